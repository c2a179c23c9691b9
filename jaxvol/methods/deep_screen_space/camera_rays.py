"""The camera's rays that show medium, with their transmittance interval maps (paper section 4.1)."""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxvol import extinction, media, sampling, segments
from jaxvol import interval_map as intervals
from jaxvol.common_stages import CommonStages
from jaxvol.interval_map import IntervalMap
from jaxvol.methods.deep_screen_space import framebuffer, kernel
from jaxvol.methods.deep_screen_space.planning import Plan, coarse_size
from jaxvol.types import Camera, Medium, Scene

_STREAM = sampling.stream("deep_screen_space.camera_rays")
_VISIBLE = 1e-7  # rays with less opacity than this show no medium
_CHUNK = 8192  # rays at a time where every step of every ray is kept with its colours


class ActiveRays(eqx.Module):
    """Rays in Morton order of their pixels; arrays have a coarse capacity, its slack repeats the last ray."""

    origin: Float[np.ndarray, "3"]  # of all rays
    direction: Float[np.ndarray, "A 3"]
    map: IntervalMap
    g: Float[np.ndarray, "N A"] | None  # mean cosine at each sample where inclusions differ; its factor is in the weights
    pixel: Int[np.ndarray, "A"]  # flat, row by row from the top
    num_rays: int
    num_overflows: int  # rays that were cut short by too many boundaries


