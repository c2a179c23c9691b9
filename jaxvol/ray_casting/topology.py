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
    faces = welded_faces(vertices, faces)
    num_vertices = faces.max() + 1
    ends = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]]])
    graph = coo_array((np.ones(len(ends), np.int8), (ends[:, 0], ends[:, 1])), shape=(num_vertices, num_vertices))
    return int(connected_components(graph, directed=False)[0])


def num_open_edges(vertices: np.ndarray, faces: np.ndarray) -> int:
    """Edges that an odd number of faces share, or that faces with contradicting windings share; 0 = closed.

    Faces without area (two corners at the same place) are left out.
    """
    faces = welded_faces(vertices, faces)
    a, b, c = faces.T
    faces = faces[(a != b) & (b != c) & (c != a)]
    ends = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]).astype(np.int64)
    sign = np.where(ends[:, 0] < ends[:, 1], 1, -1)
    key = ends.min(1) * (faces.max(initial=0) + 1) + ends.max(1)
    _, edge = np.unique(key, return_inverse=True)
    return int(np.count_nonzero(np.bincount(edge, weights=sign)))
