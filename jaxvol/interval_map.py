"""Transmittance interval map: where along each ray a medium shows, as N intervals of equal drop in transmittance.

Nalbach, Ritschel, Seidel 2014 section 4.1, made exact. With N intervals of equal drop the integral of T sigma_t over
every one of them is (1 - tau_min)/N, so that int T sigma_s f dt is estimated by N lookups of f with the known weight
albedo (1 - tau_min)/N: no segment lengths, no cached coefficients. The paper's own two passes and Riemann weights are
`paper_interval_map`, to compare with.

Rays are the last axis of every array here (the lanes of the kernels that use the map).
"""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from jaxvol import media
from jaxvol.types import Medium

POSITIONS = ("midpoint", "jittered", "far")
_OPAQUE = 1.0 - 1e-7  # largest argument of -log1p(-x): nearest float32 below 1 that keeps the column finite
_TINY = 1e-30
_NOTHING = 1e-12  # share of a ray's column that a step may hold and count as empty


class IntervalMap(eqx.Module):
    """N samples on each of R rays and their weights: int T sigma_s f dt is about sum_i weight_i f(distance_i)."""

    distance: Float[Array, "N R"]  # along the ray, inside the span, increasing
    weight: Float[Array, "M 3 R"]  # M = N, or 1 when every interval of a ray weighs the same
    one_minus_transmittance: Float[Array, "3 R"]  # of the whole span


class Marched(eqx.Module):
    """Density at K equal steps of each ray's span."""

    start: Float[Array, "R"]
    step: Float[Array, "R"]  # length of one step
    density: Float[Array, "K R"]


def levels(num_intervals: int, num_rays: int, *, position: str = "midpoint", u=None) -> Float[Array, "N R"]:
    """Fractions s_j of the ray's whole drop in transmittance at which the samples sit.

    (j + 1/2)/N (`midpoint`), (j + u)/N with the same u per ray (`jittered`, the paper's xi = 1 - u) or (j + 1)/N
    (`far`, the paper without jitter). Raises ValueError for an unknown position or a missing u.
    """
    if position not in POSITIONS:
        raise ValueError(f"position {position!r} is unknown; it is one of {', '.join(POSITIONS)}")
    if (u is not None) != (position == "jittered"):
        raise ValueError("u, one number in (0, 1) per ray, belongs to position='jittered' and to it alone")
    j = jnp.arange(num_intervals, dtype=jnp.float32)[:, None]
    offset = {"midpoint": 0.5, "far": 1.0, "jittered": u}[position]
    return jnp.broadcast_to((j + offset) / num_intervals, (num_intervals, num_rays))


def column_at(
    sigma_t: Float[Array, "3"], total: Float[Array, "R"], level: Float[Array, "N R"], *, grey: bool
) -> Float[Array, "N R"]:
    """The density column at which the drop in transmittance has reached the fraction `level` of the ray's total drop.

    Grey: -log1p(-level (1 - exp(-sigma total)))/sigma. Chromatic: the root of the mean over channels of
    (1 - exp(-sigma_c D))/(1 - exp(-sigma_c total)) = level, by Newton steps from the left (the function is concave, so
    that they never overshoot): every channel is then sampled well, also when they are 100:1 apart.
    """
    # In shares of the column, so that rays of any length, or without medium, are alike. A channel without extinction
    # drops linearly: the limit of a faint one.
    tau = jnp.maximum(sigma_t[:, None] * total, 1e-6)  # [3, R]
    drop = -jnp.expm1(-tau)
    own = [-jnp.log1p(-jnp.minimum(level * drop[c], _OPAQUE)) / tau[c] for c in range(1 if grey else 3)]
    if grey:
        return jnp.minimum(own[0], 1.0) * total
    start = jnp.minimum(jnp.minimum(own[0], own[1]), own[2])

    def newton(_, share):
        reached = sum(-jnp.expm1(-tau[c] * share) / drop[c] for c in range(3)) / 3.0
        slope = sum(tau[c] * jnp.exp(-tau[c] * share) / drop[c] for c in range(3)) / 3.0
        return jnp.clip(share + (level - reached) / jnp.maximum(slope, _TINY), share, 1.0)

    return lax.fori_loop(0, 10, newton, start) * total


