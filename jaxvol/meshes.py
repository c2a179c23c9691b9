"""Shapes of a scene: builtin meshes, transforms, one merged `Mesh`, and the watertightness that a medium's shape needs."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import trimesh

from jaxvol.mesh_files import LARGEST_LENGTH, Triangles, merge, read_mesh
from jaxvol.types import Mesh

BUILTINS = ("cornell_box", "plane", "sphere", "box")
DEFAULT_REFLECTANCE = 0.5


def builtin(name: str) -> Triangles:
    """A builtin mesh, y up: plane [-1, 1]^2 at y = 0 facing up, sphere of radius 1, box [-1, 1]^3, cornell_box of side 2.

    Raises ValueError for an unknown name. The sphere is an icosphere of 20,480 triangles, 0.1 % short of the volume.
    """
    if name == "plane":
        return _quad((-1, 0, -1), (-1, 0, 1), (1, 0, 1), (1, 0, -1))
    if name == "box":
        mesh = trimesh.creation.box(extents=(2.0, 2.0, 2.0))
        return Triangles(np.array(mesh.vertices), np.array(mesh.faces))
    if name == "sphere":
        mesh = trimesh.creation.icosphere(subdivisions=5, radius=1.0)
        return Triangles(np.array(mesh.vertices), np.array(mesh.faces))
    if name == "cornell_box":
        return _cornell_box()
    raise ValueError(f"builtin:{name} is unknown; there are {', '.join('builtin:' + known for known in BUILTINS)}")


def _quad(a, b, c, d, *, albedo=None, emission=None) -> Triangles:
    """A parallelogram whose front is where its corners run counter-clockwise."""

    def colour(value):
        return None if value is None else np.tile(np.asarray(value, np.float64), (2, 1))

    faces = np.array([[0, 1, 2], [0, 2, 3]])
    return Triangles(np.array([a, b, c, d], np.float64), faces, colour(albedo), colour(emission))


def _block(centre: tuple[float, float], width: float, height: float, degrees: float, albedo) -> Triangles:
    """A box that stands on the floor y = 0, turned about y."""
    mesh = trimesh.creation.box(extents=(width, height, width))
    turn = trimesh.transformations.rotation_matrix(np.radians(degrees), (0, 1, 0))
    vertices = trimesh.transform_points(mesh.vertices, turn) + (centre[0], height / 2, centre[1])
    return Triangles(vertices, np.array(mesh.faces), np.tile(np.asarray(albedo, np.float64), (12, 1)))


def _cornell_box() -> Triangles:
    """A box [-1, 1] x [0, 2] x [-1, 1] open toward +z: red left, green right, two blocks, a lamp that shines down."""
    white, red, green = (0.725, 0.71, 0.68), (0.63, 0.065, 0.05), (0.14, 0.45, 0.091)
    lamp = (-0.25, 1.98, -0.2), (0.25, 1.98, -0.2), (0.25, 1.98, 0.2), (-0.25, 1.98, 0.2)
    return merge(
        [
            _quad((-1, 0, 1), (1, 0, 1), (1, 0, -1), (-1, 0, -1), albedo=white),  # floor
            _quad((-1, 2, -1), (1, 2, -1), (1, 2, 1), (-1, 2, 1), albedo=white),  # ceiling
            _quad((-1, 0, -1), (1, 0, -1), (1, 2, -1), (-1, 2, -1), albedo=white),  # back
            _quad((-1, 0, 1), (-1, 0, -1), (-1, 2, -1), (-1, 2, 1), albedo=red),  # left
            _quad((1, 0, -1), (1, 0, 1), (1, 2, 1), (1, 2, -1), albedo=green),  # right
            _block((-0.33, -0.3), 0.6, 1.2, 17.0, white),
            _block((0.33, 0.38), 0.6, 0.6, -17.0, white),
            _quad(*lamp, albedo=white, emission=(17, 12, 4)),
        ]
    )


def load(mesh: object, *, base: Path) -> Triangles:
    """A file (relative to `base`), a `builtin:` name, a `trimesh.Trimesh` or a pair (vertices, faces) as triangles.

    Raises ValueError for what is missing, broken or not a triangle mesh.
    """
    if isinstance(mesh, str):
        return builtin(mesh.removeprefix("builtin:")) if mesh.startswith("builtin:") else read_mesh(base / mesh)
    vertices, faces = (mesh.vertices, mesh.faces) if isinstance(mesh, trimesh.Trimesh) else mesh
    vertices, faces = np.asarray(vertices, np.float64), np.asarray(faces)
    if vertices.ndim != 2 or vertices.shape[1:] != (3,) or faces.ndim != 2 or faces.shape[1:] != (3,):
        raise ValueError(f"needs vertices [V, 3] and faces [F, 3], not {list(vertices.shape)} and {list(faces.shape)}")
    if not np.issubdtype(faces.dtype, np.integer) or not len(faces) or faces.min() < 0 or faces.max() >= len(vertices):
        raise ValueError(f"faces must be vertex numbers in [0, {len(vertices) - 1}]")
    if not (np.abs(vertices) <= LARGEST_LENGTH).all():
        raise ValueError(f"vertices must be finite and at most {LARGEST_LENGTH:g}")
    return Triangles(vertices, faces.astype(np.int64))


def transform(
    triangles: Triangles,
    *,
    scale: Sequence[float] = (1.0, 1.0, 1.0),
    rotate: Sequence[float] = (0.0, 1.0, 0.0, 0.0),
    translate: Sequence[float] = (0.0, 0.0, 0.0),
) -> Triangles:
    """Scale, then rotate by (axis x, y, z, degrees), then translate. A mirroring scale keeps the front sides in front.

    Raises ValueError where float32 could not hold squared distances any more.
    """
    turn = trimesh.transformations.rotation_matrix(np.radians(rotate[3]), rotate[:3])[:3, :3]
    vertices = (triangles.vertices * np.asarray(scale)) @ turn.T + np.asarray(translate)
    if not (np.abs(vertices) <= LARGEST_LENGTH).all():
        raise ValueError(f"transform takes vertices beyond {LARGEST_LENGTH:g}")
    moved = replace(triangles, vertices=vertices)
    return flip_normals(moved) if np.prod(np.sign(scale)) < 0 else moved


def flip_normals(triangles: Triangles) -> Triangles:
    """The same triangles with their fronts as backs: every corner order reversed."""
    return replace(triangles, faces=triangles.faces[:, ::-1])


def zero_area(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Which triangles have no area in float32: flatter than the rounding of their corners' coordinates."""
    corners = np.asarray(vertices, np.float32)[faces].astype(np.float64)
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    twice_area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    longest = np.sqrt(np.max([((x - y) * (x - y)).sum(axis=1) for x, y in ((a, b), (b, c), (c, a))], axis=0))
    return twice_area <= 1e-9 * longest * longest


