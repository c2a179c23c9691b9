"""The pair kernel against float64 formulas and quadrature over the disk."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxvol import phase as phase_functions
from jaxvol.methods.deep_screen_space import kernel


def row(position, normal, radius, inner2=0.0, outer2=np.inf, **lobe):
    values = dict(zip(kernel.COLUMNS, [*position, *normal, inner2, outer2, 0.5 * radius**2, 1, 1, 1], strict=True)) | lobe
    return {name: jnp.full((1, 1), value, jnp.float32) for name, value in values.items()}


def evaluate(surfel, direction, distances, phase="isotropic", g=0.0, table=None):
    ray = tuple(jnp.full((1, 1), x, jnp.float32) for x in direction)
    ds = [jnp.full((1, 1), d, jnp.float32) for d in distances]
    values = kernel.pair_samples(ray, ds, surfel, phase=phase, g=jnp.float32(g), table=table)
    return float(kernel.phase_scale(phase, jnp.float32(g))) * np.array([float(v[0, 0]) for v in values])


def exact(position, normal, radius, direction, distances, g=0.0):
    """cos * phase / (d2 + delta), with delta in the cosine's length too; float64."""
    out = []
    for d in distances:
        delta = np.asarray(direction, np.float64) * d - position
        squared = delta @ delta + 0.5 * radius**2
        mu = -(delta @ np.asarray(direction)) / np.sqrt(squared)
        p = (1 - g * g) / (4 * np.pi * (1 + g * g - 2 * g * mu) ** 1.5)
        out.append(max(delta @ np.asarray(normal), 0) / squared**1.5 * p)
    return np.array(out)


@pytest.mark.parametrize("g", [-0.6, 0.0, 0.4, 0.7, 0.9])
def test_against_float64(g):
    rng = np.random.default_rng(2)
    for _ in range(8):
        position, normal, direction = (v / np.linalg.norm(v) for v in rng.normal(size=(3, 3)))
        distances = np.sort(rng.uniform(0, 3, 6))
        phase = "isotropic" if g == 0 else "henyey_greenstein"
        found = evaluate(row(position, normal, 0.05), direction, distances, phase, g)
        np.testing.assert_allclose(found, exact(position, normal, 0.05, direction, distances, g), rtol=2e-4, atol=1e-7)


def test_moments_of_henyey_greenstein_agree_with_it():
    table = phase_functions.phase_table(0.5 ** np.arange(40))
    args = (row([0.3, 0.2, -1.0], [0, 0.6, 0.8], 0.05), [0.0, 0.0, -1.0], [0.2, 0.8, 1.4])
    np.testing.assert_allclose(evaluate(*args, "table", table=table), evaluate(*args, "henyey_greenstein", 0.5), rtol=3e-3)


@pytest.mark.parametrize(("ratio", "limit"), [(1.0, 0.08), (2.0, 0.012), (4.0, 0.002)])
def test_softening_against_the_disk_on_its_axis(ratio, limit):
    """Irradiance over radiance of a disk on its axis: pi r^2/(d^2 + r^2); as cos/d^2 times the area it is 1/(d^2 + r^2)."""
    radius = 0.1
    d = ratio * radius
    scattered = evaluate(row([0, 0, 0], [0, 0, 1], radius), [0, 0, 1.0], [d]) * 4 * np.pi
    # The medium's sample receives the fluence, not the irradiance: the integral of the solid angle.
    solid_angle = 2 * np.pi * (1 - d / np.hypot(d, radius))
    assert abs(scattered[0] * np.pi * radius**2 / solid_angle - 1) < limit


def test_never_infinite_at_the_surfel_behind_it_or_in_its_plane():
    radius = 0.02
    surfel = row([0, 0, -1.0], [0, 0, 1], radius)
    at, plane, behind = (
        evaluate(surfel, [0, 0, -1.0], [1.0]),
        evaluate(row([0, 0, -1.0], [0, 1, 0], radius), [0, 0, -1.0], [0.2, 1.0, 1.7]),
        evaluate(surfel, [0, 0, -1.0], [1.2, 2.0]),
    )
    assert (at == 0).all() and (plane == 0).all() and (behind == 0).all()
    near = evaluate(surfel, [0, 0, -1.0], 1.0 - radius * np.geomspace(1e-3, 1, 9))
    assert np.isfinite(near).all() and (near * 4 * np.pi <= 2.0 / radius**2).all()


