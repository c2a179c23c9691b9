"""Direct light against closed forms, float64 quadrature and the path tracer."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxvol import camera as cameras
from jaxvol import direct, lights, media
from jaxvol.types import (
    Camera,
    DirectionalLights,
    Medium,
    Mesh,
    PhaseTable,
    PointLights,
    Rays,
    Scene,
    SpotLights,
)
from tests import problems

FEW = {"samples_per_pixel": 4, "volume_samples_per_pixel": 4}


def f32(x):
    return jnp.asarray(x, jnp.float32)


def fog(sigma_s=(1.0, 1.0, 1.0), sigma_a=(0.0, 0.0, 0.0), g=0.0, half=200.0, density=None):
    return Medium(
        bounds=f32([[-half] * 3, [half] * 3]),
        sigma_s=f32(sigma_s),
        sigma_a=f32(sigma_a),
        g=f32(g),
        density=None if density is None else f32(density),
        majorants=None if density is None else media.majorants(density),
    )


def ray(origin, direction, t_max=np.inf):
    direction = np.asarray(direction, np.float64)
    return Rays(f32([origin]), f32([direction / np.linalg.norm(direction)]), f32([t_max]))


def lamp_at(position, intensity=(1.0, 1.0, 1.0)):
    return PointLights(f32([position]), f32([intensity]))


def quad(corner, u, v, **material):
    """A parallelogram whose front is the side of cross(u, v)."""
    corner, u, v = (np.asarray(x, np.float64) for x in (corner, u, v))
    vertices = f32([corner, corner + u, corner + u + v, corner + v])
    material = {k: f32([x, x]) for k, x in material.items()}
    return Mesh(vertices, jnp.asarray([[0, 1, 2], [0, 2, 3]]), **({"albedo": jnp.zeros((2, 3))} | material))


def merge(*meshes):
    offsets = np.cumsum([0] + [m.vertices.shape[0] for m in meshes[:-1]])
    emission = [jnp.zeros((m.faces.shape[0], 3)) if m.emission is None else m.emission for m in meshes]
    return Mesh(
        jnp.concatenate([m.vertices for m in meshes]),
        jnp.concatenate([m.faces + int(o) for m, o in zip(meshes, offsets, strict=True)]),
        jnp.concatenate([m.albedo for m in meshes]),
        emission=jnp.concatenate(emission),
    )


FLOOR = quad([-50, 0, -50], [0, 0, 100], [100, 0, 0], albedo=(0.8, 0.5, 0.2))  # y = 0, facing up


@pytest.mark.parametrize("case", problems.AIRLIGHT)
def test_airlight(case):
    """T7: a point light beside a ray in an infinite medium."""
    light = (case.distance * np.cos(case.angle), case.distance * np.sin(case.angle), 0.0)
    scene = Scene(medium=fog(sigma_s=(case.sigma_t,) * 3), point_lights=lamp_at(light))
    rays = ray([0, 0, 0], [1, 0, 0], np.inf if case.length is None else case.length)
    expected = case.integral * case.sigma_t / (4 * np.pi)
    for sizes, tolerance in (({}, 3e-3), ({"num_steps": 64, "num_cells": 64}, 3e-4)):
        found = direct.radiance(scene, rays, direct.plan(scene, None, **sizes)).volume_from_light
        np.testing.assert_allclose(found, expected, rtol=tolerance)


def test_airlight_without_extinction():
    """T7 with almost no medium: (pi - angle) / (D sin angle)."""
    sigma, angle = 1e-7, 0.7
    scene = Scene(medium=fog(sigma_s=(sigma,) * 3, half=3e4), point_lights=lamp_at((2 * np.cos(angle), 2 * np.sin(angle), 0)))
    found = direct.radiance(scene, ray([0, 0, 0], [1, 0, 0]), direct.plan(scene, None, num_steps=32)).volume_from_light
    expected = problems.airlight_without_extinction(2.0, angle) * sigma / (4 * np.pi)
    np.testing.assert_allclose(found, expected, rtol=3e-3)


def henyey_greenstein(cosine, g):
    return (1 - g * g) / (4 * np.pi * (1 + g * g - 2 * g * cosine) ** 1.5)


def test_single_scattering_of_a_point_light_per_channel_and_on_a_constant_grid():
    """T12: channels 100:1 apart, albedo 0 in one, g = .6; box, grid and float64 quadrature agree."""
    sigma_s, sigma_a, g = np.array([0.03, 1.0, 0.0]), np.array([0.0, 2.0, 1.0]), 0.6
    light, origin = np.array([0.3, 0.4, -0.2]), np.array([-2.0, 0.1, 0.0])
    t = np.linspace(1.0, 3.0, 200_001)
    t = 0.5 * (t[1:] + t[:-1])
    points = origin + t[:, None] * np.array([1.0, 0.0, 0.0])
    delta = light - points
    distance = np.linalg.norm(delta, axis=1)
    phase = henyey_greenstein(delta[:, 0] / distance, g)
    depth = (t - 1.0 + distance)[:, None] * (sigma_s + sigma_a)
    expected = np.sum((phase / distance**2)[:, None] * np.exp(-depth), axis=0) * (t[1] - t[0]) * sigma_s
    for density in (None, np.ones((6, 5, 4), np.float32)):
        scene = Scene(medium=fog(sigma_s, sigma_a, g, half=1.0, density=density), point_lights=lamp_at(light))
        plan = direct.plan(scene, None, num_cells=64, num_steps=32)
        found = direct.radiance(scene, ray(origin, [1, 0, 0]), plan).volume_from_light
        np.testing.assert_allclose(found[0], expected, rtol=1.5e-3)
        assert found[0, 2] == 0.0


def test_directional_light_through_a_grid():
    """A grid that varies along the eye ray, light across it: the density seen by both is known in closed form."""
    rng = np.random.default_rng(0)
    profile = rng.uniform(0.2, 2.0, 12).astype(np.float32)
    density = np.broadcast_to(profile[:, None, None], (12, 3, 4))
    scene = Scene(
        medium=fog((0.8, 1.5, 0.1), (0.1, 0.0, 1.0), half=1.0, density=density),
        directional_lights=DirectionalLights(f32([[0, -1, 0]]), f32([[2.0, 1.0, 3.0]])),
    )
    x = np.linspace(-1, 1, 20_001)
    x = 0.5 * (x[1:] + x[:-1])
    rho = np.interp((x + 1) * 6 - 0.5, np.arange(12), profile)
    sigma_s, sigma_t = np.array([0.8, 1.5, 0.1]), np.array([0.9, 1.5, 1.1])
    column = np.cumsum(rho) * (x[1] - x[0]) - 0.5 * rho * (x[1] - x[0])
    depth = (column + rho * (1.0 - 0.25))[:, None] * sigma_t  # the light has come from y = 1 to y = 0.25
    expected = np.sum(rho[:, None] * np.exp(-depth), axis=0) * (x[1] - x[0]) * sigma_s / (4 * np.pi) * np.array([2.0, 1.0, 3.0])
    found = direct.radiance(scene, ray([-3, 0.25, 0.1], [1, 0, 0]), direct.plan(scene, None, num_cells=48)).volume_from_light
    np.testing.assert_allclose(found[0], expected, rtol=5e-3)


def test_spot_light_in_fog_counts_its_cone_alone():
    cutoff, falloff, sigma = 0.15, 0.05, 0.4
    spots = SpotLights(f32([[0, 2, 0]]), f32([[0, -1, 0]]), f32([[1, 1, 1]]), f32([cutoff]), f32([falloff]))
    scene = Scene(medium=fog((sigma,) * 3), spot_lights=spots)
    found = direct.radiance(scene, ray([-3, 0, 0.02], [1, 0, 0]), direct.plan(scene, None)).volume_from_light
    t = np.linspace(2.0, 4.0, 400_001)
    points = np.stack([t - 3.0, 0 * t, 0.02 + 0 * t], axis=1)
    distance = np.linalg.norm(points - [0, 2, 0], axis=1)
    ramp = np.clip((cutoff - np.arccos(2.0 / distance)) / (cutoff - falloff), 0, 1)
    value = ramp / distance**2 * np.exp(-sigma * (t + distance))
    np.testing.assert_allclose(found, np.sum(value) * (t[1] - t[0]) * sigma / (4 * np.pi), rtol=5e-3)
    away = direct.radiance(scene, ray([-3, 3, 0], [1, 0, 0]), direct.plan(scene, None)).volume_from_light
    np.testing.assert_array_equal(away, 0.0)


def test_an_area_light_in_fog_and_on_a_floor():
    """A lamp 1 x 1 at y = 2 facing down: float64 quadrature over the lamp and the ray."""
    lamp = quad([-0.5, 2, -0.5], [1, 0, 0], [0, 0, 1], emission=(5.0, 3.0, 1.0))
    mesh = merge(FLOOR, lamp)
    sigma, g = 0.3, 0.5
    scene = Scene(mesh=mesh, medium=fog((sigma,) * 3, g=g), area_lights=lights.area_lights(mesh))
    origin, target = np.array([-3.0, 1.9, 0.2]), np.array([0.7, 0.0, 0.3])
    length = np.linalg.norm(target - origin)
    way = (target - origin) / length
    layers = direct.radiance(scene, ray(origin, way), direct.plan(scene, None))
    node, weight = np.polynomial.legendre.leggauss(24)
    u, v = np.meshgrid(node / 2, node / 2)
    lamp_points = np.stack([u, 0 * u + 2.0, v], axis=-1).reshape(-1, 3)
    area = np.outer(weight, weight).reshape(-1) / 4

    def towards(points):
        delta = lamp_points[None] - points[:, None]
        distance = np.linalg.norm(delta, axis=-1)
        return delta / distance[..., None], distance

    w, d = towards(target[None])
    irradiance = np.sum(area * w[0, :, 1] ** 2 / d[0] ** 2 * np.exp(-sigma * d[0]))
    expected = np.array([0.8, 0.5, 0.2]) / np.pi * irradiance * np.exp(-sigma * length) * np.array([5, 3, 1])
    np.testing.assert_allclose(layers.surface_from_light[0], expected, rtol=6e-3)
    t = (np.arange(1000) + 0.5) / 1000 * length
    w, d = towards(origin + t[:, None] * way)
    inner = np.sum(area * w[..., 1] / d**2 * np.exp(-sigma * d) * henyey_greenstein(w @ way, g), axis=1)
    expected = np.sum(inner * np.exp(-sigma * t)) * length / 1000 * sigma * np.array([5, 3, 1])
    np.testing.assert_allclose(layers.volume_from_light[0], expected, rtol=2e-2)
    np.testing.assert_array_equal(layers.emission, 0.0)
    # Straight up at the lamp's front, and down on its back.
    seen = direct.radiance(scene, ray([0, 1, 0.1], [0, 1, 0]), direct.plan(scene, None)).emission
    np.testing.assert_allclose(seen[0], np.array([5, 3, 1]) * np.exp(-sigma), rtol=1e-5)
    back = direct.radiance(scene, ray([0, 3, 0.1], [0, -1, 0]), direct.plan(scene, None)).emission
    np.testing.assert_array_equal(back, 0.0)


def many_faces(num):
    """A lamp cut into num x num squares: beyond the limit for sampling by solid angle."""
    parts = [quad([i / num - 0.5, 2, j / num - 0.5], [1 / num, 0, 0], [0, 0, 1 / num], emission=(5.0, 3.0, 1.0))
             for i in range(num) for j in range(num)]  # fmt: skip
    return merge(FLOOR, *parts)


def test_many_emissive_faces_are_sampled_by_area_to_the_same_result():
    rays = Rays(f32([[-3, 1.5, 0.2], [-3, 1.0, 0.0]]), f32([[0.8, -0.6, 0.0], [1.0, 0.0, 0.0]]), f32([np.inf, np.inf]))
    found = []
    for mesh in (many_faces(1), many_faces(3)):
        scene = Scene(mesh=mesh, medium=fog((0.3,) * 3), area_lights=lights.area_lights(mesh))
        plan = direct.plan(scene, None, samples_per_pixel=64, num_area_points=8)
        found.append(direct.radiance(scene, rays, plan))
    assert np.asarray(found[0].surface_from_light).max() > 0.01
    np.testing.assert_allclose(found[1].surface_from_light, found[0].surface_from_light, rtol=0.01)
    np.testing.assert_allclose(found[1].volume_from_light, found[0].volume_from_light, rtol=0.02)


@pytest.mark.parametrize("g", [0.0, 0.8])
def test_a_uniform_sky(g):
    """Radiance 1 from everywhere, c = 1, a slab of fog: single scattering is int T(0, t) T(t, sky) dt, by quadrature."""
    scene = Scene(medium=fog((0.7,) * 3, g=g, half=1.0), environment=lights.environment_light([1.0, 1.0, 1.0]))
    layers = direct.radiance(scene, ray([-3, 0.2, 0.0], [1, 0, 0]), direct.plan(scene, None, samples_per_pixel=64))
    np.testing.assert_allclose(layers.emission, np.exp(-1.4), rtol=1e-5)
    node, weight = np.polynomial.legendre.leggauss(64)
    phi = (np.arange(64) + 0.5) * 2 * np.pi / 64
    total = 0.0
    for x, wx in zip(node, weight, strict=True):
        c, p = np.meshgrid(node, phi, indexing="ij")
        s = np.sqrt(1 - c * c)
        way = np.stack([c, s * np.cos(p), s * np.sin(p)], -1)
        exits = np.min((np.sign(way) - [x, 0.2, 0.0]) / np.where(np.abs(way) < 1e-9, 1e-9, way), axis=-1)
        inner = np.sum(weight[:, None] * henyey_greenstein(c, g) * np.exp(-0.7 * exits)) * 2 * np.pi / 64
        total += wx * 0.7 * np.exp(-0.7 * (x + 1)) * inner
    np.testing.assert_allclose(layers.volume_from_light, total, rtol=0.01)


def test_sky_on_a_glossy_floor_is_its_albedo():
    """A plane under a uniform sky reflects albedo plus the part of the Phong lobe above it (all of it, seen from above)."""
    floor = quad([-500, 0, -500], [0, 0, 1000], [1000, 0, 0], albedo=(0.3, 0.2, 0.1), specular=(0.5, 0.5, 0.5))
    floor = dataclasses.replace(floor, exponent=f32([40.0, 40.0]))
    scene = Scene(mesh=floor, environment=lights.environment_light([2.0, 2.0, 2.0]))
    found = direct.radiance(
        scene, ray([0, 5, 0], [0, -1, 0]), direct.plan(scene, None, samples_per_pixel=64)
    ).surface_from_light
    lobe = 42 / 41 * 41 / 42  # int (n+2)/(2 pi) cos^n cos dw = 1 at normal incidence
    np.testing.assert_allclose(found[0], 2 * (np.array([0.3, 0.2, 0.1]) + 0.5 * lobe), rtol=0.01)


def test_columns_towards_a_directional_light():
    """The sheared sums against marching, for points before, in, beside and behind the box; second order in the voxel."""
    from jaxvol import extinction
    from jaxvol.direct import light_columns

    rng = np.random.default_rng(0)
    points = f32(rng.uniform([-1.5, -0.5, 1.5], [1.5, 2, 4.5], (2000, 3)))
    for way in ([0.0, -1.0, 0.0], [-0.6, -0.5, -0.62]):
        errors, way = [], np.asarray(way) / np.linalg.norm(way)
        for shape in ((12, 10, 14), (24, 20, 28)):
            x, y, z = np.meshgrid(*[(np.arange(n) + 0.5) / n for n in shape], indexing="ij")
            grid = 1 + np.sin(5 * x) * np.cos(4 * y) * np.sin(3 * z + 1)
            medium = dataclasses.replace(fog(density=grid), bounds=f32([[-1, 0, 2], [1, 1.5, 4]]))
            marching = extinction.marching_medium(medium)
            found = light_columns.optical_thickness(
                light_columns.light_columns(marching, f32(way), per_voxel=1), medium, points
            )
            exact = extinction.optical_thickness(
                medium,
                points,
                jnp.broadcast_to(f32(-way), points.shape),
                jnp.full(2000, jnp.inf),
                casters=(None,),
                num_steps=1600,
            )
            errors.append(float(jnp.mean(jnp.abs(found - exact)) / jnp.mean(exact)))
        assert errors[1] < 0.006 and errors[1] < max(errors[0] / 3, 0.001)


def test_shadow_of_a_screen():
    """A screen between a point light and half the floor; no medium."""
    screen = quad([-1, 1, -50], [0, 0, 100], [-50, 0, 0])
    scene = Scene(mesh=merge(FLOOR, screen), point_lights=lamp_at((0, 2, 0), (3.0, 3.0, 3.0)))
    rays = Rays(f32([[-1.9, 0.5, 0], [-2.2, 0.5, 0]]), f32([[0, -1, 0]] * 2), f32([np.inf] * 2))
    found = np.asarray(direct.radiance(scene, rays, direct.plan(scene, None, **FEW)).surface_from_light)
    d2 = 4 + 1.9**2
    np.testing.assert_allclose(found[0], np.array([0.8, 0.5, 0.2]) / np.pi * 3 * 2 / d2**1.5, rtol=1e-4)
    np.testing.assert_array_equal(found[1], 0.0)


def test_what_a_scene_lacks_is_zero_and_said():
    rays = ray([0, 1, 0], [0, -1, 0])
    dark = Scene(mesh=FLOOR, medium=fog())
    plan = direct.plan(dark, None, **FEW)
    assert not (plan.emission or plan.surface or plan.volume) and "no light" in " ".join(plan.skipped)
    assert all(not np.any(x) for x in jax.tree.leaves(direct.radiance(dark, rays, plan)))
    lit = lamp_at((0, 2, 0))
    for scene, word in (
        (Scene(medium=fog(), point_lights=lit), "no surface"),
        (Scene(mesh=FLOOR, point_lights=lit), "no medium"),
        (Scene(mesh=quad([0, 0, 0], [0, 0, 1], [1, 0, 0]), point_lights=lit), "no surface reflects"),
        (Scene(medium=fog((0, 0, 0), (1, 1, 1)), point_lights=lit), "does not scatter"),
    ):
        assert word in " ".join(direct.plan(scene, None).skipped)
    absorbing = Scene(medium=fog((0, 0, 0), (1, 1, 1)), point_lights=lit)
    assert not direct.plan(absorbing, None).volume
    assert direct.plan(absorbing, None, specialize="structure").volume
    assert hash(plan) == hash(direct.plan(dark, None, **FEW))
    assert [c.name for c in direct.claims(dark)] == ["emission", "surface_from_light", "volume_from_light"]


def test_bad_input_is_refused_in_one_line():
    glass = dataclasses.replace(fog(), ior=f32(1.3))
    with pytest.raises(ValueError, match="refractive_index"):
        direct.plan(Scene(medium=glass, point_lights=lamp_at((0, 1, 0))), None)
    with pytest.raises(ValueError, match="num_steps = 0 must be within"):
        direct.plan(Scene(), None, num_steps=0)
    with pytest.raises(ValueError, match="specialize"):
        direct.plan(Scene(), None, specialize="all")


def small_camera(size=12):
    return Camera(cameras.look_at((0, 1.2, 4), (0, 0.8, 0), (0, 1, 0)), f32(0.7), height=size, width=size)


def lit_scene():
    lamp = quad([-0.3, 2, -0.3], [0.6, 0, 0], [0, 0, 0.6], emission=(8.0, 6.0, 4.0))
    mesh = merge(quad([-2, 0, -2], [0, 0, 4], [4, 0, 0], albedo=(0.7, 0.6, 0.5)), lamp)
    return Scene(
        mesh=mesh,
        medium=fog((0.3, 0.2, 0.1), (0.02,) * 3, g=0.4, half=3.0),
        area_lights=lights.area_lights(mesh),
        point_lights=lamp_at((1.2, 1.0, 0.5), (0.8, 0.9, 1.0)),
    )


def test_render_matches_the_path_tracer():
    """Sums over 3 x 3 blocks of the three layers, within the path tracer's own variance and 1.5 %."""
    from jaxvol.methods import path_tracing

    scene, camera = lit_scene(), small_camera()
    mine = direct.render(scene, camera, direct.plan(scene, camera))
    plan = path_tracing.plan(scene, camera, max_scatterings=1, num_lanes=4096)
    theirs = path_tracing.render(scene, camera, plan, seed=3, samples=1024)

    def blocks(x):
        return np.asarray(x, np.float64).reshape(4, 3, 4, 3, 3).mean(axis=(1, 3))

    for name in ("emission", "surface_from_light", "volume_from_light"):
        a, b, v = (blocks(getattr(e, name)) for e in (mine.mean, theirs.mean, theirs.variance))
        error = np.sqrt(v / 9) + 0.005 * b.max()
        assert np.mean(np.abs(a - b) < 3 * error) > 0.98, name
        noise = np.sqrt((v / 9 / 16).sum()) / b.sum() * 4
        assert noise < 0.04
        assert abs(a.sum() / b.sum() - 1) < 4 * noise + 0.01, name
    assert mine.auxiliary.depth.shape == (12, 12)


