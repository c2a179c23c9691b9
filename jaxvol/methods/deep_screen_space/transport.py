"""Attenuation and visibility from surfels to the medium's samples: the paper's stated main limitation (its section 5).

A table of transmittance times visibility over (cluster of surfels, cell of a coarse grid around the samples), built
anew for every frame: one segment per entry, from a surfel of the cluster to one of the samples in the cell. The
splat looks it up once per sample for all surfels of a cluster. Each entry takes another surfel of the cluster, chosen
by what it sends there, so that the error of standing for the cluster is noise between cells and not a bias; samples look
up a cell next to theirs with the probability of trilinear interpolation.
"""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxvol import ray_casting, sampling
from jaxvol.methods.deep_screen_space.lighting import LitSurfels

_STREAM = sampling.stream("deep_screen_space.transport")
_CANDIDATES = 12  # surfels of a cluster among which an entry chooses
_MARGIN = 1e-4


class Cells(eqx.Module):
    """The samples' cells in a grid of resolution^3 over their bounding box, and one sample of each cell.

    A sample drawn by its weight, not their mean: transmittance is convex, so that the mean place would make it too small.
    """

    index: Int[Array, "N A"]  # of the cell that each sample looks up
    point: Float[Array, "cells 3"]  # one of the samples that look the cell up; finite filler where none does
    used: Bool[Array, "cells"]


@partial(jax.jit, static_argnames=("resolution",))
def locate(
    origin: Float[Array, "3"],
    direction: Float[Array, "A 3"],
    distance: Float[Array, "N A"],
    weight: Float[Array, "M 3 A"],
    num_rays: int,
    seed,
    *,
    resolution: int,
) -> Cells:
    """Cell of every sample of the first `num_rays` rays, jittered by up to half a cell: trilinear in the mean."""
    num, capacity = distance.shape
    real = jnp.arange(capacity) < num_rays
    points = [origin[i] + distance * direction[:, i] for i in range(3)]  # [N, A] each
    low = [jnp.min(jnp.where(real, p, jnp.inf)) for p in points]
    high = [jnp.max(jnp.where(real, p, -jnp.inf)) for p in points]
    jitter = sampling.uniforms(seed, _STREAM, jnp.arange(capacity), jnp.arange(num)[:, None])
    index = jnp.zeros(distance.shape, jnp.int32)
    for p, a, b, u in zip(points, low, high, jitter, strict=False):
        coordinate = (p - a) * (resolution / jnp.maximum(b - a, 1e-20)) + u - 0.5
        index = index * resolution + jnp.clip(coordinate.astype(jnp.int32), 0, resolution - 1)
    cells = resolution**3
    slot = jnp.where(real, index, cells)
    # One sample of every cell, drawn with its weight: the largest ticket w/(-log u), and the place of its holder.
    ticket = jnp.where(real, jnp.mean(weight, axis=1) / -jnp.log(jitter[3]), 0.0)
    largest = jnp.zeros(cells, jnp.float32).at[slot].max(ticket, mode="drop")
    winner = jnp.where(ticket == largest[index], slot, cells)
    chosen = [jnp.zeros(cells, jnp.float32).at[winner].set(p, mode="drop") for p in points]
    return Cells(index=index, point=jnp.stack(chosen, axis=-1), used=largest > 0)


