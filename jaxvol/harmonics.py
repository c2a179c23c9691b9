"""Real spherical (SH) and zonal (ZH) harmonics: evaluation, projection, rotation and products.

Conventions (Sloan, Luna and Snyder 2005; Dubouchet et al. 2019, section 3.3): y_l^0 = K_l P_l(cos theta) with
K_l = sqrt((2l+1)/4pi); y_l^m = sqrt(2) N_l^m P_l^|m| {cos(m phi), m > 0; sin(|m| phi), m < 0}, without the
Condon-Shortley sign, so that y_1^{-1,0,1} = sqrt(3/4pi) {y, z, x}. (Equation 12 of the paper gives m = 0 a factor
sqrt(2) that it must not have.) Order N means bands 0..N-1; SH index i = l(l+1)+m. Functions that are mirror symmetric
about the xz-plane have m >= 0 only: their "half" index is l(l+1)/2+m.

Directions here point from the receiver toward the light, the one exception to the rule that directions point along
travel. Constants are numpy float64; evaluation keeps the dtype of its array argument.
"""

from collections.abc import Callable
from math import comb, pi, sqrt

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float


def num_sh(order: int) -> int:
    """Number of SH coefficients of an order: N^2."""
    return order * order


def num_half(order: int) -> int:
    """Number of coefficients with m >= 0 of an order: N(N+1)/2."""
    return order * (order + 1) // 2


def half_index(order: int) -> tuple[tuple[int, int], ...]:
    """Pairs (l, m), m >= 0, in the order of the half index."""
    return tuple((band, m) for band in range(order) for m in range(band + 1))


def zonal_norm(order: int) -> np.ndarray:
    """K_l = y_l^0 at the pole = sqrt((2l+1)/4pi), float64 `[order]`."""
    return np.sqrt((2 * np.arange(order) + 1) / (4 * pi))


def rotation_norm(order: int) -> np.ndarray:
    """n*_l = sqrt(4pi/(2l+1)) of equation (13), float64 `[order]`."""
    return 1 / zonal_norm(order)


def legendre(x: Float[Array, "*batch"], num: int) -> Float[Array, "*batch num"]:
    """P_0..P_{num-1} at x by the three-term recursion (stable for |x| <= 1)."""
    x = jnp.asarray(x)
    values = [jnp.ones_like(x), x]
    for band in range(2, num):
        values.append(((2 * band - 1) * x * values[-1] - (band - 1) * values[-2]) / band)
    return jnp.stack(values[:num], axis=-1)


def normalised_legendre(z, order: int) -> dict:
    """Q_l^m(z) by pair (l, m), with y_l^m = Q_l^m sin^m(theta) {cos, sin}(m phi); z is a numpy or jax array.

    The recursion on normalised functions cannot overflow.
    """
    table = {}
    diagonal = sqrt(1 / (4 * pi))
    for m in range(order):
        if m > 0:
            diagonal *= sqrt((2 * m + 1) / (2 * m))
        scale = diagonal if m == 0 else sqrt(2) * diagonal
        table[m, m] = scale + 0 * z
        if m + 1 < order:
            table[m + 1, m] = sqrt(2 * m + 3) * z * table[m, m]
        for band in range(m + 2, order):
            a = sqrt((4 * band * band - 1) / (band * band - m * m))
            b = sqrt(((band - 1) ** 2 - m * m) / (4 * (band - 1) ** 2 - 1))
            table[band, m] = a * (z * table[band - 1, m] - b * table[band - 2, m])
    return table


def evaluate_sh(direction: Float[Array, "*batch 3"], order: int) -> Float[Array, "*batch N2"]:
    """All y_l^m at unit directions, index l(l+1)+m."""
    x, y, z = direction[..., 0], direction[..., 1], direction[..., 2]
    table = normalised_legendre(z, order)
    cosine, sine = jnp.ones_like(x), jnp.zeros_like(x)  # sin^m(theta) cos(m phi) and sin(m phi), as polynomials of x, y
    values = [None] * num_sh(order)
    for m in range(order):
        for band in range(m, order):
            values[band * (band + 1) + m] = table[band, m] * cosine
            if m > 0:
                values[band * (band + 1) - m] = table[band, m] * sine
        cosine, sine = x * cosine - y * sine, x * sine + y * cosine
    return jnp.stack(values, axis=-1)


def evaluate_half(
    cos_theta: Float[Array, "*batch"], sin_theta: Float[Array, "*batch"], order: int
) -> Float[Array, "*batch half"]:
    """y_l^m, m >= 0, on the meridian phi = 0, half index. sin_theta may be negative (phi = pi)."""
    table = normalised_legendre(cos_theta, order)
    powers = [jnp.ones_like(sin_theta)]
    for _ in range(1, order):
        powers.append(powers[-1] * sin_theta)
    return jnp.stack([table[band, m] * powers[m] for band, m in half_index(order)], axis=-1)


def evaluate_zonal(coefficients: Float[Array, "*batch N"], cos_theta: Float[Array, "*batch"]) -> Float[Array, "*batch"]:
    """f(theta) = sum_l f_l y_l^0(theta)."""
    order = coefficients.shape[-1]
    cos_theta = jnp.asarray(cos_theta)
    norm = jnp.asarray(zonal_norm(order), dtype=cos_theta.dtype)
    return jnp.sum(coefficients * norm * legendre(cos_theta, order), axis=-1)


