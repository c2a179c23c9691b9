"""What the method claims of a scene and what it decides before it runs."""

from dataclasses import dataclass, field

import numpy as np

from jaxvol import lights as primary
from jaxvol import media
from jaxvol.layers import Claim
from jaxvol.types import Camera, Scene

_CLAIMED = tuple(f"{last}_from_{before}" for last in ("surface", "volume") for before in ("surface", "volume", "multiple"))
_MAP_BYTES = 300e6
_LEFT = 0.004  # of the energy, beyond the last compensation step
_MOST_LEVELS = 3
_PICKS_A_MARCH_IS_WORTH = 20  # lights a group: marching and casting cost about ten kernel evaluations


@dataclass(frozen=True)
class Plan:
    """Static decisions; every field but `skipped` is an argument of `plan` or follows from the scene."""

    num_paths: int
    max_lights: int | None  # kept of those of all paths; None = all
    num_sets: int
    max_depth: int
    lights: str
    mean_free_paths: float | None  # clamp distance times extinction; None = unclamped
    most_clamp: float  # upper limit of the clamp distance over the longest side of the scene
    num_levels: int
    num_chains: int
    num_direct: int
    light_stride: int
    end: str
    distance: str
    transmittance: str
    visibility: str
    shadows: str
    columns: str
    map_size: int
    map_steps: int
    direct_at_vertex: bool
    sampling: str
    num_evaluations: int
    group_size: int
    eye_steps: int
    pair_steps: int
    mip_block: int
    upsample: int
    refine_below: float
    tile: int
    jitter: bool
    edge_rays: int  # eye rays of a pixel that an edge crosses; 1 without surfaces
    caster: str
    grey: bool
    isotropic: bool
    costly: bool  # a pair needs marching or a shadow ray: estimate all lights, evaluate picked ones
    volume: bool  # eye rays collect light in the medium
    surface: bool  # surfaces reflect light to the eye
    skipped: tuple[str, ...] = field(compare=False)  # words with numbers in them: no reason to compile anew


CHOICES = {
    "lights": ("points", "rays"),
    "end": ("clamped", "unclamped", "reduced"),
    "distance": ("weight", "exponential"),
    "transmittance": ("true", "local", "detected"),
    "visibility": ("rays", "maps", "none"),
    "shadows": ("rays", "maps"),
    "columns": ("auto", "march", "mip", "maps"),
    "sampling": ("equiangular", "stratified"),
    "specialize": ("values", "structure"),
}


def claims(scene: Scene) -> tuple[Claim, ...]:
    """The six layers of light that scattered or reflected at least twice, each complete; none where ior bends rays.

    Classes that the scene cannot contain are claimed as exact zeros.
    """
    medium = scene.medium
    if medium is not None and (medium.boundary is not None or medium.inclusions or medium.ior is not None):
        return ()
    return tuple(Claim((name,)) for name in _CLAIMED)