def march(
    medium: Medium,
    origin: Float[Array, "R 3"],
    direction: Float[Array, "R 3"],
    t0: Float[Array, "R"],
    t1: Float[Array, "R"],
    *,
    num_steps: int,
    shift=0.5,
) -> Marched:
    """Density in the middle (or at the fraction `shift`) of `num_steps` equal steps of [t0, t1]. One row gather a step."""
    step = jnp.maximum(t1 - t0, 0.0) / num_steps
    packed = None if medium.density is None else media.pack_corners(medium.density)

    def body(_, k):
        t = t0 + (k + shift) * step
        points = origin + t[:, None] * direction
        if packed is None:
            density = media.inside_box(medium.bounds, points).astype(jnp.float32)
        else:
            density = media.density_packed(packed, medium.density.shape, medium.bounds, points)
        return None, jnp.where(step > 0, density, 0.0)

    _, density = lax.scan(body, None, jnp.arange(num_steps, dtype=jnp.float32))
    return Marched(start=t0, step=step, density=density)


def total_column(marched: Marched) -> Float[Array, "R"]:
    """Integral of density over the span."""
    return jnp.sum(marched.density, axis=0) * marched.step


def invert_column(marched: Marched, column: Float[Array, "N R"]) -> Float[Array, "N R"]:
    """Distances at which the column (piecewise linear in t) reaches `column`, the nearest where it is flat; exact.

    t = start + step sum_k clip(column - before_k, 0, rise_k)/rise_k: a sum over the steps instead of a search, no gathers.
    Steps that hold nothing to speak of are passed at once, so that no derivative divides by their rise.
    """
    total = lax.stop_gradient(total_column(marched))  # as the unit: the answer does not depend on it
    scale = 1.0 / jnp.where(total > _TINY, total, 1.0)
    column = column * scale

    def body(state, density):
        before, steps = state
        rise = density * marched.step * scale
        filled = rise > _NOTHING
        share = jnp.clip(column - before, 0.0, rise) / jnp.where(filled, rise, 1.0)
        return (before + rise, steps + jnp.where(filled, share, jnp.where(column > before, 1.0, 0.0))), None

    zero = jnp.zeros_like(column)
    (_, steps), _ = lax.scan(body, (jnp.zeros_like(marched.start), zero), marched.density)
    return marched.start + marched.step * jnp.minimum(steps, marched.density.shape[0])


def interval_weights(
    medium: Medium, total: Float[Array, "R"], num_intervals: int, *, grey: bool, edges: Float[Array, "N1 R"] | None = None
) -> Float[Array, "M 3 R"]:
    """albedo_c times the drop of T_c over each interval; they sum to albedo_c (1 - tau_min,c).

    Grey: the same for all intervals, M = 1. Chromatic: T_c(edge_j) - T_c(edge_j+1) = T_c(edge_j) (1 - exp(-sigma_c gap)).
    """
    sigma = media.sigma_t(medium)[:, None]
    albedo = media.single_scattering_albedo(medium)[:, None]
    if grey:
        return (albedo * -jnp.expm1(-sigma * total) / num_intervals)[None]
    gap = jnp.maximum(edges[1:] - edges[:-1], 0.0)[:, None, :]
    return albedo * jnp.exp(-sigma * edges[:-1, None, :]) * -jnp.expm1(-sigma * gap)


