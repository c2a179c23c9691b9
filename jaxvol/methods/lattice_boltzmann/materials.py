"""Init pass (section III-A): the medium as numbers per voxel, and the smoothed refractive index with its gradient.

Each voxel holds sigma * h per channel, weighted by how much of it each region fills; later inclusions override earlier
ones. Of anisotropic scattering the forward part f (`forward_part`) is left to the ray, sigma_s' = (1 - f) sigma_s:
similarity at degree 0, delta-M for a lattice that resolves moments up to `degree` (anisotropy.py). The index is
n = 1 + sum of occupancy (n_m - n below), filtered once with a Gaussian, then differentiated, so that n and grad n stay
consistent (the paper filters the gradient: linear, and equal in the interior). Stored is D = grad (n^2 / 2), per voxel
length.
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float
from scipy import sparse
from scipy.ndimage import gaussian_filter

from jaxvol import media
from jaxvol.types import Medium, Mesh
from jaxvol.voxelization import surface_voxels, voxelize

_SUBSAMPLES = 2  # per voxel edge, of density grids that do not coincide with the lattice


class Grid(eqx.Module):
    """Where the voxels are: cubes of edge `voxel` from the corner `lower`."""

    lower: Float[Array, "3"]
    voxel: Float[Array, ""]  # h, scene units
    shape: tuple[int, int, int] = eqx.field(static=True)


class Materials(eqx.Module):
    """What each voxel does to light, in units of the voxel: sigma * h."""

    grid: Grid
    scattering: Float[Array, "C X Y Z"]  # sigma_s (1 - f) h
    absorption: Float[Array, "C X Y Z"]  # sigma_a h
    ior: Float[Array, "X Y Z"] | None  # smoothed refractive index
    gradient: Float[Array, "3 X Y Z"] | None  # of ior^2 / 2, per voxel
    body: Bool[Array, "X Y Z"] | None  # voxels that some region touches; None exactly when `ior` is
    asymmetry: Float[Array, "X Y Z"] | None = None  # mean cosine g; None when all is isotropic
    solid: Bool[Array, "X Y Z"] | None = None  # voxels that hold opaque surfaces; None without such
    solid_albedo: Float[Array, "C X Y Z"] | None = None  # of these surfaces


def regions(medium: Medium) -> tuple[Medium, ...]:
    """The medium and its inclusions; the last one that contains a point owns it."""
    return (medium, *medium.inclusions)


def forward_part(g: Float[Array, "..."], degree: int) -> Float[Array, "..."]:
    """f, the part of scattering that is left to the ray: g^(degree + 1), with the sign that it has.

    None for negative g at odd degrees: scattering backwards is no forward peak, and moments less f would exceed 1 (g / (1 + g)
    at degree 1), which makes light.
    """
    f = jnp.ones_like(g)
    for _ in range(degree + 1):
        f = f * g
    return jnp.where(g < 0, 0.0, f) if degree % 2 else f


def reduced_sigma(medium: Medium, *, degree: int = 0) -> tuple[Float[Array, "R 3"], Float[Array, "R 3"]]:
    """sigma_s (1 - f) and sigma_a of every region at density 1, per unit length."""
    parts = regions(medium)
    scattering = jnp.stack([part.sigma_s * (1.0 - forward_part(mean_cosine(part), degree)) for part in parts])
    return scattering, jnp.stack([part.sigma_a for part in parts])


def mean_cosine(part: Medium) -> Float[Array, ""]:
    """g of one region."""
    return part.g if part.phase is None else part.phase.moments[1]


def body_bounds(medium: Medium) -> np.ndarray:
    """[2, 3] smallest box that holds everything of the medium that is not empty; eager."""
    boxes = []
    for part in regions(medium):
        low, high = np.asarray(part.bounds, np.float64)
        if part.boundary is not None:
            vertices = np.asarray(part.boundary.vertices, np.float64)
            low, high = np.maximum(low, vertices.min(0)), np.minimum(high, vertices.max(0))
        if part.density is not None:
            density = np.asarray(part.density)
            edge = (np.asarray(part.bounds[1], np.float64) - np.asarray(part.bounds[0])) / density.shape
            for axis in range(3):
                filled = np.flatnonzero(density.max(axis=tuple(a for a in range(3) if a != axis)) > 0)
                if len(filled):
                    start = float(part.bounds[0][axis])
                    # trilinear density reaches one voxel beyond its samples
                    low[axis] = max(low[axis], start + (filled[0] - 0.5) * edge[axis])
                    high[axis] = min(high[axis], start + (filled[-1] + 1.5) * edge[axis])
        boxes.append((low, high))
    return np.array([np.min([b[0] for b in boxes], axis=0), np.max([b[1] for b in boxes], axis=0)])


def cropped(medium: Medium) -> Medium:
    """The same medium without the empty border of its density grid, in a smaller box; eager.

    One layer of empty voxels stays, over which the trilinear density falls to zero. A medium with inclusions or an index
    keeps its box, since that says where these are.
    """
    if medium.density is None or medium.inclusions or medium.ior is not None:
        return medium
    density = np.asarray(medium.density)
    filled = density > 0
    spans = []
    for axis, count in enumerate(density.shape):
        where = np.flatnonzero(filled.any(axis=tuple(a for a in range(3) if a != axis)))
        if len(where) == 0:
            return medium
        spans.append((max(int(where[0]) - 1, 0), min(int(where[-1]) + 2, count)))
    low, high = (np.array(x) for x in zip(*spans, strict=True))
    if np.prod(high - low) > 0.9 * density.size:
        return medium
    lower, upper = np.asarray(medium.bounds, np.float64)
    edge = (upper - lower) / density.shape
    inner = density[tuple(slice(*span) for span in spans)]
    bounds = np.stack([lower + low * edge, lower + high * edge])
    block = 4 if medium.majorants is None else medium.majorants.block
    fields = jnp.asarray(bounds, jnp.float32), jnp.asarray(inner), media.majorants(inner, block=block)
    return eqx.tree_at(lambda m: (m.bounds, m.density, m.majorants), medium, fields, is_leaf=lambda x: x is None)


def make_grid(medium: Medium, *, resolution: int, margin: int = 0) -> Grid:
    """Cubic voxels over the body, `resolution` along its longest side, plus `margin` voxels all around; eager."""
    low, high = body_bounds(medium)
    voxel = float(np.max(high - low)) / resolution
    count = np.maximum(np.ceil((high - low) / voxel - 1e-4).astype(int), 1) + 2 * margin
    exact = np.isclose((high - low) / voxel, np.round((high - low) / voxel), atol=1e-4)
    count = np.where(exact, count, -(-count // 4) * 4)  # few shapes: a body that moves a little compiles nothing anew
    lower = 0.5 * (low + high) - 0.5 * voxel * count
    lower = np.where(exact, low - margin * voxel, lower)
    return Grid(jnp.asarray(lower, jnp.float32), jnp.float32(voxel), tuple(int(n) for n in count))


def build(
    medium: Medium, grid: Grid, *, num_channels: int, filter_width: float, supersampling: int = 4, degree: int = 0
) -> Materials:
    """Fill the voxels; eager. `num_channels` 1 takes the first channel of a grey medium."""
    lower, voxel = np.asarray(grid.lower, np.float64), float(grid.voxel)
    bounds = np.array([lower, lower + voxel * np.array(grid.shape)])
    all_s, all_a = (np.asarray(x)[:, :num_channels] for x in reduced_sigma(medium, degree=degree))
    scattering = np.zeros((num_channels, *grid.shape), np.float32)
    absorption = np.zeros_like(scattering)
    refractive = any(part.ior is not None for part in regions(medium))
    index, filled = np.ones(grid.shape, np.float32), np.zeros(grid.shape, np.float32)
    asymmetry = None if media.is_isotropic(medium) else np.zeros(grid.shape, np.float32)
    for number, part in enumerate(regions(medium)):
        share = _share(part, bounds, grid.shape, supersampling)
        density = _density(part, bounds, grid.shape)
        for channel in range(num_channels):
            for field, sigma in ((scattering, all_s), (absorption, all_a)):
                field[channel] += share * (sigma[number, channel] * voxel * density - field[channel])
        if asymmetry is not None:
            asymmetry = np.where(share > 0.5, np.float32(mean_cosine(part)), asymmetry)
        if refractive:
            own = 1.0 if part.ior is None else _index(part, bounds, grid.shape)
            index += share * (own - index)
            filled = np.maximum(filled, share)
    ior = gradient = body = None
    if refractive:
        index = gaussian_filter(index, filter_width, truncate=3.0, mode="nearest")
        gradient = jnp.asarray(np.stack(np.gradient(0.5 * index * index)))
        ior, body = jnp.asarray(index), jnp.asarray(filled > 0.02)
    asymmetry = None if asymmetry is None else jnp.asarray(asymmetry)
    return Materials(grid, jnp.asarray(scattering), jnp.asarray(absorption), ior, gradient, body, asymmetry)


def with_surfaces(materials: Materials, mesh: Mesh, *, num_channels: int) -> Materials:
    """Mark the voxels that an opaque mesh touches, with the mean albedo of its faces there; unchanged where it misses."""
    grid = materials.grid
    low = np.asarray(grid.lower, np.float64)
    bounds = np.array([low, low + float(grid.voxel) * np.array(grid.shape)])
    count, albedo = surface_voxels(mesh, bounds, grid.shape)
    if not count.any():
        return materials
    albedo = np.moveaxis(albedo[..., :num_channels], -1, 0).astype(np.float32)
    return eqx.tree_at(
        lambda m: (m.solid, m.solid_albedo), materials, (jnp.asarray(count), jnp.asarray(albedo)), is_leaf=lambda x: x is None
    )


def twice(materials: Materials, *, degree: int) -> Materials:
    """The channels as they are, and again with the forward part of scattering taken out of the ray (sigma_s whole)."""
    whole = materials.scattering / (1.0 - forward_part(materials.asymmetry, degree))
    return eqx.tree_at(
        lambda m: (m.scattering, m.absorption),
        materials,
        (jnp.concatenate([materials.scattering, whole]), jnp.concatenate([materials.absorption] * 2)),
    )


def _share(part, bounds, shape, supersampling):
    """How much of each voxel lies inside a region."""
    covered = 1.0
    for axis in range(3):
        edges = np.linspace(bounds[0, axis], bounds[1, axis], shape[axis] + 1)
        low, high = float(part.bounds[0][axis]), float(part.bounds[1][axis])
        length = np.minimum(edges[1:], high) - np.maximum(edges[:-1], low)
        share = np.clip(length / (edges[1] - edges[0]), 0.0, 1.0)
        share = np.where(share > 1 - 1e-4, 1.0, share)
        covered = covered * share.reshape([-1 if a == axis else 1 for a in range(3)])
    if part.boundary is None:
        return np.broadcast_to(covered, shape).astype(np.float32)
    return (voxelize(part.boundary, bounds, shape, supersampling=supersampling) * covered).astype(np.float32)


def _density(part, bounds, shape):
    """Mean density of each voxel, by the trilinear field at `_SUBSAMPLES`^3 points: one small matrix per axis."""
    if part.density is None:
        return np.float32(1.0)
    field = np.asarray(part.density)
    same = field.shape == shape and np.allclose(part.bounds, bounds, atol=1e-4 * float(np.max(bounds[1] - bounds[0])))
    if same:
        return field
    for axis in range(3):
        own = np.asarray(part.bounds, np.float64)[:, axis]
        matrix = _resampling(own, field.shape[axis], bounds[:, axis], shape[axis])
        moved = np.moveaxis(field, axis, 0)
        found = (matrix @ moved.reshape(len(moved), -1)).reshape(-1, *moved.shape[1:])
        field = np.moveaxis(found, 0, axis)
    return field


def _resampling(own, num_own, wanted, num_wanted):
    """[num_wanted, num_own] sparse: mean over the samples in a voxel of linear interpolation, 0 outside `own`."""
    fine = num_wanted * _SUBSAMPLES
    points = wanted[0] + (np.arange(fine) + 0.5) * (wanted[1] - wanted[0]) / fine
    inside = (points >= own[0]) & (points <= own[1])
    at = np.clip((points - own[0]) / (own[1] - own[0]) * num_own - 0.5, 0.0, num_own - 1.0)
    low = np.minimum(at.astype(int), max(num_own - 2, 0))
    high, row = np.minimum(low + 1, num_own - 1), np.arange(fine) // _SUBSAMPLES
    share = np.where(inside, 1.0 / _SUBSAMPLES, 0.0)
    values = np.concatenate([share * (1.0 - (at - low)), share * (at - low)]).astype(np.float32)
    index = np.tile(row, 2), np.concatenate([low, high])
    return sparse.csr_matrix((values, index), shape=(num_wanted, num_own))


def _index(part, bounds, shape):
    if jnp.ndim(part.ior) == 0:
        return np.float32(part.ior)
    centers = [bounds[0, a] + (np.arange(shape[a]) + 0.5) * (bounds[1, a] - bounds[0, a]) / shape[a] for a in range(3)]
    points = np.stack(np.meshgrid(*centers, indexing="ij"), -1).astype(np.float32)
    low, high = np.asarray(part.bounds)
    carrier = eqx.tree_at(lambda m: m.density, part, part.ior, is_leaf=lambda x: x is None)
    # held constant beyond the faces, unlike a density, which ends there
    return np.asarray(media.density(carrier, jnp.asarray(np.clip(points, low, high))))
