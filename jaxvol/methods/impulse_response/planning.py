"""What the method claims of a scene, and what is decided before baking."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Literal

import jax.numpy as jnp
import numpy as np

from jaxvol import extinction, lights, media, ray_casting, segments, tables, zonal_lookup
from jaxvol.layers import SURFACE, Claim
from jaxvol.methods.impulse_response import lookup, surface_paths
from jaxvol.methods.impulse_response.kit import Kit
from jaxvol.types import Camera, Medium, Mesh, Scene

Scattering = Literal["surface", "attenuated", "single", "multiple"]
Occlusion = Literal["march", "drop"]
_MODES = ("surface", "attenuated", "single", "multiple")
CONTRAST = 0.5  # of density along a segment, above which it is marched
BOUNDED = 7.0  # mean free paths across the medium, below which its bounds count everywhere
_MOST_LEGS = (8, 16)  # of marched segments in a bounded medium, constant or varying, before the tables take over


@dataclass(frozen=True)
class Plan:
    """Static decisions of a bake."""

    scattering: str  # what of the medium is baked
    grey: bool
    image: bool
    march_occluded: bool  # segments that an occluder cuts are integrated, not dropped
    contrast: float | None  # of density, above which a segment is integrated; None = never
    march_all: bool  # the medium ends within few mean free paths: all segments are integrated
    legs: int  # scatter points of a marched segment before the tables take over
    similarity: bool
    g_range: float | None
    harmonics: bool  # incident SH beside irradiance
    open: bool  # nothing occludes anything
    max_bounces: int
    cached: bool  # paths end at their first vertex, whose light is cached
    shares: tuple[float, float, float]  # of cosine rays, probes and area points among next vertices
    epsilon: float | None  # height over receivers of the rays of the paper's back-scattering
    probe_sigma: float
    num_steps: int  # of marching a segment
    num_lanes: int
    caster: str
    skipped: tuple[str, ...] = field(compare=False)


def claims(scene: Scene) -> tuple[Claim, ...]:
    """The four surface layers; partial where paths of their class are known to be missing."""
    once, more = [], []  # missing from light scattered once, and from light scattered more often
    medium = scene.medium
    if medium is not None and not media.is_empty(medium):
        if scene.mesh is not None and not _flat(scene.mesh):
            if segments.is_box(medium):
                more.append("light scattered more than once around occluders has its last leg alone traced")
            else:
                once.append("light that scatters around occluders is dropped")
        if scene.spot_lights is not None:
            once.append("light scattered out of a spot's cone reaches only receivers inside the cone")
        if medium.inclusions:
            once.append("inclusions scatter with the outer medium's albedo and phase function")
    glossy = scene.mesh is not None and scene.mesh.specular is not None
    lobes = ["Phong lobes count as Lambertian after the first surface"] if glossy else []
    partial = {"surface_from_light": [], "surface_from_surface": lobes, "surface_from_volume": once}
    return tuple(Claim((name,), "; ".join(partial.get(name, [*once, *more, *lobes])) or None) for name in SURFACE)


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
    back_scattering: bool | Literal["epsilon"] = True,
    epsilon: float = 0.125,
    occlusion: Occlusion = "march",
    contrast: float | None = CONTRAST,
    bounded: float | None = BOUNDED,
    legs: int | None = None,
    similarity: bool = False,
    g_range: float | None = None,
    harmonics: bool = False,
    max_bounces: int = 6,
    cached: bool = True,
    num_lanes: int = 1 << 14,
    caster: str = "auto",
) -> Plan:
    """Decide what a bake of this scene has to do; eager.

    Args:
        scattering: "surface" ignores the medium, "attenuated" knows its extinction only, "single" and "multiple" add
            light scattered once or however often.
        image: subtract the image source behind receivers (multiple scattering); False is the paper's mode.
        back_scattering: also find patches beside and behind receivers; False follows cosine rays alone; "epsilon" is the
            paper's trick (`surface_paths`), for segments that are looked up only.
        epsilon: how far that trick lifts receivers, in the scene's units as in the paper, > 0.
        occlusion: "march" integrates the light that scatters around an occluder between a receiver and an emitter, last
            leg by last leg; "drop" is the paper's rule, and its share is reported.
        contrast: of density about a receiver's segment, (max - min) / max, above which it is integrated with marched sigma;
            None = never, the paper's mode.
        bounded: mean free paths across the thinnest side of a medium's box, below which all segments of receivers are
            integrated inside its bounds, since the tables know an infinite medium only; None = never, the paper's mode.
        legs: scatter points of a marched segment before the tables bring the rest, 1 to 64; None = in a bounded medium twice
            the mean free paths across it, 2 to 8, where density varies by its densest place, 2 to 16; else 1. More follow light
            around occluders and along bounds further, at the price of noise.
        similarity: the paper's map of light scattered twice or more to an isotropic medium.
        g_range: the paper's interpolation of single scattering between tables at -g_range, 0, g_range; None = moments.
        harmonics: also bake SH of incident radiance.
        max_bounces: surface vertices after the receiver; 0 bakes the emitters' own light.
        cached: bakes of many paths know the irradiance of further vertices from a cache (`radiosity`); False walks on.
        num_lanes: paths traced together, at most.

    Raises ValueError for a scene without surfaces or with a bent medium, and for counts out of range.
    """
    if scattering not in _MODES:
        raise ValueError(f"scattering: {scattering!r} is not allowed, must be one of {', '.join(_MODES)}")
    if not 0 <= max_bounces <= 64:
        raise ValueError(f"max_bounces: {max_bounces} is not allowed, must be 0 to 64")
    if occlusion not in ("march", "drop"):
        raise ValueError(f"occlusion: {occlusion!r} is not allowed, must be march or drop")
    if back_scattering not in (True, False, "epsilon"):
        raise ValueError(f"back_scattering: {back_scattering!r} is not allowed, must be True, False or 'epsilon'")
    if not 0 < epsilon < np.inf:
        raise ValueError(f"epsilon: {epsilon} is not allowed, must be > 0")
    if contrast is not None and not 0 <= contrast <= 1:
        raise ValueError(f"contrast: {contrast} is not allowed, must be 0 to 1")
    if bounded is not None and not bounded >= 0:
        raise ValueError(f"bounded: {bounded} is not allowed, must be >= 0")
    if legs is not None and not 1 <= legs <= 64:
        raise ValueError(f"legs: {legs} is not allowed, must be 1 to 64")
    if g_range is not None and not 0 < g_range < 1:
        raise ValueError(f"g_range: {g_range} is not allowed, must lie in (0, 1)")
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
    if g_range is not None and medium is not None and medium.phase is not None:
        raise ValueError("g_range: interpolates in g, and this medium has a phase table")
    bare = _flat(scene.mesh)
    heterogeneous = scatters and medium.density is not None
    if scatters and bare:
        skipped.append("all faces lie in one plane: no occluders are looked for")
    if heterogeneous and not segments.is_box(medium):
        skipped.append("contrast is not measured in media with boundaries or inclusions: their mean serves")
        heterogeneous = False
    across = _mean_free_paths(medium) if scatters and segments.is_box(medium) else np.inf
    march_all = bounded is not None and across < bounded
    if march_all:
        heterogeneous = False
        most = _MOST_LEGS[medium.density is not None]
        legs = legs or int(np.clip(2 * np.ceil(_mean_free_paths(medium, np.max)), 2, most))
        skipped.append(f"no tables for the receivers' own segments: the medium is {across:.2g} mean free paths thick")
    elif scatters and not heterogeneous:
        skipped.append("no density varies along segments: none is marched for its contrast")
    march_occluded = scatters and occlusion == "march" and not bare and segments.is_box(medium)
    lift = epsilon if scatters and back_scattering == "epsilon" else None
    if lift is not None and (march_occluded or march_all or (heterogeneous and contrast is not None)):
        raise ValueError(
            "back_scattering: 'epsilon' belongs to segments that are looked up: it needs occlusion = 'drop', contrast = None "
            "and bounded = None here"
        )
    if not (scatters and back_scattering):
        skipped.append("no probes for back-scattering: next vertices by cosine-distributed rays alone")
    if medium is not None and medium.density is None and segments.is_box(medium):
        skipped.append("homogeneous medium in its box: optical thickness in closed form")
    return Plan(
        scattering=scattering,
        grey=grey,
        image=image and scattering == "multiple",
        march_occluded=march_occluded,
        contrast=contrast if heterogeneous else None,
        march_all=march_all,
        legs=legs or 1,
        similarity=similarity,
        g_range=g_range,
        harmonics=harmonics,
        open=bare,
        max_bounces=max_bounces,
        cached=cached,
        shares=(0.6, 0.25, 0.15) if scatters and back_scattering is True else (1.0, 0.0, 0.0),
        epsilon=lift,
        probe_sigma=_probe_sigma(scene.mesh, medium),
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


def _mean_free_paths(medium: Medium, of: Callable[[np.ndarray], float] = np.mean) -> float:
    """Across the thinnest side of the medium's box, for its mean density (or what `of` takes) and the mean of its channels."""
    density = 1.0 if medium.density is None else float(of(np.asarray(medium.density)))
    side = float(np.diff(np.asarray(medium.bounds, np.float64), axis=0).min())
    return float(np.mean(np.asarray(media.sigma_t(medium), np.float64))) * density * side


