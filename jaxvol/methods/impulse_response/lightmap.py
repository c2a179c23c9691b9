"""Receivers on surfaces: corners of faces, and texels of a lightmap (unwrapped by xatlas, dilated over seams)."""

from typing import NamedTuple

import numpy as np
import xatlas
from jaxtyping import Bool, Float, Int

from jaxvol.ray_casting import topology
from jaxvol.types import Mesh

_PULL = 1e-3  # of the way from a corner to its face's centre: corners themselves lie inside neighbouring walls


class Vertices(NamedTuple):
    """Corners of faces, split where normals or reflectances differ; front sides."""

    position: Float[np.ndarray, "N 3"]  # of the mesh
    receiver: Float[np.ndarray, "N 3"]  # pulled a little into one of its faces
    normal: Float[np.ndarray, "N 3"]
    albedo: Float[np.ndarray, "N 3"]
    faces: Int[np.ndarray, "F 3"]  # faces without area left out
    num_dropped: int  # faces without area
    num_inward: int  # closed parts whose insides are the front


class Lightmap(NamedTuple):
    """An atlas: for every texel its point on the mesh, or nothing."""

    uv: Float[np.ndarray, "V 2"]  # 0..1, v upward
    position: Float[np.ndarray, "V 3"]  # of the unwrapped vertices
    faces: Int[np.ndarray, "F 3"]
    covered: Bool[np.ndarray, "H W"]
    receiver: Float[np.ndarray, "N 3"]  # one per covered texel, row by row from the top
    normal: Float[np.ndarray, "N 3"]
    albedo: Float[np.ndarray, "N 3"]
    num_dropped: int  # faces without area
    num_inward: int  # closed parts whose insides are the front


def _sound_faces(mesh: Mesh):
    """Faces with an area, their unit normals, their numbers; ValueError where there are none."""
    faces = np.asarray(mesh.faces)
    corners = np.asarray(mesh.vertices, np.float64)[faces]
    if not np.all(np.isfinite(corners)):
        raise ValueError("mesh.vertices: not all are finite")
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    size = np.linalg.norm(cross, axis=1)
    extent = np.ptp(corners.reshape(-1, 3), axis=0).max()
    sound = size > 1e-12 * extent * extent
    if not sound.any():
        raise ValueError("mesh: no face has an area, there is nothing to bake")
    return faces[sound], cross[sound] / size[sound, None], np.flatnonzero(sound)


