"""Stage 3, radiosity: the cached irradiance solved over its own points, every surface's light carried by random steps.

    E(y) = own light(y) + mean over steps of weight E(next vertex),     weight = albedo / pi K / pdf

The steps are drawn once and used for all bounces (Jacobi's iteration from no bounce on), so a bounce costs a product.
"""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
from scipy import sparse

from jaxvol.methods.impulse_response import cache, estimate, final_gather, steps
from jaxvol.methods.impulse_response.kit import Kit, Tally
from jaxvol.methods.impulse_response.planning import Plan
from jaxvol.methods.impulse_response.receivers import Irradiance

NUM_POINTS = 2048  # at most
_SAMPLES = 16  # of own light and of steps, at each point
_FEWEST = 64  # points below which walking on is as good
_WORTH = 1  # paths of the bake for each sample in the cache, below which it costs more than it saves


def cached(kit: Kit, points: np.ndarray, normals: np.ndarray, plan: Plan, *, num_paths: int, seed: int) -> Kit:
    """The kit with irradiance cached for `num_paths` paths from these receivers [N, 3], where the plan asks for it.

    Biased by the piecewise constant irradiance of vertices (not of receivers); deterministic for a seed.
    """
    worth = num_paths >= _WORTH * NUM_POINTS * _SAMPLES and len(points) > 0
    if not (plan.cached and worth and kit.max_bounces > 1):
        return kit
    seed = (seed + 0x9E3779B9) % (1 << 32)
    position, normal = _places(kit, np.asarray(points), np.asarray(normals), seed)
    if len(position) < _FEWEST:
        return kit
    kit = replace(kit, cache=cache.unlit(position, normal, None if kit.open else kit.caster))
    if kit.walks_surfaces:
        kit = replace(kit, shares=(1.0, 0.0, 0.0))  # rays serve unscattered light; walks bring the rest
    bare = replace(plan, harmonics=False)
    own = estimate.bake(replace(kit, max_bounces=0), position, normal, bare, samples=_SAMPLES, seed=seed).mean
    straight = _with_darkness(own.surface_from_light)
    total = straight + _with_darkness(own.surface_from_volume) + _with_darkness(own.surface_from_multiple)
    light, carry = total, _transport(kit, position, normal, plan.num_lanes, seed)
    for _ in range(kit.max_bounces - 1):
        light = total + np.stack([carry[c] @ light[:, c] for c in range(3)], axis=1)
    return replace(
        kit, cache=replace(kit.cache, straight=jnp.asarray(straight), rest=jnp.asarray(light - straight, jnp.float32))
    )


def _with_darkness(value):
    return np.pad(np.asarray(value), ((0, 1), (0, 0)))


def _places(kit: Kit, points, normals, seed):
    """First and second vertices of paths from some of the receivers, on the side that the paths see."""
    rows = np.linspace(0, len(points) - 1, NUM_POINTS // 2).astype(int)
    position, normal = jnp.asarray(points[rows]), jnp.asarray(normals[rows])
    found, alive = [], np.ones(rows.size, bool)
    item = jnp.arange(rows.size, dtype=jnp.int32)
    rays = replace(kit, shares=(1.0, 0.0, 0.0))
    for depth in (2, 3):  # not 1: no segment needs to be marched for this
        arguments = (item, jnp.zeros_like(item), jnp.uint32(seed), depth, Tally())
        plain, scattered, position, normal = steps.step(rays, Irradiance(normal), position, *arguments)
        alive &= np.any(np.asarray(plain + scattered) != 0, axis=-1)
        found.append((np.asarray(position)[alive], np.asarray(normal)[alive]))
    return tuple(np.concatenate(part) for part in zip(*found, strict=True))


def _transport(kit: Kit, position, normal, num_lanes, seed) -> list[sparse.csr_array]:
    """Mean weights [M+1, M+1] of steps from points to the points nearest to where they end, for each channel."""
    num = len(position)
    lanes = estimate.lanes_for(num * _SAMPLES, num_lanes)
    rows, columns, weights = [], [], []
    for first in range(0, num * _SAMPLES, lanes):
        kept = min(lanes, num * _SAMPLES - first)
        item, sample = (first + np.arange(lanes)) % num, (first + np.arange(lanes)) // num
        where, facing = jnp.asarray(position[item]), jnp.asarray(normal[item])
        numbers = (jnp.asarray(item, jnp.int32), jnp.asarray(sample, jnp.int32), jnp.uint32(seed))
        for weight, index in final_gather.ways(kit, facing, where, *numbers):
            lit = np.flatnonzero(np.any(weight[:kept] != 0, axis=-1))
            rows.append(item[lit])
            columns.append(index[lit])
            weights.append(weight[lit] / _SAMPLES)
    place = (np.concatenate(rows), np.concatenate(columns))
    weight = np.concatenate(weights)
    return [sparse.coo_array((weight[:, c], place), shape=(num + 1, num + 1)).tocsr() for c in range(3)]
