"""Errors of pictures against a reference, layer by layer and over sums, with how far the reference lets them be known."""

from collections.abc import Sequence

import numpy as np

from jaxvol import image
from jaxvol.layers import NAMES, items, select
from jaxvol.types import Layers


def names_of(layers: Layers) -> tuple[str, ...]:
    """The single layers that an estimate holds, alone or in sums, in the order of `NAMES`."""
    held = {part for name, _ in items(layers) for part in name.split("+")}
    return tuple(name for name in NAMES if name in held)


def lit(names: Sequence[str], reference: image.Picture) -> tuple[str, ...]:
    """Those of `names` that hold any light in the reference."""
    return tuple(name for name in names if float(np.max(np.asarray(select(reference.layers, [name])))) > 0)


def relmse_of_noise(variance: np.ndarray, mean: np.ndarray) -> float:
    """relMSE that a picture of this variance has against the truth, which `mean` is near to."""
    mean = np.asarray(mean, np.float64)
    return float(np.mean(variance / (mean**2 + 0.01 * np.mean(mean) ** 2)))


def errors_of(layers: Layers, reference: image.Picture, names: Sequence[str], *, block: int) -> dict[str, float] | None:
    """Errors of the sum over `names`; None where the reference is black there.

    relmse is over pixels, the reference's variance taken out; `relmse_error` is its standard error, by the spread over
    pixels. relative_l1, p99 and reference_noise are over blocks.
    """
    a, r = (np.asarray(select(x, names), np.float64) for x in (layers, reference.layers))
    if not np.isfinite(a).all():
        return {"nonfinite": int(np.count_nonzero(~np.isfinite(a)))}
    if r.max() <= 0:
        return None
    variance = np.asarray(select(reference.variance, names), np.float64)
    terms = ((a - r) ** 2 - variance) / (r**2 + 0.01 * np.mean(r) ** 2)
    return {
        "relmse": image.relmse(a, r, variance=variance),
        "relmse_error": float(terms.std() / np.sqrt(terms.size)),
        "relative_l1": image.relative_l1(a, r, block=block),
        "bias": image.bias(a, r),
        "p99": image.p99(a, r, block=block),
        "reference_noise": image.reference_noise(r, variance, block=block),
        "mean_noise": float(np.sqrt(variance.sum()) / r.sum()),  # of the reference's mean: what `bias` is known to
    }


def all_errors(layers: Layers, reference: image.Picture, *, block: int) -> dict[str, dict[str, float]]:
    """Errors by layer or sum as the method gives them, and of all that it gives together under "own"."""
    found = {}
    for name, _ in items(layers):
        one = errors_of(layers, reference, name.split("+"), block=block)
        if one is not None:
            found[name] = one
    names = names_of(layers)
    if names:
        own = errors_of(layers, reference, names, block=block)
        if own is not None:
            found["own"] = own
    return found
