"""Single scattering in an infinite homogeneous medium as a two-dimensional integral without singularities.

Coordinates: a = half the angle at the receiver between the source and the scattering point, w = half the angle at the
source between the receiver and the scattering point, s = a + w <= pi/2. With d the distance of source and receiver,
r that of source and scattering point, t that of scattering point and receiver,

    r = d sin 2a / sin 2s,  t = d sin 2w / sin 2s,  (t + r)/d = 1 + x,  x = 2 sin a sin w / cos s,
    cos(deflection) = cos 2s,  dt dmu = (4 r^2 / d) da dw      (mu = cos 2a).

All factors are positive and nothing cancels; x is never cos(a - w)/cos s - 1. This replaces the Monte Carlo integral
of Dubouchet et al. 2019, equations (14)-(16), where inside the t-integral sigma_t means sigma_s and the emitter's
fall-off is that of the scattering point, 1/|x_t - x_s|^2.

Nodes are numpy float64, made once on the host; the integrals keep the dtype of tau.
"""

from math import pi
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float


class HalfAngleNodes(NamedTuple):
    """Quadrature over (a, w): sum(weight * f) = int int f da dw. Every field float64 `[nodes]`."""

    cos_receiver: np.ndarray  # cos 2a: angle at the receiver
    sin_receiver: np.ndarray
    cos_source: np.ndarray  # cos 2w: angle at the source
    sin_source: np.ndarray
    sin_s: np.ndarray  # s = half the deflection
    cos_s: np.ndarray
    excess: np.ndarray  # x: path length / d - 1
    receiver_distance: np.ndarray  # t / d
    source_distance: np.ndarray  # r / d
    weight: np.ndarray

    @property
    def cos_deflection(self) -> np.ndarray:
        """cos 2s, the cosine of the scattering angle."""
        return 1 - 2 * self.sin_s**2


