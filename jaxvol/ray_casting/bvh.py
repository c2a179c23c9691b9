"""A bounding volume hierarchy in pure JAX: for accelerators, and under jit where Embree cannot go.

The tree is complete, in heap order (children of node k: 2k and 2k + 1), and halves the triangles at the median of
their centres along the longest axis of each node, all nodes of a level at once in numpy. Being complete, it needs no
stack: a lane keeps its node and a second index whose bits say "nearer" or "farther" child instead of "left" or
"right", and the next node after a miss follows from the trailing ones of that index. Lanes march in lockstep inside
`lax.while_loop`; a block costs what its slowest lane costs, so blocks are small on a CPU and large on a GPU.
"""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxvol.ray_casting.triangles import coordinates, distance_to_face, in_blocks, ray_frame, triangle_test

_LEAF_FACES = 2
_NODE_STEPS = 2  # between two rounds of triangle tests
_BLOCK = {"cpu": 256}  # lanes; elsewhere:
_LARGE_BLOCK = 1 << 20
_SLACK = 2.0**-21  # of the coordinates: boxes grow by the rounding errors of the triangle test


class BVH(eqx.Module):
    """A complete tree of depth D over the faces; row 0 of `nodes` is unused, row 1 the root."""

    triangles: Float[Array, "F 3 3"]
    normals: Float[Array, "F 3"]  # outward for a closed mesh, length = twice the area
    nodes: Float[Array, "2**(D+1) 7"]  # lower corner, upper corner, split axis
    leaf_face: Int[Array, "2**D leaf"]  # -1 fills up
    num_bodies: int = eqx.field(static=True)  # connected components of the mesh


