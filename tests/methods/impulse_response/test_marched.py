"""Segments that are integrated instead of looked up: against quadrature, the path tracer and the tables."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

from jaxvol import extinction, layers
from jaxvol.methods import impulse_response
from jaxvol.methods.impulse_response import marched
from jaxvol.methods.impulse_response.light_sources import Light
from jaxvol.types import DirectionalLights, Medium, Mesh
from tests import problems
from tests.methods.impulse_response.test_irradiance import REFERENCE, found, open_plane, receivers

WALL = np.array([[0.5, -3, 0], [0.5, 3, 0], [0.5, 3, 1.5], [0.5, -3, 1.5]], np.float32)


def behind_a_wall(c):
    scene = open_plane(c)
    corners = jnp.concatenate([scene.mesh.vertices, jnp.asarray(WALL)])
    faces = jnp.concatenate([scene.mesh.faces, jnp.array([[4, 5, 6], [4, 6, 7]])])
    return open_plane(c, mesh=Mesh(corners, faces, jnp.zeros((4, 3))))


def always(scene, **options):
    """A plan that marches every segment of the receivers."""
    return impulse_response.plan(scene, None, max_bounces=0, bounded=np.inf, **options)


@pytest.mark.parametrize("g", [0.0, 0.5])
def test_marching_a_homogeneous_medium_gives_the_tables_single_scattering(g):
    scene = open_plane(0.9, g)
    looked_up = found(impulse_response.irradiance(scene, *receivers(), samples=1, max_bounces=0), "surface_from_volume")
    estimate = impulse_response.irradiance(scene, *receivers(), plan=always(scene, legs=1), samples=16384)
    error = np.sqrt(np.asarray(estimate.variance.surface_from_volume)[:, 0])
    assert np.all(np.abs(found(estimate, "surface_from_volume") - looked_up) < 4 * error + 4e-3 * looked_up)
    assert error.sum() < 0.02 * looked_up.sum() and float(estimate.diagnostics["marched_share"]) == 1


def test_marching_sunlight_gives_the_tables_single_scattering():
    """A slab so wide and deep that it is the table's half-space lit straight down, receiver 2 mean free paths below its top."""
    medium = Medium(jnp.array([[-40.0, -40, 0], [40, 40, 2]]), jnp.full(3, 0.9), jnp.full(3, 0.1), jnp.float32(0.3))
    sun = DirectionalLights(jnp.array([[0.0, 0.0, -1.0]]), jnp.ones((1, 3)))
    scene = open_plane(0.9, medium=medium, point_lights=None, directional_lights=sun)
    points, normals = np.zeros((1, 3), np.float32), np.float32([[0, 0, 1]])
    options = {"samples": 1, "max_bounces": 0, "bounded": None}
    looked_up = found(impulse_response.irradiance(scene, points, normals, **options), "surface_from_volume")
    estimate = impulse_response.irradiance(scene, points, normals, plan=always(scene, legs=1), samples=16384)
    error = np.sqrt(np.asarray(estimate.variance.surface_from_volume)[:, 0])
    assert np.abs(found(estimate, "surface_from_volume") - looked_up) < 4 * error + 2e-3 * looked_up
    assert error < 0.02 * looked_up


def slab_in_the_sun(tau):
    """A white slab on a black plane, so wide that its sides do not matter."""
    medium = Medium(jnp.array([[-40.0, -40, 0], [40, 40, tau]]), jnp.ones(3), jnp.zeros(3), jnp.float32(0.0))
    sun = DirectionalLights(jnp.array([[0.0, 0.0, -1.0]]), jnp.ones((1, 3)))
    return open_plane(1.0, medium=medium, point_lights=None, directional_lights=sun)


