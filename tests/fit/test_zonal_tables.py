"""Single-scattering tables against printed lists, closed forms and an independent quadrature."""

import numpy as np
import pytest
from scipy.integrate import quad

from jaxvol import airlight, harmonics
from jaxvol.fit import green, monte_carlo, phase_moments, validation, zonal_tables
from tests.problems_tables import AREA, DIRECTIONAL, POINT, POINT_G

TAU = np.concatenate([[1e-8, 600.0], np.geomspace(1e-4, 50, 30)])


@pytest.mark.parametrize("tau", POINT)
def test_point_lists(tau):
    found = zonal_tables.unscale_point(zonal_tables.point_table(tau), tau)[0]
    np.testing.assert_allclose(found, POINT[tau], rtol=2e-8)


@pytest.mark.parametrize("g", POINT_G)
def test_point_lists_with_henyey_greenstein(g):
    found = zonal_tables.unscale_point(zonal_tables.point_table(1.0, order=4, g=g), 1.0)[0]
    np.testing.assert_allclose(found, POINT_G[g], atol=5.1e-11)


@pytest.mark.parametrize("tau", DIRECTIONAL)
def test_directional_lists(tau):
    found = zonal_tables.directional_table(tau, order=4)[0] * np.exp(-tau)
    np.testing.assert_allclose(found, DIRECTIONAL[tau], rtol=3e-8)


def test_area_list():
    """To the printed digits but for L_10, whose last digit is wrong: .0410634 printed, .0410635 by both quadratures."""
    found = zonal_tables.unscale_point(zonal_tables.area_table(1.0, np.pi / 3), 1.0)[0, 0]
    independent = validation.area_entry(1.0, np.pi / 3, moments=np.ones(1), order=3) * np.exp(-1)
    np.testing.assert_allclose(found[:6], independent, atol=2e-9)
    right = [0, 2, 3, 4, 5]
    np.testing.assert_allclose(found[right], np.array(AREA)[right], atol=5.1e-8)
    assert abs(found[1] - 0.04106353) < 6e-9
    # the list's irradiance .0991855 is that of order 11 (its own last digit uses its L_10); the exact one is smaller
    zonal = [i for i, (_, m) in enumerate(harmonics.half_index(11)) if m == 0]
    coefficients = zonal_tables.unscale_point(zonal_tables.area_table(1.0, np.pi / 3, order=11), 1.0)[0, 0, zonal]
    assert abs(harmonics.clamped_cosine(11) @ coefficients - 0.0991855) < 1.1e-7
    nodes = airlight.area_nodes(150, np.pi / 3)
    emission = airlight.area_emission(nodes, np.pi / 3, 1)[:, 0]
    exact = np.sum(2 * nodes.weight * emission * np.maximum(nodes.cos_receiver, 0) * np.exp(-1 - nodes.excess))
    assert abs(exact - 0.0990614) < 3e-7


def test_point_within_1e8_over_all_tau():
    """Issue: 1e-8 relative per coefficient of the scaled form, tau in [1e-8, 600]."""
    for g, finer in ((0.0, 160), (0.5, 160), (-0.9, 200), (0.9, 200)):
        error = zonal_tables.point_table(TAU, g=g) / zonal_tables.point_table(TAU, g=g, num_nodes=finer) - 1
        assert np.abs(error).max() < 1e-8, g


def test_directional_within_1e8_over_all_tau():
    found, finer = zonal_tables.directional_table(TAU), zonal_tables.directional_table(TAU, num_nodes=260)
    assert np.max(np.abs(found - finer) / finer[:, :1]) < 1e-8


def test_area_within_1e6_over_all_tau():
    theta = np.radians([0, 20, 60, 89.9, 90, 95, 150, 180])
    found = zonal_tables.area_table(TAU[::2], theta, order=11)
    finer = zonal_tables.area_table(TAU[::2], theta, order=11, num_nodes=110)
    assert np.max(np.abs(found - finer) / finer[..., :1]) < 1e-6


def test_band_zero_is_the_closed_form():
    tau = np.array([0.05, 1.0, 5.0])
    fluence = np.sqrt(4 * np.pi) * zonal_tables.unscale_point(zonal_tables.point_table(tau, order=1), tau)[:, 0]
    np.testing.assert_allclose(fluence, green.fluence_bounce(tau, 1), rtol=1e-11)
    direct = [quad(lambda s, t: np.exp(-s * t) / s * np.log((s + 1) / (s - 1)), 1, np.inf, args=(t,))[0] / t for t in tau]
    np.testing.assert_allclose(fluence, direct, rtol=1e-6)


