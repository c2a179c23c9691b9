"""`by_columns` changes how arrays lie, not what is computed."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

from jaxvol import phase, sampling
from jaxvol.columns import Columns, by_columns, join, split

N = 8


def _vectors(seed=0, k=3):
    return jnp.asarray(np.random.default_rng(seed).normal(size=(N, k)), jnp.float32)


def _masks_and_dots(a, b, s):
    d = jnp.sum(a * b, axis=-1)
    a = jnp.where((s > d)[:, None], a * s[:, None] + b, jnp.clip(a, -1.0, 1.0))
    return a / jnp.linalg.norm(a, axis=-1, keepdims=True), jnp.max(b, axis=-1), jnp.concatenate([a, b[:, 1:]], axis=1)


def _tables(a, b, s):
    table = jnp.arange(15.0).reshape(5, 3)
    matrix = jnp.arange(9.0).reshape(3, 3)
    row = jnp.argmax(a, axis=1)
    return table[row] + a @ matrix + b @ matrix.T, jnp.cross(a, b), jnp.stack([s, s + 1], axis=-1), jnp.sum(a, axis=0)


def _loops(a, b, s):
    a = lax.fori_loop(0, 3, lambda i, x: jnp.where((s > 0)[:, None], x + b * i, x), a)
    return lax.while_loop(lambda x: jnp.sum(x) < 10.0, lambda x: x + jnp.abs(b), a), jnp.take_along_axis(
        a, jnp.ones((N, 1), int), 1
    )


def _physics(a, b, s):
    w = sampling.normalize(a)
    t1, t2 = sampling.orthonormal_basis(w)
    u = sampling.uniforms(jnp.uint32(3), sampling.stream("columns"), jnp.arange(N), jnp.uint32(2), jnp.uint32(1))
    return t1, t2, sampling.to_world(b, w), phase.henyey_greenstein(s, 0.5), u[0]


@pytest.mark.parametrize("function", [_masks_and_dots, _tables, _loops, _physics])
def test_same_numbers(function):
    args = _vectors(0), _vectors(1), _vectors(2, 1)[:, 0]
    expected = jax.jit(function)(*args)
    found = jax.jit(by_columns(function, N))(*split(args, N))
    for a, b in zip(jax.tree.leaves(expected), jax.tree.leaves(join(found)), strict=True):
        np.testing.assert_allclose(a, b, rtol=2e-6, atol=1e-6)


def test_results_stay_split_and_no_row_is_touched():
    """Between calls nothing is transposed: the compiled program holds no array of rows of three."""
    function = jax.jit(by_columns(_masks_and_dots, N))
    args = split((_vectors(0), _vectors(1), _vectors(2, 1)[:, 0]), N)
    found = function(*args)
    assert isinstance(found[0], Columns) and isinstance(found[2], Columns) and len(found[2].columns) == 5
    assert f"f32[{N},3]" not in function.lower(*args).compile().as_text()


def test_split_and_join_are_inverse():
    tree = {"a": _vectors(), "b": jnp.arange(N), "c": np.ones((N, 2)), "d": jnp.ones((N + 1, 3))}
    there = split(tree, N)
    assert isinstance(there["c"], Columns) and not isinstance(there["d"], Columns)
    back = join(there)
    assert isinstance(back["c"], np.ndarray)
    jax.tree.map(np.testing.assert_array_equal, tree, back)
