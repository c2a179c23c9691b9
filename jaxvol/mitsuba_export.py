"""A scene for Mitsuba 3: as a dictionary for `mitsuba.load_dict`, or as an XML file with the files it names.

Both hold the same picture in linear RGB, without spectral upsampling: `volpath`, `ply` surfaces (two-sided diffuse,
face normals), index-matched media in `null` boundaries, box filter. What differs from ours in form is converted:

* A grid holds its values at cell centres in both, and `use_grid_bbox` takes our bounds.
* Mitsuba's map rows stand at theta = pi r / (h - 1), ours at pi (r + .5) / h: maps are written with 2 h + 1 rows, on
  which both bilinear lookups agree exactly. Columns and axes are the same.
* A spot's `beam_width` and `cutoff_angle` are our `falloff` and `cutoff`, half-angles with a ramp linear in the angle.
* A medium's box that touches surfaces grows by 1e-4 of its size there, lest rays meet both at once.
* Mitsuba's rays start (1 + |position|) 9e-5 away from surfaces, whatever the scene's size: export scenes of less than
  about a unit with `scale` (lengths times s, sigma over s, intensities times s^2; radiance stays).

* Mitsuba has no Phong lobe: such surfaces name `jaxvol_phong`, which `mitsuba_phong.register` makes known.

Not expressible, refused: refractive indices, media that stick out of their bounds or inclusions out of their medium.
"""

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import trimesh

from jaxvol import image, jobs, media, mitsuba_phong, segments, volumes
from jaxvol.types import Camera, EnvironmentLight, Medium, Mesh, Scene
from jaxvol.volumes import Volume

_CLEARANCE = 1e-4  # of the size of the medium's box
_NUM_PHASE_NODES = 4001

_TAGS = {
    "scene": "scene",
    "volpath": "integrator",
    "volpathmis": "integrator",
    "perspective": "sensor",
    "hdrfilm": "film",
    "box": "rfilter",
    "independent": "sampler",
    "ply": "shape",
    "cube": "shape",
    "twosided": "bsdf",
    "diffuse": "bsdf",
    "null": "bsdf",
    mitsuba_phong.NAME: "bsdf",
    "area": "emitter",
    "point": "emitter",
    "spot": "emitter",
    "directional": "emitter",
    "constant": "emitter",
    "envmap": "emitter",
    "homogeneous": "medium",
    "heterogeneous": "medium",
    "gridvolume": "volume",
    "hg": "phase",
    "tabphase": "phase",
}


def to_mitsuba_dict(
    scene: Scene,
    camera: Camera,
    folder: str | os.PathLike,
    *,
    integrator: str = "volpath",
    max_depth: int = -1,
    samples: int = 64,
    scale: float = 1.0,
) -> dict[str, Any]:
    """What `mitsuba.load_dict` takes, its meshes, grids and maps as files in `folder`; needs Mitsuba and an rgb variant.

    `max_depth` in Mitsuba's counting: 2 is single scattering, -1 has no end. `integrator`: "volpath", or "volpathmis"
    for media whose extinction differs between channels. Raises ValueError for what Mitsuba cannot express, OSError.
    """
    import mitsuba

    def native(value: Any, key: str = "") -> Any:
        if isinstance(value, dict):
            return {name: native(item, name) for name, item in value.items()}
        if isinstance(value, np.ndarray):
            return mitsuba.ScalarTransform4f(value)
        if key == "filename":
            return str(Path(folder).resolve() / value)
        return list(value) if isinstance(value, tuple) else value

    return native(_describe(scene, camera, Path(folder), integrator, max_depth, samples, scale))


def write_mitsuba_xml(
    path: str | os.PathLike,
    scene: Scene,
    camera: Camera,
    *,
    integrator: str = "volpath",
    max_depth: int = -1,
    samples: int = 64,
    scale: float = 1.0,
) -> None:
    """The same as an XML file, with the files that it names beside it; needs no Mitsuba.

    Render it with `mitsuba -m scalar_rgb FILE` or any other rgb variant. Raises ValueError, OSError.
    """
    path = Path(path)
    described = _describe(scene, camera, path.parent, integrator, max_depth, samples, scale)
    root = _element("", described)
    root.set("version", "3.0.0")
    ElementTree.indent(root)
    jobs.write_bytes(path, ElementTree.tostring(root, encoding="utf-8") + b"\n")


