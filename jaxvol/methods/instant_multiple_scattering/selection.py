"""Trace many light paths, gather few of their lights: those that sparse pixels see most (beyond the paper).

Tracing a path costs as much as some hundred pairs, gathering its lights as many pairs as there are pixels. So the lights
of many paths are weighed by what a few pilot pixels see of each, in shares of the pixel (rows of the light matrix: Hasan,
Pellacini and Bala 2007), and some of them are kept with a probability proportional to that, spread evenly over space.
Dark parts of the picture then have as many lights as bright ones. Unbiased: a light that is kept is weighted up, and none
has probability zero. Visibility and the grid's own transmittance are left out of the weighing, not of the gathering.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int

from jaxvol import camera as pinhole
from jaxvol import materials, media, ray_casting, sampling
from jaxvol.methods.instant_multiple_scattering import compensation, gathering, pairs
from jaxvol.methods.instant_multiple_scattering.planning import Plan
from jaxvol.methods.instant_multiple_scattering.receivers import Points, Segments
from jaxvol.methods.instant_multiple_scattering.virtual_lights import LightSet, VirtualLights, blocks, capacity
from jaxvol.types import Camera, Scene

_SELECTION = sampling.stream("instant_multiple_scattering.selection")
_PILOTS = 8  # pilot pixels, each way
_FLOOR = 0.1  # share of the choice that goes by power alone
_MIDDLE = 0.4  # of the angle that a ray subtends at a light: where the pilots meet it
_BITS = 10  # of a coordinate in the order along which lights are spread


class Pilots(NamedTuple):
    """Eye rays of sparse pixels with their first hits."""

    segments: Segments | None
    points: Points | None  # where they meet surfaces
    seen: Float[Array, "p"] | None  # 1 where they do


def pilots(scene: Scene, caster: ray_casting.Caster, camera: Camera, *, seed: int) -> Pilots:
    """One eye ray in each of 8 x 8 parts of the picture."""
    origin, direction = _pilot_rays(camera, jnp.uint32(seed))
    if scene.mesh is None:
        return Pilots(_segments(scene.medium, origin, direction, jnp.inf), None, None)
    t, face = ray_casting.intersect(caster, origin, direction, np.inf)
    return _pilots_on(scene, origin, direction, jnp.asarray(t), jnp.asarray(face))


@jax.jit
def _pilot_rays(camera, seed):
    index = jnp.arange(_PILOTS * _PILOTS, dtype=jnp.uint32)
    u = jnp.stack(sampling.uniforms(seed, _SELECTION, index, 0)[:2], axis=-1)
    cell = jnp.stack([index % _PILOTS, index // _PILOTS], axis=-1).astype(jnp.float32)
    xy = (cell + u) * jnp.asarray([camera.width / _PILOTS, camera.height / _PILOTS], jnp.float32)
    rays = pinhole.generate_rays(camera, xy)
    return rays.origin, rays.direction


@jax.jit
def _segments(medium, origin, direction, t):
    if medium is None:
        return None
    t0, t1 = media.box_interval(medium.bounds, origin, direction)
    return Segments(origin, direction, t0, jnp.maximum(jnp.minimum(t1, t), t0), None)


@jax.jit
def _pilots_on(scene, origin, direction, t, face):
    hit = ray_casting.hits(scene.mesh, origin, direction, t, face)
    surface = materials.surface_at(scene.mesh, face)
    dark = jnp.zeros(origin.shape, jnp.float32)
    points = Points(hit.position, -direction, dark, None, hit.valid, hit.normal, surface)
    return Pilots(_segments(scene.medium, origin, direction, t), points, hit.valid.astype(jnp.float32))


@partial(jax.jit, static_argnames="isotropic")
def importance(
    scene: Scene, camera: Camera, rows: Pilots, lights: VirtualLights, clamp: Float[Array, ""], *, isotropic: bool
) -> Float[Array, "M"]:
    """Root mean square over the pilots of each light's share of what the pilot sees, [M].

    The geometry term is bounded at half the distance between neighbouring pilots (at least at `clamp`): a pilot stands for
    the pixels around it. Lights lie along the lanes, a scan runs over the pilots.
    """
    light = gathering.rows(lights)
    spacing = jnp.tan(0.5 * camera.fov_y) * (1.0 / _PILOTS)
    eye = camera.world_from_camera[:3, 3]
    offset = lights.position - eye
    soft = jnp.maximum(spacing * jnp.sqrt(sampling.dot(offset, offset)), clamp)
    density = 1.0
    sigma = jnp.float32(0.0)
    if scene.medium is not None:
        density = 1.0 if scene.medium.density is None else jnp.mean(scene.medium.density)
        sigma = jnp.mean(media.sigma_t(scene.medium)) * density

    def body(total, row):
        value = jnp.zeros_like(soft)
        if row.segments is not None:
            value = value + density * _along(row.segments, light, scene.medium, soft, sigma, isotropic)
        if row.points is not None:
            length = jnp.sqrt(sampling.dot(row.points.position - eye, row.points.position - eye))
            seen, _ = gathering.reflected_estimate(row.points, light, scene.medium, soft, sigma, isotropic=isotropic)
            value = value + row.seen * gathering.floored_exp(sigma * length) * seen
        share = value / jnp.maximum(jnp.sum(value), 1e-30)
        return total + share * share, None

    total, _ = lax.scan(body, jnp.zeros_like(soft), rows)
    return jnp.sqrt(total * (1.0 / (_PILOTS * _PILOTS)))


def _along(segment, light, medium, soft, sigma, isotropic):
    """What one eye ray sees of every light, without occlusion, at the mean extinction."""
    origin, direction = pairs.components(segment.origin), pairs.components(segment.direction)
    soft_segment = Segments(segment.origin, segment.direction, segment.t0, segment.t1, soft)
    point = gathering.choose_point(origin, direction, soft_segment, light.position, jnp.float32(_MIDDLE), stratified=False)
    sent, factor = gathering.leaving(light, point.towards, medium, isotropic=isotropic)
    f = gathering.phase_value(medium, -pairs.dot(point.towards, direction), isotropic=isotropic)
    depth = sigma * (point.distance + point.t - segment.t0)
    value = pairs.mean(sent) * factor * point.weight * f * pairs.mean(medium.sigma_s) * gathering.floored_exp(depth)
    return jnp.where(segment.t1 > segment.t0, value, 0.0)


def place_along_curve(position: Float[np.ndarray, "n 3"]) -> Int[np.ndarray, "n"]:
    """Number of each point's cell along a Z-order curve through the box of all points (host)."""
    low, high = position.min(axis=0), position.max(axis=0)
    scaled = (position - low) / np.maximum(high - low, 1e-30) * (2**_BITS - 1)
    cell = scaled.astype(np.int64)
    code = np.zeros(len(position), np.int64)
    for bit in range(_BITS):
        for axis in range(3):
            code |= ((cell[:, axis] >> bit) & 1) << (3 * bit + axis)
    return code


