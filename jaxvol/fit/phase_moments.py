"""Legendre moments chi_j of phase functions for the tables: p(cos) = sum (2j+1)/(4 pi) chi_j P_j(cos).

The tables are linear in the moments. The paper's table for three values of g, linearly interpolated (section 4.5), is
therefore one particular set of moments, and its error that of these moments.
"""

import numpy as np
from numpy.polynomial.legendre import leggauss, legvander

from jaxvol.fit.wavenumber import effective_moments


def henyey_greenstein(g: float, num: int) -> np.ndarray:
    """g^j, `[num]`. Raises ValueError unless -1 < g < 1."""
    if not -1 < g < 1:
        raise ValueError(f"g = {g} must lie in (-1, 1)")
    return float(g) ** np.arange(num)


def of_function(phase, num: int, *, num_nodes: int = 2048) -> np.ndarray:
    """Moments of a function of the cosine (any scale; normalised to chi_0 = 1), by Gauss-Legendre. `[num]`."""
    mu, weight = leggauss(num_nodes)
    values = weight * phase(mu)
    total = values.sum()
    if not (np.isfinite(total) and total > 0):
        raise ValueError("the phase function must be finite with a positive integral")
    return values @ legvander(mu, num - 1) / total


def three_g(g: float, g_range: float, num: int) -> np.ndarray:
    """Moments that equal linear interpolation between tables at g = -g_range, 0, g_range (section 4.5).

    g beyond the range extrapolates, as the lookup of the paper would. Raises ValueError unless 0 < g_range < 1.
    """
    if not 0 < g_range < 1:
        raise ValueError(f"g_range = {g_range} must lie in (0, 1)")
    share = abs(g) / g_range
    ends = henyey_greenstein(np.copysign(g_range, g), num)
    isotropic = henyey_greenstein(0.0, num)
    return share * ends + (1 - share) * isotropic


def similarity(sigma_s: float, sigma_t: float, g: float) -> tuple[float, float]:
    """(albedo, extinction ratio) of the isotropic medium with sigma_s' = (1 - g) sigma_s and the same absorption."""
    reduced = (1 - g) * sigma_s
    total = sigma_t - sigma_s + reduced
    return reduced / total, total / sigma_t


__all__ = ["effective_moments", "henyey_greenstein", "of_function", "similarity", "three_g"]
