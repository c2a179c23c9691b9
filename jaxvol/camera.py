"""Pinhole camera: pixels to rays and back. Row 0 is the top; x goes right = cross(forward, up)."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from jaxvol.sampling import normalize
from jaxvol.types import Camera, Rays


def look_at(origin: ArrayLike, target: ArrayLike, up: ArrayLike) -> Float[Array, "4 4"]:
    """The rigid map from camera space (x right, y up, -z forward) to the world. Degenerate input is the caller's to refuse."""
    origin, target, up = (jnp.asarray(v, jnp.float32) for v in (origin, target, up))
    forward = normalize(target - origin)
    right = normalize(jnp.cross(forward, up))
    rotation = jnp.stack([right, jnp.cross(right, forward), -forward, origin], axis=1)
    return jnp.concatenate([rotation, jnp.asarray([[0.0, 0.0, 0.0, 1.0]], jnp.float32)], axis=0)


@jax.jit
def pixel_centers(camera: Camera) -> Float[Array, "HW 2"]:
    """(x, y) of every pixel centre, row by row from the top: the first is (0.5, 0.5)."""
    x = jnp.arange(camera.width, dtype=jnp.float32) + 0.5
    y = jnp.arange(camera.height, dtype=jnp.float32) + 0.5
    return jnp.stack(jnp.meshgrid(x, y, indexing="xy"), axis=-1).reshape(-1, 2)


@jax.jit
def generate_rays(camera: Camera, pixel_xy: Float[Array, "*batch 2"]) -> Rays:
    """Unbounded rays through positions given in pixels."""
    half_height = jnp.tan(0.5 * camera.fov_y)
    scale = 2.0 * half_height / camera.height  # square pixels
    x = (pixel_xy[..., 0] - 0.5 * camera.width) * scale
    y = (0.5 * camera.height - pixel_xy[..., 1]) * scale
    right, up, back, origin = (camera.world_from_camera[:3, i] for i in range(4))
    direction = normalize(x[..., None] * right + y[..., None] * up - back)
    return Rays(
        origin=jnp.broadcast_to(origin, direction.shape),
        direction=direction,
        t_max=jnp.full(direction.shape[:-1], jnp.inf, jnp.float32),
    )


def project(camera: Camera, points: Float[Array, "*batch 3"]) -> tuple[Float[Array, "*batch 2"], Float[Array, "*batch"]]:
    """Pixel position and depth along the view axis of world points; the position is meaningless where depth <= 0."""
    right, up, back, origin = (camera.world_from_camera[:3, i] for i in range(4))
    delta = points - origin
    depth = -(delta @ back)
    scale = 0.5 * camera.height / (jnp.tan(0.5 * camera.fov_y) * jnp.where(depth == 0, 1e-30, depth))
    x = 0.5 * camera.width + (delta @ right) * scale
    y = 0.5 * camera.height - (delta @ up) * scale
    return jnp.stack([x, y], axis=-1), depth
