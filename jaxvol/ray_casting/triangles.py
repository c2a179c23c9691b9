"""The ray and triangle test that the brute-force and BVH casters share, and the distance to a known face.

Watertight after Woop, Benthin, Wald 2013 (Watertight Ray/Triangle Intersection, JCGT 2): corners are projected along
the ray onto a plane across it, where the ray is the origin. A corner's projection does not depend on the triangle it
is seen from, so that neighbours agree on their common edges and vertices, and no ray slips between them. Here the
plane is spanned by an orthonormal frame instead of a shear, and a tolerance of one rounding of the products stands for
their fallback to double precision (compilers contract `a b - c d` to one rounding in ways that differ by triangle).
"""

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

_ULP = 1.2e-7  # float32


def ray_frame(direction: Float[Array, "n 3"]) -> tuple:
    """((x, y, z) of s, of t, of d): s and t orthonormal across the rays (Duff et al. 2017), d their directions."""
    d = coordinates(direction)
    size = jnp.sqrt(d[0] * d[0] + d[1] * d[1] + d[2] * d[2])
    x, y, z = (c / jnp.where(size > 0.0, size, 1.0) for c in d)
    sign = jnp.where(z < 0.0, -1.0, 1.0)
    p = -1.0 / (sign + z)
    q = x * y * p
    return (1.0 + sign * x * x * p, sign * q, -sign * x), (q, sign + y * y * p, -y), d


def _side(p, q):
    """Twice the signed area of the origin and two points of the plane, and its rounding error."""
    left, right = p[0] * q[1], p[1] * q[0]
    return left - right, _ULP * (jnp.abs(left) + jnp.abs(right))


def triangle_test(corners, o, frame, t_best):
    """Whether rays meet triangles nearer than `t_best`, and where. Any shapes that broadcast, one array per coordinate.

    `corners` = ((x, y, z) of v0, of v1, of v2), `o` = (x, y, z), `frame` from `ray_frame`. Returns (closer, t); t is a
    filler if not closer.
    """
    relative = [tuple(v[i] - o[i] for i in range(3)) for v in corners]
    s, t, d = frame
    a, b, c = (tuple(f[0] * v[0] + f[1] * v[1] + f[2] * v[2] for f in (s, t)) for v in relative)
    (u, u_error), (v, v_error), (w, w_error) = _side(b, c), _side(c, a), _side(a, b)
    front = (u >= -u_error) & (v >= -v_error) & (w >= -w_error)
    back = (u <= u_error) & (v <= v_error) & (w <= w_error)
    n = _normal(corners)
    facing = n[0] * d[0] + n[1] * d[1] + n[2] * d[2]
    height = n[0] * relative[0][0] + n[1] * relative[0][1] + n[2] * relative[0][2]
    distance = height / jnp.where(facing == 0.0, 1.0, facing)
    return (front | back) & (facing != 0.0) & (distance > 0.0) & (distance < t_best), distance


def _normal(corners):
    """Cross product of two edges, from the corners themselves: exact for axis-aligned faces however far the ray."""
    p, q, r = corners
    e = tuple(q[i] - p[i] for i in range(3))
    f = tuple(r[i] - p[i] for i in range(3))
    return e[1] * f[2] - e[2] * f[1], e[2] * f[0] - e[0] * f[2], e[0] * f[1] - e[1] * f[0]


def distance_to_face(
    triangles: Float[Array, "F 3 3"],
    face: Int[Array, "*batch"],
    origin: Float[Array, "*batch 3"],
    direction: Float[Array, "*batch 3"],
) -> Float[Array, "*batch"]:
    """Distance along the rays to the planes of known faces, inf where face is -1; differentiable in rays and corners."""
    hit = face >= 0
    corners = triangles[jnp.maximum(face, 0)]
    normal = jnp.cross(corners[..., 1, :] - corners[..., 0, :], corners[..., 2, :] - corners[..., 0, :])
    facing = jnp.sum(normal * direction, -1)
    height = jnp.sum(normal * (corners[..., 0, :] - origin), -1)
    return jnp.where(hit, height / jnp.where(hit & (facing != 0.0), facing, 1.0), jnp.inf)


def in_blocks(function, block: int, *lanes: Array):
    """`function` of per-lane arrays, `block` lanes at a time; lanes are padded with copies of lane 0."""
    n = lanes[0].shape[0]
    if n <= block:
        return function(*lanes)
    padded = -(-n // block) * block

    def blocked(x):
        x = jnp.concatenate([x, jnp.broadcast_to(x[:1], (padded - n, *x.shape[1:]))])
        return x.reshape(padded // block, block, *x.shape[1:])

    results = lax.map(lambda xs: function(*xs), tuple(blocked(x) for x in lanes))
    return tuple(r.reshape(padded, *r.shape[2:])[:n] for r in results)


def coordinates(vectors: Float[Array, "n 3"]) -> tuple[Array, Array, Array]:
    """One array per coordinate."""
    return vectors[:, 0], vectors[:, 1], vectors[:, 2]
