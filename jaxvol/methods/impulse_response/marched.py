"""Stage 3, single segments without tables: the response's own integral, one random scatter point at a time, sigma marched.

The tables take a segment for homogeneous and open. Where the measured contrast of density about it is large, or an
occluder cuts it, the integral over last scatter points z is sampled instead, with both legs marched and tested for
occluders (specification 4, "correct fallback"):

    int f(w) sigma_s(z) e^-tau(x,z) V(x,z) { p(w, z -> y) e^-tau(z,y) V(z,y) L_e  +  light that the tables bring from y to z,
    scattered towards x by the phase function } dz

so light scattered once is right in any medium, and light scattered more often has its last leg right. z is drawn uniformly
in the half angles at x and y (specification 2) for emitters at a finite distance, which cancels 1/r^2, and by free flight
along a uniform direction of the hemisphere for light from infinity.
"""

from functools import partial
from math import pi
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float

from jaxvol import extinction, harmonics, media, phase, sampling, zonal_lookup
from jaxvol.methods.impulse_response import lookup, shading
from jaxvol.methods.impulse_response.emitters import EXTRAPOLATION
from jaxvol.methods.impulse_response.light_sources import Light
from jaxvol.sampling import dot

_AXIS = (np.arange(8) + 0.5) / 8  # places along the segment
_HALF_ANGLES = np.array([[0.3, 0.3], [0.6, 0.3], [0.3, 0.6], [0.15, 0.15]])  # at receiver and emitter
_DIRECTIONS = np.array([[0.8, 0.0], [0.8, 0.5], [0.3, 0.25], [0.3, 0.75]])  # cosine about the normal, turn
_DEPTHS = (0.25, 0.75)  # of the way through the box


class Place(NamedTuple):
    """Where light scatters last: distance along a direction from the receiver; `weight` is 1 / density of t and w over r^2."""

    direction: Float[Array, "n 3"]
    distance: Float[Array, "n"]
    weight: Float[Array, "n"]  # dw dt of the sample; at finite distance without the 1/r^2 of the light


@jax.jit
def contrast(
    marching: extinction.MarchingMedium, position: Float[Array, "n 3"], normal: Float[Array, "n 3"], light: Light
) -> Float[Array, "n"]:
    """(max - min) / max of density at 16 places on and around each segment, where its light scatters; 0 where all is empty."""
    medium = marching.regions[0]

    def density(points):
        return extinction.region_density(marching, 0, points)

    found = []
    if light.infinite:
        t0, t1 = media.box_interval(medium.bounds, position, light.direction)
        found += [density(position + (t0 + f * (t1 - t0))[:, None] * light.direction) for f in _AXIS]
        s, t = sampling.orthonormal_basis(normal)
        for cosine, turn in _DIRECTIONS:
            sine = np.sqrt(1 - cosine * cosine)
            way = cosine * normal + sine * (np.cos(2 * pi * turn) * s + np.sin(2 * pi * turn) * t)
            t0, t1 = media.box_interval(medium.bounds, position, way)
            for depth in _DEPTHS:
                inside = density(position + (t0 + depth * (t1 - t0))[:, None] * way)
                found.append(jnp.where(t1 > t0, inside, 0.0))
    else:
        way = light.distance[:, None] * light.direction
        found += [density(position + f * way) for f in _AXIS]
        s, t = sampling.orthonormal_basis(light.direction)
        for number, (a, w) in enumerate(_HALF_ANGLES):
            for turn in (0.25 * number, 0.25 * number + 0.5):
                around = np.cos(2 * pi * turn) * s + np.sin(2 * pi * turn) * t
                reach = light.distance * (np.sin(2 * w) / np.sin(2 * (a + w)))
                direction = np.cos(2 * a) * light.direction + np.sin(2 * a) * around
                # Below the receiver's own surface nothing scatters towards it.
                above = dot(direction, normal) > 0
                found.append(jnp.where(above, density(position + reach[:, None] * direction), found[0]))
    values = jnp.stack(found)
    high, low = jnp.max(values, axis=0), jnp.min(values, axis=0)
    return jnp.where(high > 0, (high - low) / jnp.maximum(high, 1e-30), 0.0)


