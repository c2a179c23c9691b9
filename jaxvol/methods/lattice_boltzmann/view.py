"""View pass (section III-D): view rays gather what the medium emits towards the eye.

Emission density is j = sigma_s Phi / (4 pi), Phi the fluence of marched plus lattice light (the lattice's track and phi,
over h^2). It is taken from fluence, with the sigma of the point and not of the voxel, so that silhouettes are those of
the mesh. Along straight rays media keep their exact pieces (`segments`). Along bent rays the eikonal is marched as for
the lights and radiance obeys n^2 d(L / n^2)/ds = -sigma_t L + j (the paper leaves the n^2 out: 2.25 times at n = 1.5).
"""

import math
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from jaxvol import extinction, segments
from jaxvol.methods.lattice_boltzmann.marching import STEPS, bent_table, corner_table, interpolate
from jaxvol.methods.lattice_boltzmann.materials import Grid, Materials, reduced_sigma
from jaxvol.types import Medium

_DARK = 1e-4  # transmittance at which a ray has seen enough


def fluence_table(grid: Grid, *fields: Float[Array, "C X Y Z"]) -> Float[Array, "voxels LC"]:
    """Fluence [W/m2] of each field (layer) and channel, side by side for one row gather; fields hold fluence * h^2."""
    scale = 1.0 / (grid.voxel * grid.voxel)
    return corner_table(*[field[c] * scale for field in fields for c in range(field.shape[0])])


