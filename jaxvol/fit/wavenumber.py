"""Multiple scattering around point and area emitters in an infinite medium, any phase function, wavenumber by wavenumber.

For one spatial frequency k and azimuthal order m about it, radiance is a vector psi_l over bands and transport is a
symmetric tridiagonal system (mu Y_l = b_l Y_{l-1} + b_{l+1} Y_{l+1}, b_l^2 = (l^2 - m^2)/(4 l^2 - 1), sigma_t = 1):

    (1 - alpha chi_l) psi_l + i k (b_l psi_{l-1} + b_{l+1} psi_{l+1}) = Q_l,        T = the same with alpha = 0.

Light scattered exactly n times is (T^-1 alpha X)^n T^-1 Q, light scattered n times or more (T - alpha X)^-1 (alpha X T^-1)^n Q,
X = diag(chi). Bands beyond the last moment are not truncated: their elimination is a continued fraction (`_tails`). So the
only approximation is the number of moments. Back in space, with the source emitting y_{k'm} about the axis source ->
receiver,

    R_{l k' m}(r) = 1/(2 pi^2) sum_L sum_m' W^L int k^2 i^L j_L(k r) A^{m'}_{l k'}(k) dk,
    W^L = (2L+1)/2 int d^l_{m m'}(beta) d^{k'}_{m m'}(beta) P_L(cos beta) sin beta dbeta,

which for a point source (k' = 0) is a Hankel transform of order l. The integral is bent into the complex plane, where it
neither oscillates nor cancels (`_paths`), so coefficients are accurate relative to themselves at any radius.

This replaces both the bounce-by-bounce Monte Carlo of Dubouchet et al. 2019, section 5.1, and its similarity mapping; area
emitters enter through the moments of their emission ("source moments").
"""

from math import pi, sqrt

import numpy as np
from numpy.polynomial.legendre import leggauss, legvander
from scipy.special import spherical_jn

MAX_MOMENTS = 256
_TAIL = 900  # levels of the backward continued fraction; enough for |k| < 50


def effective_moments(g: float, *, tolerance: float = 1e-12) -> np.ndarray:
    """Henyey-Greenstein moments g^j, j < J, with |g|^J <= tolerance and J <= 256."""
    if not -1 < g < 1:
        raise ValueError(f"g = {g} must lie in (-1, 1)")
    num = 1 if g == 0 else int(np.ceil(np.log(tolerance) / np.log(abs(g))))
    return float(g) ** np.arange(np.clip(num, 1, MAX_MOMENTS))


def _coupling(band: int, m: int) -> float:
    """b_l^2."""
    return (band * band - m * m) / (4 * band * band - 1)


def _tails(k: np.ndarray, m: int, last: int) -> np.ndarray:
    """F_last(k): the corner of the inverse of T restricted to bands >= last; F_l = 1 / (1 + k^2 b_{l+1}^2 F_{l+1}).

    Backward where that converges fast; for large |k| forward from F_m = int Y_mm^2 / (1 + i k mu), known in closed form.
    """
    tail = np.empty_like(k)
    small = np.abs(k) < 50
    square = k[small] ** 2
    value = 2 / (1 + np.sqrt(1 + square))
    for band in range(last + _TAIL, last, -1):
        value = 1 / (1 + square * _coupling(band, m) * value)
    tail[small] = value
    square = k[~small] ** 2
    value = np.arctan(k[~small]) / k[~small]
    for order in range(m):
        value = ((1 + 1 / square) * value - 1 / square) * (2 * order + 3) / (2 * order + 2)
    for band in range(m + 1, last + 1):
        value = (1 / value - 1) / (square * _coupling(band, m))
    tail[~small] = value
    return tail


