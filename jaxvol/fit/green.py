"""Isotropic scattering around an isotropic point source in an infinite medium: exact fluence, bounce by bounce and summed.

Case, de Hoffmann and Placzek 1953; Davison 1957. Source of intensity 1 W/sr (power 4 pi), sigma_t = 1: for other sigma_t,
phi(d) = sigma_t^2 phi(sigma_t d). numpy float64; these are the truth that the general solver is checked against.
"""

from math import atanh, pi

import numpy as np
from scipy.optimize import brentq


def diffusion_root(albedo: float) -> float:
    """kappa_0 in [0, 1): c atanh(kappa)/kappa = 1. Below c = 0.06, 1 - kappa_0 ~ 2 exp(-2/c) underflows: returns 1."""
    if not 0 < albedo <= 1:
        raise ValueError(f"albedo = {albedo} must lie in (0, 1]")
    if albedo == 1:
        return 0.0
    if albedo < 0.06:
        return 1.0

    def excess(kappa: float) -> float:
        return albedo * atanh(kappa) / kappa - 1

    return brentq(excess, 1e-9, 1 - 1e-16, xtol=1e-16, rtol=1e-15)


def _exp_sinh(num: int) -> tuple[np.ndarray, np.ndarray]:
    """Nodes u on (0, inf) and weights."""
    t = np.linspace(-4.2, 3.2, num)
    u = np.exp(pi / 2 * np.sinh(t))
    return u, (t[1] - t[0]) * pi / 2 * np.cosh(t) * u


def fluence_total(tau, albedo: float, *, num_nodes: int = 160) -> np.ndarray:
    """phi(tau) of all bounces, direct light included (equation of Case; specification section 3)."""
    tau = np.asarray(tau, dtype=np.float64)
    kappa = diffusion_root(albedo)
    c, k2 = albedo, kappa * kappa
    if c == 1:
        discrete = 3.0  # the limit of the expression below, as kappa^2 = 3 (1 - c)
    elif kappa == 1.0:
        discrete = 0.0
    else:
        discrete = 2 * k2 * (1 - k2) / (c * (k2 + c - 1))
    u, weight = _exp_sinh(num_nodes)
    s = 1 + u
    log_term = np.log1p(2 / u) / (2 * s)
    density = weight / ((1 - c * log_term) ** 2 + (pi * c / (2 * s)) ** 2)
    with np.errstate(under="ignore"):
        continuous = np.exp(-tau[..., None] * s) @ density
        return (discrete * np.exp(-kappa * tau) + continuous) / tau


def fluence_bounce(tau, num_scatterings: int, *, num_nodes: int = 160) -> np.ndarray:
    """phi_k(tau) of light scattered exactly k times, albedo 1.

    k <= 8 by the branch-cut integral (2e-14 at k = 3, 1e-9 at k = 8), larger k by the Fourier integral, whose integrand falls
    as q^-k (the cut integral cancels there).
    """
    tau = np.asarray(tau, dtype=np.float64)
    power = num_scatterings + 1
    if num_scatterings <= 8:
        u, weight = _exp_sinh(num_nodes)
        s = 1 + u
        base = (np.log1p(2 / u) + 1j * pi) / (2 * s)
        return 2 / (pi * tau) * (np.exp(-tau[..., None] * s) @ (weight * s * (base**power).imag))
    edges = np.concatenate([[0.0], np.geomspace(0.05, 400, 200)])
    node, weight = np.polynomial.legendre.leggauss(24)
    half = np.diff(edges)[:, None] / 2
    q = (edges[:-1, None] + half * (1 + node)).ravel()
    weight = (half * weight).ravel()
    values = weight * q * (np.arctan(q) / q) ** power
    return 2 / (pi * tau) * (np.sin(tau[..., None] * q) @ values)
