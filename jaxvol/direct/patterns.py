"""Low-discrepancy point sets: positions inside a pixel, directions towards lights, shifts of steps.

All are deterministic for a seed. Positions inside a pixel and shifts of steps are the same in every pixel (smooth
integrands, midpoint accuracy; edges are off by at most half a lattice step); sets over lights and directions are shifted
by a hash of the pixel (Cranley and Patterson 1976), so that what error remains is unbiased noise instead of bands.
"""

import math

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxvol import sampling

_STREAM = sampling.stream("direct")


def kronecker_ratios(num_dimensions: int) -> tuple[float, ...]:
    """Steps of the R_d sequence (Roberts 2018): powers of 1/x, x the root of x^(d+1) = x + 1."""
    x = 2.0
    for _ in range(64):
        x = (1.0 + x) ** (1.0 / (num_dimensions + 1))
    return tuple(x**-k for k in range(1, num_dimensions + 1))


def pixel_lattice(num: int) -> Float[np.ndarray, "num 2"]:
    """Positions inside a pixel: a rank-1 lattice whose x, y and (with `step_shift`) t are each equally spaced midpoints."""
    index = np.arange(num)
    first = _coprime(num, 0.618, ())
    second = _coprime(num, 0.414, (first, num - first))
    return (np.stack([index * first % num, index * second % num], axis=1) + 0.5) / num


def _coprime(num, ratio, taken):
    """The factor nearest to ratio * num that is coprime to num and, if possible, not taken (nor 1, the steps' own)."""
    candidates = [k for k in range(1, num + 1) if math.gcd(k, num) == 1]
    free = [k for k in candidates if k not in (*taken, 1, num - 1)] or candidates
    return min(free, key=lambda k: abs(k - ratio * num))


def step_shift(sample: Int[Array, "n"], num_samples: int) -> Float[Array, "n"]:
    """Where in each step the node lies, in (0, 1): all samples of a pixel together make a finer midpoint rule."""
    return (sample.astype(jnp.float32) + 0.5) / num_samples


def shifted(
    seed, pixel: Int[Array, "n"], index: Int[Array, "*m n"], dimension: int, num_dimensions: int
) -> tuple[Float[Array, "*m n"], ...]:
    """Point `index` of the R_d sequence, shifted per pixel; up to four coordinates in (0, 1). `dimension` names the set.

    The sequence's phase is kept to 24 bits by integer arithmetic, so that large indices lose nothing.
    """
    shift = sampling.uniforms(seed, _STREAM, pixel, dimension)
    found = []
    for ratio, start in zip(kronecker_ratios(num_dimensions), shift, strict=False):
        phase = jnp.asarray(index, jnp.uint32) * jnp.uint32(round(ratio * 2**32))
        phase = phase + (start * 2.0**32).astype(jnp.uint32)
        found.append(((phase >> 9).astype(jnp.float32) + 0.5) * jnp.float32(2.0**-23))
    return tuple(found)
