"""What the lattice is asked to compute, decided once from the scene's values: grid, lattice, channels, what is skipped."""

import math
from dataclasses import dataclass, field

import numpy as np

from jaxvol import lights, media
from jaxvol.layers import Claim
from jaxvol.methods.lattice_boltzmann import fresnel
from jaxvol.methods.lattice_boltzmann.lattice import LATTICES
from jaxvol.methods.lattice_boltzmann.marching import STEPS
from jaxvol.methods.lattice_boltzmann.materials import body_bounds, reduced_sigma, regions
from jaxvol.types import Camera, Scene

_SUM = ("volume_from_light", "volume_from_volume", "volume_from_multiple")
_THICK = 1.0  # sigma_t' h above which the lattice is coarse
_SKY = "surfaces are lit and seen as if the medium let all light pass: its shadows and caustics on them are missed"


@dataclass(frozen=True)
class Plan:
    """Static choices of one rendering; hashable."""

    lattice: str  # "26", "18" or "paper"
    probability_map: str  # "pade" or "exp"
    resolution: int  # voxels along the longest side of the body
    margin: int  # voxels around the body, for the smoothed index
    num_channels: int  # 1 when medium and lights are of one spectrum
    refract: bool
    filter_width: float  # voxels, of the Gaussian over the index
    integrator: str  # "leapfrog", "smooth" or "euler"
    march_step: float  # voxels, along bent rays
    view_step: float  # voxels
    rays_per_voxel: float  # light rays per voxel face across a beam
    num_surface_rays: int  # of the second source, light from lit surfaces; 0 without surfaces
    samples_per_pixel: int
    tolerance: float  # relative residual of the lattice
    max_applications: int
    corrections: int  # of the lattice's angular error by sweeps along 72 directions
    solve: bool  # False: nothing scatters, the lattice stays dark
    preconditioned: bool
    homogeneous: bool  # one sigma in every voxel: the lattice's coefficients are numbers
    internal_reflectance: float  # of the body's surface, for the lattice; 0 = open faces
    split_orders: bool  # the first orders as layers of their own
    degree: int  # of the scattering between links: 0 isotropic or by similarity, else moments up to it (anisotropy.py)
    first_order: bool  # anisotropic scattering: the exact first order put back
    walls: bool  # opaque meshes inside the medium as diffuse walls of the lattice
    skipped: tuple[str, ...] = field(compare=False)  # what was skipped and why; warnings begin with "warning:"


def claims(scene: Scene) -> tuple[Claim, ...]:
    """The volume layers, split where scattering is isotropic; with refraction also what is seen through the medium."""
    if scene.medium is None:
        return ()
    refract = _refracts(scene)
    surfaces = scene.mesh is not None
    bent = "reflection at the far side is diffuse and opaque surfaces inside the medium are voxels"
    missed = "light reflected by surfaces more than once is missed"
    through = "V S V E, light scattered back by surfaces into the medium, is missed, and diffuse light passes through them"
    partial = (missed if refract else through) if surfaces else None
    if refract:
        partial = bent if partial is None else f"{partial}; {bent}"
    one = bent if refract else None
    if media.is_isotropic(scene.medium):
        found = [
            Claim(("volume_from_light",), one),
            Claim(("volume_from_volume",), one),
            Claim(("volume_from_multiple",), partial),
        ]
    else:
        similar = "light scattered more than once: anisotropy by its first moment, with refraction by similarity"
        found = [Claim(_SUM, similar if partial is None else f"{partial}; {similar}")]
    if not surfaces:
        found.append(Claim(("volume_from_surface",)))  # exactly zero
    else:
        found.append(
            Claim(
                ("volume_from_surface",), "Lambertian part of the reflection only" if scene.mesh.specular is not None else one
            )
        )
    if refract:
        found.append(Claim(("emission",), "reflection inside the medium is missed"))
        found.append(Claim(("surface_from_light",), _SKY))
    return tuple(found)


def surfaces_are_lit(scene: Scene) -> bool:
    """Whether there are lights, and surfaces that reflect any of their light."""
    reflects = scene.mesh is not None and float(np.max(np.asarray(scene.mesh.albedo))) > 0
    return reflects and lights.num_lights(scene) > 0


def _refracts(scene):
    return any(
        part.ior is not None and float(np.max(np.abs(np.asarray(part.ior) - 1.0))) > 1e-4 for part in regions(scene.medium)
    )


