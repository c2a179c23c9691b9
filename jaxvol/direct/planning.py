"""What direct light is asked to compute, decided once: layers, sample counts, what is skipped and why."""

from dataclasses import dataclass, field

import numpy as np

from jaxvol import extinction, lights, media, segments
from jaxvol.layers import Claim
from jaxvol.types import Camera, Mesh, Scene

_MOST_STEPS = 256
_THICK_VOXEL = 1.2  # optical thickness beyond which light from the sky changes too fast from voxel to voxel
_BROAD = 0.5  # mean cosine up to which half the directions of the sky do
_PEAKED = 0.8  # mean cosine beyond which a few hundred directions of the sky miss the peak


@dataclass(frozen=True)
class Plan:
    """Static choices of one rendering; hashable."""

    emission: bool  # whether the layer is computed; else it is exactly zero
    surface: bool
    volume: bool
    samples_per_pixel: int  # eye rays for surfaces and emission
    volume_samples_per_pixel: int  # eye rays for the medium
    num_cells: int  # of constant density on an eye ray
    num_steps: int  # nodes on an eye ray for a point, spot or directional light
    num_area_samples: int  # per eye ray at a surface
    num_area_points: int  # per eye ray in the medium, each with
    num_area_steps: int  # nodes
    num_emitter_steps: int  # nodes on an eye ray, each with a direction to one of a few emissive faces
    num_environment_samples: int  # per eye ray at a surface
    num_environment_steps: int  # nodes on an eye ray, each with a direction
    num_bsdf_samples: int  # per eye ray at a surface, for emissive faces and the environment
    num_phase_steps: int  # nodes with a direction from the phase function, for the environment
    num_sky_directions: int  # swept for a field of light from the environment (`sky_field`); 0: every node marches
    num_field_steps: int  # nodes on an eye ray in that field
    num_light_steps: int  # marching steps towards a light, through a grid
    rays_per_chunk: int
    skipped: tuple[str, ...] = field(compare=False)  # what was skipped and why


def claims(scene: Scene) -> tuple[Claim, ...]:
    """The layers emission, surface_from_light and volume_from_light, each complete."""
    return tuple(Claim((name,)) for name in ("emission", "surface_from_light", "volume_from_light"))


