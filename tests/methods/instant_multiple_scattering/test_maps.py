"""Octahedral maps: directions and texels, depth against rays, columns against marching, local visibility; moved geometry."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

from jaxvol import layers, ray_casting
from jaxvol.methods import instant_multiple_scattering as ims
from jaxvol.methods.instant_multiple_scattering import incremental, light_paths, maps, receivers
from jaxvol.methods.instant_multiple_scattering.virtual_lights import LightSet, VirtualLights
from jaxvol.types import Mesh
from tests.methods.instant_multiple_scattering.scenes import floats, lit, make_camera, make_medium

FLOOR = np.array([[-1, -0.8, -1], [1, -0.8, -1], [1, -0.8, 1], [-1, -0.8, 1]], np.float32)


def floor_and_panel(x=0.3):
    """A floor and an upright panel at x."""
    panel = np.array([[x, -0.8, -0.5], [x, -0.8, 0.5], [x, 0.2, 0.5], [x, 0.2, -0.5]], np.float32)
    faces = [[0, 2, 1], [0, 3, 2], [4, 5, 6], [4, 6, 7]]
    return Mesh(
        vertices=jnp.asarray(np.concatenate([FLOOR, panel])),
        faces=jnp.asarray(faces, jnp.int32),
        albedo=jnp.full((4, 3), 0.5),
    )


@pytest.fixture(scope="module")
def scene():
    rng = np.random.default_rng(1)
    density = 0.5 + 0.5 * rng.random((4, 4, 4))
    return lit(make_medium(density=density), position=(-0.5, 0.5, 0.2), mesh=floor_and_panel())


@pytest.fixture(scope="module")
def built(scene):
    rng = np.random.default_rng(0)
    position = jnp.asarray(rng.uniform(-0.7, 0.7, (8, 3)), jnp.float32)
    lights = LightSet(volume_first=VirtualLights(position, position, position))
    caster = ray_casting.make_caster(scene.mesh)
    return maps.build(scene, caster, lights, size=64, num_steps=16, depth=True, columns=True), caster


@pytest.mark.parametrize("size", [5, 32])
def test_every_texel_holds_its_own_direction(size):
    directions = maps.texel_directions(size)
    np.testing.assert_allclose(np.linalg.norm(directions, axis=-1), 1.0, rtol=1e-6)
    assert np.array_equal(np.asarray(maps.texel(directions, size=size)), np.arange(size * size))


def test_maps_answer_what_rays_and_marches_answer(scene, built):
    found, caster = built
    rng = np.random.default_rng(2)
    points = jnp.asarray(rng.uniform(-0.78, 0.9, (2000, 3)), jnp.float32)
    index = jnp.asarray(rng.integers(0, 8, 2000), jnp.int32)
    delta = points - found.position[index]
    length = jnp.linalg.norm(delta, axis=-1)
    free = ~np.asarray(ray_casting.occluded(caster, found.position[index], delta / length[:, None], length * 0.999))
    seen = np.asarray(maps.visible(found, index, points))
    assert 0.05 < np.mean(~free) < 0.6
    assert np.mean(seen != free) < 0.02  # texels at the panel's edge
    column = np.asarray(maps.column(found, index, points))
    exact = np.asarray(receivers.column_between(scene.medium, found.position[index], points, num_steps=64))
    assert np.sqrt(np.mean((column - exact) ** 2)) < 0.02 * exact.mean()


def test_local_visibility_finds_the_surfaces_close_by(scene, built):
    found, caster = built
    rng = np.random.default_rng(3)
    n = 2000
    index = jnp.asarray(rng.integers(0, 8, n), jnp.int32)
    origin = found.position[index] + jnp.asarray(rng.normal(0, 0.05, (n, 3)), jnp.float32)
    direction = rng.normal(size=(n, 3))
    direction = jnp.asarray(direction / np.linalg.norm(direction, axis=-1, keepdims=True), jnp.float32)
    reach = jnp.full(n, 0.6, jnp.float32)
    t, face = (np.asarray(x) for x in maps.surface_within(found, scene.mesh, index, origin, direction, reach))
    t_exact, face_exact = (np.asarray(x) for x in ray_casting.intersect(caster, origin, direction, reach))
    hits = face_exact >= 0
    assert 0.05 < np.mean(hits) < 0.9
    assert np.mean((face >= 0) != hits) < 0.05
    same = hits & (face == face_exact)
    np.testing.assert_allclose(t[same], t_exact[same], atol=1e-3)
    far = np.asarray(found.nearest)[np.asarray(index)] > 0.6 + np.linalg.norm(origin - found.position[index], axis=-1)
    assert not np.any(hits[far]) and not np.any(face[far] >= 0)  # the least depth is a safe test


@pytest.mark.slow
def test_a_picture_with_maps_resembles_one_with_rays(scene):
    camera = make_camera(8)
    options = {"num_paths": 128, "num_levels": 1, "tile": 64}
    pictures = [
        float(jnp.mean(layers.total(ims.render(scene, camera, ims.plan(scene, camera, **options, **more), seed=1).mean)))
        for more in ({"columns": "march"}, {"shadows": "maps", "visibility": "maps", "columns": "maps"})
    ]
    assert pictures[1] == pytest.approx(pictures[0], rel=0.05)
    auto = [ims.plan(scene, dataclasses.replace(camera, height=n, width=n)).columns for n in (8, 512)]
    assert auto == ["march", "maps"]


def test_only_paths_that_moved_geometry_can_touch_are_traced_again(scene):
    """Paths kept after the panel has moved are what tracing all of them again gives."""
    before = dataclasses.replace(scene, medium=None)
    after = dataclasses.replace(before, mesh=floor_and_panel(x=0.45))
    casters = [ray_casting.make_caster(s.mesh) for s in (before, after)]
    paths = np.arange(256)
    old, _ = light_paths.trace(before, casters[0], seed=5, paths=paths, max_depth=8)
    new, _ = light_paths.trace(after, casters[1], seed=5, paths=paths, max_depth=8)
    moved = np.array([False, False, True, True])
    touched = incremental.touched_paths(after, casters[1], old, paths, moved, seed=5)
    assert 0 < len(touched) < 128
    fresh, _ = light_paths.trace(after, casters[1], seed=5, paths=touched, max_depth=8)
    joined = incremental.replaced(old, fresh, touched)
    assert np.array_equal(joined.path, new.path) and np.array_equal(joined.depth, new.depth)
    np.testing.assert_allclose(joined.position, new.position, atol=1e-4)
    np.testing.assert_allclose(joined.incident, new.incident, rtol=1e-3)


def test_the_gradient_detector_tells_even_from_uneven():
    from jaxvol.methods.instant_multiple_scattering import compensation

    ramp = np.ones((8, 8, 8), np.float32)
    ramp[4:] = np.linspace(1, 9, 4)[:, None, None]
    medium = make_medium(density=ramp)
    points = floats([-0.8, 0.1, 0.0], [0.7, 0.1, 0.0])
    mip = jnp.asarray(compensation.coarse_density(medium.density, block=1))
    assert np.asarray(compensation.is_even(medium, mip, points, floats(0.1, 0.1))).tolist() == [True, False]