def _solve(k: np.ndarray, m: int, diagonal: np.ndarray, tail: np.ndarray, source: np.ndarray) -> np.ndarray:
    """psi_l, l = m..m+N-1, of the tridiagonal system; `source` `[N, columns, nodes]`, `diagonal` `[N]`, `tail` = F_{m+N}."""
    num = diagonal.size
    square = k * k
    pivots = np.empty((num, k.size), dtype=complex)
    pivots[-1] = diagonal[-1] + square * _coupling(m + num, m) * tail
    ratios = np.empty_like(pivots)  # -i k b / pivot
    reduced = source.astype(complex)
    for index in range(num - 2, -1, -1):  # eliminate from the highest band down
        link = 1j * k * sqrt(_coupling(m + index + 1, m))
        ratios[index + 1] = -link / pivots[index + 1]
        pivots[index] = diagonal[index] + link * ratios[index + 1]
        reduced[index] += ratios[index + 1] * reduced[index + 1]
    psi = np.empty_like(reduced)
    psi[0] = reduced[0] / pivots[0]
    for index in range(1, num):
        psi[index] = reduced[index] / pivots[index] + ratios[index] * psi[index - 1]
    return psi


def _amplitudes(k, m, moments, albedo, source_bands, order, first, last) -> np.ndarray:
    """A^m_{l k'}(k): `[order, sources, nodes]`, zero below m; bounces first..last (None = all) over albedo^first."""
    bands = max(moments.size, order, max(source_bands) + 1, m + 1) - m
    chi = np.zeros(bands)
    chi[: max(moments.size - m, 0)] = moments[m:]
    tail = _tails(k, m, m + bands)
    source = np.zeros((bands, len(source_bands), k.size), dtype=complex)
    for column, band in enumerate(source_bands):
        if band >= m:
            source[band - m, column] = 1
    free = np.ones(bands)
    psi = _solve(k, m, free, tail, source)
    for _ in range(first - 1):
        psi = _solve(k, m, free, tail, chi[:, None, None] * psi)
    if last is None:
        total = _solve(k, m, 1 - albedo * chi, tail, chi[:, None, None] * psi)
    else:
        total = 0
        for bounce in range(first, last + 1):
            psi = _solve(k, m, free, tail, chi[:, None, None] * psi)
            total = total + albedo ** (bounce - first) * psi
    amplitudes = np.zeros((order, len(source_bands), k.size), dtype=complex)
    count = min(order - m, bands)
    amplitudes[m : m + count] = total[:count]
    return amplitudes


def diffusion_roots(moments: np.ndarray, albedo: np.ndarray) -> np.ndarray:
    """kappa_0 of many media at once; `moments` `[*batch, J]`, `albedo` `[*batch]`. See `diffusion_root`."""
    moments, albedo = np.asarray(moments, dtype=np.float64), np.asarray(albedo, dtype=np.float64)
    bands = moments.shape[-1]

    def definite(kappa: np.ndarray) -> np.ndarray:  # all pivots positive, from the highest band down
        square = kappa * kappa
        value = 2 / (1 + np.sqrt(1 - square))
        for band in range(bands + _TAIL, bands, -1):
            value = 1 / (1 - square * _coupling(band, 0) * value)
        positive = np.full(kappa.shape, True)
        for band in range(bands - 1, -1, -1):
            pivot = 1 - albedo * moments[..., band] - square * _coupling(band + 1, 0) * value
            positive &= pivot > 0
            value = 1 / np.where(positive, pivot, 1)
        return positive

    low, high = np.zeros(albedo.shape), np.full(albedo.shape, 1 - 1e-12)
    none = definite(high)
    for _ in range(48):
        middle = (low + high) / 2
        inside = definite(middle)
        low, high = np.where(inside, middle, low), np.where(inside, high, middle)
    return np.where(none, 1.0, low)


def diffusion_root(moments: np.ndarray, albedo: float) -> float:
    """kappa_0: the smallest kappa in (0, 1] at which the transport operator at k = i kappa is singular (m = 0); 1 if none."""
    return float(diffusion_roots(np.asarray(moments)[None], np.array([albedo]))[0])


