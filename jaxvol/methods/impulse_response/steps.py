"""How the steps between ray casts are compiled: on a CPU with every column of an [n, 3] array as an array of its own."""

from collections.abc import Callable
from functools import cache, wraps
from typing import Any

import jax

from jaxvol.columns import by_columns, compiler_options, join, split


def step(rows: Callable[..., int], *, static: tuple[str, ...] = ()) -> Callable:
    """Decorator: jit a function of lanes; `rows(*args)` is the number of lanes, `static` names keyword arguments."""

    def decorate(function: Callable) -> Callable:
        def compiled(*args: Any, **keywords: Any) -> Any:
            if jax.default_backend() != "cpu":
                return function(*args, **keywords)
            num = rows(*args)
            columns = by_columns(lambda *a: function(*a, **keywords), num)
            return join(columns(*split(args, num)))

        @wraps(function)
        def call(*args: Any, **keywords: Any) -> Any:
            return _jitted(compiled, jax.default_backend(), static)(*args, **keywords)

        return call

    return decorate


@cache
def _jitted(function, backend, static):
    return jax.jit(function, static_argnames=static, compiler_options=compiler_options(backend))