@partial(jax.jit, static_argnames="num_steps")
def place(marching, position, normal, light: Light, u, *, num_steps: int) -> Place:
    """Draw the last scatter point of each segment."""
    if light.infinite:
        ring = jnp.sqrt((1 - u[0]) * (1 + u[0]))
        direction = sampling.direction_about(normal, u[0], ring, u[1])
        t, weight = _free_flight(marching, position, direction, u[2], num_steps)
        return Place(direction, t, 2 * pi * weight)
    total = 0.5 * pi * jnp.sqrt(u[0])  # a + w, uniform over the triangle a, w >= 0, a + w <= pi / 2
    a = total * u[1]
    sine = jnp.maximum(jnp.sin(2 * total), 1e-6)
    reach, left = light.distance * jnp.sin(2 * (total - a)) / sine, light.distance * jnp.sin(2 * a) / sine
    direction = sampling.direction_about(light.direction, jnp.cos(2 * a), jnp.sin(2 * a), u[2])
    # dt dmu dphi = (4 r^2 / d) da dw dphi, over the triangle's area and all azimuths.
    return Place(direction, reach, 4 * left * left / jnp.maximum(light.distance, 1e-9) * (pi * pi / 8) * 2 * pi)


def _free_flight(marching, origin, direction, u, num_steps):
    """A distance with density ~ sigma e^-tau of the mean channel inside the box, and 1 / density."""
    medium = marching.regions[0]
    sigma = jnp.mean(media.sigma_t(medium))
    t0, t1 = media.box_interval(medium.bounds, origin, direction)
    step = (t1 - t0) / num_steps

    def density(i):
        return extinction.region_density(marching, 0, origin + (t0 + (i + 0.5) * step)[:, None] * direction)

    zero = jnp.zeros_like(t0)
    column = lax.fori_loop(0, num_steps, lambda i, total: total + step * density(i), zero)
    kept = -jnp.expm1(-sigma * column)
    target = -jnp.log1p(-u * kept) / sigma

    def find(i, state):
        passed, t, there = state
        rho = density(i)
        after = passed + step * rho
        here = (passed <= target) & (after > target)
        t = jnp.where(here, t0 + i * step + (target - passed) / jnp.maximum(rho, 1e-30), t)
        return after, t, jnp.where(here, rho, there)

    _, t, rho = lax.fori_loop(0, num_steps, find, (zero, t0, zero))
    pdf = sigma * rho * jnp.exp(-sigma * target) / jnp.maximum(kept, 1e-30)
    return t, jnp.where(pdf > 0, 1 / jnp.maximum(pdf, 1e-30), 0.0)


def _phase_lobe(medium, order):
    """Zonal coefficients of the phase function."""
    if medium.phase is None:
        moments = zonal_lookup.moments_of_g(medium.g, order)
    else:
        moments = jnp.pad(medium.phase.moments[:order], (0, max(0, order - medium.phase.moments.shape[0])))
    return moments * jnp.asarray(harmonics.zonal_norm(order), moments.dtype)


