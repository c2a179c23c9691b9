"""Stage 3, baking: receivers in parts that survive a kill, with progress; the same numbers however it is cut."""

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from jaxvol.jobs import Parts, Stop
from jaxvol.layers import SURFACE
from jaxvol.methods.impulse_response import estimate, radiosity, sharing
from jaxvol.methods.impulse_response.kit import Kit
from jaxvol.methods.impulse_response.planning import Plan

_PART, _PATHS = 4096, 1 << 18  # receivers at a time, and paths: some seconds until a bake stops or is kept


class Baked(NamedTuple):
    """Irradiance at receivers by layer, variance of its total, and `estimate.irradiance`'s shares."""

    irradiance: dict[str, np.ndarray]  # each [N, 3]
    variance: np.ndarray  # [N, 3], sum over layers
    variance_straight: np.ndarray  # of light straight from emitters alone
    shares: dict[str, float]  # dropped because occluded, marched, beyond the tables
    harmonics: np.ndarray | None = None  # [N, 9, 3], SH of incident radiance
    harmonics_straight: np.ndarray | None = None  # of light straight from emitters alone


class Interrupted(Exception):
    """The user stopped the bake; finished parts are kept."""


def bake(
    kit: Kit,
    plan: Plan,
    points: np.ndarray,
    normals: np.ndarray,
    *,
    name: str,
    samples: int,
    seed: int = 0,
    share: int = 1,
    parts: Parts | None = None,
    stop: Stop | None = None,
    on_progress: Callable[[float], None] | None = None,
) -> Baked:
    """Bake receivers [N, 3] in parts called `name-<number>`; parts that are done are taken from the store.

    With `share` > 1 one of so many receivers has light that met surface or medium computed, the others interpolate it
    (`sharing`), by samples sqrt(share) paths, about where noise per time is least; light straight from emitters is computed
    at all, by `samples`. Biased then where light bends within a group of receivers.
    `on_progress` gets the number of receivers that were finished. Raises `Interrupted` between parts once `stop` is set,
    ValueError for `share` < 1.
    """
    if share < 1:
        raise ValueError(f"share: {share} is not allowed, must be >= 1")
    more = round(samples * np.sqrt(share))
    kit = radiosity.cached(kit, points, normals, plan, num_paths=more * len(points) // share, seed=seed)
    job = _Job(plan, samples, seed, parts, stop)
    if share == 1 or len(points) <= share:
        return _in_parts(kit, job, points, normals, name, on_progress)
    shared = sharing.choose(points, normals, share=share, caster=None if kit.open else kit.caster)
    straight = _in_parts(replace(kit, responses=None, max_bounces=0, cache=None), job, points, normals, f"{name}-straight")
    told = None if on_progress is None else lambda count: on_progress(count * len(points) / len(shared.rows))
    job = job._replace(samples=more)
    rest = _in_parts(kit, job, points[shared.rows], normals[shared.rows], f"{name}-shared", told)
    irradiance = {layer: np.maximum(shared.spread(value), 0) for layer, value in rest.irradiance.items()}
    variance = straight.variance + shared.spread_variance(rest.variance - rest.variance_straight)
    harmonics = None
    if plan.harmonics:
        harmonics = straight.harmonics + shared.spread(rest.harmonics - rest.harmonics_straight)
    return rest._replace(
        irradiance=irradiance | {"surface_from_light": straight.irradiance["surface_from_light"]},
        variance=variance,
        variance_straight=straight.variance_straight,
        harmonics=harmonics,
        harmonics_straight=straight.harmonics_straight,
    )


class _Job(NamedTuple):
    plan: Plan
    samples: int
    seed: int
    parts: Parts | None
    stop: Stop | None


def _in_parts(kit: Kit, job: _Job, points, normals, name, on_progress=None) -> Baked:
    """Receivers in parts that take some seconds each."""
    plan, samples, seed, parts, stop = job
    found = []
    size = min(_PART, max(256, _PATHS // samples))
    for number, first in enumerate(range(0, len(points), size)):
        rows = slice(first, first + size)
        label = f"{name}-{number}"
        done = None if parts is None else parts.get(label)
        if done is None:
            if stop:
                raise Interrupted(f"{first} of {len(points)} receivers of {name} are done")
            result = estimate.bake(kit, points[rows], normals[rows], plan, samples=samples, seed=seed, first_item=first)
            done = {layer: np.asarray(getattr(result.mean, layer)) for layer in SURFACE}
            done["variance"] = sum(np.asarray(getattr(result.variance, layer)) for layer in SURFACE)
            done["variance_straight"] = np.asarray(result.variance.surface_from_light)
            done |= {name: np.asarray(value) for name, value in result.diagnostics.items()}
            if parts is not None:
                parts.put(label, done)
        found.append(done)
        if on_progress is not None:
            on_progress(len(done["variance"]))
    weights = np.array([len(part["variance"]) for part in found], np.float64)
    once = np.array([part["surface_from_volume"].sum() for part in found], np.float64)
    dropped = np.array([float(part["occluded_share"]) for part in found])
    lost = once * dropped / np.maximum(1 - dropped, 1e-6)
    shares = {"occluded_share": float(lost.sum() / max(once.sum() + lost.sum(), 1e-30))}
    for name in ("marched_share", "beyond_share"):
        shares[name] = float(np.average([float(part[name]) for part in found], weights=weights))

    def whole(name):
        return np.concatenate([part[name] for part in found])

    return Baked(
        irradiance={layer: whole(layer) for layer in SURFACE},
        variance=whole("variance"),
        variance_straight=whole("variance_straight"),
        shares=shares,
        harmonics=whole("harmonics") if plan.harmonics else None,
        harmonics_straight=whole("harmonics_straight") if plan.harmonics else None,
    )


def total(baked: Baked) -> np.ndarray:
    """Irradiance over all layers [N, 3]."""
    return sum(baked.irradiance.values())
