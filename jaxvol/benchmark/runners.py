"""Run one thing that is compared: a method of ours, anyone's function over rays, or a bake."""

import importlib
import os
import sys
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxvol import camera as cameras
from jaxvol import rendering
from jaxvol.benchmark.config import MethodEntry, SceneEntry, Settings, scene_name
from jaxvol.benchmark.measure import Cost, First, first_call, measured
from jaxvol.layers import from_items, items
from jaxvol.methods import impulse_response
from jaxvol.methods.impulse_response import baking, lightmap
from jaxvol.scene import SceneFile, load_scene, read_table
from jaxvol.scene_config import method_names
from jaxvol.types import Estimate, Layers, Rays, Scene

GROUP = "jaxvol.methods"  # of Python entry points
Function = Callable[[Scene, Rays, int], Layers]


@dataclass(frozen=True)
class Run:
    """A picture and what it took."""

    estimate: Estimate
    cost: Cost
    seconds: dict[str, float]  # plan, compile, run (the rest of a warm call)
    about: dict[str, Any]  # claims and what else a reader wants


def load_file(entry: SceneEntry, base: Path, *, overrides: tuple[str, ...] = ()) -> SceneFile:
    """The scene of an entry at its size, with its overrides and more; those of [render] share one scene."""
    path = base / entry.file
    own = (f"camera.width={entry.width}", f"camera.height={entry.height}", *entry.overrides)
    if not all(text.startswith("render.") for text in overrides):
        file = load_scene(path, overrides=[*own, *overrides])
    else:
        file = _loaded(path, own, path.stat().st_mtime_ns if path.exists() else 0)
        if overrides:
            file = SceneFile(**{**vars(file), "render": read_table(path, overrides=[*own, *overrides]).render})
    return SceneFile(**{**vars(file), "name": scene_name(entry)})


@lru_cache(maxsize=1)  # wanted two or three times for each setting, and smoke takes a second to make
def _loaded(path: Path, overrides: tuple[str, ...], changed: int) -> SceneFile:
    return load_scene(path, overrides=overrides)


def as_overrides(method: str, settings: Settings) -> tuple[str, ...]:
    """Settings as overrides of a scene file: `samples` and dotted keys go below [render], others below the method."""
    found = []
    for key, value in settings.items():
        shared = key in ("samples", "max_scatterings") or key.split(".")[0] in (*method_names(), "layers")
        text = str(value).lower() if isinstance(value, bool) else repr(value) if isinstance(value, str) else value
        found.append(f"render.{key}={text}" if shared else f"render.{method}.{key}={text}")
    return tuple(found)


def _rendered(file: SceneFile, method: str, seed: int) -> rendering.Rendering:
    told = file.render.model_copy(update={"seed": seed})
    return rendering.render_scene(SceneFile(**{**vars(file), "render": told}), method=method)


def compile_method(file: SceneFile, method: str, *, seed: int) -> First:
    """The first call of one of our methods, for its programs; several may be made at a time."""
    return first_call(lambda _: _rendered(file, method, seed))


def run_method(file: SceneFile, method: str, *, repeats: int, seed: int, first: First | None = None) -> Run:
    """One of our methods, or "auto"; `file` has its settings. Raises ValueError for what it refuses."""
    last, cost = measured(lambda k: _rendered(file, method, seed + k), repeats=repeats, first=first)
    claims = [{"layers": claim.name, "partial": claim.partial} for claim in last.claims]
    about = {"claims": claims, "skipped": list(last.skipped), "missing": list(last.missing)}
    about["shares"] = {share.method: list(share.layers) for share in last.shares}
    return Run(last.estimate, cost, _seconds(cost, plan=last.seconds["plan"]), about)


def _seconds(cost: Cost, *, plan: float = 0.0) -> dict[str, float]:
    """compile: what the first call took longer than a warm one, tracing and lookups in the compilation cache included."""
    return {"plan": plan, "compile": max(cost.first_seconds - cost.seconds, 0.0), "run": max(cost.seconds - plan, 0.0)}


def load_function(name: str) -> Function:
    """The function that "module:function", or an entry point of the group "jaxvol.methods", names.

    Modules are also looked for in the current folder. Raises ValueError where there is none.
    """
    if ":" not in name:
        found = [point for point in entry_points(group=GROUP) if point.name == name]
        if not found:
            raise ValueError(f"entry = {name!r}: no entry point of that name in the group {GROUP!r}, and no module:function")
        return found[0].load()
    module, _, function = name.partition(":")
    if os.getcwd() not in sys.path:
        sys.path.insert(0, os.getcwd())
    try:
        found = getattr(importlib.import_module(module), function)
    except (ImportError, AttributeError) as error:
        raise ValueError(f"entry = {name!r} cannot be loaded: {error}") from error
    return found


def run_function(file: SceneFile, entry: MethodEntry, function: Function, *, repeats: int, seed: int) -> Run:
    """Anyone's function over rays: `rays_per_pixel` of them in each pixel, on a shifted lattice, averaged."""
    side = int(np.ceil(np.sqrt(entry.rays_per_pixel)))
    centers = np.asarray(cameras.pixel_centers(file.camera))
    shifts = [((i % side + 0.5) / side - 0.5, (i // side + 0.5) / side - 0.5) for i in range(side * side)]
    points = (centers[:, None] + np.asarray(shifts)[None]).reshape(-1, 2)
    rays = cameras.generate_rays(file.camera, jnp.asarray(points, jnp.float32))
    shape = (file.camera.height, file.camera.width, side * side, 3)

    def call(k: int) -> Layers:
        return jax.block_until_ready(function(file.scene, rays, seed + k))

    last, cost = measured(call, repeats=repeats)
    if not isinstance(last, Layers):
        raise ValueError(f"entry = {entry.entry!r} must return jaxvol.types.Layers, not {type(last).__name__}")
    mean = from_items({name: jnp.asarray(value).reshape(shape).mean(axis=2) for name, value in items(last)})
    claims = [{"layers": name, "partial": None} for name, _ in items(last)]
    return Run(Estimate(mean=mean), cost, _seconds(cost), {"claims": claims, "skipped": [], "missing": [], "shares": {}})


def run_bake(file: SceneFile, *, texels: int, repeats: int, seed: int) -> tuple[Cost, int]:
    """A lightmap of texels^2 with the file's options: what it took, and how many texels were covered."""
    options = dict(file.render.options.get("impulse_response", {}))
    samples = options.pop("samples", 4)
    plan = impulse_response.plan(file.scene, None, **options)
    kit = impulse_response.prepare(file.scene, plan)
    atlas = lightmap.unwrap(file.scene.mesh, resolution=texels)
    points, normals = atlas.receiver, atlas.normal

    def call(k: int) -> baking.Baked:
        return baking.bake(kit, plan, points, normals, name="texels", samples=samples, seed=seed + k)

    _, cost = measured(call, repeats=repeats)
    return cost, len(points)