@partial(jax.jit, static_argnames=("multiple", "image"))
def gather(
    medium,
    responses: lookup.Responses,
    receiver,
    where: Place,
    density: Float[Array, "n"],
    light: Light,
    reached: Bool[Array, "n"],
    lit: Bool[Array, "n"],
    near: Float[Array, "n 3"],
    far: Float[Array, "n 3"],
    *,
    multiple: bool,
    image: bool,
) -> tuple[Float[Array, "n *rows 3"], Float[Array, "n *rows 3"]]:
    """What the receiver makes of light scattered last at the places: (once, more often).

    `light` as seen from the places, `reached` and `lit` whether they see receiver and light, near and far the optical
    thickness of the two legs.
    """
    sigma_s = medium.sigma_s * density[:, None]
    weight = jnp.where(reached[:, None], where.weight[:, None] * sigma_s * jnp.exp(-near), 0.0)
    # Directions toward light: travel along -light.direction, then along -where.direction.
    cosine = dot(where.direction, light.direction)
    source = light.strength
    if light.normal is not None:
        source = source * jnp.maximum(-dot(light.normal, light.direction), 0.0)[:, None]
    if not light.infinite:
        source = source / (light.distance * light.distance)[:, None]
    once = jnp.where(lit[:, None], source * jnp.exp(-far), 0.0) * phase.evaluate(medium, cosine)[:, None]
    first = receiver.straight(where.direction, weight * once)
    if not multiple:
        return first, jnp.zeros_like(first)
    brought = _brought(medium, responses, where.direction, light, far)
    if image:
        mirrored, thick = _mirrored(responses, receiver.normal, where, light, near, far)
        taken = _brought(medium, responses, where.direction, mirrored, thick)
        straight = jnp.exp(-thick) * phase.evaluate(medium, dot(where.direction, mirrored.direction))[:, None]
        if light.normal is not None:
            straight = straight * jnp.maximum(-dot(mirrored.normal, mirrored.direction), 0.0)[:, None]
        if not light.infinite:
            straight = straight / (mirrored.distance * mirrored.distance)[:, None]
        brought = brought - (taken + straight)
    more = jnp.where(lit[:, None], jnp.maximum(brought, 0.0), 0.0) * light.strength
    return first, receiver.straight(where.direction, weight * more)


def _brought(medium, responses, outward, light, tau):
    """Radiance that the tables' light of a unit emitter, at optical thickness tau, leaves against `outward`, per sigma_s."""
    cosine = dot(outward, light.direction)
    if light.infinite:
        parts = lookup.directional_source(responses.directional, responses.albedo, tau)
    else:
        away = jnp.broadcast_to(light.distance[:, None], tau.shape)
        if light.normal is None:
            parts = lookup.compact_source(responses.point, responses.albedo, tau, away, None)
        else:
            facing = jnp.broadcast_to(-dot(light.normal, light.direction)[:, None], tau.shape)
            parts = lookup.compact_source(responses.area, responses.albedo, tau, away, facing)
    field = sum(parts)
    if light.normal is None:
        return harmonics.zonal_product(field, _phase_lobe(medium, field.shape[-1]), cosine[:, None])
    order = round((2 * field.shape[-1]) ** 0.5 - 0.5)
    lobe = jnp.broadcast_to(_phase_lobe(medium, order), (*cosine.shape, order))
    return shading.half_product(field, lobe, shading.emitter_frame(light.direction, light.normal), outward)


def _mirrored(responses, normal, where, light, near, far):
    """The emitter's image behind the receiver's surface, as the scatter points see it, and its optical thickness.

    As in `emitters`, with the extinction of the leg to the receiver: where the medium does not reach the surface, the
    image moves away.
    """
    height = where.distance * dot(where.direction, normal)  # of the scatter point
    thickness = jnp.mean(near, axis=-1)
    sigma = jnp.maximum(thickness / jnp.maximum(where.distance, 1e-9), 1e-6)
    behind = EXTRAPOLATION / (jnp.mean(responses.transport) * sigma)
    if light.infinite:
        direction = light.direction - 2 * dot(light.direction, normal)[:, None] * normal
        deeper = 2 * (height + behind) * sigma
        return Light(direction, light.distance, light.strength, infinite=True), far + deeper[:, None]
    way = light.distance[:, None] * light.direction
    above = height + dot(way, normal)
    way = way - 2 * (above + behind)[:, None] * normal
    distance = jnp.sqrt(jnp.maximum(dot(way, way), 1e-12))
    turned = None if light.normal is None else light.normal - 2 * dot(light.normal, normal)[:, None] * normal
    thick = far + ((distance - light.distance) * sigma)[:, None]
    return Light(way / distance[:, None], distance, light.strength, turned), jnp.maximum(thick, 0.0)
