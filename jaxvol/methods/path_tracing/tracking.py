"""Flights through density grids, a few tentative collisions a step: delta tracking of paths, ratio tracking of shadow rays.

All lanes run the same loop body, whichever of the two rays they are on, so that no lane waits for another's flight.
"""

import equinox as eqx
import jax.numpy as jnp
from jax import lax

from jaxvol import sampling, slopes
from jaxvol.methods.path_tracing import flight as flights
from jaxvol.methods.path_tracing.lanes import ARRIVED, ON_APPROACH, ON_PATH, ON_SECOND_SHADOW, ON_SHADOW

_STREAM = sampling.stream("path_tracing.tracking")
_ROULETTE = 0.1  # shadow rays of less transmittance gamble


def shadow_spans(scene, settings, shadow, casts, number) -> flights.Spans:
    """The media along the shadow rays of one slot."""
    if settings.bounded:
        return flights.clip_spans(casts.shadow_spans[number], shadow.distance)
    return flights.box_spans(scene.medium, shadow.origin, shadow.direction, shadow.distance)


def path_spans(scene, settings, lanes, casts) -> flights.Spans:
    """The media along the path rays, up to the next surface."""
    if settings.bounded:
        return flights.clip_spans(casts.path_spans, casts.t)
    return flights.box_spans(scene.medium, lanes.origin, lanes.direction, casts.t)


def _path_counter(lanes):
    """Number of the first random number of a path flight; the rays to lights before it have the numbers below."""
    return lanes.event << 16 | jnp.uint32(0x8000)


def _second_counter(lanes):
    return lanes.event << 16 | jnp.uint32(0x4000)


def take_off(lanes, which, u):
    """Begin the next flights of lanes in `which`: along the shadow ray where there is one, else along the path."""
    flight = lanes.flight
    hero = flights.choose_channel(lanes.throughput, u)[0]
    waiting, shadow_counter = jnp.zeros_like(which), jnp.zeros_like(flight.counter)
    if lanes.shadows:
        waiting, shadow_counter = lanes.shadows[0].active, lanes.shadows[0].event << 16
    new = (
        jnp.where(waiting, ON_SHADOW, ON_PATH),
        jnp.full_like(flight.t, -1.0),
        jnp.zeros_like(flight.span),
        jnp.ones_like(flight.ratio),
        hero,
        jnp.zeros_like(flight.collided),
        flight.region,
        jnp.where(waiting, shadow_counter, _path_counter(lanes)),
    )
    old = (flight.stage, flight.t, flight.span, flight.ratio, flight.hero, flight.collided, flight.region, flight.counter)
    picked = (jnp.where(which[:, None] if a.ndim == 2 else which, a, b) for a, b in zip(new, old, strict=True))
    return eqx.tree_at(lambda x: x.flight, lanes, type(flight)(*picked))


def _current_rays(scene, settings, lanes, casts):
    """Ray, spans and identity (pixel, sample) of whatever each lane is following, and whether it is blocked."""
    stage = lanes.flight.stage
    spans = path_spans(scene, settings, lanes, casts)
    rays = [lanes.origin, lanes.direction, *spans, lanes.pixel, lanes.sample, jnp.zeros_like(lanes.alive)]

    def use(which, new):
        for i, value in enumerate(new):
            if value is not None:
                rays[i] = jnp.where(which[:, None] if value.ndim == 2 else which, value, rays[i])

    if lanes.shadows:
        shadow = lanes.shadows[0]
        which = shadow.active & (stage == ON_SHADOW)
        use(
            which,
            (shadow.origin, shadow.direction, *shadow_spans(scene, settings, shadow, casts, 0), None, None, casts.blocked[0]),
        )
        late = which & shadow.of_finished
        use(late, (None, None, None, None, lanes.finished.pixel, lanes.finished.sample, None))
    if settings.equiangular:
        shadow = lanes.shadows[1]
        reach = sampling.dot(shadow.origin - lanes.origin, lanes.direction)
        use(stage == ON_APPROACH, (None, None, *flights.clip_spans(spans, reach), None, None, casts.blocked[1]))
        second = shadow_spans(scene, settings, shadow, casts, 1)
        use(stage == ON_SECOND_SHADOW, (shadow.origin, shadow.direction, *second, None, None, casts.blocked[1]))
    origin, direction, t, region, pixel, sample, blocked = rays
    return origin, direction, (t, region), pixel, sample, blocked


