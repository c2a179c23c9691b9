"""Counter-based random numbers and the samplers that every estimator shares, each with its pdf beside it.

Random numbers are a hash of (seed, stream, index, sample, dimension): the same number wherever, in whatever batch and
order it is asked for. Uniforms are open at both ends, so that log(u) and 1/u are finite.
"""

import math
import zlib

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, ArrayLike, Float, UInt

from jaxvol.fast_math import atan_unit, sin_cos

Uniforms = tuple[Float[Array, "*b"], Float[Array, "*b"], Float[Array, "*b"], Float[Array, "*b"]]


def pcg4d(a: UInt[Array, "*b"], b: UInt[Array, "*b"], c: UInt[Array, "*b"], d: UInt[Array, "*b"]) -> tuple:
    """Four hashed uint32 from four (Jarzynski and Olano 2020, "Hash functions for GPU rendering", pcg4d)."""
    a, b, c, d = (jnp.asarray(x, jnp.uint32) * jnp.uint32(1664525) + jnp.uint32(1013904223) for x in (a, b, c, d))
    a = a + b * d
    b = b + c * a
    c = c + a * b
    d = d + b * c
    a, b, c, d = (x ^ (x >> 16) for x in (a, b, c, d))
    a = a + b * d
    b = b + c * a
    c = c + a * b
    d = d + b * c
    return a, b, c, d


def stream(name: str) -> int:
    """The number of a named stream of random numbers."""
    return zlib.crc32(name.encode())


def uniforms(seed: ArrayLike, stream: int, index: ArrayLike, dimension: ArrayLike, sample: ArrayLike = 0) -> Uniforms:
    """Four independent uniforms in (0, 1), float32, for a (seed, stream, index, sample, dimension); arguments broadcast.

    23 random bits and a half: never 0, never 1.
    """
    mixed = jnp.asarray(seed, jnp.uint32) * jnp.uint32(0x9E3779B9) ^ jnp.uint32(stream)
    bits = pcg4d(jnp.asarray(index, jnp.uint32), jnp.asarray(dimension, jnp.uint32), jnp.asarray(sample, jnp.uint32), mixed)
    return tuple(((x >> 9).astype(jnp.float32) + 0.5) * jnp.float32(2.0**-23) for x in bits)


def five_uniforms(
    seed: ArrayLike, stream: int, index: ArrayLike, dimension: ArrayLike, sample: ArrayLike
) -> tuple[Float[Array, "*b"], ...]:
    """`uniforms` and a fifth, of 23 bits made of what those four leave unused."""
    mixed = jnp.asarray(seed, jnp.uint32) * jnp.uint32(0x9E3779B9) ^ jnp.uint32(stream)
    bits = pcg4d(jnp.asarray(index, jnp.uint32), jnp.asarray(dimension, jnp.uint32), jnp.asarray(sample, jnp.uint32), mixed)
    low = [x & jnp.uint32(0xFF) for x in bits[:3]]
    rest = low[0] << 16 | low[1] << 8 | low[2]
    four = tuple(((x >> 9).astype(jnp.float32) + 0.5) * jnp.float32(2.0**-23) for x in bits)
    return *four, ((rest >> 1).astype(jnp.float32) + 0.5) * jnp.float32(2.0**-23)


def dot(a: Float[Array, "*b 3"], b: Float[Array, "*b 3"]) -> Float[Array, "*b"]:
    """Scalar product over the last axis."""
    return a[..., 0] * b[..., 0] + a[..., 1] * b[..., 1] + a[..., 2] * b[..., 2]


def normalize(v: Float[Array, "*b 3"]) -> Float[Array, "*b 3"]:
    """v / |v|; the zero vector stays zero, with finite gradients."""
    # By the largest component first, a constant as far as the result goes: squares neither under- nor overflow.
    largest = lax.stop_gradient(jnp.max(jnp.abs(v), axis=-1, keepdims=True))
    there = largest > 0
    v = v / jnp.where(there, largest, 1.0)
    return v * lax.rsqrt(jnp.where(there, dot(v, v)[..., None], 1.0))


def orthonormal_basis(n: Float[Array, "*b 3"]) -> tuple[Float[Array, "*b 3"], Float[Array, "*b 3"]]:
    """Two unit vectors that make a right-handed basis (s, t, n) (Duff et al. 2017)."""
    sign = jnp.where(n[..., 2] >= 0, 1.0, -1.0)
    a = -1.0 / (sign + n[..., 2])
    b = n[..., 0] * n[..., 1] * a
    s = jnp.stack([1.0 + sign * n[..., 0] * n[..., 0] * a, sign * b, -sign * n[..., 0]], axis=-1)
    t = jnp.stack([b, sign + n[..., 1] * n[..., 1] * a, -n[..., 1]], axis=-1)
    return s, t


