"""Surface reflection: two-sided Lambert plus a normalised Phong lobe, with sampler and pdf.

Directions are unit vectors along travel: `incoming` arrives at the surface, `outgoing` leaves it. The normal is turned
against `incoming`, so that both sides reflect alike. The model is reciprocal, so light paths and eye paths share it.
"""

import math

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

from jaxvol.sampling import direction_about, dot, sample_cosine_hemisphere
from jaxvol.types import Mesh

_INV_PI = 1.0 / math.pi


class Surface(eqx.Module):
    """The material at points of a mesh."""

    albedo: Float[Array, "*b 3"]
    specular: Float[Array, "*b 3"] | None = None
    exponent: Float[Array, "*b"] | None = None


def surface_at(mesh: Mesh, face: Int[Array, "*b"]) -> Surface:
    """The material of faces; -1 (a miss) reads some face's, to be masked by the caller."""
    face = jnp.maximum(face, 0)
    if mesh.specular is None:
        return Surface(albedo=mesh.albedo[face])
    return Surface(albedo=mesh.albedo[face], specular=mesh.specular[face], exponent=mesh.exponent[face])


def facing_normal(normal: Float[Array, "*b 3"], incoming: Float[Array, "*b 3"]) -> Float[Array, "*b 3"]:
    """The normal turned against the incoming travel."""
    return jnp.where((dot(normal, incoming) > 0)[..., None], -normal, normal)


def mirror(normal: Float[Array, "*b 3"], incoming: Float[Array, "*b 3"]) -> Float[Array, "*b 3"]:
    """The travel direction after an ideal reflection."""
    return incoming - 2.0 * dot(normal, incoming)[..., None] * normal


def _integer_or_real_power(base, exponent):
    """base ** exponent for base in [0, 1] and exponent >= 0 as exp2(exponent log2 base): 0 ** 0 = 1, no NaN gradient."""
    safe = jnp.maximum(base, 1e-30)
    value = lax.exp(exponent * lax.log(safe))
    return jnp.where(base > 0, value, jnp.where(exponent > 0, 0.0, 1.0))


def evaluate(
    surface: Surface, normal: Float[Array, "*b 3"], incoming: Float[Array, "*b 3"], outgoing: Float[Array, "*b 3"]
) -> Float[Array, "*b 3"]:
    """BSDF without the cosine, 1/sr: albedo / pi + specular (n+2)/(2 pi) cos^n(mirror, outgoing); 0 below the surface."""
    n = facing_normal(normal, incoming)
    value = surface.albedo * _INV_PI
    if surface.specular is not None:
        cos_lobe = jnp.maximum(dot(mirror(n, incoming), outgoing), 0.0)
        lobe = (surface.exponent + 2.0) * (0.5 * _INV_PI) * _integer_or_real_power(cos_lobe, surface.exponent)
        value = value + surface.specular * lobe[..., None]
    return jnp.where((dot(n, outgoing) > 0)[..., None], value, 0.0)


def _specular_probability(surface):
    diffuse = jnp.max(surface.albedo, axis=-1)
    specular = jnp.max(surface.specular, axis=-1)
    return specular / jnp.maximum(diffuse + specular, 1e-12)


def sample(
    surface: Surface,
    normal: Float[Array, "*b 3"],
    incoming: Float[Array, "*b 3"],
    u1: Float[Array, "*b"],
    u2: Float[Array, "*b"],
    u3: Float[Array, "*b"],
) -> Float[Array, "*b 3"]:
    """An outgoing direction with density `sample_pdf`: the cosine lobe, or with the lobes' share the Phong lobe.

    The Phong lobe may point below the surface, where `evaluate` is zero.
    """
    n = facing_normal(normal, incoming)
    diffuse = sample_cosine_hemisphere(u1, u2, n)
    if surface.specular is None:
        return diffuse
    cos_lobe = _integer_or_real_power(u1, 1.0 / (surface.exponent + 1.0))
    glossy = direction_about(mirror(n, incoming), cos_lobe, jnp.sqrt(jnp.maximum((1.0 - cos_lobe) * (1.0 + cos_lobe), 0.0)), u2)
    return jnp.where((u3 < _specular_probability(surface))[..., None], glossy, diffuse)


def sample_pdf(
    surface: Surface, normal: Float[Array, "*b 3"], incoming: Float[Array, "*b 3"], outgoing: Float[Array, "*b 3"]
) -> Float[Array, "*b"]:
    """Solid-angle density of `sample`, 1/sr."""
    n = facing_normal(normal, incoming)
    diffuse = jnp.maximum(dot(n, outgoing), 0.0) * _INV_PI
    if surface.specular is None:
        return diffuse
    cos_lobe = jnp.maximum(dot(mirror(n, incoming), outgoing), 0.0)
    glossy = (surface.exponent + 1.0) * (0.5 * _INV_PI) * _integer_or_real_power(cos_lobe, surface.exponent)
    share = _specular_probability(surface)
    return share * glossy + (1.0 - share) * diffuse
