"""Random walks from the lights through medium and surfaces; every scattering leaves a vertex (section 4.1).

One step = fly to the next interaction, record it, scatter, Russian roulette. Random numbers depend on (seed, path,
bounce) alone, so a path is the same in any batch and survives across frames; the emission and the first two flights and
directions take them from a randomly shifted rank-1 lattice, which makes a few hundred paths cover the light evenly.
"""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int, UInt

from jaxvol import emission, materials, media, phase, ray_casting, sampling, slopes
from jaxvol.types import Scene

_EMISSION = sampling.stream("instant_multiple_scattering.emission")
_SCATTER = sampling.stream("instant_multiple_scattering.scatter")
_FLIGHT = sampling.stream("instant_multiple_scattering.flight")
_SHIFT = sampling.stream("instant_multiple_scattering.shift")
# Generating vector of an embedded rank-1 lattice of up to 2^20 points (Cools, Kuo and Nuyens 2006, exod2_base2_m20).
_LATTICE = (1, 182667, 469891, 498753, 110745, 446247, 250185, 118627, 245333, 283199, 408519)
_LATTICE_BOUNCES = 2
_MAX_EVENTS = 100_000  # tentative collisions of one flight
_CHUNKS = (1, 1, 2, 4)  # bounces or tentative collisions between two compactions: most paths end early
_CHUNK = 8  # and after those


class Walkers(eqx.Module):
    """Light paths between two interactions, each at its own bounce."""

    path: UInt[Array, "n"]
    bounce: Int[Array, "n"]  # interactions so far
    origin: Float[Array, "n 3"]
    direction: Float[Array, "n 3"]
    power: Float[Array, "n 3"]  # throughput: L before the flight, W for a share 1/num_paths of the light
    alive: Bool[Array, "n"]


class Flight(eqx.Module):
    """Where flights end: after `t` in the medium, at a surface, or (neither) nowhere."""

    t: Float[Array, "n"]
    scatters: Bool[Array, "n"]
    weight: Float[Array, "n 3"]  # tau / p(t), or tau / P(no collision)
    density: Float[Array, "n"]  # of the medium at t where it scatters


class Vertices(eqx.Module):
    """Interactions of light paths, one row each."""

    path: Int[Array, "m"]
    depth: Int[Array, "m"]  # 0 = the first interaction after the light
    position: Float[Array, "m 3"]
    direction: Float[Array, "m 3"]  # of travel, arriving
    incident: Float[Array, "m 3"]  # L_i: incident radiance weight, per path
    face: Int[Array, "m"]  # -1 = in the medium
    density: Float[Array, "m"]  # of the medium there; 1 on surfaces
    outgoing: Float[Array, "m 3"]  # of travel, leaving
    power: Float[Array, "m 3"]  # throughput that leaves; 0 where the walk ends
    continues: Bool[Array, "m"]  # the walk went on from here
    valid: Bool[Array, "m"]


def lattice(index: UInt[Array, "n"], *, seed: UInt[Array, ""], dimension: int) -> Float[Array, "n"]:
    """Coordinate `dimension` of point `index` of the shifted lattice, in (0, 1): frac(reversed bits of index * z + shift)."""
    reversed_bits = _reverse_bits(jnp.asarray(index, jnp.uint32))
    mixed = jnp.asarray(seed, jnp.uint32) * jnp.uint32(0x9E3779B9) ^ jnp.uint32(_SHIFT)
    shift = sampling.pcg4d(jnp.uint32(dimension), jnp.uint32(0), jnp.uint32(0), mixed)[0]
    bits = reversed_bits * jnp.uint32(_LATTICE[dimension]) + shift
    return ((bits >> 9).astype(jnp.float32) + 0.5) * jnp.float32(2.0**-23)


def _reverse_bits(x):
    for mask, shift in ((0x55555555, 1), (0x33333333, 2), (0x0F0F0F0F, 4), (0x00FF00FF, 8)):
        x = ((x >> shift) & jnp.uint32(mask)) | ((x & jnp.uint32(mask)) << shift)
    return (x >> 16) | (x << 16)


