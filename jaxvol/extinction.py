"""Optical thickness through a whole medium: its box, its boundary mesh and its inclusions, each with its own sigma_t.

The column of a region is the integral of its density over the part of the ray that it owns; optical thickness is the
sum over regions of column times sigma_t. Homogeneous regions are exact, grids are marched at the middles of equal steps
that count with the exact length each region has of them.
"""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

from jaxvol import media, ray_casting, segments
from jaxvol.types import Medium

_PACKED_VOXELS = 4_000_000  # up to here the table of cell corners, eight times the grid, is worth its memory


class MarchingMedium(eqx.Module):
    """A medium and what marching through it wants: corner tables of its grids. Not for gradients in the density."""

    regions: tuple[Medium, ...]  # the medium and its inclusions
    corners: tuple[Float[Array, "cells 8"] | None, ...]  # None: homogeneous, or too large a grid


def marching_medium(medium: Medium) -> MarchingMedium:
    """Prepare a medium for many lookups; eager."""
    regions = (medium, *medium.inclusions)
    small = [m.density is not None and m.density.size <= _PACKED_VOXELS for m in regions]
    corners = tuple(media.pack_corners(m.density) if ok else None for m, ok in zip(regions, small, strict=True))
    # Boundary meshes serve the ray casters only: without them the pytree holds what kernels read.
    bare = tuple(eqx.tree_at(lambda m: (m.boundary, m.inclusions), m, (None, ()), is_leaf=lambda x: x is None) for m in regions)
    return MarchingMedium(bare, corners)


def region_density(marching: MarchingMedium, region: int, points: Float[Array, "*b 3"]) -> Float[Array, "*b"]:
    """Density of one region's own field at points; does not ask who owns them."""
    medium, corners = marching.regions[region], marching.corners[region]
    if corners is None:
        return media.density(medium, points)
    return media.density_packed(corners, medium.density.shape, medium.bounds, points)


def num_voxels_across(medium: Medium) -> int:
    """The largest number of voxels along an axis of any grid of the medium; 0 when all is homogeneous."""
    return max([0, *(max(m.density.shape) for m in (medium, *medium.inclusions) if m.density is not None)])


def optical_thickness(
    medium: Medium,
    origin: Float[Array, "n 3"],
    direction: Float[Array, "n 3"],
    t_max: Float[Array, "n"],
    *,
    casters: tuple[ray_casting.Caster, ...],
    num_steps: int,
    marching: MarchingMedium | None = None,
) -> Float[Array, "n 3"]:
    """Integral of sigma_t from the origins to t_max (may be inf), RGB. Eager where an Embree caster bounds the medium.

    `casters` from `segments.medium_casters`, `num_steps` at least one a voxel crossed, `marching` to share its tables.
    """
    marching = marching_medium(medium) if marching is None else marching
    if segments.is_box(medium):
        return _through_box(marching, origin, direction, t_max, num_steps)
    pieces = segments.segments(medium, origin, direction, t_max, casters=casters)
    return _through_pieces(marching, origin, direction, pieces.t, pieces.region, num_steps)


@partial(jax.jit, static_argnames="num_steps")
def _through_box(marching, origin, direction, t_max, num_steps):
    medium = marching.regions[0]
    t0, t1 = media.box_interval(medium.bounds, origin, direction)
    length = jnp.maximum(jnp.minimum(t1, t_max) - t0, 0.0)
    column = length if medium.density is None else _march(marching, 0, origin, direction, t0, length, num_steps, None)
    return column[:, None] * media.sigma_t(medium)


def _march(marching, region, origin, direction, start, length, num_steps, owned):
    """Column by the middles of equal steps; `owned(low, high)` is the length of a step that counts, None = all."""
    step = length / num_steps

    def body(i, total):
        low = start + i * step
        points = origin + (low + 0.5 * step)[:, None] * direction
        part = step if owned is None else owned(low, low + step)
        return total + part * region_density(marching, region, points)

    return lax.fori_loop(0, num_steps, body, jnp.zeros_like(length))


@partial(jax.jit, static_argnames="num_steps")
def _through_pieces(marching, origin, direction, t, region, num_steps):
    start, length = t[:, 0], t[:, -1] - t[:, 0]
    total = jnp.zeros(origin.shape, jnp.float32)
    for index, medium in enumerate(marching.regions):

        def owned(low, high, index=index):
            return owned_length(t, region, index, low, high)

        if medium.density is None:
            column = owned(start, start + length)
        else:
            column = _march(marching, index, origin, direction, start, length, num_steps, owned)
        total = total + column[:, None] * media.sigma_t(medium)
    return total


def owned_length(
    t: Float[Array, "n K+1"], region: Int[Array, "n K"], index: int, low: Float[Array, "n"], high: Float[Array, "n"]
) -> Float[Array, "n"]:
    """How much of [low, high] on each ray belongs to a region, from its segments."""
    begin = jnp.maximum(t[:, :-1], low[:, None])
    end = jnp.minimum(t[:, 1:], high[:, None])
    return jnp.sum(jnp.where(region == index, jnp.maximum(end - begin, 0.0), 0.0), axis=1)
