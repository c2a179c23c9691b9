"""Diffusion as a preconditioner of the transport solve, for media of any density: one multigrid V-cycle.

With u = sqrt(k) phi the solver inverts I - sqrt(k) B sqrt(k). By the Woodbury identity its inverse is
I + sqrt(k) (B^-1 - k)^-1 sqrt(k), and in a scattering medium B^-1 - k is close to the diffusion operator
H = sigma_a h - h^2 div (1/(3 sigma_t h)) grad with Marshak's condition at open faces: diffusion synthetic acceleration.
H^-1 is one symmetric V-cycle (cell-centred, harmonic face coefficients, damped Jacobi, trilinear transfers), so that the
preconditioner is symmetric positive definite and serves conjugate gradients. The specification's sine-transform form is
the special case of a homogeneous cube; this one also follows 100:1 density contrasts and voids.

The transfers are small matrix products on purpose: XLA fuses across levels otherwise, and computes every coarse value
again for each fine neighbour (measured: 15x slower at 64^3).
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from jaxvol.methods.lattice_boltzmann.lattice import ProbabilityMap

# Links longer than this many voxels without a collision are no diffusion; it also bounds 1/(3 sigma_t h) in voids.
_MIN_THICKNESS = 0.05
_SMOOTHING = 6.0 / 7.0  # damping of Jacobi, the optimum for the constant-coefficient stencil in 3D
_COARSEST = 4  # largest side of the last grid, which is smoothed to the end
_COARSEST_STEPS = 8


class Level(NamedTuple):
    """One grid: conductances of the faces towards +x, +y, +z (0 at the last plane), and the diagonal."""

    faces: tuple[Float[Array, "X Y Z"], Float[Array, "X Y Z"], Float[Array, "X Y Z"]]
    diagonal: Float[Array, "X Y Z"]


def build(
    shape: tuple[int, int, int],
    extinction: Float[Array, "..."],
    absorption: Float[Array, "..."],
    *,
    kind: ProbabilityMap = "pade",
) -> tuple[Level, ...]:
    """The grids of the V-cycle, finest first, from sigma_t h and sigma_a h (scalars or [X, Y, Z]).

    With the exponential map light diffuses through thick voxels as if they were 2 tanh(sigma_t h / 2) thick.
    """
    extinction = jnp.broadcast_to(jnp.asarray(extinction, jnp.float32), shape)
    extinction = 2.0 * jnp.tanh(0.5 * extinction) if kind == "exp" else extinction
    sink = jnp.broadcast_to(jnp.asarray(absorption, jnp.float32), shape)
    diffusion = 1.0 / (3.0 * jnp.maximum(extinction, _MIN_THICKNESS))
    faces = []
    for axis in range(3):
        there = _from_above(diffusion, axis)  # 0 beyond the last plane: no face
        faces.append(2.0 * diffusion * there / (diffusion + there))
        index = np.arange(shape[axis]).reshape([-1 if a == axis else 1 for a in range(3)])
        num_open = (index == 0).astype(np.float32) + (index == shape[axis] - 1)
        sink = sink + num_open / (2.0 + 0.5 / diffusion)  # half a voxel of diffusion, then Marshak's J = phi/2
    levels = [_level(faces, sink)]
    while max(levels[-1].diagonal.shape) > _COARSEST:
        faces = [_coarsen_face(face, axis) for axis, face in enumerate(faces)]
        sink = _sum_blocks(sink)
        levels.append(_level(faces, sink))
    return tuple(levels)


def _level(faces, sink):
    diagonal = sink
    for axis, face in enumerate(faces):
        diagonal = diagonal + face + _from_below(face, axis)
    return Level(tuple(faces), diagonal)


def _from_below(field, axis):
    """The neighbour's value at -1 along the axis; 0 at the first plane."""
    padding = [(1, -1, 0) if a == axis else (0, 0, 0) for a in range(3)]
    return lax.pad(field, jnp.zeros((), field.dtype), padding)


def _from_above(field, axis):
    padding = [(-1, 1, 0) if a == axis else (0, 0, 0) for a in range(3)]
    return lax.pad(field, jnp.zeros((), field.dtype), padding)


def _even(field, axis):
    side = field.shape[axis]
    return jnp.pad(field, [(0, side % 2 if a == axis else 0) for a in range(3)])


def _pairs(field, axis):
    """Sums of neighbours two by two along the axis; an odd last plane stays alone."""
    field = _even(field, axis)
    first = lax.slice_in_dim(field, 0, None, stride=2, axis=axis)
    return first + lax.slice_in_dim(field, 1, None, stride=2, axis=axis)


def _sum_blocks(field):
    for axis in range(3):
        field = _pairs(field, axis)
    return field


def _coarsen_face(face, axis):
    """Conductance of a coarse face: the sum over its four fine faces, over twice the distance."""
    face = lax.slice_in_dim(_even(face, axis), 1, None, stride=2, axis=axis)  # faces between blocks are the odd ones
    for other in range(3):
        if other != axis:
            face = _pairs(face, other)
    return 0.5 * face


def _apply(level, field):
    total = level.diagonal * field
    for axis, face in enumerate(level.faces):
        total = total - face * _from_above(field, axis) - _from_below(face * field, axis)
    return total


def _interpolation(side: int) -> np.ndarray:
    """[side, ceil(side / 2)]: linear interpolation from coarse to fine cell centres, held constant at the ends."""
    coarse = -(-side // 2)
    matrix = np.zeros((side, coarse), np.float32)
    for fine in range(side):
        near = fine // 2
        far = min(max(near + (1 if fine % 2 else -1), 0), coarse - 1)
        matrix[fine, near] += 0.75
        matrix[fine, far] += 0.25
    return matrix


def _restrict(field):
    x, y, z = (_interpolation(side) for side in field.shape)
    field = jnp.einsum("xyz,xX->Xyz", field, x)
    field = jnp.einsum("xyz,yY->xYz", field, y)
    return jnp.einsum("xyz,zZ->xyZ", field, z)


def _prolong(field, shape):
    x, y, z = (_interpolation(side) for side in shape)
    field = jnp.einsum("xyz,Zz->xyZ", field, z)
    field = jnp.einsum("xyz,Yy->xYz", field, y)
    return jnp.einsum("xyz,Xx->Xyz", field, x)


def v_cycle(levels: tuple[Level, ...], right: Float[Array, "X Y Z"]) -> Float[Array, "X Y Z"]:
    """Approximate H^-1 right by one V(1,1) cycle from zero; linear and symmetric in `right`."""
    level = levels[0]
    scale = _SMOOTHING / level.diagonal
    field = scale * right
    if len(levels) == 1:
        return lax.fori_loop(0, _COARSEST_STEPS, lambda _, f: f + scale * (right - _apply(level, f)), field)
    correction = v_cycle(levels[1:], _restrict(right - _apply(level, field)))
    field = field + _prolong(correction, right.shape)
    return field + scale * (right - _apply(level, field))
