"""The specification's stability table (section 7): every pitfall has a test here or, where it says so, elsewhere.

Light on the shading point, value and gradient: `test_gathering`. HG's value at g -> 1, 0 and negative: `test_pairs`.
Truncated paths at albedo 1, empty grids, batches of another shape: `test_light_paths`. The skip list: `test_skipping`.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxvol import layers, lights, phase, sampling
from jaxvol.methods import instant_multiple_scattering as ims
from jaxvol.methods.instant_multiple_scattering import (
    compensation,
    gathering,
    light_paths,
    pairs,
    receivers,
    rendering,
    virtual_lights,
)
from jaxvol.methods.instant_multiple_scattering.receivers import Points
from jaxvol.methods.instant_multiple_scattering.virtual_lights import VirtualLights
from jaxvol.types import Scene
from tests.methods.instant_multiple_scattering.scenes import floats, lit, make_camera, make_medium

SMALL = {"num_paths": 64, "num_levels": 2, "num_chains": 1, "num_direct": 1, "tile": 64}


@pytest.mark.parametrize(
    ("kind", "settings"),
    [
        ("peaked", {"g": 0.95}),
        ("backwards", {"g": -0.9}),
        ("albedo 1", {"sigma_s": (2.0,) * 3, "sigma_a": (0.0,) * 3}),
        ("no extinction", {"sigma_s": (0.0,) * 3, "sigma_a": (0.0,) * 3}),
        ("nearly none", {"sigma_s": (1e-9,) * 3, "sigma_a": (0.0,) * 3}),
        ("thick", {"sigma_s": (300.0,) * 3, "sigma_a": (100.0,) * 3}),
        ("one channel", {"sigma_s": (3.0, 0.0, 0.0), "sigma_a": (0.0, 0.1, 50.0)}),
        ("empty grid", {"density": np.zeros((4, 4, 4))}),
        ("one voxel", {"density": np.eye(4)[0][:, None, None] * np.eye(4)[1][None, :, None] * np.eye(4)[2]}),
    ],
)
@pytest.mark.parametrize("position", [(0.0, 0.0, 0.0), pytest.param((1.0, 1.0, 1.0), marks=pytest.mark.slow)])
def test_pictures_stay_finite(kind, settings, position):
    """The light in the medium's middle, and on a corner of its box; layers are finite and not negative."""
    scene, camera = lit(make_medium(**settings), position=position), make_camera(8)
    plan = ims.plan(scene, camera, **SMALL, max_depth=64)
    with jax.debug_nans(True):
        estimate = ims.render(scene, camera, plan, seed=2)
    total = np.asarray(layers.total(estimate.mean))
    assert np.all(np.isfinite(total)) and total.min() >= 0.0
    if kind in ("no extinction", "empty grid"):
        assert total.max() == 0.0
    elif kind != "thick":  # nothing comes through a thickness of 400
        assert total.max() > 0.0


def test_albedo_one_keeps_its_energy():
    """Every path ends by leaving: an albedo-1 medium sends out what comes in, so weights stay 1 / num_paths each."""
    scene = lit(make_medium(sigma_s=(2.0,) * 3, sigma_a=(0.0,) * 3))
    vertices, counts = light_paths.trace(scene, None, seed=1, paths=np.arange(256), max_depth=256)
    assert counts["num_truncated"] == 0
    power = vertices.incident * np.asarray(scene.medium.sigma_s)  # W of each collision
    np.testing.assert_allclose(power, power[0, 0], rtol=1e-3)


def test_uniforms_never_make_a_logarithm_infinite():
    u = np.concatenate(sampling.uniforms(jnp.uint32(1), 7, jnp.arange(1 << 16, dtype=jnp.uint32), 0))
    assert u.min() > 0.0 and u.max() < 1.0
    flights = np.asarray(sampling.sample_exponential(jnp.asarray(u), jnp.float32(1.0)))
    assert np.all(np.isfinite(flights)) and flights.max() < 25


def test_truncated_exponential_keeps_its_limit():
    d = jnp.float32(0.3)
    t = compensation.sample_distance_exponential(floats(0.25, 0.5), d, jnp.float32(1e-9))
    np.testing.assert_allclose(np.asarray(t), [0.075, 0.15], rtol=1e-5)
    assert np.all(np.asarray(t) > 0)


