"""Stage 3, gathering: light from every emitter at receivers, and along surface paths; rays are cast between jitted steps.

Light scattered on the way from an occluded emitter or patch is dropped (section 5.2, the paper's rule); the share of single
scattering that is lost at the receivers themselves is counted.
"""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from jaxvol import extinction, lights, ray_casting, sampling
from jaxvol.methods.impulse_response import emitters, surface_paths
from jaxvol.methods.impulse_response.lookup import Responses
from jaxvol.sampling import dot
from jaxvol.types import Medium, Scene

_STREAM = sampling.stream("impulse_response.lights")
DELTA = ("point", "spot", "directional")


class Kit(eqx.Module):
    """Everything that a bake prepares once."""

    scene: Scene
    responses: Responses | None  # None: light is attenuated only
    faces: surface_paths.Faces
    probe_sigma: Float[Array, ""]
    caster: ray_casting.Caster = eqx.field(static=True)
    marching: extinction.MarchingMedium | None = None
    medium_casters: tuple = eqx.field(static=True, default=())
    image: bool = eqx.field(static=True, default=True)
    num_steps: int = eqx.field(static=True, default=1)
    max_bounces: int = eqx.field(static=True, default=8)
    shares: tuple[float, float, float] = eqx.field(static=True, default=(1.0, 0.0, 0.0))


class Light(eqx.Module):
    """One emitter seen from each receiver; `strength` multiplies the response of a unit emitter."""

    direction: Float[Array, "n 3"]
    distance: Float[Array, "n"]  # inf for light from infinity
    strength: Float[Array, "n 3"]  # intensity; irradiance facing it; or radiance over density
    normal: Float[Array, "n 3"] | None = None  # of area emitters


def delta_lights(scene: Scene) -> list[tuple[str, int]]:
    """Kind and index of every point, spot and directional light."""
    found = []
    for kind in DELTA:
        group = getattr(scene, f"{kind}_lights")
        if group is not None:
            found += [(kind, i) for i in range(group.direction.shape[0] if kind == "directional" else group.position.shape[0])]
    return found


@partial(jax.jit, static_argnames="kind")
def _see(scene, position, kind, index, u):
    """The light of a kind: `index` [n] for point, spot and directional ones, a random one of the rest by u."""
    if kind in ("point", "spot"):
        group = scene.point_lights if kind == "point" else scene.spot_lights
        delta = group.position[index] - position
        distance = jnp.sqrt(jnp.maximum(dot(delta, delta), 1e-12))
        direction = delta / distance[:, None]
        strength = group.intensity[index]
        if kind == "spot":
            strength = strength * lights.spot_falloff(group, index, -direction)[:, None]
        return Light(direction, distance, strength)
    infinite = jnp.full(position.shape[0], jnp.inf, jnp.float32)
    if kind == "directional":
        return Light(-scene.directional_lights.direction[index], infinite, scene.directional_lights.irradiance[index])
    if kind == "environment":
        direction, pdf = lights.sample_environment(scene.environment, u[0], u[1])
        return Light(direction, infinite, lights.environment_radiance(scene.environment, direction) / pdf[:, None])
    group, mesh = scene.area_lights, scene.mesh
    face = group.face[sampling.sample_cdf(u[2], group.cdf)]
    a, b, c = (mesh.vertices[mesh.faces[face, i]] for i in range(3))
    w1, w2 = sampling.sample_triangle(u[0], u[1])
    delta = a + w1[:, None] * (b - a) + w2[:, None] * (c - a) - position
    distance = jnp.sqrt(jnp.maximum(dot(delta, delta), 1e-12))
    emission = mesh.emission[face]
    density = lights.luminance(emission) / group.total  # 1/area
    normal = sampling.normalize(jnp.cross(b - a, c - a))
    return Light(delta / distance[:, None], distance, emission / density[:, None], normal)


