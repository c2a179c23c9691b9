"""Irradiance at receivers, by layer, with its variance: delta lights without noise, everything else by surface paths."""

from collections.abc import Callable

import jax.numpy as jnp
import numpy as np
from jaxtyping import ArrayLike

from jaxvol import zonal_lookup
from jaxvol.layers import SURFACE, from_items
from jaxvol.methods.impulse_response import gather, planning
from jaxvol.methods.impulse_response.planning import Plan
from jaxvol.types import Estimate, Scene

Progress = Callable[[float], None]


def needs_paths(kit: gather.Kit) -> bool:
    """Whether anything beside delta lights' own light arrives."""
    return kit.max_bounces > 0 or kit.scene.area_lights is not None or kit.scene.environment is not None


def lanes_for(items: int, limit: int) -> int:
    """Lanes in powers of four, so that bakes of all sizes share a few compilations."""
    lanes = 256
    while lanes < limit and lanes < items:
        lanes *= 4
    return min(lanes, limit)


def irradiance(
    scene: Scene,
    points: ArrayLike,
    normals: ArrayLike,
    *,
    plan: Plan | None = None,
    tables: zonal_lookup.ZonalTables | None = None,
    samples: int = 64,
    seed: int = 0,
    first_item: int = 0,
    on_progress: Progress | None = None,
    **options,
) -> Estimate:
    """Irradiance on the side of the unit `normals` at points [*batch, 3] of surfaces, W/m2, by layer of the light it reflects.

    `surface_from_light` is light straight from emitters, `surface_from_volume` light scattered once on the way,
    `surface_from_surface` light from one surface, `surface_from_multiple` the rest. `options` as in `plan` where none is
    given. `first_item` numbers the receivers, so that a bake in parts draws the same numbers. Biased by what the plan
    skips, by the tables' infinite medium, and in heterogeneous media by their mean along each segment. Diagnostics:
    `occluded_share` is single scattering from occluded emitters that was dropped, over all of it.
    """
    decided = planning.plan(scene, None, **options) if plan is None else plan
    if samples < 1:
        raise ValueError(f"samples: {samples} is not allowed, must be >= 1")
    points, normals = np.asarray(points, np.float32), np.asarray(normals, np.float32)
    if points.shape != normals.shape or points.shape[-1:] != (3,):
        raise ValueError(f"points {points.shape} and normals {normals.shape} must both have shape [*batch, 3]")
    kit = planning.prepare(scene, decided, responses_from=tables)
    return bake(kit, points, normals, decided, samples=samples, seed=seed, first_item=first_item, on_progress=on_progress)


def bake(
    kit: gather.Kit,
    points: np.ndarray,
    normals: np.ndarray,
    plan: Plan,
    *,
    samples: int,
    seed: int,
    first_item: int = 0,
    on_progress: Progress | None = None,
) -> Estimate:
    """`irradiance` with everything prepared."""
    shape = points.shape[:-1]
    points, normals = points.reshape(-1, 3), normals.reshape(-1, 3)
    num = points.shape[0]
    fixed = _delta(kit, points, normals, plan.num_lanes)
    mean = {name: np.zeros((num, 3)) for name in SURFACE}
    square = {name: np.zeros((num, 3)) for name in SURFACE}
    lost = fixed.pop("occluded")
    if needs_paths(kit):
        dropped = np.zeros((num, 3))
        for lane_receiver, found in _paths(kit, points, normals, plan.num_lanes, samples, seed, first_item, on_progress):
            for name, value in found.items():
                if name == "occluded":
                    _add(dropped, lane_receiver, value)
                else:
                    _add(mean[name], lane_receiver, value)
                    _add(square[name], lane_receiver, value * value)
        lost = lost + dropped / samples
    variance = {}
    for name in SURFACE:
        mean[name] /= samples
        spread = np.maximum(square[name] / samples - mean[name] ** 2, 0) / max(samples - 1, 1)
        variance[name] = spread.astype(np.float32).reshape(*shape, 3)
        mean[name] = (mean[name] + fixed.get(name, 0)).astype(np.float32).reshape(*shape, 3)
    once = float(mean["surface_from_volume"].sum())
    share = float(lost.sum()) / max(once + float(lost.sum()), 1e-30)
    return Estimate(
        mean=from_items({name: jnp.asarray(value) for name, value in mean.items()}),
        variance=from_items({name: jnp.asarray(value) for name, value in variance.items()}),
        num_samples=jnp.float32(samples),
        diagnostics={"occluded_share": jnp.float32(share)},
    )


def _add(total, receiver, value):
    for channel in range(3):
        total[:, channel] += np.bincount(receiver, weights=value[:, channel], minlength=total.shape[0])


def _chunks(total, limit):
    """(first, lanes) of runs over `total` items, the last one padded."""
    lanes = lanes_for(total, limit)
    return [(first, lanes) for first in range(0, total, lanes)]


def _delta(kit, points, normals, limit):
    """Light of delta lights at every receiver, by layer, and what was dropped."""
    names = ("surface_from_light", "surface_from_volume", "surface_from_multiple", "occluded")
    parts = {name: [] for name in names}
    for first, lanes in _chunks(points.shape[0], limit):
        index = np.minimum(first + np.arange(lanes), points.shape[0] - 1)
        found = gather.delta_arrivals(kit, jnp.asarray(points[index]), jnp.asarray(normals[index]))
        for name, value in zip(names, found, strict=True):
            parts[name].append(np.asarray(value)[: points.shape[0] - first])
    return {name: np.concatenate(values) for name, values in parts.items()}


def _paths(kit, points, normals, limit, samples, seed, first_item, on_progress):
    """Receivers and layers of every chunk of paths; item = receiver, so that results do not depend on the chunks."""
    total = points.shape[0] * samples
    for first, lanes in _chunks(total, limit):
        flat = np.minimum(first + np.arange(lanes, dtype=np.int64), total - 1)
        receiver, sample = flat // samples, flat % samples
        item = jnp.asarray(first_item + receiver, jnp.int32)
        found = gather.path_arrivals(
            kit,
            jnp.asarray(points[receiver]),
            jnp.asarray(normals[receiver]),
            item,
            jnp.asarray(sample, jnp.int32),
            jnp.uint32(seed),
        )
        count = min(lanes, total - first)
        yield receiver[:count], {name: np.asarray(value, np.float64)[:count] for name, value in found.items()}
        if on_progress is not None:
            on_progress((first + count) / total)