def vertices(mesh: Mesh) -> Vertices:
    """One receiver per vertex, face normal and reflectance, on the front of the faces. ValueError where no face has an area."""
    faces, normals, numbers = _sound_faces(mesh)
    albedo = np.asarray(mesh.albedo, np.float64)[numbers]
    flat = faces.reshape(-1)
    key = np.concatenate(
        [flat[:, None], np.round(np.repeat(normals, 3, axis=0) * 1e4), np.round(np.repeat(albedo, 3, axis=0) * 1e6)], axis=1
    )
    _, first, inverse = np.unique(key, axis=0, return_index=True, return_inverse=True)
    corner = np.asarray(mesh.vertices, np.float64)
    centre = corner[faces].mean(axis=1)
    position = corner[flat[first]]
    return Vertices(
        position=position.astype(np.float32),
        receiver=(position + _PULL * (centre[first // 3] - position)).astype(np.float32),
        normal=normals[first // 3].astype(np.float32),
        albedo=albedo[first // 3].astype(np.float32),
        faces=inverse.reshape(-1, 3).astype(np.int32),
        num_dropped=len(mesh.faces) - len(faces),
        num_inward=topology.num_inward_bodies(np.asarray(mesh.vertices), np.asarray(mesh.faces)),
    )


def unwrap(mesh: Mesh, *, resolution: int, padding: int = 2, uv: Float[np.ndarray, "F 3 2"] | None = None) -> Lightmap:
    """A lightmap of about `resolution` texels a side, charts `padding` texels apart; front sides.

    `uv` are the mesh's own lightmap coordinates by corner, 0..1 and v upward, then exactly `resolution` texels a side; None
    unwraps the mesh. Raises ValueError for a resolution out of range, where no face has an area, where charts do not fit one
    atlas, and for coordinates that are not finite, out of range, collapsed or overlapping.
    """
    if not 16 <= resolution <= 8192:
        raise ValueError(f"resolution: {resolution} is not allowed, must be 16 to 8192")
    faces, normals, numbers = _sound_faces(mesh)
    vertex = np.asarray(mesh.vertices, np.float32)
    if uv is None:
        original, indices, uv, width, height = _charts(vertex, faces, resolution, padding)
    else:
        original, indices, uv = _given_charts(faces, np.asarray(uv, np.float64)[numbers])
        width = height = resolution
        _refuse_overlap(indices, uv, resolution)
    owner = _owners(indices, uv, width, height)
    covered = owner >= 0
    rows, columns = np.nonzero(covered)
    face = owner[rows, columns]
    centre = np.stack([(columns + 0.5) / width, 1 - (rows + 0.5) / height], axis=1)
    weight = _barycentric(uv[indices[face]].astype(np.float64), centre)
    weight = np.maximum(weight, _PULL)  # texels on an edge lie inside neighbouring walls
    weight /= weight.sum(axis=1, keepdims=True)
    corners = vertex[original[indices[face]]].astype(np.float64)
    return Lightmap(
        uv=np.asarray(uv, np.float32),
        position=vertex[original],
        faces=indices.astype(np.int32),
        covered=covered,
        receiver=np.einsum("nk,nkd->nd", weight, corners).astype(np.float32),
        normal=normals[face].astype(np.float32),
        albedo=np.asarray(mesh.albedo, np.float32)[numbers][face],
        num_dropped=len(mesh.faces) - len(faces),
        num_inward=topology.num_inward_bodies(np.asarray(mesh.vertices), np.asarray(mesh.faces)),
    )


def _charts(vertex, faces, resolution, padding):
    """Vertices' origins, faces, coordinates and size of an atlas by xatlas."""
    atlas = xatlas.Atlas()
    atlas.add_mesh(vertex, faces.astype(np.uint32))
    options = xatlas.PackOptions()
    options.resolution, options.padding, options.create_image = resolution, padding, False
    atlas.generate(pack_options=options)
    if atlas.atlas_count != 1 or atlas.width == 0:
        raise ValueError(f"mesh does not fit one lightmap of {resolution} texels ({atlas.atlas_count} would be needed)")
    original, indices, uv = atlas[0]
    return original, indices.astype(np.int64), uv, int(atlas.width), int(atlas.height)


def _given_charts(faces, uv):
    """The same for coordinates [F, 3, 2] of the faces' corners: every corner is a vertex of its own."""
    if uv.shape != (len(faces), 3, 2) or not np.all(np.isfinite(uv)):
        raise ValueError(f"uv: must be finite and of shape [faces, 3, 2], got {uv.shape}")
    if uv.min() < 0 or uv.max() > 1:
        raise ValueError(f"uv: {uv.min():g} to {uv.max():g} is not allowed, must be 0 to 1")
    one, two = uv[:, 1] - uv[:, 0], uv[:, 2] - uv[:, 0]
    collapsed = np.abs(one[:, 0] * two[:, 1] - one[:, 1] * two[:, 0]) < 1e-12
    if collapsed.any():
        raise ValueError(f"uv: {collapsed.sum()} faces with an area have none in the lightmap, face {collapsed.argmax()} first")
    return faces.reshape(-1), np.arange(3 * len(faces)).reshape(-1, 3), uv.reshape(-1, 2)


def _refuse_overlap(indices, uv, resolution):
    """ValueError where two faces claim the inside of one texel's centre."""
    whole = _owners(indices, uv, resolution, resolution, margin=1e-6)
    again = _owners(indices[::-1], uv, resolution, resolution, margin=1e-6)
    twice = (whole >= 0) & (whole != len(indices) - 1 - again)
    if twice.any():
        raise ValueError(f"uv: faces overlap in {twice.sum()} texels of {resolution} x {resolution}")


def _barycentric(corners, point):
    """Weights of a point in triangles [n, 3, 2]."""
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    ab, ac, ap = b - a, c - a, point - a
    area = ab[:, 0] * ac[:, 1] - ab[:, 1] * ac[:, 0]
    area = np.where(np.abs(area) > 1e-30, area, 1e-30)
    wb = (ap[:, 0] * ac[:, 1] - ap[:, 1] * ac[:, 0]) / area
    wc = (ab[:, 0] * ap[:, 1] - ab[:, 1] * ap[:, 0]) / area
    return np.stack([1 - wb - wc, wb, wc], axis=1)


def _owners(indices, uv, width, height, *, margin=-1e-9):
    """The face whose chart holds each texel's centre, -1 for none; row 0 is the top."""
    owner = np.full((height, width), -1, np.int64)
    size = np.array([width, height])
    for face, corners in enumerate(uv[indices].astype(np.float64)):
        pixel = corners * size
        low = np.maximum(np.floor(pixel.min(axis=0) - 0.5).astype(int), 0)
        high = np.minimum(np.ceil(pixel.max(axis=0) + 0.5).astype(int), size)
        x, y = np.meshgrid(np.arange(low[0], high[0]), np.arange(low[1], high[1]), indexing="ij")
        x, y = x.ravel(), y.ravel()
        centre = np.stack([(x + 0.5) / width, (y + 0.5) / height], axis=1)
        weight = _barycentric(np.broadcast_to(corners, (len(x), 3, 2)), centre)
        inside = np.all(weight >= margin, axis=1)
        owner[height - 1 - y[inside], x[inside]] = face
    return owner


def dilate(image: Float[np.ndarray, "H W C"], covered: Bool[np.ndarray, "H W"], *, steps: int = 4) -> np.ndarray:
    """The image with empty texels filled by the mean of their filled neighbours, `steps` texels outward: no dark seams."""
    image, known = np.array(image, np.float32), np.array(covered)
    for _ in range(steps):
        total, count = np.zeros_like(image), np.zeros(known.shape, np.float32)
        for dy in (-1, 0, 1):
            for dx in (-1, 0, 1):
                moved, there = _shift(image, dy, dx), _shift(known, dy, dx)
                total += np.where(there[..., None], moved, 0)
                count += there
        fresh = ~known & (count > 0)
        image[fresh] = total[fresh] / count[fresh][:, None]
        known |= fresh
    return image


def _shift(array, dy, dx):
    """Moved by a texel without wrapping round; False or 0 comes in at the border."""
    out = np.zeros_like(array)
    height, width = array.shape[:2]
    to_y, to_x = slice(max(dy, 0), height + min(dy, 0)), slice(max(dx, 0), width + min(dx, 0))
    from_y, from_x = slice(max(-dy, 0), height + min(-dy, 0)), slice(max(-dx, 0), width + min(-dx, 0))
    out[to_y, to_x] = array[from_y, from_x]
    return out
