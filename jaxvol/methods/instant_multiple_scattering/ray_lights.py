"""Virtual ray lights (Novak, Nowrouzezahrai, Dachsbacher and Jarosz 2012): whole flights as lights, the second estimator.

Every flight of a light path lights the medium along its way up to where it leaves the medium, whether it collides or not.
A pair of an eye ray and a flight is sampled first on the flight (pdf about the inverse distance to the eye ray), then
equi-angularly on the eye ray: 1/r^2 leaves a finite variance, nothing is clamped or compensated, nothing is biased.
Homogeneous media without surfaces only.
"""

import math
from functools import partial
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxvol import media
from jaxvol.methods.instant_multiple_scattering import gathering, light_paths, pairs
from jaxvol.methods.instant_multiple_scattering.light_paths import Vertices
from jaxvol.methods.instant_multiple_scattering.pairs import Vector
from jaxvol.methods.instant_multiple_scattering.receivers import Segments
from jaxvol.methods.instant_multiple_scattering.virtual_lights import capacity
from jaxvol.types import Medium, Scene

_TURN = 0.5698402910  # second coordinate of a two-dimensional additive recurrence (Roberts 2018)


class RayLights(eqx.Module):
    """Flights inside the medium; rows beyond the real number have strength 0."""

    origin: Float[Array, "M 3"]  # where the flight begins or enters the medium
    direction: Float[Array, "M 3"]
    length: Float[Array, "M"]
    strength: Float[Array, "M 3"]  # L sigma_s / N


class RaySet(eqx.Module):
    """Flights that come from a light, and those that come from a scattering; None = there are none."""

    volume: RayLights | None
    multiple: RayLights | None


class _Row(NamedTuple):
    position: Vector
    direction: Vector
    length: Float[Array, "*k"]
    strength: Vector
    turn: Float[Array, "*k"]


def ray_lights(scene: Scene, vertices: Vertices, *, num_paths: int, seed: int, sizes: dict[str, int] | None = None) -> RaySet:
    """The flights of the paths 0 ... num_paths - 1 that left `vertices`, traced from `seed`.

    `sizes` are array sizes to keep where they suffice, as in `virtual_lights`.
    """
    emitted = light_paths.emit(scene, jnp.asarray(light_paths.padded(np.arange(num_paths, dtype=np.uint32))), jnp.uint32(seed))
    first = tuple(np.asarray(x)[:num_paths] for x in (emitted.origin, emitted.direction, emitted.power))
    rows = np.asarray(vertices.valid & vertices.continues)
    later = tuple(np.asarray(x)[rows] for x in (vertices.position, vertices.outgoing, vertices.power))
    least = [(sizes or {}).get(name, 0) for name in ("volume", "multiple")]
    found = (_inside(scene.medium, *first, num_paths, least[0]), _inside(scene.medium, *later, num_paths, least[1]))
    return RaySet(*found)


def sizes(flights: RaySet) -> dict[str, int]:
    """Array size of both kinds, for the next call of `ray_lights`."""
    kinds = {"volume": flights.volume, "multiple": flights.multiple}
    return {name: x.length.shape[0] for name, x in kinds.items() if x is not None}


