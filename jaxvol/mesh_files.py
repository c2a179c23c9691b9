"""Mesh files (PLY, OBJ with MTL, STL, glTF/GLB) to triangles with linear diffuse colours and emission per face.

trimesh reads the files; what it gets silently wrong is set right here: OBJ lines with tabs or relative indices, exact MTL
and glTF colours and emission, node transforms, Draco without a decoder. Conventions: MTL and glTF factors and glTF vertex
colours are linear; textures, PLY and OBJ vertex colours are sRGB; a texture becomes one mean colour per face.
"""

import importlib.util
import io
import json
import logging
import struct
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import trimesh
from trimesh.visual.texture import TextureVisuals

FORMATS = (".ply", ".obj", ".stl", ".glb", ".gltf")
LARGEST_LENGTH = 1e15  # squared distances stay finite in float32
# What parsers raise on bytes that are not what they expect.
MALFORMED = (
    ValueError,
    LookupError,
    TypeError,
    AttributeError,
    EOFError,
    struct.error,
    NotImplementedError,
    AssertionError,
    MemoryError,
    RecursionError,
    OverflowError,
    ZeroDivisionError,
    ImportError,  # trimesh looks for packages that guess the encoding of broken text
)


@dataclass(frozen=True)
class Triangles:
    """Triangles in float64; colours are linear and per face, None where the source has none."""

    vertices: np.ndarray  # V 3
    faces: np.ndarray  # F 3
    albedo: np.ndarray | None = None  # F 3
    emission: np.ndarray | None = None  # F 3
    notes: tuple[str, ...] = ()  # what the reader had to leave out


def read_mesh(path: Path) -> Triangles:
    """All triangles of a mesh file in world space. Raises ValueError for a missing, broken or unsupported file."""
    suffix = path.suffix.lower()
    if suffix not in FORMATS:
        raise ValueError(f"{path} is no mesh format that is read here ({', '.join(FORMATS)})")
    if not path.is_file():
        raise ValueError(f"file {path} does not exist")
    data, notes = path.read_bytes(), []
    if not data:
        raise ValueError(f"{path} is empty")
    if suffix == ".obj":
        data, notes = _obj_for_trimesh(data, path)
    if suffix == ".stl":
        _check_stl(data, path)
    least = _num_ply_faces(data, path) if suffix == ".ply" else 1
    materials = _gltf_materials(data, path) if suffix in (".glb", ".gltf") else {}
    log = logging.getLogger("trimesh")
    level, log.level = log.level, logging.CRITICAL  # its warnings on broken files print tracebacks; the error below says it
    try:
        loaded = trimesh.load_scene(
            io.BytesIO(data), file_type=suffix[1:], resolver=trimesh.resolvers.FilePathResolver(str(path)), process=False
        )
        parts = list(_parts(loaded, materials, suffix))
    except MALFORMED as error:
        raise ValueError(f"{path} cannot be read as {suffix[1:].upper()}: {_one_line(error)}") from error
    finally:
        log.level = level
    if not parts:
        raise ValueError(f"{path} holds no triangles")
    merged = merge(parts)
    if len(merged.faces) < least:
        raise ValueError(f"{path} is truncated: {len(merged.faces)} of {least} faces")
    _check(merged, path)
    return replace(merged, notes=tuple(notes))


def merge(parts: list[Triangles]) -> Triangles:
    """One set of triangles; where only some parts have colours, the others get 0.5 reflectance or no emission."""
    offsets = np.cumsum([0] + [len(part.vertices) for part in parts[:-1]])

    def colours(name: str, default: float) -> np.ndarray | None:
        if all(getattr(part, name) is None for part in parts):
            return None
        arrays = (getattr(part, name) for part in parts)
        return np.concatenate(
            [np.full((len(p.faces), 3), default) if a is None else a for p, a in zip(parts, arrays, strict=True)]
        )

    return Triangles(
        vertices=np.concatenate([part.vertices for part in parts]),
        faces=np.concatenate([part.faces + offset for part, offset in zip(parts, offsets, strict=True)]),
        albedo=colours("albedo", 0.5),
        emission=colours("emission", 0.0),
        notes=tuple(note for part in parts for note in part.notes),
    )


def linear_from_srgb(value: np.ndarray) -> np.ndarray:
    """The sRGB transfer function (IEC 61966-2-1), from encoded [0, 1] to linear."""
    return np.where(value <= 0.04045, value / 12.92, np.power((np.maximum(value, 0.0) + 0.055) / 1.055, 2.4))


def _one_line(error: BaseException) -> str:
    return (" ".join(str(error).split()) or type(error).__name__)[:160]


