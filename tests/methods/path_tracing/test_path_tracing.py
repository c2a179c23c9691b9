"""The reference against exact answers, against itself in other shapes, and against what a scene lacks."""

import math

import jax.numpy as jnp
import numpy as np
import pytest

from jaxvol import layers, lights, meshes, phase
from jaxvol.camera import look_at
from jaxvol.methods import path_tracing
from jaxvol.methods.path_tracing import driver
from jaxvol.types import (
    Camera,
    DirectionalLights,
    Mesh,
    Rays,
    Scene,
)
from tests.methods.path_tracing.builders import box, point


def total_and_error(estimate):
    """Image and its standard error, first channel."""
    variance = np.asarray(estimate.variance.sums["+".join(layers.NAMES)])
    return np.asarray(layers.total(estimate.mean)), np.sqrt(variance)


def assert_close(value, error, exact, *, power, z=3.5):
    """|value - exact| <= z standard errors, and the standard error is small enough to mean something."""
    value, error, exact = np.broadcast_arrays(value, error, exact)
    assert np.all(error <= power * np.abs(exact)), f"standard error {error / exact} over {power}"
    assert np.all(np.abs(value - exact) <= z * error + 2e-5 * np.abs(exact)), f"{(value - exact) / error} sigma"


@pytest.mark.parametrize("grid", [None, 8])
def test_white_furnace(grid):
    """T1: albedo 1 inside and uniform radiance 1 outside give radiance 1 along every ray."""
    medium = box([-1, -1, -1], [1, 1, 1], sigma_s=[4.0, 2.0, 1.0], sigma_a=0.0, g=0.4, grid=grid)
    scene = Scene(medium=medium, environment=lights.environment_light([1.0, 1.0, 1.0]))
    origin = jnp.asarray([[0, 0, 4.0], [0.3, -0.2, 0.1]])
    direction = jnp.asarray([[0, 0, -1.0], [0.6, 0.8, 0.0]])
    rays = Rays(jnp.repeat(origin, 128, 0), jnp.repeat(direction, 128, 0), jnp.full(256, jnp.inf))
    estimate = path_tracing.radiance(scene, rays, samples=256)
    value, error = total_and_error(estimate)
    value = value.reshape(2, 128, 3).mean(axis=1)
    error = np.sqrt((error**2).reshape(2, 128, 3).sum(axis=1)) / 128
    assert_close(value, error, 1.0, power=0.01)


def test_fluence_around_a_point_source():
    """T2: Case, de Hoffmann and Placzek's fluence of an isotropic source of power 1."""
    medium = box([-25] * 3, [25] * 3, sigma_s=0.5, sigma_a=0.5)
    scene = Scene(medium=medium, point_lights=point([0, 0, 0], 1 / (4 * math.pi)))
    r = np.array([0.5, 1.0, 2.0])
    spots = np.repeat(np.stack([r, 0 * r, 0 * r], axis=1), 64, axis=0)
    estimate = path_tracing.fluence(scene, spots, samples=512)
    value, error = total_and_error(estimate)
    value = value[:, 0].reshape(3, 64).mean(axis=1)
    error = np.sqrt((error[:, 0] ** 2).reshape(3, 64).sum(axis=1)) / 64
    assert_close(value, error, [0.29476312, 0.058695138, 0.0079276237], power=0.02)


@pytest.mark.parametrize(
    ("tau", "albedo", "g", "reflected", "transmitted"),
    [(2.0, 1.0, 0.0, 0.517515, 0.482485), (2.0, 1 - 1e-7, 0.75, 0.163176, 0.836824)],
)
def test_slab_in_collimated_light(tau, albedo, g, reflected, transmitted):
    """T4: reflectance and total transmittance of a wide slab under light along its normal."""
    medium = box([-300, -300, -tau], [300, 300, 0], sigma_s=albedo, sigma_a=1 - albedo, g=g)
    sun = DirectionalLights(jnp.asarray([[0.0, 0.0, -1.0]]), jnp.ones((1, 3)))
    spots = np.repeat([[0, 0, 1e-3], [0, 0, -tau - 1e-3]], 256, axis=0)
    normals = np.repeat([[0, 0, -1.0], [0, 0, 1.0]], 256, axis=0)
    estimate = path_tracing.irradiance(Scene(medium=medium, directional_lights=sun), spots, normals, samples=512)
    value, error = total_and_error(estimate)
    value = value[:, 0].reshape(2, 256).mean(axis=1)
    error = np.sqrt((error[:, 0] ** 2).reshape(2, 256).sum(axis=1)) / 256
    assert_close(value, error, [reflected, transmitted], power=0.01)


