"""Stage 3, baking: receivers in parts that survive a kill, with progress; the same numbers however it is cut."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from jaxvol.jobs import Parts, Stop
from jaxvol.layers import SURFACE
from jaxvol.methods.impulse_response import estimate
from jaxvol.methods.impulse_response.kit import Kit
from jaxvol.methods.impulse_response.planning import Plan

_PART, _PATHS = 4096, 1 << 18  # receivers at a time, and paths: some seconds until a bake stops or is kept


class Baked(NamedTuple):
    """Irradiance at receivers by layer, variance of its total, and `estimate.irradiance`'s shares."""

    irradiance: dict[str, np.ndarray]  # each [N, 3]
    variance: np.ndarray  # [N, 3], sum over layers
    shares: dict[str, float]  # dropped because occluded, marched, beyond the tables
    harmonics: np.ndarray | None = None  # [N, 9, 3], SH of incident radiance


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
    parts: Parts | None = None,
    stop: Stop | None = None,
    on_progress: Callable[[float], None] | None = None,
) -> Baked:
    """Bake receivers [N, 3] in parts called `name-<number>`; parts that are done are taken from the store.

    `on_progress` gets the number of receivers that were finished. Raises `Interrupted` between parts once `stop` is set.
    """
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
    return Baked(
        irradiance={layer: np.concatenate([part[layer] for part in found]) for layer in SURFACE},
        variance=np.concatenate([part["variance"] for part in found]),
        shares=shares,
        harmonics=np.concatenate([part["harmonics"] for part in found]) if plan.harmonics else None,
    )


def total(baked: Baked) -> np.ndarray:
    """Irradiance over all layers [N, 3]."""
    return sum(baked.irradiance.values())
