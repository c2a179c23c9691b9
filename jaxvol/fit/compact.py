"""Chebyshev form of functions on boxes: nodes, transform, evaluation, and least squares with the residual reported.

Two variables serve the tables: ln tau, for the compact 16 x 11 form of ln(tau e^tau L_l) on a range of tau, and tau^(1/4),
in which responses are smooth down to tau = 0 (they start like tau ln tau) and e^{-kappa tau} is a polynomial.
numpy float64.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optimistix
from numpy.polynomial.chebyshev import chebvander


def nodes(num: int, low: float, high: float) -> np.ndarray:
    """Chebyshev points of the first kind on [low, high], decreasing."""
    return (low + high) / 2 + (high - low) / 2 * np.cos(np.pi * (np.arange(num) + 0.5) / num)


def transform(values: np.ndarray, *, axis: int = 0) -> np.ndarray:
    """Chebyshev coefficients along an axis of values at `nodes`."""
    num = values.shape[axis]
    matrix = 2 / num * chebvander(np.cos(np.pi * (np.arange(num) + 0.5) / num), num - 1).T
    matrix[0] /= 2
    return np.moveaxis(np.tensordot(matrix, values, axes=(1, axis)), 0, axis)


def evaluate(coefficients: np.ndarray, x, low: float, high: float, *, axis: int = 0) -> np.ndarray:
    """Values at points x `[n]`, which replace the coefficient axis."""
    position = (2 * np.asarray(x) - low - high) / (high - low)
    basis = chebvander(position, coefficients.shape[axis] - 1)
    return np.moveaxis(np.tensordot(basis, coefficients, axes=(1, axis)), 0, axis)


def to_ratios(response: np.ndarray) -> np.ndarray:
    """(ln L_0, L_1/L_0, ...) along the last axis: ranges over decades without losing relative accuracy."""
    first = response[..., :1]
    return np.concatenate([np.log(first), response[..., 1:] / first], axis=-1)


def from_ratios(form: np.ndarray) -> np.ndarray:
    """Inverse of `to_ratios`."""
    first = np.exp(form[..., :1])
    return np.concatenate([first, form[..., 1:] * first], axis=-1)


class CompactFit(NamedTuple):
    """Coefficients of ln(values) and the relative residual left at the samples."""

    coefficients: np.ndarray  # [num, columns]
    max_residual: float
    rms_residual: float
    num_steps: int


def _residual(coefficients, args):
    basis, target = args
    return jnp.expm1(basis @ coefficients - target)


def fit_log(x: np.ndarray, values: np.ndarray, *, num: int, low: float, high: float) -> CompactFit:
    """Least squares (Levenberg-Marquardt) of exp(Chebyshev) against positive samples `[n, columns]`, relative residuals.

    Raises ValueError for values that are not positive, or fewer samples than coefficients.
    """
    values = np.asarray(values, dtype=np.float64)
    if np.any(values <= 0):
        raise ValueError("fit_log needs positive values")
    if len(x) < num:
        raise ValueError(f"fit_log needs at least {num} samples, got {len(x)}")
    with jax.enable_x64(True):
        basis = jnp.asarray(chebvander((2 * np.asarray(x) - low - high) / (high - low), num - 1))
        target = jnp.log(jnp.asarray(values))
        solver = optimistix.LevenbergMarquardt(rtol=1e-14, atol=1e-14)
        columns, steps = [], 0
        for column in range(values.shape[1]):
            start = jnp.zeros(num).at[0].set(jnp.mean(target[:, column]))
            solution = optimistix.least_squares(
                _residual, solver, start, (basis, target[:, column]), max_steps=200, throw=False
            )
            columns.append(np.asarray(solution.value))
            steps = max(steps, int(solution.stats["num_steps"]))
    coefficients = np.stack(columns, axis=-1)
    residual = np.expm1(np.asarray(basis) @ coefficients - np.log(values))
    return CompactFit(coefficients, float(np.abs(residual).max()), float(np.sqrt(np.mean(residual**2))), steps)
