"""Where the grid holds anything: rays, of lights and of the eye, are walked from the first filled block to the last.

Blocks of 4^3 voxels. A ray is looked at in the middle of pieces of at most a block and a half; since every block beside a
filled one counts as filled, no filled voxel and no neighbour of one is missed. Rays that meet none cost these looks only.
Sweeps of the lattice run over all voxels of the (cropped) box: scattered light crosses the empty ones too.
"""

import math
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float
from scipy.ndimage import maximum_filter

from jaxvol.methods.lattice_boltzmann.materials import Grid, Materials

_EDGE = 4  # voxels along a block
_WORTH = 0.7  # share of blocks that count as filled, above which looking costs more than it saves


def filled_blocks(materials: Materials) -> Bool[Array, "X Y Z"] | None:
    """Blocks that hold a voxel of the medium, or are beside one that does; None where nearly all are. Eager."""
    anything = np.asarray(jnp.any(materials.scattering + materials.absorption > 0.0, axis=0))
    shape = [-(-n // _EDGE) for n in anything.shape]
    padded = np.pad(anything, [(0, _EDGE * m - n) for m, n in zip(shape, anything.shape, strict=True)])
    blocks = padded.reshape(shape[0], _EDGE, shape[1], _EDGE, shape[2], _EDGE).any(axis=(1, 3, 5))
    blocks = maximum_filter(blocks, size=3, mode="constant")
    return None if blocks.mean() > _WORTH else jnp.asarray(blocks)


def to_voxels(grid: Grid, origin: np.ndarray, direction: np.ndarray, t_max: np.ndarray):
    """Rays in voxel units, clipped to the grid: (position, direction, t0, t1) with empty rays t1 <= t0."""
    position = (np.asarray(origin, np.float64) - np.asarray(grid.lower, np.float64)) / float(grid.voxel)
    direction = np.asarray(direction, np.float64)
    safe = np.where(np.abs(direction) < 1e-12, 1e-12, direction)
    a, b = -position / safe, (np.array(grid.shape) - position) / safe
    t0 = np.maximum(np.minimum(a, b).max(1), 0.0)
    t1 = np.minimum(np.maximum(a, b).min(1), np.asarray(t_max, np.float64) / float(grid.voxel))
    return position, safe, t0, t1


def narrowed(
    blocks: Bool[Array, "X Y Z"] | None, position: np.ndarray, direction: np.ndarray, t0: np.ndarray, t1: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """(t0, t1) [n] of rays in voxel units, from the first filled block to the end of the last; t1 < t0 where all is empty."""
    if blocks is None or len(t0) == 0:
        return t0, t1
    count = 1024
    while count < len(t0):
        count *= 2
    pad = lambda x: jnp.asarray(np.concatenate([x, np.zeros((count - len(x), *x.shape[1:]))]), jnp.float32)  # noqa: E731
    num = math.ceil(float(np.linalg.norm(blocks.shape)) / 1.5)
    first, last = (np.asarray(x)[: len(t0)] for x in _spans(blocks, *(pad(x) for x in (position, direction, t0, t1)), num))
    piece = (t1 - t0) / num
    return np.where(t1 > t0, t0 + first * piece, t0), np.where(t1 > t0, t0 + (last + 1) * piece, t1)


@partial(jax.jit, static_argnames="num")
def _spans(
    blocks: Bool[Array, "X Y Z"],
    position: Float[Array, "n 3"],
    direction: Float[Array, "n 3"],
    t0: Float[Array, "n"],
    t1: Float[Array, "n"],
    num: int,
):
    """(first, last) of `num` equal pieces whose middle lies in a filled block; num and -1 where none does."""
    piece = (t1 - t0) / num

    def look(k, found):
        t = t0 + (k + 0.5) * piece
        at = [
            jnp.clip(((position[:, a] + t * direction[:, a]) / _EDGE).astype(jnp.int32), 0, blocks.shape[a] - 1)
            for a in range(3)
        ]
        hit = blocks[tuple(at)]
        return jnp.minimum(found[0], jnp.where(hit, k, num)), jnp.maximum(found[1], jnp.where(hit, k, -1))

    start = jnp.full(t0.shape, num, jnp.int32), jnp.full(t0.shape, -1, jnp.int32)
    return jax.lax.fori_loop(0, num, look, start)
