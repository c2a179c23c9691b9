"""Stage 3, single segments without tables: the response's own integral, one random scatter point at a time, sigma marched.

The tables take a segment for homogeneous and open. Where the measured contrast of density about it is large, or an
occluder cuts it, the integral over last scatter points z is sampled instead, with both legs marched and tested for
occluders (specification 4, "correct fallback"):

    int f(w) sigma_s(z) e^-tau(x,z) V(x,z) { p(w, z -> y) e^-tau(z,y) V(z,y) L_e  +  light that reaches z scattered } dz

so light scattered once is right in any medium. The second term goes on from z by the phase function and free flight for
as many `legs` as the plan says, and takes what is left from the tables at the last of them, scattered by the phase function.
z is drawn by free flight along a uniform direction of the hemisphere. For emitters at a finite distance it is drawn in
three ways whose densities all count (balance heuristic): uniformly in the half angles at x and y (specification 2), which
fits the 1/r^2 of both, or for spots in their cone; along a cosine-distributed direction equi-angular about the emitter,
which stays inside the medium; and by free flight along it.
"""

from dataclasses import replace
from functools import partial
from math import pi
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float

from jaxvol import extinction, harmonics, media, phase, sampling, slopes, zonal_lookup
from jaxvol.methods.impulse_response import lookup, shading
from jaxvol.methods.impulse_response.emitters import EXTRAPOLATION, slab_share
from jaxvol.methods.impulse_response.light_sources import NEAREST, Light
from jaxvol.sampling import dot

# Shares of places by half angles or in a spot's cone, and equi-angular along rays; the rest by free flight. Onward legs want
# much of the latter: 1 / its share is the most that a leg multiplies the weight by.
_PLACE, _ONWARD = (0.4, 0.3), (0.2, 0.2)
_AXIS = (np.arange(8) + 0.5) / 8  # places along the segment
_COSINES, _TURNS, _DEPTHS = (0.9, 0.5, 0.15), 4, (0.125, 0.375, 0.625, 0.875)  # directions about the normal, depths in the box


@jax.jit
def surroundings(medium, where: "Place", normal, offset) -> tuple[Float[Array, "n"], Float[Array, "n"]]:
    """Height of points `offset` from the receiver over its surface, and mean extinction of the leg that reached it."""
    sigma = jnp.mean(media.sigma_t(medium))
    reached = where.distance > 0  # not where the way misses the medium
    leg = jnp.maximum(sigma * where.near, 1e-6) / jnp.where(reached, where.distance, 1.0)
    return jnp.maximum(dot(offset, normal), 0.0), jnp.where(reached, leg, sigma)


class Place(NamedTuple):
    """Where light scatters last on its way to a receiver."""

    direction: Float[Array, "n 3"]  # from the receiver
    distance: Float[Array, "n"]
    near: Float[Array, "n"]  # column of density up to there
    weight: Float[Array, "n"]  # density there over the sample's density in solid angle and distance


@jax.jit
def contrast(
    marching: extinction.MarchingMedium, position: Float[Array, "n 3"], normal: Float[Array, "n 3"], light: Light
) -> Float[Array, "n"]:
    """(max - min) / max of density along each segment and around its receiver, 56 places; 1 where all are empty."""
    medium = marching.regions[0]

    def density(points):
        return extinction.region_density(marching, 0, points)

    if light.infinite:
        t0, t1 = media.box_interval(medium.bounds, position, light.direction)
        found = [density(position + (t0 + f * (t1 - t0))[:, None] * light.direction) for f in _AXIS]
    else:
        found = [density(position + (f * light.distance)[:, None] * light.direction) for f in _AXIS]
    s, t = sampling.orthonormal_basis(normal)
    for ring, cosine in enumerate(_COSINES):
        sine = np.sqrt(1 - cosine * cosine)
        for turn in range(_TURNS):
            phi = 2 * pi * (turn + 0.5 * (ring % 2)) / _TURNS
            way = cosine * normal + sine * (np.cos(phi) * s + np.sin(phi) * t)
            t0, t1 = media.box_interval(medium.bounds, position, way)
            for depth in _DEPTHS:
                inside = density(position + (t0 + depth * (t1 - t0))[:, None] * way)
                found.append(jnp.where(t1 > t0, inside, 0.0))
    values = lax.stop_gradient(jnp.stack(found))  # for a decision only
    high, low = jnp.max(values, axis=0), jnp.min(values, axis=0)
    return jnp.where(high > 0, (high - low) / jnp.maximum(high, 1e-30), 1.0)


