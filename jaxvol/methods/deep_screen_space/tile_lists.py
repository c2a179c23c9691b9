"""Which groups of surfels can reach which tiles of rays: conservative tests against the bounds of the tile's samples.

The bounds are those of the medium's samples only, not of the whole rays: that is most of the culling. Every surfel is
tested by itself (shell against box, box against the surfel's plane); a group is kept when one of its members is.
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxvol.methods.deep_screen_space.splatting import LevelRays, LevelSurfels

_SLACK = 1e-5  # relative: bounds and kernel round differently


@jax.jit
def tile_bounds(rays: LevelRays, ray_index: Int[Array, "tiles T"], num_rays: int) -> Float[Array, "tiles 2 3"]:
    """Corners of the box that holds all samples of a tile, relative to the rays' origin; NaN where all is padding.

    Samples increase along the ray, so the first and the last one bound all of them.
    """
    real = (ray_index < num_rays)[:, None, :]
    near = rays.direction * rays.distance[:, :1]
    far = rays.direction * rays.distance[:, -1:]
    low = jnp.min(jnp.where(real, jnp.minimum(near, far), jnp.inf), axis=-1)
    high = jnp.max(jnp.where(real, jnp.maximum(near, far), -jnp.inf), axis=-1)
    corners = jnp.stack([low, high], axis=1)
    return jnp.where(jnp.any(real, axis=-1)[:, None], corners, jnp.nan)


@partial(jax.jit, static_argnames=("groups_each",))
def reachable(
    bounds: Float[Array, "tiles 2 3"], sub_buffer: Int[Array, "tiles"], surfels: LevelSurfels, *, groups_each: int
) -> Bool[Array, "tiles groups_each"]:
    """Whether any surfel of each of the sub-buffer's groups may contribute to the tile.

    Kept: the nearest point of the box is nearer than the shell's outer radius, its farthest corner beyond the inner
    one, and some of the box lies in front of the surfel's plane.
    """
    columns = jnp.moveaxis(surfels.row[..., :8], 1, 0)  # [M, groups, 8]: groups are the lanes
    columns = [columns[..., i] for i in range(8)]

    def one_tile(_, inputs):
        box, sub = inputs
        x, y, z, nx, ny, nz, inner, outer = (
            lax.dynamic_slice_in_dim(c, sub * groups_each, groups_each, axis=1) for c in columns
        )
        near = far = 0.0
        ahead = 0.0
        for p, n, low, high in zip((x, y, z), (nx, ny, nz), box[0], box[1], strict=True):
            below, above = low - p, high - p
            gap = jnp.maximum(jnp.maximum(below, -above), 0.0)
            near = near + gap * gap
            far = far + jnp.maximum(below * below, above * above)
            ahead = ahead + jnp.maximum(n * below, n * above)
        keep = (near * (1.0 - _SLACK) < outer) & (far * (1.0 + _SLACK) >= inner)
        keep = keep & (ahead > -_SLACK * jnp.sqrt(far))  # all comparisons with NaN are false
        return None, jnp.any(keep, axis=0)

    _, kept = lax.scan(one_tile, None, (bounds, sub_buffer))
    return kept


def listed(kept: Bool[np.ndarray, "tiles groups"], sub_buffer: Int[np.ndarray, "tiles"]) -> tuple[np.ndarray, np.ndarray]:
    """The kept pairs as (tile, group index of the level), tile by tile. Host."""
    tile, group = np.nonzero(np.asarray(kept))
    return tile.astype(np.int32), (group + np.asarray(sub_buffer)[tile] * kept.shape[1]).astype(np.int32)


def dense(
    sub_buffer: Int[np.ndarray, "tiles"], real: Bool[np.ndarray, "tiles"], *, groups_each: int
) -> tuple[np.ndarray, np.ndarray]:
    """All pairs of a tile that holds a ray with the groups of its sub-buffer. Host."""
    return listed(np.broadcast_to(np.asarray(real)[:, None], (len(real), groups_each)), sub_buffer)


def pad_list(tile: np.ndarray, group: np.ndarray, *, batch: int) -> tuple[np.ndarray, np.ndarray, int]:
    """The list in the next size of a coarse series (so that frames share a compilation), and its true length. Host."""
    num = len(tile)
    capacity = batch
    while capacity < num:
        capacity *= 8 if capacity < 64 * batch else 2  # what is beyond `num` costs memory only, much of it in long lists
    fill = np.zeros(capacity - num, np.int32)
    return np.concatenate([tile, fill]), np.concatenate([group, fill]), num
