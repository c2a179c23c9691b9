"""Independent routes to the responses: nested adaptive quadrature, and the integral equation that multiple scattering obeys.

Nothing here shares nodes or coordinates with the tables: single scattering is integrated over the viewing angle and the
position on the ray (Sun et al. 2005: gamma and tan x), area emitters with their clamped cosine integrated over azimuth,
multiple scattering by one more gather of the radiance field itself. `verify` recomputes random entries of a table file.
"""

from math import pi

import numpy as np
from numpy.polynomial.legendre import leggauss, legval, legvander
from scipy.integrate import quad_vec

from jaxvol import airlight, harmonics
from jaxvol.fit import compact, half_space, wavenumber, zonal_tables


def _phase_4pi(cosine: np.ndarray, moments: np.ndarray) -> np.ndarray:
    return legval(cosine, (2 * np.arange(len(moments)) + 1) * moments)


def _graded(
    low: float, high: float, *, toward_low: bool, levels: int = 24, num: int = 10, refine: int = 7
) -> tuple[np.ndarray, np.ndarray]:
    """Gauss-Legendre on panels that halve toward one end, the wide ones cut into `refine`."""
    steps = np.concatenate([[0.0], 2.0 ** np.arange(-levels, 1)])
    steps = np.unique(np.concatenate([steps, np.linspace(0.125, 1, refine + 1)]))
    edges = low + (high - low) * (steps if toward_low else 1 - steps[::-1])
    node, weight = leggauss(num)
    half = np.diff(edges)[:, None] / 2
    return (edges[:-1, None] + half * (1 + node)).ravel(), (half * weight).ravel()


def physical_response(
    distance: float, *, sigma_t: float, sigma_s: float, moments: np.ndarray, order: int, theta_n: float | None = None
) -> np.ndarray:
    """L_l (L_lm, half index, given theta_n) of light scattered once, in physical units, straight from the rendering equation.

    Fixed graded Gauss-Legendre over the viewing angle gamma and the position on the ray, t = d cos gamma + h tan y. Relative
    error 1e-12; with theta_n 1e-5 of L_00.
    """
    gamma, gamma_weight = (
        np.concatenate(v) for v in zip(_graded(0, pi / 2, toward_low=True), _graded(pi / 2, pi, toward_low=False), strict=True)
    )
    bands = harmonics.half_index(order)
    refine = 7 if theta_n is None else 56  # the clamped cosine has kinks
    polynomials = harmonics.normalised_legendre(np.cos(gamma), order)
    result = np.zeros(len(bands))
    for i, angle in enumerate(gamma):
        rest, weight = _graded(0, pi - angle, toward_low=True, levels=40 if angle < 0.1 else 24, refine=refine)  # pi/2 - y
        height = distance * np.sin(angle)
        t = np.maximum(height / np.tan(rest) + distance * np.cos(angle), 0)
        r = height / np.sin(rest)
        scatter = sigma_s * _phase_4pi(-np.cos(rest), moments) / (4 * pi) * np.exp(-sigma_t * (t + r)) * weight / height
        if theta_n is None:
            emission = np.ones((1, rest.size))
        else:
            emission = _lit_azimuths(theta_n, pi - angle - rest, order)[[m for _, m in bands]]
        seen = 2 * pi * np.sin(angle) * gamma_weight[i] * (emission @ scatter)
        for index, (band, m) in enumerate(bands):
            if theta_n is not None or m == 0:
                result[index] += seen[index if theta_n is not None else 0] * polynomials[band, m][i] * np.sin(angle) ** m
    return result if theta_n is not None else result[[i for i, (_, m) in enumerate(bands) if m == 0]]


def _lit_azimuths(theta_n: float, source_angle: np.ndarray, order: int) -> np.ndarray:
    """Mean over azimuth of the clamped cosine times cos(m phi), `[order, rays]`, by Gauss-Legendre over the lit interval."""
    a, b = np.cos(theta_n) * np.cos(source_angle), np.sin(theta_n) * np.sin(source_angle)
    node, weight = leggauss(20)
    edge = np.arccos(np.clip(-a / np.maximum(b, 1e-300), -1, 1))[:, None]
    phi = edge * (1 + node) / 2
    lit = edge / 2 * weight * (a[:, None] + b[:, None] * np.cos(phi))
    return np.stack([np.sum(lit * np.cos(m * phi), axis=1) for m in range(order)]) / pi


def point_entry(tau: float, *, moments: np.ndarray, order: int) -> np.ndarray:
    """tau e^tau L_l / (alpha sigma_t^2) of a point source scattered once, `[order]`."""
    return tau * np.exp(tau) * physical_response(tau, sigma_t=1.0, sigma_s=1.0, moments=moments, order=order)


def area_entry(tau: float, theta_n: float, *, moments: np.ndarray, order: int) -> np.ndarray:
    """tau e^tau L_lm / (alpha sigma_t^2) of a Lambertian patch scattered once, `[half(order)]`."""
    return tau * np.exp(tau) * physical_response(tau, sigma_t=1.0, sigma_s=1.0, moments=moments, order=order, theta_n=theta_n)


