"""Small scenes that the tests of this method share."""

import jax.numpy as jnp
import numpy as np

from jaxvol import camera, media
from jaxvol.types import Camera, Medium, PointLights, Scene


def floats(*values):
    return jnp.asarray(values, jnp.float32)


def make_medium(*, sigma_s=(0.8,) * 3, sigma_a=(0.2,) * 3, g=0.0, half=1.0, density=None):
    bounds = floats([-half] * 3, [half] * 3)
    grid = None if density is None else jnp.asarray(density, jnp.float32)
    return Medium(
        bounds=bounds,
        sigma_s=floats(*sigma_s),
        sigma_a=floats(*sigma_a),
        g=jnp.float32(g),
        density=grid,
        majorants=None if density is None else media.majorants(density),
    )


def lit(medium, *, position=(0.0, 0.0, 0.0), intensity=1 / (4 * np.pi), mesh=None):
    """A scene with one point light, of power 1 by default."""
    return Scene(
        mesh=mesh,
        medium=medium,
        point_lights=PointLights(position=floats(position), intensity=floats([intensity] * 3)),
    )


def make_camera(size=8, distance=4.0):
    return Camera(
        world_from_camera=camera.look_at([0, 0, distance], [0, 0, 0], [0, 1, 0]),
        fov_y=jnp.float32(0.6),
        height=size,
        width=size,
    )