def test_auxiliary_guides():
    scene, camera = lit_scene(), small_camera(8)
    guides = direct.render(scene, camera, direct.plan(scene, camera, **FEW)).auxiliary
    seen = np.isfinite(np.asarray(guides.depth))
    assert 0 < seen.sum() < seen.size
    rays = cameras.generate_rays(camera, cameras.pixel_centers(camera))
    way = np.asarray(rays.direction).reshape(8, 8, 3)
    point = np.asarray(camera.world_from_camera[:3, 3]) + np.where(seen, guides.depth, 0)[..., None] * way
    floor = seen & (np.abs(point[..., 1]) < 1e-3)
    assert floor.any()
    np.testing.assert_allclose(np.asarray(guides.albedo)[floor], np.broadcast_to([0.7, 0.6, 0.5], (floor.sum(), 3)), rtol=1e-6)
    assert np.all(np.sum(np.asarray(guides.normal) * way, -1)[seen] < 0)
    start = 1.0 / np.abs(way[..., 2])  # the fog begins at z = 3, the camera stands at z = 4
    depth = (np.asarray(guides.depth) - start)[..., None] * np.array([0.32, 0.22, 0.12])
    np.testing.assert_allclose(np.asarray(guides.transmittance)[floor], np.exp(-depth)[floor], rtol=1e-3)


