"""The steady state of the lattice: phi = B (k phi + b), solved by preconditioned conjugate gradients.

u = sqrt(k) phi makes it symmetric positive definite, (I - sqrt(k) B sqrt(k)) u = sqrt(k) B b, for every lattice of
lattice.py. Gradients come from the same solve with the transposed right side (implicit differentiation by lineax), never
from the unrolled iteration. The number of applications of B does not depend on the resolution; plain iteration
(stepping.py) needs as many steps as light needs to cross the grid, times the scattering orders.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import lineax as lx
from jaxtyping import Array, Bool, Float, Int

from jaxvol import slopes
from jaxvol.methods.lattice_boltzmann import preconditioner
from jaxvol.methods.lattice_boltzmann.krylov import ConjugateGradients
from jaxvol.methods.lattice_boltzmann.lattice import Coefficients, Lattice
from jaxvol.methods.lattice_boltzmann.sweeps import transport


class Solution(NamedTuple):
    """phi = fluence * h^2 [W], per voxel; its parts by scattering order; how the solve went."""

    phi_first: Float[Array, "X Y Z"]  # B b: light that scattered once in the medium and arrives (sources: b)
    phi: Float[Array, "X Y Z"]  # all scattered light
    num_applications: Int[Array, ""]  # of B, all counted
    residual: Float[Array, ""]  # |u - sqrt(k) B (sqrt(k) u + b)| / |sqrt(k) B b|
    converged: Bool[Array, ""]


def solve(
    lattice: Lattice,
    coefficients: Coefficients,
    deposit: Float[Array, "X Y Z"],
    *,
    tolerance: float = 1e-4,
    max_steps: int = 100,
    levels: tuple[preconditioner.Level, ...] | None = None,
) -> Solution:
    """Solve for the scattered light that `deposit` (W scattered per voxel out of the marched light, isotropic) makes.

    `levels` from `preconditioner.build`; None = plain conjugate gradients. `tolerance` is of the residual of u, relative.

    Where k is 0 sqrt(k) has no slope, and u is 0 whatever phi is: for slopes dk sends out phi dk there, as a deposit would.
    """

    def plain(coefficients, deposit, tolerance, levels):
        return _solve(lattice, coefficients, deposit, tolerance, max_steps, levels)

    @jax.custom_jvp
    def solved(coefficients, deposit, tolerance, levels):
        return plain(coefficients, deposit, tolerance, levels)

    @solved.defjvp
    def along(primals, tangents):
        k, dk = primals[0].scattering, tangents[0].scattering
        sent = jnp.where(k > 0, 0.0, dk * solved(*primals).phi)
        solving = partial(plain, tolerance=primals[2], levels=primals[3])
        value, slope = jax.jvp(solving, primals[:2], (tangents[0], tangents[1] + sent))
        return value, slope._replace(phi_first=slope.phi_first - transport(lattice, primals[0], sent))

    return solved(coefficients, deposit, tolerance, levels)


def _solve(lattice, coefficients, deposit, tolerance, max_steps, levels):
    root = slopes.root(coefficients.scattering)
    phi_first = transport(lattice, coefficients, deposit)
    right = root * phi_first
    size = jnp.sqrt(jnp.sum(right * right))
    scale = jnp.where(size > 0, size, 1.0)

    def operator(u):
        return u - root * transport(lattice, coefficients, root * u)

    # how fast the solve goes is no part of its answer, so nothing is differentiated here
    inside = root if coefficients.wall is None else jnp.where(coefficients.wall, 0.0, root)
    inside, frozen_levels = jax.lax.stop_gradient((inside, levels))

    def precondition(r):
        return r if levels is None else r + inside * preconditioner.v_cycle(frozen_levels, inside * r)

    structure = jax.eval_shape(lambda: right)
    symmetric = lx.positive_semidefinite_tag
    answer = lx.linear_solve(
        lx.FunctionLinearOperator(operator, structure, symmetric),
        right,
        ConjugateGradients(tolerance=tolerance, max_steps=max_steps),
        options={"preconditioner": lx.FunctionLinearOperator(precondition, structure, symmetric)},
        throw=False,
    )
    u = answer.value
    phi = transport(lattice, coefficients, root * u + deposit)
    residual = jax.lax.stop_gradient(jnp.sqrt(jnp.sum((u - root * phi) ** 2)) / scale)  # at 0 it has no slope
    return Solution(
        phi_first=phi_first,
        phi=phi,
        num_applications=answer.stats["num_steps"] + 2,  # B b and the final phi
        residual=residual,
        converged=residual <= 2.0 * tolerance,
    )
