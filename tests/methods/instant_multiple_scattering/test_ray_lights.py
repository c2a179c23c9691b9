"""Virtual ray lights: the sampling on a flight against quadrature, and the exact radiance in an infinite medium."""

import jax.numpy as jnp
import numpy as np
import pytest

from jaxvol.methods import instant_multiple_scattering as ims
from jaxvol.methods.instant_multiple_scattering import ray_lights
from tests.methods.instant_multiple_scattering.scenes import EXACT, lit, make_camera, make_medium, radiance_past_the_source


def vector(*values):
    return tuple(jnp.float32(v) for v in values)


@pytest.mark.parametrize("start", [(-1.0, 0.3, 0.2), (0.4, 0.001, -0.5), (2.0, 1.0, 1.0)])
def test_points_on_a_flight_have_their_pdf(start):
    """Mean of inverse pdf * kernel = integral of the kernel along the flight, by float64 quadrature."""
    along = np.array([0.6, -0.3, 0.5])
    along = along / np.linalg.norm(along)
    n, length = 1 << 16, 3.0
    u = (jnp.arange(n, dtype=jnp.float32) + 0.5) / n
    v, inverse = ray_lights.sample_on_flight(
        u, vector(0, 0, 0), vector(1, 0, 0), vector(*start), vector(*along), jnp.float32(length)
    )
    assert float(jnp.min(v)) >= 0.0 and float(jnp.max(v)) <= length

    def kernel(x):
        place = np.array(start) + np.asarray(x, np.float64)[:, None] * along
        return 1.0 / np.sqrt(place[:, 1] ** 2 + place[:, 2] ** 2)  # the distance to the eye ray's line

    x = np.linspace(0, length, 400001)
    exact = np.trapezoid(kernel(x), x)
    values = np.asarray(inverse, np.float64) * kernel(np.asarray(v))
    assert values.mean() == pytest.approx(exact, rel=2e-3)
    assert values.max() < 1.05 * values.min()  # the pdf is that kernel: every sample has the same weight


def test_a_row_that_only_fills_up_is_no_nan():
    """Its length and direction are 0, and it may lie on the eye ray: 0 times what it sends must be 0."""
    nothing = vector(0, 0, 0)
    v, inverse = ray_lights.sample_on_flight(
        jnp.float32(0.5), vector(-3, 0, 0), vector(1, 0, 0), nothing, nothing, jnp.float32(0)
    )
    assert float(v) == 0 and np.isfinite(inverse)


@pytest.mark.slow
def test_infinite_medium():
    """The same exact radiance that the virtual points are tested with; no clamping, no compensation."""
    mean, error = radiance_past_the_source(sets=32, lights="rays")
    assert error < 0.02 * EXACT
    assert abs(mean - EXACT) < 3.5 * error


def test_grids_and_surfaces_are_refused():
    with pytest.raises(ValueError, match="lights"):
        ims.plan(lit(make_medium(density=np.ones((4, 4, 4)))), make_camera(), lights="rays")
