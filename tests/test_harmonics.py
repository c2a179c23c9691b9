"""Harmonics against quadrature over the sphere, scipy's spherical harmonics and printed lists."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.special import sph_harm_y

from jaxvol import harmonics

COSINE = [0.88622693, 1.02332671, 0.49541591, 0, -0.11077837, 0, 0.04992713, 0, -0.02854693, 0, 0.01850808]


def sphere(num=48):
    mu, weight = np.polynomial.legendre.leggauss(num)
    phi = 2 * np.pi * (np.arange(2 * num) + 0.5) / (2 * num)
    sine = np.sqrt(1 - mu**2)
    direction = np.stack([np.outer(sine, np.cos(phi)), np.outer(sine, np.sin(phi)), np.outer(mu, np.ones_like(phi))], axis=-1)
    return direction, np.outer(weight, np.full(2 * num, np.pi / num))


@pytest.fixture(autouse=True)
def float64():
    with jax.enable_x64(True):
        yield


def test_values_agree_with_scipy():
    direction, _ = sphere(6)
    values = np.asarray(harmonics.evaluate_sh(direction, 11))
    theta = np.arccos(direction[..., 2])
    phi = np.arctan2(direction[..., 1], direction[..., 0])
    for band in range(11):
        for m in range(-band, band + 1):
            complex_value = sph_harm_y(band, abs(m), theta, phi) * (-1) ** m  # undo the Condon-Shortley sign
            scale = 1 if m == 0 else np.sqrt(2)
            expected = scale * (complex_value.imag if m < 0 else complex_value.real)
            np.testing.assert_allclose(values[..., band * (band + 1) + m], expected, atol=1e-13)


def test_orthonormal_to_high_order():
    direction, weight = sphere(40)
    values = np.asarray(harmonics.evaluate_sh(direction, 20)).reshape(-1, 400)
    np.testing.assert_allclose(values.T @ (weight.reshape(-1, 1) * values), np.eye(400), atol=1e-12)


def test_half_is_the_meridian_of_the_full_basis():
    theta = np.linspace(0, np.pi, 7)
    direction = np.stack([np.sin(theta), 0 * theta, np.cos(theta)], axis=-1)
    full = np.asarray(harmonics.evaluate_sh(direction, 6))
    half = np.asarray(harmonics.evaluate_half(np.cos(theta), np.sin(theta), 6))
    for index, (band, m) in enumerate(harmonics.half_index(6)):
        np.testing.assert_allclose(half[:, index], full[:, band * (band + 1) + m], atol=1e-14)


def test_clamped_cosine_list_and_quadrature():
    np.testing.assert_allclose(harmonics.clamped_cosine(11), COSINE, atol=5e-9)
    mu, weight = np.polynomial.legendre.leggauss(64)
    upper = (mu + 1) / 2  # the kink at 0 is a panel end
    moments = (0.5 * weight * upper) @ np.polynomial.legendre.legvander(upper, 10)
    np.testing.assert_allclose(harmonics.clamped_cosine(11), 2 * np.pi * harmonics.zonal_norm(11) * moments, atol=1e-12)


def test_henyey_greenstein_coefficients():
    """T8: g^l sqrt((2l+1)/4pi)."""
    g = 0.7
    coefficients = harmonics.project_zonal(
        lambda mu: (1 - g * g) / (4 * np.pi * (1 + g * g - 2 * g * mu) ** 1.5), 5, num_nodes=200
    )
    np.testing.assert_allclose(coefficients, [0.28209479, 0.34202176, 0.30908373, 0.25599896, 0.20319288], atol=5e-9)


@pytest.mark.parametrize("beta", [0.0, 0.3, 1.2, 2.5, np.pi])
def test_appendix_a_against_sphere_quadrature(beta):
    rng = np.random.default_rng(3)
    g, h = rng.normal(size=(2, 11))
    direction, weight = sphere()
    axis = np.array([np.sin(beta), 0.0, np.cos(beta)])
    product = np.asarray(harmonics.evaluate_zonal(jnp.asarray(g), direction[..., 2])) * np.asarray(
        harmonics.evaluate_zonal(jnp.asarray(h), direction @ axis)
    )
    assert abs(float(harmonics.zonal_product(g, h, np.cos(beta))) - np.sum(weight * product)) < 1e-8


def test_rotation_is_the_function_about_the_axis():
    rng = np.random.default_rng(5)
    coefficients = jnp.asarray(rng.normal(size=8))
    axis = rng.normal(size=3)
    axis /= np.linalg.norm(axis)
    direction, _ = sphere(10)
    full = np.asarray(harmonics.evaluate_sh(direction, 8)) @ np.asarray(harmonics.rotate_zonal(coefficients, axis))
    np.testing.assert_allclose(full, harmonics.evaluate_zonal(coefficients, direction @ axis), atol=1e-12)


def test_projections_recover_coefficients():
    rng = np.random.default_rng(6)
    sh = rng.normal(size=36)
    found = harmonics.project_sh(lambda w: np.asarray(harmonics.evaluate_sh(w, 6)) @ sh, 6)
    np.testing.assert_allclose(found, sh, atol=1e-12)
    zonal = rng.normal(size=6)
    found = harmonics.project_zonal(lambda mu: np.asarray(harmonics.evaluate_zonal(jnp.asarray(zonal), mu)), 6)
    np.testing.assert_allclose(found, zonal, atol=1e-12)


def test_irradiance_of_zonal_half_and_full_agree_with_quadrature():
    rng = np.random.default_rng(8)
    order = 5
    half = rng.normal(size=harmonics.num_half(order))
    full = np.zeros(25)
    for value, (band, m) in zip(half, harmonics.half_index(order), strict=True):
        full[band * (band + 1) + m] = value
    normal = np.array([0.3, -0.5, 0.2])
    normal /= np.linalg.norm(normal)
    direction, weight = sphere(400)  # max(0, cos) has a kink: quadrature error 1e-6
    radiance = np.asarray(harmonics.evaluate_sh(direction, order)) @ full
    expected = np.sum(weight * radiance * np.maximum(0, direction @ normal))
    assert abs(float(harmonics.sh_irradiance(jnp.asarray(full), normal)) - expected) < 1e-5
    assert abs(float(harmonics.half_irradiance(jnp.asarray(half), normal)) - expected) < 1e-5
    zonal = rng.normal(size=order)
    radiance = np.asarray(harmonics.evaluate_zonal(jnp.asarray(zonal), direction[..., 2]))
    expected = np.sum(weight * radiance * np.maximum(0, direction @ normal))
    assert abs(float(harmonics.zonal_irradiance(jnp.asarray(zonal), normal[2])) - expected) < 1e-5


def test_float32_stays_float32():
    direction = np.float32([0.6, 0.0, 0.8])
    assert harmonics.evaluate_sh(direction, 4).dtype == np.float32
    assert harmonics.rotate_zonal(jnp.ones(4, np.float32), direction).dtype == np.float32
