"""Pixels that an edge crosses: where rays through their corners do not go on over the surface that the centre's ray meets.

A method with one eye ray a pixel is right on average over all pixels but not in one that shows two things; those want
several rays. Corners are shared by four pixels, so that the test costs one ray a pixel beside the centre's.
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxvol import camera as cameras
from jaxvol import ray_casting
from jaxvol.sampling import dot, normalize
from jaxvol.types import Camera, Mesh, Rays

_OFF_PLANE = 0.1  # of the way to the other hit: farther from the plane of the first it is another surface
_TURNED = 0.9  # cosine between normals: below it there is a crease


def edge_pixels(
    mesh: Mesh | None,
    camera: Camera,
    caster: ray_casting.Caster,
    center_rays: Rays,
    center_hits: tuple[Float[np.ndarray, "HW"], Int[np.ndarray, "HW"]],
) -> Bool[np.ndarray, "HW"]:
    """Whether each pixel, row by row from the top, shows more than one surface, material or plane; eager.

    Features smaller than a pixel that miss its centre and its corners are not found. All False without surfaces.
    """
    height, width = camera.height, camera.width
    if caster is None:
        return np.zeros(height * width, bool)
    rays = _corner_rays(camera)
    t, face = ray_casting.intersect(caster, rays.origin, rays.direction, np.float32(np.inf))
    found = _differ(mesh, rays, t, face, center_rays, *center_hits, height=height, width=width)
    return np.asarray(found).reshape(-1)


@jax.jit
def _corner_rays(camera):
    """Rays through the corners of all pixels, row by row."""
    x, y = jnp.meshgrid(jnp.arange(camera.width + 1), jnp.arange(camera.height + 1))
    return cameras.generate_rays(camera, jnp.stack([x, y], axis=-1).reshape(-1, 2).astype(jnp.float32))


@partial(jax.jit, static_argnames=("height", "width"))
def _differ(mesh, rays, t, face, center_rays, t_center, face_center, *, height: int, width: int) -> Array:
    """Any of the four corners unlike the centre."""
    corner = [v.reshape(height + 1, width + 1, *v.shape[1:]) for v in _hit(mesh, rays, t, face)]
    middle = [v.reshape(height, width, *v.shape[1:]) for v in _hit(mesh, center_rays, t_center, face_center)]
    found = jnp.zeros((height, width), bool)
    for row in (slice(None, -1), slice(1, None)):
        for column in (slice(None, -1), slice(1, None)):
            found = found | _unlike(middle, [v[row, column] for v in corner])
    return found


def _hit(mesh, rays, t, face):
    """Face, place, normal and material of first hits."""
    index = jnp.maximum(face, 0)
    corners = mesh.vertices[mesh.faces[index]]
    normal = normalize(jnp.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]))
    material = [mesh.albedo[index]]
    if mesh.specular is not None:
        material += [mesh.specular[index], mesh.exponent[index][:, None]]
    place = rays.origin + jnp.where(face >= 0, t, 0.0)[:, None] * rays.direction
    return face, place, normal, jnp.concatenate(material, axis=-1)


def _unlike(a, b):
    """Whether hit b is not on the surface of hit a, or of another material."""
    (face, place, normal, material), (other, beyond, turned, painted) = a, b
    away = beyond - place
    off = jnp.abs(dot(normal, away)) > _OFF_PLANE * jnp.sqrt(dot(away, away))
    crease = jnp.abs(dot(normal, turned)) < _TURNED
    differs = off | crease | jnp.any(material != painted, axis=-1)
    return (face != other) & (differs | (face < 0) | (other < 0))
