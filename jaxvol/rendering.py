"""Run one method, or several for one picture, and keep the books: keyword arguments, stages, plan, compile and run times.

A method is a module with `claims(scene)`, `plan(scene, camera, *, ...)` and `render(scene, camera, plan, *, seed, ...)`.
Which keyword arguments it takes is read off `plan` and `render`. Two of them are offered to every method that names them:
`on_progress(share)` is called as work gets done, `on_stage(name)` after each stage, for the table of stage times.

A composite (`jaxvol.composite`) runs each of its methods once. What they share is handed to every method whose `render`
names `common`; a plan's fields `emission`, `surface` and `volume`, where it has them, are switched off for layers that
nobody asks of it.
"""

import dataclasses
import importlib
import inspect
import platform
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType
from typing import Any

import jax
import jaxlib
import numpy as np
from pydantic import ConfigDict, TypeAdapter, ValidationError

import jaxvol
from jaxvol import composite, costs
from jaxvol.common_stages import CommonStages
from jaxvol.composite import Share
from jaxvol.jobs import Parts, Stop
from jaxvol.layers import NAMES, SURFACE, VOLUME, Claim, total
from jaxvol.scene import SceneFile
from jaxvol.scene_config import nearest
from jaxvol.types import Estimate, Scene

OFFERED = (
    "seed",
    "on_progress",
    "on_stage",
    "common",
    "parts",
    "stop",
    "seconds",
    "until_error",
)  # what the caller of `render_scene` provides, never a scene file
SAMPLES = ("samples", "num_samples")  # both names that methods give to samples per pixel
NEVER = 2**30  # a number of scatterings that no path reaches
COMPILING = "/jax/core/compile/"


@dataclass
class Rendering:
    """A picture with its books."""

    estimate: Estimate
    method: str
    arguments: dict[str, Any]  # the keyword arguments that the method was called with
    claims: tuple[Claim, ...]
    skipped: tuple[str, ...]
    seconds: dict[str, float]  # plan, compile, run
    stages: dict[str, float] = field(default_factory=dict)  # compile time included where a stage compiled
    shares: tuple[Share, ...] = ()  # of a composite: who computed what, and why
    missing: tuple[str, ...] = ()  # layers that nobody computed though the scene may contain them
    negligible: tuple[str, ...] = ()  # layers left out for holding next to nothing, by a bound that `skipped` tells

    @property
    def nonfinite_pixels(self) -> int:
        """Pixels of the picture with a channel that is NaN or infinite."""
        return int(np.count_nonzero(~np.isfinite(np.asarray(total(self.estimate.mean))).all(axis=-1)))


def load_method(name: str) -> ModuleType:
    """The module of a method."""
    return importlib.import_module("jaxvol.direct" if name == "direct" else f"jaxvol.methods.{name}")


def method_arguments(module: ModuleType, name: str, file: SceneFile) -> tuple[dict[str, Any], dict[str, Any]]:
    """Keyword arguments of the method's `plan` and `render` from the [render] table and its own subtable.

    Raises ValueError for a key that the method does not have, or a value of the wrong type.
    """
    own = dict(file.render.options.get(name, {}))
    shared = dict.fromkeys(SAMPLES, file.render.samples)
    if file.render.max_scatterings is not None:
        shared["max_scatterings"] = file.render.max_scatterings
    if not file.render.russian_roulette:
        shared["roulette_from"] = NEVER
    chosen, known = ({}, {}), {}
    for keywords, function in zip(chosen, (module.plan, module.render), strict=True):
        for key, parameter in inspect.signature(function).parameters.items():
            if parameter.kind is not inspect.Parameter.KEYWORD_ONLY or key in OFFERED:
                continue
            known[key] = parameter
            if key in own:
                keywords[key] = _typed(f"render.{name}.{key}", own[key], parameter.annotation)
            elif key in shared:
                keywords[key] = shared[key]
    for key in own:
        if key not in known:
            raise ValueError(f"render.{name}: unknown key {key!r}{nearest(key, tuple(known))}")
    return chosen


def _typed(key: str, value: Any, annotation: Any) -> Any:
    if annotation is inspect.Parameter.empty or isinstance(annotation, str):
        return value
    try:
        return TypeAdapter(annotation, config=ConfigDict(arbitrary_types_allowed=True)).validate_python(value)
    except ValidationError as error:
        expected = getattr(annotation, "__name__", None) or str(annotation)
        raise ValueError(f"{key} = {value!r} must be {expected}") from error


Progress = Callable[..., None]  # (share of the work that is done, note)


@dataclass(frozen=True)
class Job:
    """How a render that may take long is kept and ended; for methods whose `render` takes `parts` and `stop`."""

    folder: Path  # of the saved accumulators
    stop: Stop
    goal: dict[str, float]  # `seconds` or `until_error`, where given instead of a number of samples


