"""Preconditioned conjugate gradients, and their form for operators that are not symmetric, as lineax solvers.

Why not `lineax.CG`: its breakdown test compares with 100 eps * (number of unknowns), which in float32 exceeds 1 from
83,000 unknowns on and turns every step into NaN; and it asks the last step, not only the residual, to be below the
tolerance of the right side. Why not `lineax.BiCGStab`: in float32 it takes every negative omega, alpha or rho for a
breakdown, and stops. lineax still does the implicit differentiation.
"""

from typing import Any

import jax.numpy as jnp
import lineax as lx
from jax import lax
from jaxtyping import Array, Float


class _Solver(lx.AbstractLinearSolver):
    """What both solvers tell lineax."""

    def init(self, operator: lx.AbstractLinearOperator, options: dict[str, Any]):
        return lx.linearise(operator)

    def transpose(self, state, options: dict[str, Any]):
        flipped = dict(options)
        if "preconditioner" in options:
            flipped["preconditioner"] = options["preconditioner"].transpose()
        return state.transpose(), flipped

    def conj(self, state, options: dict[str, Any]):
        return lx.conj(state), options

    def assume_full_rank(self):
        return True


class ConjugateGradients(_Solver):
    """Solve A y = b, A symmetric positive definite, b one array, until |b - A y| <= tolerance |b|.

    Starts from zero. Options: `preconditioner` (a symmetric positive definite operator). Stats: `num_steps`, `residual`.
    """

    tolerance: float
    max_steps: int

    def compute(self, state, vector: Float[Array, "..."], options: dict[str, Any]):
        operator = state
        preconditioner = options.get("preconditioner")
        precondition = (lambda r: r) if preconditioner is None else preconditioner.mv
        limit = self.tolerance * self.tolerance * _dot(vector, vector)

        def unfinished(carry):
            _, r, _, gamma, step = carry
            return (_dot(r, r) > limit) & (step < self.max_steps) & (gamma > 0)

        def advance(carry):
            y, r, p, gamma_before, step = carry
            z = precondition(r)
            gamma = _dot(r, z)
            p = z + (gamma / gamma_before) * p
            image = operator.mv(p)
            alpha = gamma / _dot(p, image)
            return y + alpha * p, r - alpha * image, p, gamma, step + 1

        nothing = jnp.zeros_like(vector)
        carry = (nothing, vector, nothing, jnp.ones((), vector.dtype), 0)
        y, r, _, _, num_steps = lax.while_loop(unfinished, advance, carry)
        return _answer(y, r, vector, num_steps)


class BiconjugateGradients(_Solver):
    """Solve A y = b, A any, b one array, until |b - A y| <= tolerance |b|: BiCGStab (van der Vorst 1992), two A a step.

    Starts from zero. Options: `preconditioner`, applied from the right. Stats: `num_steps`, `residual`.
    """

    tolerance: float
    max_steps: int

    def compute(self, state, vector: Float[Array, "..."], options: dict[str, Any]):
        operator = state
        preconditioner = options.get("preconditioner")
        precondition = (lambda r: r) if preconditioner is None else preconditioner.mv
        limit = self.tolerance * self.tolerance * _dot(vector, vector)

        # a step is two halves, each one A: both in one body, so that programs hold A and its preconditioner once
        def unfinished(carry):
            _, r, _, _, rho, _, omega, half, _ = carry
            return (half % 2 == 1) | ((_dot(r, r) > limit) & (half < 2 * self.max_steps) & (rho != 0) & (omega != 0))

        def advance(carry):
            y, r, p, v, rho_before, alpha, omega, half, x = carry
            first = half % 2 == 0
            rho = jnp.where(first, _dot(vector, r), rho_before)
            p = jnp.where(first, r + (rho / rho_before) * (alpha / omega) * (p - omega * v), p)
            z = precondition(jnp.where(first, p, r))
            image = operator.mv(z)
            # first half: v = A x, r becomes s; second half: t = A z, r becomes the next residual
            alpha = jnp.where(first, rho / _dot(vector, image), alpha)
            size = _dot(image, image)
            least = jnp.where(size > 0, _dot(image, r) / jnp.where(size > 0, size, 1.0), 0.0)
            omega = jnp.where(first, omega, least)
            y = jnp.where(first, y, y + alpha * x + omega * z)
            r = r - jnp.where(first, alpha, omega) * image
            return y, r, p, jnp.where(first, image, v), rho, alpha, omega, half + 1, jnp.where(first, z, x)

        nothing, one = jnp.zeros_like(vector), jnp.ones((), vector.dtype)
        carry = (nothing, vector, nothing, nothing, one, one, one, 0, nothing)
        y, r, _, _, _, _, _, num_halves, _ = lax.while_loop(unfinished, advance, carry)
        return _answer(y, r, vector, num_halves // 2)


def _answer(y, r, vector, num_steps):
    size = jnp.sqrt(_dot(vector, vector))
    relative = jnp.sqrt(_dot(r, r)) / jnp.where(size > 0, size, 1.0)
    # never a failure: callers measure and report what is left, and lineax raises one in the solve of a slope, told or not
    return y, lx.RESULTS.successful, {"num_steps": num_steps, "residual": relative}


def _dot(a, b):
    return jnp.sum(a * b)
