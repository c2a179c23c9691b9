"""Gathering where a pair is costly (marching, shadow rays): every light is estimated, one of each group is evaluated.

Lights are dealt into groups; inside a group a reservoir keeps one light per receiver with probability proportional to
its contribution without occlusion and with approximate transmittance (resampling: Talbot et al. 2005). Only the kept
one needs the true transmittance and a shadow ray. Unbiased whatever the estimate, as long as it is positive; the cost is
a kernel evaluation per pair and one march and ray per group.
"""

from functools import partial
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

from jaxvol import media, slopes
from jaxvol.methods.instant_multiple_scattering import gathering, pairs, receivers
from jaxvol.methods.instant_multiple_scattering.gathering import Light
from jaxvol.methods.instant_multiple_scattering.receivers import Points, Segments
from jaxvol.methods.instant_multiple_scattering.virtual_lights import VirtualLights
from jaxvol.types import Medium

_LEAST = 1e-3  # share of the mean density that the estimate assumes where the table says there is none
_DARKEST = 1e-4  # albedo that the estimate assumes at least


class Picks(eqx.Module):
    """One light of each group for each receiver."""

    light: Int[Array, "k n"]
    weight: Float[Array, "k n"]  # sum of the group's estimates / the chosen one's, times min(1/r^2, b) / pdf(t)
    t: Float[Array, "k n"] | None = None  # on the eye ray; None for points


class _Reservoir(NamedTuple):
    total: Float[Array, "n"]
    estimate: Float[Array, "n"]
    light: Int[Array, "n"]
    payload: tuple
    u: Float[Array, "n"]


def _offer(reservoir, estimate, index, payload):
    """Weighted reservoir of one, on a single uniform that is stretched again after every decision."""
    total = reservoir.total + estimate
    share = estimate / jnp.maximum(total, 1e-37)
    accepts = (reservoir.u < share) & (estimate > 0)
    rest = jnp.where(accepts, reservoir.u / jnp.maximum(share, 1e-12), (reservoir.u - share) / jnp.maximum(1.0 - share, 1e-12))
    keep = lambda new, old: jnp.where(accepts, new, old)  # noqa: E731
    return _Reservoir(
        total,
        keep(estimate, reservoir.estimate),
        keep(index, reservoir.light),
        tuple(keep(n, o) for n, o in zip(payload, reservoir.payload, strict=True)),
        jnp.clip(rest, 0.0, 1.0 - 2.0**-24),
    )


