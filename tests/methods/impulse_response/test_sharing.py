"""Irradiance cached at vertices and shared between receivers, against closed forms and against walking on."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

from jaxvol import ray_casting
from jaxvol.layers import SURFACE
from jaxvol.methods import impulse_response
from jaxvol.methods.impulse_response import baking, cache, final_gather, gather, lightmap, radiosity, sharing
from jaxvol.methods.impulse_response.kit import Tally
from jaxvol.methods.impulse_response.receivers import Irradiance
from jaxvol.scene import make_scene
from jaxvol.types import Mesh

WORTH_IT = 10**9  # paths: enough for a cache


def box(medium=None, albedo=0.5, lights=()):
    """A closed box seen from inside: edges of 2 about the origin."""
    shape = {"mesh": "builtin:box", "reflectance": [albedo] * 3}
    return make_scene({"shapes": [shape], "lights": list(lights)} | ({} if medium is None else {"medium": medium})).scene


def inside(scene, resolution=32):
    """Texels of the inside."""
    mesh = scene.mesh
    turned = Mesh(mesh.vertices, mesh.faces[:, ::-1], mesh.albedo)
    what = lightmap.unwrap(turned, resolution=resolution)
    return what.receiver, what.normal


def test_uniform_light_in_a_closed_box_stays_uniform():
    """Walls of radiance 1 around a medium that only scatters: irradiance pi, whatever is scattered on the way."""
    scene = box({"bounds": [[-1, -1, -1], [1, 1, 1]], "scattering": 1.5, "absorption": 0.0, "anisotropy": 0.4})
    points, normals = inside(scene)
    plan = impulse_response.plan(scene, None)
    kit = dataclasses.replace(impulse_response.prepare(scene, plan), shares=(1.0, 0.0, 0.0))
    known = cache.unlit(points, normals, kit.caster)
    radiosity_of_walls = jnp.full(known.straight.shape, np.pi / 0.5)
    kit = dataclasses.replace(kit, cache=dataclasses.replace(known, straight=radiosity_of_walls))
    assert kit.walks_surfaces
    item = np.arange(1 << 14) % len(points)
    where, receiver = jnp.asarray(points[item]), Irradiance(jnp.asarray(normals[item]))
    numbers = (jnp.asarray(item, jnp.int32), jnp.arange(1 << 14, dtype=jnp.int32), jnp.uint32(3))
    first, several = final_gather.bounced(kit, receiver, where, *numbers, Tally())
    total = np.asarray(first + several)[:, 0]
    error = total.std() / np.sqrt(total.size)
    assert error < 0.01 * np.pi and 0 < np.asarray(several).mean() < np.pi
    assert abs(total.mean() - np.pi) < 4 * error


# Mean irradiance of the box's texels by path tracing, 512 paths a texel: total, and its standard error.
TRACED = {"clear": (1.70988, 0.0006), "fog": (1.14977, 0.0013)}


@pytest.mark.parametrize("inside_of", list(TRACED))
def test_cached_light_against_path_tracing(inside_of):
    lamp = {"kind": "point", "position": [0.2, 0.1, 0.3], "intensity": 1.0}
    fog = {"bounds": [[-1, -1, -1], [1, 1, 1]], "scattering": 0.4, "absorption": 0.1}
    scene = box(fog if inside_of == "fog" else None, 0.7, [lamp])
    points, normals = inside(scene)
    plan = impulse_response.plan(scene, None, max_bounces=16)
    kit = impulse_response.prepare(scene, plan)
    assert radiosity.cached(kit, points, normals, plan, num_paths=1, seed=0) is kit
    kit = radiosity.cached(kit, points, normals, plan, num_paths=WORTH_IT, seed=0)
    item = np.arange(1 << 14) % len(points)
    where, receiver = jnp.asarray(points[item]), Irradiance(jnp.asarray(normals[item]))
    numbers = (jnp.asarray(item, jnp.int32), jnp.arange(1 << 14, dtype=jnp.int32) // len(points), jnp.uint32(1))
    layers = gather.path_arrivals(kit, receiver, where, *numbers, Tally())
    found = sum(np.asarray(layers[name]).mean(axis=-1) for name in SURFACE)
    found = found + np.asarray(sum(gather.delta_arrivals(kit, receiver, where, Tally())[:3])).mean(axis=-1)
    truth, noise = TRACED[inside_of]
    error = np.hypot(found.std() / np.sqrt(found.size), noise)
    assert error < 0.01 * truth
    assert abs(found.mean() - truth) < 3 * error + 0.005 * truth  # what is constant around a cached point


def floor(width=3.0):
    """A floor of 2 width by 2 width texels' places, facing up."""
    x = np.linspace(-width, width, 40)
    points = np.stack([*np.meshgrid(x, x, indexing="ij"), np.zeros((40, 40))], axis=-1).reshape(-1, 3)
    return points, np.tile([0.0, 0, 1], (1600, 1))


