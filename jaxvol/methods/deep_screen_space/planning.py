"""What a frame needs to know before it starts: options, static shapes, what the scene lets it skip."""

import math
from dataclasses import dataclass, field

import numpy as np

from jaxvol import interval_map, media, segments
from jaxvol.layers import Claim
from jaxvol.methods.deep_screen_space import lighting, reconstruction, splatting, surfels
from jaxvol.types import Camera, Scene

LAYER = "volume_from_surface"
BOUNCE_LAYER = "volume_from_multiple"
TRANSPORTS = ("table", "none")
WEIGHTS = ("exact", "paper")
_STRIDES = (1, 2, 4, 8, 8, 8, 8)  # neighbours take other samples, and the blur of coarse levels averages over them


@dataclass(frozen=True)
class Plan:
    """Options and static choices of `render`; floats in it are traced, not compiled in."""

    num_surfels: int
    num_levels: int
    num_intervals: int
    num_steps: int
    epsilon: float  # relative to the area-weighted mean radiance of the lit surfels
    radius: str
    tail: bool
    weights: str
    position: str
    transport: str
    blur: str
    pattern: str
    cluster_size: int
    table_resolution: int
    dense_from: int  # levels from here on take all pairs, finer ones the lists
    strides: tuple[int, ...]  # on each level every stride-th sample of a ray
    second_bounce: int  # surfels that each surfel gathers from before a second splat; 0 = none
    light_choices: tuple[tuple[int, int], ...]
    light_steps: int
    transport_steps: int
    grey: bool
    phase: str
    active: bool  # False: the layer is exactly zero
    skipped: tuple[str, ...] = field(compare=False)


def claims(scene: Scene) -> tuple[Claim, ...]:
    """`volume_from_surface`: complete, unless the medium bends rays (an index of refraction)."""
    partial = None
    if (
        scene.medium is not None
        and scene.medium.inclusions
        and any(part.phase is not None for part in (scene.medium, *scene.medium.inclusions))
    ):
        partial = "inclusions with a tabulated phase function scatter with the outer medium's, or by their mean cosine"
    if scene.medium is not None and scene.medium.ior is not None:
        partial = "rays are not bent at changes of the refractive index"
    return (Claim((LAYER,), partial),)


def _need(name, value, allowed):
    if value not in allowed:
        raise ValueError(f"{name} = {value!r} is unknown; it is one of {', '.join(map(str, allowed))}")


def _range(name, value, low, high):
    if not (np.isfinite(value) and low <= value <= high):
        raise ValueError(f"{name} = {value} is outside the allowed range {low} .. {high}")


