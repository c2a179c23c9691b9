"""Multiple scattering: exact Green's functions, invariants, the integral equation, Chandrasekhar's H function."""

import numpy as np
import pytest

from jaxvol import harmonics
from jaxvol.fit import assemble, green, half_space, validation, wavenumber, zonal_tables
from tests import problems_tables as problems

ISOTROPIC = np.ones(1)
RADII = np.array(problems.RADII)


def fluence(tau, **keywords):
    return np.sqrt(4 * np.pi) * wavenumber.point_table(tau, order=1, **keywords)[:, 0]


@pytest.mark.parametrize("k", problems.BOUNCES)
def test_closed_form_of_bounces(k):
    np.testing.assert_allclose(green.fluence_bounce(RADII, k), problems.BOUNCES[k], rtol=6e-9)  # nine printed digits


@pytest.mark.parametrize("albedo", problems.TOTAL)
def test_closed_form_of_the_sum(albedo):
    kappa, values = problems.TOTAL[albedo]
    assert abs(green.diffusion_root(albedo) - kappa) < 1e-10
    np.testing.assert_allclose(green.fluence_total(RADII, albedo), values, rtol=6e-9)  # nine printed digits
    power_one = green.fluence_total(np.array([0.5, 1, 2, 5, 10]), albedo) / (4 * np.pi)
    np.testing.assert_allclose(power_one, problems.TOTAL_T2[albedo], rtol=5e-8)


@pytest.mark.parametrize(("albedo", "limit"), [(0.5, 5e-6), (0.9, 5e-6), (0.99, 1e-4)])
def test_operator_against_case(albedo, limit):
    """Issue: within 5e-6 (c = 0.5, 0.9) and 1e-4 (0.99) of Case's solution out to 10 mean free paths. Reached: 1e-9."""
    tau = np.concatenate([np.geomspace(0.01, 10, 24), [3.99, 4.01]])
    total = np.exp(-tau) / tau**2 + albedo * fluence(tau, moments=ISOTROPIC, albedo=albedo, first=1)
    assert np.max(np.abs(total / green.fluence_total(tau, albedo) - 1)) < min(limit, 1e-8)


def test_summed_bounces_against_case():
    """The bounces one by one, 60 of them at c = 0.5, are the sum."""
    total = fluence(RADII, moments=ISOTROPIC, albedo=0.5, first=1, last=60)
    expected = (green.fluence_total(RADII, 0.5) - np.exp(-RADII) / RADII**2) / 0.5
    np.testing.assert_allclose(total, expected, rtol=5e-6)


@pytest.mark.parametrize("n", [1, 2, 3, 6, 12])
def test_single_bounces_against_closed_form(n):
    found = fluence(RADII, moments=ISOTROPIC, albedo=1.0, first=n, last=n)
    np.testing.assert_allclose(found, green.fluence_bounce(RADII, n), rtol=1e-8)


@pytest.mark.parametrize("g", [0.0, 0.5, -0.5, 0.9])
def test_first_bounce_is_the_half_angle_table(g):
    tau = np.array([0.01, 1.0, 20.0])
    found = wavenumber.point_table(tau, moments=wavenumber.effective_moments(g), albedo=1.0, first=1, last=1)
    expected = zonal_tables.unscale_point(zonal_tables.point_table(tau, g=g, num_nodes=140), tau)
    np.testing.assert_allclose(found, expected, rtol=1e-9)


def test_scattered_lists():
    for g, lists, rtol in ((0.0, problems.SCATTERED_ISOTROPIC, 5e-6), (0.5, problems.SCATTERED_HG, 1e-5)):
        tau = np.array(list(lists))
        found = 0.9 * wavenumber.point_table(tau, moments=wavenumber.effective_moments(g), albedo=0.9, order=4, first=1)
        np.testing.assert_allclose(found, list(lists.values()), rtol=rtol)
    for bounce, values in ((2, problems.BOUNCE_2), (4, problems.BOUNCE_4)):
        found = wavenumber.point_table([1.0], moments=ISOTROPIC, albedo=1.0, order=len(values), first=bounce, last=bounce)
        np.testing.assert_allclose(found[0], values, atol=6e-8)


@pytest.mark.parametrize("albedo", problems.TOTAL_HG)
def test_henyey_greenstein_list(albedo):
    total = np.exp(-RADII) / RADII**2 + albedo * fluence(
        RADII, moments=wavenumber.effective_moments(0.5), albedo=albedo, first=1
    )
    np.testing.assert_allclose(total, problems.TOTAL_HG[albedo], rtol=5e-6)


