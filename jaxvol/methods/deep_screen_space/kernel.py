"""The pair kernel: light from one surfel, scattered towards the eye at the samples of one ray (paper section 4.2).

Per pair of a surfel and a ray the geometry is prepared once; per sample remain a handful of operations, one square root
and one division: with u = d + b, d2 = h2 + u^2 the cosine, the inverse square and Henyey-Greenstein fold into
max(e + u f, 0) / (X sqrt X), X = (1 + g^2) d2 + 2 g u sqrt(d2). Arrays are [B, T]: B chunks, T rays as lanes; samples are
separate arrays in an unrolled loop, so that XLA makes one vectorised loop of it.

The disk of radius r is softened into the point by d2 + delta, delta = r^2/2: -7 % of the disk's exact value on its axis
at distance r, -0.8 % at 2 r, finite everywhere (the paper's max(d2, delta) has a kink and no stated delta).
"""

import math
from collections.abc import Sequence

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from jaxvol import phase as phase_functions
from jaxvol.types import PhaseTable

PHASES = ("isotropic", "henyey_greenstein", "table")
MAX_ABS_G = 0.99
_INV_4PI = 1.0 / (4.0 * math.pi)

# Columns of a surfel's row; the last four only for glossy entries.
COLUMNS = ("x", "y", "z", "nx", "ny", "nz", "inner2", "outer2", "delta", "red", "green", "blue")
GLOSSY_COLUMNS = (*COLUMNS, "lx", "ly", "lz", "exponent")


def phase_scale(phase: str, g) -> Float[Array, ""]:
    """The constant factor of the phase function that `pair_samples` leaves out."""
    if phase == "isotropic":
        return jnp.float32(_INV_4PI)
    if phase == "henyey_greenstein":
        g = jnp.clip(g, -MAX_ABS_G, MAX_ABS_G)
        return _INV_4PI * (1.0 - g) * (1.0 + g)
    return jnp.float32(1.0)


def pair_samples(
    ray: tuple[Float[Array, "B T"], Float[Array, "B T"], Float[Array, "B T"]],
    distances: Sequence[Float[Array, "B T"]],
    surfel: dict[str, Float[Array, "B 1"]],
    *,
    phase: str,
    g: Float[Array, ""] | Sequence[Float[Array, "B T"]] | None = None,
    table: PhaseTable | None = None,
) -> list[Float[Array, "B T"]]:
    """For each sample cos(surfel) phase / (d2 + delta) inside the shell, else 0, without `phase_scale`.

    `ray` is the unit direction (by component), `surfel` the row's columns with x, y, z = surfel minus the rays' common
    origin. `g` may be given per sample. With `lx` etc. in the row the Phong lobe (n+2)/(2 pi) cos^n multiplies the cosine.
    """
    wx, wy, wz = ray
    b = -(wx * surfel["x"] + wy * surfel["y"] + wz * surfel["z"])
    qx, qy, qz = (-surfel[a] - b * w for a, w in zip("xyz", ray, strict=True))
    h2 = qx * qx + qy * qy + qz * qz  # from the vector: |v|^2 - b^2 would cancel
    f = wx * surfel["nx"] + wy * surfel["ny"] + wz * surfel["nz"]
    e = qx * surfel["nx"] + qy * surfel["ny"] + qz * surfel["nz"]
    glossy = "lx" in surfel
    if glossy:
        lobe_f = wx * surfel["lx"] + wy * surfel["ly"] + wz * surfel["lz"]
        lobe_e = qx * surfel["lx"] + qy * surfel["ly"] + qz * surfel["lz"]
    cosines = list(g) if isinstance(g, (list, tuple)) else [g] * len(distances)
    values = []
    for d, mean_cosine in zip(distances, cosines, strict=True):
        u = d + b
        d2 = h2 + u * u
        value = jnp.maximum(e + u * f, 0.0)
        value = jnp.where((d2 >= surfel["inner2"]) & (d2 < surfel["outer2"]), value, 0.0)
        d2 = d2 + surfel["delta"]
        if phase == "isotropic":
            value = value / (d2 * jnp.sqrt(d2))
        elif phase == "henyey_greenstein":
            a = jnp.clip(mean_cosine, -MAX_ABS_G, MAX_ABS_G)
            x = (1.0 + a * a) * d2 + 2.0 * a * u * jnp.sqrt(d2)
            # Its least value, lost to rounding; a little less, so that no tie at g = 0 halves the gradient.
            x = jnp.maximum(x, 0.999 * (1.0 - jnp.abs(a)) * (1.0 - jnp.abs(a)) * d2)
            value = value / (x * jnp.sqrt(x))
        else:
            root = jnp.sqrt(d2)
            value = value / (d2 * root) * phase_functions.evaluate_table(table, -u / root)
        if glossy:
            cos_lobe = jnp.maximum((lobe_e + u * lobe_f) / jnp.sqrt(d2), 0.0)
            power = lax.exp(surfel["exponent"] * lax.log(jnp.maximum(cos_lobe, 1e-30)))
            value = value * power * ((surfel["exponent"] + 2.0) * (0.5 / math.pi))
        values.append(value)
    return values
