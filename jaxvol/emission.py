"""Light sampled from the lights' side: particles that leave point, spot, directional, area and environment lights.

Lights of infinite distance start on a disk that covers the scene's bounding sphere. One kind and light is chosen in
proportion to its power, so `power` (RGB, W for one particle's share of the whole) is nearly equal for all particles.
"""

import math

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxvol import lights, sampling
from jaxvol.types import Scene


class Emission(eqx.Module):
    """Particles leaving lights: the mean of `power` over samples is the light's total power into the scene."""

    position: Float[Array, "*b 3"]
    direction: Float[Array, "*b 3"]  # unit, of travel
    power: Float[Array, "*b 3"]  # emitted radiance * cosine / pdf(position, direction, choice), W
    normal: Float[Array, "*b 3"]  # of the emitting surface; the travel direction for other lights
    on_surface: Bool[Array, "*b"]  # leaves a surface: the first ray wants an offset


def bounding_sphere(scene: Scene) -> tuple[Float[Array, "3"], Float[Array, ""]]:
    """Centre and radius of a sphere around mesh and medium; radius 1 at the origin for an empty scene."""
    corners = []
    if scene.mesh is not None:
        corners += [jnp.min(scene.mesh.vertices, axis=0), jnp.max(scene.mesh.vertices, axis=0)]
    if scene.medium is not None:
        for medium in (scene.medium, *scene.medium.inclusions):
            corners += [medium.bounds[0], medium.bounds[1]]
    if not corners:
        return jnp.zeros(3, jnp.float32), jnp.float32(1.0)
    stacked = jnp.stack(corners)
    low, high = jnp.min(stacked, axis=0), jnp.max(stacked, axis=0)
    half = 0.5 * (high - low)
    return 0.5 * (low + high), jnp.sqrt(jnp.sum(half * half)) * 1.0001


def _powers(scene: Scene, radius) -> list[tuple[str, Float[Array, "P"]]]:
    """Luminance of the power of every light, kind by kind."""
    disk = math.pi * radius * radius
    found = []
    if scene.point_lights is not None:
        found.append(("point", 4.0 * math.pi * lights.luminance(scene.point_lights.intensity)))
    if scene.spot_lights is not None:
        spots = scene.spot_lights
        half = jnp.sin(0.5 * spots.cutoff)
        found.append(("spot", 4.0 * math.pi * half * half * lights.luminance(spots.intensity)))
    if scene.directional_lights is not None:
        found.append(("directional", disk * lights.luminance(scene.directional_lights.irradiance)))
    if scene.area_lights is not None:
        found.append(("area", math.pi * scene.area_lights.total[None]))
    if scene.environment is not None:
        radiance = scene.environment.radiance
        h, w, _ = radiance.shape
        edges = jnp.cos(jnp.arange(h + 1) * (math.pi / h))
        solid = (edges[:-1] - edges[1:])[:, None] * (2.0 * math.pi / w)
        found.append(("environment", disk * jnp.sum(solid * lights.luminance(radiance))[None]))
    return found


def sample_emission(
    scene: Scene,
    u1: Float[Array, "*b"],
    u2: Float[Array, "*b"],
    u3: Float[Array, "*b"],
    u4: Float[Array, "*b"],
    u5: Float[Array, "*b"],
) -> Emission:
    """Particles from all lights: u1 chooses the light, u2, u3 and u4, u5 position and direction.

    Raises ValueError when the scene has no light.
    """
    center, radius = bounding_sphere(scene)
    powers = _powers(scene, radius)
    if not powers:
        raise ValueError("scene has no light to emit from")
    weights = jnp.concatenate([p for _, p in powers])
    cdf = jnp.cumsum(weights) / jnp.maximum(jnp.sum(weights), 1e-30)
    choice = sampling.sample_cdf(u1, cdf)
    below = jnp.where(choice > 0, cdf[choice - 1], 0.0)
    share = cdf[choice] - below
    rest = jnp.clip((u1 - below) / jnp.maximum(share, 1e-30), 1e-7, 1.0 - 1e-7)
    result = None
    first = 0
    for kind, power in powers:
        index = jnp.clip(choice - first, 0, power.shape[0] - 1)
        found = _EMITTERS[kind](scene, index, rest, u2, u3, u4, u5, center, radius)
        mine = choice >= first
        if result is None:
            result = found
        else:
            result = tuple(
                jnp.where(mine[..., None] if new.ndim > mine.ndim else mine, new, old)
                for new, old in zip(found, result, strict=True)
            )
        first += power.shape[0]
    position, direction, power, normal, on_surface = result
    return Emission(position, direction, power / jnp.maximum(share, 1e-30)[..., None], normal, on_surface)