def plan(
    scene: Scene,
    camera: Camera,
    *,
    num_paths: int = 4096,
    max_lights: int | None = 1024,
    num_sets: int = 1,
    max_depth: int = 256,
    lights: str = "points",
    mean_free_paths: float | None = 0.35,
    num_levels: int | None = None,
    num_chains: int = 2,
    num_direct: int = 4,
    light_stride: int = 8,
    end: str = "clamped",
    distance: str = "weight",
    transmittance: str = "true",
    visibility: str = "rays",
    shadows: str = "rays",
    columns: str = "auto",
    map_size: int = 32,
    map_steps: int = 16,
    direct_at_vertex: bool = True,
    sampling: str = "equiangular",
    num_evaluations: int = 1,
    group_size: int = _PICKS_A_MARCH_IS_WORTH,
    eye_steps: int | None = None,
    pair_steps: int | None = None,
    mip_block: int = 4,
    upsample: int = 1,
    refine_below: float = 0.25,
    tile: int = 8192,
    jitter: bool = True,
    edge_rays: int = 4,
    caster: str = "auto",
    specialize: str = "values",
) -> Plan:
    """Decide how to render a scene; eager.

    num_paths: light paths of a set; max_lights: about so many of their lights are gathered, those that the picture sees most
    (unbiased; thousands of paths cost little, thousands of lights do not; None: all); num_sets: independent sets that are
    averaged (two or more give a variance).
    lights: virtual "points", or "rays": whole flights, neither clamped nor compensated (homogeneous, no surfaces).
    mean_free_paths: clamp distance d = mean_free_paths / local sigma_t, at most a tenth of the scene (None: unclamped).
    num_levels: compensation steps; 0 = clamped only (biased); None: as many as leave less than 0.4 % of the energy to what
    happens beyond the last step, at most three. num_chains: chains of new vertices per receiver that gather from virtual
    lights; num_direct: chains that only see the primary lights, which are cheap.
    light_stride: new vertices gather from one of `light_stride` lights, another share each time.
    end: what happens beyond the last step: "clamped" (loses about (0.7 albedo mean_free_paths)^(num_levels + 1) of the
    energy), "unclamped" (unbiased, infinite variance), "reduced" (bound times 16).
    distance: "weight" or the paper's "exponential"; transmittance to new vertices: "true", "local" (biased), or
    "detected": local where the gradient of sigma_t is small. visibility of new vertices: "rays", "maps" (the depth map of
    the nearest light with a least-depth test; approximate), or "none" (biased near surfaces).
    shadows: of lights, by "rays" or by "maps" of map_size^2 texels each (approximate). columns: density towards lights by
    "march"ing, through a "mip" of half the resolution, by "maps" with map_steps steps; "auto" takes what costs least.
    direct_at_vertex: False leaves out the primary lights there, as the paper's text does (biased).
    sampling: "equiangular", or "stratified" with num_evaluations points per light (the paper).
    group_size: where pairs are costly, one light of so many is marched to and tested for occlusion.
    upsample: evaluate at 1/upsample^2 of the pixels and reconstruct (biased where it interpolates); pixels whose
    neighbours weigh less than refine_below are evaluated too.
    jitter: eye rays at random places of their pixels. edge_rays: as many of them where the pixel shows more than one surface
    (with jitter, without upsampling).
    specialize: "structure" looks at no values (for gradients).
    Raises ValueError for a medium with a boundary, inclusions or a refractive index, and for values out of range.
    """
    _check_medium(scene)
    given = {
        "lights": lights,
        "end": end,
        "distance": distance,
        "transmittance": transmittance,
        "visibility": visibility,
        "shadows": shadows,
        "columns": columns,
        "sampling": sampling,
        "specialize": specialize,
    }
    for key, value in given.items():
        if value not in CHOICES[key]:
            raise ValueError(f"{key}: {value!r} is not allowed, must be one of {', '.join(CHOICES[key])}")
    least = {"num_paths": 1, "num_sets": 1, "max_depth": 1, "num_levels": 0, "num_chains": 1, "num_direct": 1}
    least.update(map_size=4, map_steps=1, num_evaluations=1, group_size=1, mip_block=1, upsample=1, tile=64, edge_rays=1)
    for key, low in least.items():
        if locals()[key] is not None and locals()[key] < low:
            raise ValueError(f"{key}: {locals()[key]} is not allowed, must be >= {low}")
    if max_lights is not None and max_lights < 64:
        raise ValueError(f"max_lights: {max_lights} is not allowed, must be >= 64 (or none for all)")
    if light_stride not in (1, 2, 4, 8, 16):
        raise ValueError(f"light_stride: {light_stride} is not allowed, must be 1, 2, 4, 8 or 16")
    if mean_free_paths is not None and not mean_free_paths > 0:
        raise ValueError(f"mean_free_paths: {mean_free_paths} is not allowed, must be > 0 (or none for no clamping)")
    medium = scene.medium
    values = specialize == "values"
    lit = primary.num_lights(scene) > 0
    scatters = medium is not None and not (values and _is_dark(medium))
    reflects = scene.mesh is not None and not (values and _is_black(scene.mesh))
    tracked = medium is not None and medium.density is not None
    if lights == "rays" and (tracked or scene.mesh is not None):
        raise ValueError("lights: 'rays' is not allowed here, it needs a homogeneous medium and no surfaces")
    if num_levels is None:
        num_levels = _levels(scene, mean_free_paths) if values and scatters and scene.mesh is None else _MOST_LEVELS
    return Plan(
        num_paths=num_paths,
        max_lights=max_lights if lights == "points" else None,
        num_sets=num_sets,
        max_depth=max_depth,
        lights=lights,
        mean_free_paths=mean_free_paths,
        most_clamp=0.1 if tracked or scene.mesh is not None else 1.0,
        num_levels=num_levels if mean_free_paths is not None and lights == "points" else 0,
        num_chains=num_chains,
        num_direct=num_direct,
        light_stride=light_stride,
        end=end,
        distance=distance,
        transmittance=transmittance,
        visibility=visibility,
        shadows=shadows if scene.mesh is not None else "rays",
        columns=_columns_by(columns, tracked, camera, _most_lights(num_paths, max_lights), group_size, map_size, upsample),
        map_size=map_size,
        map_steps=map_steps,
        direct_at_vertex=direct_at_vertex,
        sampling=sampling,
        num_evaluations=num_evaluations,
        group_size=group_size,
        eye_steps=_eye_steps(medium) if eye_steps is None else eye_steps,
        pair_steps=8 if pair_steps is None else pair_steps,
        mip_block=mip_block,
        upsample=upsample,
        refine_below=refine_below,
        tile=tile,
        jitter=jitter,
        edge_rays=edge_rays if scene.mesh is not None and jitter and upsample == 1 else 1,
        caster=caster,
        grey=medium is not None and values and media.is_grey(medium),
        isotropic=medium is not None and values and media.is_isotropic(medium),
        costly=tracked or scene.mesh is not None,
        volume=scatters and lit,
        surface=reflects and lit and (scatters or scene.mesh is not None),
        skipped=_skipped(scene, lit, scatters, reflects, values, num_levels),
    )


