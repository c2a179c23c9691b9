"""Optical thickness and transmittance: closed forms (T6), Kobayashi's cubes (T11), grids against float64 quadrature, T12."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.ndimage import map_coordinates

from jaxvol import extinction, media, ray_casting, segments, transmittance
from jaxvol.types import Medium, Mesh
from tests import problems

EXTINCTION = (0.05, 0.7, 5.0)  # channels 100:1 apart


def medium(bounds, *, sigma_s=EXTINCTION, sigma_a=(0.0, 0.0, 0.0), density=None, **more):
    return Medium(
        bounds=jnp.asarray(bounds, jnp.float32),
        sigma_s=jnp.asarray(sigma_s, jnp.float32),
        sigma_a=jnp.asarray(sigma_a, jnp.float32),
        g=jnp.float32(0.0),
        density=None if density is None else jnp.asarray(density, jnp.float32),
        majorants=None if density is None else media.majorants(density),
        **more,
    )


def lanes(*values):
    return tuple(jnp.asarray(v, jnp.float32) for v in values)


def smooth_grid(shape=(9, 8, 7), seed=2):
    grid = np.random.default_rng(seed).uniform(0.0, 1.0, shape)
    grid[: shape[0] // 3] = 0.0  # empty coarse cells too
    return grid.astype(np.float32)


UNIT = ((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0))


def rays_through(num, seed):
    """Random rays that cross the box [-1, 1]^3, float64."""
    rng = np.random.default_rng(seed)
    target = rng.uniform(-0.8, 0.8, (num, 3))
    direction = rng.normal(size=(num, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    return target - 3.0 * direction, direction


def column_by_scipy(grid, origin, direction, t0, t1, num=4000):
    """Integral of the trilinear density over the part of [t0, t1] in [-1, 1]^3, midpoints, float64."""
    a, b = (-1.0 - origin) / direction, (1.0 - origin) / direction
    begin = np.maximum(np.minimum(a, b).max(axis=1), t0)
    length = np.maximum(np.minimum(np.maximum(a, b).min(axis=1), t1) - begin, 0.0)
    t = begin[:, None] + (np.arange(num) + 0.5) / num * length[:, None]
    points = origin[:, None] + t[..., None] * direction[:, None]
    coordinate = (points + 1.0) / 2.0 * grid.shape - 0.5
    values = map_coordinates(grid.astype(np.float64), coordinate.reshape(-1, 3).T, order=1, mode="nearest").reshape(-1, num)
    return values.mean(axis=1) * length


def test_sphere_escape_probability_by_quadrature_of_the_transmittance():
    """T6: source points by Gauss-Legendre in radius and angle, distance to the sphere exact, transmittance ours."""
    node, weight = np.polynomial.legendre.leggauss(40)
    radius, mu = np.meshgrid((node + 1) / 2, node, indexing="ij")
    volume = np.outer(weight / 2, weight / 2) * 3 * radius**2
    chord = -radius * mu + np.sqrt(1 - radius**2 * (1 - mu**2))
    direction = np.stack([mu, np.sqrt(1 - mu**2), 0 * mu], -1).reshape(-1, 3)
    origin = np.stack([radius, 0 * mu, 0 * mu], -1).reshape(-1, 3)
    for t, expected in problems.SPHERE_ESCAPE:
        fog = medium(((-2.0,) * 3, (2.0,) * 3), sigma_s=(0.0, 0.0, 0.0), sigma_a=(t, t, t))
        depth = transmittance.optical_thickness(fog, *lanes(origin, direction), jnp.zeros(1600), *lanes(chord.reshape(-1)))
        escaped = np.sum(volume.reshape(-1) * np.exp(-np.asarray(depth, np.float64)[:, 0]))
        assert escaped == pytest.approx(expected, abs=1.5e-5)
        assert problems.sphere_escape(t) == pytest.approx(expected, abs=1e-5)


def kobayashi_tube(step):
    """The part of the cubes that straight lines from the source to (5, y, 5) meet: density depends on y alone there."""
    p = problems.KOBAYASHI
    y = -p.source + step * (np.arange(round((p.outer + p.source) / step)) + 0.5)
    density = np.where((np.abs(y) < p.source) | (y > p.void), 1.0, p.sigma_void / p.sigma_absorber)
    grid = np.broadcast_to(density[None, :, None], (2, y.size, 2))
    sigma = (p.sigma_absorber,) * 3
    return medium(((-10.0, -10.0, -10.0), (10.0, 100.0, 10.0)), sigma_s=(0.0, 0.0, 0.0), sigma_a=sigma, density=grid)


def test_kobayashi_fluxes_outside_the_source():
    """T11, y >= 15: Gauss-Legendre over the source cube and its mirror images."""
    p, tube = problems.KOBAYASHI, kobayashi_tube(0.25)
    node, weight = np.polynomial.legendre.leggauss(12)
    position = np.stack(np.meshgrid(*[p.source * node] * 3, indexing="ij"), -1).reshape(-1, 3)
    volume = (p.source**3 * np.einsum("i,j,k->ijk", weight, weight, weight)).reshape(-1)
    detectors = np.array([(5.0, y, 5.0) for y in p.y[1:]])
    delta = position[None] - detectors[:, None]
    distance = np.linalg.norm(delta, axis=-1)
    origin = np.broadcast_to(detectors[:, None], delta.shape).reshape(-1, 3)
    rays = lanes(origin, (delta / distance[..., None]).reshape(-1, 3))
    depth = transmittance.optical_thickness(
        tube, *rays, jnp.zeros(distance.size), *lanes(distance.reshape(-1)), num_steps=1200
    )[:, 0]
    attenuated = np.exp(-np.asarray(depth, np.float64)).reshape(distance.shape) / (4 * np.pi * distance**2)
    np.testing.assert_allclose(attenuated @ volume, p.flux[1:], rtol=5e-4)


def test_kobayashi_flux_inside_the_source():
    """T11, y = 5: by direction, the source's own integral int e^-tau dr = (1 - e^-tau) / sigma along each."""
    p, tube = problems.KOBAYASHI, kobayashi_tube(0.025)  # the interpolant blurs the source's border by a voxel
    node, weight = np.polynomial.legendre.leggauss(48)
    detector, total = np.full(3, 5.0), 0.0
    for axis in range(3):
        for side in (-1.0, 1.0):
            u, v = np.meshgrid(p.source * node, p.source * node, indexing="ij")
            face = np.insert(np.stack([u, v], -1).reshape(-1, 2), axis, side * p.source, axis=1)
            delta = face - detector
            distance = np.linalg.norm(delta, axis=1)
            area = p.source**2 * np.outer(weight, weight).reshape(-1)
            solid_angle = area * np.abs(delta[:, axis]) / distance**3
            depth = transmittance.optical_thickness(
                tube, *lanes(np.broadcast_to(detector, face.shape), delta / distance[:, None]),
                jnp.zeros(len(face)), *lanes(distance), num_steps=128,
            )[:, 0]  # fmt: skip
            total += np.sum(solid_angle * -np.expm1(-np.asarray(depth, np.float64))) / p.sigma_absorber / (4 * np.pi)
    assert total == pytest.approx(p.flux[0], rel=5e-4)


