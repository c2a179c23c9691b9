"""Octahedral maps around every virtual light: how far it sees, and how much medium lies on the way (sections 4.2, 4.4).

A map answers for all receivers what a shadow ray or a march answers for one; it pays where a light has more receivers than
texels (`experiments/instant_transmittance.py`). The depth of the light nearest to a point also serves as the geometry
around that point: the paper's local visibility, with the least depth of a map as a first test.
"""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from scipy.spatial import cKDTree

from jaxvol import media, ray_casting, sampling
from jaxvol.methods.instant_multiple_scattering.virtual_lights import LightSet, blocks
from jaxvol.types import Medium, Mesh, Scene

_CHUNK = 1 << 18  # texels that are built at once
_SLACK = 0.02  # of a depth: texels are wide, and receivers lie on the surfaces that maps show
_LOCAL_STEPS = 8  # of a short ray through the map of the nearest light


class Maps(eqx.Module):
    """Maps of all lights, one row each, in the order of `blocks`; texels in one axis, [row of v, column of u]."""

    position: Float[Array, "M 3"]
    depth: Float[Array, "M ss"] | None  # to the nearest surface, inf: none
    face: Int[Array, "M ss"] | None  # that surface, -1: none
    nearest: Float[Array, "M"] | None  # least depth of each map
    reach: Float[Array, "M ss"] | None  # distance to the end of the medium
    columns: Float[Array, "M ss k"] | None  # of density, to the ends of k equal steps of `reach`
    size: int = eqx.field(static=True)


def texel(direction: Float[Array, "*b 3"], *, size: int) -> Int[Array, "*b"]:
    """Number of the texel that holds a direction (need not be of unit length): octahedral map of size x size."""
    u, v, w = direction[..., 0], direction[..., 1], direction[..., 2]
    scale = 1.0 / jnp.maximum(jnp.abs(u) + jnp.abs(v) + jnp.abs(w), 1e-30)
    u, v = u * scale, v * scale
    folded_u = (1.0 - jnp.abs(v)) * jnp.where(u >= 0, 1.0, -1.0)
    folded_v = (1.0 - jnp.abs(u)) * jnp.where(v >= 0, 1.0, -1.0)
    u, v = jnp.where(w < 0, folded_u, u), jnp.where(w < 0, folded_v, v)
    column = jnp.clip(((u + 1.0) * (0.5 * size)).astype(jnp.int32), 0, size - 1)
    row = jnp.clip(((v + 1.0) * (0.5 * size)).astype(jnp.int32), 0, size - 1)
    return row * size + column


