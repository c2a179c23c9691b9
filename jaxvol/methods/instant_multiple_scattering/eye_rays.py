"""Eye rays: through pixels, jittered or not, and through blocks of pixels."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, UInt

from jaxvol import camera as pinhole
from jaxvol import media, ray_casting, sampling
from jaxvol.methods.instant_multiple_scattering.stages import Context
from jaxvol.types import Camera, Scene

_PIXEL = sampling.stream("instant_multiple_scattering.pixel")
STRATA = 4  # of a pixel, each way
_RECURRENCE = np.array([0.7548777, 0.5698403], np.float32)  # powers of 1/1.3247180 (Roberts 2018, two dimensions)


def block_rays(context: Context, camera: Camera, rows: int, columns: int, *, factor: int) -> tuple:
    """Eye rays through the middle of blocks of factor x factor pixels (clamped to the picture)."""
    index = jnp.arange(rows * columns, dtype=jnp.uint32)
    xy = (jnp.stack([index % columns, index // columns], axis=-1).astype(jnp.float32) + 0.5) * factor
    xy = jnp.minimum(xy, jnp.asarray([camera.width - 0.5, camera.height - 0.5]))
    return cast(context, camera, xy, index)


def cast(context: Context, camera: Camera, xy: Float[Array, "n 2"], index: UInt[Array, "n"]) -> tuple:
    """Origins, directions, first hits (t, face) of the eye rays through `xy`, and the given numbers."""
    rays = _generate_rays(camera, xy)
    t, face = np.full(index.shape, np.inf, np.float32), np.full(index.shape, -1, np.int32)
    if context.scene.mesh is not None:
        t, face = ray_casting.intersect(context.caster, rays.origin, rays.direction, t)
    return rays.origin, rays.direction, jnp.asarray(t), jnp.asarray(face), index


_generate_rays = jax.jit(pinhole.generate_rays)


def lanes(pixels: UInt[np.ndarray, "n"], edges: Bool[np.ndarray, "HW"] | None, number: int) -> tuple:
    """(pixel, ray of it, share of it) of eye rays: one for each of `pixels`, then `number` - 1 more for those at `edges`."""
    more = np.zeros(0, np.uint32) if edges is None else pixels[edges[pixels]]
    pixel = np.concatenate([pixels, np.repeat(more, number - 1)])
    ray = np.zeros(len(pixel), np.uint32)
    ray[len(pixels) :] = np.tile(np.arange(1, number), len(more))
    share = np.ones(len(pixel), np.float32)
    if len(more):
        share[edges[pixel]] = 1.0 / number
    return pixel, ray, share


def through_pixels(
    context: Context, camera: Camera, index: UInt[Array, "n"], *, ray: UInt[Array, "n"] | None = None
) -> tuple[tuple, np.ndarray]:
    """What `gather_rays` takes for rays through pixels, and the weight [n, 1] of their values.

    `ray` numbers the rays of one pixel (None: the first of each): they are spread by an additive recurrence. Without
    surfaces a jittered ray is one of 16 strata of the pixel, chosen in proportion to 1 - exp(-length * mean extinction)
    inside the medium: a pixel at the medium's edge is then not hit or missed by chance.
    """
    scene, jitter = context.scene, context.plan.jitter
    if not jitter or scene.mesh is not None or scene.medium is None:
        xy, index = _places(camera, jnp.asarray(index), ray, context.seed, jitter=jitter)
        return cast(context, camera, xy, index), np.float32(1.0)
    index = jnp.asarray(index)
    chosen, weight = choose_in_pixel(scene, camera, _corners(camera, index), index, context.seed)
    return cast(context, camera, chosen, index), np.asarray(weight)[:, None]


@jax.jit
def _corners(camera, index):
    """Upper left corners of pixels."""
    return jnp.stack([index % camera.width, index // camera.width], axis=-1).astype(jnp.float32)


@partial(jax.jit, static_argnames="jitter")
def _places(camera, index, ray, seed, *, jitter):
    """Places in pixels, and numbers that no two rays share."""
    corner = _corners(camera, index)
    if not jitter:
        return corner + 0.5, index
    inside = jnp.stack(sampling.uniforms(seed, _PIXEL, index, 0)[:2], axis=-1)
    if ray is None:
        return corner + inside, index
    inside = (inside + ray[:, None] * _RECURRENCE) % 1.0
    return corner + inside, index + ray * jnp.uint32(camera.height * camera.width)


@jax.jit
def choose_in_pixel(
    scene: Scene, camera: Camera, xy: Float[Array, "n 2"], index: UInt[Array, "n"], seed: UInt[Array, ""]
) -> tuple[Float[Array, "n 2"], Float[Array, "n"]]:
    """A place in each pixel (its upper left corner is `xy`) by how much medium lies behind it, and 1 / (16 p)."""
    u = sampling.uniforms(seed, _PIXEL, index, 0)
    strata = jnp.arange(STRATA * STRATA)
    corner = jnp.stack([strata % STRATA, strata // STRATA], axis=-1)
    inside = (corner + jnp.stack(u[:2], axis=-1)[:, None]) / STRATA
    places = xy[:, None] + inside
    rays = pinhole.generate_rays(camera, places)
    t0, t1 = media.box_interval(scene.medium.bounds, rays.origin, rays.direction)
    density = 1.0 if scene.medium.density is None else jnp.mean(scene.medium.density)
    share = -jnp.expm1(-(t1 - t0) * density * jnp.mean(media.sigma_t(scene.medium)))
    cumulative = jnp.cumsum(share, axis=1)
    total = cumulative[:, -1]
    pick = jnp.minimum(jnp.sum(cumulative < (u[2] * total)[:, None], axis=1), strata.size - 1)
    lanes = jnp.arange(index.shape[0])
    weight = jnp.where(total > 0, total / strata.size / jnp.maximum(share[lanes, pick], 1e-30), 0.0)
    return places[lanes, pick], weight
