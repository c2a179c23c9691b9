"""Phase functions: Henyey-Greenstein and Legendre moments, each with sampler and pdf.

cos_theta = dot(incoming travel, outgoing travel); g > 0 scatters forward; values are in 1/sr and integrate to one.
"""

import math

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from jaxvol.sampling import direction_about, dot
from jaxvol.types import Medium, PhaseTable

_INV_4PI = 1.0 / (4.0 * math.pi)


def henyey_greenstein(cos_theta: Float[Array, "*b"], g: Float[Array, "*b"]) -> Float[Array, "*b"]:
    """(1 - g^2) / (4 pi (1 + g^2 - 2 g cos)^(3/2)), 1/sr.

    The denominator is (1 - |g|)^2 + 2 |g| (1 - sign(g) cos): no cancellation at the peak. As a polynomial in g it is
    smooth at g = 0, so d/dg is right there.
    """
    forward = (1.0 - g) * (1.0 - g) + 2.0 * g * (1.0 - cos_theta)
    backward = (1.0 + g) * (1.0 + g) - 2.0 * g * (1.0 + cos_theta)
    d = jnp.maximum(jnp.where(g >= 0, forward, backward), 1e-12)
    return _INV_4PI * (1.0 - g) * (1.0 + g) / (d * jnp.sqrt(d))


def sample_henyey_greenstein(u: Float[Array, "*b"], g: Float[Array, "*b"]) -> tuple[Float[Array, "*b"], Float[Array, "*b"]]:
    """(cos, sin) of a deflection with density `henyey_greenstein`, exact for every |g| < 1 including 0.

    With D = 1 - g + 2 g u: 1 - cos = 2 (1-g)^2 (1-u)(1 + g u) / D^2 and 1 + cos = 2 (1+g)^2 u (1 - g + g u) / D^2; all
    factors are positive, so that neither small g nor the peak cancels.
    """
    v = 1.0 - u  # exact
    d = jnp.where(g >= 0, (1.0 - g) + 2.0 * g * u, (1.0 + g) - 2.0 * g * v)
    inv = 1.0 / (d * d)
    one_minus = 2.0 * (1.0 - g) * (1.0 - g) * v * jnp.where(g >= 0, 1.0 + g * u, (1.0 + g) - g * v) * inv
    one_plus = 2.0 * (1.0 + g) * (1.0 + g) * u * jnp.where(g >= 0, (1.0 - g) + g * u, 1.0 - g * v) * inv
    cos_theta = jnp.where(one_minus < one_plus, 1.0 - one_minus, one_plus - 1.0)
    return cos_theta, jnp.sqrt(one_minus * one_plus)


def sample_henyey_greenstein_pdf(cos_theta: Float[Array, "*b"], g: Float[Array, "*b"]) -> Float[Array, "*b"]:
    """The phase function itself, 1/sr."""
    return henyey_greenstein(cos_theta, g)


def phase_table(moments: ArrayLike, *, num_nodes: int = 2048) -> PhaseTable:
    """A phase function from Legendre moments chi_0 = 1, chi_1 = g, ...; eager.

    p(cos) = sum_l (2l+1)/(4 pi) chi_l P_l(cos), tabulated linearly in cos on nodes that crowd towards both ends
    (cos = sin(pi x / 2)), clipped at zero and normalised: where a truncated series undershoots, that is a bias.
    Raises ValueError when chi_0 is not 1, a moment is outside [-1, 1] or not finite, or the clipped part exceeds 5 %.
    """
    chi = np.asarray(moments, np.float64)
    if chi.ndim != 1 or chi.size == 0:
        raise ValueError(f"phase moments must be a list of numbers, got an array of shape {chi.shape}")
    if not np.all(np.isfinite(chi)) or abs(chi[0] - 1.0) > 1e-6 or np.any(np.abs(chi) > 1.0 + 1e-6):
        raise ValueError("phase moments must be finite, within [-1, 1], and begin with 1")
    cos_theta = np.sin(0.5 * np.pi * np.linspace(-1.0, 1.0, num_nodes))
    order = np.arange(chi.size)
    value = np.polynomial.legendre.legval(cos_theta, chi * (2 * order + 1)) * _INV_4PI
    clipped = np.maximum(value, 0.0)
    step = np.diff(cos_theta)
    lost = 2 * np.pi * np.sum(0.5 * (clipped - value)[1:] * step + 0.5 * (clipped - value)[:-1] * step)
    if lost > 0.05:
        raise ValueError(f"phase moments give a function that is negative over {lost:.1%} of its integral (at most 5 %)")
    cumulative = np.concatenate([[0.0], np.cumsum(np.pi * (clipped[1:] + clipped[:-1]) * step)])
    to32 = lambda x: jnp.asarray(x, jnp.float32)  # noqa: E731
    return PhaseTable(
        moments=to32(chi),
        cos_theta=to32(cos_theta),
        value=to32(clipped / cumulative[-1]),
        cdf=to32(cumulative / cumulative[-1]),
    )