@jax.jit
def _shadow_ray(scale, position, normal, light):
    """From the lifted receiver to the lifted emitter."""
    start = surface_paths.lifted(position, normal, scale)
    far = jnp.where(jnp.isinf(light.distance), 0.0, light.distance)
    end = position + far[:, None] * light.direction
    if light.normal is not None:
        end = surface_paths.lifted(end, light.normal, scale)
    way = end - start
    length = jnp.sqrt(jnp.maximum(dot(way, way), 1e-20))
    infinite = jnp.isinf(light.distance)
    direction = jnp.where(infinite[:, None], light.direction, way / length[:, None])
    return start, direction, jnp.where(infinite, jnp.inf, length)


@partial(jax.jit, static_argnames="image")
def _arrivals(responses, normal, light, visible, tau, *, image):
    """Irradiance (attenuated, scattered once, more often), and what was scattered once on occluded ways."""
    cosine = jnp.maximum(dot(normal, light.direction), 0.0)
    infinite = light.normal is None and jnp.isinf(light.distance)
    distance = jnp.where(jnp.isinf(light.distance), 1.0, light.distance)
    direct = (cosine / (distance * distance))[:, None] * light.strength
    if light.normal is not None:
        direct = direct * jnp.maximum(-dot(light.normal, light.direction), 0.0)[:, None]
    seen = visible[:, None]
    if tau is not None:
        direct = direct * jnp.exp(-tau)
    direct = jnp.where(seen, direct, 0.0)
    if responses is None:
        return direct, jnp.zeros_like(direct), jnp.zeros_like(direct), jnp.zeros_like(direct)
    if light.normal is not None:
        once, more = emitters.patch_arrivals(responses, normal, light.direction, distance, light.normal, tau, image=image)
    else:
        near = emitters.point_arrivals(responses, normal, light.direction, distance, tau, image=image)
        sky = emitters.directional_arrivals(responses, normal, light.direction, tau, image=image)
        once, more = (jnp.where(infinite[:, None], b, a) for a, b in zip(near, sky, strict=True))
    once, more = once * light.strength, more * light.strength
    return direct, jnp.where(seen, once, 0.0), jnp.where(seen, more, 0.0), jnp.where(seen, 0.0, once)


def thickness(kit: Kit, origin, direction, t_max) -> Float[Array, "n 3"] | None:
    """Optical thickness of ways, RGB; None without a medium."""
    medium: Medium | None = kit.scene.medium
    if medium is None:
        return None
    return extinction.optical_thickness(
        medium, origin, direction, t_max, casters=kit.medium_casters, num_steps=kit.num_steps, marching=kit.marching
    )


def light_from(kit: Kit, position, normal, kind: str, index, u) -> tuple[Array, Array, Array, Array]:
    """Light of one emitter of a kind at each receiver: attenuated, once, more often, once but occluded; W/m2."""
    light = _see(kit.scene, position, kind, index, u)
    start, direction, length = _shadow_ray(kit.faces.scale, position, normal, light)
    visible = ~np.asarray(ray_casting.occluded(kit.caster, start, direction, length * (1 - 1e-5)))
    tau = thickness(kit, position, light.direction, light.distance)
    return _arrivals(kit.responses, normal, light, jnp.asarray(visible), tau, image=kit.image)


def delta_arrivals(kit: Kit, position: ArrayLike, normal: ArrayLike) -> tuple[Array, Array, Array, Array]:
    """Light of all point, spot and directional lights at the receivers: no noise. As `light_from`, summed."""
    total = [jnp.zeros(position.shape, jnp.float32)] * 4
    unused = (jnp.zeros(position.shape[0], jnp.float32),) * 4
    for kind, i in delta_lights(kit.scene):
        index = jnp.full(position.shape[0], i, jnp.int32)
        found = light_from(kit, position, normal, kind, index, unused)
        total = [a + b for a, b in zip(total, found, strict=True)]
    return tuple(total)


