"""References: the path tracer's picture of a scene, kept by a hash of everything that it depends on."""

from collections.abc import Callable
from pathlib import Path

from jaxvol import image, jobs
from jaxvol.benchmark.config import ReferenceTable
from jaxvol.methods import path_tracing
from jaxvol.scene import SceneFile
from jaxvol.types import Estimate

SEED = 987_654_321  # of no other run


def reference_path(file: SceneFile, settings: ReferenceTable, folder: Path) -> Path:
    """Where the reference of a scene is kept: its name, and 16 digits of the hash of scene, camera and settings."""
    told = {"scene": path_tracing.scene_digest(file.scene, file.camera), "settings": settings.model_dump(), "seed": SEED}
    told["max_scatterings"] = file.render.max_scatterings
    return folder / f"{file.name}-{jobs.config_hash(told)[:16]}.exr"


def reference(
    file: SceneFile, settings: ReferenceTable, folder: Path, *, on_progress: Callable[..., None] | None = None
) -> image.Picture:
    """The reference with its variance, computed where it is not kept; a killed computation goes on.

    Raises ValueError for scenes that the path tracer refuses (a refractive index).
    """
    path = reference_path(file, settings, folder)
    if path.exists():
        return image.read_picture(path)
    limit = {} if file.render.max_scatterings is None else {"max_scatterings": file.render.max_scatterings}
    plan = path_tracing.plan(file.scene, file.camera, **limit)
    path_tracing.render(file.scene, file.camera, plan, seed=SEED + 1, samples=1)  # compiles outside the budget
    parts = jobs.Parts(path.with_suffix(".parts"), config={"plan": repr(plan), "path": path.name})
    options = {"seconds": settings.seconds, "until_error": settings.until_error}
    found: Estimate = path_tracing.render(
        file.scene, file.camera, plan, seed=SEED, parts=parts, on_progress=on_progress, **options
    )
    about = {"scene": file.name, "samples": float(found.num_samples), "settings": settings.model_dump()}
    image.write_exr(path, image.estimate_channels(found), metadata=about)
    return image.read_picture(path)
