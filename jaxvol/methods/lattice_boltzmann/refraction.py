"""Eye rays through refractive bodies: Fresnel at the entry, the bent march, and what lies behind.

The smoothed index bends but does not reflect, so the entry takes Fresnel's factor once, at the mesh's normal: 1 - F goes
in, F times what the mirrored ray sees is added. What lies behind is seen along the exit direction.
"""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np

from jaxvol import direct, media, ray_casting
from jaxvol.methods.lattice_boltzmann import fresnel
from jaxvol.methods.lattice_boltzmann.occupancy import to_voxels
from jaxvol.methods.lattice_boltzmann.view import gather_bent
from jaxvol.types import Rays, Scene


def radiance_bent(scene: Scene, plan, materials, table, layout, origin, direction, t_max, *, seed=0):
    """(volume radiance [n, L, C], {emission, surface_from_light}) along rays from outside the body."""
    volume = np.zeros((len(origin), layout.num_layers, plan.num_channels), np.float32)
    t_entry, normal = body_entry(scene, origin, direction, t_max)
    blocked = np.full(len(origin), np.inf, np.float32)
    if scene.mesh is not None:
        blocked = np.array(ray_casting.intersect(ray_casting.caster_for(scene.mesh), origin, direction, t_max)[0])
    enters = np.flatnonzero(np.isfinite(t_entry) & (t_entry < blocked))
    ior = float(np.max(np.asarray(scene.medium.ior))) if scene.medium.ior is not None else 1.0
    cosine = np.abs(np.sum(normal[enters] * direction[enters], axis=1))
    mirror = np.asarray(fresnel.reflectance(jnp.asarray(cosine), ior)) if ior != 1.0 else np.zeros(len(enters))
    grid = materials.grid
    start = _entry_points(grid, origin[enters], direction[enters], t_entry[enters], plan.filter_width)
    found, through, exits, heading = gather_bent(
        materials, table, layout, start, direction[enters],
        step=plan.march_step, integrator=plan.integrator, degree=plan.degree,
    )  # fmt: skip
    passed = (1.0 - mirror).astype(np.float32)
    volume[enters] = found * passed[:, None, None]
    # camera rays that miss the body, the bent rays behind it, and the mirrored ones at its surface
    misses = np.ones(len(origin), bool)
    misses[enters] = False
    ahead = np.flatnonzero(misses)
    point = origin[enters] + direction[enters] * t_entry[enters, None]
    mirrored = direction[enters] + 2.0 * cosine[:, None] * _facing(normal[enters], direction[enters])
    origins = np.concatenate(
        [origin[ahead], exits, point + 1e-3 * float(grid.voxel) * _facing(normal[enters], direction[enters])]
    )
    headings = np.concatenate([direction[ahead], heading, mirrored])
    reach = np.concatenate([t_max[ahead], np.full(2 * len(enters), np.inf, np.float32)])
    seen = _background(scene, origins, headings, reach, seed)
    if materials.solid is not None:
        _see_inside(scene, materials, seen, slice(len(ahead), len(ahead) + len(enters)), exits, heading, seed)
    spectral = np.broadcast_to(through, (len(enters), 3)) if plan.num_channels == 1 else through
    rest = {}
    for name, value in seen.items():
        image = np.zeros((len(origin), 3), np.float32)
        image[ahead] = value[: len(ahead)]
        image[enters] = value[len(ahead) : len(ahead) + len(enters)] * spectral * passed[:, None]
        reflected = np.zeros_like(image)
        reflected[enters] = value[len(ahead) + len(enters) :] * mirror[:, None]
        if name == "emission":  # a mirror is a surface: what it shows has one more vertex
            rest["surface_from_light"] = rest.get("surface_from_light", 0.0) + reflected
        rest[name] = rest.get(name, 0.0) + image
    return volume, rest


