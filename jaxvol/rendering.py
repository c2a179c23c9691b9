"""Run one method on a loaded scene and keep the books: keyword arguments, stages, plan, compile and run times.

A method is a module with `claims(scene)`, `plan(scene, camera, *, ...)` and `render(scene, camera, plan, *, seed, ...)`.
Which keyword arguments it takes is read off `plan` and `render`. Two of them are offered to every method that names them:
`on_progress(share)` is called as work gets done, `on_stage(name)` after each stage, for the table of stage times.
"""

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
from jaxvol.jobs import Parts, Stop
from jaxvol.layers import NAMES, SURFACE, VOLUME, Claim, total
from jaxvol.scene import SceneFile
from jaxvol.scene_config import nearest
from jaxvol.types import Estimate, Scene

OFFERED = (
    "seed",
    "on_progress",
    "on_stage",
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
    """Plan and render the scene with one method, timed. Raises ValueError for what the method refuses."""
    name = file.render.method if method is None else method
    if file.camera is None:
        raise ValueError("camera is missing: a picture needs a [camera] table")
    if name == "auto" or file.render.layers:
        raise ValueError("render.layers and method 'auto' (composites of methods) are not supported yet; name one method")
    module = load_method(name)
    plan_arguments, render_arguments = method_arguments(module, name, file)
    stages: dict[str, float] = {}
    with compile_seconds() as compiling:
        start = time.perf_counter()
        claims = tuple(module.claims(file.scene))
        plan = module.plan(file.scene, file.camera, **plan_arguments)
        planned, last = time.perf_counter(), [time.perf_counter()]
        compiled_in_plan = compiling[0]

        def on_stage(stage: str) -> None:
            now = time.perf_counter()
            stages[stage] = stages.get(stage, 0.0) + now - last[0]
            last[0] = now

        offered = {"seed": file.render.seed, "on_progress": on_progress, "on_stage": on_stage}
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
