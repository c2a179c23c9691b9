"""Optical thickness and transmittance along rays of one medium: closed form, deterministic marching, ratio tracking.

Density is a scalar that multiplies sigma_t (RGB), so the integral of density along the ray, its column, serves all
channels: optical thickness = column * sigma_t, transmittance = exp(-optical thickness).
"""

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, UInt

from jaxvol import media, sampling
from jaxvol.types import Medium

_STREAM = sampling.stream("ratio_tracking")


def density_column(
    medium: Medium,
    origin: Float[Array, "*b 3"],
    direction: Float[Array, "*b 3"],
    t0: Float[Array, "*b"],
    t1: Float[Array, "*b"],
    *,
    num_steps: int = 64,
) -> Float[Array, "*b"]:
    """Integral of density over [t0, t1] of each ray, in length: clipped to the bounds, closed form without a grid.

    With a grid the midpoint rule with `num_steps` steps over the part inside the bounds: an error of second order in
    the step over the voxel size, so take at least one step a voxel.
    """
    enter, leave = media.box_interval(medium.bounds, origin, direction)
    start = jnp.maximum(enter, t0)
    length = jnp.maximum(jnp.minimum(leave, t1) - start, 0.0)
    if medium.density is None:
        return length
    step = length / num_steps

    def body(i, total):
        t = start + (i + 0.5) * step
        return total + media.density(medium, origin + t[..., None] * direction)

    return step * lax.fori_loop(0, num_steps, body, jnp.zeros_like(length))


def optical_thickness(
    medium: Medium,
    origin: Float[Array, "*b 3"],
    direction: Float[Array, "*b 3"],
    t0: Float[Array, "*b"],
    t1: Float[Array, "*b"],
    *,
    num_steps: int = 64,
) -> Float[Array, "*b 3"]:
    """Integral of sigma_t over [t0, t1], RGB, dimensionless; see `density_column`."""
    column = density_column(medium, origin, direction, t0, t1, num_steps=num_steps)
    return column[..., None] * media.sigma_t(medium)


def ratio_tracking(
    medium: Medium,
    origin: Float[Array, "*b 3"],
    direction: Float[Array, "*b 3"],
    t0: Float[Array, "*b"],
    t1: Float[Array, "*b"],
    *,
    seed: UInt[Array, ""] | int,
    max_steps: int = 100_000,
) -> Float[Array, "*b 3"]:
    """Unbiased estimate of the transmittance over [t0, t1], RGB, by ratio tracking (Novak et al. 2014).

    Tentative collisions at the rate of the coarse cell's majorant times the largest channel's sigma_t; each multiplies
    the estimate by 1 - sigma_t(x) / rate. Without a grid the closed form. Batch entry i uses the counter i.
    """
    if medium.density is None:
        return jnp.exp(-optical_thickness(medium, origin, direction, t0, t1))
    enter, leave = media.box_interval(medium.bounds, origin, direction)
    start = jnp.maximum(enter, t0)
    end = jnp.minimum(leave, t1)
    extinction = media.sigma_t(medium)
    strongest = jnp.max(extinction)
    index = jnp.arange(start.size, dtype=jnp.uint32).reshape(start.shape)

    def advance(state):
        step, t, estimate = state
        dt, tentative = tentative_step(medium, origin, direction, t, end, strongest, _uniform(seed, index, 2 * step)[0])
        t = t + dt
        corner = _uniform(seed, index, 2 * step + 1)
        found = media.density_stochastic(medium, origin + t[..., None] * direction, corner[:3])
        rate = jnp.where(tentative > 0, tentative * strongest, 1.0)
        factor = 1.0 - (found / rate)[..., None] * extinction
        estimate = jnp.where((tentative > 0)[..., None], estimate * factor, estimate)
        return step + 1, t, estimate

    def unfinished(state):
        step, t, _ = state
        return (step < max_steps) & jnp.any(t < end)

    ones = jnp.ones((*start.shape, 3), jnp.float32)
    return lax.while_loop(unfinished, advance, (jnp.int32(0), start, ones))[2]


def _uniform(seed, index, dimension):
    return sampling.uniforms(seed, _STREAM, index, dimension)


def tentative_step(
    medium: Medium,
    origin: Float[Array, "*b 3"],
    direction: Float[Array, "*b 3"],
    t: Float[Array, "*b"],
    end: Float[Array, "*b"],
    sigma: Float[Array, "*b"],
    u: Float[Array, "*b"],
) -> tuple[Float[Array, "*b"], Float[Array, "*b"]]:
    """One step to the next tentative collision or coarse cell border: (dt, majorant density of the cell or 0).

    The rate of tentative collisions in a cell is its majorant density times `sigma`. 0 in the second place says that
    the step ended at the border (or at `end`) without a collision: free flights have no memory, so the next cell starts
    afresh, and an empty cell costs one step.
    """
    here = origin + t[..., None] * direction
    cell, lower, upper = media.majorant_cell(medium, here + _nudge(medium) * direction)
    bound = medium.majorants.density.reshape(-1)[cell]
    tiny = jnp.where(jnp.abs(direction) < 1e-20, jnp.where(direction < 0, -1e-20, 1e-20), direction)
    exits = (jnp.where(tiny > 0, upper, lower) - here) / tiny
    to_border = jnp.minimum(jnp.minimum(exits[..., 0], exits[..., 1]), exits[..., 2])
    # At least a sliver forward: on a border rounding may find the cell just left, and the walk must not stand still.
    room = jnp.minimum(jnp.maximum(to_border, 0.0) + _nudge(medium), end - t)
    flight = sampling.sample_exponential(u, bound * sigma)
    collides = flight < room
    return jnp.where(collides, flight, jnp.maximum(room, 0.0)), jnp.where(collides, bound, 0.0)


def _nudge(medium):
    """1e-4 of a coarse cell: far above float32 rounding of positions, far below what the majorant's margin covers."""
    size = media.voxel_size(medium) * medium.majorants.block
    return 1e-4 * jnp.min(size)
