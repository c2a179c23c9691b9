"""Occupancy grids against exact boxes, volumes of meshes, and containment tests in float64."""

import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from scipy import ndimage

from jaxvol.types import Mesh
from jaxvol.voxelization import _in_turn, open_edges, surface_voxels, voxelize


def to_mesh(shape):
    return Mesh(
        vertices=jnp.asarray(shape.vertices, jnp.float32),
        faces=jnp.asarray(shape.faces, jnp.int32),
        albedo=jnp.zeros((len(shape.faces), 3), jnp.float32),
    )


def padded_bounds(shape):
    margin = 0.05 * shape.extents
    return shape.bounds + [-margin, margin]


def volume_error(shape, resolution, supersampling):
    shape = trimesh.Trimesh(np.asarray(shape.vertices, np.float32), shape.faces, process=False)
    bounds = padded_bounds(shape)
    occupancy = voxelize(to_mesh(shape), bounds, (resolution,) * 3, supersampling=supersampling)
    assert occupancy.dtype == np.float32 and occupancy.min() == 0.0 and occupancy.max() == 1.0
    return occupancy.sum(dtype=np.float64) * np.prod((bounds[1] - bounds[0]) / resolution) / shape.volume - 1.0


def test_a_box_covers_its_voxels_exactly():
    box = trimesh.creation.box(bounds=[[0.25, 0.5, 0.3], [1.75, 2.0, 1.9]])
    occupancy = voxelize(to_mesh(box), [[0, 0, 0], [3, 2, 2]], (6, 4, 4), supersampling=2)
    x = np.array([0.5, 1, 1, 0.5, 0, 0])
    y = np.array([0, 1, 1, 1])
    z = np.array([0.4, 1, 1, 0.8])
    np.testing.assert_allclose(occupancy, x[:, None, None] * y[:, None] * z, atol=1e-6)


def test_a_grid_inside_the_mesh_is_full_and_one_beside_it_empty():
    mesh = to_mesh(trimesh.creation.icosphere(subdivisions=2))
    assert np.all(voxelize(mesh, [[-0.4] * 3, [0.4] * 3], (5, 6, 7)) == 1.0)
    assert np.all(voxelize(mesh, [[2.0] * 3, [3.0] * 3], (4, 4, 4)) == 0.0)
    assert np.all(voxelize(mesh, [[-0.1, -0.1, 2], [0.1, 0.1, 3]], (4, 4, 4)) == 0.0)


def test_voxels_hold_the_fraction_of_their_points_inside():
    ball = trimesh.creation.icosphere(subdivisions=2)  # its vertices and edges lie on grid lines
    n, s = 10, 8
    occupancy = voxelize(to_mesh(ball), [[-1.1, -1.1, -1.1], [1.1, 1.1, 1.1]], (n, n, n), supersampling=s)
    points = (np.stack(np.meshgrid(*[np.arange(n * s) + 0.5] * 3, indexing="ij"), -1) / (n * s) - 0.5) * 2.2
    inside = np.ones((n * s,) * 3, bool)
    for normal, corner in zip(ball.face_normals, ball.triangles[:, 0], strict=True):
        inside &= points @ normal < corner @ normal
    expected = inside.reshape(n, s, n, s, n, s).mean((1, 3, 5))
    # Same columns; along z the expected value is counted in steps of 1/s, half a step of error per end and column.
    assert np.max(np.abs(occupancy - expected)) < 1.0 / s
    assert np.abs(occupancy - expected).mean() < 0.003
    assert np.all(occupancy[expected == 1] > 0.9) and np.count_nonzero(expected == 1) > 100


@pytest.mark.parametrize("resolution, supersampling", ((64, 4), (128, 2), (128, 4)))
def test_volume_of_a_sphere(resolution, supersampling):
    assert abs(volume_error(trimesh.creation.icosphere(subdivisions=4), resolution, supersampling)) < 1e-4


@pytest.mark.parametrize("name, supersampling", (("stanford_bunny_16k_closed", 2), ("spot", 2), ("spot", 4)))
def test_volume_of_real_meshes(name, supersampling, shared_data):
    shape = trimesh.load(shared_data / f"meshes/{name}.ply", process=False)
    assert abs(volume_error(shape, 128, supersampling)) < 1e-4


