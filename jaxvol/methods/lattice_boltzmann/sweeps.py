"""Transport by sweeps: eliminate the directions of the lattice, keep one scalar source per voxel.

Per direction the arrivals obey a first-order recurrence along lines of voxels, f_i(r + c_i) = passing_i f_i(r) +
w_i beta_i s(r). A scan over the planes of one axis runs it for all directions with a component along that axis; the
carried plane moves by a row or column for diagonal directions. One application crosses the whole grid, so that
iterations count scattering orders and not voxels. The fixed point is that of the plain lattice iteration (stepping.py).

Cost: 26 directions about 50 to 80 ns per voxel and CPU second, two to three times six directions.
"""

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from jaxvol.methods.lattice_boltzmann.lattice import Coefficients, Lattice, link_length

_TO_AXIS = {0: (0, 1, 2), 1: (1, 0, 2), 2: (2, 0, 1)}  # transposition that makes the axis the leading one
_FROM_AXIS = {0: (0, 1, 2), 1: (1, 0, 2), 2: (1, 2, 0)}


def transport(lattice: Lattice, coefficients: Coefficients, source: Float[Array, "X Y Z"]) -> Float[Array, "X Y Z"]:
    """phi = B s: the fluence times h^2 [W] that an isotropic source s [W per voxel] makes without any further scattering."""
    phi = coefficients.own * source
    for axis in range(3):
        along = _TO_AXIS[axis]
        fields = _leading(coefficients, along)
        plane_steps = _plane_steps(lattice, axis)
        if not plane_steps:
            continue
        moved = jnp.transpose(source, along)
        forward = _scan(lattice, fields, moved, plane_steps, reverse=False)
        backward = _scan(lattice, fields, moved, plane_steps, reverse=True)
        phi = phi + jnp.transpose(forward + backward, _FROM_AXIS[axis])
    return phi


def _plane_steps(lattice: Lattice, axis: int) -> tuple[tuple[int, int, int], ...]:
    """(class, row step, column step) of the directions that advance along `axis` and along no earlier axis."""
    others = [a for a in _TO_AXIS[axis] if a != axis]
    steps = []
    for c in lattice.directions:
        if c[axis] == 1 and all(c[earlier] == 0 for earlier in range(axis)):
            steps.append((sum(component != 0 for component in c), c[others[0]], c[others[1]]))
    return tuple(steps)


def _leading(coefficients: Coefficients, along: tuple[int, int, int]):
    def move(value):
        return value if jnp.ndim(value) == 0 else jnp.transpose(value, along)

    gather = tuple(move(value) for value in coefficients.gather)
    passing = None if coefficients.passing is None else tuple(move(value) for value in coefficients.passing)
    return gather, passing


def _scan(lattice, fields, source, plane_steps, *, reverse):
    """Sum over the directions of gather * arrivals, [N, rows, columns], for one sense along the leading axis."""
    gather, passing = fields
    classes = lattice.classes
    used = sorted({cls for cls, _, _ in plane_steps})
    gather = {cls: gather[classes.index(cls)] for cls in used}
    passing = None if passing is None else {cls: passing[classes.index(cls)] for cls in used}
    varying = jnp.ndim(next(iter(gather.values()))) > 0

    def body(arrivals, planes):
        if varying:
            source_plane, gather_plane, passing_plane = planes
        else:
            source_plane, gather_plane, passing_plane = planes, gather, passing
        emitted = {cls: lattice.weight(cls) / link_length(cls) * gather_plane[cls] * source_plane for cls in used}
        through = {
            cls: 2.0 / link_length(cls) * gather_plane[cls] - 1.0 if passing_plane is None else passing_plane[cls]
            for cls in used
        }
        sums = dict.fromkeys(used, 0.0)
        leaving = []
        for f, (cls, row_step, column_step) in zip(arrivals, plane_steps, strict=True):
            sums[cls] = sums[cls] + f
            leaving.append(move_plane(through[cls] * f + emitted[cls], row_step, column_step))
        return tuple(leaving), sum(gather_plane[cls] * sums[cls] for cls in used)

    start = tuple(jnp.zeros(source.shape[1:], source.dtype) for _ in plane_steps)
    planes = (source, gather, passing) if varying else source
    _, gathered = lax.scan(body, start, planes, reverse=reverse)
    return gathered


def move_plane(plane: Float[Array, "*b rows columns"], row_step: int, column_step: int) -> Float[Array, "*b rows columns"]:
    """out[r + row_step, c + column_step] = plane[r, c]; zeros come in, what leaves is lost."""
    if row_step == 0 and column_step == 0:
        return plane
    padding = (*((0, 0, 0),) * (plane.ndim - 2), (row_step, -row_step, 0), (column_step, -column_step, 0))
    return lax.pad(plane, jnp.zeros((), plane.dtype), padding)


def both_senses(
    fields: Float[Array, "n X Y Z"], along: tuple[int, int, int], *, signs: np.ndarray | float = 1.0, mirrored: int = 1
) -> Float[Array, "planes 2 n rows columns"]:
    """Planes across the axis `along[0]` of a grid and of itself mirrored along the first `mirrored` axes of `along`.

    `signs` [n] is what the mirror does to the fields.
    """
    moved = jnp.transpose(fields, (0, *(1 + a for a in along)))
    return jnp.moveaxis(jnp.stack([moved, _mirror(moved, signs, mirrored)]), 2, 0)


def one_grid(
    planes: Float[Array, "planes 2 n rows columns"],
    along: tuple[int, int, int],
    *,
    signs: np.ndarray | float = 1.0,
    mirrored: int = 1,
) -> Float[Array, "n X Y Z"]:
    """The sum of both, back in the grid that `both_senses` took."""
    here, there = jnp.moveaxis(planes, 0, 2)
    return jnp.transpose(here + _mirror(there, signs, mirrored), (0, *(1 + int(k) for k in np.argsort(along))))


def _mirror(fields, signs, mirrored):
    flipped = jnp.flip(fields, tuple(range(1, 1 + mirrored)))
    if np.ndim(signs) == 0:
        return flipped
    return jnp.asarray(signs, fields.dtype)[:, None, None, None] * flipped
