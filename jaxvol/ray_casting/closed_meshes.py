"""All crossings of rays with a closed mesh, repaired so that a ray enters and leaves in turn.

A ray is cast on from each hit, moved past it by a few roundings (there is no t_near). Near edges such a walk can meet
two neighbours for one crossing, or one side of a silhouette and not the other. Three things keep the result sound:

- a ray that meets a face within a few roundings of an edge is moved aside (by 2^-15 of the coordinates) and walks
  again, twice at most; the first walk clear of edges counts;
- the same face again, or the same side again within a few steps, is the same crossing;
- from the side of each face that was met (front = enter, back = exit; inside-out meshes are turned by their volume):
  for one connected body, only an exit met right after an enter ends an interval, so of two enters in a row the later
  counts and of two exits the earlier, and a first exit without an enter means that the ray starts inside. For several
  bodies the winding number counts, so that they may overlap, and it is the union that is crossed. (Bodies that touch
  in whole faces must be merged: no caster tells coincident faces apart.)

Casting goes on one hit beyond t_max (to the last hit for several bodies), which tells whether t_max lies inside. With
JAX casters all of it runs under jit; around Embree only the rounds of casting run on the host, on padded batches.
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

_STEP = 2.0**-19  # relative to the coordinates: 16 float32 roundings
_LEAST_BATCH = 1024  # rays on the host
_NEAR_EDGE = 2.0  # steps: nearer to an edge than this, a hit may be one of two
# Odd directions, and the steps by which rays are moved across them in the first, second and third walk.
_ASIDE = np.array([[0.0, 0.6, 0.8, 0.0], [0.36, 0.48, 0.8, 16.0], [-0.8, 0.36, 0.48, 23.0]], np.float32)


class Crossings(NamedTuple):
    """Where rays enter and leave a solid, in turn; numpy or JAX arrays."""

    t: np.ndarray  # [n, K] increasing, inf where there are no more
    face: np.ndarray  # [n, K], -1 where there are no more
    inside: np.ndarray  # [n] whether the origin is inside: the first crossing is then an exit
    num_overflows: np.ndarray  # scalar: rays with more than K crossings, the rest of which are missing


def crossings(intersect, caster, origin, direction, t_max, *, max_hits: int) -> Crossings:
    """Crossings of rays ([n, 3], [n, 3], [n]; any direction length) with the closed mesh of `caster`, up to t_max.

    `intersect(caster, origin, direction, t_max)` casts rays. Exact for solids whose walls are thicker than a few
    roundings of the coordinates; rays that graze an edge may miss it.
    """
    capacity = max_hits + 2 if caster.num_bodies == 1 else 2 * max_hits + 2
    if not isinstance(origin, np.ndarray):
        found = _search(intersect, caster, origin, direction, t_max, capacity)
        return _in_turn(found, t_max, caster.num_bodies, max_hits)
    n = len(origin)
    rays = padded(origin, direction, t_max)
    found = _search_on_host(intersect, caster, *rays, n, capacity)
    result = _in_turn(found, rays[2], caster.num_bodies, max_hits)
    rows = (np.asarray(x)[:n] for x in result[:3])
    return Crossings(*rows, np.asarray(result.num_overflows))


@functools.partial(jax.jit, static_argnames=("num_bodies", "max_hits"))
def _in_turn(found, t_max, num_bodies, max_hits):
    """Crossings from the lists that a search found."""
    t, face, side, unfinished = found
    keep, inside = (_alternate if num_bodies == 1 else _wind)(side)
    keep &= t < t_max
    row = jnp.cumsum(keep, 0) - 1
    out_t, out_face = (pack(keep, row, x, fill, max_hits) for x, fill in ((t, np.inf), (face, -1)))
    return Crossings(out_t.T, out_face.T, inside, jnp.sum(unfinished | (row[-1] >= max_hits)))


def padded(*arrays: np.ndarray) -> tuple[np.ndarray, ...]:
    """Arrays [n, ..] with zeros up to the next of few sizes, so that few programs are compiled."""
    n = len(arrays[0])
    size = _LEAST_BATCH
    while size < n:
        size *= 4
    return tuple(x if len(x) == size else np.concatenate([x, np.zeros((size - n, *x.shape[1:]), x.dtype)]) for x in arrays)


def pack(keep, row, values, fill, size):
    """Values [m, n] moved to `row` of an array [size, n] where `keep`; the rest is `fill`, rows beyond are dropped."""
    out = jnp.full((size, values.shape[1]), fill, values.dtype)
    for k in range(len(values)):  # a few rows: comparing them all is cheaper than a scatter
        at = keep[k] & (jnp.arange(size)[:, None] == row[k])
        out = jnp.where(at, values[k], out)
    return out


def _put(array, row, values):
    """Write values [n] into rows of an array [rows, n]."""
    return jnp.where(jnp.arange(len(array))[:, None] == row, values, array)


def _search_on_host(intersect, caster, origin, direction, t_max, num, capacity):
    """`_search` of the first `num` rays with a caster that runs on the host."""
    found, near_edge = _walk_on_host(intersect, caster, origin, direction, t_max, num, capacity)
    lanes = np.flatnonzero(np.asarray(near_edge))
    if not len(lanes):
        return found
    found = [np.array(x) for x in found]
    for aside in _ASIDE[1:]:
        some = padded(origin[lanes], direction[lanes], t_max[lanes], found[0][:, lanes].T)
        moved = np.asarray(_move_aside(some[0], some[1], some[3].T, aside))
        new, near_edge = _walk_on_host(intersect, caster, moved, some[1], some[2], len(lanes), capacity)
        near_edge = np.asarray(near_edge)[: len(lanes)]
        for whole, piece in zip(found, new, strict=True):
            whole[..., lanes[~near_edge]] = np.asarray(piece)[..., : len(lanes)][..., ~near_edge]
        lanes = lanes[near_edge]
        if not len(lanes):
            break
    return found


@functools.partial(jax.jit, static_argnames=("intersect", "capacity"))
def _search(intersect, caster, origin, direction, t_max, capacity):
    """Walks in JAX until rays are clear of edges: (t, face, side [capacity, n], unfinished [n])."""

    def attempt(state, aside):
        found, lanes = state
        moved = _move_aside(origin, direction, found[0], aside)
        new, near_edge = _walk(intersect, caster, moved, direction, t_max, lanes, capacity)
        better = lanes & (~near_edge | (aside[3] == 0.0))
        return (tuple(jnp.where(better, b, a) for a, b in zip(found, new, strict=True)), lanes & near_edge), None

    n = len(origin)
    start = _nothing_found(n, capacity), jnp.ones(n, bool)
    return lax.scan(attempt, start, jnp.asarray(_ASIDE))[0][0]


class _Walk(NamedTuple):
    """Where a walk is: the lists [capacity + 1, n] (the last row takes what is not recorded) and each ray's state."""

    lists: tuple
    count: jax.Array
    near_edge: jax.Array
    last: tuple
    alive: jax.Array