def project_zonal(function: Callable[[np.ndarray], np.ndarray], order: int, *, num_nodes: int = 128) -> np.ndarray:
    """f_l = 2 pi K_l int f(mu) P_l(mu) dmu by Gauss-Legendre (exact for polynomials of degree < 2 num_nodes - l)."""
    mu, weight = np.polynomial.legendre.leggauss(num_nodes)
    values = np.polynomial.legendre.legvander(mu, order - 1)
    return 2 * pi * zonal_norm(order) * ((weight * function(mu)) @ values)


def project_sh(function: Callable[[np.ndarray], np.ndarray], order: int, *, num_nodes: int = 64) -> np.ndarray:
    """f_lm = int f(w) y_lm(w) dw by Gauss-Legendre in cos theta and equal steps in phi; `function` takes `[*, 3]`."""
    mu, weight = np.polynomial.legendre.leggauss(num_nodes)
    phi = 2 * pi * (np.arange(2 * num_nodes) + 0.5) / (2 * num_nodes)
    sine = np.sqrt(1 - mu * mu)
    direction = np.stack(
        [sine[:, None] * np.cos(phi), sine[:, None] * np.sin(phi), np.broadcast_to(mu[:, None], (num_nodes, phi.size))],
        axis=-1,
    )
    values = np.asarray(evaluate_sh(direction, order))
    return np.einsum("t,tp,tpi->i", weight * pi / num_nodes, function(direction), values)


def rotate_zonal(coefficients: Float[Array, "*batch N"], axis: Float[Array, "*batch 3"]) -> Float[Array, "*batch N2"]:
    """SH coefficients of a zonal function turned to a unit axis: h_lm = sqrt(4pi/(2l+1)) f_l y_lm(axis) (equation 13)."""
    order = coefficients.shape[-1]
    scaled = coefficients * jnp.asarray(rotation_norm(order), dtype=coefficients.dtype)
    repeats = np.repeat(np.arange(order), 2 * np.arange(order) + 1)
    return scaled[..., repeats] * evaluate_sh(axis, order)


def double_product(a: Float[Array, "*batch Na"], b: Float[Array, "*batch Nb"]) -> Float[Array, "*batch"]:
    """int a(w) b(w) dw of two functions in the same basis and frame: sum over the shared coefficients."""
    shared = min(a.shape[-1], b.shape[-1])
    return jnp.sum(a[..., :shared] * b[..., :shared], axis=-1)


def zonal_product(
    g: Float[Array, "*batch N"], h: Float[Array, "*batch N"], cos_beta: Float[Array, "*batch"]
) -> Float[Array, "*batch"]:
    """int g h dw of two zonal functions whose axes meet at angle beta: sum_l g_l h_l P_l(cos beta), O(N).

    Appendix A of the paper with its misprint corrected: the last line prints y_l^0 of the axis as a factor, it is a
    divisor (y_l^0(beta) / y_l^0(0) = P_l). Decided by tests/test_harmonics.py against quadrature over the sphere.
    """
    return jnp.sum(g * h * legendre(cos_beta, g.shape[-1]), axis=-1)


def clamped_cosine(order: int) -> np.ndarray:
    """ZH coefficients of max(0, cos theta), float64 `[order]` (Ramamoorthi and Hanrahan 2001)."""
    coefficients = np.zeros(order)
    for band in range(order):
        if band == 1:
            coefficients[band] = sqrt(pi / 3)
        elif band % 2 == 0:
            sign = -1 if band % 4 == 0 else 1  # (-1)^(l/2 - 1); l = 0 gives (-1)(1/((2)(-1))) > 0
            ratio = comb(band, band // 2) / 2**band
            coefficients[band] = 2 * pi * zonal_norm(order)[band] * sign * ratio / ((band + 2) * (band - 1))
    return coefficients


def zonal_irradiance(radiance: Float[Array, "*batch N"], cos_angle: Float[Array, "*batch"]) -> Float[Array, "*batch"]:
    """Irradiance of a zonal radiance on a plane whose normal makes cos_angle with its axis: sum_l L_l A_l P_l."""
    cosine = jnp.asarray(clamped_cosine(radiance.shape[-1]), dtype=radiance.dtype)
    return zonal_product(radiance, cosine, cos_angle)


def sh_irradiance(radiance: Float[Array, "*batch N2"], normal: Float[Array, "*batch 3"]) -> Float[Array, "*batch"]:
    """Irradiance of an SH radiance on a plane with the given unit normal: sum_lm sqrt(4pi/(2l+1)) A_l L_lm y_lm(n)."""
    order = round(radiance.shape[-1] ** 0.5)
    return double_product(radiance, rotate_zonal(jnp.asarray(clamped_cosine(order), dtype=radiance.dtype), normal))


def half_irradiance(radiance: Float[Array, "*batch half"], normal: Float[Array, "*batch 3"]) -> Float[Array, "*batch"]:
    """Irradiance of a mirror-symmetric radiance (m >= 0) on a plane; the normal in the frame of its coefficients."""
    order = round((2 * radiance.shape[-1]) ** 0.5 - 0.5)
    index = np.array([band * (band + 1) + m for band, m in half_index(order)])
    lobe = rotate_zonal(jnp.asarray(clamped_cosine(order), dtype=radiance.dtype), normal)
    return jnp.sum(radiance * lobe[..., index], axis=-1)
