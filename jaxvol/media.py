"""Participating media: density lookups, boxes, coarse bounds on the density. One medium; for inclusions see `segments`.

Density multiplies sigma_s and sigma_a. Grids are `[x, y, z]`, values at cell centres, trilinear with the border value
held inside the bounds and 0 outside. A medium without a grid has density 1 inside its bounds.
"""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from jaxvol.types import Majorants, Medium


def sigma_t(medium: Medium) -> Float[Array, "3"]:
    """Extinction per unit length at density 1."""
    return medium.sigma_s + medium.sigma_a


def single_scattering_albedo(medium: Medium) -> Float[Array, "3"]:
    """sigma_s / sigma_t; 0 where both are 0."""
    extinction = sigma_t(medium)
    return jnp.where(extinction > 0, medium.sigma_s / jnp.where(extinction > 0, extinction, 1.0), 0.0)


def is_homogeneous(medium: Medium) -> bool:
    """Whether the medium and all its inclusions have constant density (by structure: no grid)."""
    return medium.density is None and all(is_homogeneous(m) for m in medium.inclusions)


def is_grey(medium: Medium) -> bool:
    """Whether scattering and absorption are equal in all channels; eager, looks at values."""

    def grey(m):
        return all(float(np.ptp(np.asarray(x))) == 0.0 for x in (m.sigma_s, m.sigma_a))

    return grey(medium) and all(grey(m) for m in medium.inclusions)


def is_isotropic(medium: Medium) -> bool:
    """Whether scattering has no preferred direction; eager, looks at values."""
    own = medium.phase is None and float(medium.g) == 0.0
    return own and all(is_isotropic(m) for m in medium.inclusions)


def is_empty(medium: Medium) -> bool:
    """Whether no light is scattered or absorbed anywhere; eager, looks at values."""
    own = float(np.max(np.asarray(sigma_t(medium)))) == 0.0
    own = own or (medium.density is not None and float(np.max(np.asarray(medium.density))) == 0.0)
    return own and all(is_empty(m) for m in medium.inclusions)


def box_interval(
    bounds: Float[Array, "2 3"], origin: Float[Array, "*b 3"], direction: Float[Array, "*b 3"]
) -> tuple[Float[Array, "*b"], Float[Array, "*b"]]:
    """(t0, t1) of a ray inside a box, t0 >= 0; a miss has t1 <= t0, both finite. Slab method, faces included."""
    least = 1e-18  # the square of its inverse, which slopes hold, stays within float32
    inverse = 1.0 / jnp.where(jnp.abs(direction) < least, jnp.where(direction < 0, -least, least), direction)
    a = (bounds[0] - origin) * inverse
    b = (bounds[1] - origin) * inverse
    near = jnp.minimum(a, b)
    far = jnp.maximum(a, b)
    t0 = jnp.maximum(jnp.maximum(near[..., 0], near[..., 1]), jnp.maximum(near[..., 2], 0.0))
    t1 = jnp.minimum(jnp.minimum(far[..., 0], far[..., 1]), far[..., 2])
    miss = t1 <= t0
    return jnp.where(miss, 0.0, t0), jnp.where(miss, 0.0, t1)


def inside_box(bounds: Float[Array, "2 3"], points: Float[Array, "*b 3"]) -> Bool[Array, "*b"]:
    """Whether points lie in the closed box."""
    return jnp.all((points >= bounds[0]) & (points <= bounds[1]), axis=-1)


def voxel_size(medium: Medium) -> Float[Array, "3"]:
    """Edge lengths of one voxel. Raises AttributeError for a medium without a grid."""
    return (medium.bounds[1] - medium.bounds[0]) / jnp.asarray(medium.density.shape, jnp.float32)


def voxel_coordinates(
    bounds: Float[Array, "2 3"], shape: tuple[int, int, int], points: Float[Array, "*b 3"]
) -> Float[Array, "*b 3"]:
    """Continuous voxel coordinates: 0 at the lower faces, `shape` at the upper ones, centres at half-integers."""
    return (points - bounds[0]) * (jnp.asarray(shape, jnp.float32) / (bounds[1] - bounds[0]))


def density(medium: Medium, points: Float[Array, "*b 3"]) -> Float[Array, "*b"]:
    """Trilinear density at world points; ignores `boundary` and `inclusions`. Eight gathers."""
    inside = inside_box(medium.bounds, points)
    if medium.density is None:
        return inside.astype(jnp.float32)
    grid = medium.density
    last = jnp.asarray(grid.shape, jnp.float32) - 1.0
    coordinate = jnp.clip(voxel_coordinates(medium.bounds, grid.shape, points) - 0.5, 0.0, last)
    low = jnp.minimum(coordinate.astype(jnp.int32), jnp.maximum(jnp.asarray(grid.shape, jnp.int32) - 2, 0))
    fx, fy, fz = (coordinate[..., i] - low[..., i] for i in range(3))
    high = jnp.minimum(low + 1, jnp.asarray(grid.shape, jnp.int32) - 1)
    flat = grid.reshape(-1)
    _, ny, nz = grid.shape

    def row(ix, iy):
        base = (ix * ny + iy) * nz
        return flat[base + low[..., 2]] * (1.0 - fz) + flat[base + high[..., 2]] * fz

    near = row(low[..., 0], low[..., 1]) * (1.0 - fy) + row(low[..., 0], high[..., 1]) * fy
    far = row(high[..., 0], low[..., 1]) * (1.0 - fy) + row(high[..., 0], high[..., 1]) * fy
    return jnp.where(inside, near * (1.0 - fx) + far * fx, 0.0)