def _uniforms(walkers, seed):
    """Six uniforms of a bounce; the first three (flight, direction) come from the lattice in the first bounces."""
    result = [
        *sampling.uniforms(seed, _SCATTER, walkers.path, 2 * walkers.bounce),
        *sampling.uniforms(seed, _SCATTER, walkers.path, 2 * walkers.bounce + 1),
    ]
    for b in range(_LATTICE_BOUNCES):
        for i in range(3):
            u = lattice(walkers.path, seed=seed, dimension=4 + 3 * b + i)
            result[i] = jnp.where(walkers.bounce == b, u, result[i])
    return result


@jax.jit
def emit(scene: Scene, path: UInt[Array, "n"], seed: UInt[Array, ""]) -> Walkers:
    """Paths leaving the lights: L = Le cos / p(x, w, light). Raises ValueError when the scene has no light."""
    hashed = sampling.uniforms(seed, _EMISSION, path, 0)
    u = [lattice(path, seed=seed, dimension=i) for i in range(4)]
    # The choice of the light is hashed: a lattice over lights of unlike power would tie lights to directions.
    found = emission.sample_emission(scene, hashed[0], u[0], u[1], u[2], u[3])
    origin = found.position
    if scene.mesh is not None:
        scale = ray_casting.scene_scale(scene.mesh)
        lifted = ray_casting.offset_origin(origin, found.normal, found.direction, scale=scale)
        origin = jnp.where(found.on_surface[:, None], lifted, origin)
    alive = jnp.max(found.power, axis=-1) > 0
    return Walkers(path, jnp.zeros(path.shape, jnp.int32), origin, found.direction, found.power, alive)


def _channel_probabilities(walkers):
    return slopes.ratio(walkers.power, jnp.sum(walkers.power, axis=-1, keepdims=True))


def _channel(choice, u):
    """A colour channel with probabilities `choice` [n, 3]."""
    return (u > choice[:, 0]).astype(jnp.int32) + (u > choice[:, 0] + choice[:, 1]).astype(jnp.int32)


def _flight_homogeneous(medium, walkers, t0, t1, u):
    """Exponential flight with one-sample MIS over the channels: weight tau_c / sum_k P_k p_k."""
    choice = _channel_probabilities(walkers)
    extinction = media.sigma_t(medium)
    sigma = extinction[_channel(choice, u[3])]
    t = t0 + sampling.sample_exponential(u[0], sigma)
    scatters = (t < t1) & walkers.alive & (sigma > 0)
    column = jnp.maximum(jnp.minimum(t, t1) - t0, 0.0)
    # Relative to the least absorbing channel: exp(-sigma column) itself underflows in all channels of a thick flight.
    tau = jnp.exp(-(extinction - jnp.min(extinction)) * column[:, None])
    density = jnp.where(scatters[:, None], extinction, 1.0)
    weight = tau / jnp.maximum(sampling.dot(choice, tau * density), 1e-30)[:, None]
    return Flight(t, scatters, weight, jnp.ones_like(t))


class Tracking(eqx.Module):
    """Flights by delta tracking, under way."""

    t: Float[Array, "n"]
    event: Int[Array, "n"]
    survival: Float[Array, "n 3"]  # product of 1 - sigma_t / rate over null collisions, up to a factor


def _tracking(walkers, t0):
    return Tracking(t0, jnp.zeros(t0.shape, jnp.int32), jnp.ones_like(walkers.power))


