"""Stage 3, light of surfaces at receivers where irradiance is cached: a step, or a walk through the medium, and a lookup."""

from collections.abc import Iterator
from functools import partial

import jax
import numpy as np
from jaxtyping import Array, Float, Int

from jaxvol.methods.impulse_response import cache, steps, surface_walks
from jaxvol.methods.impulse_response.kit import Kit, Tally
from jaxvol.methods.impulse_response.receivers import Irradiance, Receiver, like


def bounced(kit: Kit, receiver: Receiver, position, item, sample, seed, tally: Tally) -> tuple[Array, Array]:
    """Light of surfaces at receivers: (unscattered from one surface, the rest)."""
    known = kit.cache
    *moved, where, facing = steps.step(kit, receiver, position, item, sample, seed, 1, tally)
    tally.count(traced=item.size)
    first, several = collect(moved, 1.0, *_pick(known, cache.nearest(known, where, facing)), split=True)
    if kit.walks_surfaces:
        walked = surface_walks.walk(kit, position, receiver.normal, partial(steps.marching_numbers, seed, item, sample, 7))
        light = np.asarray(known.straight + known.rest)
        radiance = np.zeros(position.shape, np.float32)
        for weight, index in zip(walked.weights, walked.indices, strict=True):
            radiance += weight * light[index]
        several = several + _straight(receiver, walked.direction, radiance)
    return first, several


def ways(kit: Kit, normal, position, item, sample, seed) -> Iterator[tuple[Float[np.ndarray, "n 3"], Int[np.ndarray, "n"]]]:
    """One random way from each receiver to cached points, in parts that add up: irradiance per irradiance, and the points."""
    plain, scattered, where, facing = steps.step(kit, Irradiance(normal), position, item, sample, seed, 1, Tally())
    yield np.asarray(plain + scattered), cache.nearest(kit.cache, where, facing)
    if kit.walks_surfaces:
        walked = surface_walks.walk(kit, position, normal, partial(steps.marching_numbers, seed, item, sample, 7))
        cosine = np.maximum(np.sum(np.asarray(normal) * np.asarray(walked.direction), axis=-1, keepdims=True), 0)
        for weight, index in zip(walked.weights, walked.indices, strict=True):
            yield cosine * weight, index


@partial(jax.jit, static_argnames="split")
def collect(first_step, rest, straight, more, *, split: bool):
    """Light of one vertex at the receiver: (unscattered from one surface where `split`, else None; the rest)."""
    plain, scattered = first_step
    direct, more = rest * straight, rest * more
    if not split:
        return None, (plain + scattered) * like(direct + more, plain)
    return plain * like(direct, plain), scattered * like(direct + more, plain) + plain * like(more, plain)


@jax.jit
def _pick(known, index):
    return known.straight[index], known.rest[index]


@jax.jit
def _straight(receiver, direction, radiance):
    return receiver.straight(direction, radiance)
