"""Resampled tables against the Chebyshev tables, against quadrature of the plane, and shading against the sphere."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxvol import harmonics, tables, zonal_lookup
from jaxvol.fit import assemble, table_config
from jaxvol.methods.impulse_response import emitters, lookup, receivers, shading
from jaxvol.types import Medium
from tests.problems import FLOOR_IN_FOG

NUM = 500


@pytest.fixture(scope="module")
def table():
    return tables.default_file().lookups()


def medium(c, g=0.0):
    return Medium(
        bounds=jnp.array([[-50.0] * 3, [50.0] * 3]),
        sigma_s=jnp.full(3, c, jnp.float32),
        sigma_a=jnp.full(3, 1 - c, jnp.float32),
        g=jnp.float32(g),
    )


@pytest.mark.parametrize(("c", "g"), [(0.9, 0.0), (0.5, 0.5)])
@pytest.mark.parametrize("kind", ["point", "directional", "area"])
def test_resampled_tables_are_the_tables(table, c, g, kind):
    rng = np.random.default_rng(1)
    tau = np.exp(rng.uniform(np.log(1e-2), np.log(15), NUM)).astype(np.float32)
    theta = rng.uniform(0, np.pi, NUM).astype(np.float32)
    found = lookup.prepare(table, medium(c, g), grey=True, multiple=True)
    whole = zonal_lookup.medium_response(table, kind, g=jnp.float32(g), albedo=jnp.float32(c))
    tau3 = jnp.broadcast_to(jnp.asarray(tau)[:, None], (NUM, 3))
    if kind == "directional":
        truth = zonal_lookup.scattered_directional(whole, tau, sigma_s=jnp.float32(c), sigma_t=jnp.float32(1))
        once, more = lookup.directional_source(found.directional, found.albedo, tau3)
    else:
        theta_n = theta if kind == "area" else None
        sigma_s, sigma_t = jnp.full(NUM, c, jnp.float32), jnp.ones(NUM)
        truth = zonal_lookup.scattered_point(whole, tau, sigma_s=sigma_s, sigma_t=sigma_t, theta_n=theta_n)
        cos_n = None if theta_n is None else jnp.broadcast_to(jnp.cos(theta)[:, None], (NUM, 3))
        once, more = lookup.compact_source(getattr(found, kind), found.albedo, tau3, tau3, cos_n)
    error = np.abs(np.asarray(once + more)[:, 0] - np.asarray(truth)) / np.abs(np.asarray(truth)[:, :1])
    assert error.max() < (1e-2 if kind == "area" else 4e-4)
    assert error.mean() < (1e-3 if kind == "area" else 5e-5)


@pytest.fixture(scope="module")
def fine_table():
    """Single scattering of isotropic media with patches to order 11, as experiments/tables/fine_area.toml has them."""
    emitters = {"order": 11, "moments": 1, "area": {"order": 11, "moments": 1, "num_tau": 20, "num_angle": 10}}
    config = table_config.parse(emitters)
    parts = {name: assemble.compute_part(name, config) for name in assemble.part_names(config)}
    return zonal_lookup.from_arrays(assemble.join(parts, config))


@pytest.mark.parametrize(("name", "limit"), [("table", 6e-3), ("fine_table", 1e-3)])
def test_floor_in_fog(name, limit, request):
    """T13: the coplanar area response integrates to c pi Le (2/3)(1 - ln 2); its series ends with order 5, or with 11."""
    x, weight = np.polynomial.legendre.leggauss(100)
    s = 0.5 * (x + 1) * 5
    distance = (s * s).astype(np.float32)
    far = jnp.broadcast_to(jnp.asarray(distance)[:, None], (100, 3))
    axis = jnp.broadcast_to(jnp.array([1.0, 0.0, 0.0]), (100, 3))
    up = jnp.broadcast_to(jnp.array([0.0, 0.0, 1.0]), (100, 3))
    responses = lookup.prepare(request.getfixturevalue(name), medium(0.8), grey=True, multiple=False)
    once, more = lookup.compact_source(responses.area, responses.albedo, far, far, jnp.zeros((100, 3)))
    assert more is None
    irradiance = shading.half_irradiance(once, shading.emitter_frame(axis, up), up)[:, 0]
    total = np.sum(2 * np.pi * distance * np.asarray(irradiance) * weight * 2.5 * 2 * s)
    assert total == pytest.approx(0.8 * np.pi * FLOOR_IN_FOG, rel=limit)


def test_floor_gets_back_what_a_half_space_reflects(table):
    """All bounces, with the image source: 1 - 2 sqrt(1 - c) int H(mu) mu dmu of its light comes back (Chandrasekhar)."""
    c = 0.9
    x, weight = np.polynomial.legendre.leggauss(100)
    mu, half = 0.5 * (x + 1), 0.5 * weight
    h = np.ones(100)
    for _ in range(200):
        h = 1 / (np.sqrt(1 - c) + 0.5 * c * np.sum(half * mu * h / (mu[:, None] + mu), axis=1))
    reflected = 1 - 2 * np.sqrt(1 - c) * np.sum(half * h * mu)
    s = mu * 60**0.5
    distance = jnp.asarray(s * s, jnp.float32)
    along, up = (jnp.broadcast_to(jnp.array(axis), (100, 3)) for axis in ([1.0, 0.0, 0.0], [0.0, 0.0, 1.0]))
    responses = lookup.prepare(table, medium(c), grey=True, multiple=True)
    tau = jnp.broadcast_to(distance[:, None], (100, 3))
    arrive = jax.jit(emitters.patch_arrivals, static_argnames="image")
    once, more = arrive(responses, receivers.Irradiance(up), along, distance, up, tau, image=True)
    found = np.sum(2 * np.pi * s * s * np.asarray(once + more)[:, 0] * half * 60**0.5 * 2 * s) / np.pi
    assert found == pytest.approx(reflected, rel=0.01)


def test_single_nodes_have_the_mean_of_the_interpolation(table):
    """Lookups of one node drawn by its weight, averaged over a grid of the random numbers."""
    found = lookup.prepare(table, medium(0.9), grey=True, multiple=True)
    u = (jnp.arange(64) + 0.5) / 64
    pick = tuple(jnp.ravel(v) for v in jnp.meshgrid(u, u))
    ones = jnp.ones((64 * 64, 3))
    for tau, cosine in ((0.37, 0.3), (4.1, -0.72), (0.02, 0.99)):
        arguments = (found.area, found.albedo, tau * ones, 1.3 * ones, cosine * ones)
        exact = lookup.compact_source(*arguments)
        drawn = lookup.compact_source(*arguments, pick=pick)
        for a, b in zip(exact, drawn, strict=True):
            scale = float(jnp.abs(a[0, 0, 0]))
            assert float(jnp.abs(b - a).max()) > 1e-3 * scale  # a single node is not the interpolation
            np.testing.assert_allclose(b.mean(axis=0), a[0], atol=2e-3 * scale)


def test_one_compilation_for_two_media(table):
    before = lookup._grid._cache_size()
    for c in (0.31, 0.32):
        lookup.prepare(table, medium(c), grey=True, multiple=False)
    assert lookup._grid._cache_size() - before <= 3  # one of each emitter


def test_response_is_differentiable(table):
    found = lookup.prepare(table, medium(0.7), grey=True, multiple=True)

    def fluence(tau, distance):
        once, more = lookup.compact_source(found.point, found.albedo, tau * jnp.ones((1, 3)), distance * jnp.ones((1, 3)), None)
        return (once + more)[0, 0, 0]

    for tau in (0.0, 0.9, 40.0):
        point = (jnp.float32(tau), jnp.float32(1.3))
        slopes = jax.grad(fluence, argnums=(0, 1))(*point)
        assert np.all(np.isfinite(slopes))
    h = 2e-2
    slopes = jax.grad(fluence, argnums=(0, 1))(jnp.float32(0.9), jnp.float32(1.3))
    assert float(slopes[0]) == pytest.approx(float(fluence(0.9 + h, 1.3) - fluence(0.9 - h, 1.3)) / (2 * h), rel=3e-2)
    assert float(slopes[1]) == pytest.approx(float(fluence(0.9, 1.3 + h) - fluence(0.9, 1.3 - h)) / (2 * h), rel=3e-2)


@pytest.mark.parametrize("exponent", [0.0, 1.0, 7.5, 60.0])
def test_phong_lobe(exponent):
    mu, weight = np.polynomial.legendre.leggauss(400)
    mu, weight = 0.5 * (mu + 1), 0.5 * weight
    legendre = np.polynomial.legendre.legvander(mu, 10)
    truth = harmonics.zonal_norm(11) * (weight * (exponent + 1) * mu**exponent @ legendre)
    np.testing.assert_allclose(shading.phong_lobe(jnp.float32(exponent), 11), truth, atol=3e-6)


def _directions(num, seed):
    v = np.random.default_rng(seed).normal(size=(num, 3))
    return jnp.asarray(v / np.linalg.norm(v, axis=1, keepdims=True), jnp.float32)


def test_mirror_symmetric_radiance_turns_to_world():
    axis, normal, w = (_directions(20, seed) for seed in range(3))
    radiance = jnp.asarray(np.random.default_rng(3).normal(size=(20, 1, 15)), jnp.float32)
    frame = shading.emitter_frame(axis, normal)
    local = jnp.stack([jnp.sum(f * w, -1) for f in frame], -1)
    index = [0, 2, 3, 6, 7, 8]
    there = jnp.sum(harmonics.evaluate_sh(local, 3)[:, index] * radiance[:, 0, :6], -1)
    here = jnp.sum(harmonics.evaluate_sh(w, 3) * shading.half_to_world(radiance, frame)[:, 0], -1)
    np.testing.assert_allclose(here, there, atol=3e-6)


def test_reflection_of_zonal_radiance_against_the_sphere():
    """The O(N) products of a Lambert and a Phong lobe against a sum over the sphere."""
    radiance = np.random.default_rng(0).normal(size=5)
    mu, weight = np.polynomial.legendre.leggauss(60)
    phi = np.pi * np.arange(240) / 120
    sine = np.sqrt(1 - mu * mu)
    w = np.stack([sine[:, None] * np.cos(phi), sine[:, None] * np.sin(phi), mu[:, None] + 0 * phi], -1)
    light = np.polynomial.legendre.legvander(mu, 4) @ (radiance * harmonics.zonal_norm(5))
    lobe_axis = np.array([np.sin(0.7), 0, np.cos(0.7)])
    cosine = np.maximum(w @ lobe_axis, 0)
    for power, found in (
        (1.0, harmonics.zonal_irradiance(jnp.asarray(radiance), jnp.cos(0.7)) / np.pi),
        (9.0, shading.phong_radiance(jnp.asarray(radiance)[None, None], jnp.array([9.0]), jnp.cos(jnp.array([0.7])))[0, 0]),
    ):
        lobe = (power + 1) / (2 * np.pi) * cosine**power
        truth = np.sum(weight[:, None] * light[:, None] * lobe) * np.pi / 120
        assert float(found) == pytest.approx(truth, rel=2e-3, abs=2e-3)


def test_patches_seen_straight_on_have_slopes():
    """Where arccos has none: facing, from behind, and edge-on."""
    cosine = jnp.array([1.0, -1.0, 0.0, 0.5, -0.999999])
    found, slope = jax.jvp(lookup.angle_variable, (cosine,), (jnp.ones(5),))
    expected = np.sign(cosine) * np.sqrt(1 - np.arccos(np.abs(np.asarray(cosine, float))) * 2 / np.pi)
    np.testing.assert_allclose(found, expected, atol=1e-5)
    assert np.isfinite(slope).all() and slope[3] > 0
