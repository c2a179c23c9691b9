"""Surfelisation: area, first moment, place and size of the disks."""

import numpy as np
import pytest

from jaxvol.methods.deep_screen_space import surfels as sf


@pytest.fixture(scope="module")
def triangles():
    rng = np.random.default_rng(1)
    vertices = rng.uniform(-1, 1, (24, 3)).astype(np.float32)
    return vertices, rng.permutation(24).reshape(8, 3)


@pytest.mark.parametrize("pattern", sf.PATTERNS)
def test_area_and_first_moment(triangles, pattern):
    vertices, faces = triangles
    cut = sf.subdivide(vertices, faces, np.array([0, 0, 4.0]), num_surfels=2000, pattern=pattern)
    cloud, lost = sf.tessellate(cut, capacity=2048, pattern=pattern)
    area = sf.areas(vertices[faces].astype(np.float64))
    assert int(lost) == 0
    assert 1500 < int(np.sum(cloud.valid)) <= 2000
    np.testing.assert_allclose(np.sum(cloud.area), area.sum(), rtol=1e-5)
    moment = np.sum(np.asarray(cloud.area)[:, None] * np.asarray(cloud.position), axis=0)
    np.testing.assert_allclose(moment, (area[:, None] * vertices[faces].mean(axis=1)).sum(axis=0), atol=2e-4)
    assert (np.asarray(cloud.area)[~np.asarray(cloud.valid)] == 0).all()


@pytest.mark.parametrize("pattern", sf.PATTERNS)
def test_surfels_lie_inside_their_triangles_and_apart(pattern):
    corners = np.array([[[0, 0, 0], [1, 0, 0], [0, 1, 0]]], np.float32)
    count = np.array([49 if pattern == "congruent" else (3 * 7**2 + 1) // 4])
    cut = sf.Triangles(corners=corners, face=np.array([0]), count=count)
    cloud, _ = sf.tessellate(cut, capacity=int(count[0]), pattern=pattern)
    x, y = np.asarray(cloud.position)[:, 0], np.asarray(cloud.position)[:, 1]
    assert (x > 0).all() and (y > 0).all() and (x + y < 1).all()
    gaps = np.hypot(x[:, None] - x, y[:, None] - y) + 10 * np.eye(len(x))
    assert gaps.min() > 0.03
    if pattern == "congruent":  # centroids of 49 congruent parts: each corner's part once, every one of area 1/98
        expected = {(3 * i + 1, 3 * j + 1) for i in range(7) for j in range(7 - i)}
        expected |= {(3 * i + 2, 3 * j + 2) for i in range(6) for j in range(6 - i)}
        assert {(round(21 * a), round(21 * b)) for a, b in zip(x, y, strict=True)} == expected


def test_integer_square_root():
    n = np.arange(0, 5000)
    roots = np.asarray(sf._isqrt(np.asarray(np.concatenate([n, n**2, n[1:] ** 2 - 1]), np.int32)))
    np.testing.assert_array_equal(roots, np.sqrt(np.concatenate([n, n**2, n[1:] ** 2 - 1]).astype(np.float64)).astype(int))


def test_equal_size_on_the_screen(triangles):
    """Disk radius over distance within 0.75 .. 1.3 of its median, also for grazing and back-facing triangles."""
    vertices, faces = triangles
    eye = np.array([0.2, 0.1, 1.6])
    cut = sf.subdivide(vertices, faces, eye, num_surfels=6000)
    cloud, _ = sf.tessellate(cut, capacity=6144)
    real = np.asarray(cloud.valid)
    size = np.sqrt(np.asarray(cloud.area)[real]) / np.linalg.norm(np.asarray(cloud.position)[real] - eye, axis=-1)
    ratio = size / np.median(size)
    assert ratio.min() > 0.75 and ratio.max() < 1.3


def test_splitting_keeps_the_surface_and_stops():
    corners = np.array([[[-50, 0, -50], [50, 0, -50], [0, 0, 80]]], np.float32)
    eye = np.array([0.0, 0.5, 0.0])
    parts, source = sf.split_large(corners, eye, max_ratio=0.35)
    edges = np.linalg.norm(np.roll(parts, -1, axis=1) - parts, axis=-1).max(axis=1)
    assert (edges <= 0.35 * sf.distances(parts, eye)).all() and (source == 0).all()
    np.testing.assert_allclose(sf.areas(parts).sum(), sf.areas(corners).sum(), rtol=1e-5)
    assert len(sf.split_large(corners, eye, max_ratio=0.35, max_triangles=20)[0]) <= 20


def test_camera_on_a_triangle_is_finite():
    corners = np.array([[[-1, -1, 0], [1, -1, 0], [0, 1, 0]]], np.float32)
    cut = sf.subdivide(corners[0], np.array([[0, 1, 2]]), corners[0].mean(axis=0), num_surfels=500)
    cloud, lost = sf.tessellate(cut, capacity=512)
    assert int(lost) == 0 and np.isfinite(np.asarray(cloud.position)).all()
    np.testing.assert_allclose(np.sum(cloud.area), 2.0, rtol=1e-4)


def test_overflow_is_reported(triangles):
    vertices, faces = triangles
    cut = sf.subdivide(vertices, faces, np.array([0, 0, 4.0]), num_surfels=2000)
    _, lost = sf.tessellate(cut, capacity=1024)
    assert int(lost) == int(cut.count.sum()) - 1024 > 0
