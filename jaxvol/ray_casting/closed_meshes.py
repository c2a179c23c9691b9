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

Casting goes on one hit beyond t_max (to the last hit for several bodies), which tells whether t_max lies inside. Plain
array code: numpy around the Embree caster, JAX (jittable) around the others.
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

_STEP = 2.0**-19  # relative to the coordinates: 16 float32 roundings
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
    on_host = isinstance(origin, np.ndarray)
    xp, search = (np, _search_on_host) if on_host else (jnp, _search)
    capacity = max_hits + 2 if caster.num_bodies == 1 else 2 * max_hits + 2
    t, face, side, unfinished = search(intersect, caster, origin, direction, t_max, capacity)
    keep, inside = (_alternate if caster.num_bodies == 1 else _wind)(xp, side)
    keep &= t < t_max
    row = xp.cumsum(keep, 0) - 1
    out_t, out_face = (pack(xp, keep, row, x, fill, max_hits) for x, fill in ((t, np.inf), (face, -1)))
    return Crossings(out_t.T, out_face.T, inside, xp.sum(unfinished | (row[-1] >= max_hits)))


def pack(xp, keep, row, values, fill, size):
    """Values [m, n] moved to `row` of an array [size, n] where `keep`; the rest is `fill`, rows beyond are dropped."""
    out = xp.full((size + 1, values.shape[1]), fill, values.dtype)
    return _put(xp, out, xp.where(keep, xp.minimum(row, size), size), values)[:size]


def _put(xp, array, row, values):
    """Write values [.., n] into rows of an array [rows, n]; in place in numpy."""
    lane = xp.arange(array.shape[1])
    if xp is jnp:
        return array.at[row, lane].set(values)
    array[row, lane] = values
    return array


def _search_on_host(intersect, caster, origin, direction, t_max, capacity):
    """`_search` in numpy."""
    n = len(origin)
    found, lanes = _nothing_found(np, n, capacity), np.arange(n)
    for aside in _ASIDE:
        first = aside[3] == 0.0
        moved = origin[lanes] + _moved_aside(np, origin[lanes], direction[lanes], found[0][:, lanes], aside)
        new, near_edge = _walk_on_host(intersect, caster, moved, direction[lanes], t_max[lanes], capacity)
        better = ~near_edge | first
        for whole, piece in zip(found, new, strict=True):
            whole[..., lanes[better]] = piece[..., better]
        lanes = lanes[near_edge]
    return found


@functools.partial(jax.jit, static_argnames=("intersect", "capacity"))
def _search(intersect, caster, origin, direction, t_max, capacity):
    """Walks in JAX until rays are clear of edges: (t, face, side [capacity, n], unfinished [n])."""

    def attempt(state, aside):
        found, lanes = state
        moved = origin + _moved_aside(jnp, origin, direction, found[0], aside)
        new, near_edge = _walk(intersect, caster, moved, direction, t_max, lanes, capacity)
        better = lanes & (~near_edge | (aside[3] == 0.0))
        return (tuple(jnp.where(better, b, a) for a, b in zip(found, new, strict=True)), lanes & near_edge), None

    n = len(origin)
    start = _nothing_found(jnp, n, capacity), jnp.ones(n, bool)
    return lax.scan(attempt, start, jnp.asarray(_ASIDE))[0][0]


def _walk_on_host(intersect, caster, origin, direction, t_max, capacity):
    """One walk in numpy, in each round only of the rays that are not done: (found, near_edge)."""
    n = len(origin)
    t, face, side, unfinished = _nothing_found(np, n, capacity)
    count, near_edge = np.zeros(n, np.int32), np.zeros(n, bool)
    last = _nowhere(np, n)
    lanes, rays = np.arange(n), (origin, direction, t_max)
    for _ in range(2 * capacity):
        if len(lanes) == 0:
            break
        start = rays[0] + last[0][:, None] * rays[1]
        hit = intersect(caster, start, rays[1], np.full(len(lanes), np.inf, np.float32))
        last, is_new, is_near, beyond = _judge(np, caster, last, *hit, *rays)
        new = lanes[is_new]
        for whole, piece in zip((t, face, side), last[1:], strict=True):
            whole[count[new], new] = piece[is_new]
        count[new] += 1
        near_edge[lanes[is_near]] = True
        alive = (hit[1] >= 0) & ~beyond & (count[lanes] < capacity)
        lanes, rays, last = lanes[alive], tuple(x[alive] for x in rays), tuple(x[alive] for x in last)
    unfinished[lanes] = True
    return (t, face, side, unfinished | (count >= capacity)), near_edge


def _walk(intersect, caster, origin, direction, t_max, lanes, capacity):
    """One walk in JAX of the rays that `lanes` flags, all until the last one is done: (found, near_edge)."""
    n = len(origin)

    def cast(carry):
        rounds, (t, face, side), count, near_edge, last, alive = carry
        start = origin + last[0][:, None] * direction
        hit = intersect(caster, start, direction, jnp.where(alive, jnp.inf, -1.0))
        last, is_new, is_near, beyond = _judge(jnp, caster, last, *hit, origin, direction, t_max)
        row = jnp.where(is_new, count, capacity)
        lists = tuple(_put(jnp, a, row, b) for a, b in zip((t, face, side), last[1:], strict=True))
        count = count + is_new
        alive = (hit[1] >= 0) & ~beyond & (count < capacity)
        return rounds + 1, lists, count, near_edge | is_near, last, alive

    lists = _nothing_found(jnp, n, capacity + 1)[:3]  # the last row takes what is not recorded
    zeros = jnp.zeros(n, jnp.int32)
    first = (jnp.int32(0), lists, zeros, jnp.zeros(n, bool), _nowhere(jnp, n), lanes)
    more = lax.while_loop(lambda c: jnp.any(c[-1]) & (c[0] < 2 * capacity), cast, first)
    _, (t, face, side), count, near_edge, _, alive = more
    return (t[:capacity], face[:capacity], side[:capacity], alive | (count >= capacity)), near_edge