def _tentative(medium, walkers, tracking, t1, flying, seed):
    """One tentative collision at the global majorant's rate: (tracking, is it real, flight weight, density)."""
    choice = _channel_probabilities(walkers)
    extinction = media.sigma_t(medium)
    rate = jnp.max(medium.majorants.density) * jnp.max(extinction)
    v = sampling.uniforms(seed, _FLIGHT, walkers.path, tracking.event, walkers.bounce)
    channel_u = sampling.uniforms(seed, _SCATTER, walkers.path, 2 * walkers.bounce)[3]
    sigma = extinction[_channel(choice, channel_u)]
    t = jnp.where(flying, tracking.t + sampling.sample_exponential(v[0], rate), tracking.t)
    flying = flying & (t < t1)
    rho = media.density(medium, walkers.origin + t[:, None] * walkers.direction)
    real = flying & (v[1] * rate < rho * sigma)
    kept = tracking.survival * (1.0 - rho[:, None] * extinction / jnp.maximum(rate, 1e-30))
    most = slopes.largest(kept)[:, None]
    kept = kept / jnp.where(most > 0, most, 1.0)
    survival = jnp.where((flying & ~real)[:, None], kept, tracking.survival)
    pdf = sampling.dot(choice, survival * jnp.where(real[:, None], rho[:, None] * extinction, 1.0))
    weight = survival / jnp.where(pdf > 0, pdf, 1.0)[:, None]
    return Tracking(t, tracking.event + 1, survival), flying, real, weight, rho


def _flight_tracked(medium, walkers, t0, t1, seed):
    """A whole flight by delta tracking: the null collisions' ratio of the channels is the MIS weight."""

    def advance(state):
        tracking, flying, flight = state
        tracking, inside, real, weight, rho = _tentative(medium, walkers, tracking, t1, flying, seed)
        ended = flying & (real | ~inside)
        flight = Flight(
            jnp.where(ended, tracking.t, flight.t),
            flight.scatters | real,
            jnp.where(ended[:, None], weight, flight.weight),
            jnp.where(real, rho, flight.density),
        )
        return tracking, inside & ~real, flight

    def unfinished(state):
        return jnp.any(state[1]) & (jnp.max(state[0].event) < _MAX_EVENTS)

    flying = walkers.alive & (t1 > t0)
    nothing = Flight(t1, jnp.zeros_like(flying), jnp.ones_like(walkers.power), jnp.ones_like(t1))
    return lax.while_loop(unfinished, advance, (_tracking(walkers, t0), flying, nothing))[2]


def _interact(scene, walkers, flight, meets, hit, face, u):
    """Record the interaction at the end of a flight, choose a new direction, play roulette."""
    t = jnp.where(flight.scatters, flight.t, 0.0)
    incident = walkers.power * flight.weight
    position = walkers.origin + t[:, None] * walkers.direction
    direction, power, origin = walkers.direction, incident, position
    if scene.medium is not None:
        direction, _ = phase.sample(scene.medium, walkers.direction, u[1], u[2])
        power = incident * flight.density[:, None] * scene.medium.sigma_s
    if hit is not None:
        position = jnp.where(meets[:, None], hit.position, position)
        surface = materials.surface_at(scene.mesh, face)
        reflected = materials.sample(surface, hit.normal, walkers.direction, u[1], u[2], u[4])
        pdf = materials.sample_pdf(surface, hit.normal, walkers.direction, reflected)
        value = materials.evaluate(surface, hit.normal, walkers.direction, reflected)
        cosine = jnp.abs(sampling.dot(hit.normal, reflected))
        gain = value * (cosine / jnp.maximum(pdf, 1e-18))[:, None]
        direction = jnp.where(meets[:, None], reflected, direction)
        power = jnp.where(meets[:, None], incident * gain, power)
        lifted = ray_casting.offset_origin(position, hit.normal, direction, scale=ray_casting.scene_scale(scene.mesh))
        origin = jnp.where(meets[:, None], lifted, position)
    interacts = walkers.alive & (flight.scatters | meets)
    kept = slopes.ratio(slopes.largest(power), slopes.largest(walkers.power))
    survival = jnp.minimum(kept, 1.0)
    alive = interacts & (u[5] < survival)
    power = jnp.where(alive[:, None], power / jnp.maximum(survival, 1e-30)[:, None], 0.0)
    vertices = Vertices(
        path=walkers.path.astype(jnp.int32),
        depth=walkers.bounce,
        position=position,
        direction=walkers.direction,
        incident=incident,
        face=jnp.where(meets, face, -1),
        density=flight.density,
        outgoing=direction,
        power=power,
        continues=alive,
        valid=interacts,
    )
    return Walkers(walkers.path, walkers.bounce + 1, origin, direction, power, alive), vertices