def _point(scene, index, rest, u2, u3, u4, u5, center, radius):
    """Towards the scene only: a cone about its bounding sphere, the whole sphere from inside it."""
    position = scene.point_lights.position[index]
    delta = center - position
    distance = jnp.sqrt(jnp.maximum(sampling.dot(delta, delta), 1e-30))
    outside = distance > radius
    half_angle = jnp.where(outside, jnp.arcsin(jnp.minimum(radius / distance, 1.0)), math.pi)
    axis = jnp.where(outside[..., None], delta / distance[..., None], jnp.asarray([0.0, 0.0, 1.0]))
    direction = sampling.sample_uniform_cone(u4, u5, axis, half_angle)
    power = scene.point_lights.intensity[index] / sampling.sample_uniform_cone_pdf(half_angle)[..., None]
    return position, direction, power, direction, jnp.zeros(u2.shape, bool)


def _spot(scene, index, rest, u2, u3, u4, u5, center, radius):
    spots = scene.spot_lights
    cutoff = spots.cutoff[index]
    direction = sampling.sample_uniform_cone(u4, u5, spots.direction[index], cutoff)
    scale = lights.spot_falloff(spots, index, direction) / sampling.sample_uniform_cone_pdf(cutoff)
    power = spots.intensity[index] * scale[..., None]
    return spots.position[index], direction, power, direction, jnp.zeros(u2.shape, bool)


def _on_disk(direction, u2, u3, center, radius):
    """A point of the disk that faces the scene's bounding sphere, just outside it, upstream of `direction`."""
    s, t = sampling.orthonormal_basis(direction)
    r = radius * jnp.sqrt(u2)
    phi = 2.0 * math.pi * u3
    offset = (r * jnp.cos(phi))[..., None] * s + (r * jnp.sin(phi))[..., None] * t
    return center - radius * direction + offset


def _directional(scene, index, rest, u2, u3, u4, u5, center, radius):
    direction = scene.directional_lights.direction[index]
    power = scene.directional_lights.irradiance[index] * (math.pi * radius * radius)
    position = _on_disk(direction, u2, u3, center, radius)
    return position, direction, power, direction, jnp.zeros(u2.shape, bool)


def _area(scene, index, rest, u2, u3, u4, u5, center, radius):
    mesh, area = scene.mesh, scene.area_lights
    face = area.face[sampling.sample_cdf(rest, area.cdf)]
    a, b, c = (mesh.vertices[mesh.faces[face, i]] for i in range(3))
    w1, w2 = sampling.sample_triangle(u2, u3)
    normal = sampling.normalize(jnp.cross(b - a, c - a))
    emission = mesh.emission[face]
    # pdf of position: luminance / total; of direction: cos / pi, which cancels the cosine.
    power = emission * (math.pi * area.total / jnp.maximum(lights.luminance(emission), 1e-30))[..., None]
    point = a + w1[..., None] * (b - a) + w2[..., None] * (c - a)
    return point, sampling.sample_cosine_hemisphere(u4, u5, normal), power, normal, jnp.ones(u2.shape, bool)


def _environment(scene, index, rest, u2, u3, u4, u5, center, radius):
    towards, pdf = lights.sample_environment(scene.environment, u4, u5)
    radiance = lights.environment_radiance(scene.environment, towards)
    direction = -towards
    power = radiance * (math.pi * radius * radius / pdf)[..., None]
    return _on_disk(direction, u2, u3, center, radius), direction, power, direction, jnp.zeros(u2.shape, bool)


_EMITTERS = {
    "point": _point,
    "spot": _spot,
    "directional": _directional,
    "area": _area,
    "environment": _environment,
}
