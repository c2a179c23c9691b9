"""Reconstruction: unshuffle every level into the image, blur the noise of its sub-sampling, sum (paper sections 3.2, 4.2).

The paper replaces each level by the next level of its own Gaussian MIP map, which smears light over the border of the
medium. `demodulated` divides the opacity out first: C' = omt blur^l(C)/blur^l(omt); level 0 is not blurred, level l as
often as its pixels were halved. Biased by a few per cent where radiance per opacity varies within 2^l pixels.
"""

from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

MODES = ("demodulated", "paper", "none")


@partial(jax.jit, static_argnames=("num_pixels",))
def unshuffle(
    tiles: Float[Array, "tiles 3 T"], slot: Int[Array, "A"], pixel: Int[Array, "A"], *, num_pixels: int
) -> Float[Array, "P 3"]:
    """From the tiles of a level to the image; pixels without medium are 0. Padding has pixel >= num_pixels."""
    values = jnp.swapaxes(tiles, 1, 2).reshape(-1, 3)[slot]
    return jnp.zeros((num_pixels, 3), jnp.float32).at[pixel].set(values, mode="drop", unique_indices=True)


def _halve(image):
    """Every other pixel of the image filtered by [1 4 6 4 1]/16 in both axes; the border is held."""
    for axis in (0, 1):
        size = image.shape[axis]
        out = -(-size // 2)
        width = [(0, 0)] * image.ndim
        width[axis] = (2, 2 + 2 * out - size)
        padded = jnp.pad(image, width, mode="edge")
        taps = [jax.lax.slice_in_dim(padded, k, k + 2 * out - 1, stride=2, axis=axis) for k in range(5)]
        image = (taps[0] + taps[4] + 4.0 * (taps[1] + taps[3]) + 6.0 * taps[2]) * (1.0 / 16.0)
    return image


def _double(image, shape):
    """Twice the size by linear interpolation: sample k of the coarse image sits on pixel 2 k, as `_halve` put it."""
    for axis in (0, 1):
        size = image.shape[axis]
        following = jnp.concatenate(
            [jax.lax.slice_in_dim(image, 1, size, axis=axis), jax.lax.slice_in_dim(image, size - 1, size, axis=axis)], axis
        )
        both = jnp.stack([image, 0.5 * (image + following)], axis=axis + 1)
        image = both.reshape(*image.shape[:axis], 2 * size, *image.shape[axis + 1 :])
        image = jax.lax.slice_in_dim(image, 0, shape[axis], axis=axis)
    return image


def blur(image: Float[Array, "H W C"], *, times: int) -> Float[Array, "H W C"]:
    """The image halved `times` times and brought back."""
    shapes = []
    for _ in range(times):
        shapes.append(image.shape)
        image = _halve(image)
    for shape in reversed(shapes):
        image = _double(image, shape)
    return image


@partial(jax.jit, static_argnames=("mode",))
def reconstruct(
    levels: tuple[Float[Array, "H W 3"], ...], opacity: Float[Array, "H W"], *, mode: str = "demodulated"
) -> Float[Array, "H W 3"]:
    """The sum of the blurred levels. `opacity` (1 - tau_min, mean of the channels) steers the demodulated blur only."""
    total = jnp.zeros_like(levels[0])
    for level, image in enumerate(levels):
        if mode == "paper":
            total = total + blur(image, times=level + 1)
        elif mode == "none" or level == 0:
            total = total + image
        else:
            stacked = blur(jnp.concatenate([image, opacity[..., None]], axis=-1), times=level)
            share = stacked[..., :3] / jnp.maximum(stacked[..., 3:], 1e-6)
            total = total + opacity[..., None] * share
    return total