def _set_out(lanes, capacity):
    n = len(lanes)
    return _Walk(
        _nothing_found(n, capacity + 1)[:3], jnp.zeros(n, jnp.int32), jnp.zeros(n, bool), _nowhere(n), jnp.asarray(lanes)
    )


def _take_hits(walk, hit, body, origin, direction, t_max, capacity):
    """The walk after one round of hits (t, face)."""
    last, is_new, is_near, beyond = _judge(body, walk.last, *hit, origin, direction, t_max)
    is_new, is_near = is_new & walk.alive, is_near & walk.alive
    row = jnp.where(is_new, walk.count, capacity)
    lists = tuple(_put(a, row, b) for a, b in zip(walk.lists, last[1:], strict=True))
    count = walk.count + is_new
    alive = walk.alive & (hit[1] >= 0) & ~beyond & (count < capacity)
    return _Walk(lists, count, walk.near_edge | is_near, last, alive)


def _arrive(walk, capacity):
    """The found lists and flags, and which rays were near an edge."""
    t, face, side = (x[:capacity] for x in walk.lists)
    return (t, face, side, walk.alive | (walk.count >= capacity)), walk.near_edge


class Body(NamedTuple):
    """What judging hits needs of a caster."""

    normals: jax.Array
    triangles: jax.Array
    num_bodies: jax.Array