def test_residual_vanishes_with_the_clamp_distance():
    """b -> inf: nothing is clamped and nothing compensated; b -> 0: everything is residual, and it is finite."""
    scene, camera = lit(make_medium(), position=(0.0, 2.0, 0.0)), make_camera(8)
    totals = {}
    for number in (1e-4, 1e4):
        plan = ims.plan(scene, camera, **SMALL, mean_free_paths=number)
        bare = ims.plan(scene, camera, **{**SMALL, "num_levels": 0}, mean_free_paths=number)
        images = [rendering.render_set(scene, camera, p, seed=4)[0] for p in (plan, bare)]
        totals[number] = [float(sum(x.values()).mean()) for x in images]
    assert totals[1e-4][0] == pytest.approx(totals[1e-4][1], rel=1e-3)
    assert totals[1e4][1] < 0.7 * totals[1e4][0]  # the clamped part of everything within the box
    assert np.isfinite(totals[1e4][0])


def test_gradients_through_sampling_are_finite_at_the_edges():
    def value(h2, clamp):
        t, weight = pairs.sample_along_ray(jnp.float32(0.3), jnp.float32(-1.0), jnp.float32(1.0), h2, clamp)
        return t + weight

    for h2 in (0.0, 1e-12, 1.0):
        gradients = jax.grad(value, argnums=(0, 1))(jnp.float32(h2), jnp.float32(0.2))
        assert all(bool(jnp.isfinite(x)) for x in gradients)


def test_gradients_of_distances_in_thick_fog_are_finite():
    """Equi-angular distances to a light that hundreds to thousands of mean free paths hide; the weight is finite too."""
    n = 32
    u = (jnp.arange(n) + 0.5) / n
    segments = receivers.Segments(
        origin=jnp.tile(floats([0.0, 0.0, -3.0]), (n, 1)),
        direction=jnp.tile(floats([0.0, 0.0, 1.0]), (n, 1)),
        t0=jnp.full(n, 2.0),
        t1=jnp.full(n, 4.0),
        clamp=None,
    )

    def value(sigma):
        near, light = jnp.ones(n, bool), jnp.tile(floats([0.1, 0.0, 0.0]), (n, 1))
        t, w = receivers.sample_transmittance_or_light(segments, u, jnp.arange(n) % 2 == 0, sigma, light, near)
        return w * jnp.exp(-sigma * (t - 2.0))

    for sigma in (1e-6, 1.0, 300.0, 1e4):
        found, slope = jax.jvp(value, (jnp.float32(sigma),), (jnp.float32(1.0),))
        assert np.isfinite(found).all() and np.isfinite(slope).all()
        assert float(found.mean()) == pytest.approx(-np.expm1(-2 * sigma) / sigma, rel=0.1)


def test_phase_function_stays_below_its_peak_for_lights_on_far_rays():
    """Lights at 0 to 1e-3 from a ray that began 300 away: |delta|^2 - t^2 would cancel there, and rounding puts cosines
    above one. The distance comes from the perpendicular vector, the cosine is clipped: no value above the peak."""
    n, g = 4096, 0.7
    rng = np.random.default_rng(3)
    axis = np.array([0.6, 0.64, 0.48])
    direction = pairs.components(jnp.tile(floats(axis), (n, 1)))
    aside = rng.normal(size=(n, 3)) * (10.0 ** rng.uniform(-9, -3, (n, 1)))
    place = pairs.components(jnp.asarray(300.0 * axis + aside, jnp.float32))
    _, perpendicular, h2 = pairs.closest(pairs.components(jnp.zeros((n, 3))), direction, place)
    assert float(jnp.min(h2)) >= 0.0 and float(jnp.max(h2)) < 1e-4
    peak = (1 + g) / (4 * np.pi * (1 - g) ** 2)
    for offset in (0.0, 1e-4, -2.0):
        inverse = 1.0 / jnp.sqrt(jnp.maximum(h2 + offset * offset, 1e-20))
        towards = tuple((offset * w - p) * inverse for w, p in zip(direction, perpendicular, strict=True))
        value = np.asarray(pairs.henyey_greenstein(pairs.dot(towards, direction), jnp.float32(g)))
        assert np.isfinite(value).all() and value.max() <= peak * (1 + 1e-4)


@pytest.mark.parametrize("g", [0.999, 0.99, 0.3, 0.0, -0.9])
def test_sampled_cosines_have_mean_g(g):
    """Mean of the sampled cosine is g to 3e-3, and its derivative by g at 0 is 1."""
    u = (jnp.arange(1 << 16, dtype=jnp.float32) + 0.5) / (1 << 16)
    mean = lambda x: jnp.mean(phase.sample_henyey_greenstein(u, x)[0])  # noqa: E731
    assert float(mean(jnp.float32(g))) == pytest.approx(g, abs=3e-3)
    if g == 0.0:
        assert float(jax.grad(mean)(jnp.float32(0.0))) == pytest.approx(1.0, rel=1e-3)


