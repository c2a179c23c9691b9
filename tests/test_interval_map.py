"""Interval maps against closed forms and against marches in float64 numpy."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxvol import interval_map as im
from jaxvol.types import Medium

BOUNDS = np.array([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]], np.float32)


def medium(sigma_s, sigma_a, density=None, g=0.0):
    rgb = lambda v: jnp.asarray(np.broadcast_to(np.asarray(v, np.float32), 3))  # noqa: E731
    return Medium(
        bounds=jnp.asarray(BOUNDS),
        sigma_s=rgb(sigma_s),
        sigma_a=rgb(sigma_a),
        g=jnp.float32(g),
        density=None if density is None else jnp.asarray(density, jnp.float32),
    )


def broken_cloud(n=24, seed=3):
    """Smooth random lumps with gaps between them."""
    rng = np.random.default_rng(seed)
    x = (np.arange(n) + 0.5) / n * 2 - 1
    grid = np.stack(np.meshgrid(x, x, x, indexing="ij"), axis=-1)
    density = np.zeros((n, n, n))
    for _ in range(30):
        centre, width = rng.uniform(-0.8, 0.8, 3), rng.uniform(0.12, 0.3)
        density += np.exp(-np.sum((grid - centre) ** 2, axis=-1) / width**2)
    return np.maximum(density - 0.25, 0.0) / density.max()


@pytest.fixture(scope="module")
def rays():
    rng = np.random.default_rng(0)
    target = rng.uniform(-0.8, 0.8, (96, 3))
    origin = np.broadcast_to([0.0, 0.2, 3.0], target.shape)
    direction = target - origin
    direction /= np.linalg.norm(direction, axis=-1, keepdims=True)
    return origin.astype(np.float32), direction.astype(np.float32), np.zeros(96, np.float32), np.full(96, 50.0, np.float32)


def span(rays):
    """The rays' stay in the box, float64."""
    origin, direction = (np.asarray(a, np.float64) for a in rays[:2])
    a, b = (BOUNDS[0] - origin) / direction, (BOUNDS[1] - origin) / direction
    return np.minimum(a, b).max(axis=1), np.maximum(a, b).min(axis=1)


def test_homogeneous_is_the_closed_form(rays):
    m = medium(1.5, 0.5)
    found = im.interval_map(m, *rays, num_intervals=8, grey=True)
    enter, leave = span(rays)
    s = (np.arange(8) + 0.5)[:, None] / 8
    omt = 1 - np.exp(-2.0 * (leave - enter))
    np.testing.assert_allclose(found.distance, enter - np.log(1 - s * omt) / 2.0, rtol=1e-5)
    np.testing.assert_allclose(found.weight[0, 0], 0.75 * omt / 8, rtol=1e-5)
    np.testing.assert_allclose(found.one_minus_transmittance[0], omt, rtol=1e-5)


def test_constant_grid_equals_homogeneous(rays):
    grid = medium([0.02, 1.0, 2.0], 0.1, density=np.ones((5, 4, 3)))
    plain = medium([0.02, 1.0, 2.0], 0.1)
    a = im.interval_map(grid, *rays, num_intervals=8, num_steps=37)
    b = im.interval_map(plain, *rays, num_intervals=8)
    np.testing.assert_allclose(a.distance, b.distance, atol=2e-5)
    np.testing.assert_allclose(a.weight, b.weight, atol=2e-6)


@pytest.mark.parametrize("grey", [True, False])
@pytest.mark.parametrize("sigma", [0.0, 1e-6, 1e-3, 4.0, 1e3, 1e7])
def test_extreme_media_are_finite_ordered_and_exact_in_sum(rays, sigma, grey):
    """Stability rows: zero density, tau_min -> 1, tau_min -> 0, steps much longer than a free path, weights."""
    scatter = sigma if grey else np.array([0.01, 0.3, 1.0]) * sigma
    m = medium(scatter, 0.25 * sigma, density=broken_cloud(12))
    found = im.interval_map(m, *rays, num_intervals=16, num_steps=64, grey=grey)
    distance, weight = np.asarray(found.distance), np.asarray(found.weight)
    enter, leave = span(rays)
    assert np.isfinite(distance).all() and np.isfinite(weight).all() and (weight >= 0).all()
    assert (np.diff(distance, axis=0) >= -1e-5).all()
    assert (distance >= enter - 1e-5).all() and (distance <= leave + 1e-5).all()
    total = weight.sum(axis=0) if weight.shape[0] > 1 else 16 * weight[0]
    albedo = np.asarray(m.sigma_s) / np.maximum(np.asarray(m.sigma_s + m.sigma_a), 1e-30)
    expected = albedo[:, None] * np.asarray(found.one_minus_transmittance)
    np.testing.assert_allclose(total, expected, atol=1e-6, rtol=2e-6)
    if sigma == 0.0:
        assert (total == 0).all()