def _check(triangles: Triangles, path: Path) -> None:
    count = len(triangles.vertices)
    if not len(triangles.faces):
        raise ValueError(f"{path} holds no triangles")
    if triangles.faces.min() < 0 or triangles.faces.max() >= count:
        raise ValueError(f"{path}: a face names vertex {triangles.faces.max() + 1} of {count}")
    bad = np.count_nonzero(~(np.abs(triangles.vertices) <= LARGEST_LENGTH).all(axis=1))
    if bad:
        raise ValueError(f"{path}: {bad} of {count} vertices are not finite or beyond {LARGEST_LENGTH:g}")
    for name in ("albedo", "emission"):
        colour = getattr(triangles, name)
        if colour is not None and not (np.isfinite(colour) & (colour >= 0)).all():
            raise ValueError(f"{path}: its materials have an {name} that is negative or not finite")


def _parts(scene: trimesh.Scene, materials: dict[str, dict], suffix: str) -> Iterator[Triangles]:
    for node in scene.graph.nodes_geometry:  # every placement of every mesh; scene.geometry would lose the transforms
        transform, name = scene.graph[node]
        mesh = scene.geometry[name]
        if not isinstance(mesh, trimesh.Trimesh) or not len(mesh.faces):
            continue
        vertices = trimesh.transform_points(np.asarray(mesh.vertices, np.float64), transform)
        faces = np.array(mesh.faces, np.int64)
        albedo, emission = _colours(mesh, faces, materials, suffix)
        if np.linalg.det(transform[:3, :3]) < 0:  # a mirror turns the winding round
            faces = faces[:, ::-1]
        yield Triangles(vertices, faces, albedo, emission)


def _colours(mesh, faces, materials, suffix) -> tuple[np.ndarray | None, np.ndarray | None]:
    """Albedo and emission per face of one trimesh mesh."""
    visual, count = mesh.visual, len(faces)
    if isinstance(visual, TextureVisuals):
        material = visual.material
        exact = materials.get(getattr(material, "name", None), {})
        if suffix in (".glb", ".gltf"):
            factor, emission = exact.get("albedo"), exact.get("emission")
            image = getattr(material, "baseColorTexture", None)
            if factor is None and getattr(material, "baseColorFactor", None) is not None:
                factor = np.asarray(material.baseColorFactor, np.float64)[:3] / 255.0
            if emission is None and getattr(material, "emissiveFactor", None) is not None:
                emission = np.asarray(material.emissiveFactor, np.float64)
        else:
            known = getattr(material, "kwargs", {}) or {}
            factor, emission = (_floats(known.get(key)) for key in ("kd", "ke"))
            image = getattr(material, "image", None)
        if image is not None and visual.uv is not None:
            texture = _texture_per_face(image, np.asarray(visual.uv), faces)
            # MTL files often say Kd 0 beside a texture and mean the texture alone.
            factor = texture if factor is None or not np.any(factor) else texture * factor
        albedo = None if factor is None else np.broadcast_to(np.clip(factor, 0.0, 1.0), (count, 3))
        emission = None if emission is None or not np.any(emission) else np.broadcast_to(emission, (count, 3))
        return albedo, emission
    if visual.kind not in ("vertex", "face"):
        return None, None
    colour = np.asarray(visual.vertex_colors if visual.kind == "vertex" else visual.face_colors, np.float64)[:, :3] / 255.0
    colour = colour if suffix in (".glb", ".gltf") else linear_from_srgb(colour)
    return (colour[faces].mean(axis=1) if visual.kind == "vertex" else colour), None


def _floats(value) -> np.ndarray | None:
    """Three floats of an MTL value (trimesh keeps some as strings); one stands for three."""
    if value is None:
        return None
    numbers = np.atleast_1d(np.asarray(value, np.float64))
    return np.broadcast_to(numbers, 3) if len(numbers) in (1, 3) else None


