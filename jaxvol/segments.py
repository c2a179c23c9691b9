"""Which medium a ray is in where: media bounded by boxes and meshes, and their inclusions.

Region 0 is the medium itself: its box, within its `boundary` mesh where it has one. Region i is its i-th inclusion,
likewise. The last region that contains a point owns it; region -1 is vacuum. `segments` cuts rays into pieces of one
region each; media without meshes take a closed form. Crossings come from any caster: with Embree casters everything
runs in numpy on the host, with BVH or brute-force casters in JAX, jittable, from the same array code.
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxvol import media, ray_casting
from jaxvol.ray_casting.closed_meshes import pack
from jaxvol.types import Medium

_MOST_SEGMENTS = 16  # default limit; further pieces are rare and are reported

# Odd directions for containment tests: no mesh is aligned with them. Rays in them vote.
_VOTES = np.array([[0.5377, 0.3184, 0.7807], [-0.8221, 0.5131, 0.2467], [0.1013, -0.7129, -0.6939]], np.float32)


class Segments(eqx.Module):
    """Rays cut at every change of medium; numpy or JAX arrays.

    Piece k runs from t[k] to t[k+1] in `region[k]`. The pieces reach from the first entry into a medium to the last
    exit; all else is vacuum. Unused pieces have no length and region -1.
    """

    t: Float[Array, "n K+1"]  # nondecreasing, finite, in units of the direction's length
    region: Int[Array, "n K"]  # int32: -1 vacuum, 0 the medium, i its i-th inclusion
    num_overflows: Int[Array, ""]  # rays that were cut short: more crossings or pieces than the limits allow


def medium_casters(medium: Medium | None, *, kind: str = "auto") -> tuple[ray_casting.Caster, ...]:
    """Casters of the boundaries of the medium and of its inclusions, in order of the regions; None for plain boxes."""
    if medium is None:
        return ()
    return tuple(ray_casting.caster_for(m.boundary, kind=kind) for m in (medium, *medium.inclusions))


def is_box(medium: Medium) -> bool:
    """Whether the medium is its bounding box alone, so that `segments` is a closed form with one piece."""
    return medium.boundary is None and not medium.inclusions


def segments(
    medium: Medium,
    origin: Float[Array, "n 3"],
    direction: Float[Array, "n 3"],
    t_max: Float[Array, "n"],
    *,
    casters: tuple[ray_casting.Caster, ...],
    max_hits: int = 8,
    max_segments: int | None = None,
) -> Segments:
    """Cut rays at every change of medium, between their origins (inside or outside) and t_max (may be inf).

    `casters` from `medium_casters`. Of each mesh the first `max_hits` crossings count; `max_segments` (default: what
    these can make, at most 16) is K. Rays that exceed a limit are counted and keep their first pieces. Raises
    ValueError when the number of casters is not that of the regions.
    """
    regions = _regions(medium, casters)
    if is_box(medium):
        t0, t1 = media.box_interval(medium.bounds, origin, direction)
        t1 = jnp.minimum(t1, t_max)
        hit = t0 < t1
        t = jnp.where(hit[:, None], jnp.stack([t0, t1], 1), 0.0)
        return Segments(t=t, region=jnp.where(hit, 0, -1)[:, None], num_overflows=jnp.zeros((), jnp.int32))
    xp = _array_module(casters)
    origin, direction, t_max = (xp.asarray(x, np.float32) for x in (origin, direction, t_max))
    starts, ends, overflow = [], [], 0
    for part, caster in zip(regions, casters, strict=True):
        start, end = _box_interval(xp, part.bounds, origin, direction)
        start, end = start[None], xp.minimum(end, t_max)[None]
        if caster is not None:
            found = ray_casting.crossings(caster, origin, direction, t_max, max_hits=max_hits)
            overflow = overflow + found.num_overflows
            entry, exit_ = _intervals(xp, found)
            start, end = xp.maximum(start, entry), xp.minimum(end, exit_)
        empty = ~(start < end)
        starts.append(xp.where(empty, np.float32(np.inf), start))
        ends.append(xp.where(empty, np.float32(np.inf), end))
    most = 2 * sum(s.shape[0] for s in starts) - 1
    return _cut(xp, starts, ends, overflow, min(most, _MOST_SEGMENTS) if max_segments is None else max_segments)


def region_at(medium: Medium, points: Float[Array, "n 3"], *, casters: tuple[ray_casting.Caster, ...]) -> Int[Array, "n"]:
    """The region that owns each point, int32: -1 vacuum, 0 the medium, i its i-th inclusion.

    Containment in a mesh by a vote of three rays in fixed odd directions, so that one that meets an edge badly is
    outvoted. Raises ValueError when the number of casters is not that of the regions.
    """
    regions = _regions(medium, casters)
    xp = _array_module(casters)
    points = xp.asarray(points, np.float32)
    owner = xp.full(len(points), -1, np.int32)
    for i, (part, caster) in enumerate(zip(regions, casters, strict=True)):
        low, high = xp.asarray(part.bounds, np.float32)
        inside = xp.all((points >= low) & (points <= high), 1)
        if caster is not None:
            votes = 0
            for direction in _VOTES:
                rays = (points, xp.broadcast_to(xp.asarray(direction), points.shape), xp.zeros(len(points), np.float32))
                votes = votes + ray_casting.crossings(caster, *rays, max_hits=8).inside
            inside = inside & (votes >= 2)
        owner = xp.where(inside, np.int32(i), owner)
    return owner


def _regions(medium, casters):
    regions = (medium, *medium.inclusions)
    if len(casters) != len(regions):
        raise ValueError(f"casters: {len(casters)} given for {len(regions)} regions; make them with medium_casters")
    for i, (part, caster) in enumerate(zip(regions, casters, strict=True)):
        if (caster is None) != (part.boundary is None):
            raise ValueError(f"casters: number {i} does not belong to this medium; make them with medium_casters")
    return regions


def _array_module(casters):
    """numpy when a mesh is cast by Embree, else jax.numpy."""
    return np if any(isinstance(c, ray_casting.EmbreeCaster) for c in casters) else jnp


def _box_interval(xp, bounds, origin, direction):
    """`media.box_interval` for numpy or JAX arrays."""
    bounds = xp.asarray(bounds, np.float32)
    start, end = np.float32(0.0), np.float32(np.inf)
    for i in range(3):
        d = direction[:, i]
        inverse = 1 / xp.where(xp.abs(d) < 1e-20, xp.where(d < 0, np.float32(-1e-20), np.float32(1e-20)), d)
        a, b = (bounds[0, i] - origin[:, i]) * inverse, (bounds[1, i] - origin[:, i]) * inverse
        start, end = xp.maximum(start, xp.minimum(a, b)), xp.minimum(end, xp.maximum(a, b))
    return start, end


def _intervals(xp, found):
    """(entry, exit) [J, n] of the intervals inside a mesh; entry = inf where there are no more, the last may stay open."""
    t = found.t.T
    rest = xp.full_like(t[:1], np.inf)
    ends = xp.where(found.inside, xp.concatenate([xp.zeros_like(rest), t]), xp.concatenate([t, rest]))
    if len(ends) % 2:
        ends = xp.concatenate([ends, rest])
    return ends[0::2], ends[1::2]


def _cut(xp, starts, ends, overflow, max_segments):
    """Pieces from the intervals [J_i, n] of each region i (inf, inf where there are no more); later regions win."""
    t = xp.sort(xp.concatenate([*starts, *ends]), 0)
    if xp is np:  # rays rarely use all rows
        t = t[: 1 + np.count_nonzero(np.any(np.isfinite(t[1:]), 1))]
    low, high = t[:-1], t[1:]
    owner = xp.full(low.shape, -1, np.int32)
    for i, (start, end) in enumerate(zip(starts, ends, strict=True)):
        inside = xp.zeros(low.shape, bool)
        for j in range(len(start)):
            inside = inside | ((start[j] <= low) & (high <= end[j]))
        owner = xp.where(inside, np.int32(i), owner)
    exists = (low < high) & xp.isfinite(high)
    begins, before = [], xp.full(t.shape[1], -2, np.int32)
    for m in range(len(low)):
        begins.append(exists[m] & (owner[m] != before))
        before = xp.where(exists[m], owner[m], before)
    last = xp.max(xp.where(xp.isfinite(t), t, np.float32(0.0)), 0)
    if not begins:
        begins = [xp.zeros(t.shape[1], bool)]
        low, owner = t, xp.full(t.shape, -1, np.int32)
    begins = xp.stack(begins)
    row = xp.cumsum(begins, 0) - 1
    out_t = pack(xp, begins, row, low, np.inf, max_segments + 1)
    region = pack(xp, begins, row, owner, -1, max_segments)
    return Segments(
        t=xp.minimum(out_t, last).T,
        region=region.T,
        num_overflows=overflow + xp.sum(row[-1] >= max_segments),
    )
