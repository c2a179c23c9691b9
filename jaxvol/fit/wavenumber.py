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

from functools import cache
from math import pi, sqrt

import numpy as np
from numpy.polynomial.legendre import leggauss, legvander
from scipy.special import spherical_jn

MAX_MOMENTS = 256
_CHUNK = 2048  # nodes at a time: fewer do not keep two threads busy, more do not fit the cache
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


def _solve(
    k: np.ndarray, m: int, diagonal: np.ndarray, tail: np.ndarray, source: np.ndarray, *, keep: int | None = None
) -> np.ndarray:
    """psi_l, l = m..m+keep-1, of the tridiagonal system, `[keep, columns, media, nodes]` (keep None: all N).

    `source` `[N, columns, 1, nodes]`, `diagonal` `[N, media, nodes]` (1 where shared), `tail` = F_{m+N} `[nodes]`.
    """
    num = diagonal.shape[0]
    keep = num if keep is None else min(keep, num)
    square = k * k
    pivots, ratios, reduced = {}, {}, {}  # ratio = -i k b / pivot; only what the way back up needs is kept
    pivot = diagonal[-1] + square * (_coupling(m + num, m) * tail)
    value = source[-1]
    for index in range(num - 1, -1, -1):  # eliminate from the highest band down
        if index < num - 1:
            link = 1j * sqrt(_coupling(m + index + 1, m)) * k
            ratio = -link / pivot
            pivot = diagonal[index] + link * ratio
            value = source[index] + ratio * value
            if index + 1 < keep:
                ratios[index + 1] = ratio
        if index < keep:
            pivots[index], reduced[index] = pivot, value
    psi = [reduced[0] / pivots[0]]
    for index in range(1, keep):
        psi.append(reduced[index] / pivots[index] + ratios[index] * psi[-1])
    return np.stack(psi)


def _amplitudes(k, m, moments, albedo, source_bands, order, first, last) -> np.ndarray:
    """A^m_{l k'}(k): `[order, sources, media, nodes]`, zero below m; bounces first..last (None = all) over albedo^first.

    `albedo` is `[media, 1]` (every medium at every node) or `[1, nodes]` (each node has its own).
    """
    bands = max(moments.size, order, max(source_bands) + 1, m + 1) - m
    chi = np.zeros((bands, 1, 1, 1))
    chi[: max(moments.size - m, 0), 0, 0, 0] = moments[m:]
    keep = min(order - m, bands)
    amplitudes = np.zeros((order, len(source_bands), *np.broadcast_shapes(albedo.shape, (1, k.size))), dtype=complex)
    for start in range(0, k.size, _CHUNK):
        part = slice(start, start + _CHUNK)
        nodes = k[part]
        loss = albedo if albedo.shape[1] == 1 else albedo[:, part]
        tail = _tails(nodes, m, m + bands)
        source = np.zeros((bands, len(source_bands), 1, 1))
        for column, band in enumerate(source_bands):
            if band >= m:
                source[band - m, column] = 1
        free = np.ones((bands, 1, 1))
        psi = _solve(nodes, m, free, tail, source)
        for _ in range(first - 1):
            psi = _solve(nodes, m, free, tail, chi * psi)
        if last is None:
            total = _solve(nodes, m, 1 - loss * chi[:, 0], tail, chi * psi, keep=keep)
        else:
            total = 0
            for bounce in range(first, last + 1):
                psi = _solve(nodes, m, free, tail, chi * psi)
                total = total + loss ** (bounce - first) * psi[:keep]
        amplitudes[m : m + keep, ..., part] = total
    return amplitudes


def diffusion_roots(moments: np.ndarray, albedo: np.ndarray, *, num_steps: int = 48) -> np.ndarray:
    """kappa_0 of many media at once; `moments` `[*batch, J]`, `albedo` `[*batch]`. See `diffusion_root`.

    By bisection, from below: low by at most 2^-num_steps.
    """
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
    for _ in range(num_steps):
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


