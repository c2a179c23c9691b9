"""The hierarchical framebuffer: on level l every 2^l x 2^l block of pixels spreads over 4^l sub-buffers at random.

(Paper section 3.2, Fig. 3.) Only pixels that show medium exist here. A sub-buffer's pixels, in Morton order, are cut
into tiles of T rays: the unit in which surfels are culled and pairs evaluated. Host side, numpy: sorting is what numpy
does best, and nothing here depends on a value computed on a device but the list of active pixels.
"""

import equinox as eqx
import numpy as np
from jaxtyping import Int

_SALT = np.uint64(0x9E3779B97F4A7C15)


class Tiles(eqx.Module):
    """One level's pixels. Tiles of one sub-buffer follow each other; the last ones may be all padding."""

    ray: Int[np.ndarray, "tiles T"]  # index into the active rays, `num_rays` where padded
    sub_buffer: Int[np.ndarray, "tiles"]
    slot: Int[np.ndarray, "A"]  # where an active ray sits in the flattened tiles: the unshuffle
    phase: Int[np.ndarray, "A"]  # first of the samples that this ray evaluates on this level


def _mix(x):
    """splitmix64's finaliser: one 64-bit hash per entry."""
    x = x + _SALT
    x = (x ^ (x >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    x = (x ^ (x >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return x ^ (x >> np.uint64(31))


def hashed(seed: int, level: int, *keys: Int[np.ndarray, "n"]) -> Int[np.ndarray, "n"]:
    """A 64-bit hash of (seed, level, keys...), broadcast over the keys."""
    state = _mix(np.asarray([(seed & 0xFFFFFFFF) * 64 + level], np.uint64))  # an array: scalars would warn of wrapping
    for key in keys:
        state = _mix(state ^ np.asarray(key, np.uint64))
    return state


def morton(x: Int[np.ndarray, "n"], y: Int[np.ndarray, "n"]) -> Int[np.ndarray, "n"]:
    """Interleaved bits of x and y (16 each)."""

    def spread(v):
        v = v.astype(np.uint32)
        v = (v | (v << 8)) & np.uint32(0x00FF00FF)
        v = (v | (v << 4)) & np.uint32(0x0F0F0F0F)
        v = (v | (v << 2)) & np.uint32(0x33333333)
        return (v | (v << 1)) & np.uint32(0x55555555)

    return spread(x) | (spread(y) << np.uint32(1))


def sub_buffer_of(
    x: Int[np.ndarray, "n"], y: Int[np.ndarray, "n"], *, level: int, seed: int
) -> Int[np.ndarray, "n"]:
    """The sub-buffer (0 .. 4^level - 1) of each pixel: within each block a random bijection, uniform for every pixel.

    Two rounds of odd multiplication, addition and shift, their constants hashed per block, on the place in the block.
    """
    if level == 0:
        return np.zeros(x.shape, np.int64)
    mask = (1 << level) - 1
    place = ((y & mask) << level) | (x & mask)
    block = hashed(seed, level, x >> level, y >> level)
    size = np.uint64(4**level)
    value = place.astype(np.uint64)
    for shift in (0, 32):
        bits = block >> np.uint64(shift)
        value = (value * (bits | np.uint64(1)) + (bits >> np.uint64(12))) % size
        value = value ^ (value >> np.uint64(level))
    # a last hashed rotation makes every pixel's marginal uniform
    return ((value + (block >> np.uint64(7))) % size).astype(np.int64)


def tile_size(num_rays: int, level: int, *, largest: int = 64) -> int:
    """Rays per tile: `largest` on fine levels, about one tile a sub-buffer where those hold fewer rays."""
    mean = num_rays / 4**level
    if mean >= 2 * largest:
        return largest
    return int(np.clip(8 * np.ceil((mean + 2.0 * np.sqrt(mean)) / 8), 8, largest))


def make_tiles(
    x: Int[np.ndarray, "A"],
    y: Int[np.ndarray, "A"],
    *,
    level: int,
    seed: int,
    size: int,
    num_tiles: int,
    num_rays: int,
    stride: int = 1,
) -> Tiles:
    """The tiles of one level for active pixels given in Morton order; `num_tiles >= A // size + 4^level` is enough.

    `num_rays` is the capacity of the arrays of rays (the index of padding). `stride`: each ray evaluates every
    stride-th sample, beginning with a random `phase`.
    """
    num_sub = 4**level
    sub = sub_buffer_of(x, y, level=level, seed=seed)
    order = np.argsort(sub.astype(np.int16) if num_sub <= 2**15 else sub, kind="stable")
    counts = np.bincount(sub, minlength=num_sub)
    tiles_each = -(-counts // size)
    first_tile = np.cumsum(tiles_each) - tiles_each
    first_rank = np.cumsum(counts) - counts
    sorted_sub = sub[order]
    slot_sorted = first_tile[sorted_sub] * size + np.arange(len(sub)) - first_rank[sorted_sub]
    ray = np.full(num_tiles * size, num_rays, np.int32)
    ray[slot_sorted] = order
    slot = np.empty(len(sub), np.int32)
    slot[order] = slot_sorted
    owner = np.zeros(num_tiles, np.int32)
    used = np.repeat(np.arange(num_sub, dtype=np.int32), tiles_each)
    owner[: used.size] = used
    return Tiles(
        ray=ray.reshape(num_tiles, size),
        sub_buffer=owner,
        slot=slot,
        phase=(hashed(seed + 1, level, x, y) % np.uint64(stride)).astype(np.int32),
    )


def surfel_order(num_surfels: int, *, level: int, seed: int) -> Int[np.ndarray, "sub_buffers members"]:
    """Which surfels each sub-buffer of a level receives: one of every run of 4^level consecutive ones, `num_surfels` padded.

    Runs are compact patches (`lighting.order_for_strata`), so this is stratified sampling; the rotation of every run is
    hashed, so that P(same sub-buffer) = 4^-level for every pair.
    """
    num_sub = 4**level
    runs = num_surfels // num_sub
    rotation = hashed(seed + 2, level, np.arange(runs)) % np.uint64(num_sub)
    sub = np.arange(num_sub, dtype=np.int64)[:, None]
    return ((sub + rotation.astype(np.int64)) % num_sub + num_sub * np.arange(runs)).astype(np.int32)