def systematic(weight: Float[np.ndarray, "n"], number: int, u: float) -> Int[np.ndarray, "number"]:
    """`number` rows in proportion to their weight, evenly spaced along the list; heavy rows may come several times."""
    reach = np.cumsum(weight, dtype=np.float64)
    marks = (np.arange(number) + u) * (reach[-1] / number)
    return np.minimum(np.searchsorted(reach, marks, side="right"), len(weight) - 1)


def select(
    scene: Scene,
    caster: ray_casting.Caster,
    camera: Camera,
    lights: LightSet,
    plan: Plan,
    *,
    seed: int,
    sizes: dict[str, int] | None = None,
) -> LightSet:
    """About `plan.max_lights` of the lights of all kinds together, weighted up; the set itself where it has no more.

    `sizes` are array sizes of each kind to keep where they are given, so that the next set needs no compilation.
    """
    parts = blocks(lights)
    number = plan.max_lights
    if number is None or sum(block.position.shape[0] for _, block in parts) <= number:
        return lights
    rows = pilots(scene, caster, camera, seed=seed)
    clamp = _clamp(scene, plan)
    measure = partial(importance, scene, camera, rows, clamp=clamp, isotropic=plan.isotropic)
    weights, powers = {}, {}
    longest = 1 << (max(block.position.shape[0] for _, block in parts) - 1).bit_length()
    for name, block in parts:
        weights[name] = np.asarray(measure(_longer(block, longest)), np.float64)[: block.position.shape[0]]
        powers[name] = _power(block)
    total, power = (sum(x.sum() for x in values.values()) for values in (weights, powers))
    rng = np.random.default_rng([seed & 0xFFFFFFFF, _SELECTION])
    shares = {
        name: (1.0 - _FLOOR) * weights[name] / max(total, 1e-300) + _FLOOR * powers[name] / max(power, 1e-300)
        for name in weights
    }
    counts = even_counts({name: round(number * weight.sum()) for name, weight in shares.items()})
    found = {}
    for name, block in parts:
        weight, live = shares[name], np.flatnonzero(powers[name] > 0)
        count = (sizes or {}).get(name) or counts[name]
        if len(live) <= count:
            found[name] = block
            continue
        order = live[np.argsort(place_along_curve(np.asarray(block.position)[live]), kind="stable")]
        chosen = order[systematic(weight[order], count, rng.random())]
        found[name] = _taken(block, chosen, weight[order].sum() / (count * weight[chosen]))
    return LightSet(**found)


def even_counts(counts: dict[str, int]) -> dict[str, int]:
    """Array sizes for so many lights of each kind: one for both kinds in the medium, and for both on surfaces, where their
    numbers are within a factor of two.

    Each size is a program of its own. At a factor of two as many of both have a tenth more variance than the best numbers.
    """
    found = dict(counts)
    for place in ("volume", "surface"):
        kinds = [name for name in counts if name.startswith(place)]
        if kinds and max(counts[name] for name in kinds) <= 2 * min(counts[name] for name in kinds):
            found |= dict.fromkeys(kinds, sum(counts[name] for name in kinds) // len(kinds))
    return {name: capacity(count) for name, count in found.items()}


@partial(jax.jit, static_argnames="plan")
def _clamp(scene, plan):
    """The clamp distance at the mean density; hardly any where nothing is clamped."""
    if plan.mean_free_paths is None:
        return 1e-6 * compensation.most_clamp(scene, plan.most_clamp)
    return compensation.clamp_at(scene, None, jnp.zeros((1, 3), jnp.float32), plan=plan)[0]


def _longer(block, size):
    """Dark lights up to a common number: kinds that are alike share a program."""

    def extended(x):
        return np.concatenate([np.asarray(x), np.zeros((size - x.shape[0], *x.shape[1:]), np.float32)])

    return jax.tree.map(extended, block)


def _power(block):
    sent = [block.strength] if block.specular is None else [block.strength, block.specular]
    return sum(np.asarray(x, np.float64).mean(axis=-1) for x in sent)


def _taken(block, chosen, scale):
    """The chosen rows, stronger by `scale`."""
    part = jax.tree.map(lambda x: np.asarray(x)[chosen], block)
    scale = np.asarray(scale, np.float32)[:, None]
    specular = None if part.specular is None else part.specular * scale
    found = VirtualLights(part.position, part.direction, part.strength * scale, part.normal, specular, part.exponent)
    return jax.tree.map(jnp.asarray, found)
