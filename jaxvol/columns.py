"""Run a function over arrays [n, k] with every column as an array of its own.

Vectors and colours are written as [n, 3] everywhere, which reads well; compiled for a CPU, each mask or dot product over
such an array walks rows of three, which does not vectorise. `by_columns` re-traces a function so that each [n, k] value
inside it, k small, is k arrays [n]: the same operations on the same numbers, in loops over n alone. Between calls the
state may stay split (`Columns`), so nothing is transposed.
"""

from collections.abc import Callable
from functools import reduce
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.extend import core

_MOST_COLUMNS = 16

_ELEMENTWISE = frozenset(
    "abs add and atan2 ceil clamp convert_element_type copy cos div eq exp exp2 expm1 floor ge gt integer_pow is_finite le log"
    " log1p logistic lt max min mul ne neg nextafter not or pow rem round rsqrt select_n shift_left"
    " shift_right_arithmetic shift_right_logical sign sin sqrt square stop_gradient sub tan tanh xor".split()
)
_FREE = frozenset("broadcast_in_dim reshape squeeze slice split".split())
_WORTH_KEEPING = 12  # operations a lane saved by storing a value and loading it again, as measured
_FOLDS = {
    "reduce_sum": lax.add,
    "reduce_max": lax.max,
    "reduce_min": lax.min,
    "reduce_and": lax.bitwise_and,
    "reduce_or": lax.bitwise_or,
}
_CALLS = {"jit": "jaxpr", "pjit": "jaxpr", "closed_call": "call_jaxpr", "custom_jvp_call": "call_jaxpr"}


class Columns(eqx.Module):
    """An array [n, k] as k arrays [n]."""

    columns: tuple


def compiler_options(backend: str) -> dict[str, str] | None:
    """Options for `jax.jit(..., compiler_options=)` that keep what `by_columns` wants computed once.

    XLA's CPU compiler drops optimization barriers before it fuses, and then computes what several columns share anew in
    each of their loops; without this pass the barriers last. Other backends compile as ever.
    """
    return {"xla_disable_hlo_passes": "cse_barrier_expander"} if backend == "cpu" else None


def split(tree: Any, num_rows: int) -> Any:
    """Every [num_rows, k] array of a tree as `Columns`; numpy or JAX."""
    return jax.tree.map(lambda x: _split(x, num_rows), tree)


def join(tree: Any) -> Any:
    """Every `Columns` of a tree as one array [n, k]; numpy or JAX."""
    return jax.tree.map(_join, tree, is_leaf=lambda x: isinstance(x, Columns))


def by_columns(function: Callable, num_rows: int) -> Callable:
    """The same function, jittable, whose [num_rows, k] results, and arguments where they are split, are `Columns`."""

    def split_function(*args):
        flat, structure = jax.tree.flatten(args, is_leaf=lambda x: isinstance(x, Columns))
        shapes = [_shape(x) if isinstance(x, Columns) else x for x in flat]
        closed, out = jax.make_jaxpr(lambda *a: function(*jax.tree.unflatten(structure, a)), return_shape=True)(*shapes)
        found = _evaluate(closed, flat, num_rows)
        return jax.tree.unflatten(jax.tree.structure(out), [_split(x, num_rows) for x in found])

    return split_function


def _shape(x):
    first = x.columns[0]
    return jax.ShapeDtypeStruct((*first.shape, len(x.columns)), first.dtype)


def _is_split(shape, num_rows):
    return len(shape) == 2 and shape[0] == num_rows and 0 < shape[1] <= _MOST_COLUMNS


def _split(x, num_rows):
    if isinstance(x, Columns) or not _is_split(jnp.shape(x), num_rows):
        return x
    return Columns(tuple(x[:, i] for i in range(x.shape[1])))


def _join(x):
    if not isinstance(x, Columns):
        return x
    xp = np if isinstance(x.columns[0], np.ndarray) else jnp
    return xp.stack(x.columns, axis=1)


def _evaluate(closed, args, num_rows):
    """Values of a closed jaxpr's results; arguments and results may be split."""
    env = dict(zip(closed.jaxpr.constvars, closed.consts, strict=True))
    env.update(zip(closed.jaxpr.invars, args, strict=True))
    read = lambda v: v.val if isinstance(v, core.Literal) else env[v]  # noqa: E731
    uses = _count_uses(closed.jaxpr, num_rows)
    work: dict = {}  # operations since its inputs lay in memory, by variable
    for equation in closed.jaxpr.eqns:
        found = _apply(equation, [read(v) for v in equation.invars], num_rows)
        cost = _cost(equation, work)
        for variable, value in zip(equation.outvars, found, strict=True):
            again = cost * (uses.get(variable, 0) - 1)
            kept = again > _WORTH_KEEPING and jnp.shape(variable.aval)[:1] == (num_rows,)
            env[variable] = jax.tree.map(lax.optimization_barrier, value) if kept else value
            work[variable] = 0 if kept else cost
    return [read(v) for v in closed.jaxpr.outvars]


def _count_uses(jaxpr, num_rows):
    """How many operations read each variable, where each column that it is spread over counts."""
    uses: dict = {}
    for equation in jaxpr.eqns:
        times = 1
        if equation.primitive.name == "broadcast_in_dim" and _is_split(equation.params["shape"], num_rows):
            times = equation.params["shape"][1]
        for v in equation.invars:
            if not isinstance(v, core.Literal):
                uses[v] = uses.get(v, 0) + times
    return uses


def _cost(equation, work):
    name = equation.primitive.name
    if name in _FREE:
        return max((work.get(v, 0) for v in equation.invars if not isinstance(v, core.Literal)), default=0)
    if name in _CALLS:
        return 10
    if name not in _ELEMENTWISE and name not in _FOLDS:
        return 0  # lies in memory
    return 1 + sum(work.get(v, 0) for v in equation.invars if not isinstance(v, core.Literal))