@pytest.mark.parametrize("tau", [1e-6, 0.03, 1.0, 15.0])
def test_point_against_independent_quadrature(tau):
    moments = phase_moments.henyey_greenstein(-0.4, 60)
    truth = validation.point_entry(tau, moments=moments, order=11)
    np.testing.assert_allclose(zonal_tables.point_table(tau, g=-0.4)[0], truth, rtol=1e-9)


@pytest.mark.parametrize(("tau", "theta"), [(0.01, 1.0), (1.0, 2.5)])
def test_area_against_independent_quadrature(tau, theta):
    truth = validation.area_entry(tau, theta, moments=np.ones(1), order=5)
    found = zonal_tables.area_table(tau, theta)[0, 0]
    assert np.max(np.abs(found - truth)) < 1e-6 * truth[0]


def test_directional_against_independent_quadrature():
    moments = phase_moments.henyey_greenstein(0.3, 40)
    truth = validation.directional_entry(0.8, moments=moments, order=11)
    assert np.max(np.abs(zonal_tables.directional_table(0.8, g=0.3)[0] - truth)) < 1e-8 * truth[0]


def test_moment_tables_sum_to_henyey_greenstein():
    """Truncation |g|^(J+1): J = 16 at g = 0.4 is 2e-8 (specification section 5)."""
    tau = np.array([0.1, 1.0, 5.0])
    chi = phase_moments.henyey_greenstein(0.4, 24)
    point = zonal_tables.point_moment_table(tau, num_moments=24) @ chi
    np.testing.assert_allclose(point, zonal_tables.point_table(tau, g=0.4), rtol=1e-7)
    directional = zonal_tables.directional_moment_table(tau, num_moments=24) @ chi
    assert np.max(np.abs(directional - zonal_tables.directional_table(tau, g=0.4))) < 1e-7
    area = zonal_tables.area_moment_table(tau, [1.0], num_moments=24) @ chi
    assert np.max(np.abs(area - zonal_tables.area_table(tau, [1.0], g=0.4))) < 1e-7


def test_three_g_interpolation_has_the_papers_error():
    exact = zonal_tables.point_table(1.0, g=0.25)[0]
    moments = zonal_tables.point_moment_table(1.0, num_moments=40)[0]
    worst = np.max(np.abs(moments @ phase_moments.three_g(0.25, 0.5, 40) / exact - 1))
    assert 0.05 < worst < 0.15  # specification: 0.11
    assert np.max(np.abs(moments @ phase_moments.three_g(0.5, 0.5, 40) / zonal_tables.point_table(1.0, g=0.5)[0] - 1)) < 1e-6


def test_patch_facing_its_receiver_is_zonal():
    table = zonal_tables.area_table(1.0, [0.0, np.pi])[0]
    azimuthal = [m for _, m in harmonics.half_index(5)]
    assert np.max(np.abs(table[:, np.array(azimuthal) > 0])) < 1e-12
    assert np.all(table[:, 0] > 0)  # light scattered back from behind the patch


def test_monte_carlo_agrees():
    found = monte_carlo.point(1.0, num_samples=4096, num_repeats=16)
    truth = zonal_tables.unscale_point(zonal_tables.point_table(1.0), 1.0)[0]
    assert np.all(found.standard_error < 0.003 * truth)
    assert np.all(np.abs(found.mean - truth) < 4 * found.standard_error)
    with pytest.raises(ValueError, match="sampling"):
        monte_carlo.point(1.0, sampling="disc")


def test_float64_numpy_and_errors():
    assert zonal_tables.point_table(1.0).dtype == np.float64
    assert zonal_tables.directional_table(1.0).dtype == np.float64
    assert zonal_tables.area_table(1.0, 0.1).dtype == np.float64
    assert type(zonal_tables.point_table(1.0)) is np.ndarray
    with pytest.raises(ValueError, match="g = 1"):
        zonal_tables.point_table(1.0, g=1.0)
    with pytest.raises(ValueError, match="tau"):
        zonal_tables.point_table(-1.0)
    with pytest.raises(ValueError, match="theta_n"):
        zonal_tables.area_table(1.0, 4.0)
