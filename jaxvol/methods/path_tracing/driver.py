"""Run steps until a range of samples is done: rays cast by Embree on the host between steps, or all on the device.

On the CPU a Python loop casts with Embree between jitted steps. With pure JAX casters (BVH, brute force) the same step
and the same casting order run under `lax.while_loop`, which is what an accelerator wants.
"""

import threading
from contextlib import nullcontext
from functools import cache, partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxvol import ray_casting, segments
from jaxvol.columns import by_columns, compiler_options, join, split
from jaxvol.methods.path_tracing import sensors
from jaxvol.methods.path_tracing.flight import homogeneous_reach, mean_medium
from jaxvol.methods.path_tracing.lanes import Casts, Lanes, Settings, flush, flush_host, idle, num_columns, rows
from jaxvol.methods.path_tracing.step import Work, flight_uniforms, step
from jaxvol.ray_casting import EmbreeCaster
from jaxvol.types import Scene

_COMPILING = threading.Lock()


def _step(scene, proxy, sensor, settings, seed, lanes, casts, work):
    lanes, work, ended = _step_by_columns(scene, proxy, sensor, settings, seed, lanes, casts, work)
    return lanes, work, ended, jnp.any(lanes.alive | lanes.finished.valid)


@cache
def _jitted(function, backend, static, donated):
    return jax.jit(function, static_argnames=static, donate_argnames=donated, compiler_options=compiler_options(backend))


def jit_step():
    """The jitted step, compiled as suits the default backend."""
    return _jitted(_step, jax.default_backend(), ("settings",), ("lanes",))


def _step_by_columns(scene, proxy, sensor, settings, seed, lanes, casts, work):
    """`step` on lanes whose vectors are split into columns: about half the time on a CPU."""

    def one(scene, proxy, sensor, seed, lanes, casts, work):
        return step(scene, proxy, sensor, settings, seed, lanes, casts, work)

    return by_columns(one, lanes.alive.shape[0])(scene, proxy, sensor, seed, lanes, casts, work)


def no_casts(lanes: Lanes) -> Casts:
    """Casts of a scene without surfaces: every ray misses."""
    n = lanes.alive.shape[0]
    return Casts(
        t=jnp.full(n, jnp.inf, jnp.float32),
        face=jnp.full(n, -1, jnp.int32),
        blocked=tuple(jnp.zeros(n, bool) for _ in lanes.shadows),
    )


def cast_all(scene: Scene, casters, medium_casters, lanes: Lanes, settings: Settings, max_spans: int) -> Casts:
    """Cast the path and shadow rays of every lane, with any caster; jittable for JAX casters."""
    casts = no_casts(lanes)
    far = jnp.full(lanes.alive.shape, jnp.inf, jnp.float32)
    if scene.mesh is not None:
        t, face = ray_casting.intersect(casters, lanes.origin, lanes.direction, far)
        blocked = tuple(ray_casting.occluded(casters, s.origin, s.direction, s.distance) for s in lanes.shadows)
        casts = Casts(t=t, face=face, blocked=blocked)
    if not settings.bounded:
        return casts
    cut = lambda o, d, t: _cut(scene, medium_casters, o, d, t, max_spans)  # noqa: E731
    return eqx.tree_at(
        lambda c: (c.path_spans, c.shadow_spans),
        casts,
        (
            cut(lanes.origin, lanes.direction, far),
            tuple(cut(s.origin, s.direction, s.distance) for s in lanes.shadows),
        ),
        is_leaf=lambda x: x is None,
    )


def _cut(scene, medium_casters, origin, direction, t_max, max_spans):
    found = segments.segments(
        scene.medium, origin, direction, t_max, casters=medium_casters, max_hits=max_spans, max_segments=max_spans
    )
    return found.t, found.region


@partial(jax.jit, static_argnames=("settings",))
def _reach(medium, settings, seed, lanes):
    """How far the path rays fly if they stay where they are; inf where spans are needed to tell."""
    if settings.tracked or settings.equiangular:
        return jnp.full(lanes.alive.shape, jnp.inf, jnp.float32)
    u = flight_uniforms(seed, lanes)
    lanes = join(lanes)
    return homogeneous_reach(medium, lanes.region, lanes.origin, lanes.direction, lanes.throughput, u[0], u[1])


def _cut_paths(scene, medium_casters, seed, lanes, casts, index, origin, direction, settings):
    """Spans of new path rays, and how far these matter. Most flights in a dense body end before they leave it."""
    times, regions = casts.path_spans
    reach = np.asarray(_reach(scene.medium, settings, seed, lanes))[index] * np.float32(1 + 1e-4)
    stays = np.isfinite(reach)
    for caster in medium_casters:
        some = np.flatnonzero(stays)
        if caster is not None and some.size:
            stays[some] = ~ray_casting.occluded(caster, origin[some], direction[some], reach[some])
    inside = index[stays]
    times[inside, 0], times[inside, 1:] = 0.0, reach[stays, None]
    regions[inside, 0], regions[inside, 1:] = np.asarray(lanes.region)[inside], -1
    far = np.where(stays, reach, np.float32(np.inf))
    rest = ~stays
    if np.any(rest):
        cut = _cut(scene, medium_casters, origin[rest], direction[rest], far[rest], times.shape[1] - 1)
        times[index[rest]], regions[index[rest]] = cut
    return far


