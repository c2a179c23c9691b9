"""How responses depend on sigma (section 4.3, Figure 6), recovered by least squares instead of assumed.

A table made at sigma_t = alpha = 1 is looked up at sigma_t^q1 sigma_s^q2 d and scaled by sigma_t^p1 alpha^p2. The exponents are
fitted to responses in physical units of random media, computed by quadratures that know nothing of the scaling. Truth:
(1, 0, 2, n) for point and area emitters after n scatterings, (1, 0, 0, n) for directional ones.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optimistix
from numpy.polynomial.chebyshev import chebvander
from scipy.special import exp1

from jaxvol.fit import compact, validation, wavenumber, zonal_tables

EXPECTED = {
    "point, direct": (1, 0, 2, 0),
    "point, 1 scattering": (1, 0, 2, 1),
    "point, 2 scatterings": (1, 0, 2, 2),
    "directional, 1 scattering": (1, 0, 0, 1),
}
_TAU = (1e-3, 40.0)


class ExponentFit(NamedTuple):
    """Exponents (q1, q2, p1, p2), the largest relative residual, and the number of steps."""

    exponents: np.ndarray
    max_residual: float
    num_steps: int


def random_media(*, num: int = 24, seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(distance, sigma_s, sigma_t) of random configurations with optical distances in [0.05, 5]."""
    rng = np.random.default_rng(seed)
    sigma_t = np.exp(rng.uniform(np.log(0.2), np.log(5), num))
    tau = np.exp(rng.uniform(np.log(0.05), np.log(5), num))
    return tau / sigma_t, sigma_t * rng.uniform(0.1, 1, num), sigma_t


def _panels(edges: np.ndarray, num: int = 16) -> tuple[np.ndarray, np.ndarray]:
    node, weight = np.polynomial.legendre.leggauss(num)
    half = np.diff(edges)[:, None] / 2
    return (edges[:-1, None] + half * (1 + node)).ravel(), (half * weight).ravel()


def _next_fluence(fluence, distance: float, sigma_s: float, sigma_t: float) -> float:
    """sigma_s / (2 d) int r phi(r) [E_1(sigma_t |d - r|) - E_1(sigma_t (d + r))] dr, isotropic scattering, physical units."""
    steps = np.concatenate([[0.0], 2.0 ** np.arange(-44, 1)])
    below, below_weight = _panels(distance / 2 * steps)  # distance from r = 0, and from r = d below
    above, above_weight = _panels(np.concatenate([steps, np.linspace(1.5, 40, 40)]) / sigma_t)
    parts = []
    for radius, offset, weight in (
        (below, distance - below, below_weight),
        (distance - below, below, below_weight),
        (distance + above, above, above_weight),
    ):  # the offset |d - r| is carried, not subtracted: E_1 is singular there
        kernel = exp1(sigma_t * offset) - exp1(sigma_t * (distance + radius))
        parts.append(np.sum(weight * radius * fluence(radius) * kernel))
    return sigma_s / (2 * distance) * sum(parts)


def _direct_fluence(sigma_t: float):
    return lambda r: np.exp(-sigma_t * r) / (r * r)


def _scattered_fluence(distance: float, sigma_s: float, sigma_t: float, scatterings: int) -> float:
    if scatterings == 1:
        return _next_fluence(_direct_fluence(sigma_t), distance, sigma_s, sigma_t)
    grid = np.geomspace(1e-14, 80, 160) / sigma_t  # phi_1 is smooth in ln r after its factor e^{-sigma_t r} / r

    def factored(r):
        return _scattered_fluence(r, sigma_s, sigma_t, scatterings - 1) * r * np.exp(sigma_t * r)

    low, high = np.log(grid[0]), np.log(grid[-1])
    points = compact.nodes(90, low, high)
    coefficients = compact.transform(np.array([factored(r) for r in np.exp(points)]))

    def fluence(r):
        x = np.clip((2 * np.log(r) - low - high) / (high - low), -1, 1)
        return chebvander(x, len(coefficients) - 1) @ coefficients * np.exp(-sigma_t * r) / r

    return _next_fluence(fluence, distance, sigma_s, sigma_t)