def test_one_compilation_serves_every_brightness_and_density():
    from jaxvol.direct import single_scattering

    rays = ray([0, 0, 0], [1, 0, 0])
    before = None
    for sigma in (0.5, 1.0, 2.0):
        scene = Scene(medium=fog((sigma,) * 3, g=sigma / 4), point_lights=lamp_at((0, sigma, 0), (sigma,) * 3))
        direct.radiance(scene, rays, direct.plan(scene, None, **FEW))
        sizes = single_scattering._to_point._cache_size(), single_scattering._cut._cache_size()
        assert before is None or sizes == before
        before = sizes


def test_a_phase_table_of_moments_scatters_like_the_function_it_came_from():
    from jaxvol import phase

    table = phase.phase_table(0.5 ** np.arange(24))
    assert isinstance(table, PhaseTable)
    closed = fog((0.5,) * 3, g=0.5)
    tabled = dataclasses.replace(closed, phase=table)
    found = [
        direct.radiance(Scene(medium=m, point_lights=lamp_at((1, 1, 0))), ray([0, 0, 0], [1, 0, 0]),
                        direct.plan(Scene(medium=m, point_lights=lamp_at((1, 1, 0))), None)).volume_from_light
        for m in (closed, tabled)
    ]  # fmt: skip
    np.testing.assert_allclose(found[1], found[0], rtol=2e-3)
