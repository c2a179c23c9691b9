"""Random scenes as dictionaries for `make_scene`: structure from a few classes, numbers from all over their ranges.

Turns, shifts, other units and other light are made on the dictionaries too, so that everything goes through the same
door as a user's scene.
"""

from typing import Any

import numpy as np

Config = dict[str, Any]

# Structure: what a scene has. Numbers never change it, so one class is one compilation or few.
CLASSES: dict[str, Config] = {
    "fog_room_point": {"medium": "homogeneous", "mesh": True, "lights": ("point",)},
    "grid_sky": {"medium": "grid", "mesh": False, "lights": ("directional", "environment")},
    "grid_room_spot": {"medium": "grid", "mesh": True, "lights": ("spot",)},
    "fog_point": {"medium": "homogeneous", "mesh": False, "lights": ("point",)},
    "room_lamp": {"medium": None, "mesh": True, "lights": ("area",)},
    "fog_room_lamp": {"medium": "homogeneous", "mesh": True, "lights": ("area", "point")},
    "voxel_room_sky": {"medium": "voxel", "mesh": True, "lights": ("environment",)},
    "body_point": {"medium": "body", "mesh": False, "lights": ("point",)},
    "fog_furnace": {"medium": "homogeneous", "mesh": False, "lights": ("environment",)},
    "room_furnace": {"medium": "homogeneous", "mesh": True, "lights": ("environment",)},
}
GRID = 4  # voxels a side
SIDE = 6  # pixels
PARTS = 6  # voxels along the longest side of a medium where a method has voxels of its own
_BOX = np.array([
    [0, 2, 3], [0, 3, 1], [4, 5, 7], [4, 7, 6], [0, 1, 5], [0, 5, 4],
    [2, 6, 7], [2, 7, 3], [0, 4, 6], [0, 6, 2], [1, 3, 7], [1, 7, 5],
])  # fmt: skip


def random_scene(seed: int) -> tuple[str, Config]:
    """Class and scene number `seed`: the same on every machine."""
    names = tuple(CLASSES)
    name = names[seed % len(names)]
    return name, draw(name, np.random.default_rng(seed))


def draw(name: str, rng: np.random.Generator) -> Config:
    """One scene of a class, lengths of about one."""
    kind = CLASSES[name]
    # A lattice of PARTS voxels along the longest side is 6 x 5 x 6 whatever the sides are, and stays so under a turn.
    half = rng.uniform(0.7, 1.0) * (1.0 - np.array([0.0, rng.uniform(1.1, 1.9), rng.uniform(0.1, 0.9)]) / PARTS)
    middle = rng.uniform(-0.2, 0.2, 3)
    low, high = middle - half, middle + half
    config: Config = {"camera": _camera(rng, low, high), "lights": [], "shapes": []}
    furnace = name.endswith("furnace")
    if kind["medium"]:
        config["medium"] = _medium(kind["medium"], rng, low, high, furnace)
    if kind["mesh"]:
        config["shapes"] = _room(rng, "area" in kind["lights"], furnace)
    for light in kind["lights"]:
        if light != "area":
            config["lights"].append(_light(light, rng, low, high, furnace))
    return config


def _rgb(rng, low, high):
    """Three numbers, log-uniform, their spread drawn too."""
    middle = np.exp(rng.uniform(np.log(low), np.log(high)))
    return np.clip(middle * np.exp(rng.normal(0, rng.choice([0.0, 0.3, 2.0]), 3)), low, high)


def _medium(kind, rng, low, high, furnace):
    size = float(np.linalg.norm(high - low))
    # Half of the media are of everyday thickness, half from all of the range that is promised.
    tau = _rgb(rng, 1e-2, 1e1) if rng.random() < 0.5 else _rgb(rng, 1e-12, 1e6)
    share = rng.choice([0.0, 1.0, 2.0])
    albedo = np.ones(3) if furnace or share == 1.0 else np.zeros(3) if share == 0.0 and rng.random() < 0.3 else rng.random(3)
    g = float(rng.choice([rng.uniform(-0.9, 0.9), rng.choice([-0.999, 0.999]), rng.uniform(-0.3, 0.3)]))
    medium: Config = {"scattering": albedo * tau / size, "absorption": (1 - albedo) * tau / size, "anisotropy": g}
    if kind == "body":
        middle, half = 0.5 * (low + high), 0.4 * (high - low)
        medium["shape"] = {"mesh": (_corners(middle - half, middle + half), _BOX)}
        return medium
    medium["bounds"] = [low, high]
    if kind in ("grid", "voxel"):
        count = GRID if kind == "grid" else 1
        contrast = 10.0 ** rng.uniform(0, 8)
        density = contrast ** -rng.random((count,) * 3)
        empty = rng.random(density.shape) < rng.choice([0.0, 0.5])
        density = np.where(empty & (count > 1), 0.0, density)
        density.flat[0] = 1.0
        medium["density"] = density
    return medium


def _corners(low, high):
    return np.array([[x, y, z] for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (low[2], high[2])])


