"""Light on surfels against closed forms: point, directional and area lights, uniform sky, glossy sides, extinction."""

import jax.numpy as jnp
import numpy as np
import pytest

from jaxvol import lights, ray_casting
from jaxvol.methods.deep_screen_space import lighting
from jaxvol.methods.deep_screen_space import surfels as sf
from jaxvol.methods.deep_screen_space.camera_rays import transmittance_of
from jaxvol.types import DirectionalLights, Mesh, PointLights, Scene
from tests.methods.deep_screen_space.conftest import make_medium, make_mesh

FLOOR = ([-1, 0, 1], [2, 0, 0], [0, 0, -2])  # front side up
ALBEDO = np.array([0.5, 0.4, 0.2])


def lit(scene, *, area=16, sky=64, medium=None):
    """Lambert and glossy entries of the scene's mesh, cut into a few hundred surfels."""
    cut = sf.subdivide(scene.mesh.vertices, scene.mesh.faces, np.array([0, 3.0, 3.0]), num_surfels=400)
    cloud, _ = sf.tessellate(cut, capacity=512)
    choices = lighting.light_choices(scene, num_area_samples=area, num_environment_samples=sky)
    through = transmittance_of(medium or make_medium(0.0, 0.0), (None,), num_steps=16)
    caster = ray_casting.caster_for(scene.mesh)
    return lighting.illuminate(scene, cloud, caster, through, seed=1, choices=choices)


def test_point_light_with_extinction_on_both_sides():
    lamp = np.array([[0.2, 1.0, 0.1], [0.0, -0.7, 0.0]])
    scene = Scene(
        mesh=make_mesh([FLOOR], [ALBEDO]),
        point_lights=PointLights(jnp.asarray(lamp, jnp.float32), jnp.array([[3.0, 2.0, 1.0], [1.0, 1.0, 1.0]])),
    )
    found, glossy = lit(scene, medium=make_medium(0.3, 0.2, half=5.0))
    assert glossy is None
    up = found.normal[:, 1] > 0
    assert up.any() and (~up).any()  # the second lamp shines from below: its side is an entry of its own
    for side, intensity, index in ((up, np.array([3.0, 2.0, 1.0]), 0), (~up, np.ones(3), 1)):
        delta = lamp[index] - found.position[side]
        distance = np.linalg.norm(delta, axis=-1, keepdims=True)
        cosine = np.abs(delta[:, 1:2]) / distance
        expected = ALBEDO / np.pi * intensity * cosine / distance**2 * np.exp(-0.5 * distance)
        np.testing.assert_allclose(found.radiance[side], expected, rtol=1e-4)
    np.testing.assert_allclose(found.area[up].sum(), 4.0, rtol=1e-5)


def test_directional_light_and_its_shadow():
    board = ([-0.5, 0.3, 0.5], [1, 0, 0], [0, 0, -1])
    scene = Scene(
        mesh=make_mesh([FLOOR, board], [ALBEDO, np.zeros(3)]),
        directional_lights=DirectionalLights(jnp.array([[0.0, -1.0, 0.0]]), jnp.array([[2.0, 2.0, 2.0]])),
    )
    found, _ = lit(scene)
    assert (np.abs(found.position[:, [0, 2]]).max(axis=1) > 0.45).all()  # nothing lit below the board, nor a black board
    np.testing.assert_allclose(found.radiance, np.broadcast_to(2 * ALBEDO / np.pi, found.radiance.shape), rtol=1e-4)


def test_uniform_sky_on_an_open_floor():
    """E = pi L everywhere; single surfels are noisy, their mean is not."""
    scene = Scene(mesh=make_mesh([FLOOR], [ALBEDO]), environment=lights.environment_light([1.0, 2.0, 3.0]))
    found, _ = lit(scene)
    top = found.normal[:, 1] > 0
    np.testing.assert_allclose(found.radiance[top].mean(axis=0), ALBEDO * [1.0, 2.0, 3.0], rtol=0.01)


def test_small_area_light_is_a_point_light():
    size = 0.02
    corner = np.array([-size / 2, 1.5, -size / 2])
    quads = [FLOOR, (corner, [size, 0, 0], [0, 0, size])]
    mesh = make_mesh(quads, [ALBEDO, np.zeros(3)])
    emission = np.zeros((4, 3), np.float32)
    emission[2:] = 500.0
    mesh = Mesh(mesh.vertices, mesh.faces, mesh.albedo, emission=jnp.asarray(emission))
    found, _ = lit(Scene(mesh=mesh, area_lights=lights.area_lights(mesh)))
    floor = found.position[:, 1] < 0.1
    delta = np.array([0, 1.5, 0]) - found.position[floor]
    squared = np.sum(delta**2, axis=-1, keepdims=True)
    expected = ALBEDO / np.pi * 500 * size**2 * (1.5**2 / squared) / squared
    np.testing.assert_allclose(found.radiance[floor], expected, rtol=0.02)


def test_glossy_entries_carry_the_mirrored_light():
    mesh = make_mesh([FLOOR], [ALBEDO])
    mesh = Mesh(
        mesh.vertices, mesh.faces, mesh.albedo, specular=jnp.full((2, 3), 0.3), exponent=jnp.full((2,), 20.0)
    )
    sun = np.array([0.6, -0.8, 0.0])
    scene = Scene(mesh=mesh, directional_lights=DirectionalLights(jnp.asarray([sun], jnp.float32), jnp.ones((1, 3))))
    _, glossy = lit(scene)
    np.testing.assert_allclose(glossy.lobe_direction, np.broadcast_to([0.6, 0.8, 0.0], glossy.position.shape), atol=1e-5)
    np.testing.assert_allclose(glossy.radiance, 0.3 * 0.8, rtol=1e-4)
    assert (glossy.normal[:, 1] > 0.99).all() and (glossy.lobe_exponent == 20).all()


@pytest.mark.parametrize("num", [1, 7, 64, 1000])
def test_strata_are_compact_and_complete(num):
    rng = np.random.default_rng(0)
    fields = rng.random((num, 3)), np.tile([0, 0, 1.0], (num, 1)), np.ones(num), rng.random((num, 3))
    cloud = lighting.LitSurfels(*(a.astype(np.float32) for a in fields))
    ordered = lighting.order_for_strata(cloud, capacity=1024)
    assert sorted(ordered.position[:num, 0]) == sorted(cloud.position[:, 0]) and (ordered.area[num:] == 0).all()
    if num == 1000:
        runs = ordered.position[:960].reshape(15, 64, 3)
        assert np.ptp(runs, axis=1).max(axis=1).mean() < 0.6  # of random runs of 64: 0.97
