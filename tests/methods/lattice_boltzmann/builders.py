"""A cube of fog in the sun, its picture, and an experiment's functions: what several tests of the lattice need."""

import importlib
from pathlib import Path
from types import ModuleType

import jax.numpy as jnp
import pytest

from jaxvol import camera as cameras
from jaxvol.methods import lattice_boltzmann
from jaxvol.types import Camera, DirectionalLights, Medium, Scene


def box_scene(sigma_s=(2.0, 2.0, 2.0), sigma_a=(0.2, 0.2, 0.2), light=(1.0, 1.0, 1.0), **fields):
    medium = Medium(
        bounds=jnp.asarray([[0.0, 0, 0], [1, 1, 1]]),
        sigma_s=jnp.asarray(sigma_s, jnp.float32),
        sigma_a=jnp.asarray(sigma_a, jnp.float32),
        g=fields.pop("g", jnp.float32(0.0)),
        **fields,
    )
    sun = DirectionalLights(jnp.asarray([[0.6, -0.8, 0.0]]), jnp.asarray([light], jnp.float32))
    return Scene(medium=medium, directional_lights=sun)


def experiment(name: str) -> ModuleType:
    """The script of that name in experiments/, as a module."""
    folder = Path(__file__).resolve().parents[3] / "experiments"
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(folder))
        return importlib.import_module(name)


def box_camera(size=8):
    pose = cameras.look_at([0.5, 0.6, 3.0], [0.5, 0.5, 0.5], [0, 1, 0])
    return Camera(jnp.asarray(pose), jnp.float32(0.6), size, size)


SMALL = {"resolution": 8, "rays_per_voxel": 2.0, "samples_per_pixel": 1}


def box_picture(scene, **options):
    plan = lattice_boltzmann.plan(scene, box_camera(), **(SMALL | options))
    return lattice_boltzmann.render(scene, box_camera(), plan, seed=0), plan
