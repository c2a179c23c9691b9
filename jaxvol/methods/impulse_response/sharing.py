"""Stage 3, shared receivers: reflected and scattered light at a few of them, interpolated to all; direct light at each.

Light that has met a surface or the medium is smooth over surfaces (Ward, Rubinstein and Clear 1988; the paper's game
pipeline bakes it at the texels of coarse maps). Locally linear regression in the tangent plane gives the weights, damped
where it would multiply noise; nothing is taken from behind walls, other planes, or receivers that a surface hides.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import cKDTree

from jaxvol import ray_casting, sampling

_NEIGHBOURS, _RAYS = 12, 12
_REACH = 3.0  # of the cells' side: where a neighbour's weight ends
_ALIGNED, _FLAT = 0.9, 0.25  # cosine between normals; distance from the plane, of the cells' side
_CRAMPED = 0.25  # mean distance of what a receiver sees, of the cells' side, below which it stands alone
_RIDGE = 0.3  # on slopes, of the cells' side squared: neighbours in a row say nothing across it


class Shared(NamedTuple):
    """Which receivers are baked in full, and how the others follow from them."""

    rows: Int[np.ndarray, "K"]
    neighbours: Int[np.ndarray, "N 12"]  # among rows
    weights: Float[np.ndarray, "N 12"]

    def spread(self, values: Float[np.ndarray, "K *rest"]) -> Float[np.ndarray, "N *rest"]:
        """Values at all receivers."""
        return np.einsum("nk,nk...->n...", self.weights, values[self.neighbours])

    def spread_variance(self, variance: Float[np.ndarray, "K 3"]) -> Float[np.ndarray, "N 3"]:
        """Variance of independent values, spread."""
        return np.einsum("nk,nkc->nc", self.weights**2, variance[self.neighbours])


def choose(points, normals, *, share: int, caster: ray_casting.Caster | None) -> Shared:
    """About one of `share` receivers [N, 3], evenly over the surfaces; `caster` None: nothing hides any from another."""
    points, normals = np.asarray(points, np.float64), np.asarray(normals, np.float64)
    side, cell = _cells(points, normals, len(points) / share)
    rows = _middles(points, cell)
    neighbours, weights = _weights(points, normals, rows, side, caster)
    if caster is not None:
        weights[_openness(points, normals, side, caster) < _CRAMPED * side] = 0
    alone = np.flatnonzero(weights.sum(axis=1) == 0)
    neighbours[alone], weights[alone] = 0, 0
    neighbours[alone, 0], weights[alone, 0] = len(rows) + np.arange(len(alone)), 1
    return Shared(np.concatenate([rows, alone]), neighbours, weights)


def _cells(points, normals, wanted):
    """Side of cubes that hold the receivers in about the wanted number of groups of like normals, and each one's group."""
    low, extent = points.min(axis=0), float(np.ptp(points, axis=0).max())
    axis = np.abs(normals).argmax(axis=1)
    facing = 2 * axis + (np.take_along_axis(normals, axis[:, None], axis=1)[:, 0] < 0)
    few, many = extent * 1e-4, extent
    for _ in range(16):
        side = np.sqrt(few * many)
        keys = np.concatenate([np.floor((points - low) / side), facing[:, None]], axis=1).astype(np.int64)
        cell = np.unique(keys, axis=0, return_inverse=True)[1].reshape(-1)
        few, many = (side, many) if cell.max() + 1 > wanted else (few, side)
    return side, cell


def _middles(points, cell):
    """The receiver nearest to the mean of each cell."""
    count = np.bincount(cell)
    mean = np.stack([np.bincount(cell, points[:, c]) for c in range(3)], axis=1) / count[:, None]
    off = np.linalg.norm(points - mean[cell], axis=1)
    order = np.lexsort((off, cell))
    return order[np.concatenate([[0], np.cumsum(count)[:-1]])]


def _weights(points, normals, rows, side, caster):
    """Neighbours of every receiver among `rows` and what each counts; all 0 where none may serve."""
    k = min(_NEIGHBOURS, len(rows))
    tree = cKDTree(np.concatenate([points[rows] / side, normals[rows]], axis=1))
    neighbours = tree.query(np.concatenate([points / side, normals], axis=1), k=k)[1].reshape(len(points), k)
    there, facing = points[rows][neighbours], normals[rows][neighbours]
    delta = (there - points[:, None]) / side
    off = np.abs(np.einsum("nkd,nd->nk", delta, normals))
    distance = np.linalg.norm(delta, axis=2)
    near = np.maximum(1 - distance / _REACH, 0) ** 2 + 1e-9
    serves = (np.einsum("nkd,nd->nk", facing, normals) > _ALIGNED) & (off < _FLAT) & (distance < _REACH)
    if caster is not None:
        serves &= ~_hidden(points, normals, there, facing, side, caster)
    near = np.where(serves, near, 0)
    s, t = (np.asarray(axis, np.float64) for axis in sampling.orthonormal_basis(np.float32(normals)))
    basis = np.stack([np.ones_like(off), np.einsum("nkd,nd->nk", delta, s), np.einsum("nkd,nd->nk", delta, t)], axis=2)
    total = near.sum(axis=1)
    moments = np.einsum("nk,nki,nkj->nij", near, basis, basis)
    moments[:, [1, 2], [1, 2]] += _RIDGE * total[:, None]
    moments[total == 0] = np.eye(3)
    plane = np.linalg.solve(moments, np.broadcast_to(np.eye(3)[:, :1], (len(points), 3, 1)))[..., 0]
    return neighbours, near * np.einsum("nki,ni->nk", basis, plane)


def _openness(points, normals, side, caster):
    """Harmonic mean distance of what each receiver sees (Ward's split sphere), along twelve directions."""
    lift = 1e-3 * side
    s, t = (np.asarray(axis, np.float64) for axis in sampling.orthonormal_basis(np.float32(normals)))
    closeness = np.zeros(len(points))
    far = np.full(len(points), np.inf, np.float32)
    for i in range(_RAYS):
        sine, turn = np.sqrt((i + 0.5) / _RAYS), i * np.pi * (3 - np.sqrt(5))
        way = np.sqrt(1 - sine * sine) * normals + sine * (np.cos(turn) * s + np.sin(turn) * t)
        found = ray_casting.intersect(caster, np.float32(points + lift * normals), np.float32(way), far)[0]
        closeness += 1 / np.maximum(np.asarray(found, np.float64), 1e-30)
    return _RAYS / np.maximum(closeness, 1e-30)


def _hidden(points, normals, there, facing, side, caster):
    """Whether a surface stands between receivers and their neighbours, a little above both."""
    lift = 0.02 * side
    start = (points + lift * normals)[:, None]
    way = there + lift * facing - start
    length = np.maximum(np.linalg.norm(way, axis=2), 1e-30)
    rays = (np.broadcast_to(start, way.shape), way / length[..., None], length)
    cut = ray_casting.occluded(caster, *(np.float32(x).reshape(-1, *x.shape[2:]) for x in rays))
    return np.asarray(cut).reshape(length.shape)
