"""Surfelisation: the mesh as disks of equal size on the screen, view-dependent but complete (paper section 3.2, Fig. 2).

No hardware tessellation: every triangle is cut into m^2 congruent ones, one surfel at each centroid, so that area and
first moment are exact (`pattern="congruent"`). `pattern="paper"` places the surfels like the point mode of tessellation
hardware: on rings from edge to centre, moved inwards because shared edges would count twice.
The size depends on the distance alone, so that grazing and back-facing triangles get their surfels too.
"""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxvol.sampling import dot, normalize

PATTERNS = ("congruent", "paper")
_NEAR = 1e-3  # of the scene's extent: keeps radii positive when the camera touches a triangle


class Surfels(eqx.Module):
    """Oriented disks; slots beyond the last have area 0 and `valid` False."""

    position: Float[Array, "S 3"]
    normal: Float[Array, "S 3"]  # unit, by the winding rule
    area: Float[Array, "S"]  # pi radius^2
    face: Int[Array, "S"]  # of the mesh
    valid: Bool[Array, "S"]


class Triangles(eqx.Module):
    """Triangles small against their distance, and how finely to cut each; numpy, host side."""

    corners: Float[np.ndarray, "T 3 3"]
    face: Int[np.ndarray, "T"]  # of the mesh they were cut from
    count: Int[np.ndarray, "T"]  # surfels on each


def distances(corners: Float[np.ndarray, "T 3 3"], eye: Float[np.ndarray, "3"]) -> Float[np.ndarray, "T"]:
    """From the eye to each centroid, kept away from zero."""
    extent = np.ptp(corners.reshape(-1, 3), axis=0).max() if len(corners) else 1.0
    return np.maximum(np.linalg.norm(corners.mean(axis=1) - eye, axis=-1), _NEAR * extent)


def split_large(
    corners: Float[np.ndarray, "T 3 3"],
    eye: Float[np.ndarray, "3"],
    *,
    max_ratio: float = 0.35,
    max_triangles: int = 100_000,
) -> tuple[Float[np.ndarray, "T2 3 3"], Int[np.ndarray, "T2"]]:
    """Triangles bisected at their longest edge until it is at most `max_ratio` times the distance, and whence each came.

    One radius a triangle needs that. Stops early, unevenly, rather than exceed `max_triangles`.
    """
    corners = np.asarray(corners, np.float32)
    source = np.arange(len(corners))
    while True:
        edges = np.linalg.norm(np.roll(corners, -1, axis=1) - corners, axis=-1)  # edge i runs from corner i to i + 1
        large = edges.max(axis=1) > max_ratio * distances(corners, eye) if len(corners) else np.zeros(0, bool)
        if not large.any() or len(corners) + large.sum() > max_triangles:
            return corners, source
        longest = edges[large].argmax(axis=1)
        rows = np.arange(longest.size)
        a, b, c = (corners[large][rows, (longest + i) % 3] for i in range(3))
        middle = 0.5 * (a + b)
        halves = np.concatenate([np.stack([a, middle, c], axis=1), np.stack([middle, b, c], axis=1)])
        corners = np.concatenate([corners[~large], halves])
        source = np.concatenate([source[~large], source[large], source[large]])


def areas(corners: Float[np.ndarray, "T 3 3"]) -> Float[np.ndarray, "T"]:
    """Triangle areas."""
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return 0.5 * np.linalg.norm(cross, axis=-1)