def _apply(equation, values, num_rows):
    name = equation.primitive.name
    if name in _CALLS:
        return _evaluate(_closed(equation.params[_CALLS[name]]), values, num_rows)
    if name == "while":
        return _while(equation, values, num_rows)
    if name == "scan":
        found = _scan(equation, values, num_rows)
        if found is not None:
            return found
    if name == "broadcast_in_dim":
        found = _broadcast(equation, values[0], num_rows)
        return [_bind(equation, values) if found is None else found]
    if any(isinstance(v, Columns) for v in values):
        found = _apply_split(equation, name, values, num_rows)
        if found is not None:
            return found
    if name == "stack" and _is_split(equation.outvars[0].aval.shape, num_rows) and equation.params["axis"] == 1:
        return [Columns(tuple(values))]
    out = _bind(equation, [_join(v) for v in values])
    return [_split(x, num_rows) for x in (out if equation.primitive.multiple_results else [out])]


def _closed(jaxpr):
    return jaxpr if isinstance(jaxpr, core.ClosedJaxpr) else core.ClosedJaxpr(jaxpr, ())


def _bind(equation, values):
    return equation.primitive.bind(*values, **equation.params)


def _apply_split(equation, name, values, num_rows):
    """The operation on columns; None where it has no such form."""
    params = equation.params
    first = values[0]
    if name in _ELEMENTWISE:
        k = equation.outvars[0].aval.shape[1]
        each = [_each_column(v, k, num_rows) for v in values]
        return [Columns(tuple(_bind(equation, [v[i] for v in each]) for i in range(k)))]
    if name == "concatenate" and params["dimension"] == 1:
        return [Columns(tuple(c for v in values for c in _split(v, num_rows).columns))]
    if not isinstance(first, Columns):
        return None
    if name in _FOLDS and params["axes"] == (1,):
        return [reduce(_FOLDS[name], first.columns)]
    if name == "squeeze" and params["dimensions"] == (1,):
        return [first.columns[0]]
    if name == "reshape" and equation.outvars[0].aval.shape == (num_rows,):
        return [first.columns[0]]
    if name == "slice" and params["start_indices"][0] == 0 and params["limit_indices"][0] == num_rows:
        step = 1 if params["strides"] is None else params["strides"][1]
        return [Columns(first.columns[params["start_indices"][1] : params["limit_indices"][1] : step])]
    if name == "split" and params["axis"] == 1:
        ends = np.cumsum(params["sizes"])
        return [Columns(first.columns[e - s : e]) for s, e in zip(params["sizes"], ends, strict=True)]
    if name == "dot_general":
        (left, right), (batch, _) = params["dimension_numbers"]
        if left == (1,) and not batch and not isinstance(values[1], Columns) and jnp.ndim(values[1]) == 2:
            matrix = values[1] if right == (0,) else values[1].T
            column = lambda j: reduce(lax.add, [c * matrix[i, j] for i, c in enumerate(first.columns)])  # noqa: E731
            return [Columns(tuple(column(j) for j in range(matrix.shape[1])))]
    return None


def _each_column(value, k, num_rows):
    """k operands, one a column, of an operand that may have one row or one column for all."""
    if not isinstance(value, Columns):
        if jnp.ndim(value) == 0:
            return [value] * k
        value = Columns(tuple(jnp.broadcast_to(value[:, i], (num_rows,)) for i in range(value.shape[1])))
    return value.columns if len(value.columns) == k else value.columns * k


def _broadcast(equation, value, num_rows):
    shape, dims = equation.params["shape"], equation.params["broadcast_dimensions"]
    if not _is_split(shape, num_rows):
        return _bind(equation, [_join(value)])
    k = shape[1]
    if isinstance(value, Columns):
        return value if len(value.columns) == k else Columns(value.columns * k)
    if jnp.ndim(value) == 0:
        return Columns((jnp.broadcast_to(value, (num_rows,)),) * k)
    if jnp.ndim(value) == 1 and dims == (0,) and value.shape[0] == num_rows:
        return Columns((value,) * k)
    if jnp.ndim(value) == 1 and dims == (1,):
        each = value if value.shape[0] == k else [value[0]] * k
        return Columns(tuple(jnp.broadcast_to(each[i], (num_rows,)) for i in range(k)))
    return None


def _while(equation, values, num_rows):
    params = equation.params
    a, b = params["cond_nconsts"], params["body_nconsts"]
    tests, constants, start = values[:a], values[a : a + b], values[a + b :]
    start = [_split(v, num_rows) for v in start]
    condition = lambda state: _evaluate(params["cond_jaxpr"], [*tests, *state], num_rows)[0]  # noqa: E731
    body = lambda state: _resplit(_evaluate(params["body_jaxpr"], [*constants, *state], num_rows), num_rows)  # noqa: E731
    return lax.while_loop(condition, body, start)


def _scan(equation, values, num_rows):
    """Loops of fixed length that carry all they need; None for others."""
    params = equation.params
    constants, carry = values[: params["num_consts"]], values[params["num_consts"] :]
    if len(carry) != params["num_carry"] or len(equation.outvars) != params["num_carry"]:
        return None
    body = lambda _, state: _resplit(_evaluate(params["jaxpr"], [*constants, *state], num_rows), num_rows)  # noqa: E731
    return lax.fori_loop(0, params["length"], body, [_split(v, num_rows) for v in carry])


def _resplit(values, num_rows):
    return [_split(jnp.asarray(v) if not isinstance(v, Columns) else v, num_rows) for v in values]
