"""Small scenes that the tests of this method share."""

import jax.numpy as jnp
import numpy as np

from jaxvol import camera, media
from jaxvol.methods import instant_multiple_scattering as ims
from jaxvol.methods.instant_multiple_scattering import ray_lights, rendering, virtual_lights
from jaxvol.types import Camera, Medium, PointLights, Scene

EXACT = 2.27358e-3  # from the Fourier solution; experiments/instant_bias_table.py recomputes it from Case's


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


def radiance_past_the_source(*, sets, lanes=64, **options):
    """(mean, standard error) of what should be EXACT: light scattered at least twice along a ray past a point source.

    Infinite medium of albedo .9, the ray of length 6 passes the source of power 1 at distance 1.
    """
    medium = make_medium(sigma_s=(0.9,) * 3, sigma_a=(0.1,) * 3, half=20.0)
    scene = lit(medium, position=(0.0, 1.0, 0.0))
    plan = ims.plan(scene, make_camera(), num_paths=512, jitter=False, **options)
    rays = (
        jnp.tile(floats([-3.0, 0.0, 0.0]), (lanes, 1)),
        jnp.tile(floats([1.0, 0.0, 0.0]), (lanes, 1)),
        jnp.full(lanes, 6.0),
        jnp.full(lanes, -1),
        jnp.arange(lanes, dtype=jnp.uint32),
    )
    values, sizes = [], {}
    for k in range(sets):
        context, _ = rendering.make_context(scene, plan, seed=k, sizes=sizes)
        sizes.update(virtual_lights.sizes(context.lights) if context.rays is None else ray_lights.sizes(context.rays))
        found = rendering.gather_rays(context, *rays)
        values.append(float(jnp.mean(found["volume_from_volume"] + found["volume_from_multiple"])))
    return np.mean(values), np.std(values, ddof=1) / np.sqrt(sets)
