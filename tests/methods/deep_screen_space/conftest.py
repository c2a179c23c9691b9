"""Small scenes for the tests of deep screen space."""

import jax.numpy as jnp
import numpy as np
import pytest

from jaxvol import camera as cameras
from jaxvol.types import Camera, Medium, Mesh, PointLights, Scene


def make_mesh(quads, albedo):
    """Two triangles for every (corner, edge, edge); the front is where cross(edge, edge) points."""
    vertices, faces = [], []
    for corner, a, b in quads:
        n = len(vertices)
        corner, a, b = (np.asarray(v, np.float64) for v in (corner, a, b))
        vertices += [corner, corner + a, corner + a + b, corner + b]
        faces += [[n, n + 1, n + 2], [n, n + 2, n + 3]]
    colours = np.repeat(np.asarray(albedo, np.float32).reshape(len(quads), 3), 2, axis=0)
    return Mesh(
        vertices=jnp.asarray(vertices, jnp.float32), faces=jnp.asarray(faces, jnp.int32), albedo=jnp.asarray(colours)
    )


def room():
    """Floor, back and left wall, and a board that shades a part of the medium from the floor."""
    quads = [
        ([-1, -1, 1], [2, 0, 0], [0, 0, -2]),
        ([-1, -1, -1], [2, 0, 0], [0, 2, 0]),
        ([-1, -1, 1], [0, 0, -2], [0, 2, 0]),
        ([-0.3, -0.75, 0.3], [0.6, 0, 0], [0, 0, -0.6]),
    ]
    return make_mesh(quads, [[0.7, 0.7, 0.7], [0.2, 0.6, 0.7], [0.7, 0.2, 0.1], [0.5, 0.5, 0.5]])


def lumps(n=16):
    x = (np.arange(n) + 0.5) / n * 2 - 1
    grid = np.stack(np.meshgrid(x, x, x, indexing="ij"), axis=-1)
    centres = np.array([[0.2, 0.1, 0.0], [-0.4, -0.3, 0.2], [0.3, -0.4, -0.3]])
    density = sum(np.exp(-np.sum((grid - c) ** 2, axis=-1) / 0.08) for c in centres)
    return np.maximum(density - 0.1, 0.0) / density.max()


def make_medium(sigma_s=2.0, sigma_a=0.4, g=0.0, density=None, half=0.55, **more):
    rgb = lambda v: jnp.asarray(np.broadcast_to(np.asarray(v, np.float32), 3))  # noqa: E731
    return Medium(
        bounds=jnp.array([[-half] * 3, [half] * 3], jnp.float32),
        sigma_s=rgb(sigma_s),
        sigma_a=rgb(sigma_a),
        g=jnp.float32(g),
        density=None if density is None else jnp.asarray(density, jnp.float32),
        **more,
    )


def lamp(power=3.0, position=(0.3, 0.85, 0.4)):
    return PointLights(position=jnp.asarray([position], jnp.float32), intensity=jnp.full((1, 3), power, jnp.float32))


@pytest.fixture(scope="session")
def cloud_scene():
    return Scene(mesh=room(), medium=make_medium(density=lumps()), point_lights=lamp())


@pytest.fixture(scope="session")
def camera():
    return Camera(
        world_from_camera=cameras.look_at([0.0, 0.0, 3.4], [0.0, 0.0, 0.0], [0.0, 1.0, 0.0]),
        fov_y=jnp.float32(np.radians(30)),
        height=24,
        width=32,
    )


SMALL = {
    "num_surfels": 512,
    "num_levels": 3,
    "num_intervals": 8,
    "num_steps": 32,
    "cluster_size": 64,
    "table_resolution": 8,
    "strides": (1, 1, 1),
    "dense_from": 3,
}