def _wigner(degree: int, beta: np.ndarray) -> np.ndarray:
    """d^l_{m m'}(beta), `[beta, 2l+1, 2l+1]`, by the eigenvectors of J_y."""
    m = np.arange(-degree, degree)
    ladder = np.sqrt(degree * (degree + 1) - m * (m + 1))
    raising = np.diag(ladder, -1)
    value, vector = np.linalg.eigh((raising - raising.T) / 2j)
    phases = np.exp(-1j * beta[:, None] * value)
    return np.einsum("ij,bj,kj->bik", vector, phases, vector.conj()).real


def _weights(order: int, source_bands: tuple[int, ...]) -> dict:
    """W^L summed over +-m': {(l, k', m): [(L, m', weight)]}."""
    mu, weight = leggauss(order + max(source_bands) + 2)
    beta = np.arccos(mu)
    rotations = {degree: _wigner(degree, beta) for degree in {*range(order), *source_bands}}
    polynomials = legvander(mu, order - 1 + max(source_bands))
    table = {}
    for band in range(order):
        for column, source in enumerate(source_bands):
            for m in range(min(band, source) + 1):
                terms = []
                for inner in range(min(band, source) + 1):
                    total = 0
                    for sign in {inner, -inner}:
                        a = rotations[band][:, band + m, band + sign]
                        total = total + a * rotations[source][:, source + m, source + sign]
                    for rank in range(abs(band - source), band + source + 1, 2):
                        value = (2 * rank + 1) / 2 * np.sum(weight * total * polynomials[:, rank])
                        if abs(value) > 1e-14:
                            terms.append((rank, inner, value))
                table[band, column, m] = terms
    return table


def _hankel(max_rank: int, z: np.ndarray) -> list[np.ndarray]:
    """Spherical Hankel functions h^(1)_0..h^(1)_max, by the upward recursion (they grow with the rank: stable)."""
    wave = np.exp(1j * z)
    values = [-1j * wave / z, -wave * (z + 1j) / z**2]
    for rank in range(1, max_rank):
        values.append((2 * rank + 1) / z * values[-1] - values[-2])
    return values[: max_rank + 1]


def _panels(edges: np.ndarray, num: int) -> tuple[np.ndarray, np.ndarray]:
    """Gauss-Legendre nodes and weights on consecutive panels."""
    node, weight = leggauss(num)
    half = np.diff(edges)[:, None] / 2
    return (edges[:-1, None] + half * (1 + node)).ravel(), (half * weight).ravel()


def _paths(tau: np.ndarray, kappa: float):
    """Groups of radii with their integration paths: (indices, k, weights, is_real).

    Radii above 4: from i a upward at 45 degrees, a just below the lowest singularity, so that e^{-a r} is factored out.
    Smaller radii: along the real axis to k1, a power of 4 near 16 / r, with j_L, then straight up with h_L, which decays
    there. All radii share the real axis; its nodes below k1 resolve the pole at i kappa.
    """
    groups = []
    far = np.flatnonzero(tau > 4)
    if far.size:
        gap = 0.2 * kappa
        reach = 40 / (sqrt(0.5) * tau[far].min())
        edges = np.concatenate([[0.0], gap * 2.0 ** np.arange(np.ceil(np.log2(reach / gap)) + 1)])
        t, weight = _panels(edges, 20)
        slope = np.exp(0.25j * pi)
        groups.append((far, 1j * 0.8 * kappa + slope * t, slope * weight))
    near = np.flatnonzero(tau <= 4)
    exponent = 2 * np.round(np.log2(16 / tau[near]) / 2).astype(int)
    t, t_weight = _panels(np.array([0.0, 1, 3, 8, 18, 40]), 14)
    for step in np.unique(exponent):
        radii = near[exponent == step]
        corner, scale = 2.0**step, 2.0**step / 16
        groups.append((radii, corner + 1j * scale * t, 1j * scale * t_weight))
    if near.size:
        start = min(-4, int(np.floor(np.log2(0.25 * kappa))))
        edges = np.concatenate([[0.0], 2.0 ** np.arange(start, exponent.max() + 1)])
        real = _panels(edges, 32)
        limits = 2.0**exponent
    else:
        real, limits = (np.empty(0), np.empty(0)), np.empty(0)
    return groups, near, real, limits