def gather_straight(
    medium: Medium,
    marching: extinction.MarchingMedium,
    casters: tuple,
    grid: Grid,
    table: Float[Array, "voxels LC"],
    num_channels: int,
    origin: np.ndarray,
    direction: np.ndarray,
    t_max: np.ndarray,
    *,
    step: float,
) -> tuple[np.ndarray, np.ndarray]:
    """(radiance [n, L, C], transmittance [n, C]) along straight rays up to t_max; `step` in voxels at most.

    Rays of like length share a loop of their own number of steps; those that miss the medium cost nothing.
    """
    num_layers = table.shape[1] // num_channels
    radiance = np.zeros((len(origin), num_layers, num_channels), np.float32)
    through = np.ones((len(origin), num_channels), np.float32)
    if len(origin) == 0:
        return radiance, through
    pieces = (
        segments.segments(medium, *(jnp.asarray(x, jnp.float32) for x in (origin, direction, t_max)), casters=casters)
        if segments.is_box(medium)
        else segments.segments(medium, origin, direction, t_max, casters=casters)
    )
    t, region = np.asarray(pieces.t), np.asarray(pieces.region)
    length = np.where((region >= 0).any(1), t[:, -1] - t[:, 0], 0.0)
    order = np.argsort(length)
    order = order[length[order] > 0]
    scattering, absorption = (x[:, :num_channels] for x in reduced_sigma(medium))
    num_pieces = max(int(np.max(np.sum(np.diff(t, axis=1) > 0, axis=1))), 1)
    num_pieces = min(1 << (num_pieces - 1).bit_length(), region.shape[1])
    batch = 1 << 15
    for first in range(0, len(order), batch):
        chosen = order[first : first + batch]
        size = _bucket(len(chosen))
        index = np.concatenate([chosen, np.full(size - len(chosen), chosen[-1])])
        steps = int(np.ceil(length[chosen[-1]] / (step * float(grid.voxel))))
        steps = 8 * -(-max(steps, 4) // 8)
        found = _straight(
            marching, grid, table, scattering, absorption,
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


@jax.jit
def _straight(marching, grid, table, scattering, absorption, origin, direction, t, region, num_steps):
    """March n rays; `num_steps` is traced, so that all lengths share one compilation."""
    num_channels = scattering.shape[1]
    num_layers = table.shape[1] // num_channels
    start = t[:, 0]
    step = (t[:, -1] - start) / num_steps

    def body(i, carry):
        radiance, through = carry
        low = start + i * step
        points = origin + (low + 0.5 * step)[:, None] * direction
        fluence = interpolate(table, grid.shape, (points - grid.lower) / grid.voxel)
        thickness, scattered = 0.0, 0.0
        for number, part in enumerate(marching.regions):
            column = extinction.owned_length(t, region, number, low, low + step)
            if part.density is not None:
                column = column * extinction.region_density(marching, number, points)
            thickness = thickness + column[:, None] * (scattering[number] + absorption[number])
            scattered = scattered + column[:, None] * scattering[number]
        fluence = fluence.reshape(-1, num_layers, num_channels)
        emitted = through * scattered * _mean_through(thickness) / (4.0 * math.pi)
        return radiance + emitted[:, None, :] * fluence, through * jnp.exp(-thickness)

    n = origin.shape[0]
    begin = (jnp.zeros((n, num_layers, num_channels), jnp.float32), jnp.ones((n, num_channels), jnp.float32))
    return lax.fori_loop(0, num_steps, body, begin)


def _mean_through(thickness):
    """(1 - exp(-x)) / x: mean transmittance inside a step of optical thickness x."""
    thin = thickness < 1e-4
    return jnp.where(thin, 1.0 - 0.5 * thickness, -jnp.expm1(-thickness) / jnp.where(thin, 1.0, thickness))


def gather_bent(
    materials: Materials,
    table: Float[Array, "voxels LC"],
    num_channels: int,
    origin: np.ndarray,
    direction: np.ndarray,
    *,
    step: float,
    integrator: str,
    max_rounds: int = 64,
    solid: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """(radiance [n, L, C], transmittance [n, C], exit position, exit direction) along bent rays that start at the grid's faces.

    The camera is outside or in index 1; radiance is L at the start, the factor 1/n^2 inside. `solid` [X, Y, Z] marks
    voxels of opaque surfaces, where rays end.
    """
    grid = materials.grid
    num_layers = table.shape[1] // num_channels
    n = len(origin)
    radiance = np.zeros((n, num_layers, num_channels), np.float32)
    through = np.ones((n, num_channels), np.float32)
    position = (origin - np.asarray(grid.lower)) / float(grid.voxel)
    heading = np.array(direction, np.float32)
    kernel_table = jnp.concatenate(
        [bent_table(materials), corner_table(*materials.scattering, *materials.absorption), table], axis=1
    )
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
            blocked = None if solid is None else jnp.asarray(solid)
            found = _bent(kernel_table, grid.shape, num_channels, float(grid.voxel), step, integrator, blocked, *state)
            x, p, i, r, t, moving = (np.asarray(v)[: len(k)] for v in found)
            position[k], heading[k], index[k], radiance[k], through[k] = x, p, i, r, t
            batch_end.append(k[moving])
        live = np.concatenate(batch_end)
    end = np.asarray(grid.lower) + position * float(grid.voxel)
    heading /= np.maximum(np.linalg.norm(heading, axis=1, keepdims=True), 1e-20)
    return radiance, through, end, heading


@partial(jax.jit, static_argnames=("shape", "num_channels", "integrator"))
def _bent(table, shape, num_channels, voxel, step, integrator, solid, position, heading, index, radiance, through):
    advance = STEPS[integrator]
    upper = jnp.asarray(shape, jnp.float32)
    c = num_channels

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
        fluence = row[:, 4 + 2 * c :].reshape(row.shape[0], -1, c)
        emitted = through * scattered * _mean_through(thickness) / (4.0 * math.pi * (n * n)[:, None])
        on = moving[:, None]
        radiance = radiance + jnp.where(on, emitted, 0.0)[:, None, :] * fluence
        through = jnp.where(on, through * jnp.exp(-thickness), through)
        inside = jnp.all((moved > 0) & (moved < upper), axis=1) & (jnp.max(through, axis=1) > _DARK)
        if solid is not None:
            at = jnp.clip(moved.astype(jnp.int32), 0, jnp.asarray(shape, jnp.int32) - 1)
            inside = inside & ~solid[at[:, 0], at[:, 1], at[:, 2]]
        return (
            jnp.where(on, moved, position), jnp.where(on, turned, heading), jnp.where(moving, n, index),
            radiance, through, moving & inside,
        )  # fmt: skip

    alive = jnp.ones(index.shape, bool)
    return lax.fori_loop(0, 32, body, (position, heading, index, radiance, through, alive))