def _see_inside(scene, materials, seen, rows, exits, heading, seed):
    """Replace what the bent rays see that end at opaque surfaces: lit through the medium, along straight ways to lights."""
    grid = materials.grid
    at = np.floor((exits - np.asarray(grid.lower)) / float(grid.voxel)).astype(int)
    within = np.all((at >= 0) & (at < np.array(grid.shape)), axis=1)
    at = np.clip(at, 0, np.array(grid.shape) - 1)
    ended = np.flatnonzero(within & np.asarray(materials.solid)[tuple(at.T)])
    if len(ended) == 0:
        return
    back = (2.0 * float(grid.voxel)) * heading[ended]
    before = np.floor((exits[ended] - back - np.asarray(grid.lower)) / float(grid.voxel)).astype(int)
    before = tuple(np.clip(before, 0, np.array(grid.shape) - 1).T)
    twice = 2.0 * np.asarray(materials.scattering + materials.absorption)[:, before[0], before[1], before[2]].T
    reach = np.full(len(ended), 6.0 * float(grid.voxel), np.float32)
    straight = replace(scene, medium=_without_index(scene.medium))
    found = _background(straight, exits[ended] - back, heading[ended], reach, seed, keep_medium=True)
    for name, value in found.items():
        seen[name][rows][ended] = value * np.exp(twice)  # this piece of the way was marched already


def _without_index(medium):
    return replace(medium, ior=None, inclusions=tuple(_without_index(part) for part in medium.inclusions))


def body_entry(scene: Scene, origin, direction, t_max):
    """(distance, outward normal) where rays meet the body, its mesh or its box; inf on a miss."""
    medium = scene.medium
    if medium.boundary is None:
        t0, t1 = (np.array(x) for x in media.box_interval(medium.bounds, jnp.asarray(origin), jnp.asarray(direction)))
        t = np.where((t1 > t0) & (t0 < t_max), t0, np.inf)
        point = origin + direction * np.where(np.isfinite(t), t, 0.0)[:, None]
        low, high = np.asarray(medium.bounds)
        unit = (2.0 * point - low - high) / (high - low)
        normal = np.zeros_like(unit)
        axis = np.argmax(np.abs(unit), axis=1)
        normal[np.arange(len(unit)), axis] = np.sign(unit[np.arange(len(unit)), axis])
        return t, normal
    caster = ray_casting.caster_for(medium.boundary)
    t, face = ray_casting.intersect(caster, origin, direction, t_max)
    hits = ray_casting.hits(medium.boundary, origin, direction, t, face)
    return np.array(t), np.asarray(hits.normal)


def _facing(normal, direction):
    return np.where(np.sum(normal * direction, axis=1, keepdims=True) > 0, -normal, normal)


def _entry_points(grid, origin, direction, t_entry, filter_width):
    """A filter's reach before the surface, but inside the grid (the index is 1 there)."""
    _, _, t0, _ = to_voxels(grid, origin, direction, np.full(len(origin), np.inf))
    back = t_entry / float(grid.voxel) - np.ceil(3.0 * filter_width)
    t = np.maximum(t0 + 1e-3, back) * float(grid.voxel)
    return origin + direction * t[:, None].astype(np.float32)


def _background(scene, origin, direction, t_max, seed, *, keep_medium=False):
    """Surfaces under direct light, emissive surfaces and the environment, without the medium."""
    empty = scene if keep_medium else replace(scene, medium=None)
    layers = {}
    if scene.mesh is None and scene.environment is None:
        nothing = np.zeros((len(origin), 3), np.float32)
        return {"emission": nothing, "surface_from_light": nothing}
    settings = direct.plan(empty, None, samples_per_pixel=1)
    rays = Rays(*(jnp.asarray(x, jnp.float32) for x in (origin, direction, t_max)))
    found = direct.radiance(empty, rays, settings, seed=seed)
    for name in ("emission", "surface_from_light"):
        value = getattr(found, name)
        layers[name] = np.zeros((len(origin), 3), np.float32) if value is None else np.array(value)
    return layers
