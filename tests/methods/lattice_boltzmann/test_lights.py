"""Rays from every kind of light: their power, the fluence that they bring, shadows."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh

from jaxvol import lights as light_types
from jaxvol.methods import lattice_boltzmann
from jaxvol.methods.lattice_boltzmann import light_rays
from jaxvol.types import DirectionalLights, Mesh, PointLights, Scene, SpotLights
from tests.methods.lattice_boltzmann.builders import SMALL, box_scene


def test_light_rays_carry_the_lights_power():
    low, high = np.zeros(3), np.ones(3)
    sun = box_scene()
    rays = light_rays.from_lights(sun, low, high, 0.1, rays_per_voxel=4.0, seed=0)
    # the cube's cross-section facing (0.6, -0.8, 0) is 1.4 of irradiance 1
    assert rays.power[:, 0].sum() == pytest.approx(1.4, rel=0.03)
    bulb = Scene(medium=sun.medium, point_lights=PointLights(jnp.asarray([[0.5, 0.5, 0.5]]), jnp.ones((1, 3))))
    inside = light_rays.from_lights(bulb, low, high, 0.1, rays_per_voxel=4.0, seed=0)
    assert inside.power[:, 0].sum() == pytest.approx(4 * np.pi, rel=1e-5)


def _lamp():
    """A square of side 1 at height 3 that shines down with radiance 2."""
    vertices = jnp.asarray([[0.0, 3, 0], [1, 3, 0], [1, 3, 1], [0, 3, 1]])
    faces = jnp.asarray([[0, 1, 2], [0, 2, 3]])
    return Mesh(vertices, faces, jnp.zeros((2, 3)), emission=jnp.full((2, 3), 2.0))


def _lamp_fluence():
    x, z = np.meshgrid(*[(np.arange(50) + 0.5) / 50 - 0.5] * 2)
    square = x * x + z * z + 2.5**2
    return np.mean(2.0 * 2.5 / (square * np.sqrt(square)))


def _one(value):
    return jnp.asarray([value], jnp.float32)


@pytest.mark.parametrize(
    ("lights", "fluence"),
    [
        ({"point_lights": PointLights(_one([0.5, 3.0, 0.5]), _one([4.0] * 3))}, 4.0 / 2.5**2),
        (
            {"spot_lights": SpotLights(_one([0.5, 3.0, 0.5]), _one([0.0, -1, 0]), _one([4.0] * 3), _one(0.5), _one(0.3))},
            4.0 / 2.5**2,
        ),
        ({"directional_lights": DirectionalLights(_one([0.6, -0.8, 0.0]), _one([4.0] * 3))}, 4.0),
        ({"mesh": _lamp(), "area_lights": light_types.area_lights(_lamp())}, _lamp_fluence()),
        ({"environment": light_types.environment_light(np.full((8, 16, 3), 0.5))}, 4 * np.pi * 0.5),
    ],
    ids=["point", "spot", "directional", "area", "environment"],
)
def test_every_light_kind_brings_its_fluence(lights, fluence):
    """In the middle voxel of a box that takes nothing away."""
    medium = box_scene(sigma_s=(0.0,) * 3, sigma_a=(1e-5,) * 3).medium
    scene = Scene(medium=medium, **lights)
    plan = lattice_boltzmann.plan(scene, None, resolution=5, rays_per_voxel=256.0, surface_rays=0)
    light = lattice_boltzmann.illuminate(scene, plan)
    assert float(light.from_light[0, 2, 2, 2]) * light.spectrum[0] / 0.2**2 == pytest.approx(fluence, rel=0.03)


def test_shadows_cut_light_rays():
    wall = trimesh.creation.box(extents=[0.02, 8.0, 8.0])
    wall.apply_translation([-0.5, 0.0, 0.0])
    mesh = Mesh(jnp.asarray(wall.vertices, jnp.float32), jnp.asarray(wall.faces), jnp.zeros((len(wall.faces), 3)))
    scene = eqx.tree_at(lambda s: s.mesh, box_scene(), mesh, is_leaf=lambda x: x is None)
    scene = eqx.tree_at(lambda s: s.directional_lights.direction, scene, jnp.asarray([[1.0, 0.0, 0.0]]))
    plan = lattice_boltzmann.plan(scene, None, **SMALL)
    light = lattice_boltzmann.illuminate(scene, plan)
    assert float(jnp.max(light.from_light)) == 0.0
