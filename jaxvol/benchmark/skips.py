"""What a scene may lack, or have trivially, in pairs: a scene in which work is skipped, and one that says the same without.

The second scene holds the same light in a form that nobody can skip: a constant grid for a homogeneous medium, an albedo
of 1e-6 for 0, a black triangle far behind the camera for no surface, a plan that looks at no values.
"""

from dataclasses import dataclass, field
from typing import Any

import numpy as np

Config = dict[str, Any]

_CAMERA = {"origin": [0.0, 0.2, 3.2], "target": [0.0, 0.0, 0.0], "fov_y": 36.0, "width": 96, "height": 96}
_BOX = [[-0.8, -0.8, -0.8], [0.8, 0.8, 0.8]]
_FOG = {"bounds": _BOX, "scattering": 1.0, "absorption": 0.2, "anisotropy": 0.4}
_LAMP = {"kind": "point", "position": [0.3, 1.2, 0.6], "intensity": 4.0}
_SPOT = {"kind": "spot", "position": [0, 0.5, 0], "direction": [0, -1, 0], "angle": 20, "intensity": 4}
_SKY = {"kind": "environment", "radiance": 1.0}
_FLOOR = {"mesh": "builtin:plane", "reflectance": 0.6, "transform": {"scale": 2.0, "translate": [0.0, -1.0, 0.0]}}
_WALL = {
    "mesh": "builtin:plane",
    "reflectance": 0.6,
    "transform": {"scale": 2.0, "rotate": [1.0, 0.0, 0.0, 90.0], "translate": [0.0, 0.0, -1.0]},
}
_BEHIND = {"mesh": (np.array([[0, 0, 90], [1, 0, 90], [0, 1, 90]], float), np.array([[0, 1, 2]])), "reflectance": 0.0}
_RANDOM = np.random.default_rng(0).random((24, 24, 24))


@dataclass(frozen=True)
class Skip:
    """A pair of scenes with the options of the method that skips."""

    name: str
    method: str
    what: str  # is skipped
    present: Config  # the scene that lacks it: with the skip
    absent: Config  # the same without the skip
    options: Config = field(default_factory=dict)  # of both: the method's, for "auto" those of [render]
    without: Config = field(default_factory=dict)  # more options, of the second
    equal: float | None = 1e-3  # relative L1 within which the pictures agree; None: they differ by noise, means are compared

    def render(self, options: Config) -> Config:
        """A [render] table with these options."""
        return dict(options) if self.method == "auto" else {self.method: options}


def _scene(*, medium: Config | None = None, shapes: tuple = (_FLOOR, _WALL), lights: tuple = (_LAMP,)) -> Config:
    found: Config = {"camera": _CAMERA, "shapes": list(shapes), "lights": list(lights)}
    return found if medium is None else found | {"medium": medium}


def _medium(**changes: Any) -> Config:
    return _FOG | changes


_STRUCTURE = {"specialize": "structure"}
_PAINT = {"samples": 8}
_SPLAT = {"num_surfels": 4096}
_GATHER = {"num_paths": 128}
_EXACT = {"num_surfels": 4096, "num_levels": 1, "transport": "none"}  # every pair of surfel and sample: no noise of choices
_FEW = {"samples_per_pixel": 4}
_SLAB = np.zeros((64, 64, 64))  # filled in a fifth of the box, in voxels thin enough for the sky's field
_SLAB[:12] = np.random.default_rng(0).random((12, 64, 64))
_HALF = np.where(np.arange(24)[:, None, None] < 4, _RANDOM, 0.0)
_PUFF = np.zeros((24, 24, 24))  # a puff in one corner, dark at its own rim
_PUFF[1:7, 1:7, 1:23] = _RANDOM[1:7, 1:7, 1:23]
_CORNER = [[-0.8, -0.8, -0.8], [-0.8 + 1.6 / 3, -0.8 + 1.6 / 3, 0.8]]  # its 8 x 8 x 24 voxels

