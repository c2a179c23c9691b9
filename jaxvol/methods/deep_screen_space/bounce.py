"""A second surface bounce before the splat: lit surfels light all surfels (not in the paper).

Every surfel is connected to a few lit ones drawn in proportion to the power they send, as if these were lights: visibility
and extinction are those of `lighting`. The result is L S S V E, a share of the layer `volume_from_multiple`, which is never
claimed. Lambertian surfaces only: lobes neither send nor receive here.
"""

import dataclasses

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, UInt

from jaxvol import ray_casting, sampling
from jaxvol.methods.deep_screen_space import lighting
from jaxvol.methods.deep_screen_space.lighting import Connections, LitSurfels
from jaxvol.methods.deep_screen_space.surfels import Surfels
from jaxvol.types import Mesh

_STREAM = sampling.stream("deep_screen_space.bounce")
_INV_PI = 0.3183098861837907


@jax.jit
def _connect(lit: LitSurfels, surfels: Surfels, u: Float[Array, "K S"]) -> Connections:
    """Connections to the senders at `u` of the power's distribution: irradiance L A cos cos / (d^2 + A/pi) / (K p).

    A/pi, the sender's squared radius, makes the point the disk on its axis: pi r^2 / (d^2 + r^2).
    """
    power = lit.area * jnp.max(lit.radiance, axis=-1)
    cdf = jnp.cumsum(power)
    sender = jnp.minimum(jnp.searchsorted(cdf, u * cdf[-1], side="right"), power.shape[0] - 1)
    delta = lit.position[sender] - surfels.position
    squared = sampling.dot(delta, delta)
    soft = squared + lit.area[sender] * _INV_PI
    distance = jnp.sqrt(jnp.where(squared > 0, squared, 1.0))
    direction = delta / distance[..., None]
    sent = jnp.maximum(-sampling.dot(lit.normal[sender], direction), 0.0)
    received = jnp.abs(sampling.dot(surfels.normal, direction))
    share = power[sender] * (u.shape[0] / cdf[-1])  # K p
    factor = lit.area[sender] * sent * received / (soft * jnp.where(share > 0, share, 1.0))
    factor = jnp.where((share > 0) & (squared > 0) & surfels.valid, factor, 0.0)
    return Connections(direction, jnp.where(squared > 0, distance, 0.0), lit.radiance[sender] * factor[..., None])


def connect(lit: LitSurfels, surfels: Surfels, seed: UInt[Array, ""], *, num_connections: int) -> Connections:
    """`num_connections` senders of every surfel, stratified over the power of the senders in the order of `lit`."""
    shift = sampling.uniforms(seed, _STREAM, jnp.arange(surfels.area.shape[0]), 0)[0]
    u = (jnp.arange(num_connections, dtype=jnp.float32)[:, None] + shift) / num_connections
    return _connect(lit, surfels, u)


def illuminate(
    lit: LitSurfels,
    surfels: Surfels,
    mesh: Mesh,
    caster: ray_casting.Caster,
    transmittance,
    *,
    seed: int,
    num_connections: int,
) -> LitSurfels:
    """What the Lambertian sides of `surfels` send of the light of `lit`; unbiased over seeds for the disks as points.

    `transmittance(origin, direction, distance) -> [n, 3]` of segments. Eager: casts rays.
    """
    connections = connect(lit, surfels, jnp.uint32(seed), num_connections=num_connections)
    connections = lighting.shadow(connections, surfels, caster, scale=float(ray_casting.scene_scale(mesh)))
    connections = lighting.attenuate(connections, surfels, transmittance)
    return lighting.emit(surfels, connections, dataclasses.replace(mesh, specular=None, exponent=None))[0]
