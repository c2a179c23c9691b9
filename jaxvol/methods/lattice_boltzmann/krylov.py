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
        return _answer(y, r, vector, num_steps, self.tolerance)


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

        def unfinished(carry):
            _, r, _, _, rho, _, omega, step = carry
            return (_dot(r, r) > limit) & (step < self.max_steps) & (rho != 0) & (omega != 0)

        def advance(carry):
            y, r, p, v, rho_before, alpha, omega, step = carry
            rho = _dot(vector, r)
            p = r + (rho / rho_before) * (alpha / omega) * (p - omega * v)
            x = precondition(p)
            v = operator.mv(x)
            alpha = rho / _dot(vector, v)
            s = r - alpha * v
            z = precondition(s)
            t = operator.mv(z)
            size = _dot(t, t)
            omega = jnp.where(size > 0, _dot(t, s) / jnp.where(size > 0, size, 1.0), 0.0)
            return y + alpha * x + omega * z, s - omega * t, p, v, rho, alpha, omega, step + 1

        nothing, one = jnp.zeros_like(vector), jnp.ones((), vector.dtype)
        carry = (nothing, vector, nothing, nothing, one, one, one, 0)
        y, r, _, _, _, _, _, num_steps = lax.while_loop(unfinished, advance, carry)
        return _answer(y, r, vector, num_steps, self.tolerance)


def _answer(y, r, vector, num_steps, tolerance):
    size = jnp.sqrt(_dot(vector, vector))
    relative = jnp.sqrt(_dot(r, r)) / jnp.where(size > 0, size, 1.0)
    result = lx.RESULTS.where(relative > tolerance, lx.RESULTS.max_steps_reached, lx.RESULTS.successful)
    return y, result, {"num_steps": num_steps, "residual": relative}


def _dot(a, b):
    return jnp.sum(a * b)
