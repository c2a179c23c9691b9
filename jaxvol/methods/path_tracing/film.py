"""The film: for every pixel the sums and squares of each layer and of the total, and the means and variances they give.

The driver's films of single batches tell groups of paths apart and, by rows, the type of their first vertex; here every
layer has its own sums and nothing else has any, because this film is as large as the picture.
"""

import equinox as eqx
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
    """A film of zeros [P, 2, layers, 3]; double precision where that costs little, for sums of very many samples."""
    return np.zeros((num_pixels, 2, len(sources(groups)), 3), np.float64 if num_pixels <= _LARGE else np.float32)


def add_batch(film: np.ndarray, batch: np.ndarray, groups: tuple[int, ...]) -> None:
    """Add the driver's film of a batch [2 P, columns] to the film of the same pixels."""
    values = batch.reshape(2, len(film), 2, len(groups) + 1, 3)
    for slot, (column, row) in enumerate(sources(groups).values()):
        for part in (0, 1) if row is None else (row,):
            film[:, :, slot] += values[part, :, :, column]


def film_to_layers(
    film: np.ndarray, groups: tuple[int, ...], num_samples: int, *, only: str | None = None
) -> tuple[dict, dict]:
    """Means and variances of the mean of each layer [P, 3] (or of one), with the total under "total"; numpy float32.

    The variance is that of independent samples: (E[x^2] - E[x]^2) / (n - 1); 0 for a single sample.
    """
    mean, variance = {}, {}
    for slot, name in enumerate(sources(groups)):
        if only not in (None, name):
            continue
        average = film[:, 0, slot].astype(np.float64) / num_samples
        square = film[:, 1, slot].astype(np.float64) / num_samples
        mean[name] = average.astype(np.float32)
        variance[name] = (np.maximum(square - average**2, 0.0) / max(num_samples - 1, 1)).astype(np.float32)
    return mean, variance


def to_estimate(film: np.ndarray, groups: tuple[int, ...], num_samples: int, shape: tuple[int, ...]) -> Estimate:
    """All nine layers with their variances from a film of `num_samples` samples a pixel."""
    mean, variance = {}, {}
    for name in sources(groups):  # one after the other: large pictures are there once, not twice
        for kept, found in zip((mean, variance), film_to_layers(film, groups, num_samples, only=name), strict=True):
            kept[name] = jnp.asarray(found[name].reshape(*shape, 3))
    zeros = jnp.zeros((*shape, 3), jnp.float32)
    full = lambda found: Layers(**{name: found.get(name, zeros) for name in layer_classes.NAMES})  # noqa: E731
    whole = {"+".join(layer_classes.NAMES): variance[TOTAL]}
    return Estimate(
        mean=full(mean),
        variance=eqx.tree_at(lambda x: x.sums, full(variance), whole),  # layers of one path are not independent
        num_samples=jnp.float32(num_samples),
    )
