"""Rays that leave the lights for the medium (section III-A, "Initializing the light rays"): stratified, with their power.

Directional lights: a square lattice across the beam; point and spot lights: a Fibonacci spiral over the cone that holds
the medium; area and environment lights: a low-discrepancy sequence. `reflected` makes the second source, light that left
lit surfaces. All on the host, once per picture.
"""

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxvol import emission, extinction, lights, materials, ray_casting, sampling, segments
from jaxvol.types import Scene

_GOLDEN = math.pi * (3.0 - math.sqrt(5.0))


class LightRays(NamedTuple):
    """Numpy arrays; power in W, to be marched from the origin on, at most t_max."""

    origin: np.ndarray  # [n, 3]
    direction: np.ndarray  # [n, 3]
    power: np.ndarray  # [n, 3]
    t_max: np.ndarray  # [n]


def kronecker(count: int, dimensions: int, seed: int) -> np.ndarray:
    """[count, dimensions] points of the generalised golden-ratio sequence, shifted by the seed."""
    root = 1.5
    for _ in range(64):
        root = (1.0 + root) ** (1.0 / (dimensions + 1))
    alpha = root ** -np.arange(1.0, dimensions + 1)
    shift = np.random.default_rng(seed).random(dimensions)
    return np.clip((shift + np.arange(1, count + 1)[:, None] * alpha) % 1.0, 1e-6, 1.0 - 1e-6)


def from_lights(
    scene: Scene, low: np.ndarray, high: np.ndarray, voxel: float, *, rays_per_voxel: float, seed: int
) -> LightRays:
    """Rays from every light into the box [low, high], about `rays_per_voxel` per voxel face across the beam; shadows apply."""
    center, radius = 0.5 * (low + high), 0.5 * float(np.linalg.norm(high - low)) * 1.0001
    back = 2.0 * float(emission.bounding_sphere(scene)[1])  # before any surface, for lights at infinity
    across = max(int(rays_per_voxel * math.pi * (radius / voxel) ** 2), 64)
    parts = []
    if scene.directional_lights is not None:
        suns = scene.directional_lights
        for d, e in zip(np.asarray(suns.direction, float), np.asarray(suns.irradiance, float), strict=True):
            parts.append(_parallel(d, e, low, high, voxel / math.sqrt(rays_per_voxel), back))
    if scene.point_lights is not None:
        bulbs = scene.point_lights
        for p, i in zip(np.asarray(bulbs.position, float), np.asarray(bulbs.intensity, float), strict=True):
            parts.append(_cone(p, i, center, radius, across))
    if scene.spot_lights is not None:
        spots = scene.spot_lights
        for k in range(spots.position.shape[0]):
            parts.append(_spot(spots, k, center, radius, across))
    if scene.area_lights is not None:
        parts.append(_area(scene, center, radius, 4 * across, seed))
    if scene.environment is not None:
        parts.append(_environment(scene, center, radius, 4 * across, back, seed))
    if not parts:
        empty = np.zeros((0, 3))
        return LightRays(empty, empty, empty, np.zeros(0))
    origin, direction, power = (np.concatenate([p[k] for p in parts]) for k in range(3))
    kept = _meets_box(origin, direction, low, high) & (power.max(1) > 0)
    return _with_shadows(scene, origin[kept], direction[kept], power[kept])


def _meets_box(origin, direction, low, high):
    with np.errstate(divide="ignore", invalid="ignore"):
        a, b = (low - origin) / direction, (high - origin) / direction
    near = np.nanmax(np.minimum(a, b), axis=1)
    far = np.nanmin(np.maximum(a, b), axis=1)
    return (near < far) & (far > 0)


def _with_shadows(scene, origin, direction, power):
    origin, direction = origin.astype(np.float32), direction.astype(np.float32)
    t_max = np.full(len(origin), np.inf, np.float32)
    if scene.mesh is not None and len(origin):
        caster = ray_casting.caster_for(scene.mesh)
        t_max = np.array(ray_casting.intersect(caster, origin, direction, t_max)[0])
    return LightRays(origin, direction, power.astype(np.float32), t_max)


def _basis(direction):
    s, t = sampling.orthonormal_basis(jnp.asarray(direction, jnp.float32))
    return np.asarray(s, float), np.asarray(t, float)