@pytest.mark.parametrize("grey", [True, False])
def test_without_density_samples_stay_at_the_entry(rays, grey):
    m = medium(2.0 if grey else [1.0, 2.0, 3.0], 0.1, density=np.zeros((12, 12, 12)))
    found = im.interval_map(m, *rays, num_intervals=16, num_steps=64, grey=grey)
    assert (np.asarray(found.weight) == 0).all() and (np.asarray(found.one_minus_transmittance) == 0).all()
    np.testing.assert_allclose(found.distance, np.broadcast_to(span(rays)[0], found.distance.shape), atol=1e-5)


def test_thin_medium_keeps_its_digits(rays):
    """expm1 and not 1 - exp: at an optical thickness of 1e-6 the difference is 1 %."""
    found = im.interval_map(medium(1e-6, 0.0), *rays, num_intervals=4, grey=True)
    enter, leave = span(rays)
    np.testing.assert_allclose(found.one_minus_transmittance[0], 1e-6 * (leave - enter), rtol=1e-5)


def field(points, g, direction):
    """Light of a few dozen small senders around the medium, scattered towards the eye; float64."""
    rng = np.random.default_rng(11)
    wall = rng.uniform(-1.4, 1.4, (40, 3))
    wall[np.arange(40), rng.integers(0, 3, 40)] = np.where(rng.random(40) < 0.5, -1.4, 1.4)
    value = 0.0
    for x in wall:
        delta = points - x
        squared = np.sum(delta * delta, axis=-1) + 1e-3
        cosine = np.abs(delta @ (-x / np.linalg.norm(x))) / np.sqrt(squared)
        mu = -np.einsum("...j,...j->...", delta, np.broadcast_to(direction, delta.shape)) / np.sqrt(squared)
        value = value + cosine / squared * (1 - g * g) / (1 + g * g - 2 * g * mu) ** 1.5
    return value


def marched(m, rays, g, steps):
    """The integral of T sigma_s f by a fine march, float64, [3, R]."""
    from scipy.ndimage import map_coordinates

    origin, direction = (np.asarray(a, np.float64) for a in rays[:2])
    enter, leave = span(rays)
    dt = (leave - enter) / steps
    t = enter + (np.arange(steps)[:, None] + 0.5) * dt
    points = origin + t[..., None] * direction
    grid = np.asarray(m.density, np.float64)
    place = (points - BOUNDS[0]) / (BOUNDS[1] - BOUNDS[0]) * np.array(grid.shape) - 0.5
    density = map_coordinates(grid, np.moveaxis(place, -1, 0), order=1, mode="nearest")
    column = np.cumsum(density * dt, axis=0)
    before = column - density * dt
    sigma = np.asarray(m.sigma_s + m.sigma_a, np.float64)
    albedo = np.asarray(m.sigma_s, np.float64) / sigma
    drop = np.exp(-sigma[:, None, None] * before) - np.exp(-sigma[:, None, None] * column)
    return albedo[:, None] * np.sum(drop * field(points, g, direction), axis=1)


def estimated(m, rays, g, **options):
    found = im.interval_map(m, *rays, **options)
    points = rays[0] + np.asarray(found.distance)[..., None] * rays[1]
    values = field(points.astype(np.float64), g, rays[1].astype(np.float64))
    return np.sum(np.asarray(found.weight, np.float64) * values[:, None, :], axis=0)


@pytest.mark.parametrize(("g", "limit"), [(0.0, 0.003), (0.7, 0.002)])
def test_sixteen_intervals_against_a_fine_march(rays, g, limit):
    m = medium(3.6, 0.4, density=broken_cloud(), g=g)
    reference = marched(m, rays, g, 512)
    found = estimated(m, rays, g, num_intervals=16, num_steps=200, grey=True)
    assert np.abs(found - reference).sum() / reference.sum() < limit


def test_channels_a_hundredfold_apart(rays):
    m = medium([0.036, 0.9, 3.6], [0.004, 0.1, 0.4], density=broken_cloud())
    reference = marched(m, rays, 0.0, 512)
    found = estimated(m, rays, 0.0, num_intervals=16, num_steps=200)
    error = np.abs(found - reference).sum(axis=1) / reference.sum(axis=1)
    assert (error < 0.005).all(), error


