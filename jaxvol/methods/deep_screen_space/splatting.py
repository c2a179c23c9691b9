"""Splatting: shells of doubling radius around every surfel, each into one sub-buffer of its level (paper sections 3.2, 4.2).

A pair of surfel and sample at distance d belongs to the level whose shell [R_l-1, R_l) holds d, R_l = 2^l R_0; there the
surfel meets the pixel with probability 4^-l and counts 4^l fold: unbiased. With R_0 = r sqrt(pi L/epsilon) that
probability is proportional to what the pair exchanges. The last shell reaches infinity, so that no light is lost.

Work comes as pairs of (tile of rays, group of surfels): all of them (`dense`) or those that `tile_lists` kept.
"""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int

from jaxvol.methods.deep_screen_space import kernel
from jaxvol.methods.deep_screen_space.lighting import LitSurfels
from jaxvol.types import PhaseTable

RADII = ("quadratic", "paper")


class LevelRays(eqx.Module):
    """The active rays of one level, tile by tile; padding rays have weight 0 and a harmless direction."""

    direction: Float[Array, "tiles 3 T"]
    distance: Float[Array, "tiles n T"]
    weight: Float[Array, "tiles n 3 T"] | None  # per sample and channel; None when constant along a ray
    cell: Int[Array, "tiles n T"] | None  # of the transport table, per sample
    g: Float[Array, "tiles n T"] | None  # mean cosine at each sample; None when one number serves all
    sub_buffer: Int[Array, "tiles"]


class LevelSurfels(eqx.Module):
    """The surfels of one level: rows of kernel.COLUMNS in groups of M, sub-buffer by sub-buffer."""

    row: Float[Array, "groups M columns"]
    cluster: Int[Array, "groups"]  # of the transport table; a group never straddles clusters


def first_radius(
    area: Float[Array, "S"], radiance: Float[Array, "S 3"], epsilon, *, radius: str = "quadratic"
) -> Float[Array, "S"]:
    """R_0: `quadratic` r sqrt(pi max(L)/epsilon); `paper` r max(L)/epsilon, its getMaxDist. 0 for unlit surfels.

    The paper reasons with a quadratic fall-off but prints the linear formula. epsilon has the unit of radiance.
    """
    r = jnp.sqrt(area * (1.0 / jnp.pi))
    brightest = jnp.max(radiance, axis=-1)
    if radius == "paper":
        return r * brightest / epsilon
    return r * jnp.sqrt(jnp.pi * brightest / epsilon)


def shell(first: Float[Array, "S"], *, level: int, num_levels: int, tail: bool) -> tuple[Float[Array, "S"], Float[Array, "S"]]:
    """Squared inner and outer radius of the shell of `level`; with `tail` the last one is unbounded. Empty if first is 0."""
    largest = 2.0**level
    return _shell(first, np.float32(0.5 * largest if level else 0.0), np.float32(largest), tail and level == num_levels - 1)


@jax.jit
def _shell(first, inner, outer, endless):
    outer = jnp.where(endless & (first > 0), jnp.inf, first * outer)
    inner = first * inner
    return inner * inner, outer * outer


def level_surfels(
    lit: LitSurfels,
    first: Float[Array, "S"],
    origin: Float[Array, "3"],
    order: Int[Array, "sub members"],
    *,
    level: int,
    num_levels: int,
    tail: bool,
    group_size: int,
    cluster_size: int,
) -> LevelSurfels:
    """Rows of one level: positions relative to the rays' common origin, radiance times area times 4^level.

    delta stays that of the original surfel: scaled with the area it would bias pairs nearer than it.
    """
    inner, outer = shell(first, level=level, num_levels=num_levels, tail=tail)
    sizes = {"group_size": group_size, "cluster_size": cluster_size}
    return _ordered_rows(lit, inner, outer, np.float32(4.0**level), origin, order.reshape(-1), **sizes)