def test_shapes_with_holes_cavities_and_inside_out():
    torus = trimesh.creation.torus(major_radius=1.0, minor_radius=0.4)
    assert abs(volume_error(torus, 48, 6)) < 1e-3
    bounds = padded_bounds(torus)
    grid = voxelize(to_mesh(torus), bounds, (24, 24, 12))
    turned = trimesh.Trimesh(torus.vertices, torus.faces[:, ::-1], process=False)
    np.testing.assert_array_equal(voxelize(to_mesh(turned), bounds, (24, 24, 12)), grid)
    cavity = trimesh.creation.box(extents=[1, 1, 1])
    hollow = trimesh.util.concatenate([trimesh.creation.box(extents=[2, 2, 2]), cavity.copy()])
    hollow.faces[12:] = hollow.faces[12:, ::-1]
    occupancy = voxelize(to_mesh(hollow), [[-1] * 3, [1] * 3], (8, 8, 8))
    expected = np.ones((8, 8, 8))
    expected[2:6, 2:6, 2:6] = 0.0
    np.testing.assert_allclose(occupancy, expected, atol=1e-6)


def test_bodies_that_overlap_or_touch_count_once():
    low = trimesh.creation.box(bounds=[[0, 0, 0], [1, 1, 0.7]])
    for start in (0.7, 0.4):
        high = trimesh.creation.box(bounds=[[0, 0, start], [1, 1, 1]])
        occupancy = voxelize(to_mesh(trimesh.util.concatenate([low, high])), [[0] * 3, [1, 1, 2]], (2, 2, 8))
        np.testing.assert_allclose(occupancy, np.broadcast_to([1, 1, 1, 1, 0, 0, 0, 0], (2, 2, 8)), atol=1e-6)


def test_columns_that_do_not_add_up_are_repaired():
    column = np.array([0, 0, 0, 1, 1, 2, 2, 2, 2])
    z = np.array([1.0, 2.0, 1.5, 0.0, 5.0, 1.0, 4.0, 2.0, 3.0])
    side = np.array([1, -1, 1, 1, -1, 1, -1, 1, -1])
    got = _in_turn(column, z, side)
    assert [x.tolist() for x in got] == [[0, 0, 1, 1, 2, 2], [1.5, 2.0, 0.0, 5.0, 1.0, 4.0], [1, -1, 1, -1, 1, -1]]


def test_open_meshes_are_refused_with_the_number_of_open_edges():
    box = trimesh.creation.box()
    assert open_edges(to_mesh(box)) == 0
    unwelded = trimesh.Trimesh(box.triangles.reshape(-1, 3), np.arange(36).reshape(-1, 3), process=False)
    assert open_edges(to_mesh(unwelded)) == 0
    missing = trimesh.Trimesh(box.vertices, box.faces[1:], process=False)
    assert open_edges(to_mesh(missing)) == 3
    flipped = trimesh.Trimesh(box.vertices, np.concatenate([box.faces[:1, ::-1], box.faces[1:]]), process=False)
    assert open_edges(to_mesh(flipped)) == 3
    with pytest.raises(ValueError, match="must be watertight to be voxelised, has 3 open edges"):
        voxelize(to_mesh(missing), [[-1] * 3, [1] * 3], (4, 4, 4))


def test_bad_grids_are_refused():
    mesh = to_mesh(trimesh.creation.box())
    with pytest.raises(ValueError, match="bounds: "):
        voxelize(mesh, [[0, 0, 0], [1, 0, 1]], (4, 4, 4))
    with pytest.raises(ValueError, match="resolution: "):
        voxelize(mesh, [[0, 0, 0], [1, 1, 1]], (4, 0, 4))
    with pytest.raises(ValueError, match="supersampling: 0"):
        voxelize(mesh, [[0, 0, 0], [1, 1, 1]], (4, 4, 4), supersampling=0)


def test_pairs_are_worked_off_in_parts(monkeypatch):
    torus = trimesh.creation.torus(major_radius=1.0, minor_radius=0.4)
    whole = voxelize(to_mesh(torus), padded_bounds(torus), (16, 16, 8))
    monkeypatch.setattr("jaxvol.voxelization._MOST_PAIRS", 100)
    np.testing.assert_allclose(voxelize(to_mesh(torus), padded_bounds(torus), (16, 16, 8)), whole, atol=1e-6)


def test_surface_voxels_close_a_sphere_and_carry_its_albedo():
    ball = trimesh.creation.icosphere(subdivisions=2, radius=0.8)
    albedo = np.where(ball.triangles_center[:, :1] > 0, 0.8, 0.2) * np.ones(3)
    mesh = Mesh(jnp.asarray(ball.vertices, jnp.float32), jnp.asarray(ball.faces), jnp.asarray(albedo, jnp.float32))
    held, colour = surface_voxels(mesh, [[-1, -1, -1], [1, 1, 1]], (20, 20, 20))
    components, _ = ndimage.label(~held)  # faces join voxels, so that outside and inside must be apart
    assert components[0, 0, 0] != components[10, 10, 10] and components.max() == 2
    assert np.allclose(colour[held][:, 0].max(), 0.8) and np.allclose(colour[:9][held[:9]], 0.2)
    assert not surface_voxels(mesh, [[2, 2, 2], [3, 3, 3]], (4, 4, 4))[0].any()
