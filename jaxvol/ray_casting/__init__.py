"""Rays against triangles behind one function: Embree on the host, a BVH and brute force in pure JAX.

`make_caster(mesh)` builds one (`caster_for` keeps it as long as the mesh lives), `intersect` and `occluded` cast rays
of any batch shape, `hits` turns the answer into points and normals, `offset_origin` starts the next ray,
`all_intersections` lists every crossing of a closed mesh. The caster of no mesh (or of one without faces) is None:
every ray misses it.

Embree takes numpy or JAX arrays eagerly and returns numpy; the other two are pytrees and work under jit and grad (t is
differentiable in rays and vertices). All hold for 0 < t < t_max, on both sides of the faces, directions of any length;
there is no t_near, so callers offset origins. Rays that hold NaN hit nothing.
"""

import weakref

import jax
import jax.numpy as jnp
import numpy as np

from jaxvol.ray_casting import brute_force, bvh, closed_meshes, embree
from jaxvol.ray_casting.brute_force import BruteForce
from jaxvol.ray_casting.bvh import BVH
from jaxvol.ray_casting.closed_meshes import Crossings
from jaxvol.ray_casting.embree import EmbreeCaster
from jaxvol.ray_casting.surface_points import face_normals, hits, offset_origin, scene_scale
from jaxvol.ray_casting.topology import num_bodies, outward_normals
from jaxvol.types import Mesh

__all__ = [
    "BVH",
    "KINDS",
    "BruteForce",
    "Caster",
    "Crossings",
    "EmbreeCaster",
    "all_intersections",
    "caster_for",
    "crossings",
    "face_normals",
    "hits",
    "intersect",
    "make_caster",
    "occluded",
    "offset_origin",
    "scene_scale",
]

KINDS = ("auto", "embree", "bvh", "brute")
Caster = BruteForce | BVH | EmbreeCaster | None
_BRUTE_FORCE_FACES = 64  # up to here brute force beats a BVH
_casters: dict = {}  # (id of a mesh, kind) -> (weak reference to the mesh, caster)


def make_caster(mesh: Mesh | None, *, kind: str = "auto", num_threads: int | None = None) -> Caster:
    """Prepare `mesh` for ray casting; None when there is nothing to hit.

    `kind`: "embree", "bvh", "brute", or "auto": Embree when JAX runs on the CPU, else brute force up to 64 faces and
    the BVH above. `num_threads` (Embree only) defaults to the cores this process may use. Eager: build casters outside
    jit. Raises ValueError for an unknown kind.
    """
    if kind not in KINDS:
        raise ValueError(f"kind: unknown caster {kind!r}, must be one of {', '.join(KINDS)}")
    if mesh is None or mesh.faces.shape[0] == 0:
        return None
    if isinstance(mesh.vertices, jax.core.Tracer):
        raise ValueError("mesh: a caster cannot be built under jit; build it outside and pass it in")
    if kind == "auto":
        kind = _automatic_kind(mesh)
    faces = np.asarray(mesh.faces)
    triangles = np.asarray(mesh.vertices, np.float32)[faces]
    normals = outward_normals(triangles)
    bodies = num_bodies(np.asarray(mesh.vertices), faces)
    if kind == "embree":
        return EmbreeCaster(mesh.vertices, faces, triangles, normals, bodies, num_threads=num_threads)
    arrays = {"triangles": jnp.asarray(mesh.vertices)[faces], "normals": jnp.asarray(normals), "num_bodies": bodies}
    if kind == "brute":
        return BruteForce(**arrays)
    nodes, leaf_face = bvh.build(triangles)
    return BVH(nodes=jnp.asarray(nodes), leaf_face=jnp.asarray(leaf_face), **arrays)


def _automatic_kind(mesh):
    if jax.default_backend() == "cpu":
        return "embree"
    return "brute" if mesh.faces.shape[0] <= _BRUTE_FORCE_FACES else "bvh"


def caster_for(mesh: Mesh | None, *, kind: str = "auto") -> Caster:
    """`make_caster` once per mesh object: kept until the mesh is garbage (weak reference by identity, not by value)."""
    if mesh is None:
        return None
    key = (id(mesh), kind)
    if key not in _casters:
        _casters[key] = (weakref.ref(mesh, lambda _: _casters.pop(key, None)), make_caster(mesh, kind=kind))
    return _casters[key][1]


def intersect(caster: Caster, origin, direction, t_max):
    """Nearest hit of rays `origin [*batch, 3]`, `direction [*batch, 3]`, `t_max [*batch]`, broadcast together.

    Returns (t, face), both `[*batch]`: t = inf and face = -1 on a miss. numpy from the Embree caster, else JAX arrays.
    """
    batch, rays = _flatten(caster, origin, direction, t_max)
    if caster is None or 0 in batch:
        xp = np if isinstance(caster, EmbreeCaster) else jnp
        return xp.full(batch, np.inf, np.float32), xp.full(batch, -1, np.int32)
    t, face = _implementation(caster).intersect(caster, *rays)
    return t.reshape(batch), face.reshape(batch)


def occluded(caster: Caster, origin, direction, t_max):
    """Whether anything lies on the rays before `t_max`; shapes as in `intersect`, bool `[*batch]`."""
    batch, rays = _flatten(caster, origin, direction, t_max)
    if caster is None or 0 in batch:
        return (np if isinstance(caster, EmbreeCaster) else jnp).zeros(batch, bool)
    return _implementation(caster).occluded(caster, *rays).reshape(batch)


def _implementation(caster):
    """The module that casts rays for this kind of caster."""
    return {BruteForce: brute_force, BVH: bvh, EmbreeCaster: embree}[type(caster)]


def crossings(caster: Caster, origin, direction, t_max, *, max_hits: int) -> Crossings:
    """Where rays `[n, 3]`, `[n, 3]`, `[n]` enter and leave the closed mesh of `caster`, in turn, up to `t_max`.

    How, and what is repaired: see `closed_meshes`. Of no mesh, nothing is inside. `max_hits` per ray is kept.
    """
    (n,), rays = _flatten(caster, origin, direction, t_max)
    if caster is None or n == 0:
        xp = np if isinstance(caster, EmbreeCaster) else jnp
        t, face = xp.full((n, max_hits), np.inf, np.float32), xp.full((n, max_hits), -1, np.int32)
        return Crossings(t, face, xp.zeros(n, bool), xp.zeros((), np.int32))
    return closed_meshes.crossings(intersect, caster, *rays, max_hits=max_hits)


def all_intersections(caster: Caster, origin, direction, t_max, *, max_hits: int):
    """`crossings` as (t [n, max_hits] increasing, inf where no more, face, number of rays with more than that)."""
    found = crossings(caster, origin, direction, t_max, max_hits=max_hits)
    return found.t, found.face, found.num_overflows


def _flatten(caster, origin, direction, t_max):
    """The common batch shape and the rays as [n, 3], [n, 3], [n]."""
    xp = np if isinstance(caster, EmbreeCaster) else jnp
    origin, direction, t_max = (xp.asarray(x, np.float32) for x in (origin, direction, t_max))
    batch = np.broadcast_shapes(origin.shape[:-1], direction.shape[:-1], t_max.shape)
    n = int(np.prod(batch))
    return batch, (
        xp.broadcast_to(origin, (*batch, 3)).reshape(n, 3),
        xp.broadcast_to(direction, (*batch, 3)).reshape(n, 3),
        xp.broadcast_to(t_max, batch).reshape(n),
    )