@partial(jax.jit, static_argnames=("num_intervals", "num_steps", "position", "grey"))
def interval_map(
    medium: Medium,
    origin: Float[Array, "R 3"],
    direction: Float[Array, "R 3"],
    t0: Float[Array, "R"],
    t1: Float[Array, "R"],
    *,
    num_intervals: int,
    num_steps: int = 200,
    position: str = "midpoint",
    grey: bool = False,
    u: Float[Array, "R"] | None = None,
    u_step: Float[Array, "R"] | None = None,
) -> IntervalMap:
    """The map in one pass over [t0, t1] (clipped to the medium's bounds here), exact weights (specification 2.2).

    Without a grid no march at all: t = t0 - log1p(-s omt)/sigma. `grey` says that sigma_t is equal in
    all channels. `u` jitters the levels (position 'jittered'), `u_step` the place of the density samples in their steps
    (the paper's second jitter). One medium in its box: boundaries and inclusions go through `interval_map_of_steps`.
    """
    enter, leave = media.box_interval(medium.bounds, origin, direction)
    t0 = jnp.maximum(enter, t0)
    t1 = jnp.maximum(jnp.minimum(leave, t1), t0)
    sigma = media.sigma_t(medium)
    closed_form = medium.density is None
    if closed_form:
        total = t1 - t0
    else:
        shift = 0.5 if u_step is None else u_step
        marched = march(medium, origin, direction, t0, t1, num_steps=num_steps, shift=shift)
        total = total_column(marched)
    level = levels(num_intervals, t0.shape[0], position=position, u=u)
    edges = None
    if grey:
        columns = column_at(sigma, total, level, grey=True)
    else:
        between = jnp.arange(1, num_intervals, dtype=jnp.float32)[:, None] / num_intervals
        wanted = jnp.concatenate([level, jnp.broadcast_to(between, (num_intervals - 1, t0.shape[0]))])
        columns = column_at(sigma, total, wanted, grey=False)
        edges = jnp.concatenate([jnp.zeros_like(total)[None], columns[num_intervals:], total[None]])
        columns = columns[:num_intervals]
    distance = t0 + columns if closed_form else invert_column(marched, columns)
    return IntervalMap(
        distance=distance,
        weight=interval_weights(medium, total, num_intervals, grey=grey, edges=edges),
        one_minus_transmittance=-jnp.expm1(-sigma[:, None] * total),
    )


@partial(jax.jit, static_argnames=("num_intervals", "position"))
def interval_map_of_steps(
    sigma_s: Float[Array, "K 3 R"],
    sigma_t: Float[Array, "K 3 R"],
    t0: Float[Array, "R"],
    step: Float[Array, "R"],
    *,
    num_intervals: int,
    position: str = "midpoint",
    u: Float[Array, "R"] | None = None,
) -> IntervalMap:
    """The map of a ray through several media, whose albedo varies along it: piecewise constant sigma in K equal steps.

    Intervals of equal steps of the mean over channels of the normalised drop, as in `column_at`. Weights are exact for
    the midpoint: Q_c(edge_j+1) - Q_c(edge_j) with Q the cumulative int T sigma_s. With jitter these differences would
    be biased, so they are albedo(x_j) times the drop of T instead (unbiased where the steps are the truth).
    """
    num_steps, _, num_rays = sigma_t.shape
    level = levels(num_intervals, num_rays, position=position, u=u)
    between = jnp.arange(1, num_intervals, dtype=jnp.float32)[:, None] / num_intervals
    wanted = jnp.concatenate([level, jnp.broadcast_to(between, (num_intervals - 1, num_rays))])
    thickness = jnp.sum(sigma_t, axis=0) * step  # [3, R]
    drop = -jnp.expm1(-thickness)
    present = thickness > 0
    share = present / jnp.maximum(jnp.sum(present, axis=0), 1)  # channels that see the medium count alike
    scale = jnp.where(present, share / jnp.where(present, drop, 1.0), 0.0)

    def locate(state, sigma):
        before, steps = state
        rise = sigma * step
        reached = jnp.sum(scale * -jnp.expm1(-before), axis=0)
        gained = jnp.sum(scale * jnp.exp(-before) * -jnp.expm1(-rise), axis=0)
        # Inside the step the normalised drop bends; the straight line will do because weights are evaluated at the
        # place found, whatever it is.
        steps = steps + jnp.clip((wanted - reached) / jnp.maximum(gained, _TINY), 0.0, 1.0)
        return (before + rise, steps), None

    zero = jnp.zeros_like(thickness)
    (_, steps), _ = lax.scan(locate, (zero, jnp.zeros_like(wanted)), sigma_t)
    steps = jnp.minimum(steps, num_steps)
    ends = jnp.concatenate([jnp.zeros_like(t0)[None], steps[num_intervals:], jnp.full_like(t0, num_steps)[None]])
    steps = steps[:num_intervals]

    def accumulate(state, inputs):
        before, weight, albedo = state
        k, scatter, extinction = inputs
        part = jnp.clip(ends - k, 0.0, 1.0)[:, None, :] * step  # how far each edge reaches into this step
        share_low = extinction * part[:-1]
        gain = jnp.exp(-before - share_low) * -jnp.expm1(-extinction * (part[1:] - part[:-1]))
        ratio = jnp.where(extinction > 0, scatter / jnp.where(extinction > 0, extinction, 1.0), 0.0)
        here = (steps >= k) & ((steps < k + 1) | (k == num_steps - 1))
        albedo = jnp.where(here[:, None, :], ratio, albedo)
        return (before + extinction * step, weight + (gain if position == "jittered" else gain * ratio), albedo), None

    blank = jnp.zeros((num_intervals, 3, num_rays), jnp.float32)
    inputs = (jnp.arange(num_steps, dtype=jnp.float32), sigma_s, sigma_t)
    (_, weight, albedo), _ = lax.scan(accumulate, (zero, blank, blank), inputs)
    return IntervalMap(
        distance=t0 + steps * step,
        weight=weight * albedo if position == "jittered" else weight,
        one_minus_transmittance=drop,
    )