@pytest.mark.parametrize("slab", problems.SLABS[:2], ids=lambda slab: f"tau {slab.tau}")
def test_bounded_media_are_marched_inside_their_bounds(slab):
    """T4: the total transmittance of a slab is the irradiance below it; the tables take it for a half-space."""
    scene = slab_in_the_sun(slab.tau)
    points, normals = np.zeros((1, 3), np.float32), np.float32([[0, 0, 1]])
    assert impulse_response.plan(scene, None).march_all and not impulse_response.plan(scene, None, bounded=None).march_all
    estimate = impulse_response.irradiance(scene, points, normals, samples=32768, max_bounces=0, legs=16)
    parts = [np.asarray(getattr(estimate.variance, name))[0, 0] for name in layers.SURFACE]
    error = np.sqrt(np.sum(parts) + 2 * np.sqrt(np.prod(parts[2:])))  # layers of one path go together at worst
    assert error < 0.01 * slab.transmittance
    assert abs(np.asarray(layers.total(estimate.mean))[0, 0] - slab.transmittance) < 4 * error


def test_legs_towards_a_lamp_keep_the_light():
    """Many legs, half of them equi-angular about the lamp, against the path tracer."""
    scene = open_plane(0.5)
    estimate = impulse_response.irradiance(scene, *receivers(), plan=always(scene), samples=16384)
    once, rest = REFERENCE[0.5, 0.0, 0.0]
    error = np.sqrt(np.asarray(estimate.variance.surface_from_multiple)[:, 0])
    assert np.linalg.norm(error) < 0.04 * sum(rest)
    assert abs(found(estimate, "surface_from_multiple").sum() - sum(rest)) < 3 * np.linalg.norm(error)


def test_contrast_is_measured_around_segments():
    constant = Medium(jnp.array([[-2.0] * 3, [2.0] * 3]), jnp.ones(3), jnp.ones(3), jnp.float32(0.0), jnp.ones((4, 4, 4)))
    half = dataclasses.replace(constant, density=jnp.ones((4, 4, 4)).at[2:].set(0.0))
    position = jnp.array([[-1.0, 0, 0], [1.2, 0, 0], [-0.2, 0, 0]])
    light = Light(jnp.array([[0.0, 0, 1]] * 3), jnp.full(3, 0.4), jnp.ones((3, 3)))
    normal = light.direction
    empty = dataclasses.replace(constant, density=jnp.zeros((4, 4, 4)))
    for medium, expected in ((constant, 0.0), (half, 1.0), (empty, 1.0)):
        found = marched.contrast(extinction.marching_medium(medium), position, normal, light)
        np.testing.assert_allclose(found, expected, atol=1e-6)


def test_a_varying_medium_is_marched_and_a_constant_one_looked_up():
    scene = open_plane(0.9)
    noise = np.random.default_rng(0).uniform(0, 1, (24, 24, 12))
    for density, expected in ((np.ones((4, 4, 4)), 0.0), (noise, 1.0)):
        grid = dataclasses.replace(scene.medium, density=jnp.asarray(density, jnp.float32))
        varying = open_plane(0.9, medium=grid)
        estimate = impulse_response.irradiance(varying, *receivers(), samples=4, max_bounces=0, contrast=0.2)
        assert float(estimate.diagnostics["marched_share"]) == expected
    plan = impulse_response.plan(open_plane(0.9, medium=grid), None, contrast=None)
    assert plan.contrast is None


def test_light_goes_around_a_wall():
    scene, points, normals = behind_a_wall(0.5), *receivers()
    points = points + np.float32([0.01, 0, 0])
    dropped = impulse_response.irradiance(scene, points, normals, samples=1, max_bounces=0, occlusion="drop")
    assert np.all(np.asarray(layers.total(dropped.mean))[2:] == 0)
    estimate = impulse_response.irradiance(scene, points, normals, samples=16384, max_bounces=0)
    # path_tracing.irradiance there, 20,000 samples: 9.5e-4 +- .6e-4, 5.2e-4 +- .3e-4, 2.9e-4 +- .4e-4 at 1, 2, 3.
    total = np.asarray(layers.total(estimate.mean))[2:, 0]
    assert 0.4 < total.sum() / 1.76e-3 < 1.1  # one leg: the tables drop what is occluded from there
    assert float(estimate.diagnostics["occluded_share"]) == 0