def evaluate_table(table: PhaseTable, cos_theta: Float[Array, "*b"]) -> Float[Array, "*b"]:
    """The tabulated phase function, linear in cos between nodes, 1/sr."""
    i, fraction = _node(table, cos_theta)
    return table.value[i] + fraction * (table.value[i + 1] - table.value[i])


def _node(table, cos_theta):
    """Interval and position in it, from the closed form of the nodes."""
    num = table.cos_theta.shape[0]
    cos_theta = jnp.clip(cos_theta, -1.0, 1.0)
    x = jnp.arcsin(cos_theta) * (1.0 / math.pi) + 0.5
    i = jnp.clip((x * (num - 1)).astype(jnp.int32), 0, num - 2)
    left, right = table.cos_theta[i], table.cos_theta[i + 1]
    return i, jnp.clip((cos_theta - left) / (right - left), 0.0, 1.0)


def sample_table(u: Float[Array, "*b"], table: PhaseTable) -> Float[Array, "*b"]:
    """A cosine with density 2 pi p(cos): the cdf inverted exactly, quadratic inside an interval."""
    i = jnp.clip(jnp.searchsorted(table.cdf, u, side="right").astype(jnp.int32) - 1, 0, table.cdf.shape[0] - 2)
    left, right = table.value[i], table.value[i + 1]
    width = table.cos_theta[i + 1] - table.cos_theta[i]
    area = jnp.clip((u - table.cdf[i]) / (2.0 * math.pi * width), 0.0, 0.5 * (left + right))
    # left f + (right - left) f^2 / 2 = area, in the form that does not cancel.
    root = jnp.sqrt(jnp.maximum(left * left + 2.0 * (right - left) * area, 0.0))
    fraction = 2.0 * area / jnp.maximum(left + root, 1e-30)
    return table.cos_theta[i] + jnp.clip(fraction, 0.0, 1.0) * width


def sample_table_pdf(cos_theta: Float[Array, "*b"], table: PhaseTable) -> Float[Array, "*b"]:
    """The tabulated phase function itself, 1/sr."""
    return evaluate_table(table, cos_theta)


def evaluate(medium: Medium, cos_theta: Float[Array, "*b"]) -> Float[Array, "*b"]:
    """The medium's phase function, 1/sr."""
    if medium.phase is None:
        return henyey_greenstein(cos_theta, medium.g)
    return evaluate_table(medium.phase, cos_theta)


def sample(
    medium: Medium, direction: Float[Array, "*b 3"], u1: Float[Array, "*b"], u2: Float[Array, "*b"]
) -> tuple[Float[Array, "*b 3"], Float[Array, "*b"]]:
    """An outgoing direction with the phase function's density about `direction`, and that density."""
    if medium.phase is None:
        cos_theta, sin_theta = sample_henyey_greenstein(u1, medium.g)
        pdf = henyey_greenstein(cos_theta, medium.g)
    else:
        cos_theta = sample_table(u1, medium.phase)
        sin_theta = jnp.sqrt(jnp.maximum((1.0 - cos_theta) * (1.0 + cos_theta), 0.0))
        pdf = evaluate_table(medium.phase, cos_theta)
    return direction_about(direction, cos_theta, sin_theta, u2), pdf


def sample_pdf(medium: Medium, direction: Float[Array, "*b 3"], outgoing: Float[Array, "*b 3"]) -> Float[Array, "*b"]:
    """The density of `sample`, 1/sr."""
    return evaluate(medium, dot(direction, outgoing))


def moments(medium: Medium, num: int) -> Float[Array, "num"]:
    """The first `num` Legendre moments of the medium's phase function: g^l, or the table's padded with zeros."""
    if medium.phase is None:
        return jnp.concatenate([jnp.ones((1,), jnp.float32), jnp.cumprod(jnp.broadcast_to(medium.g, (num - 1,)))])
    chi = medium.phase.moments[:num]
    return jnp.pad(chi, (0, num - chi.shape[0]))
