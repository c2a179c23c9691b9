"""Scenes on purpose: one extreme at a time, the rest everyday."""

from collections.abc import Iterator

import numpy as np

from jaxvol.stress.scenes import GRID, Config, draw, in_units

# Beginnings of the names of extremes in which every stage is differentiated.
CORNERS = (
    "optical depth 1e-06", "optical depth 10000", "g ", "albedo ", "channels ", "density contrast 1e+08", "empty grid",
    "one voxel filled",
)  # fmt: skip


def extremes() -> Iterator[tuple[str, Config]]:
    """Name and scene of every extreme."""
    for tau in (1e-12, 1e-6, 1e2, 1e4, 1e6):
        yield f"optical depth {tau:g}, fog", _fog(scattering=0.9 * tau, absorption=0.1 * tau)
        yield f"optical depth {tau:g}, grid", _grid(scattering=0.9 * tau, absorption=0.1 * tau)
    for factor in (1e-6, 1e-3, 1e3, 1e6):
        yield f"scene scale {factor:g}, fog", in_units(_fog(), factor)
        yield f"scene scale {factor:g}, grid", in_units(_grid(), factor)
    for g in (-0.999, -0.99, 0.99, 0.999):
        yield f"g {g}", _fog(anisotropy=g)
    yield "albedo 0", _fog(scattering=0.0, absorption=1.0)
    yield "albedo 1", _fog(scattering=1.0, absorption=0.0)
    yield "channels 100 apart", _fog(scattering=[20.0, 2.0, 0.2], absorption=[0.2, 0.02, 0.002])
    for contrast in (1e4, 1e8):
        checker = np.indices((GRID,) * 3).sum(axis=0) % 2
        yield f"density contrast {contrast:g}", _grid(density=np.where(checker == 1, 1.0, 1.0 / contrast))
    yield "empty grid", _grid(density=np.zeros((GRID,) * 3))
    one = np.zeros((GRID,) * 3)
    one[1, 2, 1] = 1e3
    yield "one voxel filled", _grid(density=one)
    yield "grid of 1 voxel", _grid(density=np.ones((1, 1, 1)))
    yield "grid of 1 x 1 x 8", _grid(density=np.linspace(0, 1, 8).reshape(1, 1, 8))
    for gap in (1e-6, 1e-4):
        yield f"light {gap:g} above the floor", _fog(light=[0.1, -1.0 + gap, 0.2])
        yield f"light {gap:g} above the floor, grid", _grid(light=[0.1, -1.0 + gap, 0.2])
    yield "light on a voxel's corner", _grid(light=[0.0, 0.0, 0.0])
    yield "light at the eye", _fog(light=[0.0, 0.4, 3.0])
    yield "camera on a face of the box", _fog(camera={"origin": [0.0, 0.0, 0.8]})
    yield "camera in a corner of the box", _fog(camera={"origin": [0.8, 0.8, 0.8]})
    yield "camera on the floor", _fog(camera={"origin": [0.0, -1.0, 1.5]})
    yield "camera inside, looking along an axis", _grid(camera={"origin": [0.0, 0.0, 0.5], "target": [0.0, 0.0, 0.0]})
    yield "one pixel", _fog(camera={"width": 1, "height": 1})
    yield "4096 x 1 pixels", _fog(camera={"width": 4096, "height": 1})
    yield "1 x 4096 pixels", _fog(camera={"width": 1, "height": 4096})
    yield "field of view 0.01 degrees", _fog(camera={"fov_y": 0.01})
    yield "field of view 179 degrees", _fog(camera={"fov_y": 179.0})
    yield "slivers and duplicate triangles", _fog(shapes=[_slivers()])
    yield "surfaces inside each other", _fog(shapes=_fog()["shapes"] * 2)
    yield "light 1e15", _fog(intensity=1e15)
    yield "light 1e28", _fog(intensity=1e28)
    yield "light 1e-30", _fog(intensity=1e-30)
    yield "no light", _fog() | {"lights": []}


def _slivers() -> Config:
    vertices = np.array([[-1, -1, -1], [1, -1, -1], [1, -1, 1], [0, -1 + 1e-7, 0], [0, 0.5, 0], [1e-7, 0.5, 1e-7]], float)
    faces = np.array([[0, 2, 1], [0, 2, 1], [0, 1, 3], [3, 4, 5], [3, 5, 4], [0, 3, 5]])
    return {"mesh": (vertices, faces), "reflectance": [0.7, 0.5, 0.3]}


def _base(medium: Config, camera: Config | None, light, intensity, shapes) -> Config:
    config = draw("fog_room_point", np.random.default_rng(0))
    looks = {
        "origin": [0.0, 0.4, 3.0],
        "target": [0.0, -0.2, 0.0],
        "up": [0.0, 1.0, 0.0],
        "fov_y": 40.0,
        "width": 6,
        "height": 6,
    }
    found = {"kind": "point", "position": [0.4, 0.6, 0.3] if light is None else light, "intensity": [intensity] * 3}
    room = config["shapes"]
    vertices, faces = room[0]["mesh"]
    vertices = np.where(np.arange(len(vertices))[:, None] < 4, np.array([1.0, 0.0, 1.0]) * vertices + [0, -1, 0], vertices)
    room = [{"mesh": (vertices, faces), "reflectance": [0.7, 0.5, 0.3]}] if shapes is None else shapes
    return {"camera": looks | (camera or {}), "medium": medium, "lights": [found], "shapes": room}


def _fog(*, camera=None, light=None, intensity=1.0, shapes=None, **medium) -> Config:
    told = {"bounds": [[-0.8] * 3, [0.8] * 3], "scattering": 0.5, "absorption": 0.1, "anisotropy": 0.3}
    return _base(told | medium, camera, light, intensity, shapes)


def _grid(*, camera=None, light=None, intensity=1.0, shapes=None, **medium) -> Config:
    rng = np.random.default_rng(1)
    told = {"bounds": [[-0.8] * 3, [0.8] * 3], "scattering": 2.0, "absorption": 0.4, "anisotropy": 0.3}
    return _base(told | {"density": rng.random((GRID,) * 3)} | medium, camera, light, intensity, shapes)
