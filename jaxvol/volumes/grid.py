"""A density field on a regular grid, and the checks that every reader ends with."""

import os
from dataclasses import dataclass

import numpy as np

MAX_VOXELS = 1 << 29  # 2 GiB as float32


@dataclass(frozen=True)
class Volume:
    """Density at cell centres, and the box of the cells' outer faces."""

    density: np.ndarray  # [x, y, z] float32, finite, >= 0
    bounds: np.ndarray  # [2, 3] float64: lowest and highest corner, scene units


def check_shape(path: str | os.PathLike, shape: tuple[int, ...]) -> None:
    """Refuse (ValueError) grids that are not three-dimensional, empty, or too large to hold, before any allocation."""
    if len(shape) != 3:
        raise ValueError(f"{path}: density must be a grid [x, y, z]; it has shape {shape}")
    if min(shape) < 1:
        raise ValueError(f"{path}: the grid is empty ({' x '.join(map(str, shape))} voxels)")
    if shape[0] * shape[1] * shape[2] > MAX_VOXELS:
        raise ValueError(f"{path}: claims {' x '.join(map(str, shape))} voxels; at most {MAX_VOXELS} are read")


def checked(path: str | os.PathLike, density: np.ndarray, bounds: np.ndarray) -> Volume:
    """A Volume of finite densities >= 0 in a box of positive extent; ValueError names the file and what is wrong."""
    check_shape(path, density.shape)
    with np.errstate(over="ignore"):  # float64 beyond float32 turns infinite and is refused below
        density = np.ascontiguousarray(density, np.float32)
    bounds = np.array(bounds, np.float64).reshape(2, 3)
    if num_bad := int(np.sum(~np.isfinite(density))):
        raise ValueError(f"{path}: {num_bad} of {density.size} densities are not finite")
    if num_bad := int(np.sum(density < 0)):
        low = float(density.min())
        raise ValueError(f"{path}: {num_bad} of {density.size} densities are negative (down to {low:.6g}); is it a level set?")
    if not (np.isfinite(bounds).all() and (bounds[0] < bounds[1]).all()):
        low, high = bounds.tolist()
        raise ValueError(f"{path}: its bounds {low} to {high} are no box")
    return Volume(density=density, bounds=bounds)
