"""Direct light through the sky's field, guided directions, and media bounded by meshes."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
import trimesh

from jaxvol import camera as cameras
from jaxvol import direct, image, lights, media
from jaxvol.direct import sky_sampling
from jaxvol.types import Camera, Medium, Mesh, PointLights, Scene
from tests.test_direct import fog, henyey_greenstein, lamp_at


def f32(x):
    return jnp.asarray(x, jnp.float32)


def looking(origin, target, *, fov=0.5, size=1):
    return Camera(cameras.look_at(origin, target, (0, 1, 0)), f32(fov), height=size, width=size)


def puff(size=16):
    """A soft ball of density, off-centre, with a bump on it."""
    x, y, z = np.meshgrid(*(3 * [(np.arange(size) + 0.5) / size * 2 - 1]), indexing="ij")
    ball = np.clip(1.2 - 2.0 * np.sqrt((x - 0.1) ** 2 + y**2 + (z + 0.05) ** 2), 0, 1)
    return (ball * (1.0 + 0.4 * np.sin(5 * x) * np.cos(4 * y))).astype(np.float32)


def gradient_sky():
    rows = np.linspace(2.0, 0.2, 8)[:, None, None] * np.ones((8, 16, 3)) * np.array([0.5, 0.8, 1.2])
    rows[2, 5] += 6.0
    return lights.environment_light(rows)


@pytest.mark.parametrize("g", [0.0, 0.7])
def test_a_uniform_sky_over_a_grid_of_constant_density(g):
    """The field against float64 quadrature of single scattering in a cube, seen along one ray."""
    sigma = 0.7
    medium = fog((sigma,) * 3, g=g, half=1.0, density=np.ones((12, 12, 12), np.float32))
    scene = Scene(medium=medium, environment=lights.environment_light([1.0, 1.0, 1.0]))
    camera = looking((-3, 0.2, 0), (0, 0.2, 0), fov=1e-3)
    plan = direct.plan(scene, camera)
    assert plan.num_sky_directions > 0
    found = direct.render(scene, camera, plan).mean.volume_from_light[0, 0]
    node, weight = np.polynomial.legendre.leggauss(64)
    phi = (np.arange(64) + 0.5) * 2 * np.pi / 64
    total = 0.0
    for x, wx in zip(node, weight, strict=True):
        c, p = np.meshgrid(node, phi, indexing="ij")
        s = np.sqrt(1 - c * c)
        way = np.stack([c, s * np.cos(p), s * np.sin(p)], -1)
        exits = np.min((np.sign(way) - [x, 0.2, 0.0]) / np.where(np.abs(way) < 1e-9, 1e-9, way), axis=-1)
        inner = np.sum(weight[:, None] * henyey_greenstein(c, g) * np.exp(-sigma * exits)) * 2 * np.pi / 64
        total += wx * sigma * np.exp(-sigma * (x + 1)) * inner
    np.testing.assert_allclose(found, total, rtol=0.01)


@pytest.mark.slow
def test_the_field_is_what_marching_finds():
    """A puff of three colours under a sky with a bright spot, a floor below: field and plain march, 1 %."""
    medium = fog((4.0, 6.0, 2.0), (0.5, 0.0, 1.0), g=0.5, half=1.0, density=puff())
    corners = f32([[-9, -1.2, -9], [-9, -1.2, 9], [9, -1.2, 9], [9, -1.2, -9]])
    floor = Mesh(corners, jnp.asarray([[0, 1, 2], [0, 2, 3]]), f32([[0.5] * 3] * 2))
    scene = Scene(mesh=floor, medium=medium, environment=gradient_sky())
    camera = looking((0.5, 0.6, 4), (0, 0, 0), fov=0.5, size=5)
    fine = {"num_environment_steps": 96, "num_light_steps": 48, "num_cells": 64}
    swept = direct.plan(scene, camera, num_sky_directions=512, num_cells=64)
    marched = direct.plan(scene, camera, num_sky_directions=0, **fine)
    a, b = (np.asarray(direct.render(scene, camera, plan).mean.volume_from_light) for plan in (swept, marched))
    assert b.max() > 0.1
    assert image.relative_l1(a, b) < 0.01


def test_when_light_from_the_sky_is_marched():
    """No field with the eye or a surface in the box, voxels too thick, a phase function too peaked, or no camera."""
    sky = lights.environment_light([1.0, 1.0, 1.0])
    camera = looking((0, 0, 4), (0, 0, 0))
    medium = fog((2.0,) * 3, half=1.0, density=puff())
    assert direct.plan(Scene(medium=medium, environment=sky), camera).num_sky_directions > 0
    box = trimesh.creation.box(extents=[0.2] * 3)
    inside = Mesh(f32(box.vertices), jnp.asarray(box.faces, jnp.int32), f32(np.full((12, 3), 0.5)))
    for scene, view in (
        (Scene(medium=medium, environment=sky), looking((0.5, 0, 0), (0, 0, 0))),
        (Scene(medium=medium, environment=sky), None),
        (Scene(medium=medium, environment=sky, mesh=inside), camera),
        (Scene(medium=dataclasses.replace(medium, g=f32(0.9)), environment=sky), camera),
        (Scene(medium=fog((40.0,) * 3, half=1.0, density=puff()), environment=sky), camera),
        (Scene(medium=medium, point_lights=lamp_at((0, 2, 0))), camera),
    ):
        assert direct.plan(scene, view).num_sky_directions == 0


def test_guided_directions_follow_their_density():
    """The table's density integrates to one, and means over samples are those under it."""
    sky = gradient_sky()
    eye = f32([[0, 0, -1], [0.1, 0, -1]])
    medium = fog(g=0.6)
    table = sky_sampling.guided(sky, lambda w: sky_sampling.phase_weight((medium,), eye, w))
    way = sky_sampling.map_directions(sky, 256, 512)
    solid = np.sin((np.arange(256) + 0.5) * np.pi / 256)[:, None] * (np.pi / 256) * (2 * np.pi / 512)
    pdf = np.asarray(lights.sample_environment_pdf(table, jnp.asarray(way)))
    np.testing.assert_allclose(np.sum(pdf * solid), 1.0, rtol=2e-3)
    assert pdf.min() > 0
    u1, u2 = np.random.default_rng(0).uniform(size=(2, 100_000)).astype(np.float32)
    drawn, own = lights.sample_environment(table, u1, u2)
    np.testing.assert_allclose(own, lights.sample_environment_pdf(table, drawn), rtol=2e-2)
    expected = np.sum((pdf * solid)[..., None] * way, axis=(0, 1))
    np.testing.assert_allclose(np.mean(np.asarray(drawn), axis=0), expected, atol=0.01)  # about 5 standard errors