def _room(rng, lamp, furnace):
    """A floor, a box that may be a sliver, twice the same triangle; 16 triangles in all, and a lamp of two."""
    floor = np.array([[-2, -1, -2], [2, -1, -2], [2, -1, 2], [-2, -1, 2]]) + [0, rng.uniform(-0.2, 0.2), 0]
    middle = rng.uniform(-0.5, 0.5, 3)
    half = 0.4 * np.where(rng.random(3) < 0.2, 10.0 ** rng.uniform(-6, 0, 3), rng.random(3))
    vertices = np.concatenate([floor, _corners(middle - half, middle + half)])
    faces = np.concatenate([[[0, 2, 1], [0, 3, 2]], _BOX + 4, [[4, 6, 7], [4, 6, 7]]])
    white = furnace or rng.random() < 0.2
    colour = np.ones(3) if white else rng.random(3) * rng.choice([0.0, 1.0, 1.0, 1.0])
    shapes = [{"mesh": (vertices, faces), "reflectance": colour}]
    if lamp:
        size = 10.0 ** rng.uniform(-2, 0)
        corners = rng.uniform(-0.5, 0.5, 3) + size * np.array([[-1, 0, -1], [1, 0, -1], [1, 0, 1], [-1, 0, 1]])
        radiance = 10.0 ** rng.uniform(-3, 3) * rng.random(3)
        lamp_faces = np.array([[0, 1, 2], [0, 2, 3]])
        shapes.append({"mesh": (corners, lamp_faces), "reflectance": rng.random(3), "emission": radiance})
    return shapes


def _light(kind, rng, low, high, furnace):
    direction = rng.normal(size=3)
    power = 10.0 ** rng.uniform(-3, 3) * rng.random(3)
    place = rng.choice(["inside", "near", "outside"])
    position = low + (high - low) * rng.random(3)
    if place == "near":  # to a face of the box, or to the floor
        position[1] = rng.choice([low[1], -1.0]) + 10.0 ** rng.uniform(-6, -1)
    elif place == "outside":
        position = position + 3 * direction / np.linalg.norm(direction)
    match kind:
        case "point":
            return {"kind": kind, "position": position, "intensity": power}
        case "spot":
            angle = float(rng.uniform(1, 120))
            return {"kind": kind, "position": position, "direction": direction, "intensity": power, "angle": angle}
        case "directional":
            direction = np.where(np.arange(3) == rng.integers(3), direction, direction * rng.choice([0.0, 1.0]))
            return {"kind": kind, "direction": direction, "irradiance": power}
    return {"kind": "environment", "radiance": np.ones(3) if furnace else power}


def _camera(rng, low, high):
    target = rng.uniform(-0.3, 0.3, 3)
    direction = rng.normal(size=3)
    direction[1] = abs(direction[1])  # not from below the floor
    origin = target + rng.choice([0.4, 3.0]) * direction / np.linalg.norm(direction)
    if rng.random() < 0.1:  # on a face of the medium's box
        origin = np.append(low[:2] + (high - low)[:2] * rng.random(2), high[2])
    up = np.array([0.0, 1.0, 0.0]) if abs(direction[1]) < 0.9 * np.linalg.norm(direction) else np.array([1.0, 0.0, 0.0])
    return {
        "origin": origin, "target": target, "up": up, "fov_y": float(rng.uniform(5, 100)), "width": SIDE, "height": SIDE,
    }  # fmt: skip


def with_light(config: Config, factor: float) -> Config:
    """The scene with all light `factor` times as strong."""
    keys = ("intensity", "irradiance", "radiance", "emission")
    scaled = lambda table: {k: np.multiply(v, factor) if k in keys else v for k, v in table.items()}  # noqa: E731
    return config | {"lights": [scaled(x) for x in config["lights"]], "shapes": [scaled(x) for x in config["shapes"]]}


def in_units(config: Config, factor: float) -> Config:
    """The same scene with lengths `factor` times as large: the same picture."""
    return _moved(config, lambda x: np.multiply(x, factor), lambda x: x, factor)


def turned(config: Config, shift: np.ndarray) -> Config:
    """The scene turned by 90 degrees about y (x to -z, z to x) and shifted: the same picture."""
    turn = lambda x: np.stack([np.asarray(x)[..., 2], np.asarray(x)[..., 1], -np.asarray(x)[..., 0]], axis=-1)  # noqa: E731
    moved = _moved(config, lambda x: turn(x) + shift, turn, 1.0)
    medium = moved.get("medium")
    if medium is not None and "bounds" in medium:
        medium["bounds"] = np.sort(np.asarray(medium["bounds"]), axis=0)
        if "density" in medium:  # new x = old z, new z = -old x
            medium["density"] = np.asarray(config["medium"]["density"]).transpose(2, 1, 0)[:, :, ::-1].copy()
    return moved


def _moved(config, place, direct, factor):
    """Positions by `place`, directions by `direct`, coefficients and intensities by the unit of length."""
    camera = config["camera"]
    camera = camera | {key: place(camera[key]) for key in ("origin", "target")} | {"up": direct(camera["up"])}
    shapes = [shape | {"mesh": (place(shape["mesh"][0]), shape["mesh"][1])} for shape in config["shapes"]]
    lights = []
    for light in config["lights"]:
        new = dict(light)
        if "position" in new:
            new["position"] = place(new["position"])
        if "direction" in new:
            new["direction"] = direct(new["direction"])
        if "intensity" in new:
            new["intensity"] = np.multiply(new["intensity"], factor * factor)
        lights.append(new)
    moved = config | {"camera": camera, "shapes": shapes, "lights": lights}
    if "medium" in config:
        medium = dict(config["medium"])
        for key in ("scattering", "absorption"):
            medium[key] = np.divide(medium[key], factor)
        if "bounds" in medium:
            medium["bounds"] = place(medium["bounds"])
        if "shape" in medium:
            vertices, faces = medium["shape"]["mesh"]
            medium["shape"] = {"mesh": (place(vertices), faces)}
        moved["medium"] = medium
    return moved