def double_exponential(num: int, *, limit: float = 3.2) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Tanh-sinh nodes x on (0, 1), their exact complements 1 - x, and weights; `[num]` each.

    Truncated where the distance to an end is 1e-17; converges exponentially also for end-point singularities.
    """
    t = np.linspace(-limit, limit, num)
    y = pi * np.sinh(t)
    x, complement = 1 / (1 + np.exp(-y)), 1 / (1 + np.exp(y))
    return x, complement, (t[1] - t[0]) * pi * np.cosh(t) * x * complement


def _nodes(a, w, complement, weight) -> HalfAngleNodes:
    """All fields from a, w and pi/2 - s (which must not come from a subtraction)."""
    sin_s, cos_s = np.sin(a + w), np.sin(complement)
    sin_2s = 2 * sin_s * cos_s
    sin_2a = 2 * np.sin(a) * np.sin(complement + w)  # pi/2 - a = complement + w: no cancellation near 2a = pi
    sin_2w = 2 * np.sin(w) * np.sin(complement + a)
    return HalfAngleNodes(
        cos_receiver=np.cos(2 * a),
        sin_receiver=sin_2a,
        cos_source=np.cos(2 * w),
        sin_source=sin_2w,
        sin_s=sin_s,
        cos_s=cos_s,
        excess=2 * np.sin(a) * np.sin(w) / cos_s,
        receiver_distance=sin_2w / sin_2s,
        source_distance=sin_2a / sin_2s,
        weight=weight,
    )


def half_angle_nodes(num: int) -> HalfAngleNodes:
    """num x num nodes on the triangle a, w >= 0, a + w <= pi/2: a = sY, w = s(1 - Y) with double-exponential s and Y.

    Largest relative error of the tables, l <= 10, any tau: num = 60 8e-7, 80 5e-10, 100 2e-11, 120 2e-12.
    """
    x, x_complement, x_weight = (v[:, None] for v in double_exponential(num))
    y, y_complement, y_weight = (v[None, :] for v in double_exponential(num))
    s = pi / 2 * x
    a, w = s * y, s * y_complement
    complement = np.broadcast_to(pi / 2 * x_complement, a.shape)
    weight = (pi / 2) * s * x_weight * y_weight
    return _nodes(*(v.ravel() for v in (a, w, complement, weight)))


def area_nodes(num: int, theta_n: float) -> HalfAngleNodes:
    """3 num x num nodes on the same triangle for an emitter whose normal is theta_n off the direction to the receiver.

    The clamped cosine has kinks at 2w = |pi/2 - theta_n| and pi - |pi/2 - theta_n| (an edge of the emission cone appears or
    disappears): w is split there. num = 60 gives errors under 5e-6 of L_00 at any tau, num = 70 under 1e-7.
    """
    first = abs(pi / 2 - theta_n) / 2
    edges = (0.0, min(first, pi / 4), max(pi / 2 - first, pi / 4), pi / 2)
    x, x_complement, x_weight = double_exponential(num)
    panels = []
    for low, high in zip(edges[:-1], edges[1:], strict=True):
        width = high - low
        w, rest = low + width * x, (pi / 2 - high) + width * x_complement
        rest = np.maximum(rest, 1e-200)  # pi/2 - w; a panel of no width at w = pi/2 has weight 0, not 0/0
        a, complement = np.outer(rest, x), np.outer(rest, x_complement)
        weight = np.outer(width * x_weight * rest, x_weight)
        panels.append([v.ravel() for v in (a, np.broadcast_to(w[:, None], a.shape), complement, weight)])
    return _nodes(*(np.concatenate(parts) for parts in zip(*panels, strict=True)))


def area_emission(nodes: HalfAngleNodes, theta_n: float, num_azimuthal: int) -> np.ndarray:
    """C_m = (1/2pi) int max(0, A + B cos phi) cos(m phi) dphi, the emission of a Lambertian patch by azimuthal order.

    A = cos theta_n cos 2w, B = sin theta_n sin 2w. Returns `[nodes, num_azimuthal]`.
    """
    a = np.cos(theta_n) * nodes.cos_source
    b = np.maximum(np.sin(theta_n) * nodes.sin_source, 1e-300)
    half_width = np.arccos(np.clip(-a / b, -1, 1))

    def sine(m: int) -> np.ndarray:  # int_0^p cos(m phi) dphi
        return half_width if m == 0 else np.sin(m * half_width) / m

    orders = [a * sine(m) + b / 2 * (sine(abs(m - 1)) + sine(m + 1)) for m in range(num_azimuthal)]
    return np.stack(orders, axis=-1) / pi


def henyey_greenstein_4pi(nodes: HalfAngleNodes, g: float) -> np.ndarray:
    """4 pi p(deflection) at the nodes, without the cancellation of 1 + g^2 - 2 g cos near |g| = 1."""
    if g >= 0:
        square = (1 - g) ** 2 + 4 * g * nodes.sin_s**2
    else:
        square = (1 + g) ** 2 - 4 * g * nodes.cos_s**2
    return (1 - g * g) / (square * np.sqrt(square))


def exponential_sums(
    tau: Float[Array, "T"], excess: Float[Array, "nodes"], matrix: Float[Array, "nodes columns"]
) -> Float[Array, "T columns"]:
    """sum_i exp(-tau x_i) matrix[i, :]: every table is this product, with the same nodes for all tau (no overflow)."""
    return jnp.matmul(jnp.exp(-tau[:, None] * excess), matrix, precision="highest")


def directional_factor(
    tau: Float[Array, "*batch"], mu: Float[Array, "*batch"], one_minus_mu: Float[Array, "*batch"]
) -> Float[Array, "*batch"]:
    """e^tau L(mu) / (alpha E0 p(mu)) of light that scatters once below the top of a half-space, tau under that top.

    The light comes straight down; mu = cosine between the viewing direction and the direction toward the light:
    -expm1(-tau (1-mu)/mu)/(1-mu) for mu > 0, 1/(1-mu) for mu <= 0, tau at mu = 1.
    """
    upward = mu > 0
    safe_mu = jnp.where(upward, mu, 1)
    grazing = one_minus_mu * tau < 1e-20  # the limit at mu = 1
    safe = jnp.where(grazing, 1, one_minus_mu)
    above = jnp.where(grazing, tau / safe_mu, -jnp.expm1(-tau * safe / safe_mu) / safe)
    return jnp.where(upward, above, 1 / jnp.where(upward, 1, one_minus_mu))


def single_scatter_radiance(
    distance: Float[Array, "*batch"],
    angle: Float[Array, "*batch"],
    sigma_t: Float[Array, "*batch"],
    sigma_s: Float[Array, "*batch"],
    *,
    length: Float[Array, "*batch"] | None = None,
    num_nodes: int = 32,
) -> Float[Array, "*batch"]:
    """Airlight of an isotropic point source of intensity 1 along a ray, isotropic phase function (Sun et al. 2005).

    L = sigma_s / (4 pi) int_0^length e^{-sigma_t (t + r)} / r^2 dt, by Gauss-Legendre in the half angle w at the source:
    L = sigma_s / (4 pi) 2 / (d sin 2a) int e^{-sigma_t d (1 + x)} dw.

    Args:
        distance: d > 0 from the receiver to the source.
        angle: 2a in (0, pi), between the ray and the direction to the source.
        length: of the ray; None = infinite.
    """
    distance, angle = jnp.asarray(distance), jnp.asarray(angle)
    dtype = jnp.result_type(distance, angle, sigma_t)
    node, weight = np.polynomial.legendre.leggauss(num_nodes)
    node, weight = jnp.asarray((node + 1) / 2, dtype), jnp.asarray(weight / 2, dtype)
    half = angle / 2
    if length is None:
        end = pi / 2 - half
    else:  # 2w = the angle at the source of the triangle receiver, source, end of the ray
        end = jnp.arctan2(length * jnp.sin(angle), distance - length * jnp.cos(angle)) / 2
    w = end[..., None] * node
    complement = (pi / 2 - half)[..., None] - w
    excess = 2 * jnp.sin(half)[..., None] * jnp.sin(w) / jnp.maximum(jnp.sin(complement), jnp.finfo(dtype).tiny)
    tau = jnp.asarray(sigma_t * distance)[..., None]
    integral = end * jnp.sum(weight * jnp.exp(-tau * (1 + excess)), axis=-1)
    return sigma_s / (4 * pi) * 2 * integral / (distance * jnp.sin(angle))
