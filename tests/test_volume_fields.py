"""Procedural densities: what makes them smoke, cloud and checkerboard, in numbers."""

import time

import numpy as np
import pytest

from jaxvol.volumes import NAMES, procedural


@pytest.fixture(scope="module")
def plume():
    return procedural("plume", resolution=64, seed=1).density


@pytest.fixture(scope="module")
def cumulus():
    return procedural("cumulus", resolution=64, seed=1).density


@pytest.mark.parametrize("name", NAMES)
def test_fields_are_densities_in_their_box_and_depend_on_the_seed_alone(name):
    a = procedural(name, resolution=(20, 40, 10), seed=3)
    assert a.density.shape == (20, 40, 10) and a.density.dtype == np.float32
    assert a.density.min() == 0 and 0.3 < a.density.max() <= 1
    np.testing.assert_array_equal(a.bounds, [[-0.25, 0, -0.125], [0.25, 1, 0.125]])
    np.testing.assert_array_equal(procedural(name, resolution=(20, 40, 10), seed=3).density, a.density)
    other = procedural(name, resolution=(20, 40, 10), seed=4)
    assert np.array_equal(other.density, a.density) == (name == "checker")


@pytest.mark.parametrize("name", ["plume", "cumulus"])
def test_a_finer_resolution_shows_the_same_field(name):
    coarse, fine = (procedural(name, resolution=n, seed=2).density for n in (64, 96))
    means = [
        d.reshape(16, n // 16, 16, n // 16, 16, n // 16).mean(axis=(1, 3, 5)) for d, n in ((coarse, 4 * 16), (fine, 6 * 16))
    ]
    assert np.corrcoef(means[0].ravel(), means[1].ravel())[0, 1] > 0.98


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("resolution", [1, 2, (1, 9, 3)])
def test_tiny_resolutions(name, resolution):
    density = procedural(name, resolution=resolution).density
    assert np.isfinite(density).all() and density.min() >= 0


def test_the_plume_rises_widens_and_stays_inside(plume):
    column = plume.sum(axis=(0, 2))
    assert (column[:50] > 0).all() and plume[:, -1].max() < 1e-2  # from the floor, gone below the ceiling
    assert max(plume[0].max(), plume[-1].max(), plume[:, :, 0].max(), plume[:, :, -1].max()) < 1e-2
    x = np.broadcast_to(np.arange(64)[:, None] / 64, (64, 64))
    spread = [np.sqrt(np.average((x - np.average(x, weights=w)) ** 2, weights=w)) for w in (plume[:, 2], plume[:, 40])]
    assert spread[1] > 2.5 * spread[0]


def test_the_plume_is_no_blob(plume):
    """Smoke is folded: its level sets have far more surface than a ball of the same volume, and holes of clear air."""

    def surface(solid):
        return sum(np.sum(np.diff(solid.astype(int), axis=axis) != 0) for axis in range(3))

    solid = plume > 0.1
    grid = np.indices(plume.shape) - 31.5
    radius = (3 * solid.sum() / (4 * np.pi)) ** (1 / 3)
    assert surface(solid) > 2.5 * surface((grid**2).sum(axis=0) <= radius**2)
    inside = solid.any(axis=2)
    rows = [row for row in inside.T if row.any()]
    filled = sum(row.sum() for row in rows) / sum(np.ptp(np.flatnonzero(row)) + 1 for row in rows)
    assert filled < 0.97  # lines through its silhouette meet gaps


def test_the_cloud_has_a_flat_base_and_a_bumpy_top(cumulus):
    cloudy = cumulus > 0.2
    columns = cloudy.any(axis=1) & (cloudy.sum(axis=1) > 8)  # away from the thin rim
    base, top = cloudy.argmax(axis=1)[columns], (64 - cloudy[:, ::-1].argmax(axis=1))[columns]
    assert np.percentile(base, 75) - np.percentile(base, 25) <= 2 < top.std()
    height = np.where(cloudy.any(axis=1), 64 - cloudy[:, ::-1].argmax(axis=1), np.nan)
    bumps = height[1:-1] > np.maximum(height[:-2], height[2:])
    assert bumps.sum() > 40  # local maxima along x: billows, no dome
    assert max(cumulus[0].max(), cumulus[-1].max(), cumulus[:, 0].max(), cumulus[:, -1].max()) == 0


def test_the_checkerboard_alternates():
    density = procedural("checker", resolution=16).density
    for (i, j, k), value in np.ndenumerate(density):
        assert value == (i // 2 + j // 2 + k // 2) % 2


@pytest.mark.parametrize("name", ["plume", "cumulus"])
def test_fields_take_a_moment_only(name):
    start = time.process_time()
    procedural(name, resolution=128)
    assert time.process_time() - start < 6  # 1.5 s and 0.5 s on an idle machine


@pytest.mark.parametrize(
    ("name", "options", "problem"),
    [
        ("smoke", {}, "there are plume, cumulus, checker"),
        ("plume", {"resolution": 0}, "from 1 to 1024"),
        ("plume", {"resolution": 2000}, "from 1 to 1024"),
        ("plume", {"resolution": (8, 8)}, "one or three"),
        ("plume", {"resolution": 8.5}, "whole numbers"),
        ("plume", {"resolution": "big"}, "whole numbers"),
        ("plume", {"seed": -1}, "seed = -1"),
        ("plume", {"seed": 0.5}, "whole numbers"),
    ],
)
def test_bad_options(name, options, problem):
    with pytest.raises(ValueError, match=problem):
        procedural(name, **options)
