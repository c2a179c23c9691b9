"""Gradients of every compiled stage of a render, at the inputs that the render feeds it.

Methods plan, cast rays and make lists on the host, between compiled stages; what lies between two stages selects and
adds. So the gradient of a picture by any parameter is a product of the stages' Jacobians, and finite where these are.
A stage is differentiated forwards in all of its floating-point inputs at once, along a direction in which each of them
changes by about itself: where any entry of the Jacobian is NaN or infinite, so is the derivative.
"""

import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from functools import partial
from typing import Any, NamedTuple
from unittest import mock

import jax
import jax.numpy as jnp
import numpy as np

_JITTED = type(jax.jit(abs))
_MAKERS = "_jitted"  # functions of this name return jitted functions


class Stage(NamedTuple):
    """A jitted function with the arguments of its first call."""

    name: str
    function: Callable  # not jitted
    arguments: tuple[tuple, dict[str, Any]]


class Slopes(NamedTuple):
    """A stage's floating-point outputs, and their derivatives along one direction."""

    values: list[np.ndarray]
    slopes: list[np.ndarray]


class _Recorder:
    """Stands for a jitted function; keeps a copy of the first arguments of each form."""

    def __init__(self, function: Callable, found: dict[Any, Stage]):
        self.function, self.found = function, found

    def __call__(self, *args, **kwargs):
        leaves, tree = jax.tree.flatten((args, kwargs))
        if not any(isinstance(x, jax.core.Tracer) for x in leaves):
            module, name = self.function.__module__, self.function.__name__
            key = module, name, tree, tuple(np.shape(x) if _is_array(x) else x for x in leaves)
            if key not in self.found:  # copied: the stage may be given its inputs for its outputs
                copies = [np.array(x) if _is_array(x) else x for x in leaves]
                label = f"{module.removeprefix('jaxvol.').removeprefix('methods.')}.{name}"
                self.found[key] = Stage(label, self.function.__wrapped__, jax.tree.unflatten(tree, copies))
        return self.function(*args, **kwargs)


@contextmanager
def recording() -> Iterator[dict[Any, Stage]]:
    """Yield a dictionary that fills up with the stages that run inside the block; modules must be loaded before."""
    found: dict[Any, Stage] = {}
    with ExitStack() as stack:
        for name, module in list(sys.modules.items()):
            for key, value in list(vars(module).items()) if name.startswith("jaxvol.") else ():
                if isinstance(value, _JITTED):
                    stack.enter_context(mock.patch.object(module, key, _Recorder(value, found)))
                elif key.startswith(_MAKERS):
                    make = partial(_recorded, value, found)
                    stack.enter_context(mock.patch.object(module, key, make))
        yield found


def _recorded(make, found, *args):
    return _Recorder(make(*args), found)


def _is_array(x):
    return isinstance(x, jax.Array | np.ndarray | np.generic)


def _is_float(x):
    return _is_array(x) and np.issubdtype(x.dtype, np.floating)


_compiled: dict[Any, Callable] = {}


def clear_caches() -> None:
    """Forget compiled derivatives."""
    _compiled.clear()


def derivative(key: Any, stage: Stage, *, kind: type = np.float32) -> Slopes:
    """Values and slopes of a stage with all of its floating-point inputs as `kind`, along a direction of theirs.

    `key` is the stage's in `recording`. float64 wants an enclosing `jax.enable_x64`.
    """
    floats, others, along, outputs = _as_function(stage, kind)
    if (key, kind) not in _compiled:
        _compiled[key, kind] = jax.jit(partial(_with_slopes, outputs))
    return Slopes(*jax.device_get(_compiled[key, kind](floats, others, along)))


def differences(stage: Stage, *, step: float = 1e-7) -> list[np.ndarray]:
    """Central differences, in float64, for the slopes of `derivative`; wants an enclosing `jax.enable_x64`.

    They are not slopes where a stage draws or chooses by what is changed.
    """
    floats, others, along, outputs = _as_function(stage, np.float64)
    run = jax.jit(outputs)
    high, low = (jax.device_get(run([x + h * t for x, t in zip(floats, along, strict=True)], others)) for h in (step, -step))
    with np.errstate(invalid="ignore"):  # what is infinite has none
        return [(a - b) / (2 * step) for a, b in zip(high, low, strict=True)]


def _as_function(stage, kind):
    """Floating-point inputs as `kind`, other arrays, a direction of the former, and the outputs as a function of both."""
    leaves, tree = jax.tree.flatten(stage.arguments)
    floats = [np.asarray(x, kind) for x in leaves if _is_float(x)]
    others = [x for x in leaves if _is_array(x) and not _is_float(x)]
    rng = np.random.default_rng(0)
    return floats, others, [_direction(x, rng) for x in floats], partial(_outputs, stage.function, tree, leaves)


def _with_slopes(outputs, floats, others, along):
    return jax.jvp(lambda floats: outputs(floats, others), (floats,), (along,))


def _outputs(function, tree, leaves, floats, others):
    given, rest = iter(floats), iter(others)
    filled = [next(given) if _is_float(x) else next(rest) if _is_array(x) else x for x in leaves]
    args, kwargs = jax.tree.unflatten(tree, filled)
    kind = jnp.float64 if any(x.dtype == np.float64 for x in floats) else jnp.float32
    with mock.patch.object(jnp, "float32", kind):  # what stages name: literals, sums that loops carry
        found = [jnp.asarray(x) for x in jax.tree.leaves(function(*args, **kwargs))]
    return [x for x in found if jnp.issubdtype(x.dtype, jnp.floating)]


def _direction(x, rng):
    """A change of about each entry itself; of the mean size where it is zero, so that no parameter is left out."""
    finite = np.where(np.isfinite(x), np.abs(x), 0).astype(np.float64)
    size = np.maximum(finite, finite.mean() if finite.size else 0.0)
    size = np.where(size > 0, size, 1.0) * rng.uniform(0.5, 1.0, x.shape) * rng.choice([-1.0, 1.0], x.shape)
    return np.where(np.isfinite(x), size, 0.0).astype(x.dtype)


def finite(stages: dict[Any, Stage]) -> str | None:
    """Whether every slope is finite where its value is; None where all are."""
    for key, stage in stages.items():
        try:
            found = derivative(key, stage)
        except (RuntimeError, TypeError, ValueError) as error:  # what cannot be differentiated at all
            return f"{stage.name}: raised {type(error).__name__}: {error}"
        for number, (value, slope) in enumerate(zip(*found, strict=True)):
            bad = np.isfinite(value) & ~np.isfinite(slope)
            if bad.any():
                return f"{stage.name}: {bad.sum()} of {bad.size} slopes of output {number} are not finite"
    return None
