"""Connections to lights: next-event estimation at vertices, and at distances chosen equi-angularly towards the light.

For a volume vertex at distance t of a flight, lit by the point y of a light in direction w, three ways compete, weighted
by the balance heuristic: free flight and light sampling p_ff(t) p_l(w), equi-angular distance and light sampling
p_eq(t | y) p_l(w), free flight and phase sampling p_ff(t) p_ph(w) (Veach 1997; Kulla and Fajardo 2012).
"""

import jax.numpy as jnp

from jaxvol import lights, materials, ray_casting, sampling
from jaxvol.methods.path_tracing import flight as flights
from jaxvol.methods.path_tracing import sensors
from jaxvol.methods.path_tracing.lanes import Segment, Shadow, group_after
from jaxvol.methods.path_tracing.tracking import path_spans
from jaxvol.types import Scene

_NEAR = 1.0 - 1e-4  # shadow rays end short of the light's own surface


def connect(scene, sensor, settings, lanes, casts, arrival, throughput, surface, vertex, u, group) -> Shadow:
    """Next-event estimation at the vertex just made, or at a gathering sensor's own point."""
    position = jnp.where(lanes.starting[:, None], lanes.origin, arrival.position)
    found = lights.sample_light(scene, position, u[0], u[1], u[2])
    value = jnp.zeros_like(throughput)
    pdf = jnp.zeros_like(found.pdf)
    active = vertex
    if scene.medium is not None:
        scattered = flights.phase_value(scene.medium, arrival.region, sampling.dot(lanes.direction, found.direction))
        value = jnp.where(arrival.collided[:, None], scattered[:, None] * throughput, value)
        pdf = jnp.where(arrival.collided, scattered, pdf)
    if scene.mesh is not None:
        bsdf = materials.evaluate(surface, arrival.normal, lanes.direction, found.direction)
        cosine = jnp.abs(sampling.dot(arrival.normal, found.direction))
        value = jnp.where(arrival.on_surface[:, None], bsdf * cosine[:, None] * throughput, value)
        surface_pdf = materials.sample_pdf(surface, arrival.normal, lanes.direction, found.direction)
        pdf = jnp.where(arrival.on_surface, surface_pdf, pdf)
    if sensors.sees_light(sensor):
        weight, own = sensors.response(sensor, lanes.pixel, found.direction)
        value = jnp.where(lanes.starting[:, None], weight[:, None], value)
        pdf = jnp.where(lanes.starting, own, pdf)
        active = active | lanes.starting
    pdf = jnp.where(found.delta, 0.0, pdf)  # no scattering finds a delta light
    mis = found.pdf / jnp.maximum(found.pdf + pdf, 1e-37)
    if settings.equiangular:
        segment = flown_segment(scene, settings, lanes, casts, arrival)
        other = equiangular_density(scene, segment, arrival.position, found.position) * found.pdf
        own = segment.density * found.pdf
        mixed = own / jnp.maximum(own + segment.density * pdf + other, 1e-37)
        mis = jnp.where(arrival.collided & jnp.isfinite(found.distance), mixed, mis)
    contribution = value * found.radiance * (mis / jnp.maximum(found.pdf, 1e-37))[:, None]
    origin = position
    if scene.mesh is not None:
        off = ray_casting.offset_origin(position, arrival.normal, found.direction, scale=ray_casting.scene_scale(scene.mesh))
        origin = jnp.where(arrival.on_surface[:, None], off, origin)
    travel, distance = aim(found, origin)
    active = active & (jnp.max(contribution, axis=-1) > 0)
    never = jnp.zeros_like(active)
    return Shadow(origin, travel, distance, contribution, group, active, never, lanes.event)


def aim(found, origin):
    """Direction and length of the shadow ray from `origin`, which may lie off the point that the light was sampled for.

    On large surfaces the offset exceeds the margin before the light's own surface, which would then shadow itself.
    """
    delta = found.position - origin
    distance = jnp.sqrt(jnp.maximum(sampling.dot(delta, delta), 1e-20))
    finite = jnp.isfinite(found.distance)
    travel = jnp.where(finite[:, None], delta / distance[:, None], found.direction)
    return travel, jnp.where(finite, distance * _NEAR, jnp.inf)


def nearby_lights(scene: Scene) -> Scene:
    """The lights that equi-angular sampling aims at: all that have a place."""
    return Scene(
        mesh=None if scene.area_lights is None else scene.mesh,
        point_lights=scene.point_lights,
        spot_lights=scene.spot_lights,
        area_lights=scene.area_lights,
    )


def flown_segment(scene, settings, lanes, casts, arrival) -> Segment:
    """The flight just ended; density 0 unless it ended in a collision."""
    t, _ = path_spans(scene, settings, lanes, casts)
    density = jnp.where(arrival.collided, arrival.density, 0.0)
    return Segment(lanes.origin, lanes.direction, t[:, 0], t[:, -1], density)


def equiangular_density(scene, segment: Segment, position, light_position):
    """p_eq(t | y) of a vertex, 1/length, times the ratio of the light choices that `connect_equiangular` has."""
    t = sampling.dot(position - segment.origin, segment.direction)
    pdf = sampling.sample_equiangular_pdf(t, segment.origin, segment.direction, segment.t0, segment.t1, light_position)
    return pdf * (lights.num_lights(scene) / lights.num_lights(nearby_lights(scene)))


def connect_equiangular(scene, settings, proxy, lanes, casts, ready, u, corner) -> Shadow:
    """One more vertex on the same flight, at a distance chosen equi-angularly towards a point of a light.

    In a grid the contribution holds the density there but not yet the transmittance to it, which is tracked; `proxy`,
    homogeneous media of the grids' mean densities, stands for the free flight's density in the weights, which any
    function may that is the same on both sides.
    """
    lit = nearby_lights(scene)
    ready = ready & ~lanes.starting & (lanes.num_vertices < settings.max_scatterings)
    target = lights.sample_light(lit, lanes.origin, u[1], u[2], u[3]).position
    spans = path_spans(scene, settings, lanes, casts)
    t0, t1 = spans[0][:, 0], spans[0][:, -1]
    t, pdf = sampling.sample_equiangular(u[0], lanes.origin, lanes.direction, t0, t1, target)
    position = lanes.origin + t[:, None] * lanes.direction
    found = lights.sample_light(lit, position, u[1], u[2], u[3])
    density, through, region = flights.homogeneous_pdf(proxy, spans, lanes.throughput, t)
    if settings.tracked:
        through = flights.scattering_at(scene.medium, region, position, corner)
    cosine = sampling.dot(lanes.direction, found.direction)
    scattered = flights.phase_value(scene.medium, region, cosine)
    own = pdf * found.pdf
    chosen = found.pdf * (lights.num_lights(lit) / lights.num_lights(scene))
    total = own + density * (chosen + jnp.where(found.delta, 0.0, scattered))
    value = lanes.throughput * through * found.radiance * (scattered / jnp.maximum(total, 1e-37))[:, None]
    active = ready & (t1 > t0) & (jnp.max(value, axis=-1) > 0)
    ones, never = jnp.ones_like(ready), jnp.zeros_like(ready)
    first = jnp.where(lanes.num_vertices == 0, ones, lanes.first_volume)
    group = group_after(lanes.num_vertices + 1, first, ones)
    return Shadow(position, found.direction, found.distance * _NEAR, value, group, active, never, lanes.event)