@partial(jax.jit, static_argnames=("cluster_size",))
def representatives(
    lit: LitSurfels, points: Float[Array, "U 3"], seed, *, cluster_size: int, scale: float | Float[Array, ""] = 1.0
) -> tuple[Float[Array, "C U 3"], Float[Array, "C U 3"], Float[Array, "C U"]]:
    """For every cluster and receiving point a surfel: position, direction to the point, and the distance (0: none lit).

    Of a few surfels drawn by flux one is drawn by flux cos/d^2, what it sends (resampled importance sampling): the
    nearest surfels of a cluster send most and are dimmed least. `scale` is the size of the scene.
    """
    num_clusters = lit.area.shape[0] // cluster_size
    flux = (jnp.max(lit.radiance, axis=-1) * lit.area).reshape(num_clusters, cluster_size)
    total = jnp.sum(flux, axis=1)
    cdf = jnp.cumsum(flux, axis=1) / jnp.where(total > 0, total, 1.0)[:, None]
    shift = sampling.uniforms(seed, _STREAM, jnp.arange(num_clusters), 1_000_003)[0]
    wanted = (jnp.arange(_CANDIDATES) + shift[:, None]) / _CANDIDATES
    pick = jax.vmap(jnp.searchsorted)(cdf, wanted)
    pick = jnp.minimum(pick, cluster_size - 1) + cluster_size * jnp.arange(num_clusters)[:, None]  # [C, candidates]
    u = sampling.uniforms(seed, _STREAM, jnp.arange(points.shape[0]), 1_000_004 + jnp.arange(num_clusters)[:, None])[0]
    position, normal = lit.position[pick], lit.normal[pick]
    chosen = jnp.zeros((num_clusters, points.shape[0]), jnp.int32)
    weight_sum = jnp.zeros(chosen.shape, jnp.float32)
    for k in range(_CANDIDATES):  # weighted reservoir: one pass, one candidate kept
        delta = points - position[:, k, None]
        squared = jnp.maximum(sampling.dot(delta, delta), 1e-12 * scale * scale)
        cosine = sampling.dot(delta, normal[:, k, None]) * jax.lax.rsqrt(squared)
        weight = jnp.maximum(cosine, 1e-4) * (scale * scale / squared)
        weight_sum = weight_sum + weight
        take = u * weight_sum < weight
        u = jnp.where(take, u * weight_sum / weight, (u * weight_sum - weight) / jnp.maximum(weight_sum - weight, 1e-30))
        chosen = jnp.where(take, k, chosen)
    rows = jnp.arange(num_clusters)[:, None]
    start = position[rows, chosen]
    delta = points - start
    distance = jnp.sqrt(sampling.dot(delta, delta))
    direction = delta / jnp.maximum(distance, 1e-20)[..., None]
    origin = ray_casting.offset_origin(start, normal[rows, chosen], normal[rows, chosen], scale=scale)
    return origin, direction, jnp.where(total[:, None] > 0, distance, 0.0)


def build_table(
    lit: LitSurfels,
    cells: Cells,
    caster: ray_casting.Caster,
    transmittance,
    *,
    seed: int,
    cluster_size: int,
    resolution: int,
    grey: bool,
    scale: float = 1.0,
) -> Float[np.ndarray, "channels C cells"]:
    """Transmittance times visibility of every cluster and occupied cell, one channel if grey. Eager: it casts rays.

    `transmittance(origin, direction, distance) -> [n, 3]`. Cells that no sample looks up stay 0.
    """
    num_clusters = lit.area.shape[0] // cluster_size
    used = np.flatnonzero(np.asarray(cells.used))
    if used.size == 0:  # all weights have underflowed
        return np.zeros((1 if grey else 3, num_clusters, resolution**3), np.float32)
    size = max(64, 1 << (max(used.size, 1) - 1).bit_length())
    padded = np.concatenate([used, np.zeros(size - used.size, np.int64)])
    points = np.asarray(cells.point)[padded]
    origin, direction, distance = representatives(lit, points, jnp.uint32(seed), cluster_size=cluster_size, scale=scale)
    through = transmittance(origin.reshape(-1, 3), direction.reshape(-1, 3), distance.reshape(-1))
    channels = 1 if grey else 3
    through = np.asarray(through)[:, :channels].T.reshape(channels, num_clusters, size)[..., : used.size]
    flat = [np.asarray(a)[:, : used.size].reshape(num_clusters * used.size, -1) for a in (origin, direction)]
    length = np.asarray(distance)[:, : used.size].reshape(-1) * (1.0 - _MARGIN)
    blocked = np.asarray(ray_casting.occluded(caster, *flat, length)).reshape(num_clusters, used.size)
    table = np.zeros((channels, num_clusters, resolution**3), np.float32)
    table[:, :, used] = np.where(blocked, 0.0, through)
    return table
