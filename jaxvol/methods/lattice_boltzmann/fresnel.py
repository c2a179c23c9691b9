"""Reflection at smooth interfaces: Fresnel's equations and the diffuse internal reflectance of a body of index n."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float


def reflectance(cosine: Float[Array, "*b"], ior: Float[Array, "*b"] | float) -> Float[Array, "*b"]:
    """Unpolarised reflectance of light that arrives in vacuum at a surface of index `ior` under the angle's `cosine`."""
    sine_inside = (1.0 - cosine * cosine) / (ior * ior)
    inside = jnp.sqrt(jnp.maximum(1.0 - sine_inside, 0.0))
    s = (cosine - ior * inside) / (cosine + ior * inside)
    p = (inside - ior * cosine) / (inside + ior * cosine)
    return 0.5 * (s * s + p * p)


def diffuse_internal(ior: float, *, num: int = 2000) -> float:
    """R_d: the share of diffuse light that a surface of index `ior` throws back inside (.596 at 1.5); host, float64.

    2 int F(mu) mu dmu from inside, total beyond the critical angle. By reciprocity 1 - R_d = (1 - R_e) / n^2 with R_e
    the same integral from outside, which is the smooth one that is summed here.
    """
    cosine = (np.arange(num) + 0.5) / num
    inside = np.sqrt(1.0 - (1.0 - cosine**2) / ior**2)
    s = (cosine - ior * inside) / (cosine + ior * inside)
    p = (inside - ior * cosine) / (inside + ior * cosine)
    outer = np.mean(0.5 * (s * s + p * p) * 2.0 * cosine)
    return float(1.0 - (1.0 - outer) / ior**2)