def test_marching_is_of_second_order_and_agrees_with_float64():
    grid = smooth_grid()
    origin, direction = rays_through(64, 5)
    expected = column_by_scipy(grid, origin, direction, 1.0, 4.5)
    errors = []
    for num_steps in (16, 64, 256):
        found = transmittance.density_column(
            medium(UNIT, density=grid), *lanes(origin, direction), jnp.full(64, 1.0), jnp.full(64, 4.5), num_steps=num_steps
        )
        errors.append(np.abs(np.asarray(found) - expected).mean())
    assert errors[2] < 2e-4
    assert errors[1] < errors[0] / 8 and errors[2] < errors[1] / 4


def test_ratio_tracking_has_the_transmittance_as_its_mean():
    grid = smooth_grid()
    fog = medium(UNIT, density=grid, sigma_s=(0.1, 1.0, 2.0), sigma_a=(0.0, 0.5, 1.0))
    origin, direction = rays_through(6, 8)
    num = 1 << 15
    starts, ways = (jnp.asarray(np.repeat(x[None], num, 0), jnp.float32) for x in (origin, direction))
    ends = jnp.full((num, 6), 3.6, jnp.float32)
    draws = transmittance.ratio_tracking(fog, starts, ways, jnp.zeros((num, 6)), ends, seed=3)
    draws = np.asarray(draws, np.float64)
    column = column_by_scipy(grid, origin, direction, 0.0, 3.6)
    expected = np.exp(-column[:, None] * np.asarray(media.sigma_t(fog), np.float64))
    error = draws.std(axis=0) / np.sqrt(num)
    assert error.max() < 0.003
    z = (draws.mean(axis=0) - expected) / np.maximum(error, 1e-7)
    assert np.abs(z).max() < 3.5  # 18 tests: 99.2 %
    # and against marching, which is a second route through the library
    depth = transmittance.optical_thickness(
        fog, *lanes(origin, direction), jnp.zeros(6), jnp.full(6, 3.6, jnp.float32), num_steps=400
    )
    np.testing.assert_allclose(np.exp(-np.asarray(depth)), expected, atol=2e-4)


