"""Slopes where those of plain roots, quotients and maxima are not finite."""

import jax
import jax.numpy as jnp
import numpy as np

from jaxvol import slopes


def test_roots_have_slope_0_at_0():
    """And the root's own elsewhere."""
    value, slope = jax.jvp(slopes.root, (jnp.array([-1.0, 0.0, 4.0]),), (jnp.ones(3),))
    np.testing.assert_allclose(value, [0.0, 0.0, 2.0])
    np.testing.assert_allclose(slope, [0.0, 0.0, 0.25])


def test_quotients_of_small_numbers_have_slopes():
    """The square of 1e-30 is 0 in float32; a quotient's slope by relative changes is not affected."""
    a, b = jnp.array([2e-30, 6.0, 1.0]), jnp.array([1e-30, 3.0, 0.0])
    value, slope = jax.jvp(slopes.ratio, (a, b), (a, 0.5 * b))
    np.testing.assert_allclose(value, [2.0, 2.0, 0.0], rtol=1e-6)
    np.testing.assert_allclose(slope, [1.0, 1.0, 0.0], rtol=1e-6)


def test_the_largest_entry_has_its_own_slope():
    """Without a comparison for equality, which rounding breaks; among equals one of theirs."""
    x = jnp.array([[1.0, 3.0, 2.0], [-1.0, -2.0, -1.0], [0.0, 0.0, 5.0]])
    t = jnp.arange(9.0).reshape(3, 3)
    value, slope = jax.jvp(slopes.largest, (x,), (t,))
    np.testing.assert_array_equal(value, [3.0, -1.0, 5.0])
    assert slope[0] == 1.0 and slope[1] in (3.0, 5.0) and slope[2] == 8.0
    assert " eq " not in str(jax.make_jaxpr(lambda x, t: jax.jvp(slopes.largest, (x,), (t,)))(x, t))