def _job_arguments(job: Job | None, name: str, module: ModuleType, file: SceneFile, plan: object) -> dict[str, Any]:
    """Keyword arguments of a job; a folder that holds another scene's samples is started anew."""
    taken = inspect.signature(module.render).parameters
    for key in {} if job is None else job.goal:
        if key not in taken:
            raise ValueError(
                f"--{'time' if key == 'seconds' else 'until-error'}: {name} does not refine; only path_tracing does"
            )
    if job is None or "parts" not in taken:
        return {}
    digest = module.scene_digest(file.scene, file.camera)
    config = {"scene": digest, "plan": repr(plan), "seed": file.render.seed, "versions": versions()}
    try:
        parts = Parts(job.folder, config=config)
    except ValueError:
        parts = Parts(job.folder, config=config, restart=True)
    return {"parts": parts, "stop": job.stop, **job.goal}


def render_scene(
    file: SceneFile, *, method: str | None = None, on_progress: Progress | None = None, job: Job | None = None
) -> Rendering:
    """Plan and render the scene, timed: with `method` alone, else as the file says, by [render.layers] or its method.

    "auto" chooses a method for each layer. Raises ValueError for what a method or the composite refuses.
    """
    name = file.render.method if method is None else method
    if file.camera is None:
        raise ValueError("camera is missing: a picture needs a [camera] table")
    if name == "auto" or (method is None and file.render.layers):
        return _render_composite(file, on_progress=on_progress, job=job, chosen=name == "auto" and not file.render.layers)
    result = _run(file, name, on_progress=on_progress, job=job)
    held = {layer for claim in result.claims for layer in claim.layers}
    missing = tuple(layer for layer in composite.possible(file.scene) if layer not in held)
    return dataclasses.replace(result, missing=missing)


def _render_composite(file: SceneFile, *, on_progress: Progress | None, job: Job | None, chosen: bool) -> Rendering:
    """Every method of the assignment once, and the sum."""
    if job is not None and job.goal:
        key = "--time" if "seconds" in job.goal else "--until-error"
        raise ValueError(f"{key}: a composite does not refine; name one method (path_tracing does)")
    start = time.perf_counter()
    assigned = assign(file, automatic=chosen)
    parts, seconds = [], {"plan": time.perf_counter() - start, "compile": 0.0, "run": 0.0}
    common = CommonStages(file.scene, file.camera)
    for index, share in enumerate(assigned.shares):
        report = None
        if on_progress is not None:

            def report(done: float, note: str = "", index: int = index, name: str = share.method) -> None:
                on_progress((index + min(done, 1.0)) / len(assigned.shares), f"{name} {note}".strip())

        parts.append(_run(file, share.method, on_progress=report, job=job, share=share, common=common))
        if report is not None:
            report(1.0)
    for part in parts:
        seconds = {key: value + part.seconds[key] for key, value in seconds.items()}
    pairs = [(share, part.estimate) for share, part in zip(assigned.shares, parts, strict=True)]
    return Rendering(
        estimate=composite.compose(pairs),
        method="+".join(part.method for part in parts),
        arguments={part.method: part.arguments for part in parts},
        claims=tuple(claim for share in assigned.shares for claim in share.claims),
        skipped=(*_left_out(assigned), *(f"{part.method}: {line}" for part in parts for line in part.skipped)),
        seconds=seconds,
        stages={f"{part.method}: {stage}": value for part in parts for stage, value in part.stages.items()},
        shares=assigned.shares,
        missing=assigned.missing,
        negligible=assigned.negligible,
    )


def _left_out(assigned: composite.Assignment) -> list[str]:
    return [f"auto: {', '.join(assigned.negligible)}: {assigned.bound}"] if assigned.negligible else []


def assign(file: SceneFile, *, automatic: bool = False) -> composite.Assignment:
    """Who computes which layer of a scene file: its [render.layers], or by what the scene is. Raises ValueError."""

    def claims_of(name: str) -> tuple[Claim, ...]:
        return tuple(load_method(name).claims(file.scene))

    allow = file.render.allow_partial
    if automatic or not file.render.layers:
        prices = expected_costs(file)
        tolerance = file.render.negligible
        assigned = composite.choose(file.scene, claims_of, allow_partial=allow, costs=prices, tolerance=tolerance)
    else:
        assigned = composite.from_table(file.render.layers, file.scene, claims_of, allow_partial=allow)
    if not assigned.shares:
        raise ValueError("no layer is computed: the scene has no light, or nothing that a camera could see by it")
    return assigned


def expected_costs(file: SceneFile) -> costs.Costs | None:
    """Rough seconds of the methods that have a rule; None without a camera, or where `direct` refuses the scene."""
    if file.camera is None or not composite.is_straight(file.scene):
        return None
    direct, tracer = load_method("direct"), load_method("path_tracing")
    plan = direct.plan(file.scene, file.camera, **method_arguments(direct, "direct", file)[0])
    others = {"deep_screen_space": costs.deep_screen_space(file.camera), "direct": costs.direct(file.scene, file.camera, plan)}
    samples = method_arguments(tracer, "path_tracing", file)[1].get("samples", file.render.samples)
    return costs.Costs(costs.path_tracing(file.camera, samples), others)


