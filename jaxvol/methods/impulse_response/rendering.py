"""Stage 4, rendering: what eye rays meet first, shaded with the baked quantities."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from jaxvol import camera as cameras
from jaxvol import first_hit, materials, sampling, zonal_lookup
from jaxvol.layers import SURFACE, from_items
from jaxvol.methods.impulse_response import estimate, gather, planning, radiosity
from jaxvol.methods.impulse_response.kit import Kit, Tally, thickness
from jaxvol.methods.impulse_response.planning import Plan
from jaxvol.methods.impulse_response.receivers import Irradiance, Reflection
from jaxvol.types import Camera, Estimate, Rays, Scene

_STREAM = sampling.stream("impulse_response.pixels")


def render(
    scene: Scene,
    camera: Camera,
    plan: Plan,
    *,
    seed: int = 0,
    samples: int = 16,
    tables: zonal_lookup.ZonalTables | None = None,
    on_progress: Callable[[float], None] | None = None,
) -> Estimate:
    """Reflected light of the first surfaces, attenuated on its way to the eye, by layer; box-filtered pixels.

    Raises ValueError for samples < 1. Cost: `samples` surface paths a pixel.
    """
    if samples < 1:
        raise ValueError(f"samples: {samples} is not allowed, must be >= 1")
    kit = planning.prepare(scene, plan, responses_from=tables)
    tally = Tally()
    total = camera.height * camera.width
    lanes = estimate.lanes_for(total, plan.num_lanes)
    kit = radiosity.cached(kit, *_first_surfaces(kit, camera, total, lanes), plan, num_paths=samples * total, seed=seed)
    mean = {name: np.zeros((total, 3)) for name in SURFACE}
    square = {name: np.zeros((total, 3)) for name in SURFACE}
    for sample in range(samples):
        for first in range(0, total, lanes):
            pixel = jnp.minimum(first + jnp.arange(lanes), total - 1)
            found = _one_sample(kit, camera, pixel, jnp.full(lanes, sample, jnp.int32), jnp.uint32(seed), tally)
            rows = slice(first, min(first + lanes, total))
            for name, value in found.items():
                value = np.asarray(value, np.float64)[: total - first]
                mean[name][rows] += value
                square[name][rows] += value * value
            if on_progress is not None:
                on_progress((sample + min(first + lanes, total) / total) / samples)
    shape = (camera.height, camera.width, 3)
    means, variances = {}, {}
    for name in SURFACE:
        average = mean[name] / samples
        spread = np.maximum(square[name] / samples - average**2, 0) / max(samples - 1, 1)
        # As in `estimate.bake`, no light is negative.
        means[name] = jnp.asarray(np.maximum(average, 0).astype(np.float32).reshape(shape))
        variances[name] = jnp.asarray(spread.astype(np.float32).reshape(shape))
    return Estimate(mean=from_items(means), variance=from_items(variances), num_samples=jnp.float32(samples))


def _first_surfaces(kit, camera, total, lanes):
    """Points and normals that some of the pixels see."""
    rays = _pixel_rays(camera, jnp.arange(lanes) * total // lanes, jnp.zeros(lanes, jnp.int32), jnp.uint32(0))
    hits = first_hit.first_hits(kit.scene, rays, kit.caster)
    normal = _receiver(kit.scene.mesh, hits, rays.direction).normal
    seen = np.flatnonzero(np.asarray(hits.valid))
    return np.asarray(hits.position)[seen], np.asarray(normal)[seen]


@jax.jit
def _pixel_rays(camera, pixel, sample, seed):
    u = sampling.uniforms(seed, _STREAM, pixel, 0, sample)
    row = pixel // camera.width
    xy = jnp.stack([pixel - row * camera.width + u[0], row + u[1]], axis=-1)
    return cameras.generate_rays(camera, xy)


@jax.jit
def _receiver(mesh, hits, direction):
    """The surfaces as the eye sees them, on its side."""
    side = jnp.where(sampling.dot(hits.normal, direction) > 0, -1.0, 1.0)
    normal = jnp.where(hits.valid[:, None], hits.normal * side[:, None], -direction)
    if mesh.specular is None:
        return Irradiance(normal)
    surface = materials.surface_at(mesh, hits.face)
    mirrored = materials.mirror(normal, direction)
    return Reflection(normal, mirrored, surface.albedo, surface.specular, surface.exponent)


@jax.jit
def _reflect(mesh, face, valid, through, layers):
    weight = jnp.where(valid, 1.0, 0.0)[:, None]
    if mesh.specular is None:
        weight = weight * mesh.albedo[jnp.maximum(face, 0)] / jnp.pi
    if through is not None:
        weight = weight * through
    return {name: weight * value for name, value in layers.items()}


def _one_sample(kit: Kit, camera, pixel, sample, seed, tally):
    rays: Rays = _pixel_rays(camera, pixel, sample, seed)
    hits = first_hit.first_hits(kit.scene, rays, kit.caster)
    receiver = _receiver(kit.scene.mesh, hits, rays.direction)
    direct, once, more, _ = gather.delta_arrivals(kit, receiver, hits.position, tally)
    layers = {name: jnp.zeros_like(direct) for name in SURFACE}
    if estimate.needs_paths(kit):
        found = gather.path_arrivals(kit, receiver, hits.position, pixel, sample, seed, tally)
        layers = {name: found[name] for name in SURFACE}
    for name, value in (("surface_from_light", direct), ("surface_from_volume", once), ("surface_from_multiple", more)):
        layers[name] = layers[name] + value
    thick = thickness(kit, rays.origin, rays.direction, jnp.where(hits.valid, hits.t, 0.0))
    through = None if thick is None else jnp.exp(-thick)
    return _reflect(kit.scene.mesh, hits.face, hits.valid, through, layers)