@partial(jax.jit, static_argnames="num_steps")
def place(marching, position, normal, light: Light, u, *, num_steps: int) -> Place:
    """Draw the last scatter point of each segment by four random numbers."""
    if light.infinite:
        direction = sampling.direction_about(normal, u[0], jnp.sqrt((1 - u[0]) * (1 + u[0])), u[1])
        t, column, density = _free_flight(marching, position, direction, u[2], num_steps)
        return Place(direction, t, column, jnp.where(density > 0, 2 * pi / jnp.maximum(density, 1e-30), 0.0))
    above = sampling.sample_cosine_hemisphere(u[0], u[1], normal)
    direction, t, column, rho, aimed, along = _placed(marching, position, above, light, u, num_steps, _PLACE)
    pdf = aimed + sampling.sample_cosine_hemisphere_pdf(dot(direction, normal)) * along
    return Place(direction, t, column, _over(rho, pdf))


def _over(value, pdf):
    """value / pdf; 0 where the pdf has underflowed, which only places that light does not reach have."""
    return jnp.where(pdf > 1e-30, value / jnp.maximum(pdf, 1e-30), 0.0)


def _placed(marching, position, onward, light, u, num_steps, shares):
    """A point towards an emitter by one of three techniques, `onward` being the direction of two of them.

    Its direction, distance, column of density and density; the pdf (solid angle, distance) of the technique that aims at
    the emitter; the pdf of the distance by the other two; `shares` included.
    """
    by_aim, by_angle = shares
    aimed, evenly = u[3] < by_aim, (u[3] >= by_aim) & (u[3] < by_aim + by_angle)
    bounds = marching.regions[0].bounds
    light = _apart(light, bounds)
    emitter = position + light.distance[:, None] * light.direction
    aside, reach, drawn = (_by_half_angles if light.cone is None else _in_cone)(bounds, position, emitter, light, u)
    direction = jnp.where(aimed[:, None], aside, onward)
    t0, t1 = media.box_interval(bounds, position, direction)
    near, _ = sampling.sample_equiangular(u[2], position, direction, t0, t1, emitter)
    given = jnp.where(aimed, reach, jnp.where(evenly, near, jnp.inf))
    t, column, density = _free_flight(marching, position, direction, u[2], num_steps, given=given)
    pdf = _by_half_angles_pdf if light.cone is None else _in_cone_pdf
    # The sampler's own pdf where it drew: rounding at the cone's edge must not turn it into none.
    aimed_pdf = jnp.where(aimed, drawn, pdf(bounds, position, emitter, light, direction, t))
    rho = extinction.region_density(marching, 0, position + t[:, None] * direction)
    rho = jnp.where(t1 > t0, rho, 0.0)  # ways that leave the box at once have no place on them
    even = sampling.sample_equiangular_pdf(t, position, direction, t0, t1, emitter)
    along = by_angle * jnp.where(t1 > t0, even, 0.0) + (1 - by_aim - by_angle) * density * rho
    return direction, t, column, rho, by_aim * aimed_pdf, along


def _apart(light, bounds):
    """The light, but a box's size away from receivers at its very place, whose direction to it is 0 / 0 and has no slope.

    It only tells where places are drawn, and their densities are of the light as it is here.
    """
    on_it = light.distance < 2 * NEAREST
    size = lax.stop_gradient(jnp.max(bounds[1] - bounds[0]))
    direction = jnp.where(on_it[:, None], jnp.array([0.0, 0.0, 1.0], jnp.float32), light.direction)
    return replace(light, direction=direction, distance=jnp.where(on_it, size, light.distance))


def _by_half_angles(bounds, position, emitter, light, u):
    """Direction, distance and pdf of a point whose half angles a at x and w at the emitter are uniform over a + w <= pi / 2."""
    total = 0.5 * pi * jnp.sqrt(u[0])
    a = total * u[1]
    reach = light.distance * jnp.sin(2 * (total - a)) / jnp.maximum(jnp.sin(2 * total), 1e-6)
    direction = sampling.direction_about(light.direction, jnp.cos(2 * a), jnp.sin(2 * a), u[2])
    return direction, reach, _by_half_angles_pdf(bounds, position, emitter, light, direction, reach)


def _by_half_angles_pdf(bounds, position, emitter, light, direction, t):
    """dt dmu dphi = (4 r^2 / d) da dw dphi, over the triangle's area and all azimuths."""
    rest = emitter - position - t[:, None] * direction
    return light.distance / (4 * jnp.maximum(dot(rest, rest), 1e-30)) / (pi**3 / 4)


