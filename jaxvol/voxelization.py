"""Watertight mesh -> occupancy grid; any mesh -> the voxels that its surface touches.

Columns of sub-voxels run along z. Where a column's line meets the triangles is found by rasterising every triangle in
the xy plane, all at once in numpy; between an entry and an exit the column is full, with exact coverage of each voxel
along z. So the error is that of sampling the mesh's silhouette at `supersampling`^2 points per voxel face.

A line through an edge shared by two triangles is given to one of them by a fill rule, as in rasterisers, on numbers
that both compute alike (float64, columns shifted by an odd tiny fraction of a voxel), so that entries and exits add
up. In a column where they do not, only an exit that follows an entry ends an interval.
"""

import numpy as np
from jaxtyping import ArrayLike, Bool, Float

from jaxvol.ray_casting.topology import num_open_edges
from jaxvol.types import Mesh

_SHIFT = np.array([np.sqrt(2.0), np.sqrt(3.0)]) * 1e-7  # of a column; so that columns miss vertices and edges
_PARTS = 2.0**20  # of a voxel: lengths are rounded to these so that their sums are exact, and empty voxels exactly 0
_MOST_PAIRS = 1 << 22  # candidate (triangle, column) pairs at a time: bounds the memory


def open_edges(mesh: Mesh) -> int:
    """How many edges keep the mesh from enclosing a volume; 0 when it is watertight.

    Counts edges whose faces do not pair up in opposite windings; vertices at the same place are one.
    """
    return num_open_edges(np.asarray(mesh.vertices), np.asarray(mesh.faces))


def voxelize(
    mesh: Mesh, bounds: ArrayLike, resolution: tuple[int, int, int], *, supersampling: int = 4
) -> Float[np.ndarray, "X Y Z"]:
    """Fraction of each voxel that lies inside a watertight mesh, float32 in 0..1; eager.

    `bounds` [2, 3] are the grid's outer faces (the mesh may stick out), `supersampling` = sub-columns per voxel edge in
    x and in y. Relative error of the volume below 1e-4 for a bunny or a sphere at 128^3 with supersampling 4. Bodies
    that overlap count once. Raises ValueError for a mesh that is not closed, naming the number of its open edges, and
    for empty bounds, resolution or supersampling.
    """
    bounds = np.asarray(bounds, np.float64)
    resolution = tuple(int(n) for n in resolution)
    if bounds.shape != (2, 3) or not np.all(bounds[0] < bounds[1]):
        raise ValueError(f"bounds: {bounds.tolist()} must be [[x, y, z], [x, y, z]] with the lower corner first")
    if len(resolution) != 3 or min(resolution) < 1 or supersampling < 1:
        raise ValueError(f"resolution: {resolution} and supersampling: {supersampling} must be at least 1")
    count = open_edges(mesh)
    if count or len(mesh.faces) == 0:
        raise ValueError(f"mesh: must be watertight to be voxelised, has {count} open edges and {len(mesh.faces)} faces")
    columns = resolution[0] * supersampling, resolution[1] * supersampling
    scale = np.array([*columns, resolution[2]]) / (bounds[1] - bounds[0])
    triangles = (np.asarray(mesh.vertices, np.float64)[np.asarray(mesh.faces)] - bounds[0]) * scale
    triangles[..., :2] -= 0.5 + _SHIFT  # column centres at integers
    column, z, side = _in_turn(*_crossings(triangles, columns))
    return _fill(column, z, side, columns, resolution[2], supersampling)