def _cast_changed(scene, caster, medium_casters, seed, lanes, casts, settings, max_spans):
    """Host casting: only what is new, active and needed; numpy arrays, updated in place."""
    index = np.flatnonzero(np.asarray(lanes.recast) & np.asarray(lanes.alive))
    if index.size and (scene.mesh is not None or settings.bounded):
        origin, direction = rows(lanes.origin, index), rows(lanes.direction, index)
        far = np.full(index.size, np.inf, np.float32)
        if settings.bounded:
            far = _cut_paths(scene, medium_casters, seed, lanes, casts, index, origin, direction, settings)
        if scene.mesh is not None:
            casts.t[index], casts.face[index] = ray_casting.intersect(caster, origin, direction, far)
    for number, (shadow, recast) in enumerate(zip(lanes.shadows, lanes.recast_shadows, strict=True)):
        index = np.flatnonzero(np.asarray(shadow.active) & np.asarray(recast))
        if not index.size:
            continue
        origin, direction, distance = (rows(x, index) for x in (shadow.origin, shadow.direction, shadow.distance))
        if scene.mesh is not None:
            casts.blocked[number][index] = ray_casting.occluded(caster, origin, direction, distance)
        if settings.bounded:
            t, region = _cut(scene, medium_casters, origin, direction, distance, max_spans)
            casts.shadow_spans[number][0][index], casts.shadow_spans[number][1][index] = t, region
    return casts


def _host_casts(num_lanes, num_shadows, settings, max_spans):
    spans = lambda: (  # noqa: E731
        np.zeros((num_lanes, max_spans + 1), np.float32),
        np.full((num_lanes, max_spans), -1, np.int32),
    )
    return Casts(
        t=np.full(num_lanes, np.inf, np.float32),
        face=np.full(num_lanes, -1, np.int32),
        blocked=tuple(np.zeros(num_lanes, bool) for _ in range(num_shadows)),
        path_spans=spans() if settings.bounded else None,
        shadow_spans=tuple(spans() for _ in range(num_shadows)) if settings.bounded else None,
    )


def on_host(scene: Scene, settings: Settings, kind: str) -> bool:
    """Whether a Python loop runs the steps: on a CPU, and wherever Embree casts."""
    meshes = [] if scene.mesh is None else [ray_casting.caster_for(scene.mesh, kind=kind)]
    casters = [*meshes, *_medium_casters(scene, settings, kind)]
    casters = [c for c in casters if c is not None]
    return all(isinstance(c, EmbreeCaster) for c in casters) and (bool(casters) or jax.default_backend() == "cpu")


def _medium_casters(scene, settings, kind):
    return segments.medium_casters(scene.medium, kind=kind) if settings.bounded else ()


def run(
    scene: Scene,
    sensor: sensors.Sensor,
    settings: Settings,
    *,
    groups: tuple[int, ...],
    num_shadows: int,
    num_lanes: int,
    max_spans: int,
    kind: str,
    seed: int,
    first_pixel: int,
    num_pixels: int,
    first_sample: int,
    num_samples: int,
    on_step=None,
):
    """Trace `num_samples` samples of each of `num_pixels` pixels; the film [2 * num_pixels, columns] as numpy.

    `on_step(done_share)` is called now and then (host loop only) and stops the run early by raising.
    """
    caster = ray_casting.caster_for(scene.mesh, kind=kind)
    medium_casters = _medium_casters(scene, settings, kind)
    lanes = idle(num_lanes, groups=groups, num_shadows=num_shadows, tracked=settings.tracked, equiangular=settings.equiangular)
    film = np.zeros((2 * num_pixels, num_columns(groups)), np.float32)
    items = num_pixels * num_samples
    work = Work(jnp.uint32(0), jnp.uint32(items), jnp.uint32(first_sample), jnp.int32(first_pixel), num_pixels)
    lanes = split(lanes, num_lanes)
    seed = jnp.uint32(seed)
    proxy = mean_medium(scene.medium) if settings.equiangular else None
    if not on_host(scene, settings, kind):
        loop = _jitted(_device_loop, jax.default_backend(), ("settings", "max_spans"), ("film",))
        return np.asarray(loop(scene, proxy, sensor, settings, seed, lanes, work, film, caster, medium_casters, max_spans))
    one_step = jit_step()
    casts = _host_casts(num_lanes, num_shadows, settings, max_spans)
    count = 0
    busy = True
    while busy:
        with _COMPILING if count == 0 else nullcontext():  # threads that share a program compile it once
            lanes, work, ended, busy = one_step(scene, proxy, sensor, settings, seed, lanes, casts, work)
        flush_host(film, ended.sums, ended.finished, num_pixels, first_pixel)
        casts = _cast_changed(scene, caster, medium_casters, seed, lanes, casts, settings, max_spans)
        count += 1
        if on_step is not None and count % 16 == 0:
            on_step(min(int(work.next), items) / items)
    return film


def _device_loop(scene, proxy, sensor, settings, seed, lanes, work, film, caster, medium_casters, max_spans):
    def body(state):
        lanes, work, film, _ = state
        casts = cast_all(scene, caster, medium_casters, join(lanes), settings, max_spans)
        lanes, work, ended = _step_by_columns(scene, proxy, sensor, settings, seed, lanes, casts, work)
        film = flush(film, join(ended.sums), ended.finished, work.num_pixels, work.first_pixel)
        return lanes, work, film, jnp.any(lanes.alive | lanes.finished.valid)

    state = (lanes, work, film, jnp.array(True))
    return lax.while_loop(lambda s: s[3], body, state)[2]