def test_half_space_as_a_thick_slab():
    """T3: plane albedo of a half space, c = 0.5 and 0.9, light along the normal (two channels of one medium)."""
    medium = box([-900, -900, -40], [900, 900, 0], sigma_s=[0.5, 0.9, 0.5], sigma_a=[0.5, 0.1, 0.5])
    sun = DirectionalLights(jnp.asarray([[0.0, 0.0, -1.0]]), jnp.ones((1, 3)))
    spots = np.repeat([[0, 0, 1e-3]], 512, axis=0)
    normals = np.repeat([[0, 0, -1.0]], 512, axis=0)
    scene = Scene(medium=medium, directional_lights=sun)
    estimate = path_tracing.irradiance(scene, spots, normals, samples=256)
    value, error = total_and_error(estimate)
    error = np.sqrt((error**2).sum(axis=0)) / 512
    assert_close(value.mean(axis=0), error, [0.115226, 0.414947, 0.115226], power=0.01)


def test_airlight_of_a_point_light():
    """T7: single scattering of an isotropic point light along a ray, with extinction (Sun et al. 2005)."""
    for sigma, distance, gamma, exact in ((1.0, 1.0, math.pi / 2, 0.1933049620), (0.5, 2.0, 0.3, 1.1473272643)):
        medium = box([-80] * 3, [80] * 3, sigma_s=1e-4 * sigma, sigma_a=(1 - 1e-4) * sigma)
        source = [distance * math.cos(gamma), distance * math.sin(gamma), 0.0]
        scene = Scene(medium=medium, point_lights=point(source))
        rays = Rays(jnp.zeros((64, 3)), jnp.tile(jnp.asarray([[1.0, 0, 0]]), (64, 1)), jnp.full(64, jnp.inf))
        found = path_tracing.radiance(scene, rays, samples=64, max_scatterings=1)
        value = np.asarray(found.mean.volume_from_light)[:, 0].mean() / (1e-4 * sigma / (4 * math.pi))
        error = np.sqrt(np.asarray(found.variance.volume_from_light)[:, 0].sum()) / 64 / (1e-4 * sigma / (4 * math.pi))
        assert_close(value, error, exact, power=0.02)


def test_a_constant_grid_equals_the_homogeneous_medium_in_every_channel():
    """T12, with channels 100:1 apart and albedo 0 in one; the light inside, so that equi-angular sampling is at work."""
    rays = Rays(
        jnp.tile(jnp.asarray([[0.2, 0.1, 4.0]]), (256, 1)),
        jnp.tile(jnp.asarray([[0.0, 0.0, -1.0]]), (256, 1)),
        jnp.full(256, jnp.inf),
    )
    found = []
    for grid in (None, 8):
        medium = box([-1] * 3, [1] * 3, sigma_s=[4.0, 0.04, 0.0], sigma_a=[0.4, 0.004, 1.0], g=0.3, grid=grid)
        scene = Scene(medium=medium, point_lights=point([0.5, 0.3, 0.5]))
        estimate = path_tracing.radiance(scene, rays, samples=1024, seed=3)
        value, error = total_and_error(estimate)
        found.append((value.mean(axis=0), np.sqrt((error**2).sum(axis=0)) / 256))
    (a, da), (b, db) = found
    assert a[2] == b[2] == 0
    assert np.all(np.hypot(da, db)[:2] < 0.03 * a[:2])
    assert np.all(np.abs(a - b)[:2] < 3.5 * np.hypot(da, db)[:2])


def floor(albedo=0.5, size=1.0):
    corners = jnp.asarray([[-size, 0, -size], [-size, 0, size], [size, 0, size], [size, 0, -size]], jnp.float32)
    return Mesh(corners, jnp.asarray([[0, 1, 2], [0, 2, 3]]), jnp.full((2, 3), albedo, jnp.float32))