def step(
    scene: Scene, walkers: Walkers, t_hit: Float[Array, "n"], face: Int[Array, "n"], seed: UInt[Array, ""]
) -> tuple[Walkers, Vertices]:
    """One flight, interaction and scattering; (t_hit, face) is the next surface (inf, -1: none).

    Volume: L_i = L tau / p(t); continued with L = L_i sigma_s, direction from the phase function. Surface: L_i = L tau /
    P(no collision); continued with f_r cos / p. Roulette survives with min(1, max L_new / max L_old).
    """
    u = _uniforms(walkers, seed)
    medium = scene.medium
    ones = jnp.ones_like(walkers.power)
    flight = Flight(t_hit, jnp.zeros_like(walkers.alive), ones, jnp.ones_like(t_hit))
    if medium is not None:
        t0, t1 = media.box_interval(medium.bounds, walkers.origin, walkers.direction)
        t1 = jnp.minimum(t1, t_hit)
        if medium.density is None:
            flight = _flight_homogeneous(medium, walkers, t0, t1, u)
        else:
            flight = _flight_tracked(medium, walkers, t0, t1, seed)
    meets = walkers.alive & ~flight.scatters & (face >= 0)
    hit = None
    if scene.mesh is not None:
        hit = ray_casting.hits(scene.mesh, walkers.origin, walkers.direction, t_hit, face)
    return _interact(scene, walkers, flight, meets, hit, face, u)


_step = jax.jit(step)


@partial(jax.jit, static_argnames="num_steps")
def _walk(scene, walkers, seed, *, num_steps):
    """Several steps without surfaces: nothing to cast between them."""
    nothing = jnp.full(walkers.path.shape, -1, jnp.int32)
    infinite = jnp.full(walkers.path.shape, jnp.inf, jnp.float32)
    return lax.scan(lambda state, _: step(scene, state, infinite, nothing, seed), walkers, None, length=num_steps)


@partial(jax.jit, static_argnames=("num_steps", "max_depth"))
def _track(scene, state, seed, *, num_steps, max_depth):
    """Several tentative collisions of a grid without surfaces: every lane at its own bounce, none waits for another."""
    medium = scene.medium

    def event(state, _):
        walkers, tracking = state
        t0, t1 = media.box_interval(medium.bounds, walkers.origin, walkers.direction)
        tracking = eqx.tree_at(lambda x: x.t, tracking, jnp.maximum(tracking.t, t0))
        tracking, inside, real, weight, rho = _tentative(medium, walkers, tracking, t1, walkers.alive, seed)
        flight = Flight(tracking.t, real, weight, rho)
        u = _uniforms(walkers, seed)
        moved, vertices = _interact(scene, walkers, flight, jnp.zeros_like(real), None, jnp.full(real.shape, -1), u)
        stays = eqx.tree_at(lambda w: w.alive, walkers, inside)
        walkers = jax.tree.map(lambda a, b: _select(real, a, b), moved, stays)
        walkers = eqx.tree_at(lambda w: w.alive, walkers, walkers.alive & (walkers.bounce < max_depth))
        fresh = _tracking(walkers, jnp.zeros_like(tracking.t))
        return (walkers, jax.tree.map(lambda a, b: _select(real, a, b), fresh, tracking)), vertices

    return lax.scan(event, state, None, length=num_steps)


def _select(condition, a, b):
    return jnp.where(condition[:, None] if a.ndim > 1 else condition, a, b)