@partial(jax.jit, static_argnames=("num_intervals", "num_steps"))
def paper_interval_map(
    medium: Medium,
    origin: Float[Array, "R 3"],
    direction: Float[Array, "R 3"],
    t0: Float[Array, "R"],
    t1: Float[Array, "R"],
    *,
    num_intervals: int,
    num_steps: int = 200,
    u: Float[Array, "R"] | None = None,
    u_step: Float[Array, "R"] | None = None,
) -> IntervalMap:
    """The paper's map: two passes, distances on the marching samples, weights T_i c_i (d_i - d_i-1) (sections 4.1, 4.2).

    Reading: intervals i = 1..N (n = N + 1 distances) with thresholds tau(d_i+1) < 1 - (i - xi)(1 - tau_min)/N, the last
    distance set explicitly, T_i = 1 - i (1 - tau_min)/N at the far end. As printed, with n in place of N and i from 2,
    the last threshold is below tau_min and its weight negative. Grey media only: extinction of the first channel
    decides. Biased: a right-endpoint Riemann sum; 30 % at N = 16 in a broken cloud.
    """
    enter, leave = media.box_interval(medium.bounds, origin, direction)
    t0 = jnp.maximum(enter, t0)
    t1 = jnp.maximum(jnp.minimum(leave, t1), t0)
    shift = 0.5 if u_step is None else u_step
    marched = march(medium, origin, direction, t0, t1, num_steps=num_steps, shift=shift)
    sigma = media.sigma_t(medium)
    thickness = sigma[0] * marched.step
    omt = -jnp.expm1(-total_column(marched) * sigma[0])
    i = jnp.arange(1, num_intervals + 1, dtype=jnp.float32)[:, None]
    xi = 0.0 if u is None else u
    threshold = 1.0 - (i - xi) * omt / num_intervals

    def second_pass(state, inputs):
        column, first, distance, coefficient, found = state
        k, density = inputs
        t = marched.start + (k + shift) * marched.step
        first = jnp.where(column * thickness <= 1e-7, t, first)  # the largest distance with tau = 1
        column = column + density
        # The last interval ends with the medium: tau < threshold would never fire where xi = 0.
        last = (i == num_intervals) & (k == num_steps - 1)
        fires = ~found & ((jnp.exp(-column * thickness) < threshold) | last)
        return (
            column,
            first,
            jnp.where(fires, t, distance),
            jnp.where(fires, density, coefficient),
            found | fires,
        ), None

    zero = jnp.zeros((num_intervals, t0.shape[0]), jnp.float32)
    state = (jnp.zeros_like(t0), t0, zero, zero, jnp.zeros(zero.shape, bool))
    inputs = (jnp.arange(num_steps, dtype=jnp.float32), marched.density)
    (_, first, distance, coefficient, _), _ = lax.scan(second_pass, state, inputs)
    previous = jnp.concatenate([jnp.minimum(first, distance[0])[None], distance[:-1]])
    riemann = jnp.maximum(1.0 - i * omt / num_intervals, 0.0) * coefficient * jnp.maximum(distance - previous, 0.0)
    total = total_column(marched)
    return IntervalMap(
        distance=jnp.where(omt > 0, distance, t0),
        weight=riemann[:, None, :] * medium.sigma_s[:, None],
        one_minus_transmittance=-jnp.expm1(-sigma[:, None] * total),
    )
