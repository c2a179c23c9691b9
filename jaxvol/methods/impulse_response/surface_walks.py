"""Stage 3, light of surfaces that scatters in a bounded medium: walks from the receiver that end at cached surfaces.

    once    = int f(w) sigma_s e^-tau(x,z) int p(w, w') e^-tau(z,y) L(y) dw' dz,      y the surface that z sees along w'

and so on for more scatter points. Drawn from the receiver (free flight, phase function), no weight has a singularity; drawn
from the emitting point, as `walks` must for lamps, they do. What the surfaces send on, L, is cached (`radiosity`).
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxvol import ray_casting
from jaxvol.methods.impulse_response import cache, marched, surface_paths
from jaxvol.methods.impulse_response.kit import Kit, occluded, thickness
from jaxvol.methods.impulse_response.light_sources import Light
from jaxvol.methods.impulse_response.walks import Draw, ranks, take

_GAIN = 0.75  # of the chance to go on, over what is left of the throughput: fewer lanes for little noise
_ONWARD = 56  # scatter points after those of lamps' walks; roulette ends nearly all before


class Walks(NamedTuple):
    """Walks of n receivers: their first direction, and what each leg brings of the irradiance of one cached point."""

    direction: Float[Array, "n 3"]
    weights: list[Float[np.ndarray, "n 3"]]
    indices: list[Int[np.ndarray, "n"]]


def walk(kit: Kit, position, normal, draw: Draw) -> Walks:
    """One walk from each receiver through a medium bounded by its box; `draw(i)` gives the i-th four random numbers."""
    num, medium = position.shape[0], kit.marching.regions[0]
    nowhere = jnp.zeros((1, 3), jnp.float32)
    free = Light(nowhere, jnp.full(1, jnp.inf, jnp.float32), nowhere, infinite=True)  # no emitter to aim at
    place = marched.place(kit.marching, position, normal, free, draw(0), num_steps=kit.num_steps)
    lifted = surface_paths.lifted(position, normal, kit.faces.scale)
    reached = ~occluded(kit, lifted, place.direction, place.distance)
    weight = first = marched.throughput(medium, place, jnp.asarray(reached))
    state = (position + place.distance[:, None] * place.direction, place.direction, weight, first)
    alive = among = np.flatnonzero(reached)  # receivers whose walks go on, and their lanes
    weights, indices = [], []
    most = kit.legs + _ONWARD
    for leg in range(1, most + 1):
        if alive.size == 0:
            break
        points, outward, weight, first = take(state, ranks(among, num), state[0].shape[0])
        numbers, chance = take((draw(leg), draw(most + leg)[0]), ranks(alive, num), num)
        outward, distance, factor = marched.onward(kit.marching, points, outward, free, numbers, num_steps=kit.num_steps)
        t, face = (jnp.asarray(found) for found in ray_casting.intersect(kit.caster, points, outward, np.inf))
        tau = thickness(kit, points, outward, t)
        seen, where, facing, onward = _leg(
            kit.scene.mesh, points, outward, t, face, tau, weight, distance, factor, first, chance
        )
        whole, index = np.zeros((num, 3), np.float32), np.zeros(num, np.int64)
        whole[alive] = np.asarray(seen)[: alive.size]
        index[alive] = cache.nearest(kit.cache, np.asarray(where)[: alive.size], np.asarray(facing)[: alive.size])
        weights.append(whole)
        indices.append(index)
        state = (points + distance[:, None] * outward, outward, onward, first)
        among = np.flatnonzero(np.any(np.asarray(onward)[: alive.size] > 0, axis=-1))
        alive = alive[among]
    return Walks(place.direction, weights, indices)


@jax.jit
def _leg(mesh, points, outward, t, face, tau, weight, distance, factor, first, chance):
    """What a leg brings of the irradiance it meets, where that is, and the weights of the walks that go on."""
    hits = ray_casting.hits(mesh, points, outward, t, face)
    side = jnp.where(jnp.sum(hits.normal * outward, axis=-1) > 0, -1.0, 1.0)[:, None]
    reflected = surface_paths.surface_reflectance(mesh, jnp.maximum(face, 0)) / jnp.pi
    seen = jnp.where(hits.valid[:, None], weight * jnp.exp(-tau) * reflected, 0.0)
    return seen, hits.position, hits.normal * side, marched.survive(weight * factor, first, distance < t, chance, gain=_GAIN)
