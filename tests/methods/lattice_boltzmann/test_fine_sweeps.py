"""Transport along 80 directions: its quadrature, against integration, power."""

import jax.numpy as jnp
import numpy as np
import pytest

from jaxvol.methods.lattice_boltzmann import fine_sweeps


def test_quadrature_of_the_fine_sweeps():
    points = fine_sweeps.directions()
    vectors, weights = np.array([v for v, _ in points]), np.array([w for _, w in points])
    assert len(points) == 40 and 2 * weights.sum() == pytest.approx(1, abs=1e-6)
    np.testing.assert_allclose(np.linalg.norm(vectors, axis=1), 1, atol=1e-6)
    x = np.abs(vectors[:, 0])
    for power, mean in ((1, 1 / 2), (3, 1 / 4), (4, 1 / 5), (6, 1 / 7)):  # of |x|: the flux through a face
        assert 2 * np.sum(weights * x**power) == pytest.approx(mean, abs=1e-6)
    assert 2 * np.sum(weights * np.prod(vectors**2, axis=1)) == pytest.approx(1 / 105, abs=1e-6)


def test_fine_sweeps_against_straight_integration():
    """Fluence in the middle of a uniform source with absorption, against the integral over directions in float64."""
    n, x = 12, 0.3
    phi = fine_sweeps.transport(jnp.full((n,) * 3, x), jnp.ones((n,) * 3))
    rng = np.random.default_rng(0)
    directions = rng.normal(size=(20000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    center = np.full(3, n / 2)
    length = np.min(np.where(directions > 0, n - center, center) / np.abs(directions), axis=1)
    expected = np.mean((1 - np.exp(-x * length)) / x)
    assert float(np.mean(np.asarray(phi)[5:7, 5:7, 5:7])) == pytest.approx(expected, rel=0.01)


def test_fine_sweeps_keep_all_power():
    """From the middle of a thick cube next to nothing escapes: all of the source is met by extinction."""
    n, x = 24, 1.0
    source = jnp.zeros((n,) * 3).at[12, 11, 12].set(1.0)
    for kind in ("pade", "exp"):
        phi = fine_sweeps.transport(jnp.full((n,) * 3, x), source, kind=kind)
        assert float(jnp.sum(x * phi)) == pytest.approx(1.0, abs=2e-4)
