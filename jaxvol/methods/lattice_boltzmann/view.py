"""View pass (section III-D): view rays gather what the medium emits towards the eye.

Emission density is j = sigma_s Phi / (4 pi), Phi the fluence of marched plus lattice light (the lattice's track and phi,
over h^2). It is taken from fluence, with the sigma of the point and not of the voxel, so that silhouettes are those of
the mesh. Where scattering is anisotropic the exact first order is put back, after Nakajima and Tanaka 1988: marched light is
scattered by sigma_s p about its mean direction in the voxel, instead of by sigma_s' / (4 pi). Where p is the larger, that
is forwards, only light counts that was not scattered at all: the march of sigma_s' lets pass what is scattered forwards,
and in their form each such event of one photon is seen anew (a slab of thickness 2 and g .75 then transmits 1.26). A
lattice that knows directions adds its first moment. Along straight rays media keep their exact pieces (`segments`). Along
bent rays the eikonal is marched as for the lights and radiance obeys n^2 d(L / n^2)/ds = -sigma_t L + j (the paper leaves
the n^2 out: 2.25 times at n = 1.5).
"""

import math
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float

from jaxvol import extinction, phase, segments
from jaxvol.methods.lattice_boltzmann.anisotropy import eigenvalues, mean_direction
from jaxvol.methods.lattice_boltzmann.lattice import mean_through
from jaxvol.methods.lattice_boltzmann.marching import STEPS, bent_table, corner_table, enters, interpolate
from jaxvol.methods.lattice_boltzmann.materials import Grid, Materials, forward_part, mean_cosine, reduced_sigma, regions
from jaxvol.methods.lattice_boltzmann.occupancy import narrowed, to_voxels
from jaxvol.types import Medium

_DARK = 1e-4  # transmittance at which a ray has seen enough
_CHECK = 8  # steps between looks at it


class Layout(NamedTuple):
    """What the columns of an emission table are; hashable."""

    num_layers: int
    num_channels: int
    flux: bool  # first moments of the fluence follow it
    first: bool  # marched light that is scattered once, and its flow, follow


class Source(NamedTuple):
    """One layer's light that is scattered towards the eye, as fields of fluence * h^2."""

    fluence: Float[Array, "C X Y Z"] | None  # scattered evenly; None = dark
    flux: Float[Array, "C 3 X Y Z"] | None = None  # its first moment, times 3 lambda_1
    track: Float[Array, "C X Y Z"] | None = None  # marched light, scattered by the phase function
    unscattered: Float[Array, "C X Y Z"] | None = None  # what of it was not even scattered forwards
    direction: Float[Array, "3 X Y Z"] | None = None  # its mean direction, shorter than 1 where directions differ


def emission_table(grid: Grid, *sources: Source, unit: float = 1.0) -> tuple[Float[Array, "voxels F"], Layout]:
    """Fluence [`unit` W/m2] of each layer and channel, moments and marched light if any, side by side for one gather."""
    flux, first = (any(getattr(s, name) is not None for s in sources) for name in ("flux", "track"))
    some = next(x for s in sources for x in (s.fluence, s.track) if x is not None)
    table = _table(grid, sources, unit, flux=flux, first=first)
    return table, Layout(len(sources), some.shape[0], flux, first)


@partial(jax.jit, static_argnames=("flux", "first"))
def _table(grid, sources, unit, *, flux, first):
    scale = 1.0 / (grid.voxel * grid.voxel * unit)
    some = next(x for s in sources for x in (s.fluence, s.track) if x is not None)
    dark = jnp.zeros_like(some)
    columns = [f for s in sources for f in (dark if s.fluence is None else s.fluence)]
    if flux:
        for s in sources:
            moments = jnp.zeros((some.shape[0], 3, *some.shape[1:])) if s.flux is None else s.flux
            columns += list(moments.reshape(-1, *some.shape[1:]))
    if first:
        for name in ("track", "unscattered"):
            columns += [f for s in sources for f in (dark if s.track is None else getattr(s, name))]
        for s in sources:
            flow = jnp.zeros((3, *some.shape[1:])) if s.track is None else s.direction * jnp.mean(s.track, axis=0)
            columns += list(flow)
    return corner_table(*[scale * c for c in columns])


