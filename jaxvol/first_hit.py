"""What eye rays meet first: surfaces, what they emit towards the eye, and guides for denoisers.

Everything here is deterministic. `emission` is the layer L E: emissive faces and the environment seen through the medium.
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxvol import camera as cameras
from jaxvol import extinction, lights, materials, ray_casting
from jaxvol.common_stages import CommonStages
from jaxvol.types import Auxiliary, Camera, Hits, Rays, Scene

_CHUNK = 1 << 16  # rays at a time


def first_hits(scene: Scene, rays: Rays, caster: ray_casting.Caster) -> Hits:
    """Nearest surfaces within `t_max`. Eager with an Embree caster."""
    t, face = ray_casting.intersect(caster, rays.origin, rays.direction, rays.t_max)
    return _hits(scene.mesh, rays.origin, rays.direction, t, face)


_hits = jax.jit(ray_casting.hits)


def transmittance(
    scene: Scene,
    rays: Rays,
    hits: Hits,
    *,
    casters: tuple[ray_casting.Caster, ...],
    num_steps: int,
    marching: extinction.MarchingMedium | None = None,
) -> Float[Array, "n 3"] | None:
    """Transmittance of the medium up to the first surface, RGB; None without a medium. Arguments as in `extinction`."""
    if scene.medium is None:
        return None
    end = jnp.minimum(hits.t, rays.t_max)
    return jnp.exp(
        -extinction.optical_thickness(
            scene.medium, rays.origin, rays.direction, end, casters=casters, num_steps=num_steps, marching=marching
        )
    )


@jax.jit
def emission(scene: Scene, rays: Rays, hits: Hits, through: Float[Array, "n 3"] | None) -> Float[Array, "n 3"]:
    """Radiance of emissive faces (front side) and, where nothing is hit, of the environment, times `through`."""
    found = jnp.zeros(rays.direction.shape, jnp.float32)
    if scene.area_lights is not None:
        found = lights.emitted_radiance(scene.mesh, hits.face, hits.normal, rays.direction)
    if scene.environment is not None:
        sky = lights.environment_radiance(scene.environment, rays.direction)
        unbounded = ~hits.valid & jnp.isinf(rays.t_max)
        found = jnp.where(unbounded[:, None], sky, found)
    return found if through is None else found * through


@jax.jit
def _guides(mesh, hits, direction):
    seen = hits.valid[:, None]
    surface = materials.surface_at(mesh, hits.face)
    albedo = surface.albedo if surface.specular is None else surface.albedo + surface.specular
    normal = materials.facing_normal(hits.normal, direction)
    return jnp.where(seen, albedo, 0.0), jnp.where(seen, normal, 0.0)


@partial(jax.jit, static_argnames=("count",))
def _center_rays(camera, first, *, count):
    pixel = jnp.minimum(first + jnp.arange(count), camera.height * camera.width - 1)
    row = pixel // camera.width
    xy = jnp.stack([pixel - row * camera.width, row], axis=-1).astype(jnp.float32) + 0.5
    return cameras.generate_rays(camera, xy)


def auxiliary(
    scene: Scene,
    camera: Camera,
    *,
    caster: ray_casting.Caster = None,
    num_steps: int | None = None,
    common: CommonStages | None = None,
) -> Auxiliary:
    """Depth, transmittance, albedo (Lambert plus Phong) and normal of the first surface through each pixel's centre.

    Depth is inf where there is no surface; transmittance goes on to infinity there. Fields that the scene cannot have
    (no mesh, no medium) are None. `num_steps` defaults to one a voxel. The first hits are those of `common`, unless a `caster`
    is given.
    """
    common = CommonStages(scene, camera) if common is None else common
    medium = scene.medium
    if num_steps is None:
        num_steps = 0 if medium is None else max(1, extinction.num_voxels_across(medium))
    total = camera.height * camera.width
    count = min(_CHUNK, total)
    parts = {"depth": [], "transmittance": [], "albedo": [], "normal": []}
    for first in range(0, total, count):
        rays = _center_rays(camera, jnp.int32(first), count=count)
        if caster is None:
            part = np.minimum(np.arange(first, first + count), total - 1)
            hits = _hits(scene.mesh, rays.origin, rays.direction, *(x[part] for x in common.center_hits))
        else:
            hits = first_hits(scene, rays, caster)
        values = {}
        if scene.mesh is not None:
            values["depth"] = jnp.where(hits.valid, hits.t, jnp.inf)
            values["albedo"], values["normal"] = _guides(scene.mesh, hits, rays.direction)
        if medium is not None:
            values["transmittance"] = transmittance(
                scene, rays, hits, casters=common.medium_casters, num_steps=num_steps, marching=common.marching
            )
        for name, value in values.items():
            parts[name].append(np.asarray(value)[: total - first])

    def image(name):
        if not parts[name]:
            return None
        whole = np.concatenate(parts[name])
        return jnp.asarray(whole.reshape(camera.height, camera.width, *whole.shape[1:]))

    return Auxiliary(**{name: image(name) for name in parts})
