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
_ASIDE = (((0.36, 0.48, 0.8), 16.0), ((-0.8, 0.36, 0.48), 23.0))  # odd directions and steps by which rays are moved


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
    xp, walk = (np, _walk_on_host) if on_host else (jnp, _walk)
    capacity = max_hits + 2 if caster.num_bodies == 1 else 2 * max_hits + 2
    lanes = xp.ones(len(origin), bool)
    found, near_edge = walk(intersect, caster, origin, direction, t_max, lanes, capacity)
    for aside in _ASIDE:
        moved = origin + _moved_aside(xp, origin, direction, found[0], aside)
        again, still_near = walk(intersect, caster, moved, direction, t_max, near_edge, capacity)
        better = near_edge & ~still_near
        found = tuple(xp.where(_rows(better, old), new, old) for old, new in zip(found, again, strict=True))
        near_edge = near_edge & still_near
    t, face, side, unfinished = found
    keep, inside = (_alternate if caster.num_bodies == 1 else _wind)(xp, side)
    keep &= t < t_max[:, None]
    order = xp.cumsum(keep, 1) - 1
    out_t, out_face = [], []
    for k in range(max_hits):
        here = keep & (order == k)
        out_t.append(xp.min(xp.where(here, t, np.inf), 1))
        out_face.append(xp.max(xp.where(here, face, -1), 1))
    overflow = unfinished | (order[:, -1] >= max_hits)
    return Crossings(xp.stack(out_t, 1), xp.stack(out_face, 1), inside, xp.sum(overflow))


def _record(xp, caster, state, t_new, face_new, origin, direction, t_max):
    """Take in one round of hits: append new crossings, move on, drop rays that are done."""
    start, count, t, face, side, last_t, last_side, near_edge = state
    hit = face_new >= 0
    t_hit = start + xp.where(hit, t_new, 0.0)
    facing = xp.sum(caster.normals[xp.maximum(face_new, 0)] * direction, 1)
    side_new = xp.where(facing < 0, 1, -1).astype(xp.int8)
    capacity = t.shape[1]
    point = origin + t_hit[:, None] * direction
    reach = _STEP * (xp.max(xp.abs(point), 1) + xp.max(xp.abs(origin), 1))
    step = xp.maximum(reach / xp.sqrt(xp.sum(direction * direction, 1)), _STEP * t_hit)
    corners = caster.triangles[xp.maximum(face_new, 0)]
    near_edge = near_edge | (hit & (_distance_to_edges(xp, corners, point) < _NEAR_EDGE * reach))
    last_face = xp.max(xp.where(xp.arange(capacity) == count[:, None] - 1, face, -1), 1)
    again = (face_new == last_face) | ((side_new == last_side) & (t_hit < last_t + 4 * step))
    slot = (xp.arange(capacity) == count[:, None]) & (hit & ~again)[:, None]
    t = xp.where(slot, t_hit[:, None], t)
    face = xp.where(slot, face_new[:, None], face)
    side = xp.where(slot, side_new[:, None], side)
    count = count + (hit & ~again)
    last_t, last_side = xp.where(hit, t_hit, last_t), xp.where(hit, side_new, last_side)
    beyond = (t_hit > t_max) if caster.num_bodies == 1 else xp.zeros(hit.shape, bool)
    alive = hit & ~beyond & (count < capacity)
    start = xp.where(hit, t_hit + step, start)
    return (start, count, t, face, side, last_t, last_side, near_edge), alive


def _start(xp, n, capacity):
    return (
        xp.zeros(n, np.float32),
        xp.zeros(n, np.int32),
        xp.full((n, capacity), np.inf, np.float32),
        xp.full((n, capacity), -1, np.int32),
        xp.zeros((n, capacity), np.int8),
        xp.full(n, -np.inf, np.float32),
        xp.zeros(n, np.int8),
        xp.zeros(n, bool),
    )


def _finish(xp, state, alive):
    """What the walk found, and which rays met edges; unfinished rays: the list is full or the rounds ran out."""
    _, count, t, face, side, _, _, near_edge = state
    return (t, face, side, alive | (count >= t.shape[1])), near_edge


