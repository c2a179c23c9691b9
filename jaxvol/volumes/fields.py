"""Procedural densities for scenes that ship with the project: a smoke plume, a cumulus cloud, a checkerboard.

All are functions of position in the unit cube and of the seed, y up, so that a finer resolution shows the same field.
Densities lie in [0, 1].
"""

import operator
from collections.abc import Callable, Sequence

import numpy as np
from scipy import ndimage

from jaxvol.volumes.grid import Volume

MAX_RESOLUTION = 1024  # per axis
_COARSE = 64  # cells per axis on which positions are traced back through the flow

Axes = tuple[np.ndarray, np.ndarray, np.ndarray]  # coordinates of cell centres along x, y, z, in (0, 1)


def procedural(name: str, *, resolution: int | Sequence[int] = 128, seed: int = 0) -> Volume:
    """The field `name` of `NAMES` on `resolution` cells (one number for a cube, or three).

    The box has its longest side 1, stands on y = 0 and is centred in x and z. Raises ValueError for an unknown name, a
    resolution outside 1 to 1024, a negative seed.
    """
    if name not in _FIELDS:
        raise ValueError(f"builtin volume {name!r} is unknown; there are {', '.join(NAMES)}")
    try:
        shape = tuple(operator.index(n) for n in (resolution if isinstance(resolution, Sequence) else [resolution] * 3))
        seed = operator.index(seed)
    except TypeError as error:
        raise ValueError(f"resolution = {resolution!r} and seed = {seed!r} must be whole numbers") from error
    if len(shape) != 3 or min(shape) < 1 or max(shape) > MAX_RESOLUTION:
        raise ValueError(f"resolution = {resolution!r} must be one or three whole numbers from 1 to {MAX_RESOLUTION}")
    if seed < 0:
        raise ValueError(f"seed = {seed} must be 0 or more")
    axes = tuple(_centers(n) for n in shape)
    density = np.clip(_FIELDS[name](axes, np.random.default_rng(seed)), 0, 1)
    size = np.array(shape) / max(shape)
    low = np.array([-size[0] / 2, 0, -size[2] / 2])
    return Volume(density=np.ascontiguousarray(density, np.float32), bounds=np.array([low, low + size]))


def _centers(num: int) -> np.ndarray:
    return (np.arange(num, dtype=np.float32) + 0.5) / num


def _along(axes: Axes, i: int) -> np.ndarray:
    """Coordinate i, shaped to broadcast over [x, y, z]."""
    return axes[i].reshape([-1 if i == j else 1 for j in range(3)])


def _smoothstep(low: float, high: float, x: np.ndarray) -> np.ndarray:
    t = np.clip((x - low) / (high - low), 0, 1)
    return t * t * (3 - 2 * t)


def _noise(axes: Axes, frequency: int, rng: np.random.Generator) -> np.ndarray:
    """Smooth noise [x, y, z] of unit variance, about: uniform cubic B-splines on `frequency` random knots per unit length."""
    values = rng.standard_normal((frequency + 3,) * 3, dtype=np.float32)
    for axis, coordinates in enumerate(axes):
        cell = np.floor(coordinates * frequency).astype(int)
        t = coordinates * frequency - cell
        basis = np.stack([(1 - t) ** 3, 3 * t**3 - 6 * t**2 + 4, 1 + 3 * t * (1 + t - t**2), t**3]) / 6
        weights = np.zeros((len(coordinates), frequency + 3), np.float32)
        for k in range(4):
            weights[np.arange(len(coordinates)), cell + k] = basis[k]
        values = np.moveaxis(np.tensordot(weights, values, axes=(1, axis)), 0, axis)
    return values * np.float32(2.9)  # a cubic B-spline in three dimensions keeps 0.48^3 of the variance


def _billows(axes: Axes, frequency: int, octaves: int, rng: np.random.Generator) -> np.ndarray:
    """Folded noise of mean about 0: creases where it is high, round bulges where it is low."""
    return sum((0.55**i) * (np.abs(_noise(axes, frequency * 2**i, rng)) - 0.8) for i in range(octaves))


def _curl(axes: Axes, potential: Sequence[np.ndarray]) -> list[np.ndarray]:
    """Velocity of a vector potential: free of divergence, so that it stirs without compressing."""
    d = [[np.gradient(potential[i], axes[j], axis=j) for j in range(3)] for i in range(3)]
    return [d[2][1] - d[1][2], d[0][2] - d[2][0], d[1][0] - d[0][1]]


def _lookup(field: np.ndarray, points: Sequence[np.ndarray]) -> np.ndarray:
    """Trilinear lookup of a field on the unit cube at points in [0, 1]^3, borders held."""
    index = [p * n - 0.5 for p, n in zip(points, field.shape, strict=True)]
    return ndimage.map_coordinates(field, index, order=1, mode="nearest", prefilter=False)


