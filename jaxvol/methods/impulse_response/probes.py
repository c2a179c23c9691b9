"""Light probes: incident light on a grid as SH of order 3, and relighting from them (section 5, Fig. 11)."""

from math import pi, sqrt
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import ArrayLike, Float

from jaxvol import harmonics

ORDER = 3


class Probes(NamedTuple):
    """Incident radiance at the points of a grid; positions are `low + index * step`."""

    low: Float[np.ndarray, "3"]
    step: Float[np.ndarray, "3"]
    radiance: Float[np.ndarray, "X Y Z 9 3"]  # SH coefficients, RGB


def directions(*, num_polar: int = 4) -> tuple[Float[np.ndarray, "N 3"], Float[np.ndarray, "N"]]:
    """Unit vectors and weights of a quadrature of the sphere, exact for SH up to degree 2 num_polar - 1."""
    mu, weight = np.polynomial.legendre.leggauss(num_polar)
    phi = 2 * pi * (np.arange(2 * num_polar) + 0.5) / (2 * num_polar)
    sine = np.sqrt(1 - mu * mu)
    w = np.stack([sine[:, None] * np.cos(phi), sine[:, None] * np.sin(phi), mu[:, None] + 0 * phi], axis=-1).reshape(-1, 3)
    return w, np.repeat(weight * pi / num_polar, 2 * num_polar)


def radiance_from_irradiance(irradiance: Float[np.ndarray, "*b N 3"]) -> Float[np.ndarray, "*b 9 3"]:
    """SH of incident radiance from irradiance on planes facing `directions`: E_lm = sqrt(4 pi/(2l+1)) A_l L_lm.

    Bands above 2 of the irradiance are small (0.1 of band 2 and less) and orthogonal to the fit.
    """
    normal, weight = directions(num_polar=_num_polar(irradiance.shape[-2]))
    basis = np.asarray(harmonics.evaluate_sh(jnp.asarray(normal, jnp.float32), ORDER), np.float64)
    band = np.repeat(np.arange(ORDER), 2 * np.arange(ORDER) + 1)
    gain = (harmonics.rotation_norm(ORDER) * harmonics.clamped_cosine(ORDER))[band]
    projected = np.einsum("n,ni,...nc->...ic", weight, basis, np.asarray(irradiance, np.float64))
    return projected / gain[:, None]


def _num_polar(num: int) -> int:
    return round(sqrt(num / 2))


def grid(bounds: ArrayLike, spacing: float) -> tuple[np.ndarray, np.ndarray, tuple[int, int, int]]:
    """Lowest point, step and shape of a grid that fills bounds [2, 3]; ValueError for a spacing or bounds out of range."""
    low, high = np.asarray(bounds, np.float64)
    if not spacing > 0 or not np.all(high > low):
        raise ValueError(f"probe spacing {spacing} and bounds {low.tolist()}..{high.tolist()} must be positive")
    shape = np.maximum(np.round((high - low) / spacing).astype(int), 1)
    if int(np.prod(shape)) > 1_000_000:
        raise ValueError(f"probe spacing {spacing} makes {int(np.prod(shape))} probes; at most 1000000")
    step = (high - low) / shape
    return low + 0.5 * step, step, tuple(int(n) for n in shape)


def positions(low: np.ndarray, step: np.ndarray, shape: tuple[int, int, int]) -> Float[np.ndarray, "X Y Z 3"]:
    """The points of the grid."""
    index = np.stack(np.meshgrid(*(np.arange(n) for n in shape), indexing="ij"), axis=-1)
    return low + index * step


def relight(probes: Probes, points: ArrayLike, normals: ArrayLike) -> Float[np.ndarray, "N 3"]:
    """Irradiance at points [N, 3] facing unit normals, from trilinearly interpolated probes (the nearest beyond the grid).

    Order 3 leaks: facing a single small lamp it gives 1.06 of the truth, edge-on 0.09 of that instead of 0.
    """
    shape = np.array(probes.radiance.shape[:3])
    x = np.clip((np.asarray(points, np.float64) - probes.low) / probes.step, 0, shape - 1)
    low = np.minimum(x.astype(int), np.maximum(shape - 2, 0))
    fraction = x - low
    total = np.zeros((len(x), 9, 3))
    for corner in np.ndindex(2, 2, 2):
        index = np.minimum(low + corner, shape - 1)
        weight = np.prod(np.where(corner, fraction, 1 - fraction), axis=1)
        total += weight[:, None, None] * probes.radiance[index[:, 0], index[:, 1], index[:, 2]]
    coefficients = jnp.asarray(np.moveaxis(total, -1, 1), jnp.float32)
    normal = jnp.asarray(normals, jnp.float32)[:, None, :]
    return np.maximum(np.asarray(harmonics.sh_irradiance(coefficients, normal)), 0)
