"""Stage 2, light of one emitter at receivers: scattered once, and more often (section 5; specification 4 and 8b).

The tables hold responses of an infinite medium. A surface stops the light that such a medium would scatter back through
it, so from the second scattering on the response of an image source is taken off: the emitter mirrored at the plane
where the fluence would vanish, 0.7104 transport mean free paths behind the receiver (the Milne problem). The paper
does without; `image=False` is its mode.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxvol.methods.impulse_response import lookup, shading
from jaxvol.methods.impulse_response.lookup import Responses
from jaxvol.sampling import dot

EXTRAPOLATION = 0.7104460896  # transport mean free paths, Milne problem
Arrivals = tuple[Float[Array, "*b 3"], Float[Array, "*b 3"]]  # irradiance scattered once, and more often


def _rgb(value):
    return jnp.broadcast_to(value, (*value.shape[:-1], 3))


def _sigma(tau, distance):
    """Effective sigma_t of the segment, kept away from 0 where it is divided by."""
    return jnp.maximum(tau / distance[..., None], 1e-6)


def _mirrored(responses, direction, distance, normal, sigma):
    """The image of an emitter, per channel: way to it [*b 3 xyz], its distance and optical distance, and whether there is one.

    The way is measured from the receiver; emitters below the receiver's plane have no image.
    """
    height = distance * dot(direction, normal)
    depth = 2 * (height[..., None] + EXTRAPOLATION / (responses.transport * sigma))
    way = (distance[..., None] * direction)[..., None, :] - depth[..., None] * normal[..., None, :]
    away = jnp.sqrt(dot(way, way))
    return way / away[..., None], away, sigma * away, height > 0


def point_arrivals(
    responses: Responses,
    normal: Float[Array, "*b 3"],
    direction: Float[Array, "*b 3"],
    distance: Float[Array, "*b"],
    tau: Float[Array, "*b 3"],
    *,
    image: bool,
) -> Arrivals:
    """Scattered irradiance from a point source of intensity 1 at `distance` in `direction`; tau of the segment, RGB."""
    cosine = dot(normal, direction)
    far = _rgb(distance[..., None])
    once, more = lookup.compact_source(responses.point, responses.albedo, tau, far, None)
    first = _rgb(shading.zonal_irradiance(once, cosine))
    if more is None:
        return first, jnp.zeros_like(first)
    rest = _rgb(shading.zonal_irradiance(more, cosine))
    if image:
        way, away, thick, present = _mirrored(responses, direction, distance, normal, _sigma(tau, distance))
        again, further = lookup.compact_source(responses.point, responses.albedo, thick, away, None)
        taken = _by_channel(again + further, dot(way, normal[..., None, :]))
        rest = rest - jnp.where(present[..., None], _rgb(taken), 0)
    return first, rest


def _by_channel(radiance, cosine):
    parts = [shading.zonal_irradiance(radiance[..., c : c + 1, :], cosine[..., c]) for c in range(radiance.shape[-2])]
    return jnp.concatenate(parts, axis=-1)


def directional_arrivals(
    responses: Responses,
    normal: Float[Array, "*b 3"],
    direction: Float[Array, "*b 3"],
    tau: Float[Array, "*b 3"],
    *,
    image: bool,
) -> Arrivals:
    """Scattered irradiance from a directional light of irradiance 1 from `direction`; tau of the way out of the medium, RGB.

    The medium is taken as a half-space whose top is perpendicular to the light (specification 2).
    """
    cosine = dot(normal, direction)
    once, more = lookup.directional_source(responses.directional, responses.albedo, tau)
    first = _rgb(shading.zonal_irradiance(once, cosine))
    if more is None:
        return first, jnp.zeros_like(first)
    rest = _rgb(shading.zonal_irradiance(more, cosine))
    if image:
        deeper = tau + 2 * EXTRAPOLATION / responses.transport
        again, further = lookup.directional_source(responses.directional, responses.albedo, deeper)
        taken = _rgb(shading.zonal_irradiance(again + further, -cosine))
        rest = rest - jnp.where((cosine > 0)[..., None], taken, 0)
    return first, rest


def patch_arrivals(
    responses: Responses,
    normal: Float[Array, "*b 3"],
    direction: Float[Array, "*b 3"],
    distance: Float[Array, "*b"],
    emitter_normal: Float[Array, "*b 3"],
    tau: Float[Array, "*b 3"],
    *,
    image: bool,
) -> Arrivals:
    """Scattered irradiance from a Lambertian patch with Le dA = 1; `emitter_normal` is the side that radiates."""
    far = _rgb(distance[..., None])
    facing = _rgb(-dot(emitter_normal, direction)[..., None])
    once, more = lookup.compact_source(responses.area, responses.albedo, tau, far, facing)
    frame = shading.emitter_frame(direction, emitter_normal)
    first = _rgb(shading.half_irradiance(once, frame, normal))
    if more is None:
        return first, jnp.zeros_like(first)
    rest = _rgb(shading.half_irradiance(more, frame, normal))
    if image:
        way, away, thick, present = _mirrored(responses, direction, distance, normal, _sigma(tau, distance))
        present = present | (dot(direction, normal) > -1e-3)  # patches in the receiver's own plane have their image below it
        turned = emitter_normal - 2 * dot(emitter_normal, normal)[..., None] * normal
        facing = -dot(turned[..., None, :], way)
        again, further = lookup.compact_source(responses.area, responses.albedo, thick, away, facing)
        parts = []
        for c in range(len(responses.area)):
            frame = shading.emitter_frame(way[..., c, :], turned)
            parts.append(shading.half_irradiance((again + further)[..., c : c + 1, :], frame, normal))
        rest = rest - jnp.where(present[..., None], _rgb(jnp.concatenate(parts, axis=-1)), 0)
    return first, rest
