"""Random walks against exact moments of the fluence, and what must not depend on batches."""

import numpy as np
import pytest

from jaxvol.methods.instant_multiple_scattering import incremental, light_paths, virtual_lights
from tests.methods.instant_multiple_scattering.scenes import lit, make_medium


def walk(scene, *, number=2048, seed=5, max_depth=256):
    return light_paths.trace(scene, None, seed=seed, paths=np.arange(number), max_depth=max_depth)


def integral(vertices, number, power=0):
    """Integral of the fluence times r^power: every collision is a sample of it, of weight L_i."""
    r = np.linalg.norm(vertices.position, axis=-1)
    return np.sum(vertices.incident * (r**power)[:, None], axis=0, dtype=np.float64) / number


@pytest.mark.parametrize("g", [0.0, 0.6])
def test_moments_of_the_fluence(g):
    """T2a: integral of phi = 1 / (1 - c); <r^2> = 2 / ((1 - c)(1 - c g)); here per channel, c = .8, .5, .2."""
    medium = make_medium(sigma_s=(0.8, 0.5, 0.2), sigma_a=(0.2, 0.5, 0.8), g=g, half=40.0)
    number = 2048
    vertices, counts = walk(lit(medium), number=number)
    c = np.array([0.8, 0.5, 0.2])
    assert counts["num_truncated"] == 0
    total = integral(vertices, number)
    # Standard errors: about 2 % of the totals (geometric number of collisions), 4 % of the second moments.
    np.testing.assert_allclose(total, 1 / (1 - c), rtol=0.06)
    np.testing.assert_allclose(integral(vertices, number, 2) / total, 2 / ((1 - c) * (1 - c * g)), rtol=0.15)


def test_constant_grid_equals_homogeneous_also_per_channel():
    """T12, with channels 100:1 apart and one of albedo 0: totals in a box of 4 mean free paths, tracked and closed form."""
    settings = {"sigma_s": (2.0, 0.05, 0.0), "sigma_a": (0.5, 0.02, 0.025), "g": 0.3, "half": 1.0}
    number = 2048
    # Standard errors of the means of eight sets: 2.5 % in the thin channels, whose flights the thick one's samples serve badly.
    means = [
        np.mean([integral(walk(lit(medium), number=number, seed=seed)[0], number) for seed in range(8)], axis=0)
        for medium in (make_medium(**settings), make_medium(**settings, density=np.full((4, 4, 4), 1.0)))
    ]
    np.testing.assert_allclose(means[1], means[0], rtol=0.11)


def test_paths_do_not_depend_on_the_batch():
    scene = lit(make_medium(sigma_s=(2.0,) * 3, half=2.0))
    many, _ = walk(scene, number=200)
    few, _ = light_paths.trace(scene, None, seed=5, paths=np.arange(100, 150), max_depth=256)
    same = (many.path >= 100) & (many.path < 150)
    assert np.array_equal(many.path[same], few.path) and np.array_equal(many.depth[same], few.depth)
    np.testing.assert_allclose(many.position[same], few.position, atol=1e-5)


def test_truncation_is_counted():
    scene = lit(make_medium(sigma_s=(20.0,) * 3, sigma_a=(0.0,) * 3, half=2.0))
    vertices, counts = walk(scene, number=64, max_depth=16)
    assert counts["num_truncated"] == 64
    assert vertices.depth.max() == 15


@pytest.mark.parametrize("density", [None, np.zeros((4, 4, 4))])
def test_nothing_to_scatter_gives_no_lights(density):
    medium = make_medium(sigma_s=(0.0,) * 3, sigma_a=(0.0,) * 3) if density is None else make_medium(density=density)
    vertices, counts = walk(lit(medium), number=64)
    assert len(vertices.path) == 0 and counts["num_truncated"] == 0
    assert not virtual_lights.blocks(virtual_lights.virtual_lights(lit(medium), vertices, num_paths=64))


def test_lattice_coordinates_fill_the_unit_interval():
    for dimension in range(10):
        u = np.sort(np.asarray(light_paths.lattice(np.arange(256, dtype=np.uint32), seed=np.uint32(3), dimension=dimension)))
        assert 0 < u[0] and u[-1] < 1
        assert np.max(np.diff(u)) < 1.001 / 256 + 1e-6  # an odd multiplier permutes the 256 strata


def test_reweighted_paths_are_paths_of_the_new_medium():
    """Fluence totals of a medium of another density and albedo from the old one's paths; identity for the same medium."""
    old = lit(make_medium(half=40.0))
    new = lit(make_medium(sigma_s=(0.63, 0.72, 0.8), sigma_a=(0.27, 0.18, 0.2), half=40.0))
    number = 2048
    vertices, _ = walk(old, number=number)
    same = incremental.reweighted(old, old, vertices, seed=5)
    np.testing.assert_allclose(same.incident, vertices.incident, rtol=1e-5)
    moved = incremental.reweighted(old, new, vertices, seed=5)
    sigma = np.asarray(new.medium.sigma_s + new.medium.sigma_a)
    expected = 1 / (sigma * (1 - np.asarray(new.medium.sigma_s) / sigma))
    np.testing.assert_allclose(integral(moved, number), expected, rtol=0.1)


def test_a_share_of_the_paths_is_renewed_each_frame():
    paths = np.arange(100)
    gone = []
    for frame in range(4):
        paths, out = incremental.renewed(paths, frame=frame, share=0.25, num_paths=100)
        gone.append(out)
    assert all(len(g) == 25 for g in gone)
    assert np.array_equal(np.sort(paths), np.arange(100) + 100)
