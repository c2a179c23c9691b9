"""Half-angle quadrature and airlight against exact problems and adaptive quadrature."""

import jax
import numpy as np
import pytest
from scipy.integrate import quad
from scipy.special import exp1

from jaxvol import airlight


@pytest.mark.parametrize(
    ("sigma", "distance", "angle", "length", "expected"),
    [
        (1.0, 1.0, np.pi / 2, None, 0.1933049620),
        (0.5, 2.0, 0.3, None, 1.1473272643),
        (1.0, 1.0, np.pi / 3, 2.0, 0.3532012825),
    ],
)
def test_airlight_of_a_ray(sigma, distance, angle, length, expected):
    """T7 (Sun et al. 2005): int e^{-sigma (t + r)} / r^2 dt."""
    with jax.enable_x64(True):
        value = airlight.single_scatter_radiance(distance, angle, sigma, 4 * np.pi, length=length, num_nodes=48)
        assert value.dtype == np.float64
    assert abs(float(value) - expected) < 2e-10


def test_airlight_without_extinction():
    """int dt / r^2 = (pi - gamma) / (D sin gamma)."""
    value = airlight.single_scatter_radiance(2.0, 0.7, 0.0, 4 * np.pi)
    assert abs(float(value) / ((np.pi - 0.7) / (2 * np.sin(0.7))) - 1) < 1e-6


def test_nodes_integrate_lengths_and_jacobian():
    nodes = airlight.half_angle_nodes(80)
    np.testing.assert_allclose(np.sum(nodes.weight), np.pi**2 / 8, rtol=1e-12)
    np.testing.assert_allclose(1 + nodes.excess, nodes.source_distance + nodes.receiver_distance, rtol=1e-9)
    # int dmu dt f over a half plane of scattering points, f = e^{-t - r} / r^2 with d = 1
    ours = np.sum(nodes.weight * 4 * np.exp(-1 - nodes.excess))

    def integrand(t, mu):
        square = (t - mu) ** 2 + 1 - mu * mu
        return np.exp(-t - np.sqrt(square)) / square

    def along(mu):
        return quad(integrand, 0, 60, args=(mu,), points=[mu] if mu > 0 else None, limit=200)[0]

    assert abs(ours - quad(along, -1, 1, limit=200)[0]) < 1e-5


def test_area_nodes_cover_the_same_triangle():
    for theta in (0.0, 0.4, np.pi / 2, 2.0, np.pi):
        nodes = airlight.area_nodes(50, theta)
        assert all(np.all(np.isfinite(v)) for v in nodes)
        np.testing.assert_allclose(np.sum(nodes.weight), np.pi**2 / 8, rtol=1e-10)


@pytest.mark.parametrize("theta", [0.0, 0.3, 1.2, np.pi / 2, 2.5, np.pi])
def test_emission_by_azimuthal_order(theta):
    nodes = airlight.area_nodes(12, theta)
    found = airlight.area_emission(nodes, theta, 5)
    phi = 2 * np.pi * (np.arange(4096) + 0.5) / 4096
    cosine = np.cos(theta) * nodes.cos_source[:, None] + np.sin(theta) * nodes.sin_source[:, None] * np.cos(phi)
    for m in range(5):
        np.testing.assert_allclose(found[:, m], np.mean(np.maximum(cosine, 0) * np.cos(m * phi), axis=1), atol=2e-6)


def test_directional_factor_keeps_precision_in_float32():
    one_minus_mu = np.float32(1e-7)
    value = airlight.directional_factor(np.float32(1), 1 - one_minus_mu, one_minus_mu)
    assert abs(float(value) - 1) < 1e-6
    grazing = airlight.directional_factor(np.float32(5), np.float32([1e-30, -0.5, 1.0]), np.float32([1, 1.5, 0]))
    np.testing.assert_allclose(np.asarray(grazing), [1, 1 / 1.5, 5], rtol=1e-6)
    slope = jax.grad(lambda t: airlight.directional_factor(t, np.float32(1e-20), np.float32(1)))(np.float32(2))
    assert np.isfinite(slope)


def test_infinite_floor():
    """T13: irradiance that a floor of radiosity pi Le in fog gets back, 2/3 (1 - ln 2), from the coplanar kernel."""
    nodes = airlight.half_angle_nodes(120)
    kernel = nodes.sin_receiver * nodes.sin_source * nodes.weight / 2
    # int 2 pi d E_1(d) dd: tau integrates to 1 / (1 + x)
    ours = np.sum(2 * np.pi * kernel / (1 + nodes.excess)) / np.pi
    assert abs(ours - 2 / 3 * (1 - np.log(2))) < 1e-12
    assert abs(ours - 0.2045685463) < 1e-10


def test_half_space_fluence():
    """Band 0 of the directional response = 1/2 int e^{-z} E_1 |z - tau| dz."""
    tau = 0.7
    x, _, weight = airlight.double_exponential(120)
    with jax.enable_x64(True):
        up = np.asarray(airlight.directional_factor(np.full_like(x, tau), x, 1 - x))
    total = np.sum(weight * (up + 1 / (1 + x))) * np.exp(-tau) / 2
    above = quad(lambda z: np.exp(-z) * exp1(tau - z), 0, tau)[0]
    below = quad(lambda z: np.exp(-z) * exp1(z - tau), tau, 60)[0]
    assert abs(total - (above + below) / 2) < 1e-7
