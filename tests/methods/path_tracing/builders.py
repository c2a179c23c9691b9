"""Small scenes for the tests of the path tracer, and the statistics that judge its estimates."""

import jax.numpy as jnp
import numpy as np
from scipy.special import ndtri

from jaxvol import layers, media
from jaxvol.types import DirectionalLights, Medium, PointLights, Rays

FALSE_ALARM = 1e-3  # probability that a right program fails one test, whatever the number of its checks


def box(low, high, *, sigma_s, sigma_a, g=0.0, grid=None, **more):
    """A medium in a box; `grid` = a density [X, Y, Z], or the number of voxels along each axis of a constant one."""
    if grid is not None:
        grid = np.ones((grid,) * 3, np.float32) if np.ndim(grid) == 0 else np.asarray(grid, np.float32)
    rgb = lambda x: jnp.broadcast_to(jnp.asarray(x, jnp.float32), (3,))  # noqa: E731
    return Medium(
        bounds=jnp.asarray([low, high], jnp.float32),
        sigma_s=rgb(sigma_s),
        sigma_a=rgb(sigma_a),
        g=jnp.float32(g),
        density=None if grid is None else jnp.asarray(grid),
        majorants=None if grid is None else media.majorants(grid, block=4),
        **more,
    )


def point(position, intensity=1.0):
    """One isotropic point light."""
    return PointLights(jnp.asarray([position], jnp.float32), jnp.full((1, 3), intensity, jnp.float32))


def sun(direction=(0.0, 0.0, -1.0), irradiance=1.0):
    """One directional light that travels along `direction`."""
    return DirectionalLights(jnp.asarray([direction], jnp.float32), jnp.full((1, 3), irradiance, jnp.float32))


def rays(origin, direction, *, copies=1):
    """Unbounded rays, each repeated `copies` times in a row."""
    origin, direction = np.broadcast_arrays(np.asarray(origin, np.float64), np.asarray(direction, np.float64))
    direction = direction / np.linalg.norm(direction, axis=-1, keepdims=True)
    origin, direction = (jnp.asarray(np.repeat(x, copies, axis=0), jnp.float32) for x in (origin, direction))
    return Rays(origin, direction, jnp.full(len(origin), jnp.inf, jnp.float32))


def total_and_error(estimate, *, copies=1, layer=None):
    """Mean and standard error [n, 3] of the image, or of one layer, over copies that follow one another."""
    name = layer or "+".join(layers.NAMES)
    value = np.asarray(layers.total(estimate.mean) if layer is None else getattr(estimate.mean, layer), np.float64)
    variance = np.asarray(estimate.variance.sums[name] if layer is None else getattr(estimate.variance, layer), np.float64)
    value, variance = (x.reshape(-1, copies, 3) for x in (value, variance))
    return value.mean(axis=1), np.sqrt(variance.sum(axis=1)) / copies


def z_limit(num_checks):
    """How many standard errors one of so many right results may be off (Sidak)."""
    return float(-ndtri(0.5 * -np.expm1(np.log1p(-FALSE_ALARM) / num_checks)))


def assert_equal(value, error, exact, *, power, rounding=2e-5, exact_error=0.0):
    """Equal within the standard errors, which are small enough to mean something: at most `power` of the exact value."""
    value, error, exact, exact_error = np.broadcast_arrays(value, error, exact, exact_error)
    relative = error / np.abs(exact)
    assert np.all(relative <= power), f"standard error {relative} over {power}"
    z = (np.abs(value - exact) - rounding * np.abs(exact)) / np.hypot(error, exact_error)
    assert np.all(z < z_limit(z.size)), f"{z} standard errors, relative {relative}, found {value}, expected {exact}"
