"""Single-scattering responses of point, directional and area emitters by deterministic quadrature (section 4.2).

Scaled forms, free of underflow, for unit intensity I0 = 1, E0 = 1, Le dA = 1:

    point, area:  S = tau e^tau L / (alpha sigma_t^2)         directional:  S = e^tau L / alpha

with alpha = sigma_s / sigma_t and tau = sigma_t d. L are coefficients of the incident radiance about the axis receiver ->
source. Directly attenuated light is kept apart: I0 sigma_t^2 e^-tau / tau^2 (point), E0 e^-tau, Le dA cos+ theta_n
sigma_t^2 e^-tau / tau^2, a delta in the direction of the source.

Phase functions: `g` (Henyey-Greenstein, evaluated directly), or Legendre moments chi_j through the tables M_{l,j}
of `*_moment_table`: S_l = sum_j chi_j M_{l,j}; truncation error about |g|^(J+1).
"""

import jax
import jax.numpy as jnp
import numpy as np
from numpy.polynomial.legendre import legvander

from jaxvol import airlight, harmonics

_sums = jax.jit(airlight.exponential_sums)


def _exponential_sums(tau: np.ndarray, excess: np.ndarray, matrix: np.ndarray) -> np.ndarray:
    """`airlight.exponential_sums` in float64, in slices of tau that keep the temporary under 100 MB."""
    with jax.enable_x64(True):
        step = max(1, int(1e7 // excess.size))
        pad = -tau.size % step if tau.size > step else 0  # equal slices, one compilation
        padded = np.concatenate([tau, np.ones(pad)])
        slices = [padded[i : i + step] for i in range(0, padded.size, step)]
        return np.concatenate([np.asarray(_sums(part, excess, matrix)) for part in slices])[: tau.size]


def _checked(tau) -> np.ndarray:
    tau = np.atleast_1d(np.asarray(tau, dtype=np.float64))
    if not (np.all(np.isfinite(tau)) and np.all(tau >= 0)):
        raise ValueError("tau must be finite and >= 0")
    return tau


def _moment_columns(cosine: np.ndarray, num_moments: int) -> np.ndarray:
    """(2j+1) P_j(cosine), `[nodes, num_moments]`: 4 pi p = sum_j chi_j of these."""
    return (2 * np.arange(num_moments) + 1) * legvander(cosine, num_moments - 1)


def _check_g(g: float) -> None:
    if not -1 < g < 1:
        raise ValueError(f"g = {g} must lie in (-1, 1)")


def point_table(tau, *, order: int = 11, g: float = 0.0, num_nodes: int = 100) -> np.ndarray:
    """S_l(tau) of a point source, once scattered: `[T, order]` (equation (14) as 2 K_l int int P_l 4pi p e^{-tau x}).

    Relative error at most 1e-10 for l <= 10 and any tau >= 0, g = 0; use 160 nodes for |g| = 0.9.
    """
    _check_g(g)
    nodes = airlight.half_angle_nodes(num_nodes)
    weight = 2 * nodes.weight * airlight.henyey_greenstein_4pi(nodes, g)
    matrix = weight[:, None] * legvander(nodes.cos_receiver, order - 1) * harmonics.zonal_norm(order)
    return _exponential_sums(_checked(tau), nodes.excess, matrix)


def point_moment_table(tau, *, order: int = 11, num_moments: int = 16, num_nodes: int = 100) -> np.ndarray:
    """M_{l,j}(tau) of a point source: `[T, order, num_moments]`. Nodes must exceed about twice order + num_moments."""
    nodes = airlight.half_angle_nodes(num_nodes)
    zonal = legvander(nodes.cos_receiver, order - 1) * harmonics.zonal_norm(order)
    columns = (
        2 * nodes.weight[:, None, None] * zonal[:, :, None] * _moment_columns(nodes.cos_deflection, num_moments)[:, None, :]
    )
    table = _exponential_sums(_checked(tau), nodes.excess, columns.reshape(nodes.weight.size, -1))
    return table.reshape(-1, order, num_moments)


def _directional_nodes(num: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """mu, 1 - mu and weights over [-1, 1]: double-exponential on both halves (essential singularity at 0+, peaks at +-1)."""
    x, complement, weight = airlight.double_exponential(num)
    return np.concatenate([x, -x]), np.concatenate([complement, 1 + x]), np.concatenate([weight, weight])


@jax.jit
def _directional_sums(tau, mu, one_minus_mu, matrix):
    factor = airlight.directional_factor(tau[:, None], mu, one_minus_mu)
    return jnp.matmul(factor, matrix, precision="highest")


def _directional(tau, matrix, nodes) -> np.ndarray:
    with jax.enable_x64(True):
        return np.asarray(_directional_sums(_checked(tau), nodes[0], nodes[1], matrix))


def directional_table(tau, *, order: int = 11, g: float = 0.0, num_nodes: int = 160) -> np.ndarray:
    """S_l(tau) of light coming straight down on a half-space, tau below its top: `[T, order]` (equation (15)).

    Reading of the paper: the top is a plane perpendicular to the light through x_top, the medium is unbounded below.
    """
    _check_g(g)
    mu, one_minus_mu, weight = nodes = _directional_nodes(num_nodes)
    square = (1 - g) ** 2 + 2 * g * one_minus_mu if g >= 0 else (1 + g) ** 2 - 2 * g * (1 + mu)
    phase = (1 - g * g) / (square * np.sqrt(square))
    matrix = (weight * phase / 2)[:, None] * legvander(mu, order - 1) * harmonics.zonal_norm(order)
    return _directional(tau, matrix, nodes)


def directional_moment_table(tau, *, order: int = 11, num_moments: int = 16, num_nodes: int = 160) -> np.ndarray:
    """M_{l,j}(tau) of a directional source: `[T, order, num_moments]`."""
    mu, _, weight = nodes = _directional_nodes(num_nodes)
    zonal = legvander(mu, order - 1) * harmonics.zonal_norm(order)
    matrix = (weight / 2)[:, None, None] * zonal[:, :, None] * _moment_columns(mu, num_moments)[:, None, :]
    return _directional(tau, matrix.reshape(mu.size, -1), nodes).reshape(-1, order, num_moments)


def area_moment_table(
    tau, theta_n, *, order: int = 5, num_moments: int = 1, g: float | None = None, num_nodes: int = 70
) -> np.ndarray:
    """S_lm(tau, theta_n) of a Lambertian patch, m >= 0 (half index), by phase moment: `[T, A, half, num_moments]`.

    theta_n in [0, pi]: angle between the patch's normal and the direction from the patch to the receiver; the normal
    leans to +x. At and beyond pi/2 there is no direct light, but there is scattered light (equation (16) drops it).
    Kinks of the clamped cosine are split: error under 1e-7 of L_00, any tau. With `g`, num_moments
    must be 1 and the single column holds that Henyey-Greenstein function.
    """
    tau, theta_n = _checked(tau), np.atleast_1d(np.asarray(theta_n, dtype=np.float64))
    if not np.all((theta_n >= 0) & (theta_n <= np.pi)):
        raise ValueError("theta_n must lie in [0, pi]")
    if g is not None:
        _check_g(g)
    azimuthal = np.array([m for _, m in harmonics.half_index(order)])
    responses = []
    for angle in theta_n:
        nodes = airlight.area_nodes(num_nodes, float(angle))
        emission = airlight.area_emission(nodes, float(angle), order)
        basis = _half_basis(nodes, order)
        if g is None:
            phase = _moment_columns(nodes.cos_deflection, num_moments)
        else:
            phase = airlight.henyey_greenstein_4pi(nodes, g)[:, None]
        columns = (2 * nodes.weight[:, None] * basis * emission[:, azimuthal])[:, :, None] * phase[:, None, :]
        table = _exponential_sums(tau, nodes.excess, columns.reshape(nodes.weight.size, -1))
        responses.append(table.reshape(tau.size, azimuthal.size, -1))
    return np.stack(responses, axis=1)


def _half_basis(nodes: airlight.HalfAngleNodes, order: int) -> np.ndarray:
    polynomials = harmonics.normalised_legendre(nodes.cos_receiver, order)
    return np.stack([polynomials[band, m] * nodes.sin_receiver**m for band, m in harmonics.half_index(order)], axis=-1)


def area_table(tau, theta_n, *, order: int = 5, g: float = 0.0, num_nodes: int = 70) -> np.ndarray:
    """S_lm(tau, theta_n) of a Lambertian patch for one Henyey-Greenstein function: `[T, A, half]`."""
    return area_moment_table(tau, theta_n, order=order, g=g, num_nodes=num_nodes)[..., 0]


def unscale_point(scaled: np.ndarray, tau) -> np.ndarray:
    """L at sigma_t = alpha = 1 from S of a point or area emitter: S e^-tau / tau; tau has shape `[T]`."""
    tau = _checked(tau).reshape((-1,) + (1,) * (np.ndim(scaled) - 1))
    return scaled * np.exp(-tau) / tau
