"""Plan, and run batches into a film."""

import os
import threading
from collections.abc import Callable
from concurrent.futures import FIRST_EXCEPTION, CancelledError, ThreadPoolExecutor, wait
from dataclasses import dataclass, field

import jax.numpy as jnp
import numpy as np
from jaxtyping import ArrayLike

from jaxvol import layers as layer_classes
from jaxvol import lights, media, segments
from jaxvol.layers import Claim
from jaxvol.methods.path_tracing import driver, sensors
from jaxvol.methods.path_tracing.film import add_batch, empty_film, to_estimate
from jaxvol.methods.path_tracing.lanes import Settings, possible_groups
from jaxvol.types import Estimate, Medium, Rays, Scene

Progress = Callable[[float], None]
_RANGE = 1 << 18  # pixels traced together


@dataclass(frozen=True)
class Plan:
    """What is decided before tracing, from the scene's structure and values."""

    settings: Settings
    groups: tuple[int, ...]
    num_shadows: int
    num_lanes: int  # at most
    max_spans: int
    caster: str
    drop_medium: bool  # the medium scatters and absorbs nothing
    skipped: tuple[str, ...] = field(compare=False)


def claims(scene: Scene) -> tuple[Claim, ...]:
    """All nine layers, each complete."""
    return tuple(Claim((name,)) for name in layer_classes.NAMES)


def plan(
    scene: Scene,
    camera: sensors.Sensor,
    *,
    max_scatterings: int = 1_000_000,
    roulette_from: int = 6,
    num_lanes: int = 1 << 14,
    tracking_steps: int = 8,
    max_spans: int = 8,
    equiangular: bool | None = None,
    caster: str = "auto",
) -> Plan:
    """Decide what a path tracer of this scene has to do; eager.

    `max_scatterings` counts vertices of any kind; `roulette_from` is the number of vertices from which Russian roulette
    may end a path; `equiangular=None` uses equi-angular distances where lights stand in a medium,
    or near a fog. Raises ValueError for a refractive index other than 1 and for counts out of range.
    """
    if max_scatterings < 0:
        raise ValueError(f"max_scatterings: {max_scatterings} is not allowed, must be >= 0")
    if roulette_from < 1:
        raise ValueError(f"roulette_from: {roulette_from} is not allowed, must be >= 1")
    if tracking_steps < 1 or max_spans < 1:
        raise ValueError("tracking_steps and max_spans must be >= 1")
    if scene.medium is not None:
        _refuse_refraction(scene.medium)
    drop_medium = scene.medium is not None and media.is_empty(scene.medium)
    medium = None if drop_medium else scene.medium
    tracked = medium is not None and not media.is_homogeneous(medium)
    lit = lights.num_lights(scene) > 0
    # Where distances are tracked or bodies end early, a vertex near the light is worth its flight only inside.
    fog = medium is not None and not tracked and segments.is_box(medium)
    near = medium is not None and _light_near(scene, medium, 0.5 if fog else 0.0)
    use_equiangular = near if equiangular is None else equiangular
    placed = any(x is not None for x in (scene.point_lights, scene.spot_lights, scene.area_lights))
    if use_equiangular and (medium is None or not placed):
        raise ValueError("equiangular: true needs a medium and a point, spot or area light")
    settings = Settings(
        max_scatterings=min(max_scatterings, 1_000_000) if lit else 0,
        roulette_from=roulette_from,
        tracked=tracked,
        tracking_steps=tracking_steps,
        bounded=medium is not None and not segments.is_box(medium),
        equiangular=use_equiangular and lit,
    )
    return Plan(
        settings=settings,
        groups=possible_groups(has_mesh=scene.mesh is not None, has_medium=medium is not None),
        num_shadows=(2 if settings.equiangular else 1) if lit else 0,
        num_lanes=num_lanes,
        max_spans=max_spans if settings.bounded else 1,
        caster=caster,
        drop_medium=drop_medium,
        skipped=_skipped(scene, medium, drop_medium, settings, lit),
    )


def _refuse_refraction(medium: Medium) -> None:
    for one in (medium, *medium.inclusions):
        if one.ior is not None and float(np.max(np.abs(np.asarray(one.ior) - 1.0))) > 1e-6:
            raise ValueError(
                f"medium.refractive_index: {float(np.max(np.asarray(one.ior))):g} is not allowed here, path_tracing "
                "keeps rays straight and takes 1 only; lattice_boltzmann bends them"
            )


def _light_near(scene, medium, share):
    """Whether a light stands within the medium's box enlarged by a share of its size on each side."""
    bounds = np.asarray(medium.bounds)
    margin = share * (bounds[1] - bounds[0])
    positions = [np.asarray(x.position) for x in (scene.point_lights, scene.spot_lights) if x is not None]
    if scene.area_lights is not None:
        corners = np.asarray(scene.mesh.faces)[np.asarray(scene.area_lights.face)]
        positions.append(np.asarray(scene.mesh.vertices)[corners].reshape(-1, 3))
    return any(np.any(np.all((p > bounds[0] - margin) & (p < bounds[1] + margin), axis=-1)) for p in positions)


def _skipped(scene, medium, drop_medium, settings, lit):
    reasons = []
    if not lit:
        reasons.append("no light: nothing is traced beyond the first hit")
    if scene.mesh is None:
        reasons.append("no surfaces: no rays are cast, surface layers are exactly zero")
    if drop_medium:
        reasons.append("the medium neither scatters nor absorbs: dropped")
    elif medium is None:
        reasons.append("no medium: no free flights, volume layers are exactly zero")
    elif not settings.tracked:
        reasons.append("homogeneous media: flights and transmittance in closed form, no tracking")
    if medium is not None and not settings.bounded:
        reasons.append("the medium fills its box: one span a ray, no boundary crossings")
    if medium is not None and not settings.equiangular:
        reasons.append("no equi-angular sampling: no light in or near the medium")
    return tuple(reasons)