def _probe_sigma(mesh: Mesh, medium: Medium | None) -> float:
    """Mean extinction of the thinnest channel that is not empty: how far scattered light travels along a surface.

    At least one over the surfaces' extent: probes beyond it find nothing.
    """
    if medium is None:
        return 1.0
    extent = float(np.ptp(np.asarray(mesh.vertices, np.float64), axis=0).max())
    sigma = np.asarray(media.sigma_t(medium), np.float64)
    density = 1.0 if medium.density is None else float(np.mean(np.asarray(medium.density)))
    return float(np.float32(max(density * sigma[sigma > 0].min(), 1 / extent if extent > 0 else 1.0)))


def prepare(scene: Scene, plan: Plan, *, responses_from: zonal_lookup.ZonalTables | None = None) -> Kit:
    """Everything that baking needs, once per scene: resampled tables, ray casters, marching tables; eager.

    `responses_from` are the tables, the package's default set where None. Raises ValueError where no face has an area.
    """
    medium = None if plan.scattering == "surface" else scene.medium
    responses = None
    if plan.scattering in ("single", "multiple"):
        found = tables.default_file().lookups() if responses_from is None else responses_from
        responses = lookup.prepare(
            found,
            medium,
            grey=plan.grey,
            multiple=plan.scattering == "multiple",
            similarity=plan.similarity,
            g_range=plan.g_range,
        )
    bare = Scene(**{**{name: getattr(scene, name) for name in Scene.__dataclass_fields__}, "medium": medium})
    return Kit(
        scene=bare,
        responses=responses,
        faces=surface_paths.sampled_faces(scene.mesh, epsilon=plan.epsilon),
        probe_sigma=jnp.float32(plan.probe_sigma),
        caster=ray_casting.caster_for(scene.mesh, kind=plan.caster),
        marching=None if medium is None else extinction.marching_medium(medium),
        medium_casters=() if medium is None else segments.medium_casters(medium),
        image=plan.image,
        num_steps=plan.num_steps,
        max_bounces=plan.max_bounces,
        shares=plan.shares,
        march_occluded=plan.march_occluded,
        contrast=plan.contrast,
        march_all=plan.march_all,
        legs=plan.legs,
        multiple=plan.scattering == "multiple",
        open=plan.open,
    )
