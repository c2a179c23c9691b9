"""The picture as a whole: books, layers, equal ways to say one scene, what is skipped."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

from jaxvol import media
from jaxvol.layers import items
from jaxvol.methods import lattice_boltzmann
from jaxvol.methods.lattice_boltzmann import illumination, materials
from jaxvol.types import Mesh
from tests.methods.lattice_boltzmann.builders import SMALL, box_picture, box_scene


@pytest.fixture(scope="module")
def grey():
    return box_picture(box_scene())


def test_layers_are_claimed_and_books_balance(grey):
    estimate, plan = grey
    assert plan.num_channels == 1 and any("one spectrum" in reason for reason in plan.skipped)
    claimed = {claim.name for claim in lattice_boltzmann.claims(box_scene())}
    assert claimed == {"volume_from_light", "volume_from_volume", "volume_from_multiple", "volume_from_surface"}
    found = dict(items(estimate.mean))
    assert set(found) == claimed
    assert not np.any(found["volume_from_surface"]) and all(np.isfinite(v).all() for v in found.values())
    diagnostics = estimate.diagnostics
    assert bool(diagnostics["converged"]) and float(diagnostics["residual"].max()) < 2e-4
    assert float(diagnostics["live"][0]) < 1e-4 * float(diagnostics["sent"][0])


def test_three_equal_channels_are_one(grey):
    """Grey media solve one channel; three channels give the same picture (and the colour of the light is kept)."""
    three, plan = box_picture(box_scene(sigma_a=(0.2, 0.2, 0.2000001)))
    assert plan.num_channels == 3
    for (name, a), (_, b) in zip(items(grey[0].mean), items(three.mean), strict=True):
        np.testing.assert_allclose(a, b, rtol=2e-3, atol=2e-4 * float(np.max(np.asarray(b)) + 1e-9), err_msg=name)
    coloured, plan = box_picture(box_scene(light=(2.0, 1.0, 0.5)))
    assert plan.num_channels == 1
    expected = np.asarray(grey[0].mean.volume_from_light)[..., :1] * np.array([2.0, 1.0, 0.5])
    np.testing.assert_allclose(coloured.mean.volume_from_light, expected, rtol=1e-4, atol=1e-6)


def test_constant_grid_is_homogeneous(grey):
    """T12."""
    gridded, _ = box_picture(box_scene(density=jnp.ones((8, 8, 8))))
    for (name, a), (_, b) in zip(items(grey[0].mean), items(gridded.mean), strict=True):
        np.testing.assert_allclose(a, b, rtol=2e-3, atol=2e-3 * float(np.max(np.asarray(a)) + 1e-9), err_msg=name)


def test_empty_border_of_a_grid_costs_nothing():
    """The same cloud in a box of 27 times the volume: the same grid of voxels, the same picture."""
    rng = np.random.default_rng(0)
    tight = np.pad(rng.random((6, 6, 6)), 1)
    plans, pictures, shapes = [], [], []
    for margin in (0, 8):
        density = jnp.asarray(np.pad(tight, margin), jnp.float32)
        edge = 1 / 8
        bounds = jnp.asarray([[-margin * edge] * 3, [1 + margin * edge] * 3], jnp.float32)
        scene = eqx.tree_at(lambda s: s.medium.bounds, box_scene(density=density), bounds)
        found, plan = box_picture(scene)
        plans.append(plan)
        pictures.append(found.mean)
        inside = materials.cropped(scene.medium)
        shapes.append((inside.density.shape, materials.make_grid(inside, resolution=8).shape))
    assert plans[0] == plans[1] and shapes == [((8, 8, 8), (8, 8, 8))] * 2
    for (name, a), (_, b) in zip(*(items(p) for p in pictures), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-3, atol=1e-4 * float(np.max(np.asarray(a)) + 1e-9), err_msg=name)


def test_resampled_density_is_the_trilinear_mean():
    """A grid that does not fit the voxels, against the density looked up at the same points."""
    medium = box_scene(density=jnp.asarray(np.random.default_rng(0).random((5, 6, 7)), jnp.float32)).medium
    bounds = np.array([[-0.09, 0.0, 0.05], [1.11, 1.2, 1.25]])  # no sample on a face
    found = materials._density(medium, bounds, (9, 9, 9))
    axes = [bounds[0, a] + (np.arange(18) + 0.5) * 1.2 / 18 for a in range(3)]
    points = jnp.asarray(np.stack(np.meshgrid(*axes, indexing="ij"), -1), jnp.float32)
    expected = np.asarray(media.density(medium, points)).reshape(9, 2, 9, 2, 9, 2).mean((1, 3, 5))
    np.testing.assert_allclose(found, expected, atol=1e-5)


def test_homogeneous_boxes_solve_with_numbers(grey):
    assert grey[1].homogeneous and any("homogeneous box" in reason for reason in grey[1].skipped)
    fields, plan = box_picture(box_scene(), specialize="structure")
    assert not plan.homogeneous and plan.num_channels == 3
    for (name, a), (_, b) in zip(items(grey[0].mean), items(fields.mean), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-5 * float(np.max(np.asarray(a)) + 1e-9), err_msg=name)


@pytest.mark.parametrize("power", [2.0, 2.0**93, 2.0**-90])
def test_power_scales_the_picture(grey, power):
    """Also where the squares of powers are beyond what a float holds."""
    scaled, _ = box_picture(box_scene(light=(power,) * 3))
    for (name, a), (_, b) in zip(items(grey[0].mean), items(scaled.mean), strict=True):
        np.testing.assert_allclose(b, power * np.asarray(a), rtol=1e-5, atol=1e-6 * power, err_msg=name)


def test_illumination_is_linear_in_its_stages():
    """Marched light alone carries the first layer: without scattering orders beyond it nothing else is lit."""
    scene = box_scene(sigma_s=(1e-4,) * 3, sigma_a=(1.0,) * 3)
    plan = lattice_boltzmann.plan(scene, None, **SMALL)
    light = illumination.illuminate(scene, plan)
    assert float(jnp.max(light.scattered)) < 1e-3 * float(jnp.max(light.from_light))


def test_without_lights_all_is_dark():
    vertices, faces = jnp.asarray([[0.0, 0, 0], [1, 0, 0], [0, 0, 1]]), jnp.asarray([[0, 1, 2]])
    scene = eqx.tree_at(lambda s: s.directional_lights, box_scene(), None)
    scene = eqx.tree_at(lambda s: s.mesh, scene, Mesh(vertices, faces, jnp.full((1, 3), 0.5)), is_leaf=lambda x: x is None)
    dark, _ = box_picture(scene)
    found = dict(items(dark.mean))
    assert len(found) == 4 and not any(np.any(image) for image in found.values())
