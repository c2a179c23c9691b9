"""Light of every virtual light at every receiver, where a pair is cheap: homogeneous medium, nothing that occludes.

Receivers lie along the lanes, a scan runs over the lights (section 4.2; specification 2 and 5). An eye ray meets each
light at one point of its own, chosen by softened equi-angular sampling, or, as the paper does, at stratified points.
"""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

from jaxvol import media, phase
from jaxvol.methods.instant_multiple_scattering import pairs
from jaxvol.methods.instant_multiple_scattering.pairs import Vector
from jaxvol.methods.instant_multiple_scattering.receivers import Points, Segments
from jaxvol.methods.instant_multiple_scattering.virtual_lights import VirtualLights
from jaxvol.types import Medium

_TILE = 1024  # receivers whose numbers stay in the cache
_WIDTH = 16384  # lanes of a step: enough to hide the steps' overhead
_INV_4PI = 0.07957747154594767
_THICKEST = 30.0  # optical thickness at which estimates stop falling


class Light(NamedTuple):
    """One virtual light, or one per lane; see `VirtualLights`."""

    position: Vector
    direction: Vector
    strength: Vector
    normal: Vector | None
    specular: Vector | None
    exponent: Float[Array, "*n"] | None


def rows(lights: VirtualLights) -> Light:
    """The lights as component arrays [M], to scan over."""
    vector = lambda v: None if v is None else pairs.components(v)  # noqa: E731
    return Light(
        pairs.components(lights.position),
        pairs.components(lights.direction),
        pairs.components(lights.strength),
        vector(lights.normal),
        vector(lights.specular),
        lights.exponent,
    )


def phase_value(medium: Medium, cos_theta: Float[Array, "*n"], *, isotropic: bool) -> Float[Array, "*n"] | float:
    """The phase function, 1/sr; `isotropic` promises g = 0."""
    if isotropic:
        return _INV_4PI
    if medium.phase is not None:
        return phase.evaluate_table(medium.phase, cos_theta)
    return pairs.henyey_greenstein(cos_theta, medium.g)