def restricted(plan: Any, layers: tuple[str, ...]) -> Any:
    """The plan without the kinds of receiver that none of `layers` has, where it has switches for them."""
    kinds = ("emission", "surface", "volume")
    held = {f.name for f in dataclasses.fields(plan)} if dataclasses.is_dataclass(plan) else set()
    wanted = {kind: any(layer.split("_")[0] == kind for layer in layers) for kind in kinds}
    off = {kind: False for kind in kinds if kind in held and not wanted[kind] and getattr(plan, kind) is True}
    return dataclasses.replace(plan, **off) if off else plan


def _run(
    file: SceneFile,
    name: str,
    *,
    on_progress: Progress | None,
    job: Job | None,
    share: Share | None = None,
    common: CommonStages | None = None,
) -> Rendering:
    """One method: all that it claims, or its share of a composite."""
    module = load_method(name)
    plan_arguments, render_arguments = method_arguments(module, name, file)
    stages: dict[str, float] = {}
    with compile_seconds() as compiling:
        start = time.perf_counter()
        claims = tuple(module.claims(file.scene)) if share is None else share.claims
        plan = module.plan(file.scene, file.camera, **plan_arguments)
        if share is not None:
            plan = restricted(plan, share.layers)
        planned, last = time.perf_counter(), [time.perf_counter()]
        compiled_in_plan = compiling[0]

        def on_stage(stage: str) -> None:
            now = time.perf_counter()
            stages[stage] = stages.get(stage, 0.0) + now - last[0]
            last[0] = now

        offered = {"seed": file.render.seed, "on_progress": on_progress, "on_stage": on_stage, "common": common}
        taken = inspect.signature(module.render).parameters
        offered = {key: value for key, value in offered.items() if key in taken and value is not None}
        offered |= _job_arguments(job, name, module, file, plan)
        estimate = module.render(file.scene, file.camera, plan, **render_arguments, **offered)
        estimate = jax.block_until_ready(estimate)
        done = time.perf_counter()
    compile_in_render = min(compiling[0] - compiled_in_plan, done - planned)
    return Rendering(
        estimate=estimate,
        method=name,
        arguments=plan_arguments | render_arguments | ({"seed": file.render.seed} if "seed" in taken else {}),
        claims=claims,
        skipped=tuple(getattr(plan, "skipped", ())),
        seconds={
            "plan": max(planned - start - compiled_in_plan, 0.0),
            "compile": min(compiled_in_plan, planned - start) + compile_in_render,
            "run": done - planned - compile_in_render,
        },
        stages=stages,
    )


@contextmanager
def compile_seconds() -> Iterator[list[float]]:
    """Yield a list whose one number grows by the seconds that JAX spends tracing and compiling inside the block."""
    seconds = [0.0]

    def listen(event: str, duration: float, **_: Any) -> None:
        if event.startswith(COMPILING):
            seconds[0] += duration

    jax.monitoring.register_event_duration_secs_listener(listen)
    try:
        yield seconds
    finally:
        jax.monitoring.unregister_event_duration_listener(listen)


def lacks(scene: Scene) -> list[str]:
    """What a scene does not contain, in words, and which layers are therefore exactly zero."""
    found = []
    if scene.mesh is None:
        found.append(f"no surfaces: {', '.join(SURFACE)} and volume_from_surface are zero, no rays are cast")
    elif scene.mesh.specular is None:
        found.append("no glossy surfaces: Lambertian reflection only")
    if scene.medium is None:
        found.append(f"no medium: {', '.join(VOLUME)} and surface_from_volume are zero, no free flights, no marching")
    else:
        medium = scene.medium
        if medium.density is None:
            found.append("homogeneous medium: transmittance in closed form, no grid lookups")
        if medium.ior is None:
            found.append("no refractive index: rays stay straight")
        if medium.phase is None:
            found.append("no table of phase moments: Henyey-Greenstein in closed form")
        if medium.boundary is None:
            found.append("medium bounded by its box: no search for crossings of a mesh")
        if not medium.inclusions:
            found.append("no inclusions")
    kinds = ("point_lights", "spot_lights", "directional_lights", "area_lights", "environment")
    missing = [kind.replace("_", " ") for kind in kinds if getattr(scene, kind) is None]
    if missing:
        found.append(f"no {', no '.join(missing)}")
    return found


def unclaimed(claims: tuple[Claim, ...]) -> list[str]:
    """Layers that a method does not compute."""
    claimed = {layer for claim in claims for layer in claim.layers}
    return [name for name in NAMES if name not in claimed]


def versions() -> dict[str, str]:
    """What a result depends on."""
    return {
        "jaxvol": jaxvol.__version__,
        "jax": jax.__version__,
        "jaxlib": jaxlib.__version__,
        "numpy": np.__version__,
        "python": platform.python_version(),
    }


def device() -> str:
    """The device that JAX computes on."""
    first = jax.devices()[0]
    return f"{first.platform}: {first.device_kind} x {jax.device_count()}, {platform.machine()}"