def sampled_arrivals(kit: Kit, position, normal, item, sample, seed, depth: int, *, with_delta: bool):
    """One random emitter of each kind at each receiver. As `light_from`, summed."""
    total = [jnp.zeros(position.shape, jnp.float32)] * 4
    counts = {kind: sum(k == kind for k, _ in delta_lights(kit.scene)) for kind in DELTA} if with_delta else {}
    kinds = [kind for kind, count in counts.items() if count]
    kinds += ["area"] if kit.scene.area_lights is not None else []
    kinds += ["environment"] if kit.scene.environment is not None else []
    for number, kind in enumerate(kinds):
        u = sampling.uniforms(seed, _STREAM, item, 8 * depth + number, sample)
        count = counts.get(kind, 1)
        index = jnp.minimum((u[3] * count).astype(jnp.int32), count - 1)
        found = light_from(kit, position, normal, kind, index, u)
        total = [a + count * b for a, b in zip(total, found, strict=True)]
    return tuple(total)


def path_arrivals(kit: Kit, position, normal, item, sample, seed) -> dict[str, Array]:
    """One path from each receiver: irradiance by layer without the delta lights' own (`delta_arrivals`).

    Keys as the layers of the light that the receiver reflects, and `occluded`, the scattered light that was dropped.
    """
    direct, once, more, lost = sampled_arrivals(kit, position, normal, item, sample, seed, 0, with_delta=False)
    layers = {
        "surface_from_light": direct,
        "surface_from_surface": jnp.zeros_like(direct),
        "surface_from_volume": once,
        "surface_from_multiple": more,
        "occluded": lost,
    }
    whole = plain = jnp.ones_like(direct)
    for depth in range(1, kit.max_bounces + 1):
        arguments = (item, sample, seed, jnp.int32(depth), kit.probe_sigma)
        proposal = surface_paths.propose(kit.scene.mesh, kit.faces, position, normal, *arguments, shares=kit.shares)
        t, face = ray_casting.intersect(kit.caster, proposal.origin, proposal.direction, proposal.t_max)
        arrival = surface_paths.arrive(
            kit.scene.mesh, kit.faces, position, normal, proposal, jnp.asarray(t), jnp.asarray(face), kit.probe_sigma
        )
        visible = plumb = jnp.ones(item.shape, bool)
        if kit.shares[0] < 1:  # otherwise the ray itself is the proof
            origin, direction, length = arrival.between
            visible = ~ray_casting.occluded(kit.caster, origin, direction, length * (1 - 1e-5))
            plumb = ~ray_casting.occluded(kit.caster, *arrival.plumb)
        tau = thickness(kit, position, arrival.direction, arrival.distance)
        step, unscattered = surface_paths.transport(
            kit.scene.mesh,
            kit.faces,
            kit.responses,
            normal,
            proposal,
            arrival,
            jnp.asarray(visible),
            jnp.asarray(plumb),
            tau,
            kit.probe_sigma,
            shares=kit.shares,
            image=kit.image,
        )
        whole, plain = _survive(whole * step, plain * unscattered, item, sample, seed, jnp.int32(depth))
        position, normal = arrival.position, arrival.normal
        found = sampled_arrivals(kit, position, normal, item, sample, seed, depth, with_delta=True)
        all_of_it = whole * (found[0] + found[1] + found[2])
        if depth == 1:
            layers["surface_from_surface"] = plain * found[0]
            all_of_it = all_of_it - plain * found[0]
        layers["surface_from_multiple"] = layers["surface_from_multiple"] + all_of_it
        if not bool(jnp.any(whole > 0)):
            break
    return layers


@jax.jit
def _survive(whole, plain, item, sample, seed, depth):
    """Russian roulette from the third vertex on; paths that lost end with weight 0."""
    u = sampling.uniforms(seed, _STREAM, item, 1000 + depth, sample)[0]
    chance = jnp.clip(jnp.max(jnp.abs(whole), axis=-1), 0.1, 1.0)
    chance = jnp.where(depth < 3, 1.0, chance)
    kept = jnp.where(u < chance, 1 / chance, 0.0)[:, None]
    return whole * kept, plain * kept