def _element(name: str, value: Any) -> ElementTree.Element:
    """XML of a plugin (a dictionary with `type`) or of a property."""
    if isinstance(value, dict):
        kind = value["type"]
        if kind == "rgb":
            return ElementTree.Element("rgb", name=name, value=_numbers(value["value"]))
        if kind == "ref":
            return ElementTree.Element("ref", name=name, id=value["id"])
        element = ElementTree.Element(_TAGS[kind])
        if kind != "scene":
            element.set("type", kind)
        if "id" in value:
            element.set("id", value["id"])
        elif name and _TAGS[kind] == "volume":
            element.set("name", name)
        element.extend(_element(key, item) for key, item in value.items() if key not in ("type", "id"))
        return element
    if isinstance(value, np.ndarray):
        element = ElementTree.Element("transform", name=name)
        element.append(ElementTree.Element("matrix", value=_numbers(value.ravel())))
        return element
    if isinstance(value, tuple):
        return ElementTree.Element("point" if name == "position" else "vector", name=name, value=_numbers(value))
    kind = {bool: "boolean", int: "integer", float: "float", str: "string"}[type(value)]
    return ElementTree.Element(kind, name=name, value=str(value).lower() if kind == "boolean" else str(value))


def _numbers(values: Any) -> str:
    return ", ".join(repr(float(x)) for x in values)


def _describe(scene, camera, folder, integrator, max_depth, samples, scale) -> dict[str, Any]:
    """The scene as nested dictionaries of plain values: tuples are vectors, arrays 4 x 4 transforms."""
    if integrator not in ("volpath", "volpathmis"):
        raise ValueError(f"integrator: {integrator!r} is not allowed, must be volpath or volpathmis")
    if max_depth < -1 or samples < 1 or not 0 < scale < np.inf:
        raise ValueError("max_depth must be >= -1, samples >= 1, scale > 0 and finite")
    folder.mkdir(parents=True, exist_ok=True)
    medium = scene.medium if scene.medium is not None and not media.is_empty(scene.medium) else None
    described = {"type": "scene", "integrator": {"type": integrator, "max_depth": int(max_depth)}}
    if medium is not None:
        _refuse(medium)
        for region, part in enumerate((medium, *medium.inclusions)):
            described[f"medium_{region}"] = _medium(part, region, folder, scale)
            described[f"boundary_{region}"] = _boundary(part, region, scene.mesh, folder, scale)
    described["sensor"] = _sensor(camera, medium, samples, scale)
    for name, surface in _surfaces(scene.mesh, folder, scale):
        described[name] = surface
    described |= dict(_lights(scene, scale))
    if scene.environment is not None:
        described["environment"] = _environment(scene.environment, folder)
    return described


def _rgb(values: Any) -> dict[str, Any]:
    return {"type": "rgb", "value": [float(x) for x in np.asarray(values)]}


def _vector(values: Any) -> tuple[float, ...]:
    return tuple(float(x) for x in np.asarray(values, np.float64))


def _sensor(camera: Camera, medium: Medium | None, samples: int, scale: float) -> dict[str, Any]:
    """Mitsuba's camera looks along +z with x to the left."""
    ours = np.asarray(camera.world_from_camera, np.float64)
    pose = ours * np.array([-1.0, 1.0, -1.0, 1.0])
    pose[:3, 3] *= scale
    film = {
        "type": "hdrfilm",
        "width": int(camera.width),
        "height": int(camera.height),
        "pixel_format": "rgb",
        "component_format": "float32",
        "filter": {"type": "box"},
    }
    sensor = {
        "type": "perspective",
        "fov": float(np.degrees(np.asarray(camera.fov_y, np.float64))),
        "fov_axis": "y",
        "near_clip": 1e-5 * scale,
        "far_clip": 1e5 * scale,
        "to_world": pose,
        "film": film,
        "sampler": {"type": "independent", "sample_count": int(samples)},
    }
    if medium is not None:
        (region,) = np.asarray(segments.region_at(medium, ours[None, :3, 3], casters=segments.medium_casters(medium)))
        if region >= 0:
            sensor["medium"] = {"type": "ref", "id": f"medium_{region}"}
    return sensor