SKIPS: tuple[Skip, ...] = (
    Skip(
        "no medium", "path_tracing", "free flights, transmittance, volume layers",
        _scene(), _scene(medium=_medium(scattering=1e-9, absorption=0.0)), _PAINT, equal=None,
    ),
    Skip(
        "no surfaces", "path_tracing", "ray casting, surface layers",
        _scene(medium=_FOG, shapes=()), _scene(medium=_FOG, shapes=(_BEHIND,)), _PAINT, equal=None,
    ),
    Skip(
        "no surfaces, direct", "direct", "ray casting, shadows",
        _scene(medium=_FOG, shapes=()), _scene(medium=_FOG, shapes=(_BEHIND,)),
    ),
    Skip(
        "homogeneous", "direct", "marching, grid lookups",
        _scene(medium=_FOG), _scene(medium=_medium(density=np.ones((24, 24, 24)))), _FEW, equal=1e-2,
    ),
    Skip(
        "homogeneous, traced", "path_tracing", "tracking, majorant grid",
        _scene(medium=_FOG), _scene(medium=_medium(density=np.ones((24, 24, 24)))), _PAINT, equal=None,
    ),
    Skip(
        "grey", "deep_screen_space", "weights and transport of two channels",
        _scene(medium=_FOG), _scene(medium=_FOG), _SPLAT, _STRUCTURE,
    ),
    Skip(
        "grey, lattice", "lattice_boltzmann", "two of three channels marched and solved",
        _scene(medium=_medium(anisotropy=0.0)), _scene(medium=_medium(anisotropy=0.0)), {"resolution": 32}, _STRUCTURE,
    ),
    Skip(
        "g = 0", "deep_screen_space", "the phase function",
        _scene(medium=_medium(anisotropy=0.0, scattering=[1.0, 0.9, 0.8])),
        _scene(medium=_medium(anisotropy=0.0, scattering=[1.0, 0.9, 0.8])), _SPLAT, _STRUCTURE,
    ),
    Skip(
        "g = 0, virtual lights", "instant_multiple_scattering", "the phase function, one transmittance for three",
        _scene(medium=_medium(anisotropy=0.0), shapes=()), _scene(medium=_medium(anisotropy=0.0), shapes=()),
        _GATHER, _STRUCTURE,
    ),
    Skip(
        "no refraction", "lattice_boltzmann", "gradients of the index, bent rays",
        _scene(medium=_medium(anisotropy=0.0), shapes=()),
        _scene(medium=_medium(anisotropy=0.0, refractive_index=np.ones((8, 8, 8))), shapes=()),
        {"resolution": 24}, _STRUCTURE, equal=0.2,
    ),
    Skip(
        "empty space", "direct", "the sky's field where nothing is",
        _scene(medium=_medium(density=_SLAB, scattering=20.0), shapes=(), lights=(_SKY,)),
        _scene(medium=_medium(density=np.maximum(_SLAB, 1e-9), scattering=20.0), shapes=(), lights=(_SKY,)),
    ),
    Skip(
        "empty space, marched", "direct", "marching from where nothing is",
        _scene(medium=_medium(density=_HALF, scattering=20.0), shapes=(), lights=(_SKY,)),
        _scene(medium=_medium(density=np.maximum(_HALF, 1e-9), scattering=20.0), shapes=(), lights=(_SKY,)),
        _FEW | {"num_sky_directions": 0},
    ),
    Skip(
        "unlit surfels", "deep_screen_space", "surfels that send no light",
        _scene(medium=_FOG, lights=(_SPOT, _LAMP | {"intensity": 0.0})),
        _scene(medium=_FOG, lights=(_SPOT, _LAMP | {"intensity": 1e-6})), _EXACT,
    ),
    Skip(
        "invisible medium", "deep_screen_space", "rays that show no medium",
        _scene(medium=_medium(bounds=_CORNER, density=_PUFF[:8, :8])),
        _scene(medium=_medium(density=np.maximum(_PUFF, 1e-6))), _EXACT,
    ),
    Skip(
        "single light", "direct", "a second light's shadows and marching",
        _scene(medium=_medium(density=_RANDOM)),
        _scene(medium=_medium(density=_RANDOM), lights=(_LAMP | {"intensity": 2.0}, _LAMP | {"intensity": 2.0})),
        _FEW,
    ),
    Skip(
        "albedo 0 of surfaces", "direct", "surface light",
        _scene(medium=_FOG, shapes=(_FLOOR | {"reflectance": 0.0},)),
        _scene(medium=_FOG, shapes=(_FLOOR | {"reflectance": 1e-6},)),
    ),
    Skip(
        "albedo 0 of the medium", "lattice_boltzmann", "the lattice",
        _scene(medium=_medium(scattering=0.0, anisotropy=0.0)), _scene(medium=_medium(scattering=1e-9, anisotropy=0.0)),
        {"resolution": 32},
    ),
    Skip(
        "zero-size bounce", "instant_multiple_scattering", "virtual lights of a bounce off black surfaces, surface layers",
        _scene(medium=_FOG, shapes=(_FLOOR | {"reflectance": 0.0},)),
        _scene(medium=_FOG, shapes=(_FLOOR | {"reflectance": 1e-6},)),
        _GATHER,
    ),
    Skip(
        "thin medium", "auto", "light scattered twice, below the bound",
        _scene(medium=_medium(scattering=1e-5, absorption=0.0), shapes=()),
        _scene(medium=_medium(scattering=1e-5, absorption=0.0), shapes=()), {}, {"negligible": 0.0},
    ),
)  # fmt: skip
