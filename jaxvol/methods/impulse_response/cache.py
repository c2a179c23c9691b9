"""Stage 3, cached irradiance: what the surfaces send on is known at some points, so that paths end at their first vertex.

Ward, Rubinstein and Clear 1988 keep irradiance where a picture needs it; here at vertices that the receivers' own paths
find. Light that has left one surface is so smooth that the nearest point serves; the receivers' own light is never cached.
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, Int
from scipy.spatial import cKDTree

from jaxvol import ray_casting

_CANDIDATES, _TRIES = 6, 3
_FLATNESS = 32.0  # what lies off the plane of a point counts as that much further away
_RISE = 0.25  # of their distance, of the way between two points over their surface


class Cache(eqx.Module):
    """Irradiance at points of surfaces: straight from the emitters, and all the rest; one row more, for darkness."""

    tree: cKDTree = eqx.field(static=True)  # over positions in units of `spacing`, and normals
    spacing: float = eqx.field(static=True)
    caster: ray_casting.Caster | None = eqx.field(static=True)  # None: nothing stands between any points
    straight: Float[Array, "M+1 3"]
    rest: Float[Array, "M+1 3"]


def unlit(position: Float[np.ndarray, "M 3"], normal: Float[np.ndarray, "M 3"], caster: ray_casting.Caster | None) -> Cache:
    """The points alone. Both sides of a wall are 8 spacings of points apart, so that light does not leak."""
    near = cKDTree(position).query(position, k=2)[0][:, 1]
    spacing = 4 * max(float(np.median(near)), float(np.ptp(position, axis=0).max()) * 1e-3)
    nothing = jnp.zeros((len(position) + 1, 3), jnp.float32)
    return Cache(cKDTree(np.concatenate([position / spacing, normal], axis=1)), spacing, caster, nothing, nothing)


def nearest(known: Cache, position: Float[ArrayLike, "n 3"], normal: Float[ArrayLike, "n 3"]) -> Int[np.ndarray, "n"]:
    """The cached point that serves each point: near, on its side, in its plane rather than behind it, and seen from it.

    Darkness (the last row) where none of a few is seen: what no path has visited nearby is dark or hardly counts.
    """
    position, normal = np.nan_to_num(np.asarray(position)), np.nan_to_num(np.asarray(normal))
    distance, index = known.tree.query(np.concatenate([position / known.spacing, normal], axis=1), k=_CANDIDATES)
    off = np.einsum("nkd,nd->nk", known.tree.data[index, :3] - position[:, None] / known.spacing, normal)
    order = np.argsort(distance**2 + (_FLATNESS * off) ** 2, axis=1)
    found = np.full(len(position), known.tree.n)
    unseen = np.arange(len(position))
    for turn in range(_TRIES):
        chosen = index[unseen, order[unseen, turn]]
        cut = _cut(known, position[unseen], normal[unseen], known.tree.data[chosen])
        found[unseen[~cut]] = chosen[~cut]
        unseen = unseen[cut]
        if unseen.size == 0:
            break
    return found


def _cut(known, position, normal, there):
    """Whether a surface stands between points and cached ones, a little above both so that curved surfaces do not."""
    if known.caster is None:
        return np.zeros(len(position), bool)
    target = there[:, :3] * known.spacing
    lift = np.maximum(_RISE * np.linalg.norm(target - position, axis=1), 1e-4 * known.spacing)[:, None]
    start = (position + lift * normal).astype(np.float32)
    way = target + lift * there[:, 3:] - start
    length = np.maximum(np.linalg.norm(way, axis=1), 1e-30)
    direction = (way / length[:, None]).astype(np.float32)
    rays = (start, direction, length.astype(np.float32))
    lanes = len(start)
    if not isinstance(known.caster, ray_casting.EmbreeCaster):  # few shapes, so few compilations
        lanes = 256
        while lanes < len(start):
            lanes *= 4
    rays = (np.resize(x, (lanes, *x.shape[1:])) for x in rays)
    return np.asarray(ray_casting.occluded(known.caster, *rays))[: len(start)]