def _in_cone(bounds, position, emitter, light, u):
    """Direction, distance and pdf of a point in a spot's cone: a uniform direction of it, equi-angular about x."""
    axis, cos_angle = light.cone
    cosine = 1 - u[0] * (1 - cos_angle)
    beam = sampling.direction_about(axis, cosine, jnp.sqrt(jnp.maximum((1 - cosine) * (1 + cosine), 0.0)), u[1])
    t0, t1 = media.box_interval(bounds, emitter, beam)
    t, even = sampling.sample_equiangular(u[2], emitter, beam, t0, t1, position)
    way = emitter + t[:, None] * beam - position
    reach = jnp.sqrt(jnp.maximum(dot(way, way), 1e-30))
    pdf = even / (2 * pi * jnp.maximum(1 - cos_angle, 1e-7)) * (reach / jnp.maximum(t, 1e-30)) * (reach / jnp.maximum(t, 1e-30))
    return way / reach[:, None], reach, jnp.where(t1 > t0, pdf, 0.0)


def _in_cone_pdf(bounds, position, emitter, light, direction, t):
    """Of a point by `_in_cone`, in solid angle and distance from x: r^2 / r'^2 of that from the emitter."""
    axis, cos_angle = light.cone
    way = position + t[:, None] * direction - emitter
    square = jnp.maximum(dot(way, way), 1e-30)
    far = jnp.sqrt(square)
    beam = way / far[:, None]
    t0, t1 = media.box_interval(bounds, emitter, beam)
    even = sampling.sample_equiangular_pdf(far, emitter, beam, t0, t1, position)
    inside = (dot(beam, axis) >= cos_angle) & (t1 > t0)
    return jnp.where(inside, even / (2 * pi * jnp.maximum(1 - cos_angle, 1e-7)) * t * t / square, 0.0)


def _free_flight(marching, origin, direction, u, num_steps, given=None):
    """A distance with density ~ rho e^-tau of the mean channel inside the box: (t, column up to it, density / rho).

    Where `given` is finite it is the distance, and the rest is of it.
    """
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
        passed, t, reached = state
        rho = density(i)
        after = passed + step * rho
        here = (passed <= target) & (after > target)
        t = jnp.where(here, t0 + i * step + (target - passed) / jnp.maximum(rho, 1e-30), t)
        if given is not None:
            reached = reached + rho * jnp.clip(given - (t0 + i * step), 0.0, step)
        return after, t, reached

    _, t, reached = lax.fori_loop(0, num_steps, find, (zero, t0, zero))
    if given is not None:
        t, target = jnp.where(jnp.isinf(given), t, given), jnp.where(jnp.isinf(given), target, reached)
    return t, target, sigma * jnp.exp(-sigma * target) / jnp.maximum(kept, 1e-30) * (kept > 0)


@partial(jax.jit, static_argnames="num_steps")
def onward(marching, points, direction, light: Light, u, *, num_steps: int):
    """The next leg outward from scatter points that see `light`: (direction, distance, factor of throughput [n, 3]).

    Its direction by the phase function and its length by free flight; for emitters at a finite distance as in `place`: the
    1/r^2 of the next connection would have an infinite variance otherwise.
    """
    medium = marching.regions[0]
    turned, _ = phase.sample(medium, direction, u[0], u[1])
    if light.infinite:
        t, column, density = _free_flight(marching, points, turned, u[2], num_steps)
        weight = jnp.where(density > 0, 1 / jnp.maximum(density, 1e-30), 0.0)
        return turned, t, medium.sigma_s * jnp.exp(-media.sigma_t(medium) * column[:, None]) * weight[:, None]
    turned, t, column, rho, aimed, along = _placed(marching, points, turned, light, u, num_steps, _ONWARD)
    value = phase.evaluate(medium, dot(direction, turned))
    weight = _over(value * rho, aimed + value * along)
    return turned, t, medium.sigma_s * jnp.exp(-media.sigma_t(medium) * column[:, None]) * weight[:, None]


def _phase_lobe(medium, order):
    """Zonal coefficients of the phase function."""
    if medium.phase is None:
        moments = zonal_lookup.moments_of_g(medium.g, order)
    else:
        moments = jnp.pad(medium.phase.moments[:order], (0, max(0, order - medium.phase.moments.shape[0])))
    return moments * jnp.asarray(harmonics.zonal_norm(order), moments.dtype)


