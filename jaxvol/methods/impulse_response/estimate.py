"""Irradiance at receivers, by layer, with its variance: delta lights without noise, everything else by surface paths."""

from collections.abc import Callable

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike

from jaxvol import zonal_lookup
from jaxvol.layers import SURFACE, from_items
from jaxvol.methods.impulse_response import gather, planning, receivers
from jaxvol.methods.impulse_response.kit import Kit, Tally
from jaxvol.methods.impulse_response.planning import Plan
from jaxvol.methods.impulse_response.receivers import HARMONICS
from jaxvol.types import Estimate, Scene

Progress = Callable[[float], None]


def needs_paths(kit: Kit) -> bool:
    """Whether anything beside delta lights' own light arrives."""
    return kit.max_bounces > 0 or kit.scene.area_lights is not None or kit.scene.environment is not None or kit.marches


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
    given. `first_item` numbers the receivers, so that a bake in parts draws the same numbers. Paths walk on at every surface
    (`baking.bake` and `render` end them in a cache where that is worth it). Biased by what the plan skips, by the tables'
    infinite medium, and in heterogeneous media by their mean along each segment that is not marched.

    Diagnostics: `occluded_share`, single scattering from occluded emitters that was dropped, over all of it; of the
    receivers' own segments `marched_share`; of all lookups `beyond_share`, past the largest tau of the tables; `segments`,
    the number of path and shadow rays of live paths.
    """
    decided = planning.plan(scene, None, **options) if plan is None else plan
    if samples < 1:
        raise ValueError(f"samples: {samples} is not allowed, must be >= 1")
    points, normals = np.asarray(points, np.float32), np.asarray(normals, np.float32)
    if points.shape != normals.shape or points.shape[-1:] != (3,):
        raise ValueError(f"points {points.shape} and normals {normals.shape} must both have shape [*batch, 3]")
    kit = planning.prepare(scene, decided, responses_from=tables)
    options = {"samples": samples, "seed": seed, "first_item": first_item, "on_progress": on_progress}
    return bake(kit, points, normals, decided, **options)


def bake(
    kit: Kit,
    points: np.ndarray,
    normals: np.ndarray,
    plan: Plan,
    *,
    samples: int,
    seed: int,
    first_item: int = 0,
    on_progress: Progress | None = None,
) -> Estimate:
    """`irradiance` with everything prepared; with harmonics in the plan, `diagnostics["harmonics"]` holds the SH of incident
    radiance [*batch, 9, 3], and `diagnostics["harmonics_straight"]` that of `surface_from_light` alone."""
    shape = points.shape[:-1]
    points, normals = points.reshape(-1, 3), normals.reshape(-1, 3)
    tally = Tally()
    rows = (1 + HARMONICS, 3) if plan.harmonics else (3,)
    fixed = {name: np.zeros((points.shape[0], *rows)) for name in (*SURFACE, "occluded")}
    mean = {name: np.zeros((points.shape[0], *rows)) for name in (*SURFACE, "occluded")}
    square = {name: np.zeros((points.shape[0], *rows)) for name in SURFACE}
    for first in range(0, points.shape[0], plan.num_lanes):
        part = slice(first, first + plan.num_lanes)
        arguments = (kit, points[part], normals[part], plan)
        for name, value in _delta(*arguments, tally).items():
            fixed[name][part] = value
        if not needs_paths(kit):
            continue
        for found in _paths(*arguments, samples, seed, first_item + first, tally):
            for name, value in found.items():
                mean[name][part] += value.sum(axis=0)
                if name in square:
                    square[name][part] += np.square(value, dtype=np.float64).sum(axis=0)
        if on_progress is not None:
            on_progress(min(first + plan.num_lanes, points.shape[0]) / points.shape[0])
    variance = {}
    for name in SURFACE:
        mean[name] /= samples
        variance[name] = np.maximum(square[name] / samples - mean[name] ** 2, 0) / max(samples - 1, 1)
        mean[name] += fixed[name]
    lost = float(_first(fixed["occluded"] + mean["occluded"] / samples).sum())
    once = float(_first(mean["surface_from_volume"]).sum())
    diagnostics = {
        "occluded_share": jnp.float32(lost / max(once + lost, 1e-30)),
        "marched_share": jnp.float32(_share(tally, "marched", "segments")),
        "beyond_share": jnp.float32(_share(tally, "beyond", "lookups")),
        "segments": jnp.float32(tally.get("traced", 0)),
    }
    if plan.harmonics:
        diagnostics["harmonics"] = jnp.asarray(_shaped(sum(mean[name] for name in SURFACE)[:, 1:], shape))
        diagnostics["harmonics_straight"] = jnp.asarray(_shaped(mean["surface_from_light"][:, 1:], shape))
    return Estimate(
        # Image sources may take off a little more than there is: no light is negative.
        mean=from_items({name: jnp.asarray(_shaped(np.maximum(_first(mean[name]), 0), shape)) for name in SURFACE}),
        variance=from_items({name: jnp.asarray(_shaped(_first(variance[name]), shape)) for name in SURFACE}),
        num_samples=jnp.float32(samples),
        diagnostics=diagnostics,
    )


def _share(tally, part, whole):
    return float(tally.get(part, 0)) / max(float(tally.get(whole, 0)), 1.0)


def _first(value):
    """Irradiance among a receiver's rows."""
    return value if value.ndim == 2 else value[:, 0]


def _shaped(value, shape):
    return value.astype(np.float32).reshape(*shape, *value.shape[1:])


def receiver_of(plan: Plan, normals: Array) -> receivers.Receiver:
    """What a plan asks to be made of incident light."""
    return receivers.Incident(normals) if plan.harmonics else receivers.Irradiance(normals)


def _delta(kit, points, normals, plan, tally):
    """Light of delta lights at every receiver, by layer, and what was dropped."""
    num = points.shape[0]
    index = np.arange(lanes_for(num, plan.num_lanes)) % num
    receiver = receiver_of(plan, jnp.asarray(normals[index]))
    found = gather.delta_arrivals(kit, receiver, jnp.asarray(points[index]), tally)
    names = ("surface_from_light", "surface_from_volume", "surface_from_multiple", "occluded")
    return {name: np.asarray(value)[:num] for name, value in zip(names, found, strict=True)}


def _paths(kit, points, normals, plan, samples, seed, first_item, tally):
    """Layers [replicas, receivers, ...] of one batch of paths after another; item = receiver, whatever the batches."""
    num = points.shape[0]
    lanes = lanes_for(num * samples, plan.num_lanes)
    replicas = lanes // num
    index = np.arange(lanes) % num
    item, seed = jnp.asarray(first_item + index, jnp.int32), jnp.uint32(seed)
    position, receiver = jnp.asarray(points[index]), receiver_of(plan, jnp.asarray(normals[index]))
    for first in range(0, samples, replicas):
        sample = jnp.asarray(first + np.arange(lanes) // num, jnp.int32)
        found = gather.path_arrivals(kit, receiver, position, item, sample, seed, tally)
        count = min(replicas, samples - first)
        yield {name: np.asarray(value)[: count * num].reshape(count, num, *value.shape[1:]) for name, value in found.items()}