def _sources(row, layout, towards):
    """(fluence [n, L, C], None or marched light: track, unscattered [n, L, C], cosine to `towards`, straightness [n, L])."""
    n, l, c = row.shape[0], layout.num_layers, layout.num_channels
    fluence = jnp.maximum(row[:, : l * c], 0.0).reshape(n, l, c)  # beyond the outer centres it may fall below
    at = l * c
    if layout.flux:
        moments = row[:, at : at + 3 * l * c].reshape(n, l, c, 3)
        fluence = jnp.maximum(fluence + jnp.sum(moments * towards[:, None, None, :], axis=-1), 0.0)
        at += 3 * l * c
    if not layout.first:
        return fluence, None
    track, unscattered = (jnp.maximum(row[:, k : k + l * c], 0.0).reshape(n, l, c) for k in (at, at + l * c))
    flow = row[:, at + 2 * l * c :].reshape(n, l, 3)
    heading, straightness = mean_direction(jnp.mean(track, axis=-1), tuple(flow[..., a] for a in range(3)))
    cosine = sum(heading[a] * towards[:, None, a] for a in range(3))
    return fluence, (track, unscattered, jnp.clip(cosine, -1.0, 1.0), straightness)


def _once(first, exact, hard):
    """Marched light scattered once: by `exact` where the lattice's `hard` phase function is larger, else as said above."""
    track, unscattered = first[:2]
    return track * jnp.minimum(exact, hard) + unscattered * jnp.maximum(exact - hard, 0.0)


def _truncated(g, cosine, straightness, degree):
    """4 pi times what the lattice takes for the phase function: sum over l <= degree of (2l + 1) lambda_l P_l, not below 0."""
    total = jnp.ones_like(cosine)
    before, legendre, power = jnp.ones_like(cosine), cosine, straightness
    for l, scale in enumerate(eigenvalues(g, degree)[1:], start=1):
        total = total + (2 * l + 1) * scale * power * legendre
        before, legendre = legendre, ((2 * l + 1) * cosine * legendre - l * before) / (l + 1)
        power = power * straightness
    return jnp.maximum(total, 0.0)


def _spread(part, cosine, straightness):
    """4 pi p of light whose directions have a mean of length `straightness` s: flattened by that, exact at 1.

    Light of one radiance in a cone of that mean fills 1 - s of the sphere. Whatever scatters it, nowhere is it seen brighter
    than in that cone: 4 pi p <= 1 / (1 - s). So a sky does not glare where scattering is peaked.
    """
    if part.phase is None:
        return 4.0 * math.pi * phase.henyey_greenstein(cosine, spread_g(part.g, straightness))
    peak = 4.0 * math.pi * jnp.max(part.phase.value) - 1.0
    share = jnp.minimum(straightness, straightness / jnp.maximum((1.0 - straightness) * peak, 1e-6))
    return 1.0 + share * (4.0 * math.pi * phase.evaluate(part, cosine) - 1.0)


def spread_g(g, straightness):
    """g of what scatters light whose directions have a mean of that length: g times it, less where the peak is too high."""
    wide = jnp.maximum(1.0 - straightness, 1e-6)
    most = 0.5 * (2.0 + wide - jnp.sqrt(wide * (wide + 8.0)))  # (1 + g) / (1 - g)^2 = 1 / wide
    return jnp.clip(g * straightness, -most, most)