@cache
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


def _near_paths(tau: np.ndarray, kappa: float):
    """Paths for radii up to 4, shared by all media whose root is at least kappa: (real axis, vertical groups).

    Along the real axis to k1, a power of 4 near 16 / r, with j_L, then straight up with h_L, which decays there. All radii
    share the real axis (nodes, weights, ends `[T]`); its nodes below k1 resolve the pole at i kappa. Groups are
    (radii, nodes, weights).
    """
    exponent = 2 * np.round(np.log2(16 / tau) / 2).astype(int)
    t, t_weight = _panels(np.array([0.0, 1, 3, 8, 18, 40]), 14)
    groups = []
    for step in np.unique(exponent):
        corner, scale = 2.0**step, 2.0**step / 16
        groups.append((np.flatnonzero(exponent == step), corner + 1j * scale * t, 1j * scale * t_weight))
    start = min(-4, int(np.floor(np.log2(0.25 * kappa))))
    edges = np.concatenate([[0.0], 2.0 ** np.arange(start, exponent.max() + 1)])
    return (*_panels(edges, 32), 2.0**exponent), groups


def _far_path(tau: np.ndarray, kappa: float) -> tuple[np.ndarray, np.ndarray]:
    """Nodes and weights for radii above 4: from i a upward at 45 degrees, a just below the lowest singularity.

    So e^{-a r} is factored out.
    """
    gap = 0.2 * kappa
    reach = 40 / (sqrt(0.5) * tau.min())
    edges = np.concatenate([[0.0], gap * 2.0 ** np.arange(np.ceil(np.log2(reach / gap)) + 1)])
    t, weight = _panels(edges, 20)
    slope = np.exp(0.25j * pi)
    return 1j * 0.8 * kappa + slope * t, slope * weight


class _Sum:
    """Adds up sum over nodes of k^2 i^L j_L(k r) A(k), for every (L, m', l, k') that the response needs."""

    def __init__(self, weights: dict, source_bands: tuple[int, ...], num_azimuthal: int, shape: tuple[int, ...]):
        pairs = {}
        for (band, column, _), terms in weights.items():
            for rank, inner, _ in terms:
                if inner < num_azimuthal:
                    pairs.setdefault((rank, inner), {})[band, column] = None
        self.pairs = {key: list(value) for key, value in pairs.items()}
        self.values = {(*key, *pair): np.zeros(shape) for key, found in self.pairs.items() for pair in found}

    def add(self, radii, media, waves, factor, amplitudes) -> None:
        """`waves[L]` `[R, nodes]`, `factor` `[nodes]` or `[R, nodes]`, `amplitudes[m']` `[order, sources, C, nodes]`."""
        where = np.ix_(media, radii)
        for (rank, inner), pairs in self.pairs.items():
            bands, columns = zip(*pairs, strict=True)
            chosen = amplitudes[inner][list(bands), list(columns)]
            sums = (1j**rank * (chosen @ (waves[rank] * factor).T)).real  # [pairs, C, R]
            for pair, value in zip(pairs, sums, strict=True):
                self.values[(rank, inner, *pair)][where] += value


