"""The lattice against exact transport: conservation, diffusion, decay constants, T10, the paper's own matrix."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import brentq

from jaxvol.methods.lattice_boltzmann import stepping
from jaxvol.methods.lattice_boltzmann.lattice import LATTICES, beta_gamma, coefficients, lattice, paper_theta, theta

ALL = sorted(LATTICES)


def test_unknown_lattice_is_refused():
    with pytest.raises(ValueError, match="allowed: paper, 18, 26"):
        lattice("19")


@pytest.mark.parametrize("name", ALL)
def test_quadrature_degree(name):
    degree = {"paper": 3, "18": 5, "26": 7}[name]
    unit = np.array(LATTICES[name].directions) / LATTICES[name].lengths[:, None]
    weights = LATTICES[name].weights
    exact = {0: 1.0, 2: 1 / 3, 4: 1 / 5, 6: 1 / 7}
    for power, value in exact.items():
        if power <= degree:
            assert np.sum(weights * unit[:, 0] ** power) == pytest.approx(value, abs=1e-12)
    if degree >= 5:
        assert np.sum(weights * unit[:, 0] ** 2 * unit[:, 1] ** 2) == pytest.approx(1 / 15, abs=1e-12)


@pytest.mark.parametrize("name", ALL)
@pytest.mark.parametrize("kind", ["pade", "exp"])
def test_theta_columns_lose_only_what_is_absorbed(name, kind):
    conserving = theta(LATTICES[name], 0.7, 0.0, kind=kind)
    np.testing.assert_allclose(conserving.sum(axis=0), 1.0, atol=1e-6)
    absorbing = theta(LATTICES[name], 0.5, 0.2, kind=kind)
    assert np.all(absorbing.sum(axis=0) < 0.9) and np.all(absorbing >= 0)


def test_theta_of_equal_links_is_the_published_pade_form():
    scattering, absorption = 0.5, 0.2
    p_t, p_a = ((x / (1 + x / 2)) for x in (scattering + absorption, absorption))
    expected = np.full((6, 6), (p_t - p_a) / 6) + np.eye(6) * (1 - p_t)
    np.testing.assert_allclose(theta(LATTICES["paper"], scattering, absorption), expected, atol=1e-6)


def test_paper_theta_absorbs_nothing_and_is_albedo_one():
    matrix = paper_theta(0.3, 0.2)
    np.testing.assert_allclose(matrix.sum(axis=0), 1.0, atol=1e-12)
    # eliminate the rest state of the steady equations: what is left is a lattice of albedo 1 at the same sigma_t
    steady = matrix[1:, 1:] + np.outer(matrix[1:, 0], matrix[0, 1:])
    np.testing.assert_allclose(steady, np.full((6, 6), 0.5 / 6) + 0.5 * np.eye(6), atol=1e-12)


def test_geist_weights_conserve_and_are_only_degree_three():
    weights = np.array([1 / 12] * 6 + [1 / 24] * 12)
    directions = sorted(LATTICES["18"].directions, key=lambda c: sum(map(abs, c)))
    unit = np.array(directions) / np.linalg.norm(directions, axis=1, keepdims=True)
    assert weights.sum() == pytest.approx(1)
    assert np.sum(weights * unit[:, 0] ** 4) == pytest.approx(0.25 / 1.2, rel=0.2) and np.sum(weights * unit[:, 0] ** 4) > 0.205


@pytest.mark.parametrize("x", [0.1, 0.5, 1.0, 2.0])
def test_diffusion_constant_of_six_directions_is_exact(x):
    """A slow mode of the pure scattering lattice decays as exp(-D q^2 n), D = (h/3)(1/p_t - 1/2) per step = h/(3 x)."""
    q = 1e-4
    with jax.enable_x64(True):
        matrix = theta(LATTICES["paper"], x, 0.0)
    phases = np.exp(-1j * q * np.array(LATTICES["paper"].directions)[:, 0])
    slow = max(abs(np.linalg.eigvals(phases[:, None] * matrix)))
    assert -np.log(slow) / q**2 == pytest.approx(1 / (3 * x), rel=1e-5)


def _decay_per_mean_free_path(name, x, albedo, kind="pade"):
    """kappa of phi ~ exp(-kappa z) from the lattice: 1 = k * transfer(kappa), k = albedo x."""
    lat = LATTICES[name]
    lengths, weights = lat.lengths, lat.weights
    steps = np.array(lat.directions)[:, 2]
    beta, gamma = (np.asarray(v, float) for v in beta_gamma(jnp.asarray(x * lengths), kind))

    def defect(kappa):
        growth = np.exp(kappa * x * steps)  # f_i(r + c_i) = passing f_i(r) + w beta s(r) on the mode exp(-kappa x z)
        f = weights * beta / (1 / growth - (1 - x * lengths * beta))
        return albedo * x * np.sum(lengths * (beta * f + weights * gamma)) - 1

    return brentq(defect, 1e-6, 0.97 if albedo < 0.95 else 0.5)


def _exact_decay(albedo):
    return brentq(lambda k: albedo / (2 * k) * np.log((1 + k) / (1 - k)) - 1, 1e-9, 1 - 1e-12)


def test_decay_constant_against_exact_transport():
    assert _exact_decay(0.9) == pytest.approx(0.5254295127, abs=1e-9)  # T2
    assert _decay_per_mean_free_path("26", 0.25, 0.9) == pytest.approx(_exact_decay(0.9), rel=5e-3)
    assert _decay_per_mean_free_path("26", 0.5, 0.99) == pytest.approx(_exact_decay(0.99), rel=2e-3)
    six = _decay_per_mean_free_path("paper", 0.5, 0.9) / _exact_decay(0.9) - 1
    assert -0.06 < six < -0.03  # inherent to six directions: -4.3 %


def test_mean_square_displacement_without_absorption():
    """T10: <r^2>(n) = n (1 + q)/(1 - q) - 2 q (1 - q^n)/(1 - q)^2, q = 1 - p_s, one impulse in six directions."""
    n, p, size = 9, 0.4, 21
    x = p / (1 - p / 2)
    lat = LATTICES["paper"]
    middle = size // 2
    with jax.enable_x64(True):
        co = coefficients(lat, jnp.asarray(x, jnp.float64), jnp.asarray(0.0, jnp.float64))
        g = np.zeros((size + 2, size, size))
        g[middle + 1, middle, middle] = 1 / 6
        state = tuple(jnp.asarray(g) for _ in lat.directions)
        dark = jnp.zeros((size,) * 3)
        state = stepping.steps(lat, co, dark, state, (n - 1) // 2)
        total = np.asarray(sum(stepping.arrivals(lat, state)))
    assert total.dtype == np.float64 and total.sum() == pytest.approx(1, abs=1e-12)
    axis = np.arange(size) - middle
    square = axis[:, None, None] ** 2 + axis[None, :, None] ** 2 + axis[None, None, :] ** 2
    q = 1 - p
    expected = n * (1 + q) / (1 - q) - 2 * q * (1 - q**n) / (1 - q) ** 2
    assert np.sum(total * square) == pytest.approx(expected, abs=1e-12)


def test_linear_map_diverges_where_pade_does_not():
    """p = sigma h is no map: at sigma h = 2.1 its step grows, the Pade map stays stable up to 6."""

    def radius(matrix):
        worst = 0.0
        directions = np.array(LATTICES["paper"].directions)
        for wave in np.linspace(0, np.pi, 9):
            phases = np.exp(-1j * directions @ np.array([wave, wave, wave]))
            worst = max(worst, max(abs(np.linalg.eigvals(phases[:, None] * matrix))))
        return worst

    assert radius(np.full((6, 6), 2.1 / 6) + np.eye(6) * (1 - 2.1)) > 1.05
    assert radius(theta(LATTICES["paper"], 5.9, 0.1)) < 1.0
    assert np.min(theta(LATTICES["paper"], 5.9, 0.1)) < 0 <= np.min(theta(LATTICES["paper"], 5.9, 0.1, kind="exp"))


@pytest.mark.parametrize(("x", "ratio"), [(0.1, 0.95), (0.5, 0.75), (1.0, 0.5)])
def test_linear_map_halves_the_diffusion_constant(x, ratio):
    """Why sigma h is no probability: D = (h/3)(1/p - 1/2) with p = x against h/(3 x)."""
    q = 1e-3
    phases = np.exp(-1j * q * np.array(LATTICES["paper"].directions)[:, 0])
    slow = max(abs(np.linalg.eigvals(phases[:, None] * (np.full((6, 6), x / 6) + np.eye(6) * (1 - x)))))
    assert -np.log(slow) / q**2 * 3 * x == pytest.approx(ratio, rel=1e-3)