def _write_ply(path: Path, vertices: np.ndarray, faces: np.ndarray) -> None:
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    mesh.remove_unreferenced_vertices()
    jobs.write_bytes(path, mesh.export(file_type="ply", vertex_normal=False))


def _surfaces(mesh: Mesh | None, folder: Path, scale: float) -> Iterator[tuple[str, dict[str, Any]]]:
    """One shape for each material."""
    if mesh is None:
        return
    vertices, faces = np.asarray(mesh.vertices, np.float64) * scale, np.asarray(mesh.faces)
    albedo = np.asarray(mesh.albedo, np.float64)
    emission = np.zeros_like(albedo) if mesh.emission is None else np.asarray(mesh.emission, np.float64)
    columns = [albedo, emission]
    if mesh.specular is not None:
        columns += [np.asarray(mesh.specular, np.float64), np.asarray(mesh.exponent, np.float64)[:, None]]
    materials, which = np.unique(np.concatenate(columns, axis=1), axis=0, return_inverse=True)
    for index, material in enumerate(materials):
        name = f"surface_{index}"
        _write_ply(folder / f"{name}.ply", vertices, faces[which.reshape(-1) == index])
        shape = {"type": "ply", "filename": f"{name}.ply", "face_normals": True, "bsdf": _bsdf(material)}
        if np.any(material[3:6] > 0):
            shape["emitter"] = {"type": "area", "radiance": _rgb(material[3:6])}
        yield name, shape


