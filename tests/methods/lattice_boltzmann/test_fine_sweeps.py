"""Transport along 72 directions: its quadrature, against integration, power, turned grids."""

from functools import partial
from itertools import permutations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxvol.methods.lattice_boltzmann import fine_sweeps

SIDE = 12
FINE = {kind: jax.jit(partial(fine_sweeps.transport, kind=kind)) for kind in ("pade", "exp")}


def test_quadrature_of_the_fine_sweeps():
    points = fine_sweeps.directions()
    vectors, weights = np.array([v for v, _, _ in points]), np.array([w for _, w, _ in points])
    assert len(points) == 72 and weights.sum() == pytest.approx(1, abs=1e-6)
    np.testing.assert_allclose(np.linalg.norm(vectors, axis=1), 1, atol=1e-6)
    x = np.abs(vectors[:, 0])
    for power, mean in ((1, 1 / 2), (3, 1 / 4), (4, 1 / 5), (5, 1 / 6), (6, 1 / 7)):  # of |x|: the flux through a face
        assert np.sum(weights * x**power) == pytest.approx(mean, abs=1e-6 if power != 5 else 1e-5)
    assert np.sum(weights * np.prod(vectors**2, axis=1)) == pytest.approx(1 / 105, abs=1e-6)


def test_turned_grids_hold_turned_light():
    """All 24 rotations of a cube of voxels from clear to opaque."""
    rng = np.random.default_rng(0)
    sigma, source = (x.astype(np.float32) for x in (10.0 ** rng.uniform(-2, 2, (SIDE,) * 3), rng.random((SIDE,) * 3)))
    base = np.asarray(FINE["exp"](sigma, source))
    rotations = [
        (axes, flips)
        for axes in permutations(range(3))
        for flips in np.ndindex(2, 2, 2)
        if np.linalg.det(np.eye(3)[list(axes)]) * (-1) ** sum(flips) > 0
    ]
    assert len(rotations) == 24
    for axes, flips in rotations:
        here, there, light = (np.flip(np.transpose(x, axes), np.flatnonzero(flips)) for x in (sigma, source, base))
        np.testing.assert_allclose(FINE["exp"](here, there), light, rtol=1e-4, atol=1e-5 * base.max())


def test_fine_sweeps_against_straight_integration():
    """Fluence in the middle of a uniform source with absorption, against the integral over directions in float64."""
    n, x = SIDE, 0.3
    phi = FINE["pade"](jnp.full((n,) * 3, x, jnp.float32), jnp.ones((n,) * 3))
    rng = np.random.default_rng(0)
    directions = rng.normal(size=(20000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    center = np.full(3, n / 2)
    length = np.min(np.where(directions > 0, n - center, center) / np.abs(directions), axis=1)
    expected = np.mean((1 - np.exp(-x * length)) / x)
    assert float(np.mean(np.asarray(phi)[5:7, 5:7, 5:7])) == pytest.approx(expected, rel=0.01)


def test_fine_sweeps_keep_all_power():
    """From the middle of a thick cube next to nothing escapes: all of the source is met by extinction."""
    x = 2.0
    source = jnp.zeros((SIDE,) * 3).at[6, 5, 6].set(1.0)
    for transport in FINE.values():
        phi = transport(jnp.full((SIDE,) * 3, x, jnp.float32), source)
        assert float(jnp.sum(x * phi)) == pytest.approx(1.0, abs=2e-4)


@pytest.mark.parametrize("around", [0, 2])
def test_opaque_voxels_send_light_through_all_of_their_faces(around):
    """A cube that emits like a black body: a quarter of its faces' area times its fluence, also into clear voxels around it."""
    n, k = SIDE - 2 * around, 60.0
    inside = np.pad(np.ones((n,) * 3, np.float32), around)
    phi = np.asarray(FINE["exp"](jnp.asarray(k * inside), jnp.asarray(inside)), np.float64)
    assert n**3 - np.sum(k * inside * phi) == pytest.approx(6 * n * n / 4 / k, rel=0.02)
