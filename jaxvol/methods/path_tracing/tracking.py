"""Flights through density grids, a few tentative collisions a step: delta tracking of paths, ratio tracking of shadow rays.

All lanes run the same loop body, whichever of the two rays they are on, so that no lane waits for another's flight.
"""

import equinox as eqx
import jax.numpy as jnp
from jax import lax

from jaxvol import sampling
from jaxvol.methods.path_tracing import flight as flights
from jaxvol.methods.path_tracing.lanes import ARRIVED, ON_PATH, ON_SHADOW

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


def first_counter(lanes):
    """Number of a flight's first random number: shadow and path flights of an event have 2^15 numbers each."""
    if not lanes.shadows:
        return lanes.event << 16 | jnp.uint32(0x8000)
    shadow = lanes.shadows[0]
    return jnp.where(shadow.active, shadow.event << 16, lanes.event << 16 | jnp.uint32(0x8000))


def take_off(lanes, which, u):
    """Begin the next flights of lanes in `which`: along the shadow ray where there is one, else along the path."""
    flight = lanes.flight
    hero = flights.choose_channel(lanes.throughput, u)[0]
    waiting = lanes.shadows[0].active if lanes.shadows else jnp.zeros_like(which)
    new = (
        jnp.where(waiting, ON_SHADOW, ON_PATH),
        jnp.full_like(flight.t, -1.0),
        jnp.zeros_like(flight.span),
        jnp.ones_like(flight.ratio),
        hero,
        jnp.zeros_like(flight.collided),
        flight.region,
        first_counter(lanes),
    )
    old = (flight.stage, flight.t, flight.span, flight.ratio, flight.hero, flight.collided, flight.region, flight.counter)
    picked = (jnp.where(which[:, None] if a.ndim == 2 else which, a, b) for a, b in zip(new, old, strict=True))
    return eqx.tree_at(lambda x: x.flight, lanes, type(flight)(*picked))


def track(scene, settings, seed, lanes, casts):
    """Up to `tracking_steps` tentative collisions of every flight.

    Returns the lanes and, for the shadow slot, (transmittance [n, 3], done [n]). A shadow flight that is done hands
    over to the path's.
    """
    medium, flight = scene.medium, lanes.flight
    spans = path_spans(scene, settings, lanes, casts)
    origin, direction, pixel, sample = lanes.origin, lanes.direction, lanes.pixel, lanes.sample
    on_shadow = jnp.zeros_like(lanes.alive)
    blocked = on_shadow
    if lanes.shadows:
        shadow = lanes.shadows[0]
        on_shadow = shadow.active & (flight.stage == ON_SHADOW)
        blocked = on_shadow & casts.blocked[0]
        choose = lambda a, b: jnp.where(on_shadow[:, None] if a.ndim == 2 else on_shadow, a, b)  # noqa: E731
        origin, direction = choose(shadow.origin, origin), choose(shadow.direction, direction)
        other = shadow_spans(scene, settings, shadow, casts, 0)
        spans = (choose(other[0], spans[0]), choose(other[1], spans[1]))
        late = on_shadow & shadow.of_finished
        pixel = jnp.where(late, lanes.finished.pixel, pixel)
        sample = jnp.where(late, lanes.finished.sample, sample)
    num_spans = spans[1].shape[1]
    busy = on_shadow | (lanes.alive & ~lanes.starting & (flight.stage == ON_PATH))
    t = jnp.where(flight.t < 0, flights.span_start(spans), flight.t)

    def body(_, state):
        t, span, ratio, region, collided, done, counter = state
        u1, u2, u3, u4 = sampling.uniforms(seed, _STREAM, pixel, counter, sample)
        v = sampling.uniforms(seed, _STREAM, pixel, counter + jnp.uint32(1), sample)[0]
        moved, next_span, found_region, share = flights.tentative(medium, spans, origin, direction, t, span, u1, (u2, u3, u4))
        hero_share = flights.pick(share, flight.hero)
        hit = ~on_shadow & (v < hero_share)
        survive = jnp.where(on_shadow, 1.0, jnp.maximum(1.0 - hero_share, 1e-6))
        passed = ratio * (1.0 - share) / survive[:, None]
        struck = ratio * share / jnp.maximum(hero_share, 1e-30)[:, None]
        weight = jnp.max(passed, axis=-1)
        gamble = on_shadow & (weight < _ROULETTE)
        lost = gamble & (v * _ROULETTE >= weight)
        raised = passed * (_ROULETTE / jnp.maximum(weight, 1e-30))[:, None]
        passed = jnp.where(gamble[:, None], jnp.where(lost[:, None], 0.0, raised), passed)
        new = (moved, next_span, jnp.where(hit[:, None], struck, passed), found_region, collided | hit)
        old = (t, span, ratio, region, collided)
        kept = [jnp.where(done[:, None] if a.ndim == 2 else done, b, a) for a, b in zip(new, old, strict=True)]
        done = done | hit | lost | (next_span >= num_spans)
        return (*kept, done, counter + jnp.uint32(2))

    state = (t, flight.span, flight.ratio, flight.region, flight.collided, ~busy | blocked, flight.counter)
    t, span, ratio, region, collided, done, counter = lax.fori_loop(0, settings.tracking_steps, body, state)
    shadow_done = on_shadow & done
    stage = jnp.where(busy & ~on_shadow & done, ARRIVED, jnp.where(shadow_done, ON_PATH, flight.stage))
    path_counter = lanes.event << 16 | jnp.uint32(0x8000)
    lanes = eqx.tree_at(
        lambda x: x.flight,
        lanes,
        type(flight)(
            stage,
            jnp.where(shadow_done, -1.0, t),
            jnp.where(shadow_done, 0, span),
            jnp.where(shadow_done[:, None], 1.0, ratio),
            flight.hero,
            collided & ~shadow_done,
            region,
            jnp.where(shadow_done, path_counter, counter),
        ),
    )
    return lanes, tuple((ratio, shadow_done) for _ in lanes.shadows)
