"""The ray and triangle test that the brute-force and BVH casters share, and the distance to a known face.

The test is the Pluecker form of Embree's robust mode: an edge shared by two triangles gives exactly opposite values
in both (built from the difference and the sum of its end points relative to the ray's origin, which change sign or
stay under a swap of the ends), so that no ray slips between the two.
"""

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

_ULP = 1.2e-7  # float32


def _edge(start, end, d):
    """Signed volume of the edge (relative to the ray's origin) and the direction."""
    ex, ey, ez = end[0] - start[0], end[1] - start[1], end[2] - start[2]
    sx, sy, sz = end[0] + start[0], end[1] + start[1], end[2] + start[2]
    return d[0] * (ey * sz - ez * sy) + d[1] * (ez * sx - ex * sz) + d[2] * (ex * sy - ey * sx)


def triangle_test(corners, o, d, t_best):
    """Whether rays meet triangles nearer than `t_best`, and where. Any shapes that broadcast, one array per coordinate.

    `corners` = ((x, y, z) of v0, of v1, of v2), `o`, `d` = (x, y, z). Returns (closer, t); t is a filler if not closer.
    """
    a, b, c = (tuple(v[i] - o[i] for i in range(3)) for v in corners)
    u, v, w = _edge(a, b, d), _edge(b, c, d), _edge(c, a, d)
    tolerance = _ULP * jnp.abs(u + v + w)
    lowest, highest = jnp.minimum(u, jnp.minimum(v, w)), jnp.maximum(u, jnp.maximum(v, w))
    inside = (lowest >= -tolerance) | (highest <= tolerance)
    # Edges from the corners themselves: exact for axis-aligned faces, unlike corners relative to a far origin.
    p, q, r = corners
    e = tuple(q[i] - p[i] for i in range(3))
    f = tuple(r[i] - p[i] for i in range(3))
    n = (e[1] * f[2] - e[2] * f[1], e[2] * f[0] - e[0] * f[2], e[0] * f[1] - e[1] * f[0])
    facing = n[0] * d[0] + n[1] * d[1] + n[2] * d[2]
    height = n[0] * a[0] + n[1] * a[1] + n[2] * a[2]
    t = height / jnp.where(facing == 0.0, 1.0, facing)
    return inside & (facing != 0.0) & (t > 0.0) & (t < t_best), t


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