def sphere(radius=1.0):
    triangles = meshes.builtin("sphere")
    vertices = jnp.asarray(triangles.vertices, jnp.float32)
    vertices = radius * vertices / jnp.max(jnp.linalg.norm(vertices, axis=1))
    return Mesh(vertices, jnp.asarray(triangles.faces), jnp.full((len(triangles.faces), 3), 0.5, jnp.float32))


def test_lambertian_floor_under_a_point_light():
    """Closed form without a medium: albedo / pi * I cos / d^2; all other layers are exactly zero."""
    scene = Scene(mesh=floor(), point_lights=point([0.0, 2.0, 0.0], 3.0))
    rays = Rays(jnp.asarray([[0.5, 1.0, 0.0]]), jnp.asarray([[0.0, -1.0, 0.0]]), jnp.asarray([jnp.inf]))
    found = path_tracing.radiance(scene, rays, samples=16).mean
    squared = 0.25 + 4.0
    exact = 0.5 / math.pi * 3.0 * 2.0 / squared / math.sqrt(squared)
    assert np.allclose(found.surface_from_light, exact, rtol=1e-4)
    for name, image in layers.items(found):
        assert name == "surface_from_light" or np.all(np.asarray(image) == 0)


def test_a_lamp_above_a_large_floor_does_not_shadow_itself():
    """Offsets of ray origins grow with the mesh; the shadow ray still ends short of the lamp. Disc formula's centre."""
    half = 0.05
    lamp = np.array([[-half, 1, -half], [half, 1, -half], [half, 1, half], [-half, 1, half]], np.float32)
    ground = np.asarray(floor(size=100.0).vertices)
    mesh = Mesh(
        jnp.asarray(np.concatenate([ground, lamp])),
        jnp.asarray([[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]]),
        jnp.full((4, 3), 0.5, jnp.float32),
        emission=jnp.asarray([[0.0] * 3] * 2 + [[100.0] * 3] * 2),
    )
    scene = Scene(mesh=mesh, area_lights=lights.area_lights(mesh))
    rays = Rays(jnp.asarray([[2.0, 3.0, 0.0]] * 8), jnp.asarray([[-0.5547002, -0.8320503, 0.0]] * 8), jnp.full(8, jnp.inf))
    found = np.asarray(path_tracing.radiance(scene, rays, samples=64).mean.surface_from_light)
    assert np.allclose(found, 0.5 / math.pi * 100.0 * (2 * half) ** 2, rtol=0.02)


def test_closed_sphere_with_a_light_at_its_centre():
    """A sphere of albedo 1/2 around a point light has radiance 1 (pbrt-v4's scene): sum of all bounces."""
    mesh = sphere()
    scene = Scene(mesh=mesh, point_lights=point([0, 0, 0], math.pi))
    direction = np.array([[0.3, 0.5, 0.81]]) / np.linalg.norm([0.3, 0.5, 0.81])
    rays = Rays(jnp.zeros((64, 3)) + 0.1, jnp.tile(jnp.asarray(direction, jnp.float32), (64, 1)), jnp.full(64, jnp.inf))
    value, error = total_and_error(path_tracing.radiance(scene, rays, samples=64))
    radius = float(jnp.max(jnp.linalg.norm(mesh.vertices, axis=1)))
    assert abs(value.mean() * radius**2 - 1.0) < 0.02  # the sphere is a polyhedron


def test_layers_sum_to_the_image_and_do_not_depend_on_lanes():
    medium = box([-1, 0, -1], [1, 1, 1], sigma_s=1.0, sigma_a=0.1)
    scene = Scene(mesh=floor(size=2.0), medium=medium, point_lights=point([0, 2, 0.5], 3.0))
    camera = Camera(look_at([0, 1.5, 3], [0, 0.3, 0], [0, 1, 0]), jnp.float32(0.7), height=12, width=16)
    found = []
    for lanes in (256, 1024):
        plan = path_tracing.plan(scene, camera, num_lanes=lanes)
        found.append(path_tracing.render(scene, camera, plan, samples=16, seed=5))
    a, b = (np.asarray(layers.total(f.mean)) for f in found)
    close = np.isclose(a, b, rtol=1e-4, atol=1e-5).all(axis=-1)
    assert close.mean() > 0.999
    separate = [np.asarray(image) for _, image in layers.items(found[0].mean)]
    assert len(separate) == 9 and np.allclose(sum(separate), a, rtol=1e-5)
    assert all(
        np.max(image) > 0 for name, image in layers.items(found[0].mean) if name not in ("emission", "surface_from_surface")
    )  # nothing emits in view, and a flat floor does not see itself


