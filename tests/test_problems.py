"""The formulas among the exact problems against the tables beside them."""

import numpy as np
import pytest

from tests import problems


@pytest.mark.parametrize("c", problems.POINT_SOURCE_FLUENCE)
def test_fluence_of_a_point_source(c):
    _, table = problems.POINT_SOURCE_FLUENCE[c]
    np.testing.assert_allclose(problems.point_source_fluence(problems.POINT_SOURCE_RADII, c), table, rtol=1e-7)


def test_radiance_of_a_point_source_holds_the_energy_of_its_fluence():
    """Radiance over all directions plus the unscattered light is the fluence."""
    node, weight = np.polynomial.legendre.leggauss(24)
    angle, weight = 0.5 * np.pi * (1 + node), 0.5 * np.pi * weight  # sin(angle) tames the rays close to the source
    c = 0.9
    directions = np.stack([-np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    scattered = [problems.point_source_radiance([1.0, 0, 0], d, c) for d in directions]
    unscattered = np.exp(-1.0) / (4 * np.pi)
    total = 2 * np.pi * (weight * np.sin(angle)) @ scattered + unscattered
    np.testing.assert_allclose(total, problems.point_source_fluence(1.0, c), rtol=1e-5)


def test_thick_slab_and_half_space():
    """The asymptote of thick slabs at tau = 8, and the plane albedo from the reflected radiance."""
    slab = problems.SLABS[2]
    assert abs(problems.thick_slab_reflectance(slab.tau, problems.HALF_SPACE_H_AT_1[-1]) - slab.reflectance) < 2e-5
    for c, h, albedo in zip(
        problems.HALF_SPACE_ALBEDOS, problems.HALF_SPACE_H_AT_1, problems.HALF_SPACE_PLANE_ALBEDO, strict=True
    ):
        assert abs(1 - h * np.sqrt(1 - c) - albedo) < 2e-6


def test_airlight_in_vacuum():
    endless = problems.airlight_in_vacuum(2.0, 0.3, 1e9)
    assert abs(endless / problems.airlight_without_extinction(2.0, 0.3) - 1) < 1e-8