def test_splitting_a_surfel_does_not_change_its_far_light():
    whole = evaluate(row([0, 0, 0], [0, 0, 1], 0.02), [0, 0.6, 0.8], [1.0])
    half = evaluate(row([0, 0, 0], [0, 0, 1], 0.02 / np.sqrt(2)), [0, 0.6, 0.8], [1.0])
    np.testing.assert_allclose(half, whole, rtol=5e-4)


@pytest.mark.parametrize("g", [0.999, -0.999, 1.0])
def test_extreme_mean_cosines_stay_finite(g):
    found = evaluate(row([0, 0, -1.0], [0, 0, -1.0], 1e-3), [0, 0, -1.0], [1.0 + 1e-6, 1.5, 9.0], "henyey_greenstein", g)
    found = np.concatenate([found, evaluate(row([0, 0, -5.0], [0, 0, 1], 1e-3), [0, 0, -1.0], [1.0], "henyey_greenstein", g)])
    assert np.isfinite(found).all() and (found >= 0).all()


@pytest.mark.parametrize(("phase", "g"), [("isotropic", 0.0), ("henyey_greenstein", 0.7), ("henyey_greenstein", 1.0)])
def test_gradients_are_finite_where_square_roots_begin(phase, g):
    """By the sample's distance, the surfel's place and g: at the surfel, in its plane, behind it; elsewhere a difference."""

    def value(d, place, g):
        surfel = row([0, 0, 0], [0, 0, 1], 0.02) | {name: place[i] * jnp.ones((1, 1)) for i, name in enumerate("xyz")}
        ray = tuple(jnp.full((1, 1), x, jnp.float32) for x in (0.0, 0.0, -1.0))
        return kernel.pair_samples(ray, [d * jnp.ones((1, 1))], surfel, phase=phase, g=g)[0][0, 0]

    for place in ([0.0, 0.0, -1.0], [0.2, 0.0, -1.0], [0.1, 0.2, -0.3]):
        found = jax.grad(value, argnums=(0, 1, 2))(jnp.float32(1.0), jnp.float32(place), jnp.float32(g))
        assert all(bool(jnp.isfinite(x).all()) for x in found)
    place, h = jnp.float32([0.3, 0.1, -1.5]), 4e-3
    slope = jax.grad(value)(jnp.float32(0.6), place, jnp.float32(g))
    above, below = (value(jnp.float32(0.6 + s * h), place, jnp.float32(g)) for s in (1, -1))
    np.testing.assert_allclose(slope, (above - below) / (2 * h), rtol=5e-3)


def test_shells_partition_all_distances():
    position, normal, direction = [0.1, 0.2, -1.5], [0, 0, 1.0], [0, 0, -1.0]
    distances = np.linspace(0.05, 1.4, 40)
    whole = evaluate(row(position, normal, 0.05), direction, distances)
    edges = [0.0, 0.04, 0.16, 0.64, np.inf]
    parts = [evaluate(row(position, normal, 0.05, a, b), direction, distances) for a, b in zip(edges, edges[1:], strict=False)]
    np.testing.assert_array_equal(np.sum(parts, axis=0), whole)
    assert all((p > 0).sum() < 40 for p in parts)


def test_phong_lobe():
    """cos * (n+2)/(2 pi) cos^n(lobe) * phase / d^2 in float64, far from the surfel."""
    normal, lobe = np.array([0, 0.6, 0.8]), np.array([0.0, 0.0, 1.0])
    position, direction, d, n = np.array([0.0, -0.2, -3.0]), np.array([0.0, 0.1, -1.0]), 1.2, 30.0
    direction /= np.linalg.norm(direction)
    surfel = row(position, normal, 1e-3, lx=lobe[0], ly=lobe[1], lz=lobe[2], exponent=n)
    delta = direction * d - position
    length = np.linalg.norm(delta)
    expected = (delta @ normal) / length**3 * (n + 2) / (2 * np.pi) * (delta @ lobe / length) ** n / (4 * np.pi)
    np.testing.assert_allclose(evaluate(surfel, direction, [d])[0], expected, rtol=2e-4)
