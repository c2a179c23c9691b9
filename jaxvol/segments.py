"""Which medium a ray is in where: media bounded by boxes and meshes, and their inclusions.

Region 0 is the medium itself: its box, within its `boundary` mesh where it has one. Region i is its i-th inclusion,
likewise. The last region that contains a point owns it; region -1 is vacuum. `segments` cuts rays into pieces of one
region each; media without meshes take a closed form. Crossings come from any caster: with BVH or brute-force
casters all is jittable, with Embree casters arrays come from and go to the host.
"""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int

from jaxvol import media, ray_casting
from jaxvol.ray_casting.closed_meshes import pack, padded
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
    on_host = any(isinstance(c, ray_casting.EmbreeCaster) for c in casters)
    n = len(origin)
    xp = np if on_host else jnp
    rays = tuple(xp.asarray(x, np.float32) for x in (origin, direction, t_max))
    if on_host:
        rays = padded(*rays)
    found = tuple(None if c is None else ray_casting.crossings(c, *rays, max_hits=max_hits) for c in casters)
    boxes = tuple(part.bounds for part in regions)
    most = 2 * sum(1 if c is None else (max_hits + 2) // 2 for c in casters) - 1
    pieces = _assemble(boxes, found, *rays, min(most, _MOST_SEGMENTS) if max_segments is None else max_segments)
    if not on_host:
        return pieces
    return Segments(np.asarray(pieces.t)[:n], np.asarray(pieces.region)[:n], np.asarray(pieces.num_overflows))


@functools.partial(jax.jit, static_argnames=("max_segments",))
def _assemble(boxes, found, origin, direction, t_max, max_segments):
    """Pieces of rays from the crossings of each region's mesh (None: it fills its box)."""
    starts, ends, overflow = [], [], 0
    for bounds, crossed in zip(boxes, found, strict=True):
        start, end = media.box_interval(bounds, origin, direction)
        start, end = start[None], jnp.minimum(end, t_max)[None]
        if crossed is not None:
            overflow = overflow + crossed.num_overflows
            entry, exit_ = _intervals(crossed)
            start, end = jnp.maximum(start, entry), jnp.minimum(end, exit_)
        empty = ~(start < end)
        starts.append(jnp.where(empty, jnp.float32(jnp.inf), start))
        ends.append(jnp.where(empty, jnp.float32(jnp.inf), end))
    return _cut(starts, ends, overflow, max_segments)


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


def _intervals(found):
    """(entry, exit) [J, n] of the intervals inside a mesh; entry = inf where there are no more, the last may stay open."""
    t = found.t.T
    rest = jnp.full_like(t[:1], np.inf)
    ends = jnp.where(found.inside, jnp.concatenate([jnp.zeros_like(rest), t]), jnp.concatenate([t, rest]))
    if len(ends) % 2:
        ends = jnp.concatenate([ends, rest])
    return ends[0::2], ends[1::2]


def _sort_rows(t):
    """Each column of [T, n] in increasing order, T small; exchanges of neighbours, since XLA's sort is slow on CPUs."""
    rows = t.shape[0]
    even, odd = rows // 2 * 2, (rows - 1) // 2 * 2 + 1

    def exchange(t, first, end):
        low, high = t[first:end:2], t[first + 1 : end : 2]
        pairs = jnp.stack([jnp.minimum(low, high), jnp.maximum(low, high)], 1).reshape(end - first, -1)
        return jnp.concatenate([t[:first], pairs, t[end:]])

    return lax.fori_loop(0, rows // 2 + 1, lambda _, x: exchange(exchange(x, 0, even), 1, odd), t)


def _cut(starts, ends, overflow, max_segments):
    """Pieces from the intervals [J_i, n] of each region i (inf, inf where there are no more); later regions win."""
    if len(starts) == 1:  # in order already
        t = jnp.stack([starts[0], ends[0]], 1).reshape(-1, starts[0].shape[1])
    else:
        t = _sort_rows(jnp.concatenate([*starts, *ends]))
    low, high = t[:-1], t[1:]
    owner = jnp.full(low.shape, -1, np.int32)
    for i, (start, end) in enumerate(zip(starts, ends, strict=True)):
        inside = jnp.zeros(low.shape, bool)
        for j in range(len(start)):
            inside = inside | ((start[j] <= low) & (high <= end[j]))
        owner = jnp.where(inside, np.int32(i), owner)
    exists = (low < high) & jnp.isfinite(high)
    begins, before = [], jnp.full(t.shape[1], -2, np.int32)
    for m in range(len(low)):
        begins.append(exists[m] & (owner[m] != before))
        before = jnp.where(exists[m], owner[m], before)
    last = jnp.max(jnp.where(jnp.isfinite(t), t, np.float32(0.0)), 0)
    if not begins:
        begins = [jnp.zeros(t.shape[1], bool)]
        low, owner = t, jnp.full(t.shape, -1, np.int32)
    begins = jnp.stack(begins)
    row = jnp.cumsum(begins, 0) - 1
    out_t = pack(begins, row, low, np.inf, max_segments + 1)
    region = pack(begins, row, owner, -1, max_segments)
    return Segments(
        t=jnp.minimum(out_t, last).T,
        region=region.T,
        num_overflows=overflow + jnp.sum(row[-1] >= max_segments),
    )