def plan(
    scene: Scene,
    camera: Camera | None,
    *,
    lattice: str = "26",
    probability_map: str = "auto",
    resolution: int = 64,
    filter_width: float = 1.0,
    integrator: str = "auto",
    march_step: float = 0.5,
    view_step: float = 1.0,
    rays_per_voxel: float = 4.0,
    surface_rays: int = 1 << 17,
    samples_per_pixel: int = 4,
    tolerance: float = 1e-4,
    max_applications: int = 200,
    corrections: int | None = None,
    preconditioned: bool = True,
    boundary_reflectance: float | None = None,
    anisotropy: str = "auto",
    degree: int = 1,
    walls: bool | None = None,
    specialize: str = "values",
) -> Plan:
    """Decide how to render; None and "auto" = chosen from the scene.

    `anisotropy`: "similarity", "first_order" (similarity with the exact first order put back, after Nakajima and Tanaka
    1988) or "directional" (a Theta of moments up to `degree` as well: 26 directions, open faces, no walls); "auto" is the
    last where it can be; a slab of thickness 2 and g = 0.75 reflects 8.3 % too much with degree 1, .03 % too little with
    2 (similarity 25 %). `walls`: opaque meshes as diffuse walls of the lattice; None = with refraction, where light rays
    end at them too. `boundary_reflectance` is how much diffuse light the body's surface throws back inside: None = by its
    index (0 at 1).
    Raises ValueError for values out of range and for a closed white box without absorption, which has no steady state.
    """
    _check(scene, lattice, probability_map, integrator, specialize, boundary_reflectance, anisotropy)
    ranges = {
        "resolution": (resolution, 2, 1024),
        "filter_width": (filter_width, 0.75, 8.0),
        "march_step": (march_step, 0.01, 1.0),
        "view_step": (view_step, 0.05, 4.0),
        "rays_per_voxel": (rays_per_voxel, 0.01, 1024.0),
        "surface_rays": (surface_rays, 0, 1 << 26),
        "samples_per_pixel": (samples_per_pixel, 1, 4096),
        "tolerance": (tolerance, 1e-7, 0.1),
        "max_applications": (max_applications, 1, 100_000),
        "corrections": (corrections or 0, 0, 10),
        "degree": (degree, 1, 3),
    }
    for name, (value, low, high) in ranges.items():
        if not low <= value <= high:
            raise ValueError(f"{name} = {value} must be within [{low}, {high}]")
    skipped: list[str] = []
    by_value = specialize == "values"
    refract = _refracts(scene) if by_value else any(part.ior is not None for part in regions(scene.medium))
    if not refract:
        skipped.append("index 1: straight rays from voxel to voxel, no gradients")
    internal, walls = _closed(scene, refract, boundary_reflectance, walls)
    closed = internal > 0 or walls
    isotropic = media.is_isotropic(scene.medium)
    first_order = not isotropic and anisotropy != "similarity"
    if anisotropy == "auto":
        anisotropy = "directional" if lattice == "26" and not closed else "first_order"
    if isotropic or anisotropy != "directional":
        degree = 0
    if degree and (closed or lattice != "26"):
        raise ValueError(
            f"anisotropy = 'directional' needs lattice = '26', open faces and no walls, but lattice is {lattice!r}, "
            f"boundary_reflectance {internal:.3g}, walls {walls}"
        )
    scattering, absorption = (np.asarray(x) for x in reduced_sigma(scene.medium, degree=degree))
    grey = by_value and media.is_grey(scene.medium) and _one_spectrum(scene)
    if grey:
        skipped.append("one spectrum: one channel is marched and solved")
    low, high = body_bounds(scene.medium)
    voxel = float(np.max(high - low)) / resolution
    thickest = _thickest(scene, scattering + absorption) * voxel
    if thickest > _THICK:
        enough = math.ceil(resolution * thickest / _THICK)
        skipped.append(
            f"warning: sigma_t' h = {thickest:.2g} is coarse for the lattice; resolution = {enough} brings it to {_THICK:g}"
        )
    if probability_map == "auto":
        probability_map = "exp" if thickest > _THICK else "pade"
    if integrator == "auto":
        # an index given on a grid, without a boundary, varies smoothly; steps at surfaces want the projection
        smooth = all(p.ior is None or np.ndim(p.ior) == 3 for p in regions(scene.medium)) and scene.medium.boundary is None
        integrator = "smooth" if refract and smooth else "leapfrog"
    solve = not (by_value and float(scattering.max()) == 0.0)
    if not solve:
        skipped.append("nothing scatters: no lattice")
    if corrections is None:
        corrections = 2 if lattice == "26" and not closed else 0
    if corrections and closed:
        raise ValueError(
            f"corrections = {corrections} need open faces, but boundary_reflectance is {internal:.3g} and walls {walls}; use 0"
        )
    if not isotropic:
        skipped.append("anisotropic scattering: orders of scattering are not split")
    homogeneous = by_value and not closed and not degree and _fills_voxels(scene.medium, low, high, voxel)
    if homogeneous:
        skipped.append("homogeneous box: one set of coefficients for all voxels")
    return Plan(
        lattice=lattice,
        probability_map=probability_map,
        resolution=resolution,
        margin=math.ceil(3 * filter_width) + 1 if refract else (1 if internal > 0 else 0),
        num_channels=1 if grey else 3,
        refract=refract,
        filter_width=filter_width,
        integrator=integrator,
        march_step=march_step,
        view_step=view_step,
        rays_per_voxel=rays_per_voxel,
        num_surface_rays=surface_rays if surfaces_are_lit(scene) else 0,
        samples_per_pixel=samples_per_pixel,
        tolerance=tolerance,
        max_applications=max_applications,
        corrections=corrections,
        solve=solve,
        preconditioned=preconditioned,
        homogeneous=homogeneous,
        internal_reflectance=internal,
        split_orders=isotropic,
        degree=degree,
        first_order=first_order,
        walls=walls,
        skipped=tuple(skipped),
    )