def physical_responses(kind: str, distance, sigma_s, sigma_t) -> np.ndarray:
    """Band 0 of the response in physical units, by quadratures without any scaling."""
    isotropic = np.ones(1)
    values = []
    for d, s, t in zip(distance, sigma_s, sigma_t, strict=True):
        if kind == "point, direct":
            values.append(np.exp(-t * d) / d**2 / np.sqrt(4 * np.pi))
        elif kind == "point, 1 scattering":
            values.append(validation.physical_response(d, sigma_t=t, sigma_s=s, moments=isotropic, order=1)[0])
        elif kind == "point, 2 scatterings":
            values.append(_scattered_fluence(d, s, t, 2) / np.sqrt(4 * np.pi))
        elif kind == "directional, 1 scattering":
            # half-space, light straight down: fluence s/(2) int e^{-t z} E_1(t |z - d|) dz
            steps = np.concatenate([[0.0], 2.0 ** np.arange(-44, 1)])
            up, up_weight = _panels(d * steps)
            down, down_weight = _panels(np.concatenate([steps, np.linspace(1.5, 40, 40)]) / t)
            above = np.sum(up_weight * np.exp(-t * (d - up)) * exp1(t * up))
            below = np.sum(down_weight * np.exp(-t * (d + down)) * exp1(t * down))
            values.append(s / 2 * (above + below) / np.sqrt(4 * np.pi))
        else:
            raise ValueError(f"kind {kind!r} is unknown; known: {', '.join(EXPECTED)}")
    return np.array(values)


def _table(kind: str) -> np.ndarray:
    """Chebyshev coefficients in ln tau of ln L_0 at sigma_t = alpha = 1."""
    low, high = np.log(_TAU)
    tau = np.exp(compact.nodes(48, low, high))
    if kind == "point, direct":
        values = np.exp(-tau) / tau**2 / np.sqrt(4 * np.pi)
    elif kind == "point, 1 scattering":
        values = zonal_tables.unscale_point(zonal_tables.point_table(tau, order=1), tau)[:, 0]
    elif kind == "point, 2 scatterings":
        values = wavenumber.point_table(tau, moments=np.ones(1), albedo=1.0, order=1, first=2, last=2)[:, 0]
    else:
        values = zonal_tables.directional_table(tau, order=1)[:, 0] * np.exp(-tau)
    return compact.transform(np.log(values) + tau)  # e^-tau apart


def _residual(exponents, args):
    coefficients, log_sigma_s, log_sigma_t, log_distance, log_value = args
    q1, q2, p1, p2 = exponents
    log_tau = q1 * log_sigma_t + q2 * log_sigma_s + log_distance
    low, high = np.log(_TAU)
    angle = jnp.arccos(jnp.clip((2 * log_tau - low - high) / (high - low), -0.9999, 0.9999))
    basis = jnp.cos(np.arange(coefficients.shape[0]) * angle[:, None])  # T_n; compiles faster than the recursion
    predicted = basis @ coefficients - jnp.exp(log_tau) + p1 * log_sigma_t + p2 * (log_sigma_s - log_sigma_t)
    return predicted - log_value


def fit(kind: str, *, num: int = 24, seed: int = 0, start=(0.8, 0.1, 1.5, 0.5)) -> ExponentFit:
    """Fit the four exponents to random media by Levenberg-Marquardt. Raises ValueError for an unknown kind."""
    distance, sigma_s, sigma_t = random_media(num=num, seed=seed)
    values = physical_responses(kind, distance, sigma_s, sigma_t)
    with jax.enable_x64(True):
        args = tuple(jnp.asarray(v) for v in (_table(kind), np.log(sigma_s), np.log(sigma_t), np.log(distance), np.log(values)))
        solution = optimistix.least_squares(
            _residual,
            optimistix.LevenbergMarquardt(rtol=1e-13, atol=1e-13),
            jnp.asarray(start),
            args,
            max_steps=300,
            throw=False,
        )
        residual = np.asarray(_residual(solution.value, args))
        exponents = np.asarray(solution.value)
    return ExponentFit(exponents, float(np.abs(np.expm1(residual)).max()), int(solution.stats["num_steps"]))