@partial(jax.jit, static_argnames=("group_size", "cluster_size"))
def _ordered_rows(lit, inner, outer, scale, origin, order, *, group_size, cluster_size):
    """Rows in a level's order; levels whose groups have one size share the program."""
    emitted = lit.radiance * (lit.area * scale)[:, None]
    delta = jnp.maximum(lit.area * (0.5 / jnp.pi), 1e-10 * jnp.max(lit.area))
    columns = [*(lit.position - origin).T, *lit.normal.T, inner, outer, delta, *emitted.T]
    if lit.lobe_direction is not None:
        columns += [*lit.lobe_direction.T, lit.lobe_exponent]
    row = jnp.stack(columns, axis=-1)[order]
    groups = order.reshape(-1, group_size)
    return LevelSurfels(row=row.reshape(-1, group_size, row.shape[-1]), cluster=groups[:, 0] // cluster_size)


@partial(jax.jit, static_argnames=("stride",))
def level_rays(
    direction: Float[Array, "A 3"],
    distance: Float[Array, "N A"],
    weight: Float[Array, "M 3 A"],
    cell: Int[Array, "N A"] | None,
    g: Float[Array, "N A"] | None,
    ray: Int[Array, "tiles T"],
    sub_buffer: Int[Array, "tiles"],
    phase: Int[Array, "A"],
    *,
    stride: int = 1,
) -> LevelRays:
    """The rays of one level in the order of its tiles, with every `stride`-th sample from `phase` on.

    Weights that are constant along a ray (M = 1) are left out: they are applied once, after the levels are summed.
    """
    num = distance.shape[0] // stride

    def thin(values):  # [N, A] -> [num, A]
        if stride == 1:
            return values
        values = values.reshape(num, stride, -1)
        picked = values[:, 0]
        for s in range(1, stride):
            picked = jnp.where(phase == s, values[:, s], picked)
        return picked

    def arrange(values):  # [n, A] -> [tiles, n, T]
        padded = jnp.concatenate([values, jnp.zeros((values.shape[0], 1), values.dtype)], axis=1)
        return jnp.swapaxes(padded.T[ray], 1, 2)

    weights = None
    if weight.shape[0] > 1:
        thinned = jnp.stack([thin(weight[:, c]) for c in range(3)], axis=1)  # [num, 3, A]
        weights = arrange(thinned.reshape(num * 3, -1)).reshape(ray.shape[0], num, 3, ray.shape[1])
    return LevelRays(
        direction=arrange(direction.T),
        distance=arrange(thin(distance)),
        weight=weights,
        cell=None if cell is None else arrange(thin(cell)),
        g=None if g is None else arrange(thin(g)),
        sub_buffer=sub_buffer,
    )


def _rows(array, index):
    """array[index] for indices known to be in range: the checks of an ordinary gather cost as much as a pair."""
    return array.at[index].get(mode="promise_in_bounds")


@partial(jax.jit, static_argnames=("phase", "batch", "glossy"))
def splat(
    rays: LevelRays,
    surfels: LevelSurfels,
    tile: Int[Array, "capacity"],
    group: Int[Array, "capacity"],
    num_pairs: Int[Array, ""],
    transport: Float[Array, "channels clusters cells"] | None,
    g: Float[Array, ""],
    table: PhaseTable | None,
    *,
    phase: str,
    batch: int,
    glossy: bool = False,
) -> Float[Array, "tiles 3 T"]:
    """Sum over the listed (tile, group) pairs of what the group's surfels send through the tile's samples, per ray.

    `capacity` is a multiple of `batch`; entries from `num_pairs` on are skipped, whole batches at no cost. `transport`
    is looked up at the samples' cells, once for all surfels of a group; three channels of it need weights per sample.
    """
    names = kernel.GLOSSY_COLUMNS if glossy else kernel.COLUMNS
    num_tiles, num_samples, size = rays.distance.shape
    group_size = surfels.row.shape[1]
    # With its own g every sample's weight holds the phase function's factor already.
    scale = kernel.phase_scale(phase, g) if rays.g is None else 1.0

    def one_batch(index, images):
        chosen = index * batch + jnp.arange(batch)
        valid = chosen < num_pairs
        t = jnp.where(valid, lax.dynamic_slice_in_dim(tile, index * batch, batch), num_tiles)
        k = jnp.where(valid, lax.dynamic_slice_in_dim(group, index * batch, batch), 0)
        safe = jnp.minimum(t, num_tiles - 1)
        direction = _rows(rays.direction, safe)
        ray = (direction[:, 0], direction[:, 1], direction[:, 2])
        distance = _rows(rays.distance, safe)
        along = lambda values: [values[:, n] for n in range(num_samples)]  # noqa: E731
        factor = None
        if transport is not None:
            channels, _, num_cells = transport.shape
            place = _rows(surfels.cluster, k)[:, None, None] * num_cells + _rows(rays.cell, safe)
            factor = [_rows(transport[c].reshape(-1), place) for c in range(channels)]
        mean_cosine = g if rays.g is None else along(_rows(rays.g, safe))
        if rays.weight is not None:
            weight = _rows(rays.weight, safe)
            weights = [weight[:, :, c] if factor is None else weight[:, :, c] * factor[c % len(factor)] for c in range(3)]
            weights = [along(channel) for channel in weights]
        elif factor is not None:
            factor = along(factor[0])
        rows = _rows(surfels.row, k)

        def one_surfel(m, sums):
            row = lax.dynamic_index_in_dim(rows, m, 1, keepdims=False)
            surfel = {name: row[:, i : i + 1] for i, name in enumerate(names)}
            values = kernel.pair_samples(ray, along(distance), surfel, phase=phase, g=mean_cosine, table=table)
            colours = [surfel[name] for name in ("red", "green", "blue")]
            if rays.weight is not None:
                totals = [sum(v * w for v, w in zip(values, channel, strict=True)) for channel in weights]
                return tuple(s + c * total for s, c, total in zip(sums, colours, totals, strict=True))
            if factor is not None:
                values = [v * f for v, f in zip(values, factor, strict=True)]
            total = sum(values[1:], start=values[0])
            return tuple(s + c * total for s, c in zip(sums, colours, strict=True))

        zero = jnp.zeros((batch, size), jnp.float32)
        sums = lax.fori_loop(0, group_size, one_surfel, (zero, zero, zero))
        return tuple(i.at[t].add(s, mode="drop") for i, s in zip(images, sums, strict=True))

    blank = jnp.zeros((num_tiles, size), jnp.float32)
    num_batches = (num_pairs + batch - 1) // batch
    images = lax.fori_loop(0, num_batches, one_batch, (blank, blank, blank))
    return scale * jnp.stack(images, axis=1)
