"""Stage 2, receivers: what is made of incident light, a linear functional of it (section 5, equation 17).

Each takes light from one direction (`straight`), zonal radiance about a direction (`zonal`) and the mirror-symmetric
radiance of a patch (`half`), and gives [n, 3], or [n, rows, 3] with several quantities at once.
"""

from math import pi

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from jaxvol import harmonics
from jaxvol.methods.impulse_response import shading
from jaxvol.sampling import dot

HARMONICS = 9  # SH of order 3
Frame = tuple[Float[Array, "n 3"], Float[Array, "n 3"], Float[Array, "n 3"]]


class Irradiance(eqx.Module):
    """Irradiance on the side of the normals, W/m2."""

    normal: Float[Array, "n 3"]

    def straight(self, direction: Float[Array, "n 3"], radiance: Float[Array, "n 3"]) -> Float[Array, "n 3"]:
        """Of light from one direction."""
        return jnp.maximum(dot(self.normal, direction), 0.0)[:, None] * radiance

    def zonal(self, radiance: Float[Array, "n C bands"], axis: Float[Array, "n 3"]) -> Float[Array, "n C"]:
        """Of zonal radiance about an axis."""
        return harmonics.zonal_irradiance(radiance, dot(self.normal, axis)[:, None])

    def half(self, radiance: Float[Array, "n C half"], frame: Frame) -> Float[Array, "n C"]:
        """Of mirror-symmetric radiance in its frame."""
        return shading.half_irradiance(radiance, frame, self.normal)


class Reflection(eqx.Module):
    """Radiance that a Lambert and Phong surface sends to the eye; `axis` is the eye's direction mirrored at the normal.

    The lobe is clipped at the horizon for direct light only; for scattered light the cosine counts at the lobe's axis.
    """

    normal: Float[Array, "n 3"]
    axis: Float[Array, "n 3"]
    albedo: Float[Array, "n 3"]
    specular: Float[Array, "n 3"]
    exponent: Float[Array, "n"]

    def straight(self, direction: Float[Array, "n 3"], radiance: Float[Array, "n 3"]) -> Float[Array, "n 3"]:
        """Of light from one direction: the exact lobe (n+2)/(2 pi) cos^n."""
        cosine = jnp.maximum(dot(self.axis, direction), 1e-30)
        lobe = (self.exponent + 2) / (2 * pi) * lax.exp(self.exponent * lax.log(cosine))
        reflected = self.albedo / pi + self.specular * lobe[:, None]
        return jnp.maximum(dot(self.normal, direction), 0.0)[:, None] * reflected * radiance

    def _glossy(self):
        along = jnp.maximum(dot(self.normal, self.axis), 0.0)
        return self.specular * (along * (self.exponent + 2) / (self.exponent + 1))[:, None]

    def zonal(self, radiance: Float[Array, "n C bands"], axis: Float[Array, "n 3"]) -> Float[Array, "n 3"]:
        """Of zonal radiance about an axis, by two O(N) products (appendix A)."""
        diffuse = harmonics.zonal_irradiance(radiance, dot(self.normal, axis)[:, None])
        glossy = shading.phong_radiance(radiance, self.exponent, dot(self.axis, axis))
        return self.albedo / pi * diffuse + self._glossy() * glossy

    def half(self, radiance: Float[Array, "n C half"], frame: Frame) -> Float[Array, "n 3"]:
        """Of mirror-symmetric radiance in its frame."""
        diffuse = shading.half_irradiance(radiance, frame, self.normal)
        order = round((2 * radiance.shape[-1]) ** 0.5 - 0.5)
        glossy = shading.half_product(radiance, shading.phong_lobe(self.exponent, order), frame, self.axis)
        return self.albedo / pi * diffuse + self._glossy() * glossy


class Incident(eqx.Module):
    """Irradiance (row 0) and the SH of order 3 of incident radiance (rows 1 to 9), direction toward the light.

    Direct light comes from above the horizon only; scattered light as the tables give it, around the whole sphere.
    """

    normal: Float[Array, "n 3"]

    def _with_irradiance(self, irradiance, coefficients):
        return jnp.concatenate([irradiance[:, None], jnp.moveaxis(coefficients, -1, 1)], axis=1)

    def straight(self, direction: Float[Array, "n 3"], radiance: Float[Array, "n 3"]) -> Float[Array, "n 10 3"]:
        """Of light from one direction."""
        above = jnp.where((dot(self.normal, direction) > 0)[:, None], radiance, 0.0)
        coefficients = above[:, :, None] * harmonics.evaluate_sh(direction, 3)[:, None, :]
        return self._with_irradiance(Irradiance(self.normal).straight(direction, radiance), coefficients)

    def zonal(self, radiance: Float[Array, "n C bands"], axis: Float[Array, "n 3"]) -> Float[Array, "n 10 C"]:
        """Of zonal radiance about an axis."""
        coefficients = harmonics.rotate_zonal(radiance[..., :3], axis[:, None, :])
        return self._with_irradiance(Irradiance(self.normal).zonal(radiance, axis), coefficients)

    def half(self, radiance: Float[Array, "n C half"], frame: Frame) -> Float[Array, "n 10 C"]:
        """Of mirror-symmetric radiance in its frame."""
        return self._with_irradiance(Irradiance(self.normal).half(radiance, frame), shading.half_to_world(radiance, frame))


Receiver = Irradiance | Reflection | Incident


def like(weight: Float[Array, "n 3"], value: Float[Array, "n *rows 3"]) -> Float[Array, "n *ones 3"]:
    """A weight per receiver and channel in the shape in which it multiplies a receiver's value."""
    return weight if value.ndim == 2 else weight[:, None, :]


def nothing(receiver: Receiver) -> Float[Array, "n *rows 3"]:
    """What a receiver makes of no light."""
    rows = (1 + HARMONICS,) if isinstance(receiver, Incident) else ()
    return jnp.zeros((receiver.normal.shape[0], *rows, 3), jnp.float32)


def first_row(value: Float[Array, "n *rows 3"]) -> Float[Array, "n 3"]:
    """The irradiance, or whatever comes first."""
    return value if value.ndim == 2 else value[:, 0]


def harmonic_name(index: int) -> str:
    """Name of an SH coefficient's channel: `sh.l1.m-1`."""
    band = int(np.sqrt(index))
    return f"sh.l{band}.m{index - band * (band + 1):+d}".replace("+0", "0")