def _inside(medium, origin, direction, power, num_paths, least):
    t0, t1 = (np.asarray(x) for x in media.box_interval(medium.bounds, jnp.asarray(origin), jnp.asarray(direction)))
    kept = (t1 > t0) & (power.max(axis=-1, initial=0.0) > 0)
    if not np.any(kept):
        return None
    start = origin + t0[:, None] * direction
    strength = power * np.asarray(medium.sigma_s) / num_paths
    count = int(kept.sum())
    size = least if count <= least else capacity(count + count // 8)

    def pad(values, filler=0.0):
        out = np.full((size, *values.shape[1:]), filler, np.float32)
        out[: kept.sum()] = values[kept]
        return jnp.asarray(out)

    return RayLights(pad(start), pad(direction, 1.0 / math.sqrt(3.0)), pad(t1 - t0, 1e-3), pad(strength))


def _asinh(x):
    size = jnp.abs(x)
    root = size + size * size / (1.0 + jnp.sqrt(1.0 + size * size))
    return jnp.where(x < 0, -1.0, 1.0) * jnp.log1p(root)


def sample_on_flight(
    u: Float[Array, "*n"],
    origin: Vector,
    direction: Vector,
    start: Vector,
    along: Vector,
    length: Float[Array, "*n"],
) -> tuple[Float[Array, "*n"], Float[Array, "*n"]]:
    """v in (0, length) on a flight with pdf proportional to 1 / sqrt(h^2 + (v - v_c)^2 sin^2), and 1 / pdf.

    That is the inverse distance to the eye ray's line (origin, direction); v_c is the closest approach, h its distance.
    """
    offset = tuple(a - b for a, b in zip(origin, start, strict=True))
    cosine = pairs.dot(direction, along)
    sine2 = jnp.maximum((1.0 - cosine) * (1.0 + cosine), 1e-6)
    a, e = pairs.dot(along, offset), pairs.dot(direction, offset)
    closest = (a - cosine * e) / sine2
    aside = pairs.combine(pairs.combine(offset, -closest, along), (cosine * a - e) / sine2, direction)
    least = jnp.maximum(pairs.least_distance2(length), 1e-24)  # rows that only fill up have length 0
    h = jnp.sqrt(jnp.maximum(pairs.dot(aside, aside), least))
    scale = jnp.sqrt(sine2) / h
    low, high = _asinh(-closest * scale), _asinh((length - closest) * scale)
    y = low + u * (high - low)
    grown = jnp.exp(jnp.abs(y))
    x = jnp.where(y < 0, -0.5, 0.5) * (grown - 1.0 / grown) / scale
    v = jnp.clip(closest + x, 0.0, length)
    x = v - closest
    return v, (high - low) / scale * jnp.sqrt(1.0 + x * x * scale * scale)


@partial(jax.jit, static_argnames=("grey", "isotropic"))
def gather_segments(
    segments: Segments, u: Float[Array, "n"], u2: Float[Array, "n"], lights: RayLights, medium: Medium, *, grey, isotropic
) -> Float[Array, "n 3"]:
    """Radiance that eye rays collect from all flights: one point on each flight and one on the eye ray for each pair."""
    sigma_t = pairs.components(media.sigma_t(medium))
    turn = (_TURN * jnp.arange(lights.length.shape[0], dtype=jnp.float32)) % 1.0
    rows = _Row(
        pairs.components(lights.origin),
        pairs.components(lights.direction),
        lights.length,
        pairs.components(lights.strength),
        turn,
    )

    def tile(origin, direction, t0, t1, u, u2):
        part = Segments(origin, direction, t0, t1, None)
        origin, direction = pairs.components(origin), pairs.components(direction)

        def evaluate(light, shift, _):
            first = gathering.shifted(u2, light.turn)
            v, inverse = sample_on_flight(first, origin, direction, light.position, light.direction, light.length)
            place = pairs.combine(light.position, v, light.direction)
            point = gathering.choose_point(origin, direction, part, place, gathering.shifted(u, shift), stratified=False)
            f = gathering.phase_value(medium, -pairs.dot(point.towards, direction), isotropic=isotropic)
            sent = gathering.phase_value(medium, pairs.dot(light.direction, point.towards), isotropic=isotropic)
            return point.weight * inverse * (sent * f), point.distance + (point.t - t0) + v

        return gathering.sum_over(evaluate, rows, sigma_t, u.shape[0], grey=grey)

    arrays = (segments.origin, segments.direction, segments.t0, segments.t1, u, u2)
    collected = gathering.in_tiles(tile, *arrays) * medium.sigma_s
    return jnp.where((segments.t1 > segments.t0)[:, None], collected, 0.0)
