"""The pair kernel's sampling and phase function against float64 quadrature and closed forms."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxvol import fast_math
from jaxvol.methods.instant_multiple_scattering import compensation, pairs


def test_polynomials_are_accurate():
    x = np.linspace(-1, 1, 20001)
    atan = np.asarray(fast_math.atan_unit(jnp.asarray(x, jnp.float32)))
    assert np.max(np.abs(atan - np.arctan(x))) < 2e-7
    arccos = np.asarray(fast_math.arccos_unit(jnp.asarray(x[10000:], jnp.float32)))
    assert np.max(np.abs(arccos - np.arccos(np.float32(x[10000:]).astype(float)))) < 3e-7
    y = np.linspace(-np.pi / 2, np.pi / 2, 20001)
    sin, cos = (np.asarray(v) for v in fast_math.sin_cos(jnp.asarray(y, jnp.float32)))
    assert max(np.max(np.abs(sin - np.sin(y))), np.max(np.abs(cos - np.cos(y)))) < 4e-7


@pytest.mark.parametrize(("h", "clamp"), [(0.0, 0.2), (0.1, 0.2), (0.5, 0.2), (0.5, None), (3.0, 0.2)])
def test_sampling_along_the_ray_has_its_pdf(h, clamp):
    """Mean weight = integral of the clamped kernel (quadrature); weights hold no spikes; t follows the pdf."""
    a, b = -1.3, 2.1
    n = 1 << 16
    u = (jnp.arange(n, dtype=jnp.float32) + 0.5) / n
    d = None if clamp is None else jnp.float32(clamp)
    t, weight = pairs.sample_along_ray(u, jnp.float32(a), jnp.float32(b), jnp.float32(h * h), d)
    x = np.linspace(a, b, 2_000_001)
    kernel = 1.0 / np.maximum(x * x + h * h, 1e-12 if clamp is None else clamp * clamp)
    exact = np.trapezoid(kernel, x)
    assert float(jnp.mean(weight)) == pytest.approx(exact, rel=2e-5)
    assert float(jnp.max(weight) / jnp.min(weight)) < 2.05
    pdf = np.asarray(pairs.sample_along_ray_pdf(jnp.asarray(x, jnp.float32), a, b, jnp.float32(h * h), d), np.float64)
    cdf = np.concatenate([[0], np.cumsum(0.5 * (pdf[1:] + pdf[:-1]) * np.diff(x))])
    assert cdf[-1] == pytest.approx(1.0, abs=1e-4)
    assert np.max(np.abs(np.interp(np.asarray(t), x, cdf) - np.asarray(u))) < 2e-4


def test_a_light_on_the_ray_gives_finite_values_and_gradients():
    def value(h):
        return jnp.sum(pairs.sample_along_ray(jnp.float32([0.1, 0.5, 0.9]), -1.0, 1.0, h * h, jnp.float32(0.2))[1])

    assert np.isfinite(float(value(0.0)))
    assert np.isfinite(float(jax.grad(value)(0.0)))


@pytest.mark.parametrize("g", [0.99, 0.999, 0.5, 1e-4, 0.0, -0.7])
def test_phase_function_keeps_its_peak(g):
    cosine = np.float32([-1, -0.5, 0, 0.9, 0.999, 0.999999, 1])
    value = np.asarray(pairs.henyey_greenstein(jnp.asarray(cosine), jnp.float32(g)), np.float64)
    c, g64 = cosine.astype(np.float64), float(np.float32(g))
    exact = (1 - g64**2) / (4 * np.pi * (1 + g64**2 - 2 * g64 * c) ** 1.5)
    # rsqrt cubed: three roundings of a number that is itself good to the rounding of 1 - cos.
    assert np.max(np.abs(value / exact - 1)) < 3e-5
    assert np.isfinite(float(pairs.henyey_greenstein(jnp.float32(1.5), jnp.float32(g))))


def test_phase_function_gradient_at_zero():
    slope = jax.grad(lambda g: pairs.henyey_greenstein(jnp.float32(0.3), g))(jnp.float32(0.0))
    assert float(slope) == pytest.approx(3 * 0.3 / (4 * np.pi), rel=1e-5)


def test_residual_distances_have_their_pdf():
    n = 1 << 15
    u = (jnp.arange(n, dtype=jnp.float32) + 0.5) / n
    d = jnp.float32(0.7)
    t = compensation.sample_distance(u, d)
    np.testing.assert_allclose(np.asarray(compensation.distance_cdf(t, d)), np.asarray(u), atol=2e-6)
    x = np.linspace(0, 0.7, 100001)
    assert np.trapezoid(np.asarray(compensation.sample_distance_pdf(jnp.asarray(x), d)), x) == pytest.approx(1, abs=1e-5)
    # The weight is proportional to the pdf, so that it cancels.
    ratio = compensation.weight(t, d) / compensation.sample_distance_pdf(t, d)
    np.testing.assert_allclose(np.asarray(ratio), 2 * 0.7 / 3, rtol=1e-4)


@pytest.mark.parametrize("sigma", [0.0, 1e-9, 1.0, 50.0])
def test_exponential_distances_hold_for_thin_media(sigma):
    n = 1 << 14
    u = (jnp.arange(n, dtype=jnp.float32) + 0.5) / n
    t = compensation.sample_distance_exponential(u, jnp.float32(0.7), jnp.float32(sigma))
    pdf = compensation.sample_distance_exponential_pdf(t, jnp.float32(0.7), jnp.float32(sigma))
    assert bool(jnp.all((t >= 0) & (t <= 0.7) & jnp.isfinite(pdf)))
    x = np.asarray(t, np.float64)
    cdf = x / 0.7 if sigma < 1e-6 else np.expm1(-sigma * x) / np.expm1(-sigma * 0.7)
    np.testing.assert_allclose(cdf, np.asarray(u), atol=1e-5)
    density = 1 / 0.7 if sigma < 1e-6 else -sigma * np.exp(-sigma * x) / np.expm1(-sigma * 0.7)
    np.testing.assert_allclose(np.asarray(pdf), density, rtol=1e-4)
