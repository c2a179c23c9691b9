"""A scene file (TOML), a dictionary or Python arrays to what methods take: `Scene`, `Camera` and render settings.

Everything is checked here, eagerly: whatever is wrong is a ValueError of one line that names the key, the value and what
is allowed. What was merely left out or mended is in `SceneFile.notes`.

>>> from jaxvol.scene import load_scene, make_scene
>>> file = load_scene("experiments/scenes/cornell_fog.toml", overrides=["medium.scattering=0.5"])
>>> scene, camera, render = file.scene, file.camera, file.render
>>> fog = make_scene({
...     "camera": {"origin": [0, 0, 4], "target": [0, 0, 0], "width": 64, "height": 64},
...     "medium": {"density": np.ones((8, 8, 8)), "bounds": [[-1, -1, -1], [1, 1, 1]], "scattering": 2},
...     "shapes": [{"mesh": (vertices, faces), "reflectance": [0.8, 0.2, 0.2]}],
...     "lights": [{"kind": "point", "position": [0, 3, 0], "intensity": 10}],
... })
"""

import json
import tomllib
import zipfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
from pydantic import ValidationError

from jaxvol import camera as cameras
from jaxvol import image, lights, media, meshes, phase, volumes
from jaxvol.scene_config import (
    CameraTable,
    InclusionTable,
    MediumTable,
    RenderTable,
    SceneTable,
    ShapeOfMedium,
    explain_error,
)
from jaxvol.types import Camera, DirectionalLights, Medium, PointLights, Scene, SpotLights

MEDIUM_FILES = (".npz", ".vdb", ".vol")


@dataclass(frozen=True)
class SceneFile:
    """A scene that is ready to render, and what it was made of."""

    name: str
    scene: Scene
    camera: Camera | None
    render: RenderTable
    config: dict[str, Any]  # as validated, defaults filled in; arrays are named by their shape
    notes: tuple[str, ...]  # what was left out or mended, one line each


def load_scene(path: str | Path, *, overrides: Sequence[str] = ()) -> SceneFile:
    """Read a scene file; each override is `key.subkey.0=value` with a TOML value (or bare text).

    Raises ValueError, in one line, for whatever is wrong.
    """
    path = Path(path)
    table = read_table(path, overrides=overrides)
    try:
        return make_scene(table, base=path.parent, name=path.stem)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error


def read_table(path: str | Path, *, overrides: Sequence[str] = ()) -> SceneTable:
    """What a scene file says, as `load_scene` reads it, before any file that it names is read. Raises ValueError."""
    path = Path(path)
    try:
        with path.open("rb") as file:
            table = tomllib.load(file)
    except FileNotFoundError as error:
        raise ValueError(f"scene file {path} does not exist") from error
    except OSError as error:
        raise ValueError(f"scene file {path} cannot be read: {error.strerror or error}") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError, RecursionError) as error:
        raise ValueError(f"{path} is no TOML file: {error}") from error
    try:
        return SceneTable.model_validate(apply_overrides(table, overrides))
    except ValidationError as error:
        raise ValueError(f"{path}: {explain_error(error)}") from error
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error


def make_scene(config: dict[str, Any] | SceneTable, *, base: Path | str = ".", name: str = "scene") -> SceneFile:
    """The same from a dictionary with the keys of a scene file; files in it are relative to `base`.

    Beyond what TOML can say, `density` and `refractive_index` may be arrays [x, y, z], `mesh` a `trimesh.Trimesh` or a pair
    (vertices [V, 3], faces [F, 3]), `phase` a list of Legendre moments. Raises ValueError for whatever is wrong.
    """
    try:
        table = config if isinstance(config, SceneTable) else SceneTable.model_validate(config)
    except ValidationError as error:
        raise ValueError(explain_error(error)) from error
    base, notes = Path(base), []
    shapes = []
    for index, shape in enumerate(table.shapes):
        key = f"shapes.{index}"
        triangles = _load_mesh(f"{key}.mesh", shape.mesh, shape.transform, base)
        if shape.flip_normals:
            triangles = meshes.flip_normals(triangles)
        material = shape.model_dump(include={"reflectance", "emission", "specular", "exponent"})
        shapes.append((key, triangles, material))
    mesh, mesh_notes = meshes.build_mesh(shapes)
    notes += mesh_notes
    medium = None if table.medium is None else _medium("medium", table.medium, base, notes)
    scene = Scene(mesh=mesh, medium=medium, area_lights=lights.area_lights(mesh), **_lights(table, base, notes))
    if lights.num_lights(scene) == 0 and scene.environment is None:
        notes.append("the scene has no light: no [[lights]] and no emission, so the picture is black")
    return SceneFile(
        name=name,
        scene=scene,
        camera=None if table.camera is None else _camera(table.camera),
        render=table.render,
        config=_describe(table.model_dump()),
        notes=tuple(notes),
    )


