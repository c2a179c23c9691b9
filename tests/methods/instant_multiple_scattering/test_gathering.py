"""Gather kernels against float64 sums over lights, picking against gathering everything."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxvol.methods.instant_multiple_scattering import gathering, picking, receivers
from jaxvol.methods.instant_multiple_scattering.receivers import Points, Segments
from jaxvol.methods.instant_multiple_scattering.virtual_lights import VirtualLights
from tests.methods.instant_multiple_scattering.scenes import floats, make_medium

CLAMP = 0.2
NUM = 96


def unit(v):
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


@pytest.fixture(scope="module")
def lights():
    rng = np.random.default_rng(1)
    position = rng.uniform(-0.9, 0.9, (NUM, 3))
    position[0] = (0.02, 0.0, 0.1)  # a tenth of the clamp distance from the first ray
    return VirtualLights(
        jnp.asarray(position, jnp.float32),
        jnp.asarray(unit(rng.normal(size=(NUM, 3))), jnp.float32),
        jnp.asarray(rng.uniform(0.1, 1.0, (NUM, 3)), jnp.float32),
    )


@pytest.fixture(scope="module")
def segments():
    origin = np.array([[0.0, 0.0, -3.0]] * 4)
    direction = unit(np.array([[0.0, 0.0, 1.0], [0.1, 0.05, 1.0], [-0.2, 0.1, 1.0], [0.05, -0.2, 1.0]]))
    to32 = lambda x: jnp.asarray(x, jnp.float32)  # noqa: E731
    return Segments(to32(origin), to32(direction), jnp.full(4, 2.1), jnp.full(4, 3.7), jnp.float32(CLAMP))


def hg(cosine, g):
    return (1 - g * g) / (4 * np.pi * (1 + g * g - 2 * g * cosine) ** 1.5)


def exact_segment(segments, lights, medium, ray):
    """Radiance along one eye ray by float64 quadrature."""
    o, w = (np.asarray(x[ray], np.float64) for x in (segments.origin, segments.direction))
    t = np.linspace(float(segments.t0[ray]), float(segments.t1[ray]), 40001)
    x = o + t[:, None] * w
    sigma_s, sigma_t = np.asarray(medium.sigma_s, np.float64), np.asarray(medium.sigma_s + medium.sigma_a, np.float64)
    g = float(medium.g)
    total = np.zeros((len(t), 3))
    for p, d, s in zip(*(np.asarray(v, np.float64) for v in (lights.position, lights.direction, lights.strength)), strict=True):
        delta = x - p
        r = np.maximum(np.linalg.norm(delta, axis=-1), 1e-9)
        towards = delta / r[:, None]
        scale = hg(-towards @ w, g) * hg(towards @ d, g) / np.maximum(r * r, CLAMP**2)
        total += scale[:, None] * s * np.exp(-sigma_t * (r + t - t[0])[:, None])
    return np.trapezoid(total * sigma_s, t, axis=0)


@pytest.mark.parametrize(("g", "sigma_a"), [(0.0, (0.2,) * 3), (0.6, (0.2,) * 3), (-0.4, (0.1, 0.5, 2.0))])
def test_eye_rays_collect_what_quadrature_says(segments, lights, g, sigma_a):
    medium = make_medium(g=g, sigma_a=sigma_a)
    n = 32768  # each light turns the even spacing: an error of up to half a spacing times the change from end to end
    many = jax.tree.map(lambda x: x if x.ndim == 0 else jnp.repeat(x, n, axis=0), segments)
    u = jnp.tile((jnp.arange(n, dtype=jnp.float32) + 0.5) / n, 4)
    grey = len(set(sigma_a)) == 1
    found = gathering.gather_segments(many, u, lights, medium, grey=grey, isotropic=g == 0.0)
    found = np.asarray(found).reshape(4, n, 3).mean(axis=1)
    for ray in range(4):
        np.testing.assert_allclose(found[ray], exact_segment(segments, lights, medium, ray), rtol=2e-4)


def test_stratified_points_have_the_same_mean(segments, lights):
    medium = make_medium(g=0.3)
    n = 4096
    many = jax.tree.map(lambda x: x if x.ndim == 0 else jnp.repeat(x, n, axis=0), segments)
    u = jnp.tile((jnp.arange(n, dtype=jnp.float32) + 0.5) / n, 4)
    found = gathering.gather_segments(many, u, lights, medium, grey=True, isotropic=False, stratified=True, num_evaluations=2)
    for ray in range(4):
        mean = np.asarray(found).reshape(4, n, 3)[ray].mean(axis=0)
        np.testing.assert_allclose(mean, exact_segment(segments, lights, medium, ray), rtol=3e-4)


def test_groups_of_one_are_the_full_gather(segments, lights):
    medium = make_medium(g=0.4)
    u = floats(0.1, 0.4, 0.6, 0.9)
    full = gathering.gather_segments(segments, u, lights, medium, grey=True, isotropic=False)
    picks = picking.pick_for_segments(segments, u, u, lights, medium, num_groups=NUM, isotropic=False)
    found = picking.evaluate_segments(segments, picks, None, None, lights, medium, medium, None, isotropic=False, num_steps=4)
    np.testing.assert_allclose(np.asarray(found), np.asarray(full), rtol=2e-4)


def test_picking_is_unbiased(segments, lights):
    """One light of twelve, in a grid whose density the estimate does not know: the mean over many picks is the full sum."""
    rng = np.random.default_rng(2)
    medium = make_medium(g=0.4, density=rng.uniform(0.0, 2.0, (6, 6, 6)))
    n = 8192
    many = jax.tree.map(lambda x: x if x.ndim == 0 else jnp.repeat(x, n, axis=0), segments)
    u = jnp.tile((jnp.arange(n, dtype=jnp.float32) + 0.5) / n, 4)
    u_group = jnp.asarray(rng.random(4 * n), jnp.float32)

    def total(groups):
        picks = picking.pick_for_segments(many, u, u_group, lights, medium, num_groups=groups, isotropic=False)
        found = picking.evaluate_segments(many, picks, None, None, lights, medium, medium, None, isotropic=False, num_steps=8)
        return np.asarray(found).reshape(4, n, 3)

    some, everything = total(8), total(NUM)
    error = (some - everything).std(axis=1) / np.sqrt(n)
    assert np.max(error / everything.mean(axis=1)) < 0.01  # the power of the test
    assert np.max(np.abs((some - everything).mean(axis=1)) / error) < 4


def test_points_gather_what_a_sum_says(lights):
    """Also at a point that coincides with a light: finite, clamped."""
    medium = make_medium(g=0.4)
    position = jnp.concatenate([lights.position[:1], floats([0.3, -0.2, 0.1], [-0.5, 0.4, 0.2])])
    outgoing = jnp.asarray(unit(np.array([[1.0, 0, 0], [0, 1, 0.3], [0.2, 0.1, -1]])), jnp.float32)
    points = Points(position, outgoing, jnp.broadcast_to(medium.sigma_s, (3, 3)), jnp.full(3, CLAMP))
    found = np.asarray(gathering.gather_points(points, lights, medium, grey=True, isotropic=False))
    assert np.all(np.isfinite(found))
    picks = picking.pick_for_points(points, jnp.full(3, 0.3), lights, medium, num_groups=NUM, isotropic=False)
    same = picking.evaluate_points(points, picks, None, None, lights, medium, medium, isotropic=False, num_steps=1)
    np.testing.assert_allclose(np.asarray(same), found, rtol=2e-4)
    p, d, s = (np.asarray(v, np.float64) for v in (lights.position, lights.direction, lights.strength))
    delta = np.asarray(position[1], np.float64) - p
    r = np.linalg.norm(delta, axis=-1)
    towards = delta / r[:, None]
    scale = hg(towards @ np.asarray(outgoing[1], np.float64), 0.4) * hg(np.sum(towards * d, -1), 0.4)
    expected = np.sum((scale * np.exp(-r) / np.maximum(r * r, CLAMP**2))[:, None] * s, axis=0) * 0.8
    np.testing.assert_allclose(found[1], expected, rtol=2e-4)


def test_gradients_are_finite_with_a_light_on_the_ray(segments, lights):
    on_ray = lights.position.at[0].set(floats(0.0, 0.0, 0.1))

    def value(position, g):
        moved = VirtualLights(position, lights.direction, lights.strength)
        u = floats(0.1, 0.4, 0.6, 0.9)
        return jnp.sum(gathering.gather_segments(segments, u, moved, make_medium(g=g), grey=True, isotropic=False))

    gradients = jax.grad(value, argnums=(0, 1))(on_ray, jnp.float32(0.0))
    assert all(bool(jnp.all(jnp.isfinite(x))) for x in gradients)


@pytest.mark.parametrize("tracked", [False, True])
def test_eye_vertices_towards_a_light_keep_the_integral(tracked):
    """Mean of weight * f(t) over both halves = integral of density f, for a light beside the ray; and with less noise."""
    n = 1 << 15
    u = (jnp.arange(n, dtype=jnp.float32) + 0.5) / n
    t0, t1 = jnp.full(n, 1.0), jnp.full(n, 4.0)
    rays = (jnp.zeros((n, 3)), jnp.tile(jnp.float32([[1.0, 0.0, 0.0]]), (n, 1)), t0, t1, None)
    steps = np.linspace(0.2, 1.4, 48)  # density of the table's steps
    column = jnp.asarray(np.cumsum(steps)[:, None] * (3.0 / 48) * np.ones(n), jnp.float32) if tracked else None
    segments = receivers.Segments(*rays, column)
    light = jnp.tile(jnp.float32([[2.2, 0.05, 0.0]]), (n, 1))
    near = jnp.ones(n, bool)

    def values(half, u):
        t, w = receivers.sample_transmittance_or_light(segments, u, jnp.full(n, half), jnp.float32(0.8), light, near)
        return np.asarray(w / jnp.sqrt((t - 2.2) ** 2 + 0.05**2), np.float64)

    x = 1.0 + 3.0 * (np.arange(48 * 4096) + 0.5) / (48 * 4096)
    density = np.repeat(steps, 4096) if tracked else 1.0
    exact = 3.0 * np.mean(density / np.hypot(x - 2.2, 0.05))
    both = np.concatenate([values(False, u), values(True, u)])
    assert both.mean() == pytest.approx(exact, rel=2e-3)
    plain = receivers.sample_transmittance(segments, u, jnp.float32(0.8))
    bare = np.asarray(plain[1] / jnp.sqrt((plain[0] - 2.2) ** 2 + 0.05**2))
    assert bare.mean() == pytest.approx(exact, rel=5e-3)
    assert both.std() < 0.5 * bare.std()
