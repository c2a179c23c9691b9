"""Stage 3, random walks: the segments that `marched` integrates, chosen and walked between ray casts on the host."""

from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxvol.methods.impulse_response import light_sources, marched, surface_paths
from jaxvol.methods.impulse_response.kit import Kit, occluded, thickness
from jaxvol.methods.impulse_response.light_sources import Light
from jaxvol.methods.impulse_response.receivers import Receiver, nothing

Draw = Callable[[int], tuple[Array, Array, Array, Array]]
_RANKS = 1024  # lanes that do not close ranks: compiling for fewer would cost more than it saves


def by_marching(kit: Kit, position, normal, light: Light, visible: np.ndarray) -> np.ndarray:
    """Which segments the tables do not fit: all in a bounded medium, occluded ones where asked for, those of much contrast."""
    if kit.march_all:
        return visible | kit.march_occluded
    chosen = np.zeros(visible.shape, bool)
    if kit.march_occluded:
        chosen |= ~visible
    if kit.contrast is not None:
        chosen |= np.asarray(marched.contrast(kit.marching, position, normal, light)) > kit.contrast
    return chosen


def march(kit: Kit, receiver: Receiver, position, kind: str, index, light: Light, chosen: np.ndarray, draw: Draw):
    """(once, more often) of the chosen segments by one random walk of up to `kit.legs` scatter points each, zeros elsewhere.

    `draw(i)` gives the i-th four random numbers of every segment.
    """
    rows, num = np.flatnonzero(chosen), chosen.shape[0]
    if rows.size == 0:
        return nothing(receiver), nothing(receiver)
    lanes = ranks(rows, num)
    part, position, index, seen = take((receiver, position, index, light), lanes, num)
    numbers = take(draw(0), lanes, num)
    place = marched.place(kit.marching, position, part.normal, seen, numbers, num_steps=kit.num_steps)
    once, more = _walk(kit, part.normal, position, kind, index, seen, place, rows, num, draw)
    found = _to_receiver(part, place.direction, once, more)
    return tuple(_scatter(value, rows, num) for value in found)


def _walk(kit: Kit, normal, position, kind, index, seen, place, rows, num, draw):
    """Radiance (once, more often) that arrives along each first leg; a walk that lost at Russian roulette frees its lane."""
    medium = kit.marching.regions[0]
    lifted = surface_paths.lifted(position, normal, kit.faces.scale)
    reached = jnp.asarray(~occluded(kit, lifted, place.direction, place.distance))
    weight = first = marched.throughput(medium, place, reached)
    points, outward = position + place.distance[:, None] * place.direction, place.direction
    once, more = (np.zeros(weight.shape, np.float32) for _ in range(2))
    walks = np.arange(rows.size)  # those in the leading lanes
    for leg in range(1, kit.legs + 1):
        again = light_sources.see_again(kit.scene, position, kind, index, seen, points)
        lit = jnp.asarray(~occluded(kit, *light_sources.shadow_ray(kit.faces.scale, points, None, again)))
        far = thickness(kit, points, again.direction, again.distance)
        radiance = weight * marched.scattered_once(medium, outward, again, lit, far)
        (once if leg == 1 else more)[walks] += np.asarray(radiance)[: walks.size]
        if not kit.multiple:
            break
        if leg == kit.legs:
            around = marched.surroundings(medium, place, normal, points - position)
            arguments = (medium, kit.responses, outward, again, lit, far, normal, *around)
            brought = weight * marched.scattered_more(*arguments, image=kit.image)
            more[walks] += np.asarray(brought)[: walks.size]
            break
        lanes = ranks(rows[walks], num)
        numbers, chance = take((draw(leg), draw(kit.legs + leg)[0]), lanes, num)
        outward, distance, factor = marched.onward(kit.marching, points, outward, again, numbers, num_steps=kit.num_steps)
        free = jnp.asarray(~occluded(kit, points, outward, distance))
        # Roulette before the leg: near a lamp its factor is small, and the next connection's 1/r^2 makes up for it.
        weight = marched.survive(weight, first, free, chance) * factor
        points = points + distance[:, None] * outward
        alive = np.flatnonzero(np.any(np.asarray(weight)[: walks.size] > 0, axis=-1))
        if alive.size == 0:
            break
        walks = walks[alive]
        state = (normal, position, index, seen, place, points, outward, weight, first)
        state = take(state, ranks(alive, num), weight.shape[0])
        normal, position, index, seen, place, points, outward, weight, first = state
    return jnp.asarray(once), jnp.asarray(more)


def ranks(rows, num):
    """Rows filled up to a number of lanes of which there are three, so that few programs are compiled."""
    lanes = next(lanes for lanes in (num // 16, num // 4, num) if rows.size <= lanes and (lanes >= _RANKS or lanes == num))
    return np.concatenate([rows, np.full(lanes - rows.size, rows[0])]).astype(np.int32)


@partial(jax.jit, static_argnames="num")
def take(tree, rows, num):
    """Rows of every array of `num` rows."""
    return jax.tree.map(lambda x: x[rows] if jnp.shape(x)[:1] == (num,) else x, tree)


@jax.jit
def _to_receiver(receiver, direction, once, more):
    return receiver.straight(direction, once), receiver.straight(direction, more)


def _scatter(value, rows, num):
    whole = np.zeros((num, *value.shape[1:]), np.float32)
    whole[rows] = np.asarray(value)[: rows.size]
    return jnp.asarray(whole)