def test_jitter_is_unbiased(rays):
    """128 stratified positions per interval; the mean's standard error is below 0.1 %."""
    m = medium(3.6, 0.4, density=broken_cloud())
    reference = marched(m, rays, 0.0, 512)[0].sum()
    means = []
    for shift in (np.arange(32) + 0.5) / 32:
        u = ((np.arange(96) * 0.618 + shift) % 1.0).astype(np.float32)
        means.append(estimated(m, rays, 0.0, num_intervals=4, num_steps=200, grey=True, position="jittered", u=u)[0].sum())
    assert abs(np.mean(means) / reference - 1) < 0.002


def test_paper_map_converges_and_its_weights_are_not_negative(rays):
    m = medium(1.5, 0.5, density=np.ones((4, 4, 4)))
    enter, leave = span(rays)
    expected = 0.75 * (1 - np.exp(-2.0 * (leave - enter)))
    coarse = im.paper_interval_map(m, *rays, num_intervals=15, num_steps=400)
    fine = im.paper_interval_map(m, *rays, num_intervals=120, num_steps=4000)
    assert (np.asarray(coarse.weight) >= 0).all()
    errors = [abs(np.asarray(f.weight)[:, 0].sum() / expected.sum() - 1) for f in (coarse, fine)]
    assert errors[1] < 0.02 and errors[1] < 0.4 * errors[0]


def test_several_media_agree_with_one_and_with_cumulative_scattering(rays):
    """`interval_map_of_steps`: of one medium the same map; of two albedos the exact integral of T sigma_s."""
    enter, leave = (a.astype(np.float32) for a in span(rays))
    steps, step = 64, (leave - enter) / 64
    sigma = np.broadcast_to(np.array([0.02, 1.0, 2.0], np.float32)[:, None], (steps, 3, 96))
    found = im.interval_map_of_steps(0.5 * sigma, sigma, enter, step, num_intervals=8)
    same = im.interval_map(medium([0.01, 0.5, 1.0], [0.01, 0.5, 1.0]), *rays, num_intervals=8)
    np.testing.assert_allclose(found.distance, same.distance, atol=2e-3)
    np.testing.assert_allclose(found.weight.sum(axis=0), same.weight.sum(axis=0), atol=2e-6)
    albedo = np.where(np.arange(steps) < 20, 0.9, 0.2).astype(np.float32)[:, None, None]
    for position, u in (("midpoint", None), ("jittered", np.full(96, 0.3, np.float32))):
        found = im.interval_map_of_steps(albedo * sigma, sigma, enter, step, num_intervals=8, position=position, u=u)
        depth = sigma.astype(np.float64) * step
        before = np.cumsum(depth, axis=0) - depth
        exact = np.sum(albedo * np.exp(-before) * -np.expm1(-depth), axis=0)
        tolerance = 2e-6 if u is None else 0.1
        np.testing.assert_allclose(found.weight.sum(axis=0), exact, atol=tolerance)


def test_one_compilation_for_two_values(rays):
    before = im.interval_map._cache_size()
    for sigma in (1.0, 2.0):
        im.interval_map(medium(sigma, 0.1), *rays, num_intervals=5, grey=True)
    assert im.interval_map._cache_size() == before + 1


def test_wrong_positions_are_refused():
    with pytest.raises(ValueError, match="position 'middle' is unknown"):
        im.levels(4, 8, position="middle")
    with pytest.raises(ValueError, match="u, one number"):
        im.levels(4, 8, position="jittered")


def test_slopes_beside_empty_space(rays):
    """One voxel filled, the others empty or nearly: the slope by every voxel is finite, and by all of them right."""
    density = np.full((4, 4, 4), 1e-25)
    density[:2], density[1, 2, 2] = 0.0, 2.0
    told = medium((1.0, 3.0, 0.5), (0.1, 0.0, 2.0), density)

    def total(scale, grid):
        held = eqx.tree_at(lambda m: m.density, told, grid * scale)
        found = im.interval_map(held, *rays, num_intervals=4, num_steps=16)
        return jnp.sum(found.weight * found.distance[:, None])

    with_slopes = jax.jit(jax.value_and_grad(total, argnums=(0, 1)))
    value, (slope, by_voxel) = with_slopes(jnp.float32(1), told.density)
    assert np.isfinite(np.asarray(by_voxel)).all()
    up, down = (float(with_slopes(jnp.float32(1 + h), told.density)[0]) for h in (0.02, -0.02))
    assert float(value) > 1 and float(slope) == pytest.approx((up - down) / 0.04, rel=1e-2)
