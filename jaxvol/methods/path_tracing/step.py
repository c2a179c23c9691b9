"""One step of all paths: resolve shadow rays, fly, collect emission, connect to lights, scatter, refill.

Pure and jitted; rays are cast between steps by the driver. Symbols as in the path integral: throughput = product of
scattering and transmittance over densities; next-event estimation is combined with directional sampling, and
equi-angular with free-flight distances, by the balance heuristic (Veach 1997; Kulla and Fajardo 2012).
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Int, UInt

from jaxvol import lights, materials, ray_casting, sampling, slopes
from jaxvol.methods.path_tracing import flight as flights
from jaxvol.methods.path_tracing import sensors
from jaxvol.methods.path_tracing.connect import connect, connect_equiangular, equiangular_density, flown_segment
from jaxvol.methods.path_tracing.lanes import (
    ARRIVED,
    Arrival,
    Casts,
    Finished,
    Lanes,
    Segment,
    Settings,
    Shadow,
    Sums,
    add_to_group,
    group_after,
)
from jaxvol.methods.path_tracing.tracking import board, path_spans, shadow_spans, take_off, track
from jaxvol.types import Scene

_STREAM = sampling.stream("path_tracing")


class Work(eqx.Module):
    """The queue of work items: item i is pixel i mod P, sample first_sample + i div P, of P pixels from first_pixel."""

    next: UInt[Array, ""]
    end: UInt[Array, ""]
    first_sample: UInt[Array, ""]
    first_pixel: Int[Array, ""]
    num_pixels: int = eqx.field(static=True)


class Ended(eqx.Module):
    """Samples that are complete after a step, with their sums, for the film."""

    sums: Sums
    finished: Finished


def step(
    scene: Scene, proxy, sensor: sensors.Sensor, settings: Settings, seed, lanes: Lanes, casts: Casts, work: Work
) -> tuple[Lanes, Work, Ended]:
    """Advance every lane by one event (or by a few tentative collisions towards it).

    `proxy` is the scene's medium without grids (`flight.mean_medium`); None where equi-angular sampling is off.
    """
    if settings.tracked and settings.equiangular:
        fresh = lanes.recast & lanes.alive & ~lanes.starting
        lanes = _connect_ahead(scene, proxy, settings, seed, lanes, casts, fresh)
        # What was cast in this slot belongs to an older ray; the new one is cast after this step.
        casts = eqx.tree_at(lambda c: c.blocked, casts, (casts.blocked[0], casts.blocked[1] & ~fresh))
    if settings.tracked:
        lanes, through = track(scene, settings, seed, lanes, casts)
    else:
        through = _closed_form_transmittance(scene, settings, lanes, casts)
    lanes = _resolve_shadows(lanes, casts, through)
    pending = late = jnp.zeros(lanes.alive.shape, bool)
    for shadow in lanes.shadows:
        pending = pending | shadow.active
        # Only these keep the ended sample: sums of the next one's equi-angular vertex must not be added to it.
        late = late | (shadow.active & shadow.of_finished)
    complete = lanes.finished.valid & ~late
    ended = Ended(lanes.sums, eqx.tree_at(lambda f: f.valid, lanes.finished, complete))
    lanes = eqx.tree_at(
        lambda x: (x.finished.valid, x.sums),
        lanes,
        (
            lanes.finished.valid & late,
            tuple(None if s is None else jnp.where(complete[:, None], 0.0, s) for s in lanes.sums),
        ),
        is_leaf=lambda x: x is None,
    )
    ready = lanes.alive & ~pending
    if settings.tracked:
        ready = ready & ((lanes.flight.stage == ARRIVED) | lanes.starting)
    lanes, dead = _event(scene, proxy, sensor, settings, seed, lanes, casts, ready)
    lanes, work = _refill(sensor, settings, seed, lanes, dead, work)
    return lanes, work, ended


def _connect_ahead(scene, proxy, settings, seed, lanes, casts, fresh):
    """In grids: choose the equi-angular vertex of every new ray before flying along it."""
    draw = lambda block: sampling.uniforms(seed, _STREAM, lanes.pixel, lanes.event * 8 + block, lanes.sample)  # noqa: E731
    extra = connect_equiangular(scene, settings, proxy, lanes, casts, fresh, draw(5), draw(6)[:3])
    lanes = eqx.tree_at(
        lambda x: (x.shadows, x.recast_shadows),
        lanes,
        ((lanes.shadows[0], _replace(lanes.shadows[1], extra, fresh)), (lanes.recast_shadows[0], fresh)),
    )
    return board(lanes, fresh)


def _closed_form_transmittance(scene, settings, lanes, casts):
    """Transmittance of the shadow rays, and that all of them are through."""
    found = []
    for number, shadow in enumerate(lanes.shadows):
        if scene.medium is None:
            found.append((None, shadow.active))
            continue
        spans = shadow_spans(scene, settings, shadow, casts, number)
        found.append((jnp.exp(-flights.optical_thickness(scene.medium, spans)), shadow.active))
    return tuple(found)


def _resolve_shadows(lanes, casts, through):
    """Add what lights contribute through the shadow rays that are done."""
    sums, shadows = lanes.sums, []
    for shadow, blocked, (transmittance, done) in zip(lanes.shadows, casts.blocked, through, strict=True):
        value = shadow.contribution if transmittance is None else shadow.contribution * transmittance
        sums = add_to_group(sums, shadow.group, jnp.where((done & ~blocked)[:, None], value, 0.0))
        shadows.append(eqx.tree_at(lambda s: s.active, shadow, shadow.active & ~done))
    return eqx.tree_at(lambda x: (x.sums, x.shadows), lanes, (sums, tuple(shadows)), is_leaf=lambda x: x is None)


def _arrive(scene, proxy, settings, lanes, casts, ready, u) -> Arrival:
    ready = ready & ~lanes.starting
    n = ready.shape[0]
    collided = jnp.zeros(n, bool)
    t, region = casts.t, jnp.full(n, -1, jnp.int32)
    weight = jnp.ones((n, 3), jnp.float32)
    density = jnp.zeros(n, jnp.float32)
    if scene.medium is not None and settings.tracked:
        flight = lanes.flight
        collided, region = flight.collided, flight.region
        t = jnp.where(collided, flight.t, casts.t)
        share = flights.choose_channel(lanes.throughput, u[0])[1]
        mean = jnp.maximum(jnp.sum(share * flight.ratio, axis=-1), 1e-37)
        albedo = flights.albedo(scene.medium, region)
        weight = jnp.where(collided[:, None], albedo, 1.0) * flight.ratio / mean[:, None]
        if settings.equiangular:
            density = flights.homogeneous_pdf(proxy, path_spans(scene, settings, lanes, casts), lanes.throughput, t)[0]
    elif scene.medium is not None:
        spans = path_spans(scene, settings, lanes, casts)
        t_flight, collided, region, weight, density = flights.sample_homogeneous(
            scene.medium, spans, lanes.throughput, u[0], u[1]
        )
        t = jnp.where(collided, t_flight, casts.t)
    collided = collided & ready
    on_surface = ready & ~collided & (casts.face >= 0)
    finite_t = jnp.where(collided | on_surface, t, 0.0)
    hit = ray_casting.hits(scene.mesh, lanes.origin, lanes.direction, finite_t, jnp.where(on_surface, casts.face, -1))
    position = jnp.where(on_surface[:, None], hit.position, lanes.origin + finite_t[:, None] * lanes.direction)
    escaped = ready & ~collided & (casts.face < 0)
    return Arrival(collided, position, hit.normal, region, weight, density, on_surface, escaped)


def _emission(scene, settings, lanes, casts, arrival, throughput):
    """Light met by the path itself: emissive faces and the environment, weighted against next-event estimation."""
    if scene.area_lights is None and scene.environment is None:
        return jnp.zeros_like(throughput)
    radiance = jnp.zeros_like(throughput)
    if scene.area_lights is not None:
        emitted = lights.emitted_radiance(scene.mesh, casts.face, arrival.normal, lanes.direction)
        radiance = jnp.where(arrival.on_surface[:, None], emitted, radiance)
    if scene.environment is not None:
        sky = lights.environment_radiance(scene.environment, lanes.direction)
        radiance = jnp.where(arrival.escaped[:, None], sky, radiance)
    face = jnp.where(arrival.on_surface, casts.face, -1)
    other = lights.sample_light_pdf(scene, lanes.origin, lanes.direction, face, casts.t, arrival.normal)
    if settings.equiangular and scene.area_lights is not None:
        # Relative to free flight, which brought the path here: see `connect`.
        on_segment = (lanes.segment.density > 0) & arrival.on_surface
        rate = equiangular_density(scene, lanes.segment, lanes.origin, arrival.position)
        extra = other * rate / jnp.where(on_segment, lanes.segment.density, 1.0)
        other = other + jnp.where(on_segment, extra, 0.0)
    chosen = lanes.pdf > 0
    mis = jnp.where(chosen, lanes.pdf / jnp.maximum(lanes.pdf + other, 1e-37), 1.0)
    return throughput * radiance * mis[:, None]


def flight_uniforms(seed, lanes):
    """What decides the flights from where the lanes are, known before they are flown."""
    return sampling.uniforms(seed, _STREAM, lanes.pixel, lanes.event * 8, lanes.sample)


def _event(scene, proxy, sensor, settings, seed, lanes, casts, ready):
    """What happens where flights end: light is met, a vertex is connected to a light, and the path scatters or ends."""
    draw = lambda block: sampling.uniforms(seed, _STREAM, lanes.pixel, lanes.event * 8 + block, lanes.sample)  # noqa: E731
    flight_u, light_u, scatter_u = flight_uniforms(seed, lanes), draw(1), draw(2)
    arrival = _arrive(scene, proxy, settings, lanes, casts, ready, flight_u)
    throughput = lanes.throughput * arrival.weight
    count = lanes.num_vertices
    # `group` of light that joins the path as it stands; the last vertex' type rides in `lanes.last_volume`.
    group = group_after(count, lanes.first_volume, lanes.last_volume)
    met = _emission(scene, settings, lanes, casts, arrival, throughput)
    gone = arrival.on_surface | arrival.escaped
    sums = add_to_group(lanes.sums, group, jnp.where(gone[:, None], met, 0.0))

    vertex = (arrival.collided | arrival.on_surface) & (count < settings.max_scatterings)
    first_volume = jnp.where(vertex & (count == 0), arrival.collided, lanes.first_volume)
    last_volume = jnp.where(vertex, arrival.collided, lanes.last_volume)
    count = count + vertex.astype(jnp.int32)
    surface = None if scene.mesh is None else materials.surface_at(scene.mesh, casts.face)

    shadows = lanes.shadows
    if shadows:
        shadow = connect(
            scene,
            sensor,
            settings,
            lanes,
            casts,
            arrival,
            throughput,
            surface,
            vertex,
            light_u,
            group_after(count, first_volume, last_volume),
        )
        shadows = (_replace(shadows[0], shadow, ready), *shadows[1:])
    if settings.equiangular and not settings.tracked:
        extra = connect_equiangular(scene, settings, proxy, lanes, casts, ready, draw(3), None)
        shadows = (shadows[0], _replace(shadows[1], extra, ready))

    direction, weight, pdf = _scatter(scene, lanes, arrival, surface, scatter_u)
    scattered = throughput * weight
    keep = slopes.largest(scattered)
    survival = jnp.where(count >= settings.roulette_from, jnp.clip(keep, 0.02, 1.0), 1.0)
    alive = vertex & (scatter_u[3] < survival) & (keep > 0)
    if scene.area_lights is None and scene.environment is None:
        alive = alive & (count < settings.max_scatterings)  # nothing to be met by a last flight
    scattered = scattered / survival[:, None]
    origin = arrival.position
    if scene.mesh is not None:
        off = ray_casting.offset_origin(arrival.position, arrival.normal, direction, scale=ray_casting.scene_scale(scene.mesh))
        origin = jnp.where(arrival.on_surface[:, None], off, origin)
    go = vertex & alive
    ended = ready & ~lanes.starting & ~go
    pick = lambda new, old: jnp.where(go[:, None] if new.ndim == 2 else go, new, old)  # noqa: E731
    before = lanes
    recast_shadows = lanes.recast_shadows
    if shadows:
        recast_shadows = (ready, *(recast_shadows[1:] if settings.tracked else [ready] * (len(shadows) - 1)))
    lanes = eqx.tree_at(
        lambda x: (
            x.sums,
            x.shadows,
            x.origin,
            x.direction,
            x.throughput,
            x.pdf,
            x.num_vertices,
            x.first_volume,
            x.last_volume,
            x.event,
            x.region,
            x.starting,
            x.recast,
            x.recast_shadows,
        ),
        lanes,
        (
            sums,
            shadows,
            pick(origin, lanes.origin),
            pick(direction, lanes.direction),
            pick(scattered, lanes.throughput),
            pick(pdf, lanes.pdf),
            count,
            first_volume,
            last_volume,
            lanes.event + ready.astype(jnp.uint32),
            pick(jnp.where(arrival.collided, arrival.region, -1), lanes.region),
            lanes.starting & ~ready,
            ready,
            recast_shadows,
        ),
    )
    if settings.equiangular:
        flown = flown_segment(scene, settings, before, casts, arrival)
        segment = Segment(*(pick(getattr(flown, f), getattr(lanes.segment, f)) for f in Segment.__dataclass_fields__))
        lanes = eqx.tree_at(lambda x: x.segment, lanes, segment)
    if settings.tracked:
        lanes = take_off(lanes, ready, draw(4)[0])
    return lanes, ended


def _replace(old: Shadow, new: Shadow, ready):
    pick = lambda a, b: jnp.where(ready[:, None] if a.ndim == 2 else ready, a, b)  # noqa: E731
    return Shadow(*(pick(getattr(new, f), getattr(old, f)) for f in Shadow.__dataclass_fields__))


def _scatter(scene, lanes, arrival, surface, u):
    """A new direction, its weight for the throughput, and its density."""
    n = u[0].shape[0]
    direction, pdf = lanes.direction, jnp.ones(n, jnp.float32)
    weight = jnp.ones((n, 3), jnp.float32)
    if scene.medium is not None:
        direction, pdf = flights.sample_phase(scene.medium, arrival.region, lanes.direction, u[0], u[1])
    if scene.mesh is not None:
        out = materials.sample(surface, arrival.normal, lanes.direction, u[0], u[1], u[2])
        out_pdf = materials.sample_pdf(surface, arrival.normal, lanes.direction, out)
        value = materials.evaluate(surface, arrival.normal, lanes.direction, out)
        cosine = jnp.abs(sampling.dot(arrival.normal, out))
        reflected = value * (cosine / jnp.maximum(out_pdf, 1e-20))[:, None]
        at = arrival.on_surface
        direction = jnp.where(at[:, None], out, direction)
        pdf = jnp.where(at, out_pdf, pdf)
        weight = jnp.where(at[:, None], reflected, weight)
    return direction, weight, pdf


def _refill(sensor, settings, seed, lanes, ended, work):
    """Note ended samples in `finished` and start the next work items in their lanes."""
    free = ended | ~lanes.alive
    for shadow in lanes.shadows:  # a sample still in `finished` must leave before the lane is used again
        free = free & (ended | ~shadow.active)
    finished = lanes.finished
    pick = lambda new, old: jnp.where(ended[:, None] if new.ndim == 2 else ended, new, old)  # noqa: E731
    finished = Finished(
        pixel=pick(lanes.pixel, finished.pixel),
        sample=pick(lanes.sample, finished.sample),
        first_volume=pick(lanes.first_volume, finished.first_volume),
        valid=finished.valid | ended,
    )
    shadows = tuple(
        eqx.tree_at(lambda s: s.of_finished, shadow, shadow.of_finished | (ended & shadow.active)) for shadow in lanes.shadows
    )
    item = work.next + jnp.cumsum(free.astype(jnp.uint32)) - jnp.uint32(1)
    start = free & (item < work.end)
    sample = work.first_sample + item // jnp.uint32(work.num_pixels)
    pixel = (item % jnp.uint32(work.num_pixels)).astype(jnp.int32) + work.first_pixel
    pixel = jnp.where(start, pixel, lanes.pixel)
    sample = jnp.where(start, sample, lanes.sample)
    u1, u2, u3, _ = sampling.uniforms(seed, _STREAM, pixel, jnp.uint32(7), sample)
    origin, direction, weight, pdf = sensors.sample_ray(sensor, pixel, u1, u2)
    new = lambda a, b: jnp.where(start[:, None] if jnp.ndim(b) == 2 else start, a, b)  # noqa: E731
    lanes = Lanes(
        pixel=pixel,
        sample=sample,
        alive=(lanes.alive & ~ended) | start,
        starting=new(sensors.sees_light(sensor) and bool(lanes.shadows), lanes.starting),
        origin=new(origin, lanes.origin),
        direction=new(direction, lanes.direction),
        throughput=new(weight[:, None], lanes.throughput),
        pdf=new(pdf, lanes.pdf),
        num_vertices=new(0, lanes.num_vertices),
        first_volume=new(False, lanes.first_volume),
        last_volume=new(False, lanes.last_volume),
        event=new(jnp.uint32(1), lanes.event),
        region=new(-1, lanes.region),
        sums=lanes.sums,
        shadows=shadows,
        finished=finished,
        flight=lanes.flight,
        segment=lanes.segment,
        recast=lanes.recast | start,
        recast_shadows=lanes.recast_shadows,
    )
    if settings.tracked:
        lanes = take_off(lanes, start, u3)
    count = jnp.sum(start.astype(jnp.uint32))
    return lanes, eqx.tree_at(lambda w: w.next, work, work.next + count)