def density_stochastic(medium: Medium, points: Float[Array, "*b 3"], u: tuple[Float[Array, "*b"], ...]) -> Float[Array, "*b"]:
    """One of the eight corner densities, chosen with its trilinear weight: its mean is `density`. One gather.

    Exact in distribution inside delta tracking and unbiased inside ratio tracking, which are linear in each lookup.
    """
    inside = inside_box(medium.bounds, points)
    if medium.density is None:
        return inside.astype(jnp.float32)
    nx, ny, nz = medium.density.shape
    coordinate = voxel_coordinates(medium.bounds, medium.density.shape, points) - 0.5
    ix, iy, iz = (
        jnp.clip(jnp.floor(coordinate[..., i] + u[i]).astype(jnp.int32), 0, n - 1) for i, n in enumerate((nx, ny, nz))
    )
    return jnp.where(inside, medium.density.reshape(-1)[(ix * ny + iy) * nz + iz], 0.0)


def pack_corners(grid: Float[Array, "X Y Z"]) -> Float[Array, "cells 8"]:
    """The eight corner values of each of the (X+1)(Y+1)(Z+1) cells between voxel centres, for one gather a lookup.

    Cell (i, j, k) lies between the centres of voxels i-1 and i (the border held), so that lookups need no clamping.
    Memory: eight times the grid.
    """
    padded = jnp.pad(grid, 1, mode="edge")
    corners = [
        padded[i : i + grid.shape[0] + 1, j : j + grid.shape[1] + 1, k : k + grid.shape[2] + 1]
        for i in (0, 1)
        for j in (0, 1)
        for k in (0, 1)
    ]
    return jnp.stack(corners, axis=-1).reshape(-1, 8)


def density_packed(
    packed: Float[Array, "cells 8"], shape: tuple[int, int, int], bounds: Float[Array, "2 3"], points: Float[Array, "*b 3"]
) -> Float[Array, "*b"]:
    """`density` from the table of `pack_corners` of a grid of `shape`: one row gather."""
    inside = inside_box(bounds, points)
    coordinate = voxel_coordinates(bounds, shape, points) + 0.5
    cell = [jnp.clip(coordinate[..., i].astype(jnp.int32), 0, n) for i, n in enumerate(shape)]
    fx, fy, fz = (jnp.clip(coordinate[..., i] - cell[i], 0.0, 1.0) for i in range(3))
    rows = packed[(cell[0] * (shape[1] + 1) + cell[1]) * (shape[2] + 1) + cell[2]]
    z = [rows[..., 2 * i] * (1.0 - fz) + rows[..., 2 * i + 1] * fz for i in range(4)]
    y = [z[2 * i] * (1.0 - fy) + z[2 * i + 1] * fy for i in range(2)]
    return jnp.where(inside, y[0] * (1.0 - fx) + y[1] * fx, 0.0)


def majorants(grid: ArrayLike, *, block: int = 4) -> Majorants:
    """Upper bounds of the trilinear interpolant: the maximum over the corners of `block`^3 cubes of voxel centres; eager."""
    grid = np.asarray(grid, np.float32)
    shape = [n // block + 1 for n in grid.shape]
    padded = np.pad(grid, [(1, s * block - n) for n, s in zip(grid.shape, shape, strict=True)], mode="edge")
    coarse = padded
    for axis, count in enumerate(shape):
        windows = [np.take(coarse, np.arange(count) * block + k, axis=axis) for k in range(block + 1)]
        coarse = np.maximum.reduce(windows)
    return Majorants(density=jnp.asarray(coarse), block=block)


def majorant_block(grid: ArrayLike, *, sigma_t: float, voxel_size: float) -> int:
    """The block of `majorants` with the fewest tracking steps for a ray that crosses all of the grid alike; eager.

    A step is a tentative collision, at the rate of the majorant, or the border of a coarse cell: 3/2 a cell on average
    over directions. `sigma_t` (1/length) at density 1.
    """

    def steps(block):
        mean = float(np.mean(np.asarray(majorants(grid, block=block).density)))
        return sigma_t * mean + 1.5 / (block * voxel_size)

    found = min((4, 8, 16), key=steps)
    # Small cells are looked at only where even bounds without any slack would pay: grids are large.
    least = sigma_t * float(np.mean(np.asarray(grid)))
    tried = [block for block in (1, 2) if least + 1.5 / (block * voxel_size) < steps(found)]
    return min((*tried, found), key=steps)


def majorant_cell(
    medium: Medium, points: Float[Array, "*b 3"]
) -> tuple[Int[Array, "*b"], Float[Array, "*b 3"], Float[Array, "*b 3"]]:
    """Flat index, lower and upper corner (world) of the coarse cell that holds each point (clamped to the grid)."""
    coarse = medium.majorants
    voxel = voxel_size(medium)
    size, first = voxel * coarse.block, medium.bounds[0] - 0.5 * voxel
    last = jnp.asarray(coarse.density.shape, jnp.int32) - 1
    cell = jnp.clip(jnp.floor((points - first) / size).astype(jnp.int32), 0, last)
    flat = (cell[..., 0] * coarse.density.shape[1] + cell[..., 1]) * coarse.density.shape[2] + cell[..., 2]
    lower = first + cell * size
    return flat, lower, lower + size
