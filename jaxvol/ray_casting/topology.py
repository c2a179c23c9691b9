"""Facts about a mesh's connectivity that need the host: open edges, connected bodies, which way is out."""

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components


def outward_normals(triangles: np.ndarray) -> np.ndarray:
    """Face normals [F, 3] (length = twice the area), turned so that a closed mesh's enclosed volume is positive.

    Consistent winding is assumed; an inside-out closed mesh is turned as a whole.
    """
    corner = triangles[:, 0].astype(np.float64)
    normals = np.cross(triangles[:, 1] - corner, triangles[:, 2] - corner)
    volume = np.sum(normals * (corner - corner.mean(0)))
    return np.asarray(normals if volume >= 0.0 else -normals, np.float32)


def welded_faces(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Faces whose vertices are numbered by position, so that vertices at the same place are one."""
    _, index = np.unique(np.asarray(vertices, np.float32) + 0.0, axis=0, return_inverse=True)
    return index.reshape(-1)[faces]


def num_bodies(vertices: np.ndarray, faces: np.ndarray) -> int:
    """Connected components of the mesh, vertices at the same place counting as one."""
    return _bodies(welded_faces(vertices, faces))[0]


def num_inward_bodies(vertices: np.ndarray, faces: np.ndarray) -> int:
    """Connected closed components whose fronts face inward: their signed volume is negative."""
    welded = welded_faces(vertices, faces)
    proper = _three_corners(welded)
    if not proper.any():
        return 0
    num, body = _bodies(welded[proper])
    edge, sign = _edges(welded[proper])
    unpaired = np.bincount(edge, weights=sign) != 0
    num_open = np.bincount(np.tile(body, 3), weights=unpaired[edge], minlength=num)
    corners = np.asarray(vertices, np.float64)[faces[proper]]
    first = np.unique(body, return_index=True)[1]  # volumes are summed about a corner of their own body
    a, b, c = np.moveaxis(corners - corners[first, 0][body][:, None], 1, 0)
    volume = np.bincount(body, weights=np.sum(a * np.cross(b, c), axis=1), minlength=num)
    return int(np.count_nonzero((num_open == 0) & (volume < 0)))


def num_open_edges(vertices: np.ndarray, faces: np.ndarray) -> int:
    """Edges that an odd number of faces share, or that faces with contradicting windings share; 0 = closed.

    Faces without area (two corners at the same place) are left out.
    """
    welded = welded_faces(vertices, faces)
    edge, sign = _edges(welded[_three_corners(welded)])
    return int(np.count_nonzero(np.bincount(edge, weights=sign)))


def _three_corners(faces):
    """Which faces have three different corners."""
    a, b, c = faces.T
    return (a != b) & (b != c) & (c != a)


def _bodies(faces):
    """How many connected components there are, and the one of each face."""
    ends = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]]])
    used, ends = np.unique(ends, return_inverse=True)
    ends = ends.reshape(-1, 2)
    graph = coo_array((np.ones(len(ends), np.int8), (ends[:, 0], ends[:, 1])), shape=(len(used), len(used)))
    num, label = connected_components(graph, directed=False)
    return int(num), label[ends[: len(faces), 0]]


def _edges(faces):
    """Number of the edge behind each corner, all first ones, then the second and third ones, and the way it is run along."""
    ends = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]).astype(np.int64)
    sign = np.where(ends[:, 0] < ends[:, 1], 1, -1)
    key = ends.min(1) * (faces.max(initial=0) + 1) + ends.max(1)
    return np.unique(key, return_inverse=True)[1].reshape(-1), sign