def _deal(lights, num_groups):
    """Rows of the lights as [k, m]: neighbours in the list go to different groups; padded with dark lights."""
    number = lights.position.shape[0]
    size = -(-number // num_groups)
    pad = size * num_groups - number

    def deal(x):
        return jnp.pad(x, (0, pad)).reshape(size, num_groups).T

    index = jnp.minimum(jnp.arange(size * num_groups, dtype=jnp.int32), number - 1).reshape(size, num_groups).T
    return jax.tree.map(deal, gathering.rows(lights)), index, gathering.golden(index)


def _pick(estimate, lights, u, num_groups, num_payload):
    """Run the reservoirs: estimate(light, shift) -> (value, payload)."""
    zero = jnp.zeros_like(u)

    def group(_, item):
        members, indices, shifts, start = item
        start = gathering.shifted(u, start)
        empty = _Reservoir(zero, zero, jnp.zeros(u.shape, jnp.int32), (zero,) * num_payload, start)
        nothing = (zero, jnp.int32(0), (zero,) * num_payload)

        def member(state, row):
            # Offered one step later, through the scan's state: XLA would else compute the estimate again for every
            # field of the reservoir.
            reservoir, late = state
            light, index, shift = row
            value, payload = estimate(light, shift)
            return (_offer(reservoir, *late), (value, index, payload)), None

        (kept, late), _ = lax.scan(member, (empty, nothing), (members, indices, shifts))
        kept = _offer(kept, *late)
        scale = slopes.ratio(kept.total, kept.estimate)
        return None, (kept.light, scale, *kept.payload)

    starts = gathering.golden(7919 * jnp.arange(num_groups) + 1)
    return lax.scan(group, None, (*_deal(lights, num_groups), starts))[1]


def _mean_density(medium):
    return 1.0 if medium.density is None else jnp.mean(medium.density)


@partial(jax.jit, static_argnames=("num_groups", "isotropic", "stratified"))
def pick_for_segments(
    segments: Segments,
    u: Float[Array, "n"],
    u_group: Float[Array, "n"],
    lights: VirtualLights,
    medium: Medium,
    *,
    num_groups: int,
    isotropic: bool,
    stratified: bool = False,
) -> Picks:
    """For each eye ray and group one light and the point of the ray that it meets."""
    origin, direction = pairs.components(segments.origin), pairs.components(segments.direction)
    sigma = jnp.mean(media.sigma_t(medium))
    mean_density = _mean_density(medium)
    number = 0 if segments.column is None else segments.column.shape[0]
    if number:
        ends = jnp.pad(segments.column, ((1, 0), (0, 0)))
        length = jnp.where(segments.t1 > segments.t0, segments.t1 - segments.t0, 1.0)
        density = (ends[1:] - ends[:-1]) * (number / length)
        # A step beside one that holds density is not empty: the table blurs over a step.
        padded = jnp.pad(density, ((1, 1), (0, 0)), mode="edge")
        density = jnp.maximum(jnp.maximum(padded[:-2], padded[2:]), density)
        source = (density + _LEAST * mean_density) * gathering.floored_exp(sigma * ends[1:])
        flat = source.reshape(-1)
        lanes = jnp.arange(u.shape[0])

    def estimate(light, shift):
        v = gathering.shifted(u, shift)
        point = gathering.choose_point(origin, direction, segments, light.position, v, stratified=stratified)
        sent, factor = gathering.leaving(light, point.towards, medium, isotropic=isotropic)
        value = pairs.mean(sent) * factor * point.weight
        value = value * gathering.phase_value(medium, -pairs.dot(point.towards, direction), isotropic=isotropic)
        along = point.t - segments.t0
        depth = sigma * mean_density * point.distance
        if number:
            step = jnp.clip((along * (number / length)).astype(jnp.int32), 0, number - 1)
            value = value * flat[step * u.shape[0] + lanes]
        else:
            depth = depth + sigma * along
        return value * gathering.floored_exp(depth), (point.t, point.weight)

    light, scale, t, weight = _pick(estimate, lights, u_group, num_groups, 2)
    alive = segments.t1 > segments.t0
    return Picks(light, jnp.where(alive, scale * weight, 0.0), t)


@partial(jax.jit, static_argnames=("num_groups", "isotropic"))
def pick_for_points(
    points: Points,
    u: Float[Array, "n"],
    lights: VirtualLights,
    medium: Medium | None,
    *,
    num_groups: int,
    isotropic: bool,
) -> Picks:
    """For each point and group one light; black points pick as dark grey ones do, so that their slopes are right."""
    if points.surface is not None:
        floored = jnp.maximum(points.surface.albedo, _DARKEST)
        points = eqx.tree_at(lambda p: p.surface.albedo, points, floored)
    sigma = 0.0 if medium is None else jnp.mean(media.sigma_t(medium)) * _mean_density(medium)

    def estimate(light, _):
        value, bounded = gathering.reflected_estimate(points, light, medium, points.clamp, sigma, isotropic=isotropic)
        return value, (bounded,)

    light, scale, bounded = _pick(estimate, lights, u, num_groups, 1)
    return Picks(light, scale * bounded)


def _chosen(lights, index):
    """The picked light of each lane."""
    return jax.tree.map(lambda x: x[index], gathering.rows(lights))


@jax.jit
def shadow_rays(
    position: Float[Array, "*k n 3"], lights: VirtualLights, picks: Picks
) -> tuple[Float[Array, "k n 3"], Float[Array, "k n 3"], Float[Array, "k n"]]:
    """Origin, direction and length of the rays from points to their picked lights, a little short of them."""
    delta = lights.position[picks.light] - position
    length = jnp.sqrt(jnp.maximum(jnp.sum(delta * delta, axis=-1), 1e-30))
    return jnp.broadcast_to(position, delta.shape), delta / length[..., None], length * (1.0 - 1e-4)


@jax.jit
def points_of(segments: Segments, picks: Picks) -> Float[Array, "k n 3"]:
    """Where the eye rays meet their picked lights."""
    return segments.origin + picks.t[..., None] * segments.direction


@partial(jax.jit, static_argnames=("isotropic", "num_steps"))
def evaluate_segments(
    segments: Segments,
    picks: Picks,
    visible: Float[Array, "k n"] | None,
    columns: Float[Array, "k n"] | None,
    lights: VirtualLights,
    medium: Medium,
    marched: Medium,
    clamps: Float[Array, "k n"] | None,
    *,
    isotropic: bool,
    num_steps: int,
) -> Float[Array, "n 3"]:
    """Radiance that eye rays collect from the picked lights, true transmittance and visibility (None: all visible).

    `columns` of density to the lights may be given; else they are marched through the medium `marched`. `clamps` are the
    clamp distances at the points where they differ from the ray's own least one (None: they do not).
    """
    direction = pairs.components(segments.direction)
    sigma_t = pairs.components(media.sigma_t(medium))

    def body(total, item):
        index, weight, t, seen, column, clamp = item
        light: Light = _chosen(lights, index)
        x = segments.origin + t[:, None] * segments.direction
        r2, _, towards = pairs.separation(pairs.components(x), light.position, segments.clamp)
        f = gathering.phase_value(medium, -pairs.dot(towards, direction), isotropic=isotropic)
        if clamp is not None:
            weight = weight * pairs.inverse_square(r2, clamp) / pairs.inverse_square(r2, segments.clamp)
        scale = weight * f * media.density(medium, x)
        if seen is not None:
            scale = scale * seen
        sent, factor = gathering.leaving(light, towards, medium, isotropic=isotropic)
        if column is None:
            column = receivers.column_between(marched, x, jnp.stack(light.position, -1), num_steps=num_steps)
        column = column + receivers.column_at(segments, t)
        value = gathering.extinguish(sent, scale * factor, sigma_t, column, grey=False)
        return gathering.add(total, value), None

    zero = jnp.zeros_like(segments.t0)
    items = (picks.light, picks.weight, picks.t, visible, columns, clamps)
    total, _ = lax.scan(body, (zero, zero, zero), items)
    return jnp.stack(total, axis=-1) * medium.sigma_s


@partial(jax.jit, static_argnames=("isotropic", "num_steps"))
def evaluate_points(
    points: Points,
    picks: Picks,
    visible: Float[Array, "k n"] | None,
    columns: Float[Array, "k n"] | None,
    lights: VirtualLights,
    medium: Medium | None,
    marched: Medium | None,
    *,
    isotropic: bool,
    num_steps: int,
) -> Float[Array, "n 3"]:
    """Light of the picked lights scattered at points towards `outgoing`."""
    position = pairs.components(points.position)

    def body(total, item):
        index, weight, seen, column = item
        light: Light = _chosen(lights, index)
        _, _, towards = pairs.separation(position, light.position, points.clamp)
        scale = weight if seen is None else weight * seen
        sent, factor = gathering.leaving(light, towards, medium, isotropic=isotropic)
        scale = scale * factor
        received = gathering.scattered(points, towards, medium, isotropic=isotropic)
        value = tuple(a * b for a, b in zip(sent, received, strict=True))
        if medium is None:
            return gathering.add(total, tuple(v * scale for v in value)), None
        if column is None:
            ends = jnp.stack(light.position, -1)
            column = receivers.column_between(marched, points.position, ends, num_steps=num_steps)
        value = gathering.extinguish(value, scale, pairs.components(media.sigma_t(medium)), column, grey=False)
        return gathering.add(total, value), None

    zero = jnp.zeros(points.position.shape[:1], jnp.float32)
    total, _ = lax.scan(body, (zero, zero, zero), (picks.light, picks.weight, visible, columns))
    return jnp.stack(total, axis=-1)