@functools.partial(jax.jit, static_argnames=("intersect", "capacity"))
def _walk(intersect, caster, origin, direction, t_max, lanes, capacity):
    """The walk in JAX: the rays named in `lanes`, all until the last one is done."""

    def cast(carry):
        rounds, state, alive = carry
        start = origin + state[0][:, None] * direction
        t_new, face_new = intersect(caster, start, direction, jnp.where(alive, jnp.inf, -1.0))
        state, alive = _record(jnp, caster, state, t_new, face_new, origin, direction, t_max)
        return rounds + 1, state, alive

    first = (jnp.int32(0), _start(jnp, len(origin), capacity), lanes)
    _, state, alive = lax.while_loop(lambda c: jnp.any(c[2]) & (c[0] < 2 * capacity), cast, first)
    return _finish(jnp, state, alive)


def _walk_on_host(intersect, caster, origin, direction, t_max, lanes, capacity):
    """The walk in numpy: in each round only the rays that are not done."""
    state = _start(np, len(origin), capacity)
    unfinished = np.zeros(len(origin), bool)
    lanes = np.nonzero(lanes)[0]
    for _ in range(2 * capacity):
        if len(lanes) == 0:
            break
        part = tuple(x[lanes] for x in state)
        o, d = origin[lanes], direction[lanes]
        start = (o + part[0][:, None] * d).astype(np.float32)
        t_new, face_new = intersect(caster, start, d, np.full(len(lanes), np.inf, np.float32))
        part, alive = _record(np, caster, part, t_new, face_new, o, d, t_max[lanes])
        for whole, piece in zip(state, part, strict=True):
            whole[lanes] = piece
        lanes = lanes[alive]
    unfinished[lanes] = True
    return _finish(np, state, unfinished)


def _distance_to_edges(xp, corners, point):
    """Distance of points [n, 3] in the planes of triangles [n, 3, 3] to the lines through their nearest edges."""
    nearest = np.inf
    for k in range(3):
        edge = corners[:, (k + 1) % 3] - corners[:, k]
        beside = xp.cross(edge, point - corners[:, k])
        squared = xp.sum(beside * beside, 1) / xp.maximum(xp.sum(edge * edge, 1), np.float32(1e-37))
        nearest = xp.minimum(nearest, squared)
    return xp.sqrt(nearest)


def _moved_aside(xp, origin, direction, t, aside):
    """A small shift across the rays, in proportion to the coordinates at their hits `t` [n, capacity]."""
    (x, y, z), steps = aside
    far = xp.max(xp.where(xp.isfinite(t), t, 0.0), 1)[:, None]
    size = xp.max(xp.abs(origin + far * direction), 1) + xp.max(xp.abs(origin), 1)
    across = xp.cross(direction, xp.asarray([x, y, z], np.float32))
    across = across / xp.maximum(xp.sqrt(xp.sum(across * across, 1, keepdims=True)), np.float32(1e-30))
    return (steps * _STEP * size)[:, None].astype(np.float32) * across


def _rows(flags, like):
    """Flags per ray in the shape of `like`, which may have a second axis."""
    return flags if like.ndim == 1 else flags[:, None]


def _alternate(xp, side):
    """One body: keep enters that an exit follows and exits that an enter precedes, or a first exit. (keep, inside)."""
    before = xp.concatenate([xp.zeros_like(side[:, :1]), side[:, :-1]], 1)
    after = xp.concatenate([side[:, 1:], xp.zeros_like(side[:, :1])], 1)
    first = (side == -1) & (before == 0) & (xp.arange(side.shape[1]) == 0)
    keep = ((side == 1) & (after == -1)) | ((side == -1) & (before == 1)) | first
    return keep, side[:, 0] == -1


def _wind(xp, side):
    """Several bodies: keep the crossings where the winding number leaves or reaches 0. (keep, inside)."""
    wide = side.astype(np.int32)
    at_origin = xp.maximum(-xp.sum(wide, 1), 0)
    depth = at_origin[:, None] + xp.cumsum(wide, 1)
    keep = ((wide == 1) & (depth == 1)) | ((wide == -1) & (depth == 0))
    return keep, at_origin > 0