def add_samples(
    film: np.ndarray,
    scene: Scene,
    sensor: sensors.Sensor,
    plan: Plan,
    *,
    seed: int,
    first_sample: int,
    num_samples: int,
    num_lanes: int,
    on_progress: Progress | None = None,
) -> None:
    """Trace `num_samples` more samples of every pixel into `film` (`empty_film`), in ranges that bound the memory.

    Samples are numbered, so the film does not depend on how they are split, beyond rounding. `on_progress(share)`, which
    one thread at a time calls, may raise to give up; the film is then of no use.
    """
    if plan.drop_medium:
        scene = Scene(**{**{f: getattr(scene, f) for f in Scene.__dataclass_fields__}, "medium": None})
    total = sensors.num_pixels(sensor)
    pixels = [(first, min(_RANGE, total - first)) for first in range(0, total, _RANGE)]
    # A host loop keeps one core busy: cores share a batch by its samples.
    shares = min(num_samples, host_threads()) if driver.on_host(scene, plan.settings, plan.caster) else 1
    cuts = [num_samples * i // shares for i in range(shares + 1)]
    jobs = [(p, low, high) for p in pixels for low, high in zip(cuts[:-1], cuts[1:], strict=True)]
    done = [0.0] * len(jobs)
    reporting, leaving = threading.Lock(), threading.Event()

    def trace(number):
        (first, count), low, high = jobs[number]

        def report(share):
            if leaving.is_set():
                raise CancelledError
            if on_progress is not None:
                with reporting:
                    done[number] = share
                    on_progress(sum(done) / len(done))

        return driver.run(
            scene,
            sensor,
            plan.settings,
            groups=plan.groups,
            num_shadows=plan.num_shadows,
            num_lanes=num_lanes,
            max_spans=plan.max_spans,
            kind=plan.caster,
            seed=seed,
            first_pixel=first,
            num_pixels=count,
            first_sample=first_sample + low,
            num_samples=high - low,
            on_step=report,
        )

    with ThreadPoolExecutor(shares) as pool:
        try:
            for begin in range(0, len(jobs), shares):
                parts = [pool.submit(trace, number) for number in range(begin, begin + shares)]
                _raise_first(parts)
                (first, count), _, _ = jobs[begin]
                while parts:  # in order, so that a render repeats to the last bit; films as large as these are let go
                    add_batch(film[:, :, first : first + count], parts.pop(0).result(), plan.groups)
                done[begin : begin + shares] = [1.0] * shares
        finally:
            leaving.set()  # after an error or Ctrl-C the other threads need not finish their shares


def _raise_first(parts):
    """Wait for all parts, or raise what the first to fail raised."""
    for part in wait(parts, return_when=FIRST_EXCEPTION).done:
        part.result()


def host_threads() -> int:
    """Cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def lanes_for(items: int, limit: int) -> int:
    """Lanes in powers of four, so that renders of all sizes share a few compilations."""
    lanes = 256
    while lanes < limit and lanes * 8 < items:
        lanes *= 4
    return min(lanes, limit)


def _sense(scene, sensor, shape, *, seed, samples, **options):
    decided = plan(scene, sensor, **options)
    film = empty_film(sensors.num_pixels(sensor), decided.groups)
    lanes = lanes_for(sensors.num_pixels(sensor) * samples, decided.num_lanes)
    add_samples(film, scene, sensor, decided, seed=seed, first_sample=0, num_samples=samples, num_lanes=lanes)
    return to_estimate(film, decided.groups, samples, shape)


def radiance(scene: Scene, rays: Rays, *, seed: int = 0, samples: int = 64, **options) -> Estimate:
    """Radiance arriving along rays [*batch], by layer, W/(m2 sr); `options` as in `plan`."""
    shape = np.shape(rays.origin)[:-1]
    flat = Rays(
        *(jnp.asarray(x, jnp.float32).reshape(-1, *x.shape[len(shape) :]) for x in (rays.origin, rays.direction, rays.t_max))
    )
    return _sense(scene, sensors.RaySensor(flat), shape, seed=seed, samples=samples, **options)


def irradiance(scene: Scene, points: ArrayLike, normals: ArrayLike, *, seed: int = 0, samples: int = 64, **options) -> Estimate:
    """Irradiance on the side of the unit `normals` at points [*batch, 3], W/m2, by the class of path that arrives.

    The layer `emission` holds light straight from the sources.
    """
    points, normals = jnp.asarray(points, jnp.float32), jnp.asarray(normals, jnp.float32)
    sensor = sensors.IrradianceSensor(points.reshape(-1, 3), normals.reshape(-1, 3))
    return _sense(scene, sensor, points.shape[:-1], seed=seed, samples=samples, **options)


def fluence(scene: Scene, points: ArrayLike, *, seed: int = 0, samples: int = 64, **options) -> Estimate:
    """Fluence at points [*batch, 3], W/m2, by the class of path that arrives; `emission` is unscattered light."""
    points = jnp.asarray(points, jnp.float32)
    sensor = sensors.FluenceSensor(points.reshape(-1, 3))
    return _sense(scene, sensor, points.shape[:-1], seed=seed, samples=samples, **options)
