"""From hits to points on surfaces, and from points on surfaces to origins of new rays."""

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

from jaxvol import slopes
from jaxvol.types import Hits, Mesh

_OFFSET = 2.0**-16  # relative to the size of the coordinates: 128 float32 roundings


def face_normals(mesh: Mesh) -> Float[Array, "F 3"]:
    """Unit geometric normals by the winding rule; (0, 0, 1) for faces without area."""
    corners = mesh.vertices[mesh.faces]
    return _unit(jnp.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]))


def hits(
    mesh: Mesh | None,
    origin: Float[Array, "*batch 3"],
    direction: Float[Array, "*batch 3"],
    t: Float[Array, "*batch"],
    face: Int[Array, "*batch"],
) -> Hits:
    """Points and geometric normals where rays meet the faces that `intersect` returned; jittable, differentiable.

    Positions are put back on the plane of the face, so that their error (a few roundings of the coordinates) does not
    grow with t. On a miss: t = inf, face = -1, position = origin, normal = -direction.
    """
    origin, direction, t, face = jnp.asarray(origin), jnp.asarray(direction), jnp.asarray(t), jnp.asarray(face)
    valid = face >= 0
    if mesh is None:
        return Hits(t=t, face=face, position=origin, normal=-direction, valid=valid)
    corners = mesh.vertices[mesh.faces[jnp.where(valid, face, 0)]]
    corner = corners[..., 0, :]
    normal = _unit(jnp.cross(corners[..., 1, :] - corner, corners[..., 2, :] - corner))
    position = origin + jnp.where(valid, t, 0.0)[..., None] * direction
    height = jnp.sum(normal * (position - corner), -1, keepdims=True)
    return Hits(
        t=t,
        face=face,
        position=jnp.where(valid[..., None], position - height * normal, origin),
        normal=jnp.where(valid[..., None], normal, -direction),
        valid=valid,
    )


def offset_origin(
    position: Float[Array, "*batch 3"],
    normal: Float[Array, "*batch 3"],
    direction: Float[Array, "*batch 3"],
    *,
    scale: Float[Array, ""] | float = 1.0,
) -> Float[Array, "*batch 3"]:
    """Origin for a ray that leaves a surface: moved off it along the normal, to the side `direction` points to.

    By 2^-16 times the largest of the point's coordinates and `scale`, which stands for the size of the scene's
    triangles and so of their rounding errors; pass `scene_scale(mesh)` for scenes far from unit size.
    """
    size = jnp.maximum(slopes.largest(jnp.abs(position))[..., None], scale)
    side = jnp.where(jnp.sum(normal * direction, -1, keepdims=True) >= 0.0, 1.0, -1.0)
    return position + _OFFSET * size * side * normal


def scene_scale(mesh: Mesh) -> Float[Array, ""]:
    """Largest coordinate of the mesh in magnitude: what `offset_origin` wants as `scale`."""
    return jnp.max(jnp.abs(mesh.vertices))


def _unit(vector):
    """Normalised; (0, 0, 1) where the length is zero. Safe for gradients and for tiny triangles."""
    size = lax.stop_gradient(jnp.max(jnp.abs(vector), -1, keepdims=True))  # as the unit
    vector = jnp.where(size > 0.0, vector / jnp.where(size > 0.0, size, 1.0), jnp.array([0.0, 0.0, 1.0]))
    return vector / jnp.sqrt(jnp.sum(vector * vector, -1, keepdims=True))