def surfel_counts(
    area: Float[np.ndarray, "T"], radius: Float[np.ndarray, "T"], *, pattern: str = "congruent"
) -> Int[np.ndarray, "T"]:
    """Surfels that make each disk about `radius`: m^2, or (3 (k+1)^2 + 1)/4 with k even in the paper's pattern."""
    disk = np.pi * radius * radius
    if pattern == "paper":
        k = np.ceil(np.sqrt(np.maximum(4.0 * area - disk, 0.0) / (3.0 * disk)) - 1.0)
        k = 2 * np.ceil(np.maximum(k, 0.0) / 2).astype(np.int64)
        return np.where(area > 0, (3 * (k + 1) ** 2 + 1) // 4, 0)
    m = np.maximum(np.ceil(np.sqrt(area / disk)), 1).astype(np.int64)
    return np.where(area > 0, m * m, 0)


def subdivide(
    vertices: Float[np.ndarray, "V 3"],
    faces: Int[np.ndarray, "F 3"],
    eye: Float[np.ndarray, "3"],
    *,
    num_surfels: int,
    pattern: str = "congruent",
    max_ratio: float = 0.35,
) -> Triangles:
    """Cut the mesh for about (at most) `num_surfels` surfels of equal size on the screen, by bisection of that size.

    Meshes with more triangles than `num_surfels` get one surfel a triangle: more than asked for. Eager, numpy.
    """
    vertices, faces = np.asarray(vertices), np.asarray(faces)
    eye = np.asarray(eye, np.float32)
    corners, source = split_large(vertices[faces], eye, max_ratio=max_ratio, max_triangles=max(num_surfels, 1))
    area = areas(corners)
    distance = distances(corners, eye)
    low, high = 1e-6, 10.0  # radius over distance: too fine, coarse enough
    for _ in range(40):
        middle = np.sqrt(low * high)
        fits = surfel_counts(area, middle * distance, pattern=pattern).sum() <= num_surfels
        low, high = (low, middle) if fits else (middle, high)
    return Triangles(corners=corners, face=source, count=surfel_counts(area, high * distance, pattern=pattern))


def _isqrt(n):
    """Integer square root of non-negative int32 below 2^24: float32 may be one off."""
    root = jnp.sqrt(n.astype(jnp.float32)).astype(jnp.int32)
    root = jnp.where(root * root > n, root - 1, root)
    return jnp.where((root + 1) * (root + 1) <= n, root + 1, root)


def _congruent_point(index, count):
    """Barycentric weights of corners b and c at the centroid of sub-triangle `index` of m^2 = count."""
    m = _isqrt(count)
    row = _isqrt(index)
    q = index - row * row
    column = q // 2
    upright = q % 2 == 0
    i = row + jnp.where(upright, 2.0, 1.0) / 3.0
    j = column + jnp.where(upright, 1.0, 2.0) / 3.0
    return (i - j) / m, j / m


def _paper_point(index, count):
    """The same for vertex `index` of point mode with inner level k: 0 is the centre, then rings of 6 q vertices.

    A ring with 2 q segments a side lies (k - 2 q)/2 rings inwards, its corners at (1 - 2 t, t, t), t = (k/2 - q) 2/(3 k).
    Moved inwards by k/(k + 1) because edges are shared.
    """
    k = _isqrt((4 * count - 1) // 3) - 1
    q = jnp.ceil(0.5 * (jnp.sqrt(1.0 + 4.0 * index / 3.0) - 1.0) - 1e-4).astype(jnp.int32)
    place = index - 1 - 3 * (q - 1) * q
    segments = jnp.maximum(2 * q, 1)
    side, along = place // segments, (place % segments) / segments
    inset = (k // 2 - q) * 2.0 / (3.0 * jnp.maximum(k, 1))
    start = jax.nn.one_hot(side % 3, 3)
    end = jax.nn.one_hot((side + 1) % 3, 3)
    weights = inset[:, None] + (1.0 - 3.0 * inset[:, None]) * (start + along[:, None] * (end - start))
    shrink = (k / (k + 1.0))[:, None]
    weights = jnp.where((index == 0)[:, None], 1.0 / 3.0, 1.0 / 3.0 + shrink * (weights - 1.0 / 3.0))
    return weights[:, 1], weights[:, 2]


@partial(jax.jit, static_argnames=("capacity", "pattern"))
def tessellate(triangles: Triangles, *, capacity: int, pattern: str = "congruent") -> tuple[Surfels, Int[Array, ""]]:
    """The surfels in `capacity` slots, and how many found no slot (0 unless the capacity is too small).

    Slot k belongs to the first triangle whose cumulative count exceeds k; each surfel has area A/count.
    """
    end = jnp.cumsum(triangles.count.astype(jnp.int32))
    total = end[-1]
    slot = jnp.arange(capacity, dtype=jnp.int32)
    t = jnp.minimum(jnp.searchsorted(end, slot, side="right").astype(jnp.int32), end.shape[0] - 1)
    count = jnp.maximum(triangles.count[t].astype(jnp.int32), 1)
    index = jnp.clip(slot - (end[t] - triangles.count[t].astype(jnp.int32)), 0, count - 1)
    b, c = (_paper_point if pattern == "paper" else _congruent_point)(index, count)
    p0, p1, p2 = (triangles.corners[t, i] for i in range(3))
    cross = jnp.cross(p1 - p0, p2 - p0)
    valid = slot < total
    double_area = jnp.sqrt(jnp.maximum(dot(cross, cross), 0.0))
    surfels = Surfels(
        position=p0 + b[:, None] * (p1 - p0) + c[:, None] * (p2 - p0),
        normal=normalize(cross),
        area=jnp.where(valid, 0.5 * double_area / count, 0.0),
        face=triangles.face[t].astype(jnp.int32),
        valid=valid,
    )
    return surfels, jnp.maximum(total - capacity, 0)
