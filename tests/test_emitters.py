"""Directions to area lights."""

import jax
import jax.numpy as jnp
import numpy as np

from jaxvol.direct import emitters


def test_directions_to_lamps_have_slopes():
    """A lamp from close by and so far away that it has next to no solid angle: directions change as central differences say."""
    corners = jnp.array([[[-0.5, 1.0, -0.5], [0.5, 1.0, -0.5], [0.5, 1.0, 0.5]]])
    lamp = emitters.Emitters(corners, jnp.array([[0.0, -1.0, 0.0]]), jnp.array([0.5]), jnp.ones((1, 3)), jnp.array([0]))
    points = jnp.array([[0.1, 0.0, 0.2], [3.0, -4000.0, 10.0], [0.0, 2.0, 0.0]])  # the last behind it
    u = jnp.full(3, 0.3)

    def seen(height):
        found = emitters.sample(lamp, points + height * jnp.array([0.0, 1.0, 0.0]), u, u)
        return found.direction, found.pdf

    slopes = jax.jit(lambda: jax.jvp(seen, (jnp.float32(0),), (jnp.float32(1),)))()[1]
    assert all(np.isfinite(x).all() for x in slopes)
    high, low = (np.asarray(seen(jnp.float32(h))[0]) for h in (0.02, -0.02))
    np.testing.assert_allclose(slopes[0][0], (high - low)[0] / 0.04, rtol=0.02, atol=1e-3)