def texel_directions(size: int) -> Float[Array, "ss 3"]:
    """Unit directions of the middles of all texels."""
    index = jnp.arange(size * size)
    u = (index % size + 0.5) * (2.0 / size) - 1.0
    v = (index // size + 0.5) * (2.0 / size) - 1.0
    w = 1.0 - jnp.abs(u) - jnp.abs(v)
    inner_u = jnp.where(w < 0, (1.0 - jnp.abs(v)) * jnp.where(u >= 0, 1.0, -1.0), u)
    inner_v = jnp.where(w < 0, (1.0 - jnp.abs(u)) * jnp.where(v >= 0, 1.0, -1.0), v)
    return sampling.normalize(jnp.stack([inner_u, inner_v, w], axis=-1))


def first_rows(lights: LightSet) -> dict[str, int]:
    """Where the maps of each kind of light begin."""
    rows, start = {}, 0
    for name, block in blocks(lights):
        rows[name] = start
        start += block.position.shape[0]
    return rows


def build(
    scene: Scene, caster: ray_casting.Caster, lights: LightSet, *, size: int, num_steps: int, depth: bool, columns: bool
) -> Maps:
    """Maps of all lights: size^2 rays and size^2 * num_steps density lookups each."""
    position = jnp.concatenate([block.position for _, block in blocks(lights)])
    parts = [block.position if block.normal is None else _lifted(scene, block) for _, block in blocks(lights)]
    origin = np.asarray(jnp.concatenate(parts))
    directions = texel_directions(size)
    chunk = max(1, _CHUNK // (size * size))
    found: dict[str, list] = {"depth": [], "face": [], "reach": [], "columns": []}
    for begin in range(0, len(origin), chunk):
        part = jnp.asarray(origin[begin : begin + chunk])
        if depth:
            rays = (jnp.repeat(part, size * size, axis=0), jnp.tile(directions, (part.shape[0], 1)))
            t, face = ray_casting.intersect(caster, *rays, np.inf)
            found["depth"].append(np.asarray(t).reshape(-1, size * size))
            found["face"].append(np.asarray(face).reshape(-1, size * size))
        if columns:
            reach, column = _columns(scene.medium, part, directions, num_steps=num_steps)
            found["reach"].append(reach)
            found["columns"].append(column)
    joined = {name: jnp.concatenate([jnp.asarray(x) for x in found[name]]) if found[name] else None for name in found}
    nearest = None if joined["depth"] is None else jnp.min(joined["depth"], axis=1)
    return Maps(position, joined["depth"], joined["face"], nearest, joined["reach"], joined["columns"], size)


def _lifted(scene, block):
    scale = ray_casting.scene_scale(scene.mesh)
    return ray_casting.offset_origin(block.position, block.normal, block.normal, scale=scale)


@partial(jax.jit, static_argnames="num_steps")
def _columns(medium: Medium, origin, directions, *, num_steps):
    origin, direction = origin[:, None], directions[None]
    _, reach = media.box_interval(medium.bounds, origin, jnp.broadcast_to(direction, (origin.shape[0], *directions.shape)))
    h = reach / num_steps

    def body(total, i):
        position = origin + ((i + 0.5) * h)[..., None] * direction
        total = total + h * media.density(medium, position)
        return total, total

    _, columns = jax.lax.scan(body, jnp.zeros_like(h), jnp.arange(num_steps))
    return reach, jnp.moveaxis(columns, 0, -1)


def _texels(maps, index, offset):
    """Flat number of the texel of light `index` that looks along `offset`, and the length of `offset`."""
    length = jnp.sqrt(jnp.maximum(sampling.dot(offset, offset), 1e-30))
    return index * (maps.size * maps.size) + texel(offset, size=maps.size), length


@jax.jit
def visible(maps: Maps, index: Int[Array, "*b"], point: Float[Array, "*b 3"]) -> Bool[Array, "*b"]:
    """Whether lights `index` see the points: not farther than the depth of the texel, and a little."""
    flat, length = _texels(maps, index, point - maps.position[index])
    return length < maps.depth.reshape(-1)[flat] * (1.0 + _SLACK)


@jax.jit
def column(maps: Maps, index: Int[Array, "*b"], point: Float[Array, "*b 3"]) -> Float[Array, "*b"]:
    """Density column from lights `index` to the points: nearest texel, linear along it."""
    flat, length = _texels(maps, index, point - maps.position[index])
    number = maps.columns.shape[-1]
    x = jnp.clip(length / jnp.maximum(maps.reach.reshape(-1)[flat], 1e-30), 0.0, 1.0) * number
    step = jnp.minimum(x.astype(jnp.int32), number - 1)
    table = maps.columns.reshape(-1)
    after = table[flat * number + step]
    before = jnp.where(step > 0, table[flat * number + jnp.maximum(step - 1, 0)], 0.0)
    return before + (x - step) * (after - before)


def nearest_lights(tree: cKDTree, point: Float[Array, "n 3"]) -> Int[np.ndarray, "n"]:
    """The light closest to each point (host)."""
    return tree.query(np.asarray(point))[1].astype(np.int32)


def make_tree(maps: Maps) -> cKDTree:
    """For `nearest_lights`."""
    return cKDTree(np.asarray(maps.position))


@jax.jit
def surface_within(
    maps: Maps,
    mesh: Mesh,
    index: Int[Array, "n"],
    origin: Float[Array, "n 3"],
    direction: Float[Array, "n 3"],
    reach: Float[Array, "n"],
) -> tuple[Float[Array, "n"], Int[Array, "n"]]:
    """What short rays meet in the map of a light close by: (distance, face), (inf, -1) where nothing (approximate).

    A light whose least depth exceeds its distance plus `reach` sees no surface that the ray could meet. Else the first of
    a few points that lies behind the map's surface gives the face, and the plane of the face the distance.
    """
    distance = jnp.linalg.norm(origin - maps.position[index], axis=-1)
    near = maps.nearest[index] < distance + reach
    depth, faces = maps.depth.reshape(-1), maps.face.reshape(-1)

    def body(i, state):
        t_found, found = state
        t = (i + 1.0) * (1.0 / _LOCAL_STEPS) * reach
        flat, length = _texels(maps, index, origin + t[:, None] * direction - maps.position[index])
        behind = near & (length > depth[flat]) & (faces[flat] >= 0)
        plane = _plane_distance(mesh, faces[flat], origin, direction)
        meets = behind & (found < 0) & (plane > 0) & (plane <= t)
        return jnp.where(meets, plane, t_found), jnp.where(meets, faces[flat], found)

    nothing = (jnp.full(reach.shape, jnp.inf, jnp.float32), jnp.full(reach.shape, -1, jnp.int32))
    return jax.lax.fori_loop(0, _LOCAL_STEPS, body, nothing)


def _plane_distance(mesh, face, origin, direction):
    corners = mesh.vertices[mesh.faces[jnp.maximum(face, 0)]]
    normal = jnp.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    slope = sampling.dot(normal, direction)
    return sampling.dot(normal, corners[:, 0] - origin) / jnp.where(jnp.abs(slope) < 1e-20, 1e-20, slope)