@jax.jit
def survive(
    weight: Float[Array, "n 3"], first: Float[Array, "n 3"], free: Bool[Array, "n"], u: Float[Array, "n"], *, gain: float = 16.0
) -> Float[Array, "n 3"]:
    """Throughputs after Russian roulette on a `gain`th of a walk's first one; 0 where it lost or the way is not free."""
    chance = jnp.minimum(gain * slopes.ratio(slopes.largest(weight), slopes.largest(first)), 1.0)
    kept = jnp.where(free & (u < chance), 1 / jnp.maximum(chance, 1e-30), 0.0)
    return weight * kept[:, None]


@jax.jit
def throughput(medium, where: Place, reached: Bool[Array, "n"]) -> Float[Array, "n 3"]:
    """What a place counts at the receiver per unit of scattered radiance over sigma_s rho; 0 where it is not seen."""
    found = medium.sigma_s * jnp.exp(-media.sigma_t(medium) * where.near[:, None]) * where.weight[:, None]
    return jnp.where(reached[:, None], found, 0.0)


@jax.jit
def scattered_once(
    medium, outward: Float[Array, "n 3"], light: Light, lit: Bool[Array, "n"], far: Float[Array, "n 3"]
) -> Float[Array, "n 3"]:
    """Radiance over sigma_s that attenuated light leaves against `outward` at points that see the emitter as `light`."""
    source = light.strength
    if light.normal is not None:
        source = source * jnp.maximum(-dot(light.normal, light.direction), 0.0)[:, None]
    if not light.infinite:
        apart = light.distance > 2 * NEAREST  # on the lamp itself, which rounding hits, nothing is counted
        near = jnp.where(apart, 1 / jnp.where(apart, light.distance, 1.0), 0.0)
        source = source * (near * near)[:, None]
    # Directions toward light: it travels along -light.direction, then along -outward.
    return jnp.where(lit[:, None], source * jnp.exp(-far), 0.0) * phase.evaluate(medium, dot(outward, light.direction))[:, None]


@partial(jax.jit, static_argnames="image")
def scattered_more(
    medium,
    responses: lookup.Responses,
    outward: Float[Array, "n 3"],
    light: Light,
    lit: Bool[Array, "n"],
    far: Float[Array, "n 3"],
    normal: Float[Array, "n 3"],
    height: Float[Array, "n"],
    sigma: Float[Array, "n"],
    *,
    image: bool,
) -> Float[Array, "n 3"]:
    """As `scattered_once`, of the light that the tables bring to the points.

    With `image` less the emitter's image behind the receiver's surface, `height` below and with extinction `sigma` above it.
    """
    brought = _brought(medium, responses, outward, light, far)
    if image and light.infinite:
        kappa = jnp.stack([grid.kappa for grid in responses.directional])
        brought = brought * slab_share(kappa, far, (height * sigma)[:, None], responses.transport)
    elif image:
        mirrored, thick = _mirrored(responses, normal, height, sigma, light, far)
        straight = jnp.exp(-thick) * phase.evaluate(medium, dot(outward, mirrored.direction))[:, None]
        if light.normal is not None:
            straight = straight * jnp.maximum(-dot(mirrored.normal, mirrored.direction), 0.0)[:, None]
        straight = straight / (mirrored.distance * mirrored.distance)[:, None]
        brought = brought - (_brought(medium, responses, outward, mirrored, thick) + straight)
    return jnp.where(lit[:, None], jnp.maximum(brought, 0.0), 0.0) * light.strength


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


def _mirrored(responses, normal, height, sigma, light, far):
    """The emitter's image behind the receiver's surface, as the scatter points see it, and its optical thickness.

    As in `emitters`, with the extinction of the leg to the receiver: where the medium does not reach the surface, the
    image moves away.
    """
    behind = EXTRAPOLATION / (jnp.mean(responses.transport) * sigma)
    way = light.distance[:, None] * light.direction
    above = height + dot(way, normal)
    way = way - 2 * (above + behind)[:, None] * normal
    distance = jnp.sqrt(jnp.maximum(dot(way, way), 1e-30))
    turned = None if light.normal is None else light.normal - 2 * dot(light.normal, normal)[:, None] * normal
    thick = far + ((distance - light.distance) * sigma)[:, None]
    return Light(way / distance[:, None], distance, light.strength, turned), jnp.maximum(thick, 0.0)