def _texture_per_face(image, uv: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """The mean linear colour of each face: the texture at ten points spread over the triangle, repeated beyond its edges."""
    pixels = linear_from_srgb(np.asarray(image.convert("RGB"), np.float64) / 255.0)
    height, width = pixels.shape[:2]
    corners = uv[faces]
    total = np.zeros((len(faces), 3))
    steps = [(i, j, 3 - i - j) for i in range(4) for j in range(4 - i)]
    for weights in steps:
        inside = (np.asarray(weights) + 0.1) / 3.3  # a little inside, so that no point falls on a seam
        u, v = np.tensordot(inside, corners, axes=(0, 1)).T
        column = np.clip((u % 1.0 * width).astype(int), 0, width - 1)
        row = np.clip(((1.0 - v % 1.0) * height).astype(int), 0, height - 1)
        total += pixels[row, column]
    return total / len(steps)


def _obj_for_trimesh(data: bytes, path: Path) -> tuple[bytes, list[str]]:
    """OBJ text with plain spaces, absolute indices and triangles only; and notes on missing material files and textures."""
    text = data.decode("utf-8", errors="replace").replace("\\\r\n", " ").replace("\\\n", " ")
    counts, lines, notes = [0, 0, 0], [], []
    kinds = {"v": 0, "vt": 1, "vn": 2}
    for line_number, line in enumerate(text.splitlines(), start=1):
        words = line.split("#", 1)[0].split()
        if not words:
            continue
        if words[0] in kinds:
            counts[kinds[words[0]]] += 1
        if words[0] == "f":
            try:
                corners = [_absolute(word, counts) for word in words[1:]]
            except ValueError as error:
                raise ValueError(f"{path}, line {line_number}: {error}") from error
            lines += [f"f {corners[0]} {b} {c}" for b, c in zip(corners[1:-1], corners[2:], strict=True)]
            continue
        if words[0] == "mtllib":
            notes += _missing_materials(path, " ".join(words[1:]))
        lines.append(" ".join(words))
    if not any(line.startswith("f ") for line in lines):
        raise ValueError(f"{path} holds no triangles")
    return "\n".join(lines).encode(), notes


def _absolute(corner: str, counts: list[int]) -> str:
    """`vertex/texture/normal` with indices from 1: a negative index counts back from the latest element."""
    parts = []
    for word, count in zip(corner.split("/"), counts, strict=False):
        if not word:
            parts.append("")
            continue
        index = int(word)
        index = count + 1 + index if index < 0 else index
        if not 1 <= index <= count:
            raise ValueError(f"index {word} is outside the {count} elements so far")
        parts.append(str(index))
    return "/".join(parts)


def _missing_materials(path: Path, name: str) -> list[str]:
    file = path.parent / name
    if not file.is_file():
        return [f"{path.name}: material file {file} does not exist; its colours are left out"]
    notes = []
    for line in file.read_text(errors="replace").splitlines():
        words = line.split()
        if words and words[0].lower() == "map_kd" and not (path.parent / words[-1]).is_file():
            notes.append(f"{path.name}: texture {path.parent / words[-1]} does not exist; the plain colour is used")
    return notes


def _check_stl(data: bytes, path: Path) -> None:
    """A binary STL is exactly as long as its triangle count says."""
    if data[:5].lower() == b"solid" and b"facet" in data[:1024]:
        if not data.isascii() or b"endsolid" not in data[-1024:]:
            raise ValueError(f"{path} is a text STL file that is truncated or damaged")
        return
    said = 84 + 50 * struct.unpack("<I", data[80:84])[0] if len(data) >= 84 else None
    if said != len(data):
        raise ValueError(f"{path} is truncated or no STL file ({len(data)} bytes, {said} expected)")


def _num_ply_faces(data: bytes, path: Path) -> int:
    """The number of faces that the header claims; no list may claim more entries than the file has bytes."""
    end = data.find(b"end_header")
    if data[:3] != b"ply" or end < 0:
        raise ValueError(f"{path} is no PLY file (its header is missing or cut off)")
    counts = {}
    for line in data[:end].decode("ascii", errors="replace").splitlines():
        words = line.split()
        if words[:1] != ["element"]:
            continue
        if len(words) != 3 or not words[2].isdigit() or int(words[2]) > len(data):
            raise ValueError(f"{path}: the header claims '{line}' in a file of {len(data)} bytes")
        counts[words[1]] = int(words[2])
    return counts.get("face", 0)


def _gltf_materials(data: bytes, path: Path) -> dict[str, dict]:
    """Exact linear colours by material name (trimesh rounds them to 8 bits). Raises ValueError for undecodable geometry."""
    try:
        if path.suffix.lower() == ".glb":
            magic, _, length, chunk, kind = struct.unpack("<4sIII4s", data[:20])
            if magic != b"glTF" or kind != b"JSON" or length > len(data):
                raise ValueError(f"its header is wrong or it is truncated ({len(data)} of {length} bytes)")
            header = json.loads(data[20 : 20 + chunk])
        else:
            header = json.loads(data)
        extensions = set(header.get("extensionsUsed", ())) | set(header.get("extensionsRequired", ()))
        found: dict[str, dict] = {}
        for material in header.get("materials", ()):
            name = material.get("name")
            if name is None or name in found:  # nameless or ambiguous: trimesh's rounded values must do
                found.pop(name, None)
                continue
            factor = material.get("pbrMetallicRoughness", {}).get("baseColorFactor", (1.0, 1.0, 1.0, 1.0))
            strength = material.get("extensions", {}).get("KHR_materials_emissive_strength", {}).get("emissiveStrength", 1.0)
            emission = np.asarray(material.get("emissiveFactor", (0.0, 0.0, 0.0)), np.float64) * strength
            found[name] = {"albedo": np.asarray(factor[:3], np.float64), "emission": emission}
    except (*MALFORMED, UnicodeDecodeError) as error:
        raise ValueError(f"{path} cannot be read as glTF: {_one_line(error)}") from error
    for extension, decoder in (("KHR_draco_mesh_compression", "DracoPy"), ("EXT_meshopt_compression", "")):
        if extension in extensions and not (decoder and importlib.util.find_spec(decoder)):
            hint = f"install {decoder} or export without compression" if decoder else "export without compression"
            raise ValueError(f"{path} is compressed ({extension}), which cannot be read here; {hint}")
    return found