def surface_voxels(
    mesh: Mesh, bounds: ArrayLike, resolution: tuple[int, int, int]
) -> tuple[Bool[np.ndarray, "X Y Z"], Float[np.ndarray, "X Y Z 3"]]:
    """(voxels that hold points of the mesh, mean albedo of the points in each); eager, any mesh.

    Points lie on a triangular lattice of each triangle, at most 0.4 voxels apart: a voxel whose corner alone is cut may
    be missed, but a ray cannot pass between marked ones without crossing a marked edge or corner.
    """
    bounds = np.asarray(bounds, np.float64)
    scale = np.array(resolution) / (bounds[1] - bounds[0])
    triangles = (np.asarray(mesh.vertices, np.float64)[np.asarray(mesh.faces)] - bounds[0]) * scale
    near = np.all((triangles.max(1) >= 0) & (triangles.min(1) <= np.array(resolution)), axis=1)
    triangles, albedo = triangles[near], np.asarray(mesh.albedo, np.float64)[near]
    longest = np.max(np.linalg.norm(triangles - np.roll(triangles, 1, axis=1), axis=2), axis=1)
    parts = np.maximum(np.ceil(longest / 0.4).astype(int), 1)
    num = np.zeros(resolution)
    total = np.zeros((*resolution, 3))
    for count in np.unique(parts):
        i, j = (a.ravel() for a in np.meshgrid(np.arange(count + 1), np.arange(count + 1), indexing="ij"))
        u, v = i[i + j <= count] / count, j[i + j <= count] / count
        weights = np.stack([1 - u - v, u, v], 1)
        mine = np.flatnonzero(parts == count)
        for some in np.array_split(mine, max(1, len(mine) * len(weights) // _MOST_PAIRS + 1)):
            points = np.einsum("pk,fkc->fpc", weights, triangles[some]).reshape(-1, 3)
            colour = np.repeat(albedo[some], len(weights), axis=0)
            inside = np.all((points >= 0) & (points < np.array(resolution)), axis=1)
            at = tuple(points[inside].astype(np.int64).T)
            np.add.at(num, at, 1.0)
            np.add.at(total, at, colour[inside])
    return num > 0, (total / np.maximum(num, 1.0)[..., None]).astype(np.float32)


def _crossings(triangles, columns):
    """(column, z, side) of every crossing of the columns; side +1 enters going up, -1 leaves."""
    edge, other = triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
    area = edge[:, 0] * other[:, 1] - edge[:, 1] * other[:, 0]
    low = np.maximum(np.ceil(triangles[..., :2].min(1)), 0).astype(np.int64)
    high = np.minimum(np.floor(triangles[..., :2].max(1)), np.array(columns) - 1).astype(np.int64)
    size = np.maximum(high - low + 1, 0)
    count = np.where(area != 0, size[:, 0] * size[:, 1], 0)
    faces = np.nonzero(count)[0]
    total = np.cumsum(count[faces])
    parts = []
    while len(faces):
        taken = max(1, int(np.searchsorted(total, _MOST_PAIRS, side="right")))
        now, faces = faces[:taken], faces[taken:]
        parts.append(_rasterise(triangles[now], area[now], low[now], size[now, 1], count[now], columns[1]))
        total = total[taken:] - total[taken - 1]
    if not parts:
        return np.zeros(0, np.int64), np.zeros(0), np.zeros(0, np.int64)
    column, z, side = (np.concatenate(x) for x in zip(*parts, strict=True))
    volume = np.einsum("ij,ij->", triangles[:, 0], np.cross(triangles[:, 1], triangles[:, 2]))
    return column, z, side if volume > 0 else -side


def _rasterise(triangles, area, low, width, count, num_rows):
    """Crossings of triangles [F, 3, 3] with the columns in their bounding rectangles (`count` columns each)."""
    face = np.repeat(np.arange(len(triangles)), count)
    item = np.arange(len(face)) - np.repeat(np.cumsum(count) - count, count)
    ix, iy = low[face, 0] + item // width[face], low[face, 1] + item % width[face]
    inside = np.ones(len(face), bool)
    z = np.zeros(len(face))
    for k in range(3):
        start, end, opposite = (triangles[:, (k + j) % 3] for j in range(3))
        # From the lower end to the higher, so that both triangles at an edge compute the same number.
        swap = (start[:, 0] > end[:, 0]) | ((start[:, 0] == end[:, 0]) & (start[:, 1] > end[:, 1]))
        a, b = np.where(swap[:, None], end, start), np.where(swap[:, None], start, end)
        along = (b - a)[:, :2]
        sign = np.where(swap == (area > 0), -1.0, 1.0)
        value = sign[face] * (along[face, 0] * (iy - a[face, 1]) - along[face, 1] * (ix - a[face, 0]))
        inside &= (value > 0) | ((value == 0) & (sign[face] > 0))
        z += value * (opposite[:, 2] / np.abs(area))[face]
    return (ix * num_rows + iy)[inside], z[inside], np.where(area < 0, 1, -1)[face[inside]]


def _in_turn(column, z, side):
    """The crossings sorted by column and z, less those inside the union and those that do not add up."""
    order = np.lexsort((z, column))
    column, z, side = column[order], z[order], side[order]
    depth = np.cumsum(side)
    ends = np.append(column[1:] != column[:-1], True)[: len(column)]
    columns_so_far = np.cumsum(ends) - ends
    at_end = np.append(0, depth[ends])
    depth = depth - at_end[columns_so_far]
    balanced = (np.diff(at_end) == 0)[columns_so_far]
    next_side = np.append(side[1:], 0)[: len(side)] * ~ends
    previous_side = np.append(0, (side * ~ends)[:-1])
    paired = np.where(side > 0, next_side < 0, previous_side > 0)
    changes = np.where(side > 0, depth == 1, depth == 0)
    keep = np.where(balanced, changes, paired)
    return column[keep], z[keep], side[keep]


def _fill(column, z, side, columns, num_layers, supersampling):
    """Mean over the columns of each voxel of the covered length: a sum over crossings, then a running sum along z."""
    z = np.clip(z, 0.0, num_layers)
    layer = np.minimum(z.astype(np.int64), num_layers - 1)
    above = np.round((z - layer) * _PARTS) / _PARTS
    ix, iy = column // columns[1] // supersampling, column % columns[1] // supersampling
    shape = columns[0] // supersampling, columns[1] // supersampling, num_layers + 1
    index = (ix * shape[1] + iy) * shape[2] + layer
    change = np.bincount(index, side * (1.0 - above), np.prod(shape))
    change += np.bincount(index + 1, side * above, np.prod(shape))
    occupancy = np.cumsum(change.reshape(shape), 2)[:, :, :-1] / supersampling**2
    return np.clip(occupancy, 0.0, 1.0).astype(np.float32)