def apply_overrides(table: dict[str, Any], overrides: Sequence[str]) -> dict[str, Any]:
    """A copy of `table` with every `a.b.0.c=value` set; the value is TOML, or text where it is no TOML.

    Raises ValueError for a malformed override or an index outside a list. Unknown keys are found by the validation.
    """
    table = _copied(table)
    for override in overrides:
        key, equals, text = override.partition("=")
        path = key.strip().split(".")
        if not equals or not all(path):
            raise ValueError(f"--set {override!r} must have the form key.subkey=value")
        target = table
        for part, following in zip(path, [*path[1:], None], strict=True):
            if isinstance(target, list):
                if not part.isdigit() or int(part) >= len(target):
                    raise ValueError(f"--set {key}: {part!r} must be an index in [0, {len(target) - 1}]")
                part = int(part)
            elif not isinstance(target, dict):
                raise ValueError(f"--set {key}: there is no table above {part!r}")
            if following is None:
                target[part] = _value(text.strip())
            else:
                target = target[part] if isinstance(target, list) else target.setdefault(part, {})
    return table


def _copied(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _copied(item) for key, item in value.items()}
    return [_copied(item) for item in value] if isinstance(value, list) else value


def _value(text: str) -> Any:
    try:
        return tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        pass
    try:
        return float(text)  # forms that TOML refuses, such as .5
    except ValueError:
        return text


def _describe(value: Any) -> Any:
    """A JSON-able copy; arrays are told by their shapes."""
    if isinstance(value, dict):
        return {key: _describe(item) for key, item in value.items()}
    if isinstance(value, list | tuple) and not any(hasattr(item, "dtype") for item in value):
        return [_describe(item) for item in value]
    if value is None or isinstance(value, str | int | float | bool):
        return value
    if isinstance(value, tuple):
        return f"arrays {[list(item.shape) for item in value]}"
    return f"array {list(value.shape)}" if hasattr(value, "dtype") else type(value).__name__


def _camera(table: CameraTable) -> Camera:
    forward = np.subtract(table.target, table.origin)
    length = np.linalg.norm(forward)
    if not np.any(np.subtract(np.float32(table.target), np.float32(table.origin))):
        raise ValueError(f"camera.target = {list(table.target)} must differ from camera.origin")
    sine = np.linalg.norm(np.cross(forward / length, np.asarray(table.up) / np.linalg.norm(table.up)))
    if sine < 1e-4:
        raise ValueError(f"camera.up = {list(table.up)} must not be parallel to the view direction")
    return Camera(
        world_from_camera=cameras.look_at(table.origin, table.target, table.up),
        fov_y=jnp.float32(np.radians(table.fov_y)),
        height=table.height,
        width=table.width,
    )


def _load_mesh(key: str, mesh: Any, transform: Any, base: Path) -> meshes.Triangles:
    try:
        return meshes.transform(meshes.load(mesh, base=base), **transform.model_dump())
    except (ValueError, OSError) as error:
        raise ValueError(f"{key}: {error}") from error


