"""The film: for every pixel the sums and squares of each layer and of the total, and the means and variances they give.

The driver's films of single batches tell groups of paths apart and, by rows, the type of their first vertex; here every
layer has its own sums and nothing else has any, because this film is as large as the picture.
"""

import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxvol import layers as layer_classes
from jaxvol.methods.path_tracing.lanes import (
    EMISSION,
    FROM_MULTIPLE,
    FROM_SURFACE,
    FROM_VOLUME,
    SURFACE_LIGHT,
    VOLUME_LIGHT,
)
from jaxvol.types import Estimate, Layers

TOTAL = "total"
_LARGE = 1 << 18  # pixels
_ALIGNED = 16  # floats


def sources(groups: tuple[int, ...]) -> dict[str, tuple[int, int | None]]:
    """Each layer that such paths fall into, then the total: its place among the groups and its row (None: both)."""
    column = {group: i for i, group in enumerate(groups)}
    single = (("emission", EMISSION), ("surface_from_light", SURFACE_LIGHT), ("volume_from_light", VOLUME_LIGHT))
    found = {name: (column[group], None) for name, group in single if group in column}
    for row, kind, present in ((0, "surface", SURFACE_LIGHT in column), (1, "volume", VOLUME_LIGHT in column)):
        for source, group in (("surface", FROM_SURFACE), ("volume", FROM_VOLUME), ("multiple", FROM_MULTIPLE)):
            if present and group in column:
                found[f"{kind}_from_{source}"] = (column[group], row)
    return found | {TOTAL: (len(groups), None)}


def empty_film(num_pixels: int, groups: tuple[int, ...]) -> np.ndarray:
    """A film of zeros [layers, 2, P, 3]; double precision where that costs little, for sums of very many samples."""
    shape = len(sources(groups)), 2, num_pixels, 3
    if num_pixels <= _LARGE:
        return np.zeros(shape, np.float64)
    # From an aligned address, JAX takes what becomes of it as it is, without a copy.
    whole = np.zeros(math.prod(shape) + _ALIGNED, np.float32)
    first = -whole.ctypes.data % (4 * _ALIGNED) // 4
    return whole[first : first + math.prod(shape)].reshape(shape)


def add_batch(film: np.ndarray, batch: np.ndarray, groups: tuple[int, ...]) -> None:
    """Add the driver's film of a batch [2 P, columns] to the film of the same pixels."""
    values = batch.reshape(2, film.shape[2], 2, len(groups) + 1, 3)
    for sums, (column, row) in zip(film, sources(groups).values(), strict=True):
        for part in (0, 1) if row is None else (row,):
            sums += np.moveaxis(values[part, :, :, column], 1, 0)


def moments(sums: np.ndarray, num_samples: int) -> tuple[np.ndarray, np.ndarray]:
    """Mean and variance of the mean [P, 3], float32, from one layer's sums [2, P, 3].

    The variance is that of independent samples: (E[x^2] - E[x]^2) / (n - 1); 0 for a single sample.
    """
    mean = np.empty(sums.shape[1:], np.float32)
    variance = np.empty_like(mean)
    for low in range(0, len(mean), _LARGE):  # a large picture has no room for itself in double precision
        cut = slice(low, low + _LARGE)
        average, square = (part[cut].astype(np.float64) / num_samples for part in sums)
        mean[cut] = average
        variance[cut] = np.maximum(square - average**2, 0.0) / max(num_samples - 1, 1)
    return mean, variance


def total_moments(film: np.ndarray, groups: tuple[int, ...], num_samples: int) -> tuple[np.ndarray, np.ndarray]:
    """Mean and variance of the mean [P, 3] of the sum of all layers."""
    return moments(film[list(sources(groups)).index(TOTAL)], num_samples)


def to_estimate(film: np.ndarray, groups: tuple[int, ...], num_samples: int, shape: tuple[int, ...]) -> Estimate:
    """All nine layers with their variances from a film of `num_samples` samples a pixel; a large film is used up.

    The means and variances of a large film take the place of its sums, so that such a picture is there once, not twice.
    """
    mean, variance = {}, {}
    for sums, name in zip(film, sources(groups), strict=True):
        found = moments(sums, num_samples)
        if film.dtype == np.float32:
            sums[0], sums[1] = found
            found = sums
        mean[name], variance[name] = (jax.device_put(x.reshape(*shape, 3), may_alias=True) for x in found)
    zeros = jnp.zeros((*shape, 3), jnp.float32)
    full = lambda found: Layers(**{name: found.get(name, zeros) for name in layer_classes.NAMES})  # noqa: E731
    whole = {"+".join(layer_classes.NAMES): variance[TOTAL]}
    return Estimate(
        mean=full(mean),
        variance=eqx.tree_at(lambda x: x.sums, full(variance), whole),  # layers of one path are not independent
        num_samples=jnp.float32(num_samples),
    )