def plan(
    scene: Scene,
    camera: Camera,
    *,
    num_surfels: int = 14336,
    num_levels: int = 6,
    num_intervals: int = 16,
    num_steps: int = 128,
    epsilon: float = 0.06,
    radius: str = "quadratic",
    tail: bool = True,
    weights: str = "exact",
    position: str = "midpoint",
    transport: str = "table",
    blur: str = "demodulated",
    pattern: str = "congruent",
    cluster_size: int = 256,
    table_resolution: int = 24,
    dense_from: int = 3,
    strides: tuple[int, ...] | None = None,
    second_bounce: int = 0,
    num_area_samples: int = 4,
    num_environment_samples: int = 8,
    light_steps: int = 32,
    transport_steps: int = 12,
    specialize: str = "values",
) -> Plan:
    """Check the options, look at the scene, decide what to skip. Eager.

    `specialize="values"` lets values decide (grey medium, isotropic phase function); `"structure"` keeps the general
    kernels, so that gradients with respect to those values are right. `paper` presets: radius="paper", tail=False,
    weights="paper", position="far", transport="none", blur="paper", pattern="paper".
    `second_bounce`: every surfel also gathers from so many lit ones, and a second splat gives light of two surface
    bounces, L S S V E: a part of `volume_from_multiple`, which `claims` never names.
    Raises ValueError for options outside their range.
    """
    for name, value, allowed in (
        ("radius", radius, splatting.RADII),
        ("weights", weights, WEIGHTS),
        ("position", position, interval_map.POSITIONS),
        ("transport", transport, TRANSPORTS),
        ("blur", blur, reconstruction.MODES),
        ("pattern", pattern, surfels.PATTERNS),
        ("specialize", specialize, ("values", "structure")),
    ):
        _need(name, value, allowed)
    for name, value, low, high in (
        ("num_surfels", num_surfels, 1, 2**20),
        ("num_levels", num_levels, 1, 7),
        ("num_intervals", num_intervals, 1, 256),
        ("num_steps", num_steps, 1, 4096),
        ("epsilon", epsilon, 1e-9, 1e6),
        ("table_resolution", table_resolution, 1, 64),
        ("second_bounce", second_bounce, 0, 1024),
        ("num_area_samples", num_area_samples, 1, 1024),
        ("num_environment_samples", num_environment_samples, 1, 1024),
        ("light_steps", light_steps, 1, 4096),
        ("transport_steps", transport_steps, 1, 4096),
    ):
        _range(name, value, low, high)
    if cluster_size < 16 or cluster_size & (cluster_size - 1):
        raise ValueError(f"cluster_size = {cluster_size} must be a power of two, at least 16")
    if strides is None:
        strides = tuple(math.gcd(s, num_intervals) for s in _STRIDES[:num_levels])
    if len(strides) != num_levels or any(s < 1 or num_intervals % s for s in strides):
        raise ValueError(f"strides = {strides} must give each of the {num_levels} levels a divisor of {num_intervals}")
    if weights == "paper" and position == "midpoint":
        raise ValueError("weights = 'paper' are right-endpoint sums: position must be 'far' or 'jittered'")
    if weights == "paper" and scene.medium is not None and not segments.is_box(scene.medium):
        raise ValueError("weights = 'paper' are for one medium in its box, without boundary mesh or inclusions")
    choices = lighting.light_choices(scene, num_area_samples=num_area_samples, num_environment_samples=num_environment_samples)
    skipped = _nothing_to_do(scene, choices)
    active = not skipped
    medium = scene.medium
    by_value = specialize == "values" and active
    grey = by_value and media.is_grey(medium) or (active and weights == "paper")
    phase = "henyey_greenstein"
    if active and medium.phase is not None:
        phase = "table"
        if medium.inclusions and any(part.phase is None for part in medium.inclusions):
            raise ValueError("a tabulated phase function in the medium and none in an inclusion cannot be mixed")
    elif by_value and media.is_isotropic(medium):
        phase = "isotropic"
        skipped += ("the phase function is constant: the kernel without it",)
    if grey and by_value:
        skipped += ("the medium is grey: one interval weight for all channels",)
    if active and medium.density is None and medium.boundary is None:
        skipped += ("the medium is homogeneous: intervals in closed form, no ray marching",)
    if active and scene.mesh.specular is None:
        skipped += ("no surface is glossy: no lobes",)
    if active and second_bounce:
        skipped += ("volume_from_multiple is partial: light of two surface bounces (L S S V E) alone, Lambertian ones",)
    return Plan(
        num_surfels=num_surfels,
        num_levels=num_levels,
        num_intervals=num_intervals,
        num_steps=num_steps,
        epsilon=float(epsilon),
        radius=radius,
        tail=tail,
        weights=weights,
        position=position,
        transport=transport,
        blur=blur,
        pattern=pattern,
        cluster_size=cluster_size,
        table_resolution=table_resolution,
        dense_from=dense_from,
        strides=tuple(strides),
        second_bounce=second_bounce,
        light_choices=choices,
        light_steps=light_steps,
        transport_steps=transport_steps,
        grey=bool(grey),
        phase=phase,
        active=active,
        skipped=skipped,
    )


def _nothing_to_do(scene, choices):
    """Why the layer is exactly zero; empty when it is not."""
    if scene.medium is None or media.is_empty(scene.medium):
        return ("no medium: no light is scattered in a volume; every stage is skipped",)
    if scene.mesh is None or scene.mesh.faces.shape[0] == 0:
        return ("no surfaces: no light comes from them; every stage is skipped",)
    if not choices:
        return ("no lights: every stage is skipped",)
    reflects = float(np.max(np.asarray(scene.mesh.albedo), initial=0.0)) > 0 or scene.mesh.specular is not None
    if not reflects:
        return ("all surfaces are black: no light comes from them; every stage is skipped",)
    return ()


def group_size(level: int, cluster_size: int, *, largest: int = 8) -> int:
    """Surfels that are evaluated together: as many as share a cluster of the transport table on this level."""
    return int(max(1, min(largest, cluster_size // 4**level)))


def coarse_size(num: int, *, least: int = 256) -> int:
    """`num` rounded up to one of eight sizes an octave, so that similar frames share compilations."""
    if num <= least:
        return least
    step = 1 << max((num - 1).bit_length() - 4, 0)
    return -(-num // step) * step
