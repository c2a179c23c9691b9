"""Rough seconds that methods take for a picture, from counts that are known before anything runs.

For `composite.choose`, which weighs a fast method against the path tracer where that one is needed anyway. Constants are
of two CPU cores (docs/benchmark.md, "Who does what in `auto`"), good to a factor of two or three; their ratios matter.
"""

from dataclasses import dataclass
from typing import Any

from jaxvol import extinction, lights, segments
from jaxvol.types import Camera, Scene

PATH = 5e-6  # a path of the path tracer: 3.5 in fog to 17 in a cloud of albedo 1
CONNECTION = 4e-7  # a point joined to a light: a ray, a phase function or BSDF, weights
STEP = 6e-8  # of marching through a grid
FIELD_STEP = 1e-8  # a vertex of the field swept for the sky, once per direction
SPLATTING = 0.4  # surfels, their light and lists, before any pixel
SPLATTED_PIXEL = 1.2e-5


@dataclass(frozen=True)
class Costs:
    """Of one picture."""

    path_tracing: float  # all layers together
    others: dict[str, dict[str, float]]  # by method and layer; a method that is not named has no rule


def path_tracing(camera: Camera, samples: int) -> float:
    """All layers."""
    return PATH * camera.height * camera.width * samples


def deep_screen_space(camera: Camera) -> dict[str, float]:
    """By layer."""
    return {"volume_from_surface": SPLATTING + SPLATTED_PIXEL * camera.height * camera.width}


def direct(scene: Scene, camera: Camera, plan: Any) -> dict[str, float]:
    """By layer, from a plan of `jaxvol.direct`: connections, each with its steps towards the light where there is a grid."""
    pixels = camera.height * camera.width
    gridded = scene.medium is not None and extinction.num_voxels_across(scene.medium) > 0
    steps = STEP * plan.num_light_steps if gridded else 0.0
    # Light of one direction through a box comes from columns that are summed once.
    marched = {"directional": 0.0 if scene.medium is None or segments.is_box(scene.medium) else steps}
    surface, volume = 0.0, 0.0
    for kind, count in lights.num_each(scene).items():
        each = CONNECTION + marched.get(kind, steps)
        surface += count * each * _surface_connections(kind, plan)
        nodes = _volume_connections(kind, plan)
        swept = kind == "environment" and plan.num_sky_directions > 0
        volume += count * nodes * (CONNECTION if swept else each)
    seen = CONNECTION + (STEP * plan.num_cells if gridded else 0.0)  # first hit, transmittance to the eye
    field = 0.0
    if plan.num_sky_directions:
        field = FIELD_STEP * plan.num_sky_directions * float(scene.medium.density.size)
    return {
        "emission": plan.emission * pixels * plan.samples_per_pixel * seen,
        "surface_from_light": plan.surface * pixels * plan.samples_per_pixel * (seen + surface),
        "volume_from_light": plan.volume * (pixels * plan.volume_samples_per_pixel * (seen + volume) + field),
    }


def _surface_connections(kind: str, plan: Any) -> int:
    """At a first hit, towards one light."""
    many = {"area": plan.num_area_samples + plan.num_bsdf_samples}
    many["environment"] = plan.num_environment_samples + plan.num_bsdf_samples
    return many.get(kind, 1)


def _volume_connections(kind: str, plan: Any) -> int:
    """On an eye ray, towards one light."""
    many = {
        "area": plan.num_area_points * plan.num_area_steps,
        "environment": plan.num_environment_steps + plan.num_phase_steps,
    }
    if plan.num_sky_directions:
        many["environment"] = plan.num_field_steps
    return many.get(kind, plan.num_steps)
