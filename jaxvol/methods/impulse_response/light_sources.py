"""Stage 3, emitters as receivers see them: choice, direction, distance, strength, and the ray that tells what is occluded."""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

from jaxvol import lights, sampling, slopes
from jaxvol.methods.impulse_response import surface_paths
from jaxvol.sampling import dot
from jaxvol.types import Scene

DELTA = ("point", "spot", "directional")
NEAREST = 1e-15  # the distance of an emitter from a point that lies on it


class Light(eqx.Module):
    """One emitter seen from each receiver; `strength` multiplies the response of a unit emitter."""

    direction: Float[Array, "n 3"]
    distance: Float[Array, "n"]  # inf for light from infinity
    strength: Float[Array, "n 3"]  # intensity; irradiance facing it; or radiance over density
    normal: Float[Array, "n 3"] | None = None  # of area emitters
    cone: tuple[Float[Array, "n 3"], Float[Array, "n"]] | None = None  # of spots: axis, cosine of the half angle
    infinite: bool = eqx.field(static=True, default=False)


def delta_lights(scene: Scene) -> list[tuple[str, int]]:
    """Kind and index of every point, spot and directional light."""
    found = []
    for kind in DELTA:
        group = getattr(scene, f"{kind}_lights")
        if group is not None:
            found += [(kind, i) for i in range(group.direction.shape[0] if kind == "directional" else group.position.shape[0])]
    return found


@partial(jax.jit, static_argnames=("kind", "falloff"))
def choose(scene, position, kind, u, *, falloff: int) -> tuple[Int[Array, "n"], Float[Array, "n"]]:
    """One of a kind of delta lights at each receiver and 1 / its probability: by its strength over distance^falloff, a
    quarter of the times by its strength alone."""
    group = getattr(scene, f"{kind}_lights")
    if kind == "directional":
        chance = jnp.broadcast_to(_shares(lights.luminance(group.irradiance)), (position.shape[0], group.direction.shape[0]))
    else:
        strength = lights.luminance(group.intensity)
        delta = group.position - position[:, None]
        square = dot(delta, delta)
        square = jnp.where(square < 1e30, square, 1e30)  # paths that have left the scene are nowhere
        near = lax.integer_pow(lax.rsqrt(jnp.maximum(square, 1e-30)), falloff)
        near = near / lax.stop_gradient(jnp.max(near, axis=-1, keepdims=True))  # as the unit
        chance = 0.75 * _shares(strength * near) + 0.25 * _shares(strength)
    total = jnp.cumsum(chance, axis=-1)
    index = jnp.minimum(jnp.sum(u[:, None] * total[:, -1:] >= total, axis=-1), chance.shape[1] - 1)
    return index, total[:, -1] / jnp.take_along_axis(chance, index[:, None], axis=-1)[:, 0]


def _shares(weight):
    return slopes.ratio(weight, jnp.maximum(jnp.sum(weight, axis=-1, keepdims=True), 1e-30)) + 1e-6


@partial(jax.jit, static_argnames=("kind", "scatters"))
def see(scene, position, normal, kind, index, u, *, scatters: bool) -> Light:
    """The light of a kind: `index` [n] for point, spot and directional ones, a random one of the rest by u.

    Directions to the sky by its map and by the cosine about `normal` (balance heuristic), by the cosine alone where the sky is
    constant and no medium `scatters` what comes from below the horizon.
    """
    if kind in ("point", "spot"):
        group = scene.point_lights if kind == "point" else scene.spot_lights
        delta = group.position[index] - position
        distance = jnp.sqrt(jnp.maximum(dot(delta, delta), NEAREST * NEAREST))
        direction = delta / distance[:, None]
        strength = group.intensity[index]
        if kind == "point":
            return Light(direction, distance, strength)
        strength = strength * lights.spot_falloff(group, index, -direction)[:, None]
        return Light(direction, distance, strength, cone=(group.direction[index], jnp.cos(group.cutoff[index])))
    infinite = jnp.full(position.shape[0], jnp.inf, jnp.float32)
    if kind == "directional":
        group = scene.directional_lights
        return Light(-group.direction[index], infinite, group.irradiance[index], infinite=True)
    if kind == "environment":
        constant = scene.environment.radiance.shape[:2] == (1, 1)
        share = 1.0 if constant and not scatters else 0.5
        mapped, _ = lights.sample_environment(scene.environment, u[0], u[1])
        direction = jnp.where((u[2] < share)[:, None], sampling.sample_cosine_hemisphere(u[0], u[1], normal), mapped)
        pdf = share * sampling.sample_cosine_hemisphere_pdf(dot(normal, direction))
        pdf = pdf + (1 - share) * lights.sample_environment_pdf(scene.environment, direction)
        pdf = jnp.maximum(pdf, 1e-9)  # at the very horizon, where nothing arrives
        radiance = lights.environment_radiance(scene.environment, direction)
        return Light(direction, infinite, radiance / pdf[:, None], infinite=True)
    group, mesh = scene.area_lights, scene.mesh
    face = group.face[sampling.sample_cdf(u[2], group.cdf)]
    a, b, c = (mesh.vertices[mesh.faces[face, i]] for i in range(3))
    w1, w2 = sampling.sample_triangle(u[0], u[1])
    delta = a + w1[:, None] * (b - a) + w2[:, None] * (c - a) - position
    distance = jnp.sqrt(jnp.maximum(dot(delta, delta), NEAREST * NEAREST))
    emission = mesh.emission[face]
    density = lights.luminance(emission) / group.total  # 1/area
    normal = sampling.normalize(jnp.cross(b - a, c - a))
    return Light(delta / distance[:, None], distance, emission / density[:, None], normal)


@partial(jax.jit, static_argnames="kind")
def see_again(scene, position, kind, index, light: Light, moved) -> Light:
    """The same emitter from other points `moved`: a spot's falloff changes, the sample on an area emitter does not."""
    if light.infinite:
        return light
    delta = position + light.distance[:, None] * light.direction - moved
    distance = jnp.sqrt(jnp.maximum(dot(delta, delta), NEAREST * NEAREST))
    direction = delta / distance[:, None]
    strength = light.strength
    if kind == "spot":
        group = scene.spot_lights
        strength = group.intensity[index] * lights.spot_falloff(group, index, -direction)[:, None]
    return Light(direction, distance, strength, light.normal, light.cone)


@jax.jit
def shadow_ray(scale, position, normal, light: Light):
    """From the receiver, lifted where it has a normal, to the lifted emitter: origin, direction, length."""
    start = position if normal is None else surface_paths.lifted(position, normal, scale)
    if light.infinite:
        return start, light.direction, light.distance
    end = position + light.distance[:, None] * light.direction
    if light.normal is not None:
        end = surface_paths.lifted(end, light.normal, scale)
    way = end - start
    length = jnp.sqrt(jnp.maximum(dot(way, way), 1e-30))
    return start, way / length[:, None], length * (1 - 1e-5)