def map_rays(
    scene: Scene,
    camera: Camera,
    plan: Plan,
    common: CommonStages,
    *,
    seed: int,
    pixels: Int[np.ndarray, "n"] | None = None,
) -> ActiveRays | None:
    """The interval maps of the rays (of `pixels`, default all) that show medium; None when none does. Eager.

    Only rays that pass the medium's box are marched, only those that meet some density are kept.
    """
    rays = common.center_rays
    origin = np.asarray(rays.origin[0])
    enter, leave = (np.asarray(t) for t in media.box_interval(scene.medium.bounds, rays.origin, rays.direction))
    for part in scene.medium.inclusions:  # they may stick out of the medium
        first, last = (np.asarray(t) for t in media.box_interval(part.bounds, rays.origin, rays.direction))
        leave = np.where(last > first, np.maximum(leave, enter + 1.0), leave)
    wanted = np.ones(leave.shape, bool) if pixels is None else np.isin(np.arange(leave.size), pixels)
    pixel = np.flatnonzero((leave > enter) & wanted)
    if pixel.size == 0:
        return None
    pixel = pixel[np.argsort(framebuffer.morton(pixel % camera.width, pixel // camera.width), kind="stable")]
    capacity = coarse_size(pixel.size)
    pixel_padded = np.concatenate([pixel, np.full(capacity - pixel.size, pixel[-1])])
    direction = np.asarray(rays.direction)[pixel_padded]
    depth = common.center_hits[0][pixel_padded]
    u, u_step = _jitter(jnp.uint32(seed), jnp.asarray(pixel_padded))
    u, u_step = (u, u_step) if plan.position == "jittered" else (None, None)
    g, overflows = None, 0
    if segments.is_box(scene.medium):
        mapped = _map_box(scene.medium, origin, direction, depth, plan, u, u_step)
    else:
        mapped, g, overflows = _map_regions(scene.medium, origin, direction, depth, plan, u, common)
    opaque = np.asarray(mapped.one_minus_transmittance).max(axis=0)[: pixel.size]
    shown = np.flatnonzero(opaque > _VISIBLE)
    if shown.size == 0:
        return None
    keep = np.concatenate([shown, np.full(coarse_size(shown.size) - shown.size, shown[-1])])
    take = lambda a: np.take(np.asarray(a), keep, axis=-1)  # noqa: E731
    return ActiveRays(
        origin=origin,
        direction=direction[keep],
        map=jax.tree.map(take, mapped),
        g=None if g is None else take(g),
        pixel=pixel_padded[keep],
        num_rays=shown.size,
        num_overflows=overflows,
    )


@jax.jit
def _jitter(seed, pixel):
    u1, u2, _, _ = sampling.uniforms(seed, _STREAM, pixel, 0)
    return u1, u2


def _map_box(medium, origin, direction, depth, plan, u, u_step):
    """One medium in its box: the column of its density serves all channels."""
    options = {"num_intervals": plan.num_intervals, "num_steps": plan.num_steps, "u": u, "u_step": u_step}
    start = jnp.zeros(depth.shape, jnp.float32)
    origins = jnp.broadcast_to(origin, direction.shape)
    if plan.weights == "paper":
        return intervals.paper_interval_map(medium, origins, direction, start, depth, **options)
    options |= {"position": plan.position, "grey": plan.grey}
    return intervals.interval_map(medium, origins, direction, start, depth, **options)


def _map_regions(medium, origin, direction, depth, plan, u, common):
    """Media bounded by meshes, with inclusions: sigma of every step from the pieces that its owners have of it."""
    marching, casters = common.marching, common.medium_casters
    pieces = segments.segments(medium, np.broadcast_to(origin, direction.shape), direction, depth, casters=casters)
    parts = []
    for begin in range(0, len(direction), _CHUNK):
        rows = slice(begin, begin + _CHUNK)
        t, region = np.asarray(pieces.t)[rows], np.asarray(pieces.region)[rows]
        sigma_s, sigma_t, g_steps, start, step = march_regions(
            marching, jnp.asarray(origin), direction[rows], t, region, num_steps=plan.num_steps
        )
        mapped = intervals.interval_map_of_steps(
            sigma_s,
            sigma_t,
            start,
            step,
            num_intervals=plan.num_intervals,
            position=plan.position,
            u=None if u is None else u[rows],
        )
        g = None
        if plan.phase == "henyey_greenstein" and medium.inclusions:
            mapped, g = _own_cosines(mapped, g_steps, start, step)
        parts.append((mapped, g))
    joined = jax.tree.map(lambda *a: np.concatenate([np.asarray(x) for x in a], axis=-1), *parts)
    return *joined, int(pieces.num_overflows)


@partial(jax.jit, static_argnames=("num_steps",))
def march_regions(
    marching: extinction.MarchingMedium,
    origin: Float[Array, "3"],
    direction: Float[Array, "R 3"],
    t: Float[Array, "R pieces+1"],
    region: Int[Array, "R pieces"],
    *,
    num_steps: int,
) -> tuple[Array, Array, Array, Array, Array]:
    """sigma_s, sigma_t [K, 3, R] and the scattered light's mean g [K, R] of equal steps, with their start and length [R].

    A region counts with the share of the step that it owns, its density looked up in the step's middle.
    """
    start = t[:, 0]
    step = (t[:, -1] - start) / num_steps

    def body(_, k):
        low = start + k * step
        points = origin + (low + 0.5 * step)[:, None] * direction
        scatter = extinct = jnp.zeros((3, start.shape[0]), jnp.float32)
        cosine = jnp.zeros_like(start)
        for index, part in enumerate(marching.regions):
            share = extinction.owned_length(t, region, index, low, low + step) / jnp.maximum(step, 1e-30)
            if part.density is not None:
                share = share * extinction.region_density(marching, index, points)
            scatter = scatter + share * part.sigma_s[:, None]
            extinct = extinct + share * media.sigma_t(part)[:, None]
            cosine = cosine + share * jnp.mean(part.sigma_s) * part.g
        mean = jnp.mean(scatter, axis=0)
        return None, (scatter, extinct, jnp.where(mean > 0, cosine / jnp.where(mean > 0, mean, 1.0), 0.0))

    _, (sigma_s, sigma_t, g) = jax.lax.scan(body, None, jnp.arange(num_steps, dtype=jnp.float32))
    return sigma_s, sigma_t, g, start, step


@jax.jit
def _own_cosines(mapped, g_steps, start, step):
    """g at each sample, and the map with the phase function's constant factor for that g in its weights."""
    index = jnp.clip((mapped.distance - start) / jnp.maximum(step, 1e-30), 0, g_steps.shape[0] - 1).astype(jnp.int32)
    g = jnp.take_along_axis(g_steps, index, axis=0)
    weight = mapped.weight * kernel.phase_scale("henyey_greenstein", g)[:, None, :]
    return eqx.tree_at(lambda m: m.weight, mapped, weight), g


def transmittance_of(medium: Medium, casters: tuple, *, num_steps: int, marching: extinction.MarchingMedium | None = None):
    """The function (origin, direction, distance) -> transmittance [n, 3] of segments, as stages take it. Eager."""
    marching = extinction.marching_medium(medium) if marching is None else marching

    def transmittance(origin, direction, distance):
        thickness = extinction.optical_thickness(
            medium,
            jnp.asarray(origin),
            jnp.asarray(direction),
            jnp.asarray(distance),
            casters=casters,
            num_steps=num_steps,
            marching=marching,
        )
        return np.exp(-np.asarray(thickness))

    return transmittance