def _plume(axes: Axes, rng: np.random.Generator) -> np.ndarray:
    """Smoke that rises from the floor: a widening column, stirred ever longer the higher it has risen.

    Every cell is traced back through turbulence that rises with the smoke (curl noise, Bridson et al. 2007), and asks
    the still column about the place it came from; folded billows in that place's coordinates give the rolls.
    """
    coarse = tuple(_centers(max(8, min(len(a), _COARSE))) for a in axes)
    stirring = np.minimum(1, 0.15 + 1.6 * _along(coarse, 1))
    eddies = ((5, 0.0055), (9, 0.0048), (17, 0.0030))  # frequency, amplitude of the potential
    potential = [sum(amount * _noise(coarse, n, rng) for n, amount in eddies) * stirring for _ in range(3)]
    velocity = _curl(coarse, potential)
    shape = [len(c) for c in coarse]
    source = [np.array(np.broadcast_to(_along(coarse, i), shape)) for i in range(3)]
    num_steps = 8
    for _ in range(num_steps):
        moved = [_lookup(v, source) for v in velocity]
        source = [x - v / num_steps for x, v in zip(source, moved, strict=True)]

    # Cells that the column cannot reach are left out from here on.
    near = ndimage.binary_dilation(_column_distance(*source) < 1.5)
    where = np.nonzero(near[np.ix_(*(np.floor(a * len(c)).astype(int) for a, c in zip(axes, coarse, strict=True)))])
    points = [a[w] for a, w in zip(axes, where, strict=True)]
    x, y, z = (_lookup(s, points) for s in source)
    folds = _billows(tuple(_centers(max(8, min(len(a), 160))) for a in axes), 7, 4, rng)
    fold = _lookup(folds, (x, y, z))
    depth = 1 - _column_distance(x, y, z) - 0.45 * fold * np.minimum(1, 0.2 + 3 * np.clip(y, 0, 1))
    fading = 1 - _smoothstep(0.5, 0.9, points[1] + 0.1 * fold)
    for axis, (low, high) in enumerate(((0, 0.05), (-1, 0), (0, 0.05))):  # nothing touches the walls and the ceiling
        fading *= _smoothstep(low, high, points[axis]) * (1 - _smoothstep(0.95, 1, points[axis]))
    density = np.zeros([len(a) for a in axes], np.float32)
    density[where] = _smoothstep(0, 0.7, depth) * fading * np.sqrt(_column_radius(0) / _column_radius(y))
    return density


def _column_radius(y: np.ndarray) -> np.ndarray:
    return 0.06 + 0.20 * np.clip(y, 0, 1.2)


def _column_distance(x: np.ndarray, y: np.ndarray, z: np.ndarray) -> np.ndarray:
    """Distance from the bent axis of the still column, in its radius."""
    dx = x - 0.5 - 0.05 * y * np.sin(4 * y + 1)
    dz = z - 0.5 - 0.05 * y * np.cos(4 * y)
    return np.sqrt(dx * dx + dz * dz) / _column_radius(y)


def _cumulus(axes: Axes, rng: np.random.Generator) -> np.ndarray:
    """A fair-weather cloud: heaps of spheres on a flat base, smaller ones on the upper sides of larger ones, wrinkled."""
    base = 0.14
    centers, radii = _heap(base, rng)
    depth = np.full([len(a) for a in axes], -1, np.float32)  # below the surface of the nearest sphere
    margin = 0.03
    for center, radius in zip(centers, radii, strict=True):
        box = tuple(
            slice(*np.searchsorted(a, (c - radius - margin, c + radius + margin))) for a, c in zip(axes, center, strict=True)
        )
        dx, dy, dz = (_along([a[b] for a, b in zip(axes, box, strict=True)], i) - center[i] for i in range(3))
        np.maximum(depth[box], radius - np.sqrt(dx * dx + dy * dy + dz * dz), out=depth[box])
    wrinkles = _billows(axes, 10, 3, rng)
    height = _along(axes, 1) - base - 0.012 * _noise(axes, 8, rng)
    depth = np.minimum(depth - 0.022 * wrinkles, height - 0.008 * wrinkles)
    # Water content grows with height above the base.
    return _smoothstep(-0.004, 0.04, depth) * (0.45 + 0.55 * _smoothstep(0, 0.4, height))


def _heap(base: float, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Centres [n, 3] and radii [n] of three generations of spheres."""
    num = 11
    x, z = np.clip(0.5 + rng.normal(0, (0.17, 0.14), (num, 2)), 0.25, 0.75).T
    radius = np.clip(0.24 - 0.55 * np.hypot(x - 0.5, z - 0.5), 0.07, 1) * rng.uniform(0.65, 1.1, num)
    # The thickest have risen highest.
    center = np.stack([x, base + 0.3 * radius + 1.1 * np.maximum(radius - 0.12, 0), z], axis=-1)
    generations = [(center, radius)]
    for num_children in (16, 12):
        direction = rng.normal(size=(len(radius) * num_children, 3))
        direction[:, 1] = 0.9 * np.abs(direction[:, 1]) + 0.1 * direction[:, 1]
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        parent = np.repeat(radius, num_children)
        center = np.repeat(center, num_children, axis=0) + 0.92 * parent[:, None] * direction
        radius = 0.42 * parent * rng.uniform(0.7, 1.25, len(parent))
        generations.append((center, radius))
    centers, radii = zip(*generations, strict=True)
    return np.concatenate(centers), np.concatenate(radii)


def _checker(axes: Axes, rng: np.random.Generator) -> np.ndarray:
    """Eight boxes along each axis, empty and full in turn; the seed changes nothing."""
    del rng
    return sum(np.floor(8 * _along(axes, i)) for i in range(3)) % 2


_FIELDS: dict[str, Callable[[Axes, np.random.Generator], np.ndarray]] = {
    "plume": _plume,
    "cumulus": _cumulus,
    "checker": _checker,
}
NAMES = tuple(_FIELDS)
