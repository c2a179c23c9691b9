"""Columns of density towards a directional light, once for all points: prefix sums along the light in a sheared grid.

Points on one line along the light share their coordinates q on the plane where the light enters the box; layers of voxels
across the light's dominant axis are summed along these lines, at q spaced by a voxel (by less in small grids). Unlike
sweeps from layer to layer nothing is interpolated twice, so columns do not blur with depth. One lookup per sheared voxel
to build, one per point to use, instead of a march per point. Second order in the spacing.
"""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from jaxvol import media
from jaxvol.extinction import MarchingMedium, region_density
from jaxvol.types import Medium

_SMALL = 5_000_000  # cells of the sheared grid that always may be had; eight floats each


class LightColumns(eqx.Module):
    """Column of density between points and a directional light."""

    corners: Float[Array, "cells 8"]  # of the columns at q and layer borders, see `media.pack_corners`
    bounds: Float[Array, "2 3"]  # of that table in sheared coordinates
    origin: Float[Array, "3"]  # the corner where layers begin
    shear: Float[Array, "3"]  # light's travel per unit along the axis
    depth: Float[Array, ""]  # of the box along the axis; negative when the light travels against it
    axis: int = eqx.field(static=True)
    shape: tuple[int, int, int] = eqx.field(static=True)


def light_columns(marching: MarchingMedium, direction: Float[Array, "3"], *, per_voxel: int | None = None) -> LightColumns:
    """Sum densities along the light's travel `direction`; eager. For a medium that is one box with a grid.

    `per_voxel` lines and layers to a voxel's edge; default one, more in small grids.
    """
    medium = marching.regions[0]
    low, high = np.asarray(medium.bounds, np.float64)
    way = np.asarray(direction, np.float64)
    voxels = (_lines_per_voxel(medium.density.shape) if per_voxel is None else per_voxel) * np.array(medium.density.shape)
    voxel = (high - low) / voxels
    axis = int(np.argmax(np.abs(way) / voxel))
    shear = way / way[axis]
    extent = high[axis] - low[axis]
    origin = low.copy()
    origin[axis] = low[axis] if way[axis] > 0 else high[axis]
    sign = 1.0 if way[axis] > 0 else -1.0
    # q = position minus its depth times shear: the range that the box's corners take
    drift = -sign * extent * shear
    begin, end = low + np.minimum(drift, 0.0), high + np.maximum(drift, 0.0)
    count = np.maximum(np.ceil((end - begin) / voxel).astype(int), 1)
    end = begin + count * voxel
    num_layers = int(voxels[axis])
    count[axis] = num_layers + 1
    step = extent / num_layers
    begin[axis], end[axis] = -0.5 * step, extent + 0.5 * step
    grid = _sum_layers(
        marching,
        *(jnp.asarray(x, jnp.float32) for x in (begin, (end - begin) / count, origin, shear, sign * step)),
        axis=axis,
        count=tuple(int(c) for c in count),
    )
    length = step * np.linalg.norm(shear)
    return LightColumns(
        corners=media.pack_corners(_unbent(grid) * jnp.float32(length)),
        bounds=jnp.asarray(np.stack([begin, end]), jnp.float32),
        origin=jnp.asarray(origin, jnp.float32),
        shear=jnp.asarray(shear, jnp.float32),
        depth=jnp.float32(sign * extent),
        axis=axis,
        shape=tuple(int(c) for c in count),
    )


def _lines_per_voxel(shape: tuple[int, int, int]) -> int:
    """One; more in small grids, where they cost nothing and nothing says that voxels are thin."""
    factor = 1
    while factor < 8 and np.prod(shape) * (factor + 1) ** 3 <= _SMALL:
        factor += 1
    return factor


@partial(jax.jit, static_argnames=("axis", "count"))
def _sum_layers(marching, begin, spacing, origin, shear, signed_step, *, axis, count):
    """Sums of densities at the middles of layers, up to each border: `count`, the axis holding the borders."""
    others = [i for i in range(3) if i != axis]
    planes = [begin[i] + (jnp.arange(count[i], dtype=jnp.float32) + 0.5) * spacing[i] for i in others]
    first, second = jnp.meshgrid(*planes, indexing="ij")
    base = jnp.zeros((*first.shape, 3), jnp.float32).at[..., others[0]].set(first).at[..., others[1]].set(second)
    base = base.at[..., axis].set(origin[axis])

    low, high = marching.regions[0].bounds

    def layer(total, k):
        # A line may enter or leave through the sides of the box within a layer: only the part inside counts.
        enter, leave = jnp.zeros_like(first), jnp.ones_like(first)
        for i in others:
            if_still = jnp.abs(shear[i]) < 1e-9
            slope = jnp.where(if_still, 1.0, signed_step * shear[i])
            start = base[..., i] + k * signed_step * shear[i]
            a, b = (low[i] - start) / slope, (high[i] - start) / slope
            enter = jnp.where(if_still, enter, jnp.maximum(enter, jnp.minimum(a, b)))
            leave = jnp.where(if_still, leave, jnp.minimum(leave, jnp.maximum(a, b)))
        points = base + (k + 0.5 * (enter + leave))[..., None] * signed_step * shear
        total = total + jnp.maximum(leave - enter, 0.0) * region_density(marching, 0, points)
        return total, total

    empty = jnp.zeros(first.shape, jnp.float32)
    _, sums = lax.scan(layer, empty, jnp.arange(count[axis] - 1, dtype=jnp.float32))
    return jnp.moveaxis(jnp.concatenate([empty[None], sums]), 0, axis)


@jax.jit
def _unbent(grid):
    """Columns whose straight lines between nodes are right on average: those through a bent curve lie on one side of it.

    By a twelfth of the second difference along each axis, the smallest of three neighbours that agree in sign: at a face of
    the box columns have a kink, and straight lines are exact there.
    """
    total = grid
    for axis in range(3):
        if grid.shape[axis] < 5:
            continue
        values = jnp.moveaxis(grid, axis, 0)
        bend = values[2:] - 2.0 * values[1:-1] + values[:-2]
        three = bend[:-2], bend[1:-1], bend[2:]
        least = jnp.minimum(jnp.minimum(*map(jnp.abs, three[:2])), jnp.abs(three[2]))
        agree = (three[0] * three[1] > 0.0) & (three[1] * three[2] > 0.0)
        change = jnp.where(agree, jnp.sign(three[1]) * least, 0.0) / 12.0
        total = total - jnp.moveaxis(jnp.pad(change, ((2, 2), (0, 0), (0, 0))), 0, axis)
    return jnp.maximum(total, 0.0)


def optical_thickness(columns: LightColumns, medium: Medium, points: Float[Array, "n 3"]) -> Float[Array, "n 3"]:
    """Between points (anywhere) and the light, RGB."""
    along = points[:, columns.axis] - columns.origin[columns.axis]
    sheared = points - along[:, None] * columns.shear
    # Before the box nothing has been passed, beyond it all of it: q is the same all along the light.
    depth = jnp.clip(along * jnp.sign(columns.depth), 0.0, jnp.abs(columns.depth))
    sheared = sheared.at[:, columns.axis].set(depth)
    return media.density_packed(columns.corners, columns.shape, columns.bounds, sheared)[:, None] * media.sigma_t(medium)
