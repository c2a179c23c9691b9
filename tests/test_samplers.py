"""Every sampler against its pdf: a chi-square test of histograms, and closed-form normalisation and moments."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from jaxvol import lights, materials, phase, sampling
from jaxvol.types import AreaLights, DirectionalLights, EnvironmentLight, Mesh, PointLights, Scene, SpotLights

NUM = 1 << 18


def draw(num, dimension=0, seed=7):
    return sampling.uniforms(seed, sampling.stream("test"), jnp.arange(num, dtype=jnp.uint32), dimension)


def chi_square(directions, pdf, bins=(12, 24)):
    """p-value of directions against a pdf on the sphere, integrated over cells in float64 by 16 x 16 midpoints."""
    directions = np.asarray(directions, np.float64)
    z = np.clip(directions[:, 2], -1, 1)
    phi = np.arctan2(directions[:, 1], directions[:, 0]) % (2 * np.pi)
    rows, columns = bins
    counts, _, _ = np.histogram2d(z, phi, bins=bins, range=[[-1, 1], [0, 2 * np.pi]])
    sub = 24
    zs = -1 + 2 * (np.arange(rows * sub) + 0.5) / (rows * sub)
    phis = 2 * np.pi * (np.arange(columns * sub) + 0.5) / (columns * sub)
    zz, pp = np.meshgrid(zs, phis, indexing="ij")
    s = np.sqrt(1 - zz * zz)
    grid = np.stack([s * np.cos(pp), s * np.sin(pp), zz], axis=-1).reshape(-1, 3)
    values = np.asarray(pdf(jnp.asarray(grid, jnp.float32)), np.float64).reshape(rows, sub, columns, sub)
    cell = values.sum(axis=(1, 3)) * (2 / (rows * sub)) * (2 * np.pi / (columns * sub))
    assert abs(cell.sum() - 1) < 5e-3 or cell.sum() < 1  # densities integrate to one (a lobe may lose its lower part)
    expected = cell * len(directions)
    keep = expected > 20
    statistic = np.sum((counts[keep] - expected[keep]) ** 2 / expected[keep])
    return stats.chi2.sf(statistic, keep.sum() - 1), cell.sum()


def test_pcg4d_is_uniform_and_independent_of_neighbouring_counters():
    u = np.stack(draw(NUM), axis=1)
    assert u.min() > 0 and u.max() < 1
    for column in u.T:
        assert stats.kstest(column, "uniform").pvalue > 1e-3
    counts, _, _ = np.histogram2d(u[:-1, 0], u[1:, 0], bins=32)
    assert stats.chisquare(counts.ravel()).pvalue > 1e-3
    other = np.stack(draw(NUM, dimension=1), axis=1)
    for a in range(4):
        for b in range(4):
            assert abs(np.corrcoef(u[:, a], other[:, b])[0, 1]) < 4 / math.sqrt(NUM)


def test_pcg4d_matches_the_published_integer_code():
    def reference(v):
        mask = 0xFFFFFFFF
        v = [(x * 1664525 + 1013904223) & mask for x in v]
        for _ in range(2):
            v[0] = (v[0] + v[1] * v[3]) & mask
            v[1] = (v[1] + v[2] * v[0]) & mask
            v[2] = (v[2] + v[0] * v[1]) & mask
            v[3] = (v[3] + v[1] * v[2]) & mask
            if _ == 0:
                v = [x ^ (x >> 16) for x in v]
        return v

    for v in ([0, 0, 0, 0], [1, 2, 3, 4], [0xFFFFFFFF, 17, 0x80000000, 5]):
        got = [int(x) for x in sampling.pcg4d(*(jnp.uint32(x) for x in v))]
        assert got == reference(list(v))


def test_normalize_has_no_smallest_length():
    """Vectors whose squares under- or overflow, and the zero vector, with their gradients both ways."""
    v = jnp.asarray([[3.0, 0.0, 4.0]]) * jnp.asarray([[1e-30], [1e-12], [1.0], [1e30], [0.0]])
    unit, slope = jax.jvp(sampling.normalize, (v,), (v[:, ::-1],))
    np.testing.assert_allclose(unit[:4], np.tile([0.6, 0.0, 0.8], (4, 1)), rtol=1e-6)
    # (I - u u') w / |v| with w = (4, 0, 3) |v| / 5
    np.testing.assert_allclose(slope[:4], np.tile([0.8 - 0.96 * 0.6, 0.0, 0.6 - 0.96 * 0.8], (4, 1)), rtol=1e-5, atol=1e-7)
    assert (np.asarray(unit[4]) == 0).all() and (np.asarray(slope[4]) == 0).all()
    assert np.isfinite(jax.grad(lambda v: jnp.sum(sampling.normalize(v)[:, 0]))(v)).all()


@pytest.mark.parametrize("g", [-0.95, -0.5, 0.0, 1e-4, 0.3, 0.8])
def test_henyey_greenstein(g):
    u1, u2, _, _ = draw(NUM)
    cos_theta, sin_theta = phase.sample_henyey_greenstein(u1, jnp.float32(g))
    axis = jnp.broadcast_to(sampling.normalize(jnp.array([0.3, -0.5, 0.8])), (NUM, 3))
    directions = sampling.direction_about(axis, cos_theta, sin_theta, u2)
    p, total = chi_square(directions, lambda w: phase.henyey_greenstein(w @ axis[0], jnp.float32(g)))
    assert abs(np.mean(np.asarray(cos_theta, np.float64)) - g) < 4 / math.sqrt(NUM)
    assert abs(g) > 0.9 or p > 1e-3


@pytest.mark.parametrize("g", [0.99, 0.999, -0.999])
def test_henyey_greenstein_at_its_extremes_against_float64(g):
    u = np.asarray(draw(4096)[0], np.float64)
    g = float(np.float32(g))
    s = (1 - g * g) / (1 - g + 2 * g * u)
    exact = (1 + g * g - s * s) / (2 * g)
    got = np.asarray(phase.sample_henyey_greenstein(jnp.asarray(u, jnp.float32), jnp.float32(g))[0])
    assert np.max(np.abs(got - exact)) < 1e-5
    gradient = jax.grad(lambda g: phase.henyey_greenstein(jnp.float32(0.4), g))
    assert abs(float(gradient(jnp.float32(0.0))) - 3 * 0.4 / (4 * math.pi)) < 1e-6


def test_phase_table_reproduces_henyey_greenstein_and_its_own_pdf():
    g = 0.6
    table = phase.phase_table(g ** np.arange(40))
    cos_theta = jnp.linspace(-1, 1, 2001)
    assert np.allclose(phase.evaluate_table(table, cos_theta), phase.henyey_greenstein(cos_theta, g), rtol=3e-3, atol=1e-5)
    u1, u2, _, _ = draw(NUM)
    cosines = phase.sample_table(u1, table)
    axis = jnp.broadcast_to(jnp.array([0.0, 0.6, 0.8]), (NUM, 3))
    directions = sampling.direction_about(axis, cosines, jnp.sqrt(1 - cosines * cosines), u2)
    p, total = chi_square(directions, lambda w: phase.evaluate_table(table, w @ axis[0]))
    assert p > 1e-3 and abs(total - 1) < 2e-3


@pytest.mark.parametrize("moments", [[1.0, 2.0], [0.5], [1.0, float("nan")], [1.0, 0.99, -0.9]])
def test_phase_table_refuses_impossible_moments(moments):
    with pytest.raises(ValueError, match="phase moments"):
        phase.phase_table(moments)


@pytest.mark.parametrize("specular", [None, 0.4])
def test_surface_sampler(specular):
    n = jnp.array([0.0, 0.0, 1.0])
    incoming = sampling.normalize(jnp.array([0.5, 0.2, -0.6]))
    surface = materials.Surface(
        albedo=jnp.full((NUM, 3), 0.5),
        specular=None if specular is None else jnp.full((NUM, 3), specular),
        exponent=None if specular is None else jnp.full((NUM,), 12.0),
    )
    many = lambda v: jnp.broadcast_to(v, (NUM, 3))  # noqa: E731
    u1, u2, u3, _ = draw(NUM)
    directions = materials.sample(surface, many(n), many(incoming), u1, u2, u3)
    one = jax.tree.map(lambda x: x[0], surface)
    p, _ = chi_square(directions, lambda w: materials.sample_pdf(one, n, incoming, w), bins=(16, 24))
    assert p > 1e-3
    # Energy: the albedo of the whole lobe stays at or below albedo + specular.
    pdf = materials.sample_pdf(surface, many(n), many(incoming), directions)
    value = materials.evaluate(surface, many(n), many(incoming), directions)[:, 0] * jnp.maximum(directions[:, 2], 0)
    reflected = float(jnp.mean(value / pdf))
    assert reflected <= 0.5 + (specular or 0) + 0.01
    assert specular is not None or abs(reflected - 0.5) < 2e-3


def test_surface_is_reciprocal_and_two_sided():
    surface = materials.Surface(albedo=jnp.array([0.5] * 3), specular=jnp.array([0.3] * 3), exponent=jnp.float32(9.0))
    n = jnp.array([0.0, 0.0, 1.0])
    a = sampling.normalize(jnp.array([0.5, 0.2, -0.6]))
    b = sampling.normalize(jnp.array([0.1, 0.4, 0.7]))
    forward = materials.evaluate(surface, n, a, b)
    assert np.allclose(forward, materials.evaluate(surface, n, -b, -a), rtol=1e-5)
    assert np.allclose(forward, materials.evaluate(surface, -n, a, b), rtol=1e-5)


@pytest.mark.parametrize("rotation", [0.0, 70.0])
def test_environment_sampler(rotation):
    rng = np.random.default_rng(3)
    image = rng.random((16, 32, 3)) ** 4
    image[4, 20] = 30.0
    sky = lights.environment_light(image, rotation_degrees=rotation)
    u1, u2, _, _ = draw(NUM)
    directions, pdf = jax.jit(lights.sample_environment)(sky, u1, u2)
    assert (
        np.allclose(pdf, lights.sample_environment_pdf(sky, directions), rtol=2e-2)
        or np.mean(np.abs(pdf / lights.sample_environment_pdf(sky, directions) - 1) > 1e-3) < 1e-3
    )  # a direction on a cell's border may fall to its neighbour
    radiance = lights.environment_radiance(sky, directions)
    estimate = np.asarray(radiance / pdf[:, None], np.float64)
    uniform = sampling.sample_uniform_sphere(*draw(NUM, dimension=5)[:2])
    brute = np.asarray(lights.environment_radiance(sky, uniform), np.float64) * 4 * np.pi
    error = np.hypot(estimate.std(axis=0), brute.std(axis=0)) / math.sqrt(NUM)
    assert np.all(np.abs(estimate.mean(axis=0) - brute.mean(axis=0)) < 4 * error)


def test_environment_directions_follow_the_stated_convention():
    image = np.zeros((32, 64, 3))
    image[15:17, 31:33] = 1.0  # the middle of the map
    sky = lights.environment_light(image)
    assert float(lights.environment_radiance(sky, jnp.array([0.0, 0.0, 1.0]))[0]) > 0.9
    turned = lights.environment_light(image, rotation_degrees=90.0)  # about y: +z goes to +x
    assert float(lights.environment_radiance(turned, jnp.array([1.0, 0.0, 0.0]))[0]) > 0.9


def quad(emission):
    vertices = jnp.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]) + jnp.array([-0.5, -0.5, 2.0])
    faces = jnp.array([[0, 2, 1], [0, 3, 2]])  # front towards -z
    return Mesh(vertices=vertices, faces=faces, albedo=jnp.zeros((2, 3)), emission=jnp.asarray(emission))


def test_light_sampling_estimates_the_irradiance_of_every_kind_at_once():
    mesh = quad([[2.0, 1.0, 0.5], [2.0, 1.0, 0.5]])
    scene = Scene(
        mesh=mesh,
        area_lights=lights.area_lights(mesh),
        point_lights=PointLights(jnp.array([[0.0, 0, 1.0], [1.0, 0, 1]]), jnp.array([[1.0, 2, 3], [1, 1, 1]])),
        spot_lights=SpotLights(
            jnp.array([[0.0, 0.0, 4.0]]), jnp.array([[0.0, 0, -1]]), jnp.ones((1, 3)), jnp.array([0.4]), jnp.array([0.2])
        ),
        directional_lights=DirectionalLights(jnp.array([[0.0, 0.0, -1.0]]), jnp.array([[0.3, 0.2, 0.1]])),
        environment=lights.environment_light([0.05, 0.05, 0.05]),
    )
    num = 1 << 20
    u1, u2, u3, _ = draw(num)
    position = jnp.zeros((num, 3))
    sample = jax.jit(lights.sample_light)(scene, position, u1, u2, u3)
    cosine = jnp.maximum(sample.direction[:, 2], 0)
    estimate = np.asarray(sample.radiance * (cosine / sample.pdf)[:, None], np.float64)
    x, y = np.meshgrid((np.arange(400) + 0.5) / 400 - 0.5, (np.arange(400) + 0.5) / 400 - 0.5)
    form = np.mean(4.0 / (x * x + y * y + 4) ** 2)  # cos cos / d^2 over the unit square at height 2
    exact = np.array([2, 1, 0.5]) * form + [1, 2, 3] + np.ones(3) / 2 / math.sqrt(2) + 1 / 16 + [0.3, 0.2, 0.1] + 0.05 * math.pi
    error = estimate.std(axis=0) / math.sqrt(num)
    assert np.all(error < 3e-3 * exact)
    assert np.all(np.abs(estimate.mean(axis=0) - exact) < 4 * error)


def test_light_pdf_agrees_with_light_sampling():
    mesh = quad([[2.0, 1.0, 0.5], [1.0, 1.0, 1.0]])
    scene = Scene(mesh=mesh, area_lights=lights.area_lights(mesh))
    u1, u2, u3, _ = draw(1024)
    sample = lights.sample_light(scene, jnp.zeros((1024, 3)), u1, u2, u3)
    face = jnp.where(sample.position[:, 0] > sample.position[:, 1], 0, 1)
    normal = jnp.broadcast_to(jnp.array([0.0, 0, -1]), (1024, 3))
    pdf = lights.sample_light_pdf(scene, jnp.zeros((1024, 3)), sample.direction, face, sample.distance, normal)
    assert np.allclose(pdf, sample.pdf, rtol=1e-4)
    assert np.all(lights.emitted_radiance(mesh, face, normal, sample.direction)[:, 0] > 0)
    assert np.all(lights.emitted_radiance(mesh, face, normal, -sample.direction)[:, 0] == 0)


def test_area_light_table_leaves_out_what_does_not_emit():
    mesh = quad([[0.0, 0, 0], [1, 1, 1]])
    found = lights.area_lights(mesh)
    assert isinstance(found, AreaLights) and found.face.tolist() == [1]
    assert lights.area_lights(quad([[0.0, 0, 0], [0, 0, 0]])) is None
    assert lights.environment_light(np.zeros((2, 4, 3))) is None
    assert isinstance(lights.environment_light([1.0, 1, 1]), EnvironmentLight)


def test_equiangular_and_exponential_samplers():
    num = 1 << 16
    u = draw(num)[0]
    origin = jnp.broadcast_to(jnp.array([0.0, 0.0, 0.0]), (num, 3))
    direction = jnp.broadcast_to(jnp.array([0.0, 0.0, 1.0]), (num, 3))
    point = jnp.broadcast_to(jnp.array([0.2, 0.0, 1.5]), (num, 3))
    t0, t1 = jnp.full((num,), 0.5), jnp.full((num,), 4.0)
    t, pdf = sampling.sample_equiangular(u, origin, direction, t0, t1, point)
    assert np.allclose(pdf, sampling.sample_equiangular_pdf(t, origin, direction, t0, t1, point), rtol=1e-4)
    cdf = lambda x: (np.arctan((x - 1.5) / 0.2) - np.arctan(-1 / 0.2)) / (np.arctan(2.5 / 0.2) - np.arctan(-1 / 0.2))  # noqa: E731
    assert stats.kstest(np.asarray(t), cdf).pvalue > 1e-3
    for sigma in (0.0, 1e-6, 0.7, 50.0):
        t = np.asarray(sampling.sample_truncated_exponential(u, jnp.float32(sigma), jnp.float32(2.0)), np.float64)
        exact = (lambda x: x / 2) if sigma == 0 else (lambda x, s=sigma: np.expm1(-s * x) / np.expm1(-s * 2.0))
        assert stats.kstest(t, exact).pvalue > 1e-3
        grid = (np.arange(20000) + 0.5) / 10000
        total = np.mean(sampling.sample_truncated_exponential_pdf(jnp.asarray(grid, jnp.float32), sigma, 2.0)) * 2
        assert abs(total - 1) < 1e-3


def test_spot_intensity_is_linear_in_the_angle():
    spots = SpotLights(jnp.zeros((1, 3)), jnp.array([[0.0, 0, 1]]), jnp.ones((1, 3)), jnp.array([0.6]), jnp.array([0.2]))
    angle = jnp.array([0.0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7])
    travel = jnp.stack([jnp.sin(angle), 0 * angle, jnp.cos(angle)], axis=1)
    got = lights.spot_falloff(spots, jnp.zeros(8, jnp.int32), travel)
    assert np.allclose(got, [1, 1, 1, 0.75, 0.5, 0.25, 0, 0], atol=1e-5)


def test_the_fifth_uniform_is_uniform_and_independent_of_the_four():
    num = 1 << 16
    index = jnp.arange(num, dtype=jnp.uint32)
    draws = np.asarray(sampling.five_uniforms(jnp.uint32(5), sampling.stream("test"), index, jnp.uint32(3), jnp.uint32(0)))
    np.testing.assert_array_equal(draws[:4], sampling.uniforms(jnp.uint32(5), sampling.stream("test"), index, jnp.uint32(3)))
    assert 0 < draws[4].min() and draws[4].max() < 1
    for other in draws[:4]:
        counts = np.histogram2d(draws[4], other, bins=16, range=[[0, 1], [0, 1]])[0]
        chi2 = np.sum((counts - num / 256) ** 2) / (num / 256)
        assert abs(chi2 - 255) < 5 * np.sqrt(2 * 255)
    assert abs(np.corrcoef(draws[4][:-1], draws[4][1:])[0, 1]) < 5 / np.sqrt(num)