def to_world(local: Float[Array, "*b 3"], n: Float[Array, "*b 3"]) -> Float[Array, "*b 3"]:
    """A vector given in the basis (s, t, n) of `orthonormal_basis(n)`, in world coordinates."""
    s, t = orthonormal_basis(n)
    return local[..., 0:1] * s + local[..., 1:2] * t + local[..., 2:3] * n


def sin_cos_turn(u: Float[Array, "*b"]) -> tuple[Float[Array, "*b"], Float[Array, "*b"]]:
    """sin(2 pi u) and cos(2 pi u) for u in [0, 1], by polynomials of the half turn; absolute error below 5e-7."""
    s, c = sin_cos(math.pi * (u - 0.5))
    return -2.0 * s * c, 2.0 * s * s - 1.0


def angle_of(y: Float[Array, "*b"], x: Float[Array, "*b"]) -> Float[Array, "*b"]:
    """atan2(y, x) for y >= 0, by a polynomial; relative error below 1e-6. 0 for y = x = 0."""
    size = jnp.abs(x)
    small, large = jnp.minimum(y, size), jnp.maximum(y, size)
    acute = atan_unit(small / jnp.maximum(large, 1e-37))
    acute = jnp.where(y > size, 0.5 * math.pi - acute, acute)
    return jnp.where(x < 0, math.pi - acute, acute)


def direction_about(
    axis: Float[Array, "*b 3"], cos_theta: Float[Array, "*b"], sin_theta: Float[Array, "*b"], u: Float[Array, "*b"]
) -> Float[Array, "*b 3"]:
    """The unit vector at polar angle theta and azimuth 2 pi u about `axis`."""
    sin_phi, cos_phi = sin_cos_turn(u)
    local = jnp.stack([sin_theta * cos_phi, sin_theta * sin_phi, cos_theta], axis=-1)
    return normalize(to_world(local, axis))  # long paths would add up the rounding of their directions


def sample_uniform_sphere(u1: Float[Array, "*b"], u2: Float[Array, "*b"]) -> Float[Array, "*b 3"]:
    """A direction uniform over the sphere."""
    z = 1.0 - 2.0 * u1
    r = 2.0 * jnp.sqrt(u1 * (1.0 - u1))
    sin_phi, cos_phi = sin_cos_turn(u2)
    return jnp.stack([r * cos_phi, r * sin_phi, z], axis=-1)


def sample_uniform_sphere_pdf() -> float:
    """1 / (4 pi), 1/sr."""
    return 1.0 / (4.0 * math.pi)


def sample_cosine_hemisphere(u1: Float[Array, "*b"], u2: Float[Array, "*b"], n: Float[Array, "*b 3"]) -> Float[Array, "*b 3"]:
    """A direction about n with pdf cos / pi."""
    return direction_about(n, jnp.sqrt(1.0 - u1), jnp.sqrt(u1), u2)


def sample_cosine_hemisphere_pdf(cos_theta: Float[Array, "*b"]) -> Float[Array, "*b"]:
    """max(cos, 0) / pi, 1/sr."""
    return jnp.maximum(cos_theta, 0.0) * (1.0 / math.pi)


def sample_uniform_cone(
    u1: Float[Array, "*b"], u2: Float[Array, "*b"], axis: Float[Array, "*b 3"], half_angle: Float[Array, "*b"]
) -> Float[Array, "*b 3"]:
    """A direction uniform in the cone about `axis`; half_angle in radians."""
    half = jnp.sin(0.5 * half_angle)
    one_minus_cos = 2.0 * half * half * u1  # (1 - cos) without cancellation for narrow cones
    return direction_about(axis, 1.0 - one_minus_cos, jnp.sqrt(one_minus_cos * (2.0 - one_minus_cos)), u2)


def sample_uniform_cone_pdf(half_angle: Float[Array, "*b"]) -> Float[Array, "*b"]:
    """1 / (2 pi (1 - cos half_angle)), 1/sr."""
    half = jnp.sin(0.5 * half_angle)
    return 1.0 / (4.0 * math.pi * jnp.maximum(half * half, 1e-30))


def sample_triangle(u1: Float[Array, "*b"], u2: Float[Array, "*b"]) -> tuple[Float[Array, "*b"], Float[Array, "*b"]]:
    """Barycentric weights of the second and third vertex of a point uniform over a triangle."""
    root = jnp.sqrt(u1)
    return root * (1.0 - u2), root * u2


def sample_exponential(u: Float[Array, "*b"], sigma: Float[Array, "*b"]) -> Float[Array, "*b"]:
    """A free flight of pdf sigma exp(-sigma t); sigma = 0 gives a flight of at least 1e30."""
    return -jnp.log1p(-u) / jnp.maximum(sigma, 1e-30)