def directional_entry(tau: float, *, moments: np.ndarray, order: int, rtol: float = 1e-10) -> np.ndarray:
    """e^tau L_l / alpha of a directional source scattered once, by integrating along every direction numerically."""

    def outer(mu: float) -> np.ndarray:
        def inner(depth: float) -> float:  # scattering at `depth`, seen from tau along mu
            return np.exp(tau - depth - abs(tau - depth) / abs(mu)) / abs(mu)

        limits = (max(0.0, tau - 40 * mu), tau) if mu > 0 else (tau, tau + 40 * abs(mu))
        value = quad_vec(inner, *limits, epsrel=rtol / 10, epsabs=0, limit=400)[0]
        return value * _phase_4pi(mu, moments) / (4 * pi) * legvander(np.array([mu]), order - 1)[0]

    parts = [quad_vec(outer, *ends, epsrel=rtol, epsabs=1e-13, norm="max", limit=400)[0] for ends in ((-1, -1e-9), (1e-9, 1))]
    return 2 * pi * harmonics.zonal_norm(order) * sum(parts)


def _field(make, low: float, high: float, num: int = 48):
    """A smooth interpolant in x^(1/4) of a response (band 0 positive) on [low, high]."""
    ends = low**0.25, high**0.25
    coefficients = compact.transform(compact.to_ratios(make(compact.nodes(num, *ends) ** 4)))
    return lambda x: compact.from_ratios(compact.evaluate(coefficients, np.clip(x, low, high) ** 0.25, *ends))


def gathered_point(tau: float, *, moments: np.ndarray, albedo: float, order: int, num_nodes: int = 90) -> np.ndarray:
    """G_l(tau) of a point source (two bounces or more, over albedo^2) from the integral equation: one gather of the field.

    L_{k+1,l} = (2 pi K_l / tau) 4 int int da dw P_l r^2 e^-t sum_j chi_j K_j P_j(cos 2s) L_{k,j}(r), with L the light
    scattered once or more, from the half-angle table plus the wavenumber solution.
    """
    moments = np.asarray(moments)
    bands = moments.size
    nodes = airlight.half_angle_nodes(num_nodes)
    r, t = tau * nodes.source_distance, tau * nodes.receiver_distance

    def once_or_more(radius):
        single = zonal_tables.unscale_point(
            zonal_tables.point_moment_table(radius, order=bands, num_moments=bands) @ moments, radius
        )
        return single + albedo * wavenumber.point_table(radius, moments=moments, albedo=albedo, order=bands)

    field = _field(once_or_more, 1e-4, tau + 60)
    keep = (t < 60) & (r < tau + 60)
    polynomials = legvander(nodes.cos_deflection[keep], bands - 1) * moments * harmonics.zonal_norm(bands)
    # below the interpolant's range the field goes like 1 / r
    source = np.sum(polynomials * field(r[keep]), axis=1) * np.maximum(1, 1e-4 / r[keep])
    zonal = legvander(nodes.cos_receiver[keep], order - 1) * harmonics.zonal_norm(order)
    return 8 * pi / tau * (nodes.weight[keep] * r[keep] ** 2 * np.exp(-t[keep]) * source) @ zonal


def gathered_directional(tau: float, *, moments: np.ndarray, albedo: float, order: int) -> np.ndarray:
    """G_l(tau) of a directional source from the integral equation, the source function sampled at depths and integrated."""
    moments = np.asarray(moments)
    bands = moments.size

    def once_or_more(depth):
        single = zonal_tables.directional_moment_table(depth, order=bands, num_moments=bands) @ moments
        streams = half_space.streams_for(moments)
        return single * np.exp(-depth)[:, None] + albedo * half_space.directional_table(
            depth, moments=moments, albedo=albedo, order=bands, num_streams=streams
        )

    field = _field(once_or_more, 0.0, tau + 60)
    x, complement, weight = airlight.double_exponential(90)
    node, node_weight = leggauss(40)
    result = np.zeros(order)
    for sign in (1, -1):
        mu = sign * x
        reach = np.minimum(tau, 40 * x) if sign == 1 else np.minimum(60.0, 40 * x)
        edges = reach[:, None] * np.array([0, 0.02, 0.15, 0.45, 1.0])
        half = np.diff(edges, axis=1) / 2
        offset = edges[:, :-1, None] + half[..., None] * (1 + node)
        depth = np.maximum(tau - sign * offset, 0.0)
        radiance = field(depth.ravel()).reshape(*depth.shape, bands)
        phase = legvander(mu, bands - 1) * moments * harmonics.zonal_norm(bands)
        source = np.einsum("mpqj,mj->mpq", radiance, phase)
        decay = np.exp(-offset / x[:, None, None]) / x[:, None, None]
        seen = np.einsum("mpq,mp,q->m", source * decay, half, node_weight)
        result += 2 * pi * harmonics.zonal_norm(order) * ((weight * seen) @ legvander(mu, order - 1))
    return result
