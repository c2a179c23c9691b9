"""The paper's estimator of single scattering (section 4.2): equi-angular sampling of the ray, low-discrepancy directions.

Uniform directions on the sphere, as the paper has it, give an infinite variance (radiance goes like 1/theta near the source);
uniform theta, pdf 1/(2 pi^2 sin theta), a finite one. An independent check of the tables, not a way to make them.
"""

from typing import NamedTuple

import numpy as np
from numpy.polynomial.legendre import legvander
from scipy.stats import qmc

from jaxvol import harmonics


class MonteCarlo(NamedTuple):
    """Mean and standard error over independent scramblings."""

    mean: np.ndarray
    standard_error: np.ndarray


def point(
    tau: float,
    *,
    order: int = 11,
    g: float = 0.0,
    num_samples: int = 4096,
    num_repeats: int = 16,
    sampling: str = "theta",
    seed: int = 0,
) -> MonteCarlo:
    """L_l of a point source scattered once, sigma_t = alpha = 1, by scrambled Sobol points.

    Args:
        sampling: "theta" (uniform angle) or "sphere" (the paper's; its printed standard error is not to be trusted).
    """
    if sampling not in ("theta", "sphere"):
        raise ValueError(f"sampling = {sampling!r} must be 'theta' or 'sphere'")
    means = []
    for repeat in range(num_repeats):
        u = qmc.Sobol(2, seed=np.random.default_rng((seed, repeat))).random(num_samples)
        if sampling == "theta":
            theta = np.pi * u[:, 0]
            weight = 2 * np.pi**2 * np.sin(theta)
        else:
            theta = np.arccos(1 - 2 * u[:, 0])
            weight = np.full(num_samples, 4 * np.pi)
        # equi-angular: the angle y at the source, from the ray's start to infinity
        low = theta - np.pi / 2
        y = low + (np.pi / 2 - low) * u[:, 1]
        height = tau * np.sin(theta)
        r, t = height / np.cos(y), tau * np.cos(theta) + height * np.tan(y)
        pdf = height / (r * r * (np.pi / 2 - low))
        cosine = -np.sin(y)
        phase = (1 - g * g) / (4 * np.pi * (1 + g * g - 2 * g * cosine) ** 1.5)
        value = weight * phase * np.exp(-(t + r)) / (r * r * pdf)
        basis = legvander(np.cos(theta), order - 1) * harmonics.zonal_norm(order)
        means.append(value @ basis / num_samples)
    means = np.stack(means)
    return MonteCarlo(means.mean(axis=0), means.std(axis=0, ddof=1) / np.sqrt(num_repeats))