def _closed(scene, refract, boundary_reflectance, walls):
    """(reflectance of the body's surface from inside, whether opaque meshes are walls)."""
    internal = boundary_reflectance
    if internal is None:
        bends = refract and scene.medium.ior is not None
        internal = fresnel.diffuse_internal(float(np.max(np.asarray(scene.medium.ior)))) if bends else 0.0
    return float(internal), (refract if walls is None else walls) and scene.mesh is not None


def _check(scene, lattice, probability_map, integrator, specialize, boundary_reflectance, anisotropy):
    allowed = {
        "lattice": (lattice, tuple(LATTICES)),
        "probability_map": (probability_map, ("auto", "pade", "exp")),
        "integrator": (integrator, ("auto", *STEPS)),
        "specialize": (specialize, ("values", "structure")),
        "anisotropy": (anisotropy, ("auto", "similarity", "first_order", "directional")),
    }
    for name, (value, choices) in allowed.items():
        if value not in choices:
            raise ValueError(f"{name} = {value!r} must be one of {', '.join(choices)}")
    if scene.medium is None:
        raise ValueError("medium is missing: the lattice lights a participating medium")
    if boundary_reflectance is None:
        return
    if not 0.0 <= boundary_reflectance <= 1.0:
        raise ValueError(f"boundary_reflectance = {boundary_reflectance} must be within [0, 1]")
    if boundary_reflectance == 1.0 and float(np.max(np.asarray(reduced_sigma(scene.medium)[1]))) == 0.0:
        raise ValueError(
            "boundary_reflectance = 1 with absorption 0 has no steady state: light neither leaves nor is absorbed; "
            "allowed: below 1, or some absorption"
        )


def _fills_voxels(medium, low, high, voxel):
    """Whether all voxels of the grid hold the same: a box of whole voxels with nothing in it."""
    counts = (high - low) / voxel
    whole = np.allclose(counts, np.round(counts), atol=1e-4)
    return bool(medium.density is None and medium.boundary is None and not medium.inclusions and whole)


def _thickest(scene, extinction):
    """Largest reduced extinction anywhere, per unit length."""
    peaks = [1.0 if p.density is None else float(np.max(np.asarray(p.density))) for p in regions(scene.medium)]
    return float(np.max(extinction * np.array(peaks)[:, None]))


def _one_spectrum(scene) -> bool:
    """Whether all lights that can reach the medium have the same colour and surfaces do not change it."""
    colours = []
    for kind, name in (("point_lights", "intensity"), ("spot_lights", "intensity"), ("directional_lights", "irradiance")):
        if getattr(scene, kind) is not None:
            colours.append(np.asarray(getattr(getattr(scene, kind), name)))
    if scene.environment is not None:
        colours.append(np.asarray(scene.environment.radiance).reshape(-1, 3))
    if scene.mesh is not None:
        if scene.mesh.emission is not None:
            colours.append(np.asarray(scene.mesh.emission))
        if float(np.max(np.ptp(np.asarray(scene.mesh.albedo), axis=1))) > 0:
            return False
    if not colours:
        return True
    colours = np.concatenate(colours).astype(np.float64)
    total = colours.sum(0)
    size = colours.sum(1, keepdims=True)
    return bool(np.all(np.abs(colours - size * total / max(total.sum(), 1e-300)) <= 1e-5 * max(float(size.max()), 1e-300)))