@pytest.mark.slow
def test_a_medium_in_a_box_mesh_is_the_medium_in_its_box():
    """The same box as `boundary` and as bounds, under a point light behind it and a sky, over a floor."""
    box = trimesh.creation.box(extents=[2, 2, 2])
    shape = Mesh(f32(box.vertices), jnp.asarray(box.faces, jnp.int32), f32(np.zeros((12, 3))))
    corners = f32([[-9, -1.2, -9], [-9, -1.2, 9], [9, -1.2, 9], [9, -1.2, -9]])
    floor = Mesh(corners, jnp.asarray([[0, 1, 2], [0, 2, 3]]), f32([[0.5] * 3] * 2))
    plain = fog((0.8, 0.5, 0.3), (0.1, 0.2, 0.0), g=0.3, half=1.0)
    found = []
    for medium in (plain, dataclasses.replace(plain, boundary=shape, bounds=f32([[-1.01] * 3, [1.01] * 3]))):
        scene = Scene(mesh=floor, medium=medium, point_lights=lamp_at((1.0, 1.6, -1.5)), environment=gradient_sky())
        camera = looking((0.3, 0.8, 4.5), (0, -0.2, 0), fov=0.8, size=6)
        plan = direct.plan(scene, camera, num_environment_steps=64, num_cells=32)
        found.append(direct.render(scene, camera, plan).mean)
    for name in ("emission", "surface_from_light", "volume_from_light"):
        a, b = (np.asarray(getattr(x, name)) for x in found)
        assert b.max() > 0.01, name
        assert image.relative_l1(b, a) < 0.01, name


def test_light_of_a_grid_is_in_the_pixels_where_the_path_tracer_has_it():
    """A puff and a point light: blocks of 4 x 4 pixels, mean error below 1 % beyond the reference's own noise."""
    from jaxvol.methods import path_tracing

    density = puff()
    medium = Medium(
        bounds=f32([[-1, -1, -1], [1, 1, 1]]), sigma_s=f32([2.0] * 3), sigma_a=f32([0.5] * 3), g=f32(0.3),
        density=f32(density), majorants=media.majorants(density),
    )  # fmt: skip
    scene = Scene(medium=medium, point_lights=PointLights(f32([[1.5, 1.5, 0.5]]), f32([[3.0] * 3])))
    camera = looking((0, 0.2, 5), (0.6, 0, 0), fov=0.7, size=12)
    mine = np.asarray(direct.render(scene, camera, direct.plan(scene, camera)).mean.volume_from_light, np.float64)
    plan = path_tracing.plan(scene, camera, max_scatterings=1, num_lanes=4096)
    theirs = path_tracing.render(scene, camera, plan, seed=2, samples=2048)
    mean, variance = (np.asarray(x.volume_from_light, np.float64) for x in (theirs.mean, theirs.variance))
    noise = image.reference_noise(mean, variance, block=4)
    assert noise < 0.02
    assert image.relative_l1(mine, mean, block=4) < 0.01 + noise
    blocks = mean.reshape(3, 4, 3, 4, 3).mean(axis=(1, 3))
    error = np.sqrt(variance.reshape(3, 4, 3, 4, 3).mean(axis=(1, 3)) / 16) + 0.005 * blocks.max()
    z = (mine.reshape(3, 4, 3, 4, 3).mean(axis=(1, 3)) - blocks) / error
    assert np.abs(z).max() < 3.6  # 27 values, Sidak at 1 %
    assert abs(image.bias(mine, mean)) < 0.01
