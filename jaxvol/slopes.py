"""Roots, quotients and maxima whose slopes are finite where those of the plain operations are not."""

import functools

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float


def root(x: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """sqrt(max(x, 0)), with slope 0 where that is 0."""
    positive = x > 0
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, x, 1.0)), 0.0)


def ratio(a: Float[Array, "*n"], b: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """a / b for b > 0, else 0; in units of b, as the square of a small b, by which the slope is divided, underflows."""
    positive = b > 0
    unit = lax.stop_gradient(jnp.where(positive, b, 1.0))
    return jnp.where(positive, a / unit / jnp.where(positive, b / unit, 1.0), 0.0)


@jax.custom_jvp
def largest(x: Float[Array, "*b n"]) -> Float[Array, "*b"]:
    """The largest entry of the last axis, a short one, with that entry's slope.

    The slope of jnp.max is a mean over the entries that equal the maximum: 0 / 0 where a compiled program computes `x`
    twice, once for the maximum and once to compare, and contracts products and sums in one of them only.
    """
    return jnp.max(x, axis=-1)


@largest.defjvp
def _largest_jvp(primals, tangents):
    (x,), (slope,) = primals, tangents
    entries = ((x[..., i], slope[..., i]) for i in range(x.shape[-1]))
    return functools.reduce(lambda a, b: tuple(jnp.where(a[0] > b[0], c, d) for c, d in zip(a, b, strict=True)), entries)
