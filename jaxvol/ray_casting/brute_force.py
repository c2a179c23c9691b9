"""Brute force: every ray against every triangle, pure JAX.

Right for a handful of triangles (about 1 M rays/s and core against a box) and the oracle for the other casters; the
cost grows with rays times triangles. Works under jit, vmap and grad (in t: rays and vertices; the choice of the face
is piecewise constant).
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxvol.ray_casting.triangles import coordinates, distance_to_face, in_blocks, ray_frame, triangle_test

_BLOCK = 4096  # lanes: their state stays in a core's cache while the triangles go by


class BruteForce(eqx.Module):
    """Triangles as they are."""

    triangles: Float[Array, "F 3 3"]
    normals: Float[Array, "F 3"]  # outward for a closed mesh, length = twice the area
    num_bodies: int = eqx.field(static=True)  # connected components of the mesh


def _scan_triangles(step, triangles, state):
    """Fold `step(state, index, corners)` over the triangles."""
    num_faces = triangles.shape[0]
    rows = triangles.reshape(num_faces, 9)

    def body(state, item):
        index, row = item
        return step(state, index, tuple(tuple(row[3 * k + i] for i in range(3)) for k in range(3))), None

    return lax.scan(body, state, (jnp.arange(num_faces, dtype=jnp.int32), rows), unroll=min(4, num_faces))[0]


@jax.jit
def intersect(
    caster: BruteForce, origin: Float[Array, "n 3"], direction: Float[Array, "n 3"], t_max: Float[Array, "n"]
) -> tuple[Float[Array, "n"], Int[Array, "n"]]:
    """Nearest hit of each ray: (t, face), (inf, -1) on a miss."""
    triangles = lax.stop_gradient(caster.triangles)

    def block(origin, direction, t_max):
        o, frame = coordinates(origin), ray_frame(direction)

        def step(state, index, corners):
            t_best, face = state
            closer, t = triangle_test(corners, o, frame, t_best)
            return jnp.where(closer, t, t_best), jnp.where(closer, index, face)

        return (_scan_triangles(step, triangles, (t_max, jnp.full(t_max.shape, -1, jnp.int32)))[1],)

    lanes = jax.tree.map(lax.stop_gradient, (origin, direction, t_max))
    (face,) = in_blocks(block, _BLOCK, *lanes)
    return distance_to_face(caster.triangles, face, origin, direction), face


@jax.jit
def occluded(
    caster: BruteForce, origin: Float[Array, "n 3"], direction: Float[Array, "n 3"], t_max: Float[Array, "n"]
) -> Bool[Array, "n"]:
    """Whether anything lies between the origin and t_max."""

    def block(origin, direction, t_max):
        o, frame = coordinates(origin), ray_frame(direction)

        def step(blocked, _, corners):
            return blocked | triangle_test(corners, o, frame, t_max)[0]

        return (_scan_triangles(step, caster.triangles, jnp.zeros(t_max.shape, bool)),)

    return in_blocks(block, _BLOCK, origin, direction, t_max)[0]
