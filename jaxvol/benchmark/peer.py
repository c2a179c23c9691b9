"""Mitsuba 3 on our scenes, where it is installed: pictures of the sum of all layers, in batches whose spread is the noise."""

import importlib.util
import os
import re
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from jaxvol import mitsuba_export, mitsuba_phong
from jaxvol.benchmark.config import PeerTable, SceneEntry
from jaxvol.benchmark.measure import Cost, First, first_call, measured
from jaxvol.scene import SceneFile

_LEAST_LLVM = 19  # 19 and 22 work, 14 and 15 abort ("Cannot select: fmaximum")


@dataclass(frozen=True)
class PeerRun:
    """Mean picture of all batches, variance of one batch, and what one batch took."""

    samples: int
    mean: np.ndarray  # [H, W, 3]
    variance: np.ndarray
    cost: Cost


def installed() -> bool:
    """Whether Mitsuba 3 can be imported."""
    return importlib.util.find_spec("mitsuba") is not None


def choose_variant() -> str:
    """`llvm_ad_rgb` where a library that it can use is found, else `scalar_rgb`; the library goes to the environment."""
    if "DRJIT_LIBLLVM_PATH" in os.environ:
        return "llvm_ad_rgb"
    found = []
    for path in Path("/usr/lib").glob("*/libLLVM*.so*"):
        version = re.search(r"(\d+)(\.\d+)*$", path.name.replace(".so", "")) or re.search(r"-(\d+)", path.name)
        if version and int(version.group(1)) >= _LEAST_LLVM:
            found.append((int(version.group(1)), str(path)))
    if not found:
        return "scalar_rgb"
    os.environ["DRJIT_LIBLLVM_PATH"] = max(found)[1]
    return "llvm_ad_rgb"


def _render(file: SceneFile, entry: SceneEntry, samples: int, seed: int) -> Callable[[int], np.ndarray]:
    """A function that renders picture k. Raises ValueError for scenes that Mitsuba cannot express."""
    import mitsuba

    if mitsuba.variant() is None:
        mitsuba.set_variant(choose_variant())
        mitsuba_phong.register()
    with tempfile.TemporaryDirectory() as folder:
        described = mitsuba_export.to_mitsuba_dict(
            file.scene, file.camera, folder, integrator=entry.peer_integrator, scale=entry.peer_scale
        )
        loaded = mitsuba.load_dict(described)
    return lambda k: np.array(mitsuba.render(loaded, seed=seed + 1000 + k, spp=samples), np.float64)


def compile_peer(file: SceneFile, entry: SceneEntry, *, samples: int, seed: int) -> First:
    """The first picture, for which Mitsuba compiles a kernel that it keeps."""
    return first_call(lambda k: _render(file, entry, samples, seed)(k))


def run_peer(
    file: SceneFile, entry: SceneEntry, settings: PeerTable, *, samples: int, seed: int, first: First | None = None
) -> PeerRun:
    """`batches` pictures of `samples` samples a pixel. Raises ValueError for scenes that Mitsuba cannot express."""
    render, pictures = _render(file, entry, samples, seed), []

    def call(k: int) -> None:
        pictures.append(render(k))

    _, cost = measured(call, repeats=settings.batches, first=first)
    batches = np.stack(pictures[-settings.batches :])
    return PeerRun(samples, batches.mean(axis=0), batches.var(axis=0, ddof=1), cost)
