"""Best axis for a zonal approximation of an area emitter's response (section 4.2, Figure 5).

The response is mirror symmetric about the plane of normal and light (m >= 0, half index); the axis lies in that plane at angle
psi from the direction to the light, psi > 0 toward the side of the patch's normal. For a given axis the best zonal function is
the projection f_l = sqrt(4pi/(2l+1)) sum_m L_lm y_lm(psi).

Three criteria: the optimal linear direction (the dipole's), the L2 fit of the paper, and an L2 fit weighted with the
clamped cosine's bands, which is the one that irradiance sees. Direct light must not be in the fit: its delta would pin
the axis to the light. numpy float64 in and out.
"""

from functools import partial
from math import pi

import jax
import jax.numpy as jnp
import numpy as np
import optimistix

from jaxvol import harmonics

MAX_STEPS = 200


def _order(half: np.ndarray) -> int:
    return round((2 * half.shape[-1]) ** 0.5 - 0.5)


def optimal_linear(half: np.ndarray) -> np.ndarray:
    """psi of the dipole (L_11, L_10), `[*batch]`."""
    half = np.asarray(half, dtype=np.float64)
    return np.arctan2(half[..., 2], half[..., 1])


def _meridian(order: int) -> np.ndarray:
    """y_lm on the meridian as a Fourier series in psi: coefficients of cos k psi, then of sin k psi, `[2 order, half]`.

    One small matrix product instead of the unrolled recursion, which XLA compiles for minutes inside a solver.
    """
    psi = 2 * pi * np.arange(4 * order) / (4 * order)
    polynomials = harmonics.normalised_legendre(np.cos(psi), order)
    values = np.stack([polynomials[band, m] * np.sin(psi) ** m for band, m in harmonics.half_index(order)], axis=-1)
    waves = np.exp(1j * np.outer(np.arange(order), psi)) @ values / (2 * order)
    waves[0] /= 2
    return np.concatenate([waves.real, waves.imag])


def _residual(psi, half, weight, order):
    """Weighted L_lm - sqrt(4pi/(2l+1)) f_l y_lm(psi), a vector over (l, m >= 0)."""
    phases = np.arange(order) * psi
    basis = jnp.concatenate([jnp.cos(phases), jnp.sin(phases)]) @ _meridian(order)
    bands = np.array([band for band, _ in harmonics.half_index(order)])
    zonal = jax.ops.segment_sum(half * basis, bands, num_segments=order)  # without its factor sqrt(4pi/(2l+1))
    scale = (harmonics.rotation_norm(order) ** 2)[bands]
    return weight * (half - scale * zonal[bands] * basis)


def _weights(order: int, criterion: str) -> np.ndarray:
    if criterion == "l2":
        return np.ones(harmonics.num_half(order))
    if criterion == "irradiance":
        cosine = np.abs(harmonics.clamped_cosine(order)) * harmonics.rotation_norm(order)
        return cosine[[band for band, _ in harmonics.half_index(order)]]
    raise ValueError(f"criterion {criterion!r} must be 'l2' or 'irradiance'")


@partial(jax.jit, static_argnums=3)
def _levenberg_marquardt(half, start, weight, order):
    def solve(one, guess):
        solution = optimistix.least_squares(
            lambda psi, args: _residual(psi, args, weight, order) / jnp.linalg.norm(args),
            optimistix.LevenbergMarquardt(rtol=1e-10, atol=1e-10),
            guess,
            one,
            max_steps=MAX_STEPS,
            throw=False,
        )
        return solution.value, solution.result == optimistix.RESULTS.successful

    return jax.vmap(solve)(half, start)


@partial(jax.jit, static_argnums=4)
def _golden(half, lower, upper, weight, order):
    # optimistix 0.1.0: GoldenSearch places its middle point as if lower were 0, so it searches in psi - lower.
    def solve(one, low, high):
        solution = optimistix.minimise(
            lambda z, args: jnp.sum(_residual(z + low, args, weight, order) ** 2) / jnp.sum(args**2),
            optimistix.GoldenSearch(rtol=1e-9, atol=1e-9),
            (high - low) / 2,
            one,
            options={"lower": jnp.zeros(()), "upper": high - low},
            max_steps=MAX_STEPS,
            throw=False,
        )
        return solution.value + low

    return jax.vmap(solve)(half, lower, upper)