def _parallel(direction, irradiance, low, high, spacing, back):
    s, t = _basis(direction)
    corners = np.array([[x, y, z] for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (low[2], high[2])])
    u, v, w = corners @ s, corners @ t, corners @ direction
    nu, nv = (max(int(np.ceil((c.max() - c.min()) / spacing)), 1) for c in (u, v))
    du, dv = (u.max() - u.min()) / nu, (v.max() - v.min()) / nv
    i, j = (a.ravel() for a in np.meshgrid(np.arange(nu), np.arange(nv), indexing="ij"))
    # even rows, each shifted by the golden ratio: at random places in their squares rays give voxels more and less light (30
    # times the squared error), and without shifts they meet the voxels of an axis-parallel grid at the same few places
    shift = (0.5 + (math.sqrt(5.0) - 1.0) / 2.0 * i) % 1.0
    across = (u.min() + (i + 0.5) * du)[:, None] * s + (v.min() + (j + shift) * dv)[:, None] * t
    origin = across + (w.min() - back) * direction
    return origin, np.broadcast_to(direction, origin.shape), np.broadcast_to(irradiance * du * dv, origin.shape)


def _spiral(axis, cos_angle, count):
    """Directions evenly over a cone, and their solid angle each."""
    z = 1.0 - (np.arange(count) + 0.5) / count * (1.0 - cos_angle)
    r, phi = np.sqrt(np.maximum(1.0 - z * z, 0.0)), _GOLDEN * np.arange(count)
    s, t = _basis(axis)
    directions = (r * np.cos(phi))[:, None] * s + (r * np.sin(phi))[:, None] * t + z[:, None] * axis
    return directions, 2.0 * math.pi * (1.0 - cos_angle) / count


def _towards(position, center, radius):
    """Axis and cosine of the half-angle of the cone from a point that holds a sphere; the whole sphere from inside."""
    delta = center - position
    distance = float(np.linalg.norm(delta))
    if distance <= radius:
        return np.array([0.0, 0.0, 1.0]), -1.0
    return delta / distance, math.sqrt(max(1.0 - (radius / distance) ** 2, 0.0))


def _cone(position, intensity, center, radius, count):
    axis, cosine = _towards(position, center, radius)
    if cosine < 0:
        count *= 4
    directions, solid = _spiral(axis, cosine, count)
    shape = directions.shape
    return np.broadcast_to(position, shape), directions, np.broadcast_to(intensity * solid, shape)


def _spot(spots, k, center, radius, count):
    position = np.asarray(spots.position[k], float)
    axis, cosine = _towards(position, center, radius)
    own = math.cos(float(spots.cutoff[k]))
    if own > cosine:
        axis, cosine = np.asarray(spots.direction[k], float), own
    directions, solid = _spiral(axis, cosine, count)
    falloff = np.asarray(lights.spot_falloff(spots, jnp.full(count, k), jnp.asarray(directions, jnp.float32)))
    power = falloff[:, None] * solid * np.asarray(spots.intensity[k], float)
    return np.broadcast_to(position, directions.shape), directions, power


def _area(scene, center, radius, count, seed):
    mesh, area = scene.mesh, scene.area_lights
    u = kronecker(count, 5, seed)
    face = np.asarray(area.face)[np.minimum(np.searchsorted(np.asarray(area.cdf), u[:, 4]), len(area.cdf) - 1)]
    corners = np.asarray(mesh.vertices, float)[np.asarray(mesh.faces)[face]]
    w1, w2 = (np.asarray(w, float) for w in sampling.sample_triangle(jnp.asarray(u[:, 0]), jnp.asarray(u[:, 1])))
    edge, other = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    point = corners[:, 0] + w1[:, None] * edge + w2[:, None] * other
    normal = np.cross(edge, other)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    delta = center - point
    distance = np.linalg.norm(delta, axis=1)
    sine = np.minimum(radius / np.maximum(distance, 1e-20), 1.0)
    cosine = np.where(distance > radius, np.sqrt(np.maximum(1 - sine * sine, 0)), -1.0)
    axis = delta / np.maximum(distance, 1e-20)[:, None]
    z = 1.0 - u[:, 2] * (1.0 - cosine)
    r, phi = np.sqrt(np.maximum(1 - z * z, 0)), 2 * math.pi * u[:, 3]
    s, t = (np.asarray(b, float) for b in sampling.orthonormal_basis(jnp.asarray(axis, jnp.float32)))
    direction = (r * np.cos(phi))[:, None] * s + (r * np.sin(phi))[:, None] * t + z[:, None] * axis
    emitted = np.asarray(mesh.emission, float)[face]
    density = np.asarray(lights.luminance(jnp.asarray(emitted, jnp.float32))) / float(area.total)
    solid = 2 * math.pi * (1.0 - cosine)
    lambert = np.maximum(np.sum(normal * direction, axis=1), 0.0)
    power = emitted * (lambert * solid / (density * count))[:, None]
    return point + 1e-4 * radius * normal, direction, power


