"""Camera conventions: where rows and columns go, field of view, and that projecting undoes generating."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxvol import camera as cameras
from jaxvol.types import Camera


def make(origin=(0.0, 0.0, 4.0), target=(0.0, 0.0, 0.0), up=(0.0, 1.0, 0.0), fov=40.0, height=12, width=16):
    return Camera(cameras.look_at(origin, target, up), jnp.float32(np.radians(fov)), height=height, width=width)


def test_look_at_is_rigid_and_right_handed():
    pose = np.asarray(cameras.look_at([1.0, 2.0, 3.0], [-2.0, 0.5, 7.0], [0.1, 1.0, 0.2]), np.float64)
    rotation = pose[:3, :3]
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-6)
    assert np.linalg.det(rotation) == pytest.approx(1.0, abs=1e-6)
    forward = np.array([-3.0, -1.5, 4.0]) / np.linalg.norm([-3.0, -1.5, 4.0])
    np.testing.assert_allclose(-rotation[:, 2], forward, atol=1e-6)
    right = np.cross(forward, [0.1, 1.0, 0.2])
    np.testing.assert_allclose(rotation[:, 0], right / np.linalg.norm(right), atol=1e-6)
    np.testing.assert_allclose(pose[:3, 3], [1.0, 2.0, 3.0])


def test_row_zero_is_the_top_and_x_goes_right():
    camera = make()
    centers = np.asarray(cameras.pixel_centers(camera))
    assert centers.shape == (12 * 16, 2)
    np.testing.assert_array_equal(centers[[0, 1, 16]], [[0.5, 0.5], [1.5, 0.5], [0.5, 1.5]])
    directions = np.asarray(cameras.generate_rays(camera, jnp.asarray(centers)).direction).reshape(12, 16, 3)
    assert np.all(np.diff(directions[5, :, 0]) > 0)  # right = cross(forward, up) = +x here
    assert np.all(np.diff(directions[:, 5, 1]) < 0)  # rows go down
    np.testing.assert_allclose(np.linalg.norm(directions, axis=-1), 1.0, atol=1e-6)


def test_fov_is_the_full_vertical_angle_and_pixels_are_square():
    camera = make(fov=60.0, height=10, width=30)
    edges = jnp.asarray([[15.0, 0.0], [15.0, 10.0], [15.0, 5.0], [16.0, 5.0], [15.0, 6.0]])
    rays = cameras.generate_rays(camera, edges)
    assert np.all(np.isinf(np.asarray(rays.t_max)))
    top, bottom, middle, right, down = np.asarray(rays.direction, np.float64)
    assert np.degrees(np.arccos(top @ bottom)) == pytest.approx(60.0, abs=1e-4)
    np.testing.assert_allclose(middle, [0.0, 0.0, -1.0], atol=1e-7)
    assert right[0] / -right[2] == pytest.approx(-down[1] / -down[2], rel=1e-5)


def test_project_undoes_generate_rays():
    rng = np.random.default_rng(1)
    camera = make(origin=(3.0, -2.0, 1.0), target=(0.5, 4.0, -2.0), up=(0.3, 0.2, 1.0), fov=75.0, height=90, width=160)
    pixel = rng.uniform([0, 0], [160, 90], (500, 2)).astype(np.float32)
    rays = cameras.generate_rays(camera, jnp.asarray(pixel))
    t = jnp.asarray(rng.uniform(0.1, 50.0, 500), jnp.float32)
    points = rays.origin + t[:, None] * rays.direction
    found, depth = cameras.project(camera, points)
    np.testing.assert_allclose(found, pixel, atol=2e-3)
    forward = -np.asarray(camera.world_from_camera[:3, 2])
    np.testing.assert_allclose(depth, np.asarray(t) * (np.asarray(rays.direction) @ forward), rtol=1e-4)
    behind = camera.world_from_camera[:3, 3] - forward
    assert float(cameras.project(camera, behind[None])[1][0]) < 0


def test_one_compilation_serves_every_pose_and_angle():
    project = jax.jit(cameras.generate_rays)
    centers = cameras.pixel_centers(make())
    for fov in (20.0, 70.0):
        project(make(fov=fov, origin=(fov, 0.0, 1.0)), centers)
    assert project._cache_size() == 1