def test_gradient_through_tracing_and_gathering():
    """d/d(density) by forward differentiation through flights and gather = a central difference with the same numbers."""
    n, bounces = 256, 4
    walls = (jnp.full(n, jnp.inf), jnp.full(n, -1, jnp.int32))
    receiver = Points(floats([0.7, 0.2, 0.1]), floats([1.0, 0.0, 0.0]), floats([0.8] * 3), floats(0.3))

    def radiance(scale):
        medium = make_medium(sigma_s=(0.8,) * 3, sigma_a=(0.2,) * 3, g=0.3, half=30.0)
        medium = dataclasses.replace(medium, sigma_s=medium.sigma_s * scale, sigma_a=medium.sigma_a * scale)
        scene, seed = lit(medium), jnp.uint32(5)
        walkers = light_paths.emit(scene, jnp.arange(n, dtype=jnp.uint32), seed)
        step = lambda state, _: light_paths.step(scene, state, *walls, seed)  # noqa: E731
        _, rows = jax.lax.scan(step, walkers, None, length=bounces)
        flat = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), rows)
        strength = jnp.where(flat.valid[:, None], flat.incident * medium.sigma_s / n, 0.0)
        found = VirtualLights(flat.position, flat.direction, strength)
        return jnp.mean(gathering.gather_points(receiver, found, medium, grey=True, isotropic=False))

    _, slope = jax.jvp(radiance, (jnp.float32(1.0),), (jnp.float32(1.0),))
    h = 4e-3
    difference = (float(radiance(jnp.float32(1 + h))) - float(radiance(jnp.float32(1 - h)))) / (2 * h)
    assert float(slope) == pytest.approx(difference, rel=1e-2)


def test_power_that_leaves_a_scattering_has_its_slope():
    """By the light's power it is itself (Euler). A compiled walk computes powers twice, rounded differently: the slope
    of jnp.max over channels, a mean over the entries that equal it, was 0 / 0 then."""
    n, seed = 64, jnp.uint32(5)
    density = np.random.default_rng(0).random((4, 4, 4))
    scene = lit(make_medium(sigma_s=(3.0, 2.0, 1.0), sigma_a=(0.1, 0.2, 0.3), g=0.5, density=density))
    walkers = light_paths.emit(scene, jnp.arange(n, dtype=jnp.uint32), seed)

    def outgoing(power):
        lit_by = dataclasses.replace(walkers, power=power)
        state = (lit_by, light_paths._tracking(lit_by, jnp.zeros(n)))
        return light_paths._track(scene, state, seed, num_steps=2, max_depth=4)[1].power

    value, slope = jax.jvp(outgoing, (walkers.power,), (walkers.power,))
    assert np.count_nonzero(value) > 100
    np.testing.assert_allclose(slope, value, rtol=1e-5)


def test_furnace():
    """Albedo 1 under a sky of radiance 1: every ray sees 1, so light scattered twice or more is 1 - tau - single.

    Single scattering by quadrature: nodes along the ray, directions of a Fibonacci sphere, distances out of the box.
    """
    medium = make_medium(sigma_s=(1.0,) * 3, sigma_a=(0.0,) * 3)
    scene = Scene(medium=medium, environment=lights.environment_light(np.ones((8, 16, 3))))
    nodes, weights = np.polynomial.legendre.leggauss(48)
    k = np.arange(4000) + 0.5
    z, angle = 1 - 2 * k / 4000, np.pi * (1 + 5**0.5) * k
    sphere = np.stack([np.sqrt(1 - z * z) * np.cos(angle), np.sqrt(1 - z * z) * np.sin(angle), z], axis=-1)
    place = np.stack([nodes, 0.3 + 0 * nodes, 0 * nodes], axis=-1)
    out = np.min((np.sign(sphere)[None] - place[:, None]) / sphere[None], axis=-1)
    single = np.sum(weights * np.exp(-(1 + nodes)) * np.exp(-out).mean(axis=1))
    exact = 1 - np.exp(-2.0) - single
    plan = ims.plan(scene, make_camera(8), num_paths=1024, jitter=False)
    lanes = 64
    rays = (jnp.tile(floats([-3.0, 0.3, 0.0]), (lanes, 1)), jnp.tile(floats([1.0, 0.0, 0.0]), (lanes, 1)))
    rest = (jnp.full(lanes, jnp.inf), jnp.full(lanes, -1), jnp.arange(lanes, dtype=jnp.uint32))
    values, sizes = [], {}
    for seed in range(24):
        context, _ = rendering.make_context(scene, plan, seed=seed, sizes=sizes)
        sizes.update(virtual_lights.sizes(context.lights))
        found = rendering.gather_rays(context, *rays, *rest)
        values.append(float(jnp.mean(found["volume_from_volume"] + found["volume_from_multiple"])))
    error = np.std(values, ddof=1) / np.sqrt(len(values))
    assert error < 0.012 * exact
    assert abs(np.mean(values) - exact) < 3.5 * error