def plan(
    scene: Scene,
    camera: Camera | None,
    *,
    samples_per_pixel: int = 16,
    volume_samples_per_pixel: int | None = None,
    num_cells: int | None = None,
    num_steps: int | None = None,
    num_area_samples: int = 8,
    num_area_points: int = 2,
    num_area_steps: int = 4,
    num_emitter_steps: int = 8,
    num_environment_samples: int | None = None,
    num_environment_steps: int | None = None,
    num_bsdf_samples: int | None = None,
    num_phase_steps: int | None = None,
    num_sky_directions: int | None = None,
    num_field_steps: int = 8,
    num_light_steps: int | None = None,
    rays_per_chunk: int = 1 << 15,
    specialize: str = "values",
) -> Plan:
    """Decide what to compute and how finely; None = chosen from the scene.

    specialize: "values" also skips what the scene's numbers make zero (albedo 0, an empty medium, lights without power),
    "structure" only what the scene does not have. Raises ValueError for a refractive index other than 1 and for counts
    out of range.
    """
    if specialize not in ("values", "structure"):
        raise ValueError(f"specialize = {specialize!r} must be 'values' or 'structure'")
    _refuse_refraction(scene)
    counts = {
        "samples_per_pixel": (samples_per_pixel, 1, 4096),
        "volume_samples_per_pixel": (volume_samples_per_pixel, 1, 4096),
        "num_cells": (num_cells, 1, 4096),
        "num_steps": (num_steps, 1, 4096),
        "num_area_samples": (num_area_samples, 1, 4096),
        "num_area_points": (num_area_points, 1, 4096),
        "num_area_steps": (num_area_steps, 1, 4096),
        "num_emitter_steps": (num_emitter_steps, 1, 4096),
        "num_environment_samples": (num_environment_samples, 0, 4096),
        "num_environment_steps": (num_environment_steps, 0, 4096),
        "num_bsdf_samples": (num_bsdf_samples, 0, 4096),
        "num_phase_steps": (num_phase_steps, 0, 4096),
        "num_sky_directions": (num_sky_directions, 0, 65536),
        "num_field_steps": (num_field_steps, 1, 4096),
        "num_light_steps": (num_light_steps, 1, 4096),
        "rays_per_chunk": (rays_per_chunk, 1, 1 << 24),
    }
    for name, (value, low, high) in counts.items():
        if value is not None and not low <= value <= high:
            raise ValueError(f"{name} = {value} must be within [{low}, {high}]")
    by_value = specialize == "values"
    emission, surface, volume, skipped = _layers(scene, by_value)
    across = 0 if scene.medium is None else extinction.num_voxels_across(scene.medium)
    # A map with a sun in it needs more directions than a sky of one radiance; without a grid they cost little.
    is_map = scene.environment is not None and scene.environment.radiance.shape[:2] != (1, 1)
    if num_sky_directions is None:  # 256 at g = .4 are within .02 % of 512, at g = .7 within .15 %
        num_sky_directions = 512 if volume and abs(float(scene.medium.g)) > _BROAD else 256
    if not (volume and _has_field(scene, camera)):
        num_sky_directions = 0
    if num_environment_samples is None:
        num_environment_samples = 40 if is_map else 12
    if num_environment_steps is None:
        cheap = scene.medium is None or (not across and segments.is_box(scene.medium))
        num_environment_steps = 64 if is_map and cheap else 48
    if num_bsdf_samples is None:
        num_bsdf_samples = _default_bsdf_samples(scene)
    if num_phase_steps is None:
        # Thick clouds want directions of the sky, thin ones with a peaked phase function (g = .85) directions of the latter.
        peaked = scene.environment is not None and volume and (not by_value or _sharpest(scene.medium) > 0.6)
        num_phase_steps = 24 if peaked else 0
    if scene.environment is not None and volume and num_environment_steps + num_phase_steps == 0:
        raise ValueError("num_environment_steps and num_phase_steps must not both be 0 in a scene with an environment")
    if scene.environment is not None and surface and num_environment_samples + num_bsdf_samples == 0:
        raise ValueError("num_environment_samples and num_bsdf_samples must not both be 0 in a scene with an environment")
    if volume_samples_per_pixel is None:
        volume_samples_per_pixel = samples_per_pixel
    return Plan(
        emission=emission,
        surface=surface,
        volume=volume,
        samples_per_pixel=samples_per_pixel,
        volume_samples_per_pixel=volume_samples_per_pixel,
        num_cells=num_cells or (min(max(across + across // 2, min(4 * across, 64)), _MOST_STEPS) if across else 16),
        num_steps=num_steps or (16 if across else 8),
        num_area_samples=num_area_samples,
        num_area_points=num_area_points,
        num_area_steps=num_area_steps,
        num_emitter_steps=num_emitter_steps,
        num_environment_samples=num_environment_samples,
        num_environment_steps=num_environment_steps,
        num_bsdf_samples=num_bsdf_samples,
        num_phase_steps=num_phase_steps,
        num_sky_directions=num_sky_directions,
        num_field_steps=num_field_steps,
        # Small grids are marched finely: nothing says that their voxels are thin.
        num_light_steps=num_light_steps or min(max(-(-across // 2), min(4 * across, 48), 1), _MOST_STEPS),
        rays_per_chunk=rays_per_chunk,
        skipped=skipped,
    )


def _refuse_refraction(scene: Scene) -> None:
    if scene.medium is None:
        return
    for name, medium in (
        ("medium", scene.medium),
        *((f"medium.inclusions.{i}", m) for i, m in enumerate(scene.medium.inclusions)),
    ):
        if medium.ior is not None and np.any(np.asarray(medium.ior) != 1.0):
            raise ValueError(f"{name}.refractive_index must be 1 for direct light, whose rays are straight")


def _has_field(scene: Scene, camera: Camera | None) -> bool:
    """Whether light from the environment may be swept: a box with a grid, the eye and all surfaces outside it."""
    if scene.environment is None or camera is None or scene.medium.density is None or not segments.is_box(scene.medium):
        return False
    low, high = np.asarray(scene.medium.bounds, np.float64)
    eye = np.asarray(camera.world_from_camera, np.float64)[:3, 3]
    if np.all((eye >= low) & (eye <= high)):
        return False
    if not _is_smooth(scene.medium):
        return False
    if scene.mesh is None:
        return True
    corners = np.asarray(scene.mesh.vertices, np.float64)[np.asarray(scene.mesh.faces)]
    inside = (corners.max(axis=1) > low) & (corners.min(axis=1) < high)
    return not np.any(np.all(inside, axis=1))


def _is_smooth(medium) -> bool:
    """Whether light from the sky can be interpolated between voxels (optical thickness of nearly all of them below
    about one) and found by a few hundred directions (a phase function that is not too peaked)."""
    density = np.asarray(medium.density)
    voxel = np.ptp(np.asarray(medium.bounds, np.float64), axis=0) / density.shape
    filled = density[density > 0]
    if filled.size == 0:
        return False
    thickness = np.percentile(filled, 99) * float(np.max(np.asarray(media.sigma_t(medium)))) * voxel.max()
    return bool(thickness <= _THICK_VOXEL) and abs(float(medium.g)) <= _PEAKED


def _default_bsdf_samples(scene: Scene) -> int:
    """Wanted for the sky, seen by all of a hemisphere; for emissive faces only where a lobe is narrow."""
    if scene.mesh is None or (scene.area_lights is None and scene.environment is None):
        return 0
    return 4 if scene.environment is not None or scene.mesh.specular is not None else 0


def _sharpest(medium) -> float:
    """The largest mean cosine, in magnitude, of the medium and its inclusions."""
    return max(abs(float(m.g)) for m in (medium, *medium.inclusions))


def _layers(scene: Scene, by_value: bool) -> tuple[bool, bool, bool, tuple[str, ...]]:
    """Which of emission, surface and volume there is to compute, and reasons for what there is not."""
    skipped = []
    has_light = lights.num_lights(scene) > 0
    emission = scene.area_lights is not None or scene.environment is not None
    if not emission:
        skipped.append("emission: no emissive face and no environment, the layer is zero")
    surface, volume = has_light, has_light
    if not has_light:
        skipped.append("surface_from_light, volume_from_light: no light, both layers are zero")
    if scene.mesh is None:
        surface = False
        skipped.append("surface_from_light: no surface, the layer is zero; no rays are cast, nothing is in shadow")
    elif by_value and _is_black(scene.mesh):
        surface = False
        skipped.append("surface_from_light: no surface reflects, the layer is zero")
    if scene.medium is None:
        volume = False
        skipped.append("volume_from_light: no medium, the layer is zero; all transmittances are one")
    elif by_value and not _scatters(scene.medium):
        volume = False
        skipped.append("volume_from_light: the medium does not scatter, the layer is zero")
    elif media.is_homogeneous(scene.medium):
        skipped.append("grid lookups: the medium is homogeneous, optical thickness is in closed form")
    return emission, surface, volume, tuple(skipped)


def _is_black(mesh: Mesh) -> bool:
    specular = 0.0 if mesh.specular is None else float(np.max(np.asarray(mesh.specular), initial=0.0))
    return float(np.max(np.asarray(mesh.albedo), initial=0.0)) == 0.0 and specular == 0.0


def _scatters(medium) -> bool:
    own = float(np.max(np.asarray(medium.sigma_s))) > 0.0
    own = own and (medium.density is None or float(np.max(np.asarray(medium.density))) > 0.0)
    return own or any(_scatters(m) for m in medium.inclusions)