def _bsdf(material: np.ndarray) -> dict[str, Any]:
    """Of albedo, emission and, where there is a lobe, specular and exponent."""
    if np.any(material[6:9] > 0):
        values = (float(x) for x in np.delete(material, [3, 4, 5]))
        return {"type": mitsuba_phong.NAME, **dict(zip(mitsuba_phong.PARAMETERS, values, strict=True))}
    return {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": _rgb(material[:3])}}


def _refuse(medium: Medium) -> None:
    low, high = np.asarray(medium.bounds, np.float64)
    for part in (medium, *medium.inclusions):
        if part.ior is not None and np.any(np.abs(np.asarray(part.ior) - 1.0) > 1e-6):
            raise ValueError("medium.refractive_index: only 1 can be exported, media have index-matched boundaries")
        if part.boundary is not None:
            corners = np.asarray(part.boundary.vertices, np.float64)
            own = np.asarray(part.bounds, np.float64)
            room = 1e-6 * np.max(high - low)
            within = [own] if part is medium else [own, (low, high)]
            if any(np.any(corners < a - room) or np.any(corners > b + room) for a, b in within):
                raise ValueError("medium.shape: to be exported it must lie within bounds, an inclusion within its medium")


def _medium(part: Medium, region: int, folder: Path, scale: float) -> dict[str, Any]:
    sigma_t = np.asarray(media.sigma_t(part), np.float64) / scale
    sigma_s = np.asarray(part.sigma_s, np.float64) / scale
    grey = bool(np.all(sigma_t == sigma_t[0]))
    described = {
        "id": f"medium_{region}",
        "albedo": _rgb(sigma_s / np.where(sigma_t > 0, sigma_t, 1.0)),
        "has_spectral_extinction": not grey,
        "phase": _phase(part),
    }
    if part.density is None:
        return {"type": "homogeneous", "sigma_t": _rgb(sigma_t), **described}
    largest = float(sigma_t.max())
    name, density = f"density_{region}.vol", np.asarray(part.density)
    if not grey:
        density = density[..., None] * (sigma_t / largest)
    volumes.write_vol(folder / name, Volume(density=density, bounds=np.asarray(part.bounds) * scale))
    grid = {"type": "gridvolume", "filename": name, "use_grid_bbox": True, "raw": True}
    return {"type": "heterogeneous", "sigma_t": grid, "scale": largest, **described}


def _phase(part: Medium) -> dict[str, Any]:
    if part.phase is None:
        return {"type": "hg", "g": float(part.g)}
    cosine = np.linspace(-1.0, 1.0, _NUM_PHASE_NODES)
    value = np.interp(cosine, np.asarray(part.phase.cos_theta), np.asarray(part.phase.value))
    return {"type": "tabphase", "values": ", ".join(f"{x:.7g}" for x in value)}


def _boundary(part: Medium, region: int, mesh: Mesh | None, folder: Path, scale: float) -> dict[str, Any]:
    """A closed shape that does not bend light, with the medium inside."""
    if part.boundary is None:
        low, high = _with_clearance(np.asarray(part.bounds, np.float64), mesh) * scale
        pose = np.diag([*(0.5 * (high - low)), 1.0])
        pose[:3, 3] = 0.5 * (low + high)
        shape = {"type": "cube", "to_world": pose}
    else:
        name = f"boundary_{region}.ply"
        _write_ply(folder / name, np.asarray(part.boundary.vertices, np.float64) * scale, np.asarray(part.boundary.faces))
        shape = {"type": "ply", "filename": name, "face_normals": True}
    shape |= {"bsdf": {"type": "null"}, "interior": {"type": "ref", "id": f"medium_{region}"}}
    if region > 0:
        shape["exterior"] = {"type": "ref", "id": "medium_0"}
    return shape


def _with_clearance(bounds: np.ndarray, mesh: Mesh | None) -> np.ndarray:
    """The box, a little larger on those sides that a vertex of the mesh (nearly) touches."""
    if mesh is None:
        return bounds
    size = np.max(bounds[1] - bounds[0])
    vertices = np.asarray(mesh.vertices, np.float64)
    near = np.stack([np.any(np.abs(vertices - side) < _CLEARANCE * size, axis=0) for side in bounds])
    return bounds + np.where(near, _CLEARANCE * size, 0.0) * np.array([[-1.0], [1.0]])


def _lights(scene: Scene, scale: float) -> Iterator[tuple[str, dict[str, Any]]]:
    """Lights without surfaces; the environment apart."""
    lights = scene.point_lights
    for i in range(0 if lights is None else lights.position.shape[0]):
        position = _vector(np.asarray(lights.position[i], np.float64) * scale)
        intensity = _rgb(np.asarray(lights.intensity[i], np.float64) * scale**2)
        yield f"point_{i}", {"type": "point", "position": position, "intensity": intensity}
    lights = scene.spot_lights
    for i in range(0 if lights is None else lights.position.shape[0]):
        yield (
            f"spot_{i}",
            {
                "type": "spot",
                "to_world": _aim(np.asarray(lights.position[i], np.float64) * scale, lights.direction[i]),
                "intensity": _rgb(np.asarray(lights.intensity[i], np.float64) * scale**2),
                "cutoff_angle": float(np.degrees(np.asarray(lights.cutoff[i], np.float64))),
                "beam_width": float(np.degrees(np.asarray(lights.falloff[i], np.float64))),
            },
        )
    lights = scene.directional_lights
    for i in range(0 if lights is None else lights.direction.shape[0]):
        direction, irradiance = _vector(lights.direction[i]), _rgb(lights.irradiance[i])
        yield f"directional_{i}", {"type": "directional", "direction": direction, "irradiance": irradiance}


def _aim(position: np.ndarray, direction: Any) -> np.ndarray:
    """A pose whose +z is `direction`."""
    z = np.asarray(direction, np.float64)
    z = z / np.linalg.norm(z)
    x = np.cross(np.eye(3)[np.argmin(np.abs(z))], z)
    x = x / np.linalg.norm(x)
    pose = np.eye(4)
    pose[:3] = np.stack([x, np.cross(z, x), z, position], axis=1)
    return pose


def _environment(environment: EnvironmentLight, folder: Path) -> dict[str, Any]:
    ours = np.asarray(environment.radiance)
    height, width, _ = ours.shape
    if height == 1 and width == 1:
        return {"type": "constant", "radiance": _rgb(ours[0, 0])}
    if width == 1:
        ours = np.repeat(ours, 2, axis=1)
    # Row k of the new map stands at theta = pi k / (2 h): on our rows, half way between them, and at the poles.
    padded = np.concatenate([ours[:1], ours, ours[-1:]])
    rows = np.empty((2 * height + 1, *ours.shape[1:]), np.float32)
    rows[1::2] = ours
    rows[0::2] = 0.5 * (padded[:-1] + padded[1:])
    image.write_exr(folder / "environment.exr", {letter: rows[..., i] for i, letter in enumerate("RGB")})
    pose = np.eye(4)
    pose[:3, :3] = np.asarray(environment.map_from_world, np.float64).T
    return {"type": "envmap", "filename": "environment.exr", "to_world": pose}
