"""Bodies that bend light: opaque meshes inside, anisotropy, energy, against photons; walls without bending."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh

from jaxvol import camera as cameras
from jaxvol.methods import lattice_boltzmann, path_tracing
from jaxvol.methods.lattice_boltzmann import illumination
from jaxvol.types import Camera, DirectionalLights, Medium, Mesh, Rays, Scene
from tests.methods.lattice_boltzmann.builders import box_camera, box_picture, box_scene, experiment


def test_opaque_mesh_inside_a_refractive_body():
    """It ends light, is seen where it is and scatters light back; outside the body it does nothing."""
    ball = trimesh.creation.icosphere(subdivisions=2, radius=0.5)
    cube = trimesh.creation.box(extents=[0.3, 0.3, 0.3])
    as_mesh = lambda m, albedo: Mesh(  # noqa: E731
        jnp.asarray(m.vertices, jnp.float32), jnp.asarray(m.faces), jnp.full((len(m.faces), 3), albedo)
    )
    medium = Medium(
        jnp.asarray([[-0.5] * 3, [0.5] * 3]), jnp.full(3, 1.0), jnp.full(3, 0.1), jnp.float32(0),
        ior=jnp.float32(1.2), boundary=as_mesh(ball, 0.0),
    )  # fmt: skip
    sun = DirectionalLights(jnp.asarray([[0.0, 0.0, -1.0]]), jnp.ones((1, 3)))
    camera = Camera(jnp.asarray(cameras.look_at([0, 0, 3.0], [0, 0, 0], [0, 1, 0])), jnp.float32(0.3), 5, 5)
    options = {"resolution": 16, "rays_per_voxel": 2.0, "samples_per_pixel": 1, "surface_rays": 1 << 12}
    behind, seen, total = [], [], []
    for albedo in (0.0, 0.9):
        scene = Scene(mesh=as_mesh(cube, albedo), medium=medium, directional_lights=sun)
        plan = lattice_boltzmann.plan(scene, camera, **options)
        assert plan.walls
        light = illumination.illuminate(scene, plan)
        middle, far = (
            light.from_light.shape[1] // 2,
            slice(light.from_light.shape[3] // 2 - 5, light.from_light.shape[3] // 2 - 3),
        )
        behind.append(float(jnp.max(light.from_light[0, middle, middle, far])))
        found = lattice_boltzmann.render(scene, camera, plan)
        seen.append(np.asarray(found.mean.surface_from_light)[2, 2, 0])
        total.append(float(jnp.sum(light.scattered)))
    unblocked = light.from_light[0, middle, middle, -6]
    assert max(behind) < 0.05 * float(unblocked)
    # Lambert in the light that the medium lets through, there and back, with Fresnel's 0.8 % at the surface
    assert seen[1] - seen[0] == pytest.approx(0.9 / np.pi * np.exp(-1.1 * 0.7), rel=0.1)
    assert total[1] > 1.1 * total[0]


@pytest.mark.slow
def test_bent_rays_scatter_anisotropically_as_straight_ones_do():
    """An index of 1.001 bends nothing to speak of: the bent march, solve and view against the straight ones, g = 0.6."""
    options = {"anisotropy": "first_order", "corrections": 0, "resolution": 24}
    straight, plan = box_picture(box_scene(g=jnp.float32(0.6)), **options)
    bent, bent_plan = box_picture(box_scene(g=jnp.float32(0.6), ior=jnp.float32(1.001)), **options)
    assert not plan.refract and bent_plan.refract and bent_plan.first_order
    name = "volume_from_light+volume_from_volume+volume_from_multiple"
    a, b = (np.asarray(x.mean.sums[name]) for x in (straight, bent))
    assert b.sum() == pytest.approx(a.sum(), rel=0.05)


@pytest.mark.slow
def test_walls_in_a_medium_with_straight_rays_against_the_path_tracer():
    """A white cube in fog: with `walls` light comes back from it into the fog, without it passes through."""
    cube = trimesh.creation.box(extents=[0.5] * 3)
    cube.apply_translation([0.5] * 3)
    mesh = Mesh(jnp.asarray(cube.vertices, jnp.float32), jnp.asarray(cube.faces), jnp.full((len(cube.faces), 3), 0.9))
    scene = eqx.tree_at(lambda s: s.mesh, box_scene(sigma_s=(6.0,) * 3), mesh, is_leaf=lambda x: x is None)
    camera = box_camera(16)
    layers = ("volume_from_volume", "volume_from_multiple")
    reference = path_tracing.render(scene, camera, path_tracing.plan(scene, camera), seed=0, samples=128)
    values = [np.asarray(getattr(reference.mean, name)).sum() for name in layers]
    noise = np.sqrt(sum(np.asarray(getattr(reference.variance, name)).sum() for name in layers)) / sum(values)
    assert noise < 0.015
    errors = {}
    for walls in (False, True):
        options = {"resolution": 32, "samples_per_pixel": 4, "walls": walls}
        found = lattice_boltzmann.render(scene, camera, lattice_boltzmann.plan(scene, camera, **options)).mean
        errors[walls] = sum(np.asarray(getattr(found, name)).sum() for name in layers) / sum(values) - 1
    assert abs(errors[True]) < 0.06, errors


@pytest.mark.slow
def test_refraction_with_anisotropic_scattering_against_photons():
    """A sphere of index 1.3, g = 0.6, under a beam: what is absorbed where, against photons that meet Snell and Fresnel."""
    module = experiment("lattice_photons")
    sigma_s, sigma_a, ior, g = 15.2, 0.8, 1.3, 0.6
    books, exact = module.photon_tracer(sigma_s, sigma_a, ior, 200_000, g=g)
    assert sum(books.values()) == pytest.approx(1.0, abs=1e-9)
    absorbed, shells = module.lattice_books(sigma_s, sigma_a, ior, 40, g=g)
    assert absorbed == pytest.approx(books["absorbed"], rel=0.04)
    assert np.abs(shells - exact).sum() / exact.sum() < 0.1


@pytest.mark.slow
def test_refraction_radiance_over_all_exits_and_absorption_make_the_input():
    """The 1/n^2 law and internal reflection belong together: a sphere of index 1.5 gives back what it does not absorb."""
    ball = trimesh.creation.icosphere(subdivisions=3, radius=0.5)
    boundary = Mesh(jnp.asarray(ball.vertices, jnp.float32), jnp.asarray(ball.faces), jnp.zeros((len(ball.faces), 3)))
    medium = Medium(
        jnp.asarray([[-0.5] * 3, [0.5] * 3], jnp.float32), jnp.full(3, 12.0), jnp.full(3, 0.05), jnp.float32(0),
        ior=jnp.float32(1.5), boundary=boundary,
    )  # fmt: skip
    scene = Scene(medium=medium, directional_lights=DirectionalLights(jnp.asarray([[0.0, 0, 1.0]]), jnp.ones((1, 3))))
    plan = lattice_boltzmann.plan(scene, None, resolution=40, rays_per_voxel=2.0)
    light = lattice_boltzmann.illuminate(scene, plan)
    absorbed = float(jnp.sum(light.materials.absorption[0] * (light.from_light + light.scattered)[0]))
    rng = np.random.default_rng(0)
    n, radius = 6000, 0.55
    direction = rng.normal(size=(n, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    other = rng.normal(size=(n, 3))
    across = other - np.sum(other * direction, 1, keepdims=True) * direction
    across *= radius * np.sqrt(rng.random(n))[:, None] / np.linalg.norm(across, axis=1, keepdims=True)
    rays = Rays(*(jnp.asarray(x, jnp.float32) for x in (across - 2 * direction, direction, np.full(n, np.inf))))
    found = lattice_boltzmann.radiance(scene, rays, plan, light)
    leaving = sum(v[:, 0] for k, v in found.items() if k.startswith("volume")).mean() * 4 * np.pi * np.pi * radius**2
    sent, straight = (float(light.diagnostics[k][0]) for k in ("sent", "escaped_unscattered"))
    assert absorbed + leaving + straight == pytest.approx(sent, rel=0.1)
