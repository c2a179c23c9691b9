"""The paper's 8-bit interval map (section 4.1): distances and scattering coefficients in bytes, for the error study.

Nothing in `render` uses it: exact weights need no coefficients, and XLA gains nothing from bytes. Distances are stored
as numbers of steps between neighbouring samples. Each is the difference of ROUNDED positions, so that errors do not add
up: |error| <= step/2 (rounding the differences instead gives up to N times that). A gap above 255 steps saturates and
moves every later sample towards the camera. With the origin at the ray's entry and a step of span/255 none does.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float, UInt8


def encode_distances(
    distance: Float[Array, "N R"], origin: Float[Array, "R"], step: Float[Array, "R"]
) -> UInt8[Array, "N R"]:
    """Bytes k_i = K_i - K_(i-1), K_i = round((d_i - origin)/step), clipped to 0..255."""
    place = jnp.round((distance - origin) / step)
    before = jnp.concatenate([jnp.zeros_like(place[:1]), place[:-1]])
    return jnp.clip(place - before, 0.0, 255.0).astype(jnp.uint8)


def decode_distances(code: UInt8[Array, "N R"], origin: Float[Array, "R"], step: Float[Array, "R"]) -> Float[Array, "N R"]:
    """origin + step times the running sum of the bytes."""
    return origin + step * jnp.cumsum(code.astype(jnp.float32), axis=0)


def encode_coefficients(
    coefficient: Float[Array, "N R"], largest: Float[Array, ""]
) -> tuple[UInt8[Array, "N R"], UInt8[Array, "R"]]:
    """Bytes of c_i relative to the ray's maximum, and of that maximum relative to `largest`, of the whole medium.

    The maximum is rounded up, so that no coefficient of the ray exceeds it: |error| <= (its decoded value)/510.
    """
    top = jnp.ceil(jnp.max(coefficient, axis=0) / jnp.maximum(largest, 1e-30) * 255.0 - 1e-4)
    top = jnp.clip(top, 0.0, 255.0)
    scale = jnp.maximum(top * (largest / 255.0), 1e-30)
    return jnp.clip(jnp.round(coefficient / scale * 255.0), 0.0, 255.0).astype(jnp.uint8), top.astype(jnp.uint8)


def decode_coefficients(
    code: UInt8[Array, "N R"], top: UInt8[Array, "R"], largest: Float[Array, ""]
) -> Float[Array, "N R"]:
    """The inverse of `encode_coefficients` within its error."""
    return code.astype(jnp.float32) * (top.astype(jnp.float32) * (largest / (255.0 * 255.0)))