_jit_set_out = jax.jit(_set_out, static_argnames=("capacity",))
_jit_round = jax.jit(_take_hits, static_argnames=("capacity",))


def _walk_on_host(intersect, caster, origin, direction, t_max, num, capacity):
    """One walk of the first `num` rays, cast on the host, each round only those that are not done."""
    walk = _jit_set_out(np.arange(len(origin)) < num, capacity=capacity)
    cast = functools.partial(intersect, caster)
    return _arrive(_walk_on(cast, caster.body, walk, (origin, direction, t_max), capacity), capacity)


def _walk_on(cast, body, walk, rays, capacity):
    """The rest of a walk; when few rays are left, on a batch of these alone."""
    origin, direction, _ = rays
    n = len(origin)
    for _ in range(2 * capacity):
        lanes = np.flatnonzero(np.asarray(walk.alive))
        if not len(lanes):
            break
        if n > _LEAST_BATCH and 4 * len(lanes) <= n:
            part = _walk_on(cast, body, _take_lanes(walk, lanes), padded(*(x[lanes] for x in rays)), capacity)
            return _put_lanes(walk, lanes, part)
        t, face = np.full(n, np.inf, np.float32), np.full(n, -1, np.int32)
        along = direction[lanes]
        start = origin[lanes] + np.asarray(walk.last[0])[lanes, None] * along
        t[lanes], face[lanes] = cast(start, along, np.full(len(lanes), np.inf, np.float32))
        walk = _jit_round(walk, (t, face), body, *rays, capacity=capacity)
    return walk


def _take_lanes(walk, lanes):
    return jax.tree.map(lambda x: padded(np.asarray(x)[..., lanes].T)[0].T, walk)


def _put_lanes(walk, lanes, part):
    def put(whole, piece):
        whole = np.array(whole)
        whole[..., lanes] = np.asarray(piece)[..., : len(lanes)]
        return whole

    return jax.tree.map(put, walk, part)


def _walk(intersect, caster, origin, direction, t_max, lanes, capacity):
    """One walk in JAX of the rays that `lanes` flags, all until the last one is done: (found, near_edge)."""

    def cast(carry):
        rounds, walk = carry
        start = origin + walk.last[0][:, None] * direction
        hit = intersect(caster, start, direction, jnp.where(walk.alive, jnp.inf, -1.0))
        return rounds + 1, _take_hits(walk, hit, caster, origin, direction, t_max, capacity)

    first = jnp.int32(0), _set_out(lanes, capacity)
    return _arrive(lax.while_loop(lambda c: jnp.any(c[1].alive) & (c[0] < 2 * capacity), cast, first)[1], capacity)


def _nothing_found(n, capacity):
    """Empty lists: (t, face, side [capacity, n], unfinished [n])."""
    return (
        jnp.full((capacity, n), np.inf, np.float32),
        jnp.full((capacity, n), -1, np.int32),
        jnp.zeros((capacity, n), np.int8),
        jnp.zeros(n, bool),
    )


def _nowhere(n):
    """Rays that have met nothing yet: where to cast from, and the last hit's t, face, side."""
    return jnp.zeros(n, np.float32), jnp.full(n, -np.inf, np.float32), jnp.full(n, -1, np.int32), jnp.zeros(n, np.int8)