def test_phase_table_and_inclusions():
    """A Henyey-Greenstein table equals the closed form; an inclusion of the same stuff changes nothing."""
    ball = sphere(0.6)
    sun = DirectionalLights(jnp.asarray([[0.0, -1.0, 0.0]]), jnp.ones((1, 3)))
    rays = Rays(
        jnp.tile(jnp.asarray([[0.1, 0.2, 4.0]]), (256, 1)),
        jnp.tile(jnp.asarray([[0.0, 0.0, -1.0]]), (256, 1)),
        jnp.full(256, jnp.inf),
    )
    common = {"sigma_s": 1.5, "sigma_a": 0.2, "g": 0.5}
    inner = box([-1] * 3, [1] * 3, boundary=ball, **common)
    variants = (
        box([-1] * 3, [1] * 3, **common),
        box([-1] * 3, [1] * 3, phase=phase.phase_table(0.5 ** np.arange(30)), **common),
        box([-1] * 3, [1] * 3, inclusions=(inner,), **common),
    )
    values, errors = [], []
    for medium in variants:
        value, error = total_and_error(path_tracing.radiance(Scene(medium=medium, directional_lights=sun), rays, samples=128))
        values.append(value[:, 0].mean())
        errors.append(np.sqrt((error[:, 0] ** 2).sum()) / 256)
    assert max(errors) < 0.01 * values[0]
    for value, error in zip(values[1:], errors[1:], strict=True):
        assert abs(value - values[0]) < 3.5 * math.hypot(error, errors[0])


def test_what_is_absent_costs_nothing_and_is_exactly_zero():
    camera = Camera(jnp.eye(4), jnp.float32(0.7), height=4, width=4)
    empty = box([-1] * 3, [1] * 3, sigma_s=0.0, sigma_a=0.0)
    scene = Scene(mesh=floor(), medium=empty, point_lights=point([0, 2, 0]))
    plan = path_tracing.plan(scene, camera)
    assert plan.drop_medium and any("dropped" in reason for reason in plan.skipped)
    found = path_tracing.render(scene, camera, plan, samples=1).mean
    assert all(np.all(np.asarray(getattr(found, name)) == 0) for name in layers.VOLUME)
    dark = path_tracing.plan(Scene(mesh=floor()), camera)
    assert dark.num_shadows == 0 and dark.settings.max_scatterings == 0
    assert np.all(np.asarray(layers.total(path_tracing.render(Scene(mesh=floor()), camera, dark, samples=1).mean)) == 0)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"max_scatterings": -1}, "max_scatterings"),
        ({"roulette_from": 0}, "roulette_from"),
        ({"equiangular": True}, "equiangular"),
    ],
)
def test_bad_options_are_named(change, words):
    camera = Camera(jnp.eye(4), jnp.float32(0.7), height=4, width=4)
    with pytest.raises(ValueError, match=words):
        path_tracing.plan(Scene(mesh=floor()), camera, **change)


def test_refraction_is_refused():
    medium = box([-1] * 3, [1] * 3, sigma_s=1.0, sigma_a=0.0, ior=jnp.float32(1.3))
    with pytest.raises(ValueError, match="refractive_index"):
        path_tracing.plan(Scene(medium=medium), Camera(jnp.eye(4), jnp.float32(0.7), height=4, width=4))


def test_two_parameter_values_make_one_compilation():
    rays = Rays(jnp.zeros((4, 3)), jnp.tile(jnp.asarray([[0.0, 0, 1]]), (4, 1)), jnp.full(4, jnp.inf))
    sizes = []
    for sigma in (0.7, 0.9):
        medium = box([-1] * 3, [1] * 3, sigma_s=sigma, sigma_a=0.1, g=sigma - 0.5)
        path_tracing.radiance(Scene(medium=medium, point_lights=point([0, 2, sigma])), rays, samples=4)
        sizes.append(driver.jit_step()._cache_size())
    assert sizes[0] == sizes[1]