def track(scene, settings, seed, lanes, casts):
    """Up to `tracking_steps` tentative collisions of every flight.

    Returns the lanes and, for each shadow slot, (transmittance [n, 3], done [n]). Whatever is done hands over to the
    next stage.
    """
    medium, flight = scene.medium, lanes.flight
    origin, direction, spans, pixel, sample, blocked = _current_rays(scene, settings, lanes, casts)
    stage = flight.stage
    on_path = stage == ON_PATH
    connecting = ~on_path
    num_spans = spans[1].shape[1]
    late = stage == ON_SHADOW  # its sample may have ended: the lane itself need not be alive
    busy = (stage != ARRIVED) & ~late & lanes.alive & ~lanes.starting
    if lanes.shadows:
        busy = busy | (late & lanes.shadows[0].active)
    t = jnp.where(flight.t < 0, flights.span_start(spans), flight.t)

    def body(_, state):
        t, span, ratio, region, collided, done, counter = state
        u1, u2, u3, u4, v = sampling.five_uniforms(seed, _STREAM, pixel, counter, sample)
        moved, next_span, found_region, share = flights.tentative(medium, spans, origin, direction, t, span, u1, (u2, u3, u4))
        hero_share = flights.pick(share, flight.hero)
        hit = on_path & (v < hero_share)
        survive = jnp.where(connecting, 1.0, jnp.maximum(1.0 - hero_share, 1e-6))
        passed = ratio * (1.0 - share) / survive[:, None]
        struck = ratio * share / jnp.maximum(hero_share, 1e-30)[:, None]
        weight = slopes.largest(passed)
        gamble = connecting & (weight < _ROULETTE)
        lost = gamble & (v * _ROULETTE >= weight)
        raised = passed * (_ROULETTE / jnp.maximum(weight, 1e-30))[:, None]
        passed = jnp.where(gamble[:, None], jnp.where(lost[:, None], 0.0, raised), passed)
        new = (moved, next_span, jnp.where(hit[:, None], struck, passed), found_region, collided | hit)
        old = (t, span, ratio, region, collided)
        kept = [jnp.where(done[:, None] if a.ndim == 2 else done, b, a) for a, b in zip(new, old, strict=True)]
        done = done | hit | lost | (next_span >= num_spans)
        return (*kept, done, counter + jnp.uint32(1))

    state = (t, flight.span, flight.ratio, flight.region, flight.collided, ~busy | blocked, flight.counter)
    t, span, ratio, region, collided, done, counter = lax.fori_loop(0, settings.tracking_steps, body, state)
    done = done & busy
    lost = blocked | (jnp.max(ratio, axis=-1) <= 0)
    next_stage, resolved = _next_stage(settings, lanes, stage, done, lost)
    turned = done & (next_stage != ARRIVED)
    first = jnp.where(next_stage == ON_APPROACH, _second_counter(lanes), _path_counter(lanes))
    keeps_ratio = next_stage == ON_SECOND_SHADOW  # transmittance goes on from the approach
    counter = jnp.where(turned & ~keeps_ratio, first, counter)
    lanes = eqx.tree_at(
        lambda x: x.flight,
        lanes,
        type(flight)(
            next_stage,
            jnp.where(turned, -1.0, t),
            jnp.where(turned, 0, span),
            jnp.where((turned & ~keeps_ratio)[:, None], 1.0, ratio),
            flight.hero,
            collided & ~turned,
            region,
            counter,
        ),
    )
    return lanes, tuple((ratio, which) for which in resolved)


def _next_stage(settings, lanes, stage, done, lost):
    """The stage after this step, and for each shadow slot whether it is resolved."""
    if not lanes.shadows:
        return jnp.where(done, ARRIVED, stage), ()
    first = done & (stage == ON_SHADOW)
    after_shadow = jnp.full_like(stage, ON_PATH)
    following = jnp.where(stage == ON_PATH, ARRIVED, ON_PATH)
    resolved = (first,)
    if settings.equiangular:
        after_shadow = jnp.where(lanes.shadows[1].active, ON_APPROACH, ON_PATH)
        onward = (stage == ON_APPROACH) & ~lost
        following = jnp.where(onward, ON_SECOND_SHADOW, following)
        resolved = (first, done & (((stage == ON_APPROACH) & lost) | (stage == ON_SECOND_SHADOW)))
    following = jnp.where(stage == ON_SHADOW, after_shadow, following)
    return jnp.where(done, following, stage), resolved


def board(lanes, fresh):
    """Lanes with a new ray and an equi-angular vertex on it follow that ray first."""
    flight = lanes.flight
    which = fresh & lanes.shadows[1].active & (flight.stage == ON_PATH)
    return eqx.tree_at(
        lambda x: (x.flight.stage, x.flight.counter),
        lanes,
        (jnp.where(which, ON_APPROACH, flight.stage), jnp.where(which, _second_counter(lanes), flight.counter)),
    )
