"""Lighting of the surfels: light of every kind, with visibility and extinction on the way (paper section 4.2).

Delta lights (point, spot, directional) are each visited once; emissive triangles and the environment are sampled, a few
stratified directions per surfel, so that many surfels share the noise. Both sides of a surfel are lit apart: L_front and
L_back. What the paper calls radiosity B_S is in its formula radiance; radiance is what is stored here.
"""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxvol import lights, materials, ray_casting, sampling
from jaxvol.methods.deep_screen_space.surfels import Surfels
from jaxvol.types import Mesh, Scene

_STREAM = sampling.stream("deep_screen_space.lighting")
_SHADOW_MARGIN = 1e-4  # relative: area lights are surfaces themselves, shadow rays stop short of them


class Connections(eqx.Module):
    """K directions from each surfel towards a light and the irradiance that each would bring, unoccluded."""

    direction: Float[Array, "K S 3"]  # from the surfel towards the light
    distance: Float[Array, "K S"]  # to the light, inf for infinite ones
    irradiance: Float[Array, "K S 3"]  # radiance |cos| / pdf, W/m2


class LitSurfels(eqx.Module):
    """What is splatted: one entry per lit side of a surfel. `lobe_*` only for glossy entries (one per connection)."""

    position: Float[Array, "S 3"]
    normal: Float[Array, "S 3"]  # towards the lit side
    area: Float[Array, "S"]
    radiance: Float[Array, "S 3"]  # Lambert: outgoing radiance; glossy: specular times irradiance, W/m2
    lobe_direction: Float[Array, "S 3"] | None = None  # axis of the Phong lobe, travel
    lobe_exponent: Float[Array, "S"] | None = None


def light_choices(scene: Scene, *, num_area_samples: int, num_environment_samples: int) -> tuple[tuple[int, int], ...]:
    """(index of the choice in `lights.sample_light`, samples of it) for every light of the scene."""
    deltas = sum(
        0 if kind is None else kind.direction.shape[0] if kind is scene.directional_lights else kind.position.shape[0]
        for kind in (scene.point_lights, scene.spot_lights, scene.directional_lights)
    )
    choices = [(i, 1) for i in range(deltas)]
    for kind, samples in ((scene.area_lights, num_area_samples), (scene.environment, num_environment_samples)):
        if kind is not None:
            choices.append((len(choices), samples))
    return tuple(choices)


@partial(jax.jit, static_argnames=("choices",))
def connect(scene: Scene, surfels: Surfels, seed, *, choices: tuple[tuple[int, int], ...]) -> Connections:
    """Directions towards the lights; per light a Kronecker sequence over its samples, shifted per surfel."""
    number = lights.num_lights(scene)
    shift = sampling.uniforms(seed, _STREAM, jnp.arange(surfels.area.shape[0]), 0)
    rows = [(choice, samples, k) for choice, samples in choices for k in range(samples)]
    choice, samples, k = (jnp.asarray(column, jnp.float32)[:, None] for column in zip(*rows, strict=True))  # [K, 1]
    # Powers of the root of x^4 = x + 1: the R3 sequence of low discrepancy (Roberts 2018).
    u1, u2, u3 = (
        _open((u + (k + 1.0) * ratio) % 1.0)
        for u, ratio in zip(shift, (0.8191725134, 0.6710436067, 0.5497004779), strict=False)
    )
    position = jnp.broadcast_to(surfels.position, (*u1.shape, 3))
    light = lights.sample_light(scene, position, u1, u2, (choice + u3) / number)
    cosine = sampling.dot(surfels.normal, light.direction)
    # sample_light's pdf holds the choice among `number` lights; here that light is certain, sampled `samples` times.
    scale = jnp.abs(cosine) / jnp.maximum(light.pdf * number * samples, 1e-30)
    scale = jnp.where(surfels.valid & (light.pdf > 0), scale, 0.0)
    return Connections(light.direction, light.distance, light.radiance * scale[..., None])


def _open(u):
    return jnp.clip(u, 1e-6, 1.0 - 1e-6)


def shadow(
    connections: Connections, surfels: Surfels, caster: ray_casting.Caster, *, scale: float
) -> Connections:
    """The connections with occluded ones set to zero. Eager: casts only rays that carry light."""
    irradiance = np.array(connections.irradiance)
    k, s = np.nonzero(irradiance.max(axis=-1) > 0)
    direction = np.asarray(connections.direction)[k, s]
    origin = ray_casting.offset_origin(
        jnp.asarray(np.asarray(surfels.position)[s]), jnp.asarray(np.asarray(surfels.normal)[s]), direction, scale=scale
    )
    distance = np.asarray(connections.distance)[k, s]
    # Aimed anew from the offset origin: on large meshes the offset exceeds the margin before the light's own surface.
    finite = np.isfinite(distance)
    to_light = np.asarray(surfels.position)[s] + np.where(finite, distance, 1.0)[:, None] * direction - np.asarray(origin)
    reach = np.maximum(np.linalg.norm(to_light, axis=-1), 1e-20)
    direction = np.where(finite[:, None], to_light / reach[:, None], direction)
    distance = np.where(finite, reach, np.inf) * (1.0 - _SHADOW_MARGIN)
    blocked = np.asarray(ray_casting.occluded(caster, origin, direction.astype(np.float32), distance.astype(np.float32)))
    irradiance[k[blocked], s[blocked]] = 0.0
    return Connections(connections.direction, connections.distance, irradiance)


