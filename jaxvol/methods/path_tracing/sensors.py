"""Where paths begin: the pixels of a camera, given rays, or points whose irradiance or fluence is asked for."""

import math

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxvol import camera as cameras
from jaxvol import sampling
from jaxvol.types import Camera, Rays


class RaySensor(eqx.Module):
    """Radiance along given rays: one estimate a ray."""

    rays: Rays  # origin, direction [P, 3]; t_max is not used


class IrradianceSensor(eqx.Module):
    """Irradiance on one side of small planes, W/m2."""

    position: Float[Array, "P 3"]
    normal: Float[Array, "P 3"]


class FluenceSensor(eqx.Module):
    """Fluence (radiance over all directions) at points, W/m2."""

    position: Float[Array, "P 3"]


Sensor = Camera | RaySensor | IrradianceSensor | FluenceSensor


def num_pixels(sensor: Sensor) -> int:
    """How many estimates the sensor asks for."""
    if isinstance(sensor, Camera):
        return sensor.height * sensor.width
    if isinstance(sensor, RaySensor):
        return sensor.rays.origin.shape[0]
    return sensor.position.shape[0]


def sees_light(sensor: Sensor) -> bool:
    """Whether the sensor gathers from a solid angle, so that delta lights reach it directly."""
    return isinstance(sensor, IrradianceSensor | FluenceSensor)


def sample_ray(
    sensor: Sensor, pixel: Int[Array, "n"], u1: Float[Array, "n"], u2: Float[Array, "n"]
) -> tuple[Float[Array, "n 3"], Float[Array, "n 3"], Float[Array, "n"], Float[Array, "n"]]:
    """Origin, direction, weight and solid-angle pdf (0 for a camera, which samples no solid angle) of a first ray.

    A camera pixel is averaged over its square (box filter).
    """
    zeros = jnp.zeros_like(u1)
    if isinstance(sensor, Camera):
        row = pixel // sensor.width
        xy = jnp.stack([pixel - row * sensor.width + u1, row + u2], axis=-1)
        rays = cameras.generate_rays(sensor, xy)
        return rays.origin, rays.direction, zeros + 1.0, zeros
    if isinstance(sensor, RaySensor):
        return sensor.rays.origin[pixel], sensor.rays.direction[pixel], zeros + 1.0, zeros
    position = sensor.position[pixel]
    if isinstance(sensor, IrradianceSensor):
        normal = sensor.normal[pixel]
        direction = sampling.sample_cosine_hemisphere(u1, u2, normal)
        pdf = sampling.sample_cosine_hemisphere_pdf(sampling.dot(normal, direction))
        return position, direction, zeros + math.pi, pdf
    return position, sampling.sample_uniform_sphere(u1, u2), zeros + 4.0 * math.pi, zeros + 1.0 / (4.0 * math.pi)


def response(
    sensor: Sensor, pixel: Int[Array, "n"], direction: Float[Array, "n 3"]
) -> tuple[Float[Array, "n"], Float[Array, "n"]]:
    """Weight of radiance from `direction` (away from the sensor), and the pdf of `sample_ray` there; irradiance, fluence."""
    if isinstance(sensor, IrradianceSensor):
        cosine = jnp.maximum(sampling.dot(sensor.normal[pixel], direction), 0.0)
        return cosine, sampling.sample_cosine_hemisphere_pdf(cosine)
    ones = jnp.ones(direction.shape[:-1], jnp.float32)
    return ones, ones / (4.0 * math.pi)