def trace(
    scene: Scene, caster: ray_casting.Caster, *, seed: int, paths: np.ndarray, max_depth: int
) -> tuple[Vertices, dict[str, int]]:
    """Walk the light paths with the given numbers to their end; vertices as numpy arrays, invalid rows removed.

    Counts: "num_truncated" paths were cut alive after `max_depth` interactions (their rest is lost). Lanes are compacted
    between calls. Raises ValueError when the scene has no light.
    """
    seed = jnp.uint32(seed)
    number = len(paths)
    walkers = emit(scene, jnp.asarray(padded(np.asarray(paths, np.uint32))), seed)
    alive = np.asarray(walkers.alive) & (np.arange(walkers.path.shape[0]) < number)
    walkers = eqx.tree_at(lambda w: w.alive, walkers, jnp.asarray(alive))
    tracked = scene.mesh is None and scene.medium is not None and scene.medium.density is not None
    state = (walkers, _tracking(walkers, jnp.zeros(alive.shape, jnp.float32))) if tracked else (walkers,)
    if scene.mesh is None:
        alive = alive & np.asarray(_meets_medium(scene, walkers))
    found, num_truncated, chunks = [], 0, iter(_CHUNKS)
    while np.any(alive):
        num_steps = next(chunks, _CHUNK)
        state = _compact(state, alive)
        if tracked:
            state, vertices = _track(scene, state, seed, num_steps=num_steps, max_depth=max_depth)
        elif scene.mesh is None:
            walkers, vertices = _walk(scene, state[0], seed, num_steps=num_steps)
            state = (walkers,)
        else:
            t, face = ray_casting.intersect(caster, state[0].origin, state[0].direction, np.inf)
            walkers, vertices = _step(scene, state[0], t, face, seed)
            state = (walkers,)
        found.append(_rows(vertices, np.asarray(vertices.valid) & (np.asarray(vertices.depth) < max_depth)))
        alive = np.asarray(state[0].alive)
        if not tracked:
            cut = alive & (np.asarray(state[0].bounce) >= max_depth)
            num_truncated += int(np.sum(cut))
            alive = alive & ~cut
    vertices = _join(found)
    if tracked:
        num_truncated = int(np.sum(vertices.depth == max_depth - 1))
    return vertices, {"num_truncated": num_truncated}


@jax.jit
def _meets_medium(scene, walkers):
    """Whether the first flight crosses the medium: where nothing else is, the others need no lane."""
    if scene.medium is None:
        return jnp.zeros(walkers.alive.shape, bool)
    t0, t1 = media.box_interval(scene.medium.bounds, walkers.origin, walkers.direction)
    return t1 > t0


def _rows(vertices, chosen):
    return jax.tree.map(lambda x: np.asarray(x)[chosen], vertices)


def padded(values, *, factor=2, least=64):
    """`values` with zeros up to a power of `factor` times `least`: few sizes, few compilations."""
    size = least
    while size < len(values):
        size *= factor
    return np.concatenate([values, np.zeros((size - len(values), *values.shape[1:]), values.dtype)])


def _compact(state, alive):
    """The live lanes, padded with dead ones; `alive` (numpy) may be less than the state's own.

    Every size is a program that takes longer to compile than a whole walk to run: sizes fall to a sixteenth at a time.
    """
    lanes = np.flatnonzero(alive)
    chosen = padded(lanes, factor=16, least=256)
    live = np.arange(len(chosen)) < len(lanes)
    if len(chosen) >= len(alive):
        chosen, live = np.arange(len(alive)), alive
    else:
        state = jax.tree.map(lambda x: np.asarray(x)[chosen], state)
    return (eqx.tree_at(lambda w: w.alive, state[0], live), *state[1:])


def _join(parts):
    if not parts:
        index, vector = np.zeros((0,), np.int32), np.zeros((0, 3), np.float32)
        flag = np.zeros((0,), bool)
        return Vertices(index, index, vector, vector, vector, index, np.zeros((0,), np.float32), vector, vector, flag, flag)
    joined = jax.tree.map(lambda *x: np.concatenate(x), *parts)
    order = np.lexsort((joined.depth, joined.path))
    return jax.tree.map(lambda x: x[order], joined)