def attenuate(connections: Connections, surfels: Surfels, transmittance) -> Connections:
    """The connections weakened by the medium; `transmittance(origin, direction, distance)` is asked only where light is."""
    irradiance = np.array(connections.irradiance)
    k, s = np.nonzero(irradiance.max(axis=-1) > 0)
    num = max(256, 1 << (int(k.size) - 1).bit_length()) if k.size else 256  # few sizes, few compilations
    pad = np.zeros(num - k.size, np.int64)
    ks, ss = np.concatenate([k, pad]), np.concatenate([s, pad])
    through = transmittance(
        np.asarray(surfels.position)[ss], np.asarray(connections.direction)[ks, ss], np.asarray(connections.distance)[ks, ss]
    )
    irradiance[k, s] *= np.asarray(through)[: k.size]
    return Connections(connections.direction, connections.distance, irradiance)


def emit(surfels: Surfels, connections: Connections, mesh: Mesh) -> tuple[LitSurfels, LitSurfels | None]:
    """The lit sides: Lambertian entries, and glossy ones (one per connection) or None. Eager, unlit sides dropped.

    Radiance of a side is albedo/pi times the irradiance that arrives on it.
    """
    position, normal, area, face = (np.asarray(x) for x in (surfels.position, surfels.normal, surfels.area, surfels.face))
    cosine = np.einsum("sj,ksj->ks", normal, np.asarray(connections.direction))
    irradiance = np.asarray(connections.irradiance)
    albedo = np.asarray(mesh.albedo)[face] / np.pi
    sides = []
    for sign in (1.0, -1.0):
        arriving = np.sum(np.where((sign * cosine > 0)[..., None], irradiance, 0.0), axis=0)
        radiance = albedo * arriving
        lit = np.flatnonzero((radiance.max(axis=-1) > 0) & (area > 0))
        sides.append((position[lit], sign * normal[lit], area[lit], radiance[lit]))
    lambert = LitSurfels(*(np.concatenate(part).astype(np.float32) for part in zip(*sides, strict=True)))
    if mesh.specular is None:
        return lambert, None
    reflected = irradiance * np.asarray(mesh.specular)[face]
    k, s = np.nonzero((reflected.max(axis=-1) > 0) & (area > 0))
    if k.size == 0:
        return lambert, None
    incoming = -np.asarray(connections.direction)[k, s]
    facing = np.where((np.einsum("ij,ij->i", normal[s], incoming) > 0)[:, None], -normal[s], normal[s])
    glossy = LitSurfels(
        position=position[s],
        normal=facing,
        area=area[s],
        radiance=reflected[k, s],
        lobe_direction=np.asarray(materials.mirror(jnp.asarray(facing), jnp.asarray(incoming))),
        lobe_exponent=np.asarray(mesh.exponent)[face[s]],
    )
    return lambert, glossy


def illuminate(
    scene: Scene,
    surfels: Surfels,
    caster: ray_casting.Caster,
    transmittance,
    *,
    seed: int,
    choices: tuple[tuple[int, int], ...],
    scale: float = 1.0,
) -> tuple[LitSurfels, LitSurfels | None]:
    """The lit surfels of the scene: connect, shadow, attenuate, emit.

    `transmittance(origin, direction, distance) -> [n, 3]` of segments.
    """
    connections = connect(scene, surfels, jnp.uint32(seed), choices=choices)
    connections = shadow(connections, surfels, caster, scale=scale)
    connections = attenuate(connections, surfels, transmittance)
    return emit(surfels, connections, scene.mesh)


def order_for_strata(lit: LitSurfels, *, capacity: int, normal_weight: float = 0.5) -> LitSurfels:
    """The surfels in an order in which neighbours in the list are neighbours in space, padded to `capacity` with area 0.

    Balanced k-d splits over position and (weighted by `normal_weight` times the extent) normal: consecutive runs of any
    power of two are compact patches of like orientation, which stratifies the splat's sub-buffers and makes clusters. Eager.
    """
    num = lit.area.shape[0]
    position, normal = np.asarray(lit.position), np.asarray(lit.normal)
    extent = np.ptp(position, axis=0).max() if num else 1.0
    order = _kd_order(np.concatenate([position, normal_weight * extent * normal], axis=1), leaf=4)

    def arrange(value):
        value = np.asarray(value)
        fill = np.zeros((capacity - num, *value.shape[1:]), value.dtype)
        return np.concatenate([value[order], fill])

    return jax.tree.map(arrange, lit)


def _kd_order(points: Float[np.ndarray, "S D"], *, leaf: int) -> Int[np.ndarray, "S"]:
    """Indices by recursive halving along the widest axis; all nodes of a depth at once, runs are multiples of a power of 2."""
    num = len(points)
    size = leaf
    while size < num:
        size *= 2
    order = np.arange(num)
    while size > leaf:
        full = num // size * size
        rest = order[full:]
        parts = [_halved(points, order[:full].reshape(-1, size), size // 2)] if full else []
        parts.append(_halved(points, rest[None], size // 2) if rest.size > size // 2 else rest)
        order = np.concatenate([part.reshape(-1) for part in parts])
        size //= 2
    return order


def _halved(points, rows, half):
    """Rows [n, m] of indices, each with the `half` lowest along its widest axis first."""
    part = points[rows]
    axis = np.ptp(part, axis=1).argmax(axis=1)
    along = np.take_along_axis(part, axis[:, None, None], axis=2)[..., 0]
    return np.take_along_axis(rows, np.argpartition(along, half, axis=1), axis=1)