def radial_integrals(table, limit):
    """int 4 pi r^2 phi dr and the mean of r^2, phi = table(r)."""
    node, weight = np.polynomial.legendre.leggauss(16)
    edges = np.concatenate([[1e-7], np.geomspace(1e-3, limit, 28)])
    half = np.diff(edges)[:, None] / 2
    r = (edges[:-1, None] + half * (1 + node)).ravel()
    shell = 4 * np.pi * r * r * table(r) * (half * weight).ravel()
    return shell.sum(), (shell * r * r).sum() / shell.sum()


@pytest.mark.parametrize(("g", "n"), [(0.5, 1), (0.5, 3), (-0.5, 2), (0.9, 2), (-0.9, 3)])
def test_energy_and_mean_square_of_bounces(g, n):
    """Issue: energy and <r^2> of HG bounces within 1e-5, |g| up to 0.9."""
    moments = wavenumber.effective_moments(g)
    energy, square = radial_integrals(lambda r: fluence(r, moments=moments, albedo=1.0, first=n, last=n), 60.0)
    flights = n + 1
    expected = 2 * flights + 2 * (flights * g / (1 - g) - g * (1 - g**flights) / (1 - g) ** 2)
    assert abs(energy / (4 * np.pi) - 1) < 1e-5
    assert abs(square / expected - 1) < 1e-5


def test_energy_and_mean_square_of_the_sum():
    """T2a: <r^2> = 2 / ((1 - c)(1 - c g)); c = 0.8, g = 0.6: 19.231."""
    moments, c = wavenumber.effective_moments(0.6), 0.8
    energy, square = radial_integrals(lambda r: np.exp(-r) / r**2 + c * fluence(r, moments=moments, albedo=c, first=1), 120.0)
    assert abs(energy * (1 - c) / (4 * np.pi) - 1) < 1e-5
    assert abs(square / (2 / ((1 - c) * (1 - c * 0.6))) - 1) < 1e-5


@pytest.mark.parametrize(("g", "num"), [(0.5, 24), (0.9, 128), (-0.9, 128)])
def test_number_of_moments(g, num):
    """Issue: phi(r) at NL against 2 NL moments within 1e-4, |g| up to 0.9."""
    tau = np.array([0.1, 1.0, 3.0, 10.0])
    found = [fluence(tau, moments=g ** np.arange(n), albedo=0.9, first=1) for n in (num, 2 * num)]
    assert np.max(np.abs(found[0] / found[1] - 1)) < 1e-4
    too_few = fluence(tau, moments=g ** np.arange(2), albedo=0.9, first=1)
    assert np.max(np.abs(too_few / found[1] - 1)) > 1e-2  # energy and <r^2> alone would not notice


@pytest.mark.parametrize("g", [0.0, 0.5])
def test_point_solution_satisfies_the_integral_equation(g):
    moments = wavenumber.effective_moments(g, tolerance=1e-7)
    found = wavenumber.point_table([1.3], moments=moments, albedo=0.9)[0]
    gathered = validation.gathered_point(1.3, moments=moments, albedo=0.9, order=11)
    assert np.max(np.abs(found - gathered)) < 1e-6 * gathered[0]


def test_area_bounces_by_source_moments():
    """Projected on y_km of the normal, the exact area table is the wavenumber solution's source moment."""
    tau, bands, order = np.array([0.05, 1.0, 6.0]), (0, 1, 2, 4), 4
    moments = wavenumber.effective_moments(0.5)
    response = wavenumber.moment_responses(tau, moments=moments, albedo=1.0, source_bands=bands, order=order, first=1, last=1)
    x, w = np.polynomial.legendre.leggauss(16)
    theta = np.concatenate([(x + 1) * np.pi / 4, np.pi / 2 + (x + 1) * np.pi / 4])
    weight = np.concatenate([w, w]) * np.pi / 4 * np.sin(theta)
    table = zonal_tables.unscale_point(zonal_tables.area_table(tau, theta, order=order, g=0.5), tau)
    y = harmonics.normalised_legendre(np.cos(theta), 5)
    for index, (band, m) in enumerate(harmonics.half_index(order)):
        for column, k in enumerate(bands):
            if m <= k:
                along = weight * y[k, m] * np.sin(theta) ** m
                projected = (table[:, :, index] * along).sum(axis=1) * (2 * np.pi if m == 0 else np.pi)
                found = harmonics.clamped_cosine(5)[k] * harmonics.rotation_norm(5)[k] * response[:, band, column, m]
                assert np.max(np.abs(found - projected) / table[:, 0, 0]) < 1e-6, (band, m, k)


