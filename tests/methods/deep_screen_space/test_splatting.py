"""The splat hierarchy: partitions, equality of forms, unbiasedness against all pairs, energy."""

import numpy as np
import pytest

from jaxvol.methods import deep_screen_space as method
from jaxvol.methods.deep_screen_space import framebuffer, splatting
from tests.methods.deep_screen_space.conftest import SMALL

BARE = SMALL | {"transport": "none", "blur": "none"}


def image(scene, camera, seed=0, **options):
    plan = method.plan(scene, camera, **(BARE | options))
    return np.asarray(method.render(scene, camera, plan, seed=seed).mean.volume_from_surface)


@pytest.mark.parametrize("level", [1, 2, 5])
def test_each_block_visits_every_sub_buffer_once(level):
    y, x = np.divmod(np.arange(64 * 64), 64)
    sub = framebuffer.sub_buffer_of(x, y, level=level, seed=7).reshape(64, 64)
    size = 2**level
    blocks = sub.reshape(64 // size, size, 64 // size, size).swapaxes(1, 2).reshape(-1, 4**level)
    assert (np.sort(blocks, axis=1) == np.arange(4**level)).all()
    assert len(np.unique(blocks, axis=0)) > 1 if len(blocks) > 1 else True


def test_every_pair_meets_with_the_same_probability():
    """Chi-square over 4096 seeds: a pixel's sub-buffer, a surfel's, and whether they agree, on level 1 (4 sub-buffers)."""
    x, y = np.array([3, 2, 17]), np.array([5, 4, 40])
    seeds = range(4096)
    pixels = np.array([framebuffer.sub_buffer_of(x, y, level=1, seed=s) for s in seeds])
    orders = np.array([framebuffer.surfel_order(16, level=1, seed=s) for s in seeds])  # [seeds, 4, runs]
    owner = np.array([[np.argwhere(o == s)[0, 0] for s in (0, 5, 11)] for o in orders])
    for pixel in range(3):
        assert chi_square(np.bincount(pixels[:, pixel], minlength=4)) < 16.3  # 0.1 % of chance with 3 degrees of freedom
        for surfel in range(3):
            meetings = np.bincount((pixels[:, pixel] - owner[:, surfel]) % 4, minlength=4)
            assert chi_square(meetings) < 16.3


def chi_square(counts):
    expected = counts.sum() / len(counts)
    return np.sum((counts - expected) ** 2) / expected


def test_tiles_hold_every_ray_once():
    rng = np.random.default_rng(0)
    pixel = np.flatnonzero(rng.random(40 * 30) < 0.4)
    tiles = framebuffer.make_tiles(
        pixel % 40, pixel // 40, level=2, seed=3, size=16, num_tiles=len(pixel) // 16 + 16, num_rays=len(pixel), stride=4
    )
    rays = tiles.ray.reshape(-1)
    assert sorted(rays[rays < len(pixel)]) == list(range(len(pixel)))
    assert (rays[tiles.slot] == np.arange(len(pixel))).all()
    sub = framebuffer.sub_buffer_of(pixel % 40, pixel // 40, level=2, seed=3)
    assert (tiles.sub_buffer[tiles.slot // 16] == sub).all()
    assert set(tiles.phase) == {0, 1, 2, 3}


def test_shells_double_and_the_last_is_open():
    first = np.array([0.1, 0.0], np.float32)
    inner, outer = zip(*(splatting.shell(first, level=l, num_levels=3, tail=True) for l in range(3)), strict=True)
    np.testing.assert_allclose(np.asarray(outer)[:, 0], [0.01, 0.04, np.inf])
    np.testing.assert_allclose(np.asarray(inner)[:, 0], [0.0, 0.01, 0.04])
    assert (np.asarray(outer)[:, 1] == 0).all()  # an unlit surfel reaches nothing


def test_first_radius_has_the_stated_contribution_at_the_edge():
    """Area L / R_0^2 = epsilon for the quadratic form; the paper's is r L / epsilon."""
    area, radiance = np.array([0.02], np.float32), np.array([[0.1, 0.5, 0.2]], np.float32)
    quadratic = splatting.first_radius(area, radiance, 0.06)
    np.testing.assert_allclose(0.02 * 0.5 / np.asarray(quadratic) ** 2, 0.06, rtol=1e-5)
    paper = splatting.first_radius(area, radiance, 0.06, radius="paper")
    np.testing.assert_allclose(paper, np.sqrt(0.02 / np.pi) * 0.5 / 0.06, rtol=1e-5)


def test_lists_equal_dense(cloud_scene, camera):
    lists = image(cloud_scene, camera, dense_from=3)
    dense = image(cloud_scene, camera, dense_from=0)
    assert dense.max() > 0
    np.testing.assert_allclose(lists, dense, atol=1e-6 * dense.max(), rtol=0)


def test_mean_over_seeds_is_all_pairs(cloud_scene, camera):
    """Also with every second sample only on the coarsest level; standard error below 0.3 %, within 3 of them."""
    reference = image(cloud_scene, camera, num_levels=1, strides=(1,), dense_from=0).sum()
    sums = np.array([image(cloud_scene, camera, seed=s, strides=(1, 1, 2)).sum() for s in range(24)]) / reference
    error = sums.std(ddof=1) / np.sqrt(len(sums))
    assert error < 0.003
    assert abs(sums.mean() - 1) < 3 * error, (sums.mean(), error)


def test_without_tail_only_the_far_pairs_are_missing(cloud_scene, camera):
    """The loss is the sum over pairs beyond the last radius: all pairs minus one level that ends there."""
    whole = image(cloud_scene, camera, num_levels=1, strides=(1,), dense_from=0)
    inside = image(cloud_scene, camera, num_levels=1, strides=(1,), dense_from=0, tail=False, epsilon=0.6 / 16)
    sums = np.array([image(cloud_scene, camera, seed=s, tail=False, epsilon=0.6).sum() for s in range(24)])
    assert inside.sum() < 0.99 * whole.sum()
    assert abs(sums.mean() - inside.sum()) < 3 * sums.std(ddof=1) / np.sqrt(len(sums))