def sample_exponential_pdf(t: Float[Array, "*b"], sigma: Float[Array, "*b"]) -> Float[Array, "*b"]:
    """sigma exp(-sigma t)."""
    return sigma * jnp.exp(-sigma * t)


def sample_truncated_exponential(
    u: Float[Array, "*b"], sigma: Float[Array, "*b"], t_max: Float[Array, "*b"]
) -> Float[Array, "*b"]:
    """A distance in [0, t_max] of pdf proportional to exp(-sigma t); sigma -> 0 is uniform."""
    depth = sigma * t_max
    thin = depth < 1e-4
    safe = jnp.where(thin, 1.0, sigma)
    thick = -jnp.log1p(u * jnp.expm1(-jnp.where(thin, 1.0, depth))) / safe
    # First order in the depth: the exact inverse of u = (1 - e^-st)/(1 - e^-sT) to O(depth^2).
    return jnp.minimum(jnp.where(thin, t_max * u * (1.0 - 0.5 * depth * (1.0 - u)), thick), t_max)


def sample_truncated_exponential_pdf(
    t: Float[Array, "*b"], sigma: Float[Array, "*b"], t_max: Float[Array, "*b"]
) -> Float[Array, "*b"]:
    """sigma exp(-sigma t) / (1 - exp(-sigma t_max)), with the limit 1 / t_max."""
    depth = sigma * t_max
    thin = depth < 1e-4
    norm = jnp.where(thin, t_max * (1.0 - 0.5 * depth), -jnp.expm1(-depth) / jnp.where(thin, 1.0, sigma))
    return jnp.exp(-sigma * t) / jnp.maximum(norm, 1e-37)


def _closest_approach(origin, direction, point):
    """Parameter and distance of the point of the ray that is closest to `point`."""
    delta = point - origin
    t_closest = dot(delta, direction)
    perpendicular = delta - t_closest[..., None] * direction  # from the vector: |delta|^2 - t^2 would cancel
    distance = jnp.sqrt(jnp.maximum(dot(perpendicular, perpendicular), 1e-24))
    return t_closest, distance


def sample_equiangular(
    u: Float[Array, "*b"],
    origin: Float[Array, "*b 3"],
    direction: Float[Array, "*b 3"],
    t0: Float[Array, "*b"],
    t1: Float[Array, "*b"],
    point: Float[Array, "*b 3"],
) -> tuple[Float[Array, "*b"], Float[Array, "*b"]]:
    """A distance in [t0, t1] with pdf proportional to 1 / |x(t) - point|^2, and that pdf (Kulla and Fajardo 2012)."""
    t_closest, distance = _closest_approach(origin, direction, point)
    begin = t0 - t_closest
    angle = _seen_angle(begin, t1 - t_closest, distance)
    # tan(theta0 + u angle) from the tangent of theta0 = begin / distance, free of cancellation far from the point.
    s, c = sin_cos(u * angle - 0.5 * math.pi)
    sin_part, cos_part = c, -s
    offset = distance * (begin * cos_part + distance * sin_part) / _away_from_zero(distance * cos_part - begin * sin_part)
    t = jnp.clip(t_closest + offset, t0, t1)
    return t, _equiangular_pdf(t - t_closest, distance, angle)


def _seen_angle(begin, end, distance):
    """Angle under which the point sees the stretch from `begin` to `end`, offsets from the closest approach."""
    return angle_of(distance * jnp.maximum(end - begin, 0.0), distance * distance + begin * end)


def _away_from_zero(x):
    return jnp.where(jnp.abs(x) < 1e-37, 1e-37, x)


def sample_equiangular_pdf(t, origin, direction, t0, t1, point) -> Float[Array, "*b"]:
    """The pdf of `sample_equiangular` at t, 1/length; zero outside [t0, t1]."""
    t_closest, distance = _closest_approach(origin, direction, point)
    angle = _seen_angle(t0 - t_closest, t1 - t_closest, distance)
    inside = (t >= t0) & (t <= t1)
    return jnp.where(inside, _equiangular_pdf(t - t_closest, distance, angle), 0.0)


def _equiangular_pdf(offset, distance, angle):
    return distance / (jnp.maximum(angle, 1e-30) * (offset * offset + distance * distance))


def sample_cdf(u: Float[Array, "*b"], cdf: Float[Array, "N"]) -> Array:
    """The first index whose inclusive cumulative probability exceeds u; int32, by binary search."""
    index = jnp.searchsorted(cdf, u, side="right").astype(jnp.int32)
    return jnp.clip(index, 0, cdf.shape[0] - 1)