def _nothing_found(xp, n, capacity):
    """Empty lists: (t, face, side [capacity, n], unfinished [n])."""
    return (
        xp.full((capacity, n), np.inf, np.float32),
        xp.full((capacity, n), -1, np.int32),
        xp.zeros((capacity, n), np.int8),
        xp.zeros(n, bool),
    )


def _nowhere(xp, n):
    """Rays that have met nothing yet: where to cast from, and the last hit's t, face, side."""
    return xp.zeros(n, np.float32), xp.full(n, -np.inf, np.float32), xp.full(n, -1, np.int32), xp.zeros(n, np.int8)


def _judge(xp, caster, last, t_new, face_new, origin, direction, t_max):
    """What a round of hits means: (where rays are now, is it a new crossing, is it near an edge, is it past t_max)."""
    start, last_t, last_face, last_side = last
    hit = face_new >= 0
    t = start + xp.where(hit, t_new, np.float32(0.0))
    index = xp.maximum(face_new, 0)
    side = xp.where(_dot(caster.normals[index], direction) < 0, np.int8(1), np.int8(-1))
    point = origin + t[:, None] * direction
    reach = np.float32(_STEP) * (_largest(xp, point) + _largest(xp, origin))
    step = xp.maximum(reach / xp.sqrt(_dot(direction, direction)), np.float32(_STEP) * t)
    is_near = hit & (_distance_to_edges(xp, caster.triangles[index], point) < np.float32(_NEAR_EDGE) * reach)
    again = (face_new == last_face) | ((side == last_side) & (t < last_t + 4 * step))
    new = tuple(xp.where(hit, b, a) for a, b in zip(last, (t + step, t, face_new, side), strict=True))
    # With several bodies the crossings beyond t_max are needed: they tell the winding number at the origin.
    beyond = (t > t_max) if caster.num_bodies == 1 else xp.zeros(hit.shape, bool)
    return new, hit & ~again, is_near, beyond


def _dot(a, b):
    return a[:, 0] * b[:, 0] + a[:, 1] * b[:, 1] + a[:, 2] * b[:, 2]


def _largest(xp, vector):
    """Largest coordinate in magnitude."""
    x, y, z = (xp.abs(vector[:, i]) for i in range(3))
    return xp.maximum(xp.maximum(x, y), z)


def _distance_to_edges(xp, corners, point):
    """Distance of points [n, 3] in the planes of triangles [n, 3, 3] to the lines through their nearest edges."""
    nearest = np.float32(np.inf)
    for k in range(3):
        edge, spoke = corners[:, (k + 1) % 3] - corners[:, k], point - corners[:, k]
        beside = _cross(xp, edge, spoke)
        squared = _dot(beside, beside) / xp.maximum(_dot(edge, edge), np.float32(1e-37))
        nearest = xp.minimum(nearest, squared)
    return xp.sqrt(nearest)


def _cross(xp, a, b):
    x = a[:, 1] * b[:, 2] - a[:, 2] * b[:, 1]
    y = a[:, 2] * b[:, 0] - a[:, 0] * b[:, 2]
    z = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
    return xp.stack([x, y, z], 1)


def _moved_aside(xp, origin, direction, t, aside):
    """A small shift across the rays, in proportion to the coordinates at their hits `t` [capacity, n]."""
    far = xp.max(xp.where(xp.isfinite(t), t, np.float32(0.0)), 0)[:, None]
    size = _largest(xp, origin + far * direction) + _largest(xp, origin)
    across = _cross(xp, direction, xp.broadcast_to(aside[:3], direction.shape))
    length = xp.maximum(xp.sqrt(_dot(across, across)), np.float32(1e-30))
    return (aside[3] * np.float32(_STEP) * size / length)[:, None] * across


def _alternate(xp, side):
    """One body: keep enters that an exit follows and exits that an enter precedes, or a first exit. (keep, inside)."""
    none = xp.zeros_like(side[:1])
    before, after = xp.concatenate([none, side[:-1]]), xp.concatenate([side[1:], none])
    first = xp.concatenate([side[:1] == -1, xp.zeros(side[1:].shape, bool)])
    keep = ((side == 1) & (after == -1)) | ((side == -1) & (before == 1)) | first
    return keep, side[0] == -1


def _wind(xp, side):
    """Several bodies: keep the crossings where the winding number leaves or reaches 0. (keep, inside)."""
    wide = side.astype(np.int32)
    at_origin = xp.maximum(-xp.sum(wide, 0), 0)
    depth = at_origin + xp.cumsum(wide, 0)
    keep = ((side == 1) & (depth == 1)) | ((side == -1) & (depth == 0))
    return keep, at_origin > 0