@pytest.mark.parametrize("sigma_a", [(0.0, 0.0, 0.0), (0.3, 0.0, 2.0)])
def test_a_constant_grid_equals_the_homogeneous_medium(sigma_a):
    """T12 for transmittance: per channel, with and without absorption."""
    whole = medium(UNIT, sigma_a=sigma_a)
    gridded = medium(UNIT, sigma_a=sigma_a, density=np.ones((5, 6, 3)))
    origin, direction = rays_through(50, 11)
    arguments = (*lanes(origin, direction), jnp.zeros(50), jnp.full(50, 4.0, jnp.float32))
    exact = transmittance.optical_thickness(whole, *arguments)
    np.testing.assert_allclose(transmittance.optical_thickness(gridded, *arguments), exact, rtol=3e-5)
    for one in (whole, gridded):
        through = extinction.optical_thickness(one, *lanes(origin, direction), arguments[3], casters=(None,), num_steps=16)
        np.testing.assert_allclose(through, exact, rtol=3e-5)
    num = 1 << 13
    many = tuple(jnp.broadcast_to(x, (num, *x.shape)) for x in arguments)
    draws = np.asarray(transmittance.ratio_tracking(gridded, *many, seed=1), np.float64)
    error = draws.std(axis=0) / np.sqrt(num)
    expected = np.exp(-np.asarray(exact, np.float64))
    seen = expected > 2e-3  # the strongest channel's draws are 0 or 1: enough of them must be 1
    z = (draws.mean(axis=0) - expected)[seen] / error[seen]
    assert seen.sum() > 100 and np.mean(np.abs(z) < 3.0) > 0.98


def box_mesh(low, high):
    corners = np.array([[x, y, z] for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (low[2], high[2])])
    quads = ((0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3))
    faces = [t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))]
    return Mesh(jnp.asarray(corners, jnp.float32), jnp.asarray(faces, jnp.int32), jnp.ones((12, 3)))


def test_a_medium_with_an_inclusion_adds_up_both_parts():
    grid = smooth_grid()
    inner_low, inner_high = (-0.3, -0.5, -0.4), (0.6, 0.2, 0.5)
    inclusion = medium((inner_low, inner_high), sigma_s=(2.0, 0.5, 1.0), boundary=box_mesh(inner_low, inner_high))
    outer = medium(UNIT, sigma_s=(0.2, 1.0, 3.0), density=grid, inclusions=(inclusion,))
    origin, direction = rays_through(60, 21)
    end = 3.4
    found = extinction.optical_thickness(
        outer, *lanes(origin, direction), jnp.full(60, end), casters=segments.medium_casters(outer), num_steps=300
    )
    a, b = ((np.array(x) - origin) / direction for x in (inner_low, inner_high))
    t0 = np.maximum(np.minimum(a, b).max(axis=1), 0.0)
    t1 = np.minimum(np.maximum(a, b).min(axis=1), end)
    t1 = np.maximum(t0, t1)
    around = column_by_scipy(grid, origin, direction, 0.0, end)
    around -= np.array(
        [column_by_scipy(grid, o[None], d[None], s, e)[0] for o, d, s, e in zip(origin, direction, t0, t1, strict=True)]
    )
    expected = around[:, None] * np.array([0.2, 1.0, 3.0]) + (t1 - t0)[:, None] * np.array([2.0, 0.5, 1.0])
    assert (t1 > t0).sum() > 20
    np.testing.assert_allclose(found, expected, atol=5e-3)


def test_extinction_refuses_casters_of_another_medium():
    fog = medium(UNIT, boundary=box_mesh((-0.5,) * 3, (0.5,) * 3))
    with pytest.raises(ValueError, match="casters"):
        extinction.optical_thickness(fog, *lanes(np.zeros((1, 3)), [[0.0, 0.0, 1.0]], [1.0]), casters=(None,), num_steps=4)
    caster = ray_casting.make_caster(fog.boundary)
    inside = extinction.optical_thickness(
        fog, *lanes(np.zeros((1, 3)), [[0.0, 0.0, 1.0]], [9.0]), casters=(caster,), num_steps=4
    )
    np.testing.assert_allclose(inside[0], 0.5 * np.array(EXTINCTION), rtol=1e-5)


def test_one_compilation_serves_every_extinction():
    march = jax.jit(lambda m, o, d: transmittance.optical_thickness(m, o, d, jnp.zeros(4), jnp.full(4, 9.0)))
    origin, direction = rays_through(4, 1)
    results = [march(medium(UNIT, sigma_s=(s, s, s)), *lanes(origin, direction)) for s in (0.5, 1.0)]
    assert march._cache_size() == 1
    np.testing.assert_allclose(2 * results[0], results[1], rtol=1e-6)
