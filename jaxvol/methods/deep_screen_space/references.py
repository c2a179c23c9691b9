"""Slower answers to the same question, each leaving out one approximation, so that errors can be told apart.

A1 `exact_pairs`: the same surfels and samples, all pairs, visibility and transmittance of every pair by itself. What
   differs from `render` is the splat's noise, the blur and the transport table.
A2 `gather`: rays cast from the samples, surfaces lit where they are hit: no surfels. What differs from A1 is the
   discretisation of surfaces (and the softening of near pairs).
A3 is the path tracer's layer `volume_from_surface`; what differs from A2 are the samples along the ray.
All are eager host loops over chosen pixels.
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from jaxvol import lights, materials, phase, ray_casting, sampling
from jaxvol.common_stages import CommonStages
from jaxvol.methods.deep_screen_space import frame, kernel, splatting
from jaxvol.methods.deep_screen_space.camera_rays import map_rays, transmittance_of
from jaxvol.methods.deep_screen_space.planning import Plan
from jaxvol.types import Camera, Medium, Scene

_STREAM = sampling.stream("deep_screen_space.references")
_MARGIN = 1e-4


@partial(jax.jit, static_argnames=("phase_kind",))
def _pair_values(rows, direction, distance, medium: Medium, *, phase_kind: str):
    """Untransported contribution of every surfel to every sample: [samples, S] without the radiance."""
    surfel = {name: rows[None, :, i] for i, name in enumerate(kernel.COLUMNS)}
    ray = tuple(direction[:, i : i + 1] for i in range(3))
    values = kernel.pair_samples(
        ray, [distance[:, None]], surfel, phase=phase_kind, g=medium.g, table=medium.phase
    )
    return kernel.phase_scale(phase_kind, medium.g) * values[0]


def exact_pairs(
    scene: Scene,
    camera: Camera,
    plan: Plan,
    pixels: Int[np.ndarray, "n"],
    *,
    seed: int = 0,
    num_steps: int = 32,
    visibility: bool = True,
    attenuation: bool = True,
    chunk: int = 64,
) -> Float[np.ndarray, "n 3"]:
    """A1 for flat pixel indices: every pair with its own shadow ray and `num_steps` steps of extinction; Lambert only."""
    common = CommonStages(scene, camera)
    caster, transmittance = common.caster, transmittance_of(scene.medium, common.medium_casters, num_steps=num_steps)
    cloud, _ = frame.make_surfels(scene, camera, plan)
    lit, _ = frame.light_surfels(scene, cloud, plan, common, seed=seed)
    active = map_rays(scene, camera, plan, common, seed=seed, pixels=pixels)
    place = {int(p): i for i, p in enumerate(active.pixel[: active.num_rays])}
    out = np.zeros((len(pixels), 3), np.float32)
    # One level that holds all distances.
    first = splatting.first_radius(lit.area, lit.radiance, 1.0)
    order = np.arange(lit.area.shape[0])[None]
    rows = splatting.level_surfels(
        lit, first, active.origin, order, level=0, num_levels=1, tail=True, group_size=1, cluster_size=1
    ).row[:, 0]
    emitted = np.asarray(rows)[:, 9:12]
    distance, weight = np.asarray(active.map.distance), np.asarray(active.map.weight)
    num_samples, scale = distance.shape[0], ray_casting.scene_scale(scene.mesh)
    weight = np.broadcast_to(weight, (num_samples, *weight.shape[1:]))
    todo = [(k, place[int(p)]) for k, p in enumerate(pixels) if int(p) in place]
    entries = [(k, a, n) for k, a in todo for n in range(num_samples)]
    for begin in range(0, len(entries), chunk):
        part = np.array(entries[begin : begin + chunk])
        full = np.concatenate([part, np.repeat(part[-1:], chunk - len(part), axis=0)])
        direction, d = active.direction[full[:, 1]], distance[full[:, 2], full[:, 1]]
        values = np.array(_pair_values(rows, direction, d, scene.medium, phase_kind=plan.phase))
        point = active.origin + d[:, None] * direction
        delta = point[:, None] - np.asarray(lit.position)[None]
        length = np.linalg.norm(delta, axis=-1)
        toward = delta / np.maximum(length, 1e-12)[..., None]
        if visibility:
            start = np.broadcast_to(
                np.asarray(ray_casting.offset_origin(lit.position, lit.normal, lit.normal, scale=scale)),
                toward.shape,
            )
            blocked = np.asarray(ray_casting.occluded(caster, start, toward, length * (1.0 - _MARGIN)))
            values = np.where(blocked, 0.0, values)
        through = 1.0
        if attenuation:
            starts = np.broadcast_to(np.asarray(lit.position), toward.shape).reshape(-1, 3)
            through = transmittance(starts, toward.reshape(-1, 3), length.reshape(-1)).reshape(*length.shape, 3)
        received = np.einsum("ps,psc,sc->pc", values, np.broadcast_to(through, (*length.shape, 3)), emitted)
        received = received * weight[full[:, 2], :, full[:, 1]]
        np.add.at(out, part[:, 0], received[: len(part)])
    return out


@partial(jax.jit, static_argnames=("phase_kind",))
def _scatter(medium, direction, u1, u2, *, phase_kind):
    """Directions towards which to look for light that scatters into the eye: against its travel (phase is symmetric)."""
    arriving, _ = phase.sample(medium, -direction, u1, u2)
    return -arriving


@jax.jit
def _next_event(scene, hit, looking, u1, u2, u3):
    """Light towards the hit points: sample, and radiance reflected against `looking` per unit visibility."""
    light = lights.sample_light(scene, hit.position, u1, u2, u3)
    surface = materials.surface_at(scene.mesh, hit.face)
    value = materials.evaluate(surface, hit.normal, -light.direction, -looking)
    cosine = jnp.abs(sampling.dot(hit.normal, light.direction))
    radiance = value * light.radiance * (cosine / jnp.maximum(light.pdf, 1e-30))[..., None]
    scale = ray_casting.scene_scale(scene.mesh)
    origin = ray_casting.offset_origin(hit.position, hit.normal, light.direction, scale=scale)
    return light, jnp.where((hit.valid & (light.pdf > 0))[..., None], radiance, 0.0), origin


def gather(
    scene: Scene,
    camera: Camera,
    plan: Plan,
    pixels: Int[np.ndarray, "n"],
    *,
    num_directions: int = 64,
    seed: int = 0,
    num_steps: int = 48,
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]:
    """A2 for flat pixel indices: mean and standard error. From every sample of the plan's map `num_directions` rays by
    the phase function; where they meet a surface, one light sample. The n-th direction of all samples is one estimate.
    """
    common = CommonStages(scene, camera)
    caster, transmittance = common.caster, transmittance_of(scene.medium, common.medium_casters, num_steps=num_steps)
    active = map_rays(scene, camera, plan, common, seed=seed, pixels=pixels)
    place = {int(p): i for i, p in enumerate(active.pixel[: active.num_rays])}
    known = np.array([place.get(int(p), -1) for p in pixels])
    rows = np.flatnonzero(known >= 0)
    a = known[rows]
    distance = np.asarray(active.map.distance)[:, a]
    weight = np.asarray(active.map.weight)[:, :, a]
    num_samples, num = distance.shape
    direction = np.broadcast_to(active.direction[a], (num_samples, num, 3)).reshape(-1, 3)
    point = jnp.asarray(active.origin + distance.reshape(-1, 1) * direction)
    total, square = np.zeros((2, num, 3))
    index = jnp.arange(point.shape[0])
    for k in range(num_directions):
        u = sampling.uniforms(jnp.uint32(seed), _STREAM, index, 2 * k)
        v = sampling.uniforms(jnp.uint32(seed), _STREAM, index, 2 * k + 1)
        looking = _scatter(scene.medium, jnp.asarray(direction), u[0], u[1], phase_kind=plan.phase)
        t, face = ray_casting.intersect(caster, point, looking, np.inf)
        hit = ray_casting.hits(scene.mesh, point, looking, t, face)
        light, radiance, origin = _next_event(scene, hit, looking, v[0], v[1], v[2])
        blocked = ray_casting.occluded(caster, origin, light.direction, light.distance * (1.0 - _MARGIN))
        near = transmittance(point, looking, jnp.where(hit.valid, t, 0.0))
        far = transmittance(hit.position, light.direction, light.distance)
        found = np.where(np.asarray(blocked)[:, None], 0.0, np.asarray(radiance) * near * far)
        found = (found.reshape(num_samples, num, 3) * np.swapaxes(weight, 1, 2)).sum(axis=0)
        total += found
        square += found * found
    mean = total / num_directions
    error = np.sqrt(np.maximum(square / num_directions - mean * mean, 0.0) / max(num_directions - 1, 1))
    image, sigma = np.zeros((2, len(pixels), 3), np.float32)
    image[rows], sigma[rows] = mean, error
    return image, sigma