def fit(half: np.ndarray, *, criterion: str = "l2") -> np.ndarray:
    """psi that minimises the weighted squared residual, `[*batch]`, by Levenberg-Marquardt from half the dipole's angle.

    Raises ValueError for an unknown criterion, RuntimeError where the solver does not converge.
    """
    half = np.asarray(half, dtype=np.float64)
    order = _order(half)
    weight = _weights(order, criterion)
    flat = half.reshape(-1, half.shape[-1])
    with jax.enable_x64(True):
        psi, good = _levenberg_marquardt(flat, 0.5 * optimal_linear(flat), weight, order)
    if not np.all(good):
        raise RuntimeError(f"{np.sum(~np.asarray(good))} of {flat.shape[0]} axis fits did not converge in {MAX_STEPS} steps")
    return np.asarray(psi, dtype=np.float64).reshape(half.shape[:-1])


def golden_search(half: np.ndarray, *, lower: float = -0.1, upper: float = pi / 2, criterion: str = "l2") -> np.ndarray:
    """The same minimum by golden-section search on [lower, upper], as a check (the paper uses Brent's method)."""
    half = np.asarray(half, dtype=np.float64)
    order = _order(half)
    flat = half.reshape(-1, half.shape[-1])
    ends = [np.full(flat.shape[0], value) for value in (lower, upper)]
    with jax.enable_x64(True):
        psi = _golden(flat, *ends, _weights(order, criterion), order)
    return np.asarray(psi, dtype=np.float64).reshape(half.shape[:-1])


def project(half: np.ndarray, psi: np.ndarray) -> np.ndarray:
    """Zonal coefficients f_l about the axis psi: `[*batch, order]`."""
    half, psi = np.asarray(half, dtype=np.float64), np.asarray(psi, dtype=np.float64)
    order = _order(half)
    polynomials = harmonics.normalised_legendre(np.cos(psi), order)
    zonal = np.zeros((*psi.shape, order))
    for index, (band, m) in enumerate(harmonics.half_index(order)):
        zonal[..., band] += half[..., index] * polynomials[band, m] * np.sin(psi) ** m
    return zonal * harmonics.rotation_norm(order)


def reconstruct(zonal: np.ndarray, psi: np.ndarray) -> np.ndarray:
    """Half-index coefficients of a zonal function about the axis psi."""
    order = zonal.shape[-1]
    polynomials = harmonics.normalised_legendre(np.cos(psi), order)
    norm = harmonics.rotation_norm(order)
    terms = [zonal[..., band] * norm[band] * polynomials[band, m] * np.sin(psi) ** m for band, m in harmonics.half_index(order)]
    return np.stack(terms, axis=-1)


def errors(half: np.ndarray, approximation: np.ndarray, *, num_normals: int = 181) -> tuple[np.ndarray, np.ndarray]:
    """(L2 error, largest irradiance error over normals in the plane and off it) of an approximation, relative to the response.

    Irradiance is compared with the largest irradiance over normals. Missing bands of the approximation count as zero.
    """
    half = np.asarray(half, dtype=np.float64)
    padded = np.zeros_like(half)
    padded[..., : approximation.shape[-1]] = approximation
    difference = half - padded
    l2 = np.linalg.norm(difference, axis=-1) / np.linalg.norm(half, axis=-1)
    order = _order(half)
    theta = np.linspace(0, 2 * pi, num_normals)
    normals = [(np.sin(theta) * np.cos(tilt), np.sin(theta) * np.sin(tilt), np.cos(theta)) for tilt in (0, 0.5, 1.0, pi / 2)]
    with jax.enable_x64(True):
        lobe = harmonics.rotate_zonal(
            jnp.asarray(harmonics.clamped_cosine(order)), jnp.asarray(np.concatenate([np.stack(n, axis=-1) for n in normals]))
        )
    index = [band * (band + 1) + m for band, m in harmonics.half_index(order)]
    lobe = np.asarray(lobe)[:, index]
    irradiance, wrong = half @ lobe.T, difference @ lobe.T
    return l2, np.abs(wrong).max(axis=-1) / np.abs(irradiance).max(axis=-1)
