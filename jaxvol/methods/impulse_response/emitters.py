"""Stage 2, light of one emitter at receivers: scattered once, and more often (section 5; specification 4 and 8b).

The tables hold responses of an infinite medium. A surface stops the light that such a medium would scatter back through
it, so from the second scattering on the response of an image source is taken off: the emitter mirrored at the plane
where the fluence would vanish, some transport mean free paths behind the receiver. The Milne problem has 0.7104 of them
far from the light; 0.6 leaves the smaller error of irradiance (albedo 0.5 to 0.99, g = -0.5 to 0.5, lights 0.3 to 3 mean free
paths up: at most 3.5 % against 6.5 %, experiments/bake_open_plane.py). The paper does without; `image=False` is its mode.
`pick` holds random numbers for lookups of single nodes.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxvol.methods.impulse_response import lookup, shading
from jaxvol.methods.impulse_response.lookup import Pick, Responses
from jaxvol.methods.impulse_response.receivers import Receiver, like
from jaxvol.sampling import dot

EXTRAPOLATION = 0.6  # transport mean free paths
Arrivals = tuple[Float[Array, "n *rows 3"], Float[Array, "n *rows 3"]]  # what the receiver makes of light scattered once, more


def _rgb(value):
    return jnp.broadcast_to(value, (*value.shape[:-1], 3))


def _where(mask, value):
    return jnp.where(mask.reshape(mask.shape + (1,) * (value.ndim - 1)), value, 0)


def _channels(parts):
    """RGB from what a receiver made of each channel alone; a grey medium has one part, good for all three."""
    if len(parts) == 1:
        return _rgb(parts[0])
    return jnp.concatenate([part[..., c : c + 1] if part.shape[-1] == 3 else part for c, part in enumerate(parts)], axis=-1)


def _sigma(tau, distance):
    """Effective sigma_t of the segment, kept away from 0 where it is divided by."""
    return jnp.maximum(tau, 1e-6) / distance[..., None]


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
    receiver: Receiver,
    direction: Float[Array, "n 3"],
    distance: Float[Array, "n"],
    tau: Float[Array, "n 3"],
    *,
    image: bool,
    pick: Pick | None = None,
) -> Arrivals:
    """Scattered light of a point source of intensity 1 at `distance` in `direction`; tau of the segment, RGB."""
    far = _rgb(distance[..., None])
    once, more = lookup.compact_source(responses.point, responses.albedo, tau, far, None, pick=pick)
    first = _rgb(receiver.zonal(once, direction))
    if more is None:
        return first, jnp.zeros_like(first)
    rest = _rgb(receiver.zonal(more, direction))
    if image:
        way, away, thick, present = _mirrored(responses, direction, distance, receiver.normal, _sigma(tau, distance))
        again, further = lookup.compact_source(responses.point, responses.albedo, thick, away, None, pick=pick)
        taken = [receiver.zonal((again + further)[:, c : c + 1], way[:, c]) for c in range(len(responses.point))]
        rest = rest - _where(present, _channels(taken))
    return first, rest


def slab_share(
    kappa: Float[Array, "C"], tau: Float[Array, "n 3"], below: Float[Array, "n 3"] | float, transport: Float[Array, "3"]
) -> Float[Array, "n 3"]:
    """Fluence in a slab lit from above over that in the half-space of the tables, by diffusion with extrapolated boundaries.

    At depth tau, `below` (optical) over the slab's lower face: sinh(kappa (below + z)) / sinh(kappa (tau + below + 2 z)) over
    exp(-kappa (tau + z)), z the extrapolation. A half-space of no absorption stays lit at any depth, a slab loses light below.
    """
    z = EXTRAPOLATION / transport
    rate = 2 * jnp.maximum(kappa, 1e-3)
    return jnp.expm1(-rate * (below + z)) / jnp.expm1(-rate * (tau + below + 2 * z))


def directional_arrivals(
    responses: Responses,
    receiver: Receiver,
    direction: Float[Array, "n 3"],
    tau: Float[Array, "n 3"],
    *,
    image: bool,
    pick: Pick | None = None,
) -> Arrivals:
    """Scattered light of a directional light of irradiance 1 from `direction`; tau of the way out of the medium, RGB.

    The medium is taken as a half-space whose top is perpendicular to the light (specification 2), with `image` as a slab that
    ends at the receiver: an image source would take off more than there is.
    """
    once, more = lookup.directional_source(responses.directional, responses.albedo, tau, pick=pick)
    first = _rgb(receiver.zonal(once, direction))
    if more is None:
        return first, jnp.zeros_like(first)
    rest = _rgb(receiver.zonal(more, direction))
    if image:
        kappa = jnp.stack([grid.kappa for grid in responses.directional])
        # Twice the share: on a plane deep inside, half of the fluence comes from below, and there is no below here.
        share = jnp.minimum(2 * slab_share(kappa, tau, 0.0, responses.transport), 1.0)
        rest = like(share, rest) * rest
    return first, rest


def patch_arrivals(
    responses: Responses,
    receiver: Receiver,
    direction: Float[Array, "n 3"],
    distance: Float[Array, "n"],
    emitter_normal: Float[Array, "n 3"],
    tau: Float[Array, "n 3"],
    *,
    image: bool,
    pick: Pick | None = None,
) -> Arrivals:
    """Scattered light of a Lambertian patch with Le dA = 1; `emitter_normal` is the side that radiates."""
    far = _rgb(distance[..., None])
    facing = _rgb(-dot(emitter_normal, direction)[..., None])
    once, more = lookup.compact_source(responses.area, responses.albedo, tau, far, facing, pick=pick)
    frame = shading.emitter_frame(direction, emitter_normal)
    first = _rgb(receiver.half(once, frame))
    if more is None:
        return first, jnp.zeros_like(first)
    rest = _rgb(receiver.half(more, frame))
    if image:
        normal = receiver.normal
        way, away, thick, present = _mirrored(responses, direction, distance, normal, _sigma(tau, distance))
        present = present | (dot(direction, normal) > -1e-3)  # patches in the receiver's own plane have their image below it
        turned = emitter_normal - 2 * dot(emitter_normal, normal)[..., None] * normal
        facing = -dot(turned[..., None, :], way)
        again, further = lookup.compact_source(responses.area, responses.albedo, thick, away, facing, pick=pick)
        taken = []
        for c in range(len(responses.area)):
            frame = shading.emitter_frame(way[..., c, :], turned)
            taken.append(receiver.half((again + further)[:, c : c + 1], frame))
        rest = rest - _where(present, _channels(taken))
    return first, rest