def test_reciprocity_of_source_and_receiver_moments():
    """R_lkm = R_klm: source and receiver may be swapped, as their frames look at each other."""
    response = wavenumber.moment_responses(
        [0.7], moments=wavenumber.effective_moments(0.6), albedo=0.8, source_bands=(0, 1, 2, 3), order=4
    )[0]
    for m in range(4):
        block = response[m:, m:, m]
        np.testing.assert_allclose(block, block.T, rtol=1e-9, atol=1e-12 * abs(block).max())
    assert abs(response[2, 1, 0]) > 1e-4


def test_patches_of_every_orientation_are_a_point():
    node, weight = np.polynomial.legendre.leggauss(12)
    moments = wavenumber.effective_moments(0.3)
    table = assemble.area_response([0.5], np.arccos(node), moments=moments, albedo=0.7, order=5, source_bands=8)
    zonal = [i for i, (_, m) in enumerate(harmonics.half_index(5)) if m == 0]
    point = wavenumber.point_table([0.5], moments=moments, albedo=0.7, order=5)
    np.testing.assert_allclose(weight / 2 @ table[0][:, zonal], point[0] / 4, rtol=1e-10)


@pytest.mark.parametrize("albedo", problems.H_FUNCTION)
def test_half_space_is_chandrasekhars(albedo):
    """T3: fluence at the top is H(1); absorption (1-c) int J dz = H(1) sqrt(1-c)."""
    rate, _, coefficients = half_space.source_function(albedo, ISOTROPIC)
    h = problems.H_FUNCTION[albedo]
    assert abs(1 + albedo * coefficients.sum().real - h) < 1e-7
    absorbed = (1 - albedo) * (1 + albedo * np.sum(coefficients / rate).real)
    assert abs(absorbed - h * np.sqrt(1 - albedo)) < 1e-7


@pytest.mark.parametrize("g", [0.0, -0.5, 0.7])
def test_half_space_satisfies_the_integral_equation(g):
    moments = wavenumber.effective_moments(g, tolerance=1e-7)
    streams = half_space.streams_for(moments)
    found = half_space.directional_table([1.3], moments=moments, albedo=0.9, num_streams=streams)[0]
    gathered = validation.gathered_directional(1.3, moments=moments, albedo=0.9, order=11)
    assert np.max(np.abs(found - gathered)) < 1e-6 * gathered[0]


def test_half_space_bounces_sum_up():
    tau, c = np.array([0.0, 0.1, 1.0, 5.0]), 0.4
    bounces = half_space.bounce_tables(tau, moments=ISOTROPIC, num_bounces=30, num_streams=32)
    total = half_space.directional_table(tau, moments=ISOTROPIC, albedo=c, num_streams=32)
    summed = np.sum(bounces * c ** np.arange(29)[:, None, None], axis=0)
    assert np.max(np.abs(summed - total) / total[:, :1]) < 1e-8


def test_similarity_theory_is_as_wrong_as_specified():
    """Specification section 3: ratio of similarity theory to the exact total at c = 0.9, g = 0.5: 1.019 1.050 .996 .985."""
    c, g = 0.9, 0.5
    extinction = 1 - c + (1 - g) * c
    similar = extinction**2 * green.fluence_total(extinction * RADII, (1 - g) * c / extinction)
    similar += np.exp(-RADII) / RADII**2 - np.exp(-extinction * RADII) / RADII**2
    exact = np.exp(-RADII) / RADII**2 + c * fluence(RADII, moments=wavenumber.effective_moments(g), albedo=c, first=1)
    assert np.all(np.abs(similar / exact - 1) < 0.12)


def test_bad_input():
    with pytest.raises(ValueError, match="albedo"):
        wavenumber.point_table([1.0], moments=ISOTROPIC, albedo=1.0)
    with pytest.raises(ValueError, match="tau"):
        wavenumber.point_table([0.0], moments=ISOTROPIC, albedo=0.5)
    with pytest.raises(ValueError, match="bounces"):
        wavenumber.point_table([1.0], moments=ISOTROPIC, albedo=0.5, first=3, last=2)
    with pytest.raises(ValueError, match="g = -1"):
        wavenumber.effective_moments(-1.0)
    with pytest.raises(ValueError, match="albedo"):
        half_space.directional_table([1.0], moments=ISOTROPIC, albedo=1.0)
    with pytest.raises(ValueError, match="albedo"):
        green.diffusion_root(0.0)