def gather_straight(
    medium: Medium,
    marching: extinction.MarchingMedium,
    casters: tuple,
    grid: Grid,
    table: Float[Array, "voxels F"],
    layout: Layout,
    origin: np.ndarray,
    direction: np.ndarray,
    t_max: np.ndarray,
    *,
    step: float,
    degree: int = 0,
    blocks: Bool[Array, "X Y Z"] | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """(radiance [n, L, C], transmittance [n, C]) along straight rays up to t_max; `step` in voxels at most.

    Rays of like length share a loop of their own number of steps; what misses the medium, or is empty around it, costs nothing.
    """
    num_channels = layout.num_channels
    radiance = np.zeros((len(origin), layout.num_layers, num_channels), np.float32)
    through = np.ones((len(origin), num_channels), np.float32)
    if len(origin) == 0:
        return radiance, through
    pieces = (
        segments.segments(medium, *(jnp.asarray(x, jnp.float32) for x in (origin, direction, t_max)), casters=casters)
        if segments.is_box(medium)
        else segments.segments(medium, origin, direction, t_max, casters=casters)
    )
    t, region = np.asarray(pieces.t), np.asarray(pieces.region)
    clipped = to_voxels(grid, origin, direction, t_max)  # around the grid, and outside `blocks`, the medium is empty
    enter, leave = narrowed(blocks, *clipped)
    enter, leave = (np.float32(float(grid.voxel) * x)[:, None] for x in (enter, leave))
    t = np.clip(t, enter, np.maximum(enter, leave))
    length = np.where((region >= 0).any(1), t[:, -1] - t[:, 0], 0.0)
    order = np.argsort(length)
    order = order[length[order] > 0]
    scattering, absorption = (x[:, :num_channels] for x in reduced_sigma(medium, degree=degree))
    # leaner than the medium: what the loop looks up is `marching`, here only phase functions and sigma_s are read
    bare = {"density": None, "majorants": None, "ior": None, "boundary": None, "inclusions": ()}
    parts = tuple(replace(part, **bare) for part in regions(medium))
    parts = parts if layout.first else None
    num_pieces = max(int(np.max(np.sum(np.diff(t, axis=1) > 0, axis=1))), 1)
    num_pieces = min(1 << (num_pieces - 1).bit_length(), region.shape[1])
    batch = 1 << 15
    for first in range(0, len(order), batch):
        chosen = order[first : first + batch]
        size = _bucket(len(chosen))
        index = np.concatenate([chosen, np.full(size - len(chosen), chosen[-1])])
        steps = int(np.ceil(length[chosen[-1]] / (step * float(grid.voxel))))
        steps = _CHECK * -(-max(steps, 4) // _CHECK)
        found = _straight(
            marching, parts, grid, table, layout, degree, scattering, absorption,
            jnp.asarray(origin[index], jnp.float32), jnp.asarray(direction[index], jnp.float32),
            jnp.asarray(t[index, : num_pieces + 1]), jnp.asarray(region[index, :num_pieces]), steps,
        )  # fmt: skip
        radiance[chosen], through[chosen] = (np.asarray(x)[: len(chosen)] for x in found)
    return radiance, through


def _bucket(count):
    size = 1024
    while size < count:
        size *= 2
    return size


@partial(jax.jit, static_argnames=("layout", "degree"))
def _straight(marching, parts, grid, table, layout, degree, scattering, absorption, origin, direction, t, region, num_steps):
    """March n rays until all are dark; `num_steps` is traced, so that all lengths share one compilation."""
    num_channels = scattering.shape[1]
    start = t[:, 0]
    step = (t[:, -1] - start) / num_steps

    def body(i, carry):
        radiance, through = carry
        low = start + i * step
        points = origin + (low + 0.5 * step)[:, None] * direction
        # in the outer half voxel the lights' own light is at its strongest: held constant it would be 3 to 9 % too dark
        row = interpolate(table, grid.shape, (points - grid.lower) / grid.voxel, beyond=0.5)
        fluence, first = _sources(row, layout, -direction)
        thickness, scattered, once = 0.0, 0.0, 0.0
        for number, part in enumerate(marching.regions):
            column = extinction.owned_length(t, region, number, low, low + step)
            if part.density is not None:
                column = column * extinction.region_density(marching, number, points)
            thickness = thickness + column[:, None] * (scattering[number] + absorption[number])
            scattered = scattered + column[:, None] * scattering[number]
            if first is not None:
                part, angles = parts[number], first[2:]
                exact = _spread(part, *angles)[..., None] * part.sigma_s[:num_channels]
                hard = _truncated(mean_cosine(part), *angles, degree)[..., None] * scattering[number]
                once = once + column[:, None, None] * _once(first, exact, hard)
        emitted = scattered[:, None, :] * fluence + once
        seen = (through * mean_through(thickness) / (4.0 * math.pi))[:, None, :]
        return radiance + seen * emitted, through * jnp.exp(-thickness)

    n = origin.shape[0]
    begin = (jnp.zeros((n, layout.num_layers, num_channels), jnp.float32), jnp.ones((n, num_channels), jnp.float32))

    def unfinished(carry):
        i, (_, through) = carry
        return (i < num_steps) & (jnp.max(through) > _DARK)

    def advance(carry):
        i, state = carry
        return i + _CHECK, lax.fori_loop(i, i + _CHECK, body, state)

    return lax.while_loop(unfinished, advance, (0, begin))[1]


def gather_bent(
    materials: Materials,
    table: Float[Array, "voxels F"],
    layout: Layout,
    origin: np.ndarray,
    direction: np.ndarray,
    *,
    step: float,
    integrator: str,
    degree: int = 0,
    max_rounds: int = 64,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """(radiance [n, L, C], transmittance [n, C], exit position, exit direction) along bent rays that start at the grid's faces.

    The camera is outside or in index 1; radiance is L at the start, the factor 1/n^2 inside. Rays end in the voxels of
    opaque surfaces, `materials.solid`. Anisotropic scattering is Henyey and Greenstein's, of the voxel's mean cosine.
    """
    grid = materials.grid
    num_layers, num_channels = layout.num_layers, layout.num_channels
    n = len(origin)
    radiance = np.zeros((n, num_layers, num_channels), np.float32)
    through = np.ones((n, num_channels), np.float32)
    position = (origin - np.asarray(grid.lower)) / float(grid.voxel)
    heading = np.array(direction, np.float32)
    own = [*materials.scattering, *materials.absorption, *([materials.asymmetry] if layout.first else [])]
    kernel_table = jnp.concatenate([bent_table(materials), corner_table(*own), table], axis=1)
    live = np.arange(n)
    index = np.ones(n, np.float32)
    for _ in range(max_rounds):
        if len(live) == 0:
            break
        batch_end = []
        for first in range(0, len(live), 1 << 15):
            k = live[first : first + (1 << 15)]
            pad = np.concatenate([k, np.full(_bucket(len(k)) - len(k), k[0])])
            state = (position[pad], heading[pad], index[pad], radiance[pad], through[pad])
            state = tuple(jnp.asarray(x, jnp.float32) for x in state)
            found = _bent(kernel_table, grid.shape, layout, degree, step, integrator, materials.solid, *state)
            x, p, i, r, t, moving = (np.asarray(v)[: len(k)] for v in found)
            position[k], heading[k], index[k], radiance[k], through[k] = x, p, i, r, t
            batch_end.append(k[moving])
        live = np.concatenate(batch_end)
    end = np.asarray(grid.lower) + position * float(grid.voxel)
    heading /= np.maximum(np.linalg.norm(heading, axis=1, keepdims=True), 1e-20)
    return radiance, through, end, heading


@partial(jax.jit, static_argnames=("shape", "layout", "degree", "integrator"))
def _bent(table, shape, layout, degree, step, integrator, solid, position, heading, index, radiance, through):
    advance = STEPS[integrator]
    upper = jnp.asarray(shape, jnp.float32)
    c = layout.num_channels
    columns = 4 + 2 * c + (1 if layout.first else 0)

    def body(_, carry):
        position, heading, index, radiance, through, moving = carry
        kept = {}

        def lookup(x):
            kept["row"] = interpolate(table, shape, x)
            return kept["row"][:, :4]

        moved, turned, n, _ = advance(lookup, position, heading, jnp.maximum(index, 1.0), step)
        row = kept["row"]
        thickness = (row[:, 4 : 4 + c] + row[:, 4 + c : 4 + 2 * c]) * step
        scattered = row[:, 4 : 4 + c] * step
        towards = -turned * lax.rsqrt(jnp.maximum(jnp.sum(turned * turned, axis=1, keepdims=True), 1e-20))
        fluence, first = _sources(row[:, columns:], layout, towards)
        emitted = scattered[:, None, :] * fluence
        if first is not None:
            g = row[:, columns - 1 : columns]
            exact = 4.0 * math.pi * phase.henyey_greenstein(first[2], spread_g(g, first[3])) / (1.0 - forward_part(g, degree))
            hard = _truncated(g, *first[2:], degree)
            emitted = emitted + scattered[:, None, :] * _once(first, exact[..., None], hard[..., None])
        seen = through * mean_through(thickness) / (4.0 * math.pi * (n * n)[:, None])
        on = moving[:, None]
        radiance = radiance + jnp.where(on, seen, 0.0)[:, None, :] * emitted
        through = jnp.where(on, through * jnp.exp(-thickness), through)
        inside = jnp.all((moved > 0) & (moved < upper), axis=1) & (jnp.max(through, axis=1) > _DARK)
        if solid is not None:
            inside = inside & ~enters(solid, position, moved)
        return (
            jnp.where(on, moved, position), jnp.where(on, turned, heading), jnp.where(moving, n, index),
            radiance, through, moving & inside,
        )  # fmt: skip

    alive = jnp.ones(index.shape, bool)
    return lax.fori_loop(0, 32, body, (position, heading, index, radiance, through, alive))
