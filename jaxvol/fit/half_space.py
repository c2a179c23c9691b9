"""Multiple scattering of light that comes straight down on a half-space, any phase function, by discrete ordinates.

The medium fills z > 0 below the top, sigma_t = 1, light travels along +z (mu = 1), irradiance 1 on the top. On 2N directions
+-mu_i radiance solves a linear system in z with constant coefficients: a sum of N decaying exponentials e^{-lambda z} and
the beam's e^{-z}. Its source function is then gathered exactly along every direction, which removes the directions'
discretisation from the result but for that of the source (`tests/fit/test_half_space.py`: H function to 1e-7).

Single bounces are the Taylor coefficients in the albedo of the sum, by the trapezoidal rule on a circle.
"""

from math import pi

import numpy as np
from numpy.polynomial.legendre import leggauss, legvander
from scipy.linalg import eigh

from jaxvol import airlight, harmonics

NUM_STREAMS = 48  # directions per hemisphere; |g| = 0.9 needs 96


def streams_for(moments: np.ndarray) -> int:
    """Directions that resolve a phase function: as many as it has moments, between 48 and 128."""
    return int(np.clip(np.size(moments), NUM_STREAMS, 128))


def _directions(num: int) -> tuple[np.ndarray, np.ndarray]:
    """mu on (0, 1) and weights: Gauss-Legendre in sqrt(mu), because radiance near the horizon goes like mu ln mu."""
    x, weight = leggauss(num)
    x = (x + 1) / 2
    return x * x, weight * x


def source_function(albedo: complex, moments: np.ndarray, *, num_streams: int = NUM_STREAMS):
    """Decay rates `[N+1]` and S_j `[J, N+1]`: source of light scattered at least twice, over albedo^2.

    S(z, mu) = sum_j P_j(mu) sum_i S_j,i e^{-rate_i z}; the last rate is the beam's, 1. Also returns the fluence of light
    scattered at least once, over albedo, as coefficients of the same exponentials.
    """
    mu, weight = _directions(num_streams)
    moments = np.asarray(moments, dtype=np.float64)[:num_streams]  # more cannot be told apart by these directions
    band = np.arange(moments.size)
    polynomials = legvander(mu, moments.size - 1)
    strength = (2 * band + 1) * moments
    even, odd = band % 2 == 0, band % 2 == 1

    def scatter(parity):
        p = polynomials[:, parity]
        return (p * strength[parity]) @ (p * weight[:, None]).T

    identity = np.eye(num_streams)
    loss_even, loss_odd = identity - albedo * scatter(even), identity - albedo * scatter(odd)
    # -rate mu even = -loss_odd odd and -rate mu odd = -loss_even even. Eigenvalues of the inverse, 1/rate^2, because the
    # slow modes matter and would drown in rounding beside the fast ones (1/mu^2 up to 1e12).
    odd_from_even = np.linalg.solve(loss_odd, np.diag(mu))
    if isinstance(albedo, complex):
        square, even_modes = np.linalg.eig(np.linalg.solve(loss_even, mu[:, None] * odd_from_even))
    else:  # with weights on both sides both matrices are symmetric and positive
        root = np.sqrt(weight)
        square, even_modes = eigh(*(_symmetric(root[:, None] * v / root) for v in (mu[:, None] * odd_from_even, loss_even)))
        even_modes = even_modes / root[:, None]
    fastest = mu.min() ** 2 / 2  # no mode decays faster; rounding says otherwise of the last few
    square = np.where(square.real < fastest, fastest, square)
    rate = 1 / np.sqrt(square)
    odd_modes = rate * (odd_from_even @ even_modes)
    beam = [(polynomials[:, parity] @ strength[parity]) / (4 * pi) for parity in (odd, even)]
    system = np.block([[-np.diag(mu), loss_odd], [loss_even, -np.diag(mu)]])
    beam_even, beam_odd = np.split(np.linalg.solve(system, np.concatenate(beam)), 2)
    amplitude = np.linalg.solve(even_modes + odd_modes, -(beam_even + beam_odd))
    even_part = np.concatenate([even_modes * amplitude, beam_even[:, None]], axis=1)
    odd_part = np.concatenate([odd_modes * amplitude, beam_odd[:, None]], axis=1)
    projection = (polynomials * weight[:, None]).T
    radiance = np.where(even[:, None], projection @ even_part, projection @ odd_part)
    return np.append(rate, 1.0), strength[:, None] * radiance, 4 * pi * radiance[0]


def _symmetric(matrix: np.ndarray) -> np.ndarray:
    return (matrix + matrix.T) / 2


def _gather(tau: np.ndarray, rate: np.ndarray, mu: np.ndarray) -> np.ndarray:
    """Radiance at depth tau, travelling along mu, of the source e^{-rate z}: `[T, mu, rates]`."""
    t, m, r = tau[:, None, None], mu[:, None], rate
    down = m > 0
    cosine = np.abs(m)
    gap = 1 - r * cosine
    x = t * gap / cosine
    slow = gap.real > 0
    safe = np.where(np.abs(x) < 1e-8, 1, gap)
    decayed = np.where(slow, np.exp(-r * t), np.exp(-t / cosine))
    growth = -np.expm1(-np.where(slow, x, -x)) * np.where(slow, 1, -1)
    descending = np.where(np.abs(x) < 1e-8, np.exp(-r * t) * t / cosine, decayed * growth / safe)
    return np.where(down, descending, np.exp(-r * t) / (1 + r * cosine))


def directional_table(
    tau, *, moments: np.ndarray, albedo: complex, order: int = 11, num_streams: int = NUM_STREAMS, num_nodes: int = 100
) -> np.ndarray:
    """L_l(tau) / albedo^2 of light scattered at least twice, E0 = 1: `[T, order]`. |albedo| < 1, tau >= 0."""
    tau = np.atleast_1d(np.asarray(tau, dtype=np.float64))
    if not abs(albedo) < 1:
        raise ValueError(f"albedo = {albedo} must lie in [0, 1)")
    rate, source, _ = source_function(albedo, moments, num_streams=num_streams)
    x, _, weight = airlight.double_exponential(num_nodes)
    mu, weight = np.concatenate([x, -x]), np.concatenate([weight, weight])
    source_at = legvander(mu, source.shape[0] - 1) @ source
    zonal = 2 * pi * harmonics.zonal_norm(order) * legvander(mu, order - 1) * weight[:, None]
    with np.errstate(over="ignore", under="ignore", invalid="ignore"):
        radiance = np.einsum("tmr,mr->tm", _gather(tau, rate, mu), source_at)
    table = radiance @ zonal
    return table


def bounce_tables(tau, *, moments: np.ndarray, num_bounces: int, order: int = 11, num_streams: int = NUM_STREAMS) -> np.ndarray:
    """L_l(tau) of light scattered exactly n times, n = 2..num_bounces, albedo 1: `[bounces - 1, T, order]`.

    Radius 0.6, 64 points: aliasing error 0.6^64 = 6e-15 of the response, rounding times 0.6^-n.
    """
    radius, count = 0.6, 64
    angle = 2 * pi * np.arange(count // 2 + 1) / count
    points = radius * np.exp(1j * angle)
    values = np.stack([directional_table(tau, moments=moments, albedo=p, order=order, num_streams=num_streams) for p in points])
    coefficients = np.fft.irfft(values.conj(), n=count, axis=0)
    return coefficients[: num_bounces - 1] / radius ** np.arange(num_bounces - 1)[:, None, None]