def moment_responses(
    tau,
    *,
    moments: np.ndarray,
    albedo: float,
    source_bands: tuple[int, ...] = (0,),
    order: int = 11,
    first: int = 2,
    last: int | None = None,
    kappa: float | None = None,
) -> np.ndarray:
    """R_{l k' m}(tau) / albedo^first: response of receiver band l to source emission y_{k'm}, `[T, order, sources, M]`.

    Bounces first..last (n = number of scatterings), last = None for the infinite sum; sigma_t = 1. Bands l describe the
    incident radiance as a function of the direction toward the light, axis receiver -> source; sources emit y_{k'm} about the
    axis source -> receiver; m >= 0, M = max m + 1; both frames share x. albedo in [0, 1), or <= 1 where last is given.
    kappa = the infinite sum's `diffusion_root` where the caller knows it already.
    """
    tau = np.atleast_1d(np.asarray(tau, dtype=np.float64))
    if not np.all(tau > 0):
        raise ValueError("tau must be > 0")
    if first < 1 or (last is not None and last < first):
        raise ValueError(f"bounces {first}..{last} must satisfy 1 <= first <= last")
    if not 0 <= albedo < 1 and not (albedo == 1 and last is not None):
        raise ValueError(f"albedo = {albedo} must lie in [0, 1) for the infinite sum, [0, 1] for single bounces")
    moments = np.asarray(moments, dtype=np.float64)
    if last is not None or albedo == 0:
        kappa = 1.0  # single bounces have no poles
    elif kappa is None:
        kappa = diffusion_root(moments, albedo)
    groups, near, (real, real_weight), limits = _paths(tau, kappa)
    weights = _weights(order, source_bands)
    num_azimuthal = min(order - 1, max(source_bands)) + 1
    scattered_azimuthal = min(num_azimuthal, moments.size)  # chi_m = 0 beyond: nothing scatters there
    k = np.concatenate([real.astype(complex), *(group[1] for group in groups)])
    amplitudes = [_amplitudes(k, m, moments, albedo, source_bands, order, first, last) for m in range(scattered_azimuthal)]
    response = np.zeros((tau.size, order, len(source_bands), num_azimuthal))

    def add(radii, wave, part, weight, inside):
        factor = weight * k[part] ** 2
        for (band, column, m), terms in weights.items():
            by_rank = {}
            for rank, inner, value in terms:
                if inner < scattered_azimuthal:
                    by_rank[rank] = by_rank.get(rank, 0) + value * amplitudes[inner][band, column, part]
            for rank, amplitude in by_rank.items():
                integrand = (1j**rank * factor * amplitude) * wave[rank]
                response[radii, band, column, m] += np.where(inside, integrand, 0).real.sum(axis=1) / (2 * pi**2) * (-1) ** m

    max_rank = order - 1 + max(source_bands)
    if near.size:
        part = slice(0, real.size)
        wave = [spherical_jn(rank, np.outer(tau[near], real)) for rank in range(max_rank + 1)]
        add(near, wave, part, real_weight, real < limits[:, None])
    start = real.size
    for radii, nodes, weight in groups:
        part = slice(start, start + nodes.size)
        add(radii, _hankel(max_rank, np.outer(tau[radii], nodes)), part, weight, True)
        start += nodes.size
    return response


def point_table(
    tau,
    *,
    moments: np.ndarray,
    albedo: float,
    order: int = 11,
    first: int = 2,
    last: int | None = None,
    kappa: float | None = None,
) -> np.ndarray:
    """L_l(tau) / albedo^first of a point source of intensity 1, bounces first..last: `[T, order]`, sigma_t = 1."""
    response = moment_responses(tau, moments=moments, albedo=albedo, order=order, first=first, last=last, kappa=kappa)
    return sqrt(4 * pi) * response[:, :, 0, 0]