def _medium(key: str, table: InclusionTable, base: Path, notes: list[str]) -> Medium:
    boundary = None
    if table.shape is not None:
        shape = table.shape if isinstance(table.shape, ShapeOfMedium) else ShapeOfMedium(mesh=table.shape)
        triangles = _load_mesh(f"{key}.shape", shape.mesh, shape.transform, base)
        boundary, boundary_notes = meshes.boundary(f"{key}.shape", triangles)
        notes += boundary_notes
    density, bounds, scale = _density(key, table, base)
    if table.bounds is not None:
        bounds = table.bounds
    if bounds is None:  # a homogeneous medium in a mesh: a little larger, so that the mesh alone bounds it
        corners = np.asarray(boundary.vertices, np.float64)
        margin = 1e-3 * np.ptp(corners, axis=0).max()
        bounds = (corners.min(axis=0) - margin, corners.max(axis=0) + margin)
    table_of_moments = None if table.phase is None else _phase(f"{key}.phase", table.phase, base)
    g = (table.anisotropy or 0.0) if table_of_moments is None else _mean_cosine(table_of_moments)
    inclusions = table.inclusions if isinstance(table, MediumTable) else ()
    sigma_s = _sigma(f"{key}.scattering", table.scattering, scale)
    sigma_a = _sigma(f"{key}.absorption", table.absorption, scale)
    return Medium(
        bounds=jnp.asarray(np.asarray(bounds), jnp.float32),
        sigma_s=sigma_s,
        sigma_a=sigma_a,
        g=jnp.float32(g),
        density=None if density is None else jnp.asarray(density),
        majorants=None if density is None else _majorants(density, np.asarray(bounds), np.asarray(sigma_s + sigma_a)),
        phase=table_of_moments,
        ior=_refractive_index(f"{key}.refractive_index", table.refractive_index, base),
        boundary=boundary,
        inclusions=tuple(_medium(f"{key}.inclusions.{i}", t, base, notes) for i, t in enumerate(inclusions)),
    )


def _majorants(density, bounds, sigma_t):
    voxel_size = float(np.min((bounds[1] - bounds[0]) / density.shape))
    return media.majorants(density, block=media.majorant_block(density, sigma_t=float(sigma_t.max()), voxel_size=voxel_size))


def _sigma(key: str, value: Sequence[float], scale: float):
    """Coefficients with a homogeneous density multiplied in."""
    sigma = np.asarray(value, np.float64) * scale
    if sigma.max() > 1e30:
        raise ValueError(f"{key} times density = {sigma.max():g} must be at most 1e30")
    return jnp.asarray(sigma, jnp.float32)


def _density(key: str, table: InclusionTable, base: Path) -> tuple[np.ndarray | None, Any, float]:
    """Grid and bounds of a density, or None, None and its one value when it is homogeneous."""
    value, name = table.density, f"{key}.density"
    if isinstance(value, float):
        return None, None, value
    if isinstance(value, str):
        try:
            if value.startswith("builtin:"):
                options = {k: v for k in ("resolution", "seed") if (v := getattr(table, k)) is not None}
                volume = volumes.procedural(value.removeprefix("builtin:"), **options)
            else:
                volume = _read_volume(base / value)
        except (ValueError, OSError) as error:
            raise ValueError(f"{name}: {error}") from error
        return _grid(name, volume.density, 0.0), volume.bounds, 1.0
    if table.bounds is None and table.shape is None:
        raise ValueError(f"{key}.bounds is missing: a density array needs bounds")
    return _grid(name, value, 0.0), None, 1.0


def _read_volume(path: Path) -> Any:
    if path.suffix.lower() not in MEDIUM_FILES:
        raise ValueError(f"{path} is no volume format that is read here ({', '.join(MEDIUM_FILES)})")
    if not path.is_file():
        raise ValueError(f"file {path} does not exist")
    return volumes.read_volume(path)


def _grid(name: str, values: Any, low: float) -> np.ndarray:
    """A checked float32 grid [x, y, z]."""
    grid = np.asarray(values)
    if grid.ndim != 3 or 0 in grid.shape:
        raise ValueError(f"{name}: a grid must have three axes, none of length 0; its shape is {list(grid.shape)}")
    if grid.dtype.kind not in "fiu":
        raise ValueError(f"{name}: a grid must hold numbers, not {grid.dtype}")
    num_bad = int(np.count_nonzero(~(np.isfinite(grid) & (np.abs(grid) <= 1e30))))
    if num_bad:
        raise ValueError(f"{name}: {num_bad} of {grid.size} values are not finite (or beyond 1e30)")
    if grid.min() < low:
        num_low = np.count_nonzero(grid < low)
        raise ValueError(f"{name}: {num_low} of {grid.size} values are below {low:g}; the least is {grid.min():g}")
    return grid.astype(np.float32)