def _judge(body, last, t_new, face_new, origin, direction, t_max):
    """What a round of hits means: (where rays are now, is it a new crossing, is it near an edge, is it past t_max)."""
    start, last_t, last_face, last_side = last
    hit = face_new >= 0
    t = start + jnp.where(hit, t_new, np.float32(0.0))
    index = jnp.maximum(face_new, 0)
    side = jnp.where(_dot(body.normals[index], direction) < 0, np.int8(1), np.int8(-1))
    point = origin + t[:, None] * direction
    reach = np.float32(_STEP) * (_largest(point) + _largest(origin))
    step = jnp.maximum(reach / jnp.sqrt(_dot(direction, direction)), np.float32(_STEP) * t)
    is_near = hit & (_distance_to_edges(body.triangles[index], point) < np.float32(_NEAR_EDGE) * reach)
    again = (face_new == last_face) | ((side == last_side) & (t < last_t + 4 * step))
    new = tuple(jnp.where(hit, b, a) for a, b in zip(last, (t + step, t, face_new, side), strict=True))
    # With several bodies the crossings beyond t_max are needed: they tell the winding number at the origin.
    beyond = (t > t_max) & (body.num_bodies == 1)
    return new, hit & ~again, is_near, beyond


def _dot(a, b):
    return a[:, 0] * b[:, 0] + a[:, 1] * b[:, 1] + a[:, 2] * b[:, 2]


def _largest(vector):
    """Largest coordinate in magnitude."""
    x, y, z = (jnp.abs(vector[:, i]) for i in range(3))
    return jnp.maximum(jnp.maximum(x, y), z)


def _distance_to_edges(corners, point):
    """Distance of points [n, 3] in the planes of triangles [n, 3, 3] to the lines through their nearest edges."""
    nearest = np.float32(np.inf)
    for k in range(3):
        edge, spoke = corners[:, (k + 1) % 3] - corners[:, k], point - corners[:, k]
        beside = _cross(edge, spoke)
        squared = _dot(beside, beside) / jnp.maximum(_dot(edge, edge), np.float32(1e-37))
        nearest = jnp.minimum(nearest, squared)
    return jnp.sqrt(nearest)


def _cross(a, b):
    x = a[:, 1] * b[:, 2] - a[:, 2] * b[:, 1]
    y = a[:, 2] * b[:, 0] - a[:, 0] * b[:, 2]
    z = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
    return jnp.stack([x, y, z], 1)


@jax.jit
def _move_aside(origin, direction, t, aside):
    """Origins shifted a little across their rays, in proportion to the coordinates at their hits `t` [capacity, n]."""
    far = jnp.max(jnp.where(jnp.isfinite(t), t, jnp.float32(0.0)), 0)[:, None]
    size = _largest(origin + far * direction) + _largest(origin)
    across = _cross(direction, jnp.broadcast_to(aside[:3], direction.shape))
    length = jnp.maximum(jnp.sqrt(_dot(across, across)), jnp.float32(1e-30))
    return origin + (aside[3] * jnp.float32(_STEP) * size / length)[:, None] * across


def _alternate(side):
    """One body: keep enters that an exit follows and exits that an enter precedes, or a first exit. (keep, inside)."""
    none = jnp.zeros_like(side[:1])
    before, after = jnp.concatenate([none, side[:-1]]), jnp.concatenate([side[1:], none])
    first = jnp.concatenate([side[:1] == -1, jnp.zeros(side[1:].shape, bool)])
    keep = ((side == 1) & (after == -1)) | ((side == -1) & (before == 1)) | first
    return keep, side[0] == -1


def _wind(side):
    """Several bodies: keep the crossings where the winding number leaves or reaches 0. (keep, inside)."""
    wide = side.astype(np.int32)
    at_origin = jnp.maximum(-jnp.sum(wide, 0), 0)
    depth = at_origin + jnp.cumsum(wide, 0)
    keep = ((side == 1) & (depth == 1)) | ((side == -1) & (depth == 0))
    return keep, at_origin > 0