def _check_medium(scene):
    medium = scene.medium
    if medium is None:
        return
    for key, value in (("boundary", medium.boundary), ("inclusions", medium.inclusions or None), ("ior", medium.ior)):
        if value is not None:
            raise ValueError(
                f"medium.{key}: instant_multiple_scattering takes a single medium that fills its box and keeps rays "
                "straight; use path_tracing or lattice_boltzmann"
            )


def _is_dark(medium):
    return float(np.max(np.asarray(medium.sigma_s))) == 0.0 or media.is_empty(medium)


def _is_black(mesh):
    brightest = float(np.max(np.asarray(mesh.albedo), initial=0.0))
    return brightest == 0.0 and (mesh.specular is None or float(np.max(np.asarray(mesh.specular), initial=0.0)) == 0.0)


def _eye_steps(medium):
    """Steps of the table along an eye ray: one for each voxel of the longest axis, within 32 and 256."""
    if medium is None or medium.density is None:
        return 0
    return int(np.clip(8 * -(-max(medium.density.shape) // 8), 32, 256))


def _most_lights(num_paths, max_lights):
    """About as many lights as will be gathered: few paths have more than four."""
    return 4 * num_paths if max_lights is None else min(4 * num_paths, max_lights)


def _columns_by(columns, tracked, camera, num_lights, group_size, map_size, upsample):
    """How columns towards lights are found: maps where a light has several times more receivers than texels.

    A map costs its texels, a march one in `group_size` of the receivers, both with as many lookups; reading a map costs
    a tenth of a march (experiments/instant_transmittance.py). Maps of all lights must fit into 300 MB.
    """
    if not tracked:
        return "march"
    if columns != "auto":
        return columns
    receivers = 1.75 * camera.height * camera.width / (upsample * upsample * group_size)
    fits = num_lights * map_size * map_size * 16 * 4 < _MAP_BYTES
    return "maps" if fits and receivers > 1.5 * map_size * map_size else "march"


def _levels(scene, mean_free_paths):
    """Compensation steps that leave less than `_LEFT` of the energy that scattered at least twice.

    Of that, a share 0.7 min(d, size) / min(mean free path, size) has its last segment within the clamp distance d, and each
    step passes on at most 0.7 albedo sigma_t min(d, size) of what it receives.
    """
    if mean_free_paths is None:
        return 0
    medium = scene.medium
    albedo = float(np.max(np.asarray(medium.sigma_s) / np.maximum(np.asarray(media.sigma_t(medium)), 1e-30)))
    thickness = max(_thickness(scene), 1e-30)
    within = 0.7 * min(mean_free_paths, thickness)
    left, number = within / min(1.0, thickness), 0
    while left > _LEFT and number < _MOST_LEVELS:
        left, number = left * within * albedo, number + 1
    return number


def _skipped(scene, lit, scatters, reflects, values, num_levels):
    reasons = []
    if not lit:
        reasons.append("no light: nothing is traced or gathered")
    if scene.medium is None:
        reasons.append("no medium: volume layers are exactly zero")
    elif not scatters:
        reasons.append("the medium scatters nothing: no virtual lights in it, volume layers are exactly zero")
    elif scene.medium.density is None:
        reasons.append("homogeneous medium: flights and transmittance in closed form, no tracking or marching")
    if scene.mesh is None:
        reasons.append("no surfaces: no rays are cast, surface layers are exactly zero")
    elif not reflects:
        reasons.append("black surfaces: they only occlude, no virtual lights on them, surface layers are exactly zero")
    if scatters and values and media.is_isotropic(scene.medium):
        reasons.append("g = 0: no phase function is evaluated")
    if scatters and values and media.is_grey(scene.medium):
        reasons.append("grey medium: one transmittance for all channels")
    if scatters and values and _thickness(scene) < 0.1:
        reasons.append(
            f"optically thin (at most {_thickness(scene):.2g} across): multiple scattering is a small share of single; "
            f"{num_levels} compensation steps"
        )
    return tuple(reasons)


def _thickness(scene):
    """Bound on the medium's optical thickness across its box."""
    medium = scene.medium
    bounds = np.asarray(medium.bounds)
    peak = 1.0 if medium.density is None else float(np.max(np.asarray(medium.density)))
    return float(np.max(np.asarray(media.sigma_t(medium)))) * peak * float(np.linalg.norm(bounds[1] - bounds[0]))