def _environment(scene, center, radius, count, back, seed):
    u = kronecker(count, 4, seed)
    u1, u2 = (jnp.asarray(u[:, k], jnp.float32) for k in (0, 1))
    towards, pdf = lights.sample_environment(scene.environment, u1, u2)
    radiance = np.asarray(lights.environment_radiance(scene.environment, towards), float)
    direction = -np.asarray(towards, float)
    s, t = (np.asarray(b, float) for b in sampling.orthonormal_basis(jnp.asarray(direction, jnp.float32)))
    r, phi = radius * np.sqrt(u[:, 2]), 2 * math.pi * u[:, 3]
    origin = center - (radius + back) * direction + (r * np.cos(phi))[:, None] * s + (r * np.sin(phi))[:, None] * t
    return origin, direction, radiance * (math.pi * radius**2 / (np.asarray(pdf, float) * count))[:, None]


def reflected(scene: Scene, low: np.ndarray, high: np.ndarray, *, count: int, seed: int) -> LightRays:
    """Rays that leave surfaces lit by the lights (one Lambertian reflection), into the box; weighted by what reached them.

    The way from the light to the surface is attenuated by the medium. Light reflected more than once is missed.
    """
    columns = np.asarray(kronecker(count, 8, seed + 1).T, np.float32)
    caster, scale = ray_casting.caster_for(scene.mesh), ray_casting.scene_scale(scene.mesh)
    start, way, power = (np.asarray(x) for x in _sent(scene, scale, *columns[:5]))
    infinite = np.full(count, np.inf, np.float32)
    t, face = ray_casting.intersect(caster, start, way, infinite)
    power = power.astype(float) / count
    if scene.medium is not None:
        thickness = extinction.optical_thickness(
            scene.medium,
            start,
            way,
            np.where(np.isfinite(t), t, 0.0).astype(np.float32),
            casters=segments.medium_casters(scene.medium),
            num_steps=64,
        )
        power = power * np.exp(-np.asarray(thickness, float))
    found = _reflected(scene.mesh, scale, start, way, t, face, *columns[5:7])
    origin, direction, share = (np.asarray(x, float) for x in found)
    power = power * share
    kept = (power.max(1) > 0) & _meets_box(origin, direction, low, high)
    return _with_shadows(scene, origin[kept], direction[kept], power[kept])


@jax.jit
def _sent(scene, scale, *u):
    """(origin, direction, power) of rays from the lights."""
    sent = emission.sample_emission(scene, *u)
    beside = ray_casting.offset_origin(sent.position, sent.normal, sent.direction, scale=scale)
    return jnp.where(sent.on_surface[:, None], beside, sent.position), sent.direction, sent.power


@jax.jit
def _reflected(mesh, scale, start, way, t, face, *u):
    """(origin, direction, share of the power) of what rays that hit the mesh send on; 0 for those that miss."""
    hits = ray_casting.hits(mesh, start, way, t, face)
    surface = materials.surface_at(mesh, jnp.maximum(hits.face, 0))
    normal = materials.facing_normal(hits.normal, way)
    out = sampling.sample_cosine_hemisphere(*u, normal)
    origin = ray_casting.offset_origin(hits.position, normal, out, scale=scale)
    return origin, out, jnp.where(hits.valid[:, None], surface.albedo, 0.0)