def moment_responses(
    tau,
    *,
    moments: np.ndarray,
    albedo,
    source_bands: tuple[int, ...] = (0,),
    order: int = 11,
    first: int = 2,
    last: int | None = None,
    kappa=None,
) -> np.ndarray:
    """R_{l k' m}(tau) / albedo^first: response of receiver band l to source emission y_{k'm}, `[*media, T, order, sources, M]`.

    Bounces first..last (n = number of scatterings), last = None for the infinite sum; sigma_t = 1. Bands l describe the
    incident radiance as a function of the direction toward the light, axis receiver -> source; sources emit y_{k'm} about the
    axis source -> receiver; m >= 0, M = max m + 1; both frames share x. albedo in [0, 1), or <= 1 where last is given: a number
    or a vector, one entry per medium (media share moments and most of the work).
    kappa = the infinite sum's `diffusion_roots` where the caller knows them already, shaped like albedo.
    """
    tau = np.atleast_1d(np.asarray(tau, dtype=np.float64))
    if not np.all(tau > 0):
        raise ValueError("tau must be > 0")
    if first < 1 or (last is not None and last < first):
        raise ValueError(f"bounces {first}..{last} must satisfy 1 <= first <= last")
    scalar = np.ndim(albedo) == 0
    albedo = np.atleast_1d(np.asarray(albedo, dtype=np.float64))
    for value in albedo:
        if not 0 <= value < 1 and not (value == 1 and last is not None):
            raise ValueError(f"albedo = {value} must lie in [0, 1) for the infinite sum, [0, 1] for single bounces")
    moments = np.asarray(moments, dtype=np.float64)
    if last is not None:
        kappa = np.ones(albedo.size)  # single bounces have no poles
    elif kappa is None:
        kappa = diffusion_roots(np.broadcast_to(moments, (albedo.size, moments.size)), albedo)
    kappa = np.where(albedo == 0, 1.0, np.atleast_1d(kappa))
    weights = _weights(order, source_bands)
    num_azimuthal = min(order - 1, max(source_bands)) + 1
    scattered_azimuthal = min(num_azimuthal, moments.size)  # chi_m = 0 beyond: nothing scatters there
    max_rank = order - 1 + max(source_bands)
    total = _Sum(weights, source_bands, scattered_azimuthal, (albedo.size, tau.size))

    def amplitudes(k, albedos):
        return [_amplitudes(k, m, moments, albedos, source_bands, order, first, last) for m in range(scattered_azimuthal)]

    media = np.arange(albedo.size)
    near, far = np.flatnonzero(tau <= 4), np.flatnonzero(tau > 4)
    if near.size:
        (real, real_weight, limits), groups = _near_paths(tau[near], kappa.min())
        found = amplitudes(np.concatenate([real.astype(complex), *(nodes for _, nodes, _ in groups)]), albedo[:, None])
        waves = [spherical_jn(rank, np.outer(tau[near], real)) for rank in range(max_rank + 1)]
        inside = real < limits[:, None]
        total.add(near, media, waves, real_weight * real**2 * inside, [a[..., : real.size] for a in found])
        start = real.size
        for radii, nodes, weight in groups:
            part = [a[..., start : start + nodes.size] for a in found]
            total.add(near[radii], media, _hankel(max_rank, np.outer(tau[near[radii]], nodes)), weight * nodes**2, part)
            start += nodes.size
    if far.size:
        paths = [_far_path(tau[far], value) for value in kappa]
        own = np.repeat(albedo, [nodes.size for nodes, _ in paths])
        found = amplitudes(np.concatenate([nodes for nodes, _ in paths]), own[None])
        start = 0
        for medium, (nodes, weight) in enumerate(paths):
            part = [a[..., start : start + nodes.size] for a in found]
            total.add(far, [medium], _hankel(max_rank, np.outer(tau[far], nodes)), weight * nodes**2, part)
            start += nodes.size
    response = np.zeros((albedo.size, tau.size, order, len(source_bands), num_azimuthal))
    for (band, column, m), terms in weights.items():
        for rank, inner, value in terms:
            if inner < scattered_azimuthal:
                share = (-1) ** m * value / (2 * pi**2)
                response[:, :, band, column, m] += share * total.values[rank, inner, band, column]
    return response[0] if scalar else response


def point_table(
    tau,
    *,
    moments: np.ndarray,
    albedo,
    order: int = 11,
    first: int = 2,
    last: int | None = None,
    kappa=None,
) -> np.ndarray:
    """L_l(tau) / albedo^first of a point source of intensity 1, bounces first..last: `[*media, T, order]`, sigma_t = 1."""
    response = moment_responses(tau, moments=moments, albedo=albedo, order=order, first=first, last=last, kappa=kappa)
    return sqrt(4 * pi) * response[..., 0, 0]