def wall(points, normals):
    """A caster of the floor and of a wall upon it along x = 0, far higher and longer than the floor."""
    corners = [[-9, -9, 0], [9, -9, 0], [9, 9, 0], [-9, 9, 0], [0, -9, 0], [0, 9, 0], [0, 9, 9], [0, -9, 9]]
    faces = [[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]]
    return ray_casting.make_caster(Mesh(jnp.asarray(corners, jnp.float32), jnp.asarray(faces), jnp.ones((4, 3))), kind="auto")


def test_sharing_keeps_linear_light_and_few_receivers():
    points, normals = floor()
    shared = sharing.choose(points, normals, share=16, caster=None)
    assert 50 <= len(shared.rows) <= 150
    linear = 2 + 0.3 * points[:, :1] - 0.2 * points[:, 1:2]
    found = shared.spread(linear[shared.rows])
    inner = np.abs(points[:, :2]).max(axis=1) < 2
    np.testing.assert_allclose(found[inner], linear[inner], rtol=0.02)
    np.testing.assert_allclose(shared.weights.sum(axis=1), 1, atol=0.2)
    assert np.mean(np.sum(shared.weights**2, axis=1)) < 0.35  # noise of several receivers averages out


def test_sharing_and_the_cache_keep_light_behind_walls():
    points, normals = floor()
    caster = wall(points, normals)
    lit = (points[:, :1] > 0).astype(float)
    shared = sharing.choose(points, normals, share=16, caster=caster)
    np.testing.assert_allclose(shared.spread(lit[shared.rows]) > 0.5, lit > 0.5)
    np.testing.assert_allclose(shared.spread(lit[shared.rows])[lit[:, 0] == 0], 0)
    rng = np.random.default_rng(0)
    some = rng.choice(len(points), 300, replace=False)
    known = cache.unlit(points[some], normals[some], caster)
    index = cache.nearest(known, points, normals)
    beyond = np.append(np.sign(points[some, 0]), 0)[index] == -np.sign(points[:, 0])
    assert not beyond.any()
    assert np.mean(index == len(some)) < 0.05  # few are left in the dark


def test_shared_bake_adds_up():
    """Layers, variance and harmonics of a shared bake near those of a full one; light from emitters the same."""
    lamp = {"kind": "point", "position": [0.0, 0.0, 0.4], "intensity": 1.0}
    scene = box(None, 0.5, [lamp])
    points, normals = inside(scene, 48)
    plan = impulse_response.plan(scene, None, harmonics=True, max_bounces=2)
    kit = impulse_response.prepare(scene, plan)
    with pytest.raises(ValueError, match="share: 0 is not allowed"):
        baking.bake(kit, plan, points, normals, name="none", samples=1, share=0)
    full = baking.bake(kit, plan, points, normals, name="full", samples=32)
    shared = baking.bake(kit, plan, points, normals, name="shared", samples=32, share=8)
    np.testing.assert_array_equal(full.irradiance["surface_from_light"], shared.irradiance["surface_from_light"])
    for layer in ("surface_from_surface", "surface_from_multiple"):
        assert shared.irradiance[layer].mean() == pytest.approx(full.irradiance[layer].mean(), rel=0.05)
    assert shared.variance.shape == full.variance.shape and shared.variance.mean() < full.variance.mean()
    up = normals[:, 2] > 0.9  # the mean over one wall: single texels are noise
    np.testing.assert_allclose(shared.harmonics[up].mean(axis=0), full.harmonics[up].mean(axis=0), atol=0.02)
    assert full.harmonics[up, 0].mean() > 0.2
    assert np.all(np.isfinite(shared.variance))