def build_mesh(shapes: Sequence[tuple[str, Triangles, dict]]) -> tuple[Mesh | None, list[str]]:
    """One `Mesh` from (key, triangles, material) and notes on what was dropped; None when there are no triangles.

    `material` has `reflectance`, `emission`, `specular` (RGB or None) and `exponent`; None keeps the file's colours
    (reflectance 0.5 where it has none). Raises ValueError where albedo + specular exceeds 1.
    """
    parts, notes = [], []
    for key, triangles, material in shapes:
        notes += triangles.notes
        keep = ~zero_area(triangles.vertices, triangles.faces)
        if not keep.all():
            notes.append(f"{key}: {np.count_nonzero(~keep)} of {len(keep)} triangles have no area and are left out")
        if keep.any():
            parts.append(_with_material(key, triangles, keep, material))
    if not parts:
        return None, notes
    offsets = np.cumsum([0] + [len(part["vertices"]) for part in parts[:-1]])
    faces = np.concatenate([part["faces"] + offset for part, offset in zip(parts, offsets, strict=True)])

    def joined(name: str) -> np.ndarray:
        return np.concatenate([part[name] for part in parts])

    emission, specular = joined("emission"), joined("specular")
    shiny = bool(specular.any())
    mesh = Mesh(
        vertices=_float32(joined("vertices")),
        faces=jnp.asarray(faces, jnp.int32),
        albedo=_float32(joined("albedo")),
        emission=_float32(emission) if emission.any() else None,
        specular=_float32(specular) if shiny else None,
        exponent=_float32(joined("exponent")) if shiny else None,
    )
    return mesh, notes


def _float32(array: np.ndarray):
    return jnp.asarray(array, jnp.float32)


def _with_material(key: str, triangles: Triangles, keep: np.ndarray, material: dict) -> dict[str, np.ndarray]:
    faces = triangles.faces[keep]

    def per_face(value, from_file: np.ndarray | None, default: float) -> np.ndarray:
        if value is None and from_file is not None:
            return from_file[keep]
        return np.broadcast_to(np.asarray(default if value is None else value, np.float64), (len(faces), 3))

    albedo = per_face(material.get("reflectance"), triangles.albedo, DEFAULT_REFLECTANCE)
    specular = per_face(material.get("specular"), None, 0.0)
    total = (albedo + specular).max()
    if total > 1.0 + 1e-6:
        raise ValueError(f"{key}: reflectance + specular = {total:.4g} must be in [0, 1] in every channel")
    return {
        "vertices": triangles.vertices,
        "faces": faces,
        "albedo": albedo,
        "emission": per_face(material.get("emission"), triangles.emission, 0.0),
        "specular": specular,
        "exponent": np.full(len(faces), float(material.get("exponent") or 0.0)),
    }


def open_edges(vertices: np.ndarray, faces: np.ndarray) -> int:
    """How many edges have an odd number of faces, equal positions counted as one vertex: 0 for a watertight mesh."""
    _, merged = np.unique(np.asarray(vertices, np.float32), axis=0, return_inverse=True)
    welded = merged.reshape(-1)[faces]
    edges = np.sort(np.concatenate([welded[:, [0, 1]], welded[:, [1, 2]], welded[:, [2, 0]]]), axis=1)
    edges = edges[edges[:, 0] != edges[:, 1]]
    _, counts = np.unique(edges, axis=0, return_counts=True)
    return int(np.count_nonzero(counts % 2))


def boundary(key: str, triangles: Triangles) -> tuple[Mesh, list[str]]:
    """The closed surface of a medium, wound so that its normals point outwards, and notes.

    Raises ValueError, naming the number of open edges, when it is not watertight.
    """
    num_open = open_edges(triangles.vertices, triangles.faces)
    if num_open:
        raise ValueError(f"{key}: the mesh is not watertight ({num_open} open edges); a medium needs a closed one")
    notes, faces = list(triangles.notes), triangles.faces
    corners = (triangles.vertices - triangles.vertices.mean(axis=0))[faces]
    volume = np.einsum("ij,ij->i", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])).sum() / 6.0
    extent = np.ptp(triangles.vertices, axis=0).max()
    if abs(volume) <= 1e-9 * extent * extent * extent:
        raise ValueError(f"{key}: the mesh encloses no volume")
    if volume < 0:
        faces = faces[:, ::-1]
        notes.append(f"{key}: the triangles face inwards; turned round")
    faces = faces[~zero_area(triangles.vertices, faces)]
    black = jnp.zeros((len(faces), 3), jnp.float32)
    return Mesh(vertices=_float32(triangles.vertices), faces=jnp.asarray(faces, jnp.int32), albedo=black), notes
