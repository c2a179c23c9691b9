"""What the method claims of a scene, and what is decided before baking."""

from dataclasses import dataclass
from typing import Literal

import jax.numpy as jnp
import numpy as np

from jaxvol import extinction, lights, media, ray_casting, segments, tables, zonal_lookup
from jaxvol.layers import SURFACE, Claim
from jaxvol.methods.impulse_response import gather, lookup, surface_paths
from jaxvol.types import Camera, Medium, Scene

Scattering = Literal["surface", "attenuated", "single", "multiple"]
_MODES = ("surface", "attenuated", "single", "multiple")


@dataclass(frozen=True)
class Plan:
    """Static decisions of a bake."""

    scattering: str  # what of the medium is baked
    grey: bool
    image: bool
    max_bounces: int
    shares: tuple[float, float, float]  # of cosine rays, probes and area points among next vertices
    probe_sigma: float
    num_steps: int  # of marching a segment
    num_lanes: int
    caster: str
    skipped: tuple[str, ...]


def claims(scene: Scene) -> tuple[Claim, ...]:
    """The four surface layers; partial where paths of their class are known to be missing."""
    missing = []
    if scene.medium is not None and not media.is_empty(scene.medium):
        if scene.mesh is not None and not _flat(scene.mesh):
            missing.append("light that scatters around occluders is dropped")
        if scene.spot_lights is not None:
            missing.append("light scattered out of a spot's cone reaches only receivers inside the cone")
        if scene.medium.inclusions:
            missing.append("inclusions scatter with the outer medium's albedo and phase function")
    glossy = scene.mesh is not None and scene.mesh.specular is not None
    scattered = "; ".join([*missing, *(["Phong lobes are left out"] if glossy else [])]) or None
    plain = "Phong lobes are left out" if glossy else None
    return tuple(
        Claim((name,), plain if name in ("surface_from_light", "surface_from_surface") else scattered) for name in SURFACE
    )


def _flat(mesh) -> bool:
    """Whether all faces lie in one plane: then nothing stands between anything."""
    vertices = np.asarray(mesh.vertices, np.float64)
    normals = np.asarray(ray_casting.face_normals(mesh), np.float64)
    offset = vertices - vertices[0]
    return float(np.abs(offset @ normals[0]).max()) <= 1e-6 * float(np.abs(offset).max())


def plan(
    scene: Scene,
    camera: Camera | None,
    *,
    scattering: Scattering = "multiple",
    image: bool = True,
    back_scattering: bool = True,
    max_bounces: int = 6,
    num_lanes: int = 1 << 14,
    caster: str = "auto",
) -> Plan:
    """Decide what a bake of this scene has to do; eager.

    Args:
        scattering: "surface" ignores the medium, "attenuated" knows its extinction only, "single" and "multiple" add
            light scattered once or however often.
        image: subtract the image source behind receivers (multiple scattering); False is the paper's mode.
        back_scattering: also find patches beside and behind receivers; False follows cosine rays alone.
        max_bounces: surface vertices after the receiver; 0 bakes the emitters' own light.
        num_lanes: paths traced together, at most.

    Raises ValueError for a scene without surfaces or with a bent medium, and for counts out of range.
    """
    if scattering not in _MODES:
        raise ValueError(f"scattering: {scattering!r} is not allowed, must be one of {', '.join(_MODES)}")
    if not 0 <= max_bounces <= 64:
        raise ValueError(f"max_bounces: {max_bounces} is not allowed, must be 0 to 64")
    if num_lanes < 1:
        raise ValueError(f"num_lanes: {num_lanes} is not allowed, must be >= 1")
    if scene.mesh is None or scene.mesh.faces.shape[0] == 0:
        raise ValueError("mesh is missing: impulse_response bakes light onto surfaces")
    medium = scene.medium
    if medium is not None:
        _refuse_refraction(medium)
    skipped = []
    if medium is None or media.is_empty(medium):
        scattering = "surface"
        skipped.append("no medium that scatters or absorbs: a surface-only bake")
    if scattering == "surface":
        medium = None
    scatters = scattering in ("single", "multiple") and float(np.max(np.asarray(medium.sigma_s))) > 0
    if not scatters and scattering in ("single", "multiple"):
        skipped.append("the medium only absorbs: no tables are read")
        scattering = "attenuated"
    if lights.num_lights(scene) == 0:
        skipped.append("no light: every layer is zero")
    grey = medium is None or media.is_grey(medium)
    if scatters and grey:
        skipped.append("grey medium: one channel of tables serves all three")
    if scatters and scattering == "single":
        skipped.append("light scattered twice or more (scattering = 'single')")
    if not (scatters and back_scattering):
        skipped.append("no probes for back-scattering: next vertices by cosine-distributed rays alone")
    if medium is not None and medium.density is None and segments.is_box(medium):
        skipped.append("homogeneous medium in its box: optical thickness in closed form")
    return Plan(
        scattering=scattering,
        grey=grey,
        image=image and scattering == "multiple",
        max_bounces=max_bounces,
        shares=(0.6, 0.25, 0.15) if scatters and back_scattering else (1.0, 0.0, 0.0),
        probe_sigma=_probe_sigma(medium),
        num_steps=1 if medium is None else max(1, extinction.num_voxels_across(medium)),
        num_lanes=num_lanes,
        caster=caster,
        skipped=tuple(skipped),
    )


def _refuse_refraction(medium: Medium) -> None:
    for one in (medium, *medium.inclusions):
        if one.ior is not None and float(np.max(np.abs(np.asarray(one.ior) - 1.0))) > 1e-6:
            raise ValueError(
                f"medium.refractive_index: {float(np.max(np.asarray(one.ior))):g} is not allowed here, impulse_response "
                "keeps rays straight and takes 1 only; lattice_boltzmann bends them"
            )


def _probe_sigma(medium: Medium | None) -> float:
    """Mean extinction of the thinnest channel that is not empty: how far scattered light travels along a surface."""
    if medium is None:
        return 1.0
    sigma = np.asarray(media.sigma_t(medium), np.float64)
    density = 1.0 if medium.density is None else float(np.mean(np.asarray(medium.density)))
    return float(np.float32(max(density * sigma[sigma > 0].min(), 1e-6)))


def prepare(scene: Scene, plan: Plan, *, responses_from: zonal_lookup.ZonalTables | None = None) -> gather.Kit:
    """Everything that baking needs, once per scene: resampled tables, ray casters, marching tables; eager.

    `responses_from` are the tables, the package's default set where None. Raises ValueError where no face has an area.
    """
    medium = None if plan.scattering == "surface" else scene.medium
    responses = None
    if plan.scattering in ("single", "multiple"):
        found = tables.default_file().lookups() if responses_from is None else responses_from
        responses = lookup.prepare(found, medium, grey=plan.grey, multiple=plan.scattering == "multiple")
    bare = Scene(**{**{name: getattr(scene, name) for name in Scene.__dataclass_fields__}, "medium": medium})
    return gather.Kit(
        scene=bare,
        responses=responses,
        faces=surface_paths.sampled_faces(scene.mesh),
        probe_sigma=jnp.float32(plan.probe_sigma),
        caster=ray_casting.caster_for(scene.mesh, kind=plan.caster),
        marching=None if medium is None else extinction.marching_medium(medium),
        medium_casters=() if medium is None else segments.medium_casters(medium),
        image=plan.image,
        num_steps=plan.num_steps,
        max_bounces=plan.max_bounces,
        shares=plan.shares,
    )