def _refractive_index(key: str, value: Any, base: Path):
    if value is None or (isinstance(value, float) and value == 1.0):
        return None
    if isinstance(value, float):
        return jnp.float32(value)
    try:
        values = _read_volume(base / value).density if isinstance(value, str) else value
    except (ValueError, OSError) as error:
        raise ValueError(f"{key}: {error}") from error
    grid = _grid(key, values, 0.1)
    if grid.max() > 10.0:
        raise ValueError(f"{key}: {np.count_nonzero(grid > 10)} of {grid.size} values are above 10")
    return jnp.asarray(grid)


def _mean_cosine(table: Any) -> float:
    return float(table.moments[1]) if table.moments.shape[0] > 1 else 0.0


def _phase(key: str, value: Any, base: Path):
    try:
        return phase.phase_table(read_moments(base / value) if isinstance(value, str) else value)
    except (ValueError, OSError) as error:
        raise ValueError(f"{key}: {error}") from error


def read_moments(path: Path) -> np.ndarray:
    """Legendre moments chi_0 = 1, chi_1 = g, ... from .npz (array `moments`), .json (a list, or under `moments`) or text.

    Raises ValueError for a missing, broken or unsupported file.
    """
    if not path.is_file():
        raise ValueError(f"file {path} does not exist")
    try:
        match path.suffix.lower():
            case ".npz":
                with np.load(path) as arrays:
                    if "moments" not in arrays:
                        raise ValueError(f"has no array 'moments', only {', '.join(arrays) or 'nothing'}")
                    moments = arrays["moments"]
            case ".json":
                data = json.loads(path.read_text())
                moments = data["moments"] if isinstance(data, dict) and "moments" in data else data
            case ".txt":
                moments = [float(word) for word in path.read_text().replace(",", " ").split()]
            case _:
                raise ValueError("a file of moments must be .npz, .json or .txt")
        return np.asarray(moments, np.float64)
    except (ValueError, TypeError, EOFError, OSError, zipfile.BadZipFile) as error:
        raise ValueError(f"{path} holds no Legendre moments: {error}") from error


def _lights(table: SceneTable, base: Path, notes: list[str]) -> dict[str, Any]:
    """The fields of `Scene` for every kind of light but emissive triangles; None for what there is not."""

    def stack(kind: str, key: str):
        values = [getattr(light, key) for light in table.lights if light.kind == kind]
        return jnp.asarray(np.asarray(values), jnp.float32)

    def unit(kind: str):
        directions = np.array([light.direction for light in table.lights if light.kind == kind])
        return jnp.asarray(directions / np.linalg.norm(directions, axis=1, keepdims=True), jnp.float32)

    kinds, found = {light.kind for light in table.lights}, {}
    if "point" in kinds:
        found["point_lights"] = PointLights(position=stack("point", "position"), intensity=stack("point", "intensity"))
    if "spot" in kinds:
        spots = [light for light in table.lights if light.kind == "spot"]
        falloff = [0.75 * spot.angle if spot.falloff is None else spot.falloff for spot in spots]
        found["spot_lights"] = SpotLights(
            position=stack("spot", "position"),
            direction=unit("spot"),
            intensity=stack("spot", "intensity"),
            cutoff=jnp.asarray(np.radians([spot.angle for spot in spots]), jnp.float32),
            falloff=jnp.asarray(np.radians(falloff), jnp.float32),
        )
    if "directional" in kinds:
        found["directional_lights"] = DirectionalLights(
            direction=unit("directional"), irradiance=stack("directional", "irradiance")
        )
    for index, light in enumerate(table.lights):
        if light.kind == "environment":
            found["environment"] = _environment(f"lights.{index}", light, base, notes)
    return found


def _environment(key: str, light: Any, base: Path, notes: list[str]):
    if light.file is None:
        radiance = np.asarray(light.radiance).reshape(1, 1, 3)
    else:
        path = base / light.file
        if not path.is_file():
            raise ValueError(f"{key}.file: file {path} does not exist")
        try:
            radiance, num_negative = image.read_environment(path)
        except (ValueError, OSError) as error:
            raise ValueError(f"{key}.file: {error}") from error
        if num_negative:
            notes.append(f"{key}.file: {num_negative} of {radiance.size} values are negative and count as 0")
    radiance = np.asarray(radiance, np.float64) * np.asarray(light.scale)
    if radiance.max() > 1e30:
        raise ValueError(f"{key}: radiance times scale = {radiance.max():g} must be at most 1e30")
    return lights.environment_light(radiance, rotation_degrees=light.rotation)
