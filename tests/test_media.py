"""Density lookups against scipy, boxes at their awkward rays, majorants as bounds, and what a medium says of itself."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.ndimage import map_coordinates

from jaxvol import media, sampling
from jaxvol.types import Medium, Mesh

SHAPES = [(5, 7, 4), (1, 6, 3), (1, 1, 1), (2, 2, 2)]
BOUNDS = np.array([[-1.0, 0.5, 2.0], [0.5, 3.0, 2.75]], np.float32)


def medium(density=None, sigma_s=(1.0, 2.0, 3.0), sigma_a=(0.5, 0.0, 0.25), g=0.0, **more):
    return Medium(
        bounds=jnp.asarray(BOUNDS),
        sigma_s=jnp.asarray(sigma_s, jnp.float32),
        sigma_a=jnp.asarray(sigma_a, jnp.float32),
        g=jnp.float32(g),
        density=None if density is None else jnp.asarray(density),
        majorants=None if density is None else media.majorants(density),
        **more,
    )


def random_grid(shape, seed=0):
    return np.random.default_rng(seed).uniform(0.0, 2.0, shape).astype(np.float32)


def points_around(num=2000, seed=1):
    size = BOUNDS[1] - BOUNDS[0]
    return np.random.default_rng(seed).uniform(BOUNDS[0] - 0.2 * size, BOUNDS[1] + 0.2 * size, (num, 3)).astype(np.float32)


def by_scipy(grid, points):
    """Trilinear with the border held, 0 outside the bounds; float64."""
    points = points.astype(np.float64)
    coordinate = (points - BOUNDS[0]) / (BOUNDS[1] - BOUNDS[0]).astype(np.float64) * grid.shape - 0.5
    values = map_coordinates(grid.astype(np.float64), coordinate.T, order=1, mode="nearest")
    return np.where(np.all((points >= BOUNDS[0]) & (points <= BOUNDS[1]), axis=1), values, 0.0)


@pytest.mark.parametrize("shape", SHAPES)
def test_density_is_the_trilinear_interpolant(shape):
    grid, points = random_grid(shape), points_around()
    # Points on voxel centres, faces and corners of the box too.
    lattice = np.stack(np.meshgrid(*[np.linspace(BOUNDS[0, i], BOUNDS[1, i], 2 * shape[i] + 1) for i in range(3)]), -1)
    points = np.concatenate([points, lattice.reshape(-1, 3).astype(np.float32)])
    expected = by_scipy(grid, points)
    found = media.density(medium(grid), jnp.asarray(points))
    np.testing.assert_allclose(found, expected, atol=1e-5)
    packed = media.pack_corners(jnp.asarray(grid))
    found = media.density_packed(packed, shape, jnp.asarray(BOUNDS), jnp.asarray(points))
    np.testing.assert_allclose(found, expected, atol=1e-5)


def test_a_homogeneous_medium_has_density_one_inside_and_zero_outside():
    points = points_around()
    inside = np.all((points >= BOUNDS[0]) & (points <= BOUNDS[1]), axis=1)
    assert 0 < inside.sum() < len(points)
    np.testing.assert_array_equal(media.density(medium(), jnp.asarray(points)), inside)


@pytest.mark.parametrize("shape", SHAPES[:2])
def test_stochastic_lookup_has_the_interpolant_as_its_mean(shape):
    grid, points = random_grid(shape, 3), points_around(40)
    num = 1 << 16
    counter = jnp.arange(num * len(points), dtype=jnp.uint32).reshape(num, -1)
    u = sampling.uniforms(1, sampling.stream("test"), counter, 0)[:3]
    draws = np.asarray(media.density_stochastic(medium(grid), jnp.broadcast_to(points, (num, *points.shape)), u), np.float64)
    error = draws.std(axis=0) / np.sqrt(num)
    assert error.max() < 0.004
    z = (draws.mean(axis=0) - by_scipy(grid, points))[error > 0] / error[error > 0]
    assert np.abs(z).max() < 4.0  # 80 tests: 99.5 %
    np.testing.assert_allclose(draws.mean(axis=0)[error == 0], by_scipy(grid, points)[error == 0], atol=1e-5)


@pytest.mark.parametrize(("shape", "block"), [((9, 6, 5), 4), ((8, 8, 8), 2), ((3, 1, 7), 4), ((5, 5, 5), 1)])
def test_majorants_bound_the_interpolant(shape, block):
    grid = random_grid(shape, 5) * (np.random.default_rng(6).random(shape) < 0.3)
    coarse = media.majorants(grid, block=block)
    assert coarse.density.shape == tuple(n // block + 1 for n in shape)
    full = Medium(jnp.asarray(BOUNDS), jnp.ones(3), jnp.zeros(3), jnp.float32(0), jnp.asarray(grid), coarse)
    points = points_around(20_000)
    cell, lower, upper = media.majorant_cell(full, jnp.asarray(points))
    bound = np.asarray(coarse.density).reshape(-1)[np.asarray(cell)]
    inside = by_scipy(np.ones(shape, np.float32), points) > 0
    assert np.all(by_scipy(grid, points) <= bound + 1e-6)
    assert np.all((points >= lower - 1e-5) & (points <= upper + 1e-5), axis=1)[inside].all()
    assert coarse.density.max() == grid.max()


def test_a_spike_reaches_only_the_cells_its_interpolant_reaches():
    grid = np.zeros((12, 12, 12), np.float32)
    grid[5, 5, 5] = 1.0
    found = np.asarray(media.majorants(grid, block=4).density)
    expected = np.zeros((4, 4, 4))
    expected[1, 1, 1] = 1.0
    np.testing.assert_array_equal(found, expected)
    grid[7, 5, 5] = 2.0  # a corner of cubes in two cells
    coarse = media.majorants(grid, block=4).density
    assert coarse[1, 1, 1] == 2.0 and coarse[2, 1, 1] == 2.0 and np.count_nonzero(coarse) == 2


def interval(origin, direction):
    t0, t1 = media.box_interval(
        jnp.asarray([[-1.0] * 3, [1.0] * 3]), jnp.asarray(origin, jnp.float32), jnp.asarray(direction, jnp.float32)
    )
    return float(t0), float(t1)


def test_box_interval_of_plain_rays():
    assert interval([-3, 0, 0], [1, 0, 0]) == (2.0, 4.0)
    assert interval([0, 0, 0], [0, -1, 0]) == (0.0, 1.0)  # from inside
    t0, t1 = interval([-3, 0, 0], [-1, 0, 0])  # behind
    assert t1 <= t0 and np.isfinite([t0, t1]).all()
    t0, t1 = interval([-3, 1.5, 0], [1, 0, 0])  # beside
    assert t1 <= t0 and np.isfinite([t0, t1]).all()
    s = np.sqrt(1 / 3)
    t0, t1 = interval([-2, -2, -2], [s, s, s])  # through two corners
    assert (t0, t1) == (pytest.approx(np.sqrt(3), rel=1e-6), pytest.approx(3 * np.sqrt(3), rel=1e-6))


@pytest.mark.parametrize("zero", [0.0, -0.0])
def test_box_interval_of_rays_in_and_along_faces(zero):
    assert interval([-3, 0.5, zero], [1, zero, zero]) == (2.0, 4.0)  # parallel to four faces
    t0, t1 = interval([-3, 1.0 + 1e-5, 0], [1, zero, zero])  # parallel, just outside
    assert t1 <= t0
    for y in (1.0, -1.0):  # in a face: finite, nowhere beyond the box
        t0, t1 = interval([-3, y, 0], [1, zero, zero])
        assert np.isfinite([t0, t1]).all() and (t1 <= t0 or (t0, t1) == (2.0, 4.0))
    assert interval([-1, 0, 0], [1, zero, zero]) == (0.0, 2.0)  # starts on a face, going in
    t0, t1 = interval([1, 0, 0], [1, zero, zero])  # starts on a face, going out
    assert t1 <= t0


def test_box_interval_against_float64():
    rng = np.random.default_rng(4)
    origin = rng.uniform(-3, 3, (3000, 3))
    direction = rng.normal(size=(3000, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    a, b = (BOUNDS[0] - origin) / direction, (BOUNDS[1] - origin) / direction
    t0 = np.maximum(np.minimum(a, b).max(axis=1), 0.0)
    t1 = np.maximum(a, b).min(axis=1)
    length = np.maximum(t1 - t0, 0.0)
    found0, found1 = media.box_interval(
        jnp.asarray(BOUNDS), jnp.asarray(origin, jnp.float32), jnp.asarray(direction, jnp.float32)
    )
    assert (length > 0).sum() > 100
    np.testing.assert_allclose(np.maximum(np.asarray(found1) - np.asarray(found0), 0), length, atol=2e-5)
    np.testing.assert_allclose(np.asarray(found0)[length > 1e-4], t0[length > 1e-4], atol=2e-5)


def test_what_a_medium_says_of_itself():
    ones = np.ones((2, 2, 2), np.float32)
    grey, coloured = medium(sigma_s=(1, 1, 1), sigma_a=(0, 0, 0)), medium(g=0.3)
    assert media.is_grey(grey) and not media.is_grey(coloured)
    assert media.is_isotropic(grey) and not media.is_isotropic(coloured)
    assert media.is_homogeneous(grey) and not media.is_homogeneous(medium(ones))
    assert media.is_empty(medium(0 * ones)) and not media.is_empty(medium(ones))
    assert media.is_empty(medium(sigma_s=(0, 0, 0), sigma_a=(0, 0, 0)))
    triangle = Mesh(jnp.eye(3), jnp.asarray([[0, 1, 2]]), jnp.ones((1, 3)))
    nested = medium(
        sigma_s=(1, 1, 1), sigma_a=(0, 0, 0), boundary=triangle, inclusions=(medium(ones, g=0.5, boundary=triangle),)
    )
    assert not (media.is_grey(nested) or media.is_isotropic(nested) or media.is_homogeneous(nested))
    np.testing.assert_allclose(media.sigma_t(coloured), [1.5, 2.0, 3.25])
    np.testing.assert_allclose(media.single_scattering_albedo(coloured), [1 / 1.5, 1.0, 3 / 3.25], rtol=1e-6)
    np.testing.assert_array_equal(media.single_scattering_albedo(medium(sigma_s=(0, 0, 0), sigma_a=(0, 0, 1))), 0.0)


def test_density_has_the_gradient_of_the_interpolant_and_compiles_once():
    grid = random_grid((4, 5, 6), 9)
    point = jnp.asarray([[-0.4, 1.7, 2.3]], jnp.float32)
    lookup = jax.jit(lambda m, p: media.density(m, p)[0])
    weights = jax.grad(lambda d: lookup(medium_with(d), point))(jnp.asarray(grid))
    assert float(weights.sum()) == pytest.approx(1.0, abs=1e-5)
    assert int((np.asarray(weights) > 0).sum()) == 8
    np.testing.assert_allclose(float((weights * grid).sum()), by_scipy(grid, np.asarray(point))[0], rtol=1e-5)


def medium_with(density):
    base = medium(np.ones(density.shape, np.float32))
    return Medium(base.bounds, base.sigma_s, base.sigma_a, base.g, density, base.majorants)


def test_majorant_blocks_grow_where_collisions_are_rare():
    grid = np.zeros((32, 32, 32), np.float32)
    grid[9:11] = 1.0
    thin = media.majorant_block(grid, sigma_t=1e-3, voxel_size=1.0)
    thick = media.majorant_block(grid, sigma_t=1e3, voxel_size=1.0)
    assert (thin, thick) == (16, 1)