def build(triangles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(nodes, leaf_face) of `BVH` for triangles [F, 3, 3]; vectorised, F log^2 F."""
    num_faces = len(triangles)
    depth = max(0, int(np.ceil(np.log2(num_faces / _LEAF_FACES))))
    low, high = triangles.min(1), triangles.max(1)
    centre = low + high
    order = np.arange(num_faces)
    nodes = np.zeros((2 << depth, 7), np.float32)
    for level in range(depth):
        first = _first_items(num_faces, level)
        points = centre[order]
        extent = np.maximum.reduceat(points, first) - np.minimum.reduceat(points, first)
        axis = np.argmax(extent, 1)
        nodes[1 << level : 2 << level, 6] = axis
        node = np.repeat(np.arange(1 << level), np.diff(np.append(first, num_faces)))
        order = order[np.lexsort((points[np.arange(num_faces), axis[node]], node))]
    first = _first_items(num_faces, depth)
    count = np.diff(np.append(first, num_faces))
    slot = np.arange(count.max())
    item = np.minimum(first[:, None] + slot, num_faces - 1)
    leaf_face = np.where(slot < count[:, None], order[item], -1).astype(np.int32)
    lower, upper = np.minimum.reduceat(low[order], first), np.maximum.reduceat(high[order], first)
    for level in range(depth, -1, -1):
        nodes[1 << level : 2 << level, 0:3], nodes[1 << level : 2 << level, 3:6] = lower, upper
        if level > 0:
            lower, upper = np.minimum(lower[0::2], lower[1::2]), np.maximum(upper[0::2], upper[1::2])
    return nodes, leaf_face


def _first_items(num_faces, level):
    """Where the faces of each node of a level start: equal shares, nested from level to level."""
    return (np.arange(1 << level, dtype=np.int64) * num_faces) >> level


def _next_node(node, visit):
    """Where to go when a subtree is done: the farther sibling of the nearest ancestor that has one to offer; 0 = end."""
    after = visit + 1
    up = lax.population_count((after & -after) - 1)
    visit = after >> up
    return jnp.where(visit == 1, 0, (node >> up) ^ 1), visit


def _traverse(nodes, leaf_face, triangles, origin, direction, t_max, any_hit):
    """(t, face) of a block of rays; with `any_hit` the first face found, else the nearest."""
    num_leaves, leaf_size = leaf_face.shape
    o, frame = coordinates(origin), ray_frame(direction)
    d = frame[2]
    inverse = tuple(1.0 / jnp.where(jnp.abs(x) < 1e-20, jnp.where(x < 0, -1e-20, 1e-20), x) for x in d)
    size = jnp.max(jnp.abs(nodes[1, :6])) + jnp.maximum(jnp.abs(o[0]), jnp.maximum(jnp.abs(o[1]), jnp.abs(o[2])))
    o_low, o_high = (tuple(x + sign * _SLACK * size for x in o) for sign in (1, -1))
    negative = tuple((x < 0).astype(jnp.int32) for x in d)

    def node_step(_, state):
        node, visit, waiting, t_best = state
        row = nodes[node]
        t0 = [(row[:, i] - o_low[i]) * inverse[i] for i in range(3)]
        t1 = [(row[:, i + 3] - o_high[i]) * inverse[i] for i in range(3)]
        near, far = ([f(a, b) for a, b in zip(t0, t1, strict=True)] for f in (jnp.minimum, jnp.maximum))
        entry = jnp.maximum(jnp.maximum(near[0], near[1]), jnp.maximum(near[2], 0.0))
        exit_ = jnp.minimum(jnp.minimum(far[0], far[1]), far[2])
        hit = entry <= jnp.minimum(exit_, t_best)
        axis = row[:, 6]
        farther = jnp.where(axis == 0.0, negative[0], jnp.where(axis == 1.0, negative[1], negative[2]))
        is_leaf = node >= num_leaves
        after, visit_after = _next_node(node, visit)
        moving = (node > 0) & ~waiting
        new_node = jnp.where(hit, jnp.where(is_leaf, node, 2 * node + farther), after)
        new_visit = jnp.where(hit, jnp.where(is_leaf, visit, 2 * visit), visit_after)
        waiting = waiting | (moving & hit & is_leaf)
        return jnp.where(moving, new_node, node), jnp.where(moving, new_visit, visit), waiting, t_best

    def round_(state):
        node, visit, t_best, face = state
        waiting = jnp.zeros(node.shape, bool)
        node, visit, waiting, _ = lax.fori_loop(0, _NODE_STEPS, node_step, (node, visit, waiting, t_best), unroll=True)
        faces = leaf_face[jnp.where(waiting, node - num_leaves, 0)]
        for k in range(leaf_size):
            rows = triangles[jnp.maximum(faces[:, k], 0)]
            corners = tuple(tuple(rows[:, 3 * v + i] for i in range(3)) for v in range(3))
            closer, t = triangle_test(corners, o, frame, t_best)
            closer = closer & waiting & (faces[:, k] >= 0)
            t_best, face = jnp.where(closer, t, t_best), jnp.where(closer, faces[:, k], face)
        after, visit_after = _next_node(node, visit)
        node, visit = jnp.where(waiting, after, node), jnp.where(waiting, visit_after, visit)
        return jnp.where(any_hit & (face >= 0), 0, node), visit, t_best, face

    start = jnp.where(t_max > 0.0, 1, 0).astype(jnp.int32)
    state = (start, jnp.ones_like(start), t_max, jnp.full(t_max.shape, -1, jnp.int32))
    _, _, t_best, face = lax.while_loop(lambda s: jnp.any(s[0] > 0), round_, state)
    return t_best, face


def _cast(caster, origin, direction, t_max, any_hit):
    triangles = caster.triangles.reshape(-1, 9)
    block = functools.partial(_traverse, caster.nodes, caster.leaf_face, triangles, any_hit=any_hit)
    lanes = (origin, direction, t_max)
    return in_blocks(block, _BLOCK.get(jax.default_backend(), _LARGE_BLOCK), *lanes)[1]


@jax.jit
def intersect(
    caster: BVH, origin: Float[Array, "n 3"], direction: Float[Array, "n 3"], t_max: Float[Array, "n"]
) -> tuple[Float[Array, "n"], Int[Array, "n"]]:
    """Nearest hit of each ray: (t, face), (inf, -1) on a miss. Differentiable in t."""
    face = _cast(*jax.tree.map(lax.stop_gradient, (caster, origin, direction, t_max)), any_hit=False)
    return distance_to_face(caster.triangles, face, origin, direction), face


@jax.jit
def occluded(
    caster: BVH, origin: Float[Array, "n 3"], direction: Float[Array, "n 3"], t_max: Float[Array, "n"]
) -> Bool[Array, "n"]:
    """Whether anything lies between the origin and t_max; a lane stops at its first hit."""
    return _cast(caster, origin, direction, t_max, any_hit=True) >= 0