def lobe(exponent: Float[Array, "*n"], cos_theta: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """max(cos, 0)^exponent as an exponential; 0 at cos <= 0."""
    safe = jnp.clip(cos_theta, 1e-30, 1.0)
    return jnp.where(cos_theta > 0, jnp.exp(exponent * jnp.log(safe)), 0.0)


def leaving(light: Light, w: Vector, medium: Medium | None, *, isotropic: bool) -> tuple[Vector, Float[Array, "*n"] | float]:
    """What a light sends along the unit direction w, as RGB and a factor: radiance weight times emitter cosine."""
    if light.normal is None:
        return light.strength, phase_value(medium, pairs.dot(light.direction, w), isotropic=isotropic)
    cosine = jnp.maximum(pairs.dot(light.normal, w), 0.0)
    if light.specular is None:
        return light.strength, cosine
    glossy = lobe(light.exponent, pairs.dot(light.direction, w))
    return tuple(s + k * glossy for s, k in zip(light.strength, light.specular, strict=True)), cosine


def scattered(points: Points, towards: Vector, medium: Medium | None, *, isotropic: bool) -> Vector:
    """sigma_s f_p, or f_r cos, at the points for light that travels along `towards`, RGB (cosine included)."""
    outgoing = pairs.components(points.outgoing)
    if medium is None:
        value = (0.0, 0.0, 0.0)
    else:
        f = phase_value(medium, pairs.dot(towards, outgoing), isotropic=isotropic)
        value = tuple(s * f for s in pairs.components(points.scattering))
    if points.on_surface is None:
        return value
    normal = pairs.components(points.normal)
    side = jnp.where(pairs.dot(normal, outgoing) >= 0, 1.0, -1.0)
    cos_in = -pairs.dot(normal, towards)
    lit = cos_in * side > 0
    albedo = pairs.components(points.surface.albedo)
    brdf = tuple(a * (4.0 * _INV_4PI) for a in albedo)
    if points.surface.specular is not None:
        mirrored = pairs.combine(towards, 2.0 * cos_in, normal)
        scale = (points.surface.exponent + 2.0) * (2.0 * _INV_4PI)
        glossy = scale * lobe(points.surface.exponent, pairs.dot(mirrored, outgoing))
        brdf = tuple(f + s * glossy for f, s in zip(brdf, pairs.components(points.surface.specular), strict=True))
    cosine = jnp.where(lit, jnp.abs(cos_in), 0.0)
    return tuple(jnp.where(points.on_surface, f * cosine, v) for f, v in zip(brdf, value, strict=True))


def extinguish(value: Vector, scale: Float[Array, "*n"], sigma_t: Vector, column: Float[Array, "*n"], *, grey: bool) -> Vector:
    """value * scale * exp(-sigma_t column) per channel; one exponential when `grey`."""
    if grey:
        # The barrier keeps XLA from computing the factor again in each channel's loop.
        factor = lax.optimization_barrier(scale * jnp.exp(-sigma_t[0] * column))
        return tuple(v * factor for v in value)
    scale = lax.optimization_barrier(scale)
    return tuple(v * scale * jnp.exp(-s * column) for v, s in zip(value, sigma_t, strict=True))


def reflected_estimate(
    points: Points,
    light: Light,
    medium: Medium | None,
    clamp: Float[Array, "*n"] | None,
    sigma: Float[Array, ""] | float,
    *,
    isotropic: bool,
) -> tuple[Float[Array, "*n"], Float[Array, "*n"]]:
    """What points send on of lights, mean over channels, unoccluded and at the extinction `sigma`; and min(1/r^2, b)."""
    r2, distance, towards = pairs.separation(pairs.components(points.position), light.position, clamp)
    sent, factor = leaving(light, towards, medium, isotropic=isotropic)
    received = pairs.mean(scattered(points, towards, medium, isotropic=isotropic))
    bounded = pairs.inverse_square(r2, clamp)
    return pairs.mean(sent) * factor * received * bounded * floored_exp(sigma * distance), bounded


def floored_exp(depth: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """exp(-depth), at least exp(-30): an estimate that picks by it must not underflow to zero."""
    return jnp.exp(-jnp.minimum(depth, _THICKEST))


class RayPoint(NamedTuple):
    """A point of an eye ray chosen for one light."""

    t: Float[Array, "n"]
    weight: Float[Array, "n"]  # min(1/r^2, 1/clamp^2) / pdf
    distance: Float[Array, "n"]  # to the light
    towards: Vector  # unit, from the light to the point


def choose_point(
    origin: Vector, direction: Vector, segments: Segments, position: Vector, u: Float[Array, "n"], *, stratified: bool
) -> RayPoint:
    """One point of each eye ray for a light at `position`; `stratified` spreads u evenly instead (the paper)."""
    t_closest, perpendicular, h2 = pairs.closest(origin, direction, position)
    a, b = segments.t0 - t_closest, segments.t1 - t_closest
    if stratified:
        t = a + u * (b - a)
        weight = (b - a) * pairs.inverse_square(h2 + t * t, segments.clamp)
    else:
        t, weight = pairs.sample_along_ray(u, a, b, h2, segments.clamp)
    inverse = lax.rsqrt(jnp.maximum(h2 + t * t, pairs.least_distance2(segments.clamp)))
    towards = tuple((t * w - p) * inverse for w, p in zip(direction, perpendicular, strict=True))
    return RayPoint(t + t_closest, weight, (h2 + t * t) * inverse, towards)


def golden(index: Int[Array, "m"]) -> Float[Array, "m"]:
    """Multiples of the golden section, modulo 1: how far the light with this index turns a receiver's u."""
    turned = jnp.asarray(index).astype(jnp.uint32) * jnp.uint32(2654435769)
    return (turned >> 8).astype(jnp.float32) * jnp.float32(2.0**-24)


def shifted(u: Float[Array, "n"], shift: Float[Array, ""]) -> Float[Array, "n"]:
    """u turned by `shift`, modulo 1: every light meets a ray elsewhere."""
    v = u + shift
    return v - jnp.floor(v)


def add(total: Vector, value: Vector) -> Vector:
    """Sum of two vectors."""
    return total[0] + value[0], total[1] + value[1], total[2] + value[2]


def sum_over(
    function: Callable, lights: NamedTuple, sigma_t: Vector, num_lanes: int, *, grey: bool, repeats: int = 1
) -> Float[Array, "n 3"]:
    """Sum of strength * scale * exp(-sigma_t column) over all lights, (scale, column) = function(light, shift, repeat).

    `lights`: rows [M] to scan over, among them `strength`.

    The lanes are [k, n]: k lights at once, so that few receivers still give a step enough to do. What a step computes goes
    into the sum one step later, through the scan's state: XLA would else compute it again in each channel's loop.
    """
    count = lights.strength[0].shape[0]
    number = count * repeats
    k = max(1, min(_WIDTH // max(num_lanes, 1), number))
    steps = -(-number // k)

    def rows_of(x):
        return jnp.pad(jnp.repeat(x, repeats, axis=0), (0, steps * k - number)).reshape(steps, k, 1)

    def collect(total, late):
        strength, scale, column = late
        if grey:
            return tuple(t + s * scale for t, s in zip(total, strength, strict=True))
        return tuple(t + s * scale * jnp.exp(-x * column) for t, s, x in zip(total, strength, sigma_t, strict=True))

    def body(state, item):
        total, late = state
        light, shift, repeat = item
        scale, column = function(light, shift, repeat)
        if grey:
            scale, column = scale * jnp.exp(-sigma_t[0] * column), column[:1, :1]
        return (collect(total, late), (light.strength, scale, column)), None

    zero = jnp.zeros((k, num_lanes), jnp.float32)
    dark = jnp.zeros((k, 1), jnp.float32)
    index = jnp.arange(count)
    which = jnp.tile(jnp.arange(repeats, dtype=jnp.float32), count)
    items = (
        *jax.tree.map(rows_of, (lights, golden(index))),
        jnp.pad(which, (0, steps * k - number)).reshape(steps, k, 1),
    )
    start = ((zero, zero, zero), ((dark, dark, dark), zero, zero[:1, :1] if grey else zero))
    (total, late), _ = lax.scan(body, start, items)
    return jnp.stack([jnp.sum(part, axis=0) for part in collect(total, late)], axis=-1)


def in_tiles(function: Callable, *arrays: Array | None) -> Float[Array, "n 3"]:
    """function(*arrays) over tiles of the first axis that fit the cache; scalars and None go along as they are."""
    n = arrays[0].shape[0]
    tiles = max(1, n // _TILE)
    while n % tiles and tiles < 2 * n // _TILE:
        tiles += 1
    if tiles == 1 or n % tiles:
        return function(*arrays)
    parts = jax.tree.map(lambda x: x.reshape(tiles, n // tiles, *x.shape[1:]), arrays)
    return lax.map(lambda part: function(*part), parts).reshape(n, 3)


@partial(jax.jit, static_argnames=("grey", "isotropic", "stratified", "num_evaluations"))
def gather_segments(
    segments: Segments,
    u: Float[Array, "n"],
    lights: VirtualLights,
    medium: Medium,
    *,
    grey: bool,
    isotropic: bool,
    stratified: bool = False,
    num_evaluations: int = 1,
) -> Float[Array, "n 3"]:
    """Radiance that eye rays collect from all lights in a homogeneous, unoccluded medium (L_v of section 4.2).

    sum_i f_p(x) tau(x0, x) tau(x, v_i) min(1/r^2, b) / pdf sigma_s(x) L_i sigma_s f_p(v_i), x = x_i(u). Unbiased for the
    clamped kernel; `num_evaluations` stratified points per pair.
    """
    sigma_t = pairs.components(media.sigma_t(medium))

    def tile(origin, direction, t0, t1, u):
        part = Segments(origin, direction, t0, t1, segments.clamp)
        origin, direction = pairs.components(origin), pairs.components(direction)

        def evaluate(light, shift, repeat):
            v = (shifted(u, shift) + repeat) * (1.0 / num_evaluations)
            point = choose_point(origin, direction, part, light.position, v, stratified=stratified)
            f = phase_value(medium, -pairs.dot(point.towards, direction), isotropic=isotropic)
            sent = phase_value(medium, pairs.dot(light.direction, point.towards), isotropic=isotropic)
            return point.weight * (sent * f * (1.0 / num_evaluations)), point.distance + (point.t - t0)

        return sum_over(evaluate, rows(lights), sigma_t, u.shape[0], grey=grey, repeats=num_evaluations)

    collected = in_tiles(tile, segments.origin, segments.direction, segments.t0, segments.t1, u) * medium.sigma_s
    return jnp.where((segments.t1 > segments.t0)[:, None], collected, 0.0)


@partial(jax.jit, static_argnames=("grey", "isotropic"))
def gather_points(points: Points, lights: VirtualLights, medium: Medium, *, grey: bool, isotropic: bool) -> Float[Array, "n 3"]:
    """Light of all lights scattered at points towards `outgoing`, homogeneous and unoccluded, clamped (min(1/r^2, b))."""
    sigma_t = pairs.components(media.sigma_t(medium))

    def tile(position, outgoing, clamp):
        position, outgoing = pairs.components(position), pairs.components(outgoing)

        def evaluate(light, _, __):
            r2, distance, towards = pairs.separation(position, light.position, clamp)
            f = phase_value(medium, pairs.dot(towards, outgoing), isotropic=isotropic)
            sent = phase_value(medium, pairs.dot(light.direction, towards), isotropic=isotropic)
            return pairs.inverse_square(r2, clamp) * (sent * f), distance

        return sum_over(evaluate, rows(lights), sigma_t, position[0].shape[0], grey=grey)

    return points.scattering * in_tiles(tile, points.position, points.outgoing, points.clamp)
