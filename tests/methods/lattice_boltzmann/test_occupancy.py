"""Rays are walked from the first filled block to the last, and that changes nothing but the time."""

from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.ndimage import maximum_filter

from jaxvol.methods import lattice_boltzmann
from jaxvol.methods.lattice_boltzmann import marching, occupancy
from jaxvol.methods.lattice_boltzmann.materials import Grid, Materials
from jaxvol.types import Rays
from tests.methods.lattice_boltzmann.builders import SMALL, box_scene

SHAPE = (40, 29, 34)


@pytest.fixture(scope="module")
def specks():
    """Voxels of a few blobs in a large empty grid."""
    rng = np.random.default_rng(0)
    filled = np.zeros(SHAPE, np.float32)
    for corner in ((3, 4, 2), (30, 20, 5), (5, 24, 30)):
        filled[tuple(slice(c, c + 3) for c in corner)] = rng.random((3, 3, 3)) + 0.1
    filled[20, 0, 33] = 0.5  # a single voxel at a face
    field = jnp.asarray(filled)[None]
    return Materials(Grid(jnp.zeros(3), jnp.float32(1.0), SHAPE), 0.8 * field, 0.2 * field, None, None, None)


def _with_neighbours(materials):
    """Voxels between whose centres fluence is interpolated inside filled ones."""
    return maximum_filter(np.asarray(materials.scattering[0]) > 0, size=3, mode="constant")


def _rays(count):
    rng = np.random.default_rng(1)
    start, end = (rng.normal(size=(count, 3)) for _ in range(2))
    center = np.array(SHAPE) / 2
    start = center + 40.0 * start / np.linalg.norm(start, axis=1, keepdims=True)
    end = center + end * np.array(SHAPE) / 4
    direction = (end - start) / np.linalg.norm(end - start, axis=1, keepdims=True)
    return start, direction, np.full(count, np.inf), np.ones((count, 1), np.float32)


def test_light_leaves_the_same_track_in_fewer_steps(specks):
    blocks = occupancy.filled_blocks(specks)
    whole = marching.march_straight(specks, *_rays(20_000))
    found = marching.march_straight(specks, *_rays(20_000), blocks=blocks)
    filled = _with_neighbours(specks)
    expected, track = (np.where(filled, np.asarray(x.track[0]), 0.0) for x in (whole, found))
    assert expected.max() > 1.0
    np.testing.assert_allclose(track, expected, rtol=1e-3, atol=1e-3 * expected.max())
    for name in ("sent", "escaped"):
        np.testing.assert_allclose(getattr(found, name), getattr(whole, name), rtol=1e-5)
    assert found.num_steps < 0.6 * whole.num_steps


def test_no_filled_voxel_lies_outside_the_span(specks):
    origin, direction, t_max, _ = _rays(5_000)
    position, direction, t0, t1 = occupancy.to_voxels(specks.grid, origin, direction, t_max)
    near, far = occupancy.narrowed(occupancy.filled_blocks(specks), position, direction, t0, t1)
    t = t0[:, None] + (t1 - t0)[:, None] * (np.arange(400) + 0.5) / 400
    at = np.floor(position[:, None] + t[..., None] * direction[:, None]).astype(int)
    at = np.clip(at, 0, np.array(SHAPE) - 1)
    hit = _with_neighbours(specks)[tuple(np.moveaxis(at, -1, 0))] & (t1 > t0)[:, None]
    assert hit.sum() > 1000
    assert np.all((t >= near[:, None] - 1e-6) & (t <= far[:, None] + 1e-6) | ~hit)
    assert np.mean(far <= near) > 0.2  # many meet nothing at all


def test_full_grids_are_not_looked_at(specks):
    full = SimpleNamespace(scattering=jnp.ones((1, 16, 16, 16)), absorption=jnp.zeros((1, 16, 16, 16)))
    assert occupancy.filled_blocks(full) is None


def test_the_picture_is_the_same():
    """Two small clouds at opposite corners, seen with and without skipping."""
    density = np.zeros((24, 24, 24), np.float32)
    density[1:4, 1:4, 1:4] = density[20:23, 20:23, 20:23] = 20.0
    scene = box_scene(density=jnp.asarray(density))
    plan = lattice_boltzmann.plan(scene, None, **(SMALL | {"resolution": 24, "lattice": "paper", "view_step": 0.25}))
    light = lattice_boltzmann.illuminate(scene, plan)
    assert light.blocks is not None
    x, y = (a.ravel() for a in np.meshgrid((np.arange(24) + 0.5) / 24, (np.arange(24) + 0.5) / 24, indexing="ij"))
    origin = np.stack([x, y, np.full(576, -1.0)], 1)
    rays = Rays(*(jnp.asarray(v, jnp.float32) for v in (origin, np.tile([0.0, 0.0, 1.0], (576, 1)), np.full(576, np.inf))))
    skipped, walked = (lattice_boltzmann.radiance(scene, rays, plan, found) for found in (light, light._replace(blocks=None)))
    for name, image in walked.items():
        np.testing.assert_allclose(skipped[name], image, atol=0.02 * float(image.max()) + 1e-12, err_msg=name)
