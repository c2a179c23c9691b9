"""The method as a whole: what it claims, plans, refuses and skips; books, layers, equal ways to say one scene."""

import importlib
from pathlib import Path

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh

from jaxvol import camera as cameras
from jaxvol import lights as light_types
from jaxvol import media
from jaxvol.layers import items
from jaxvol.methods import lattice_boltzmann, path_tracing
from jaxvol.methods.lattice_boltzmann import fine_sweeps, illumination, light_rays, materials
from jaxvol.types import Camera, DirectionalLights, Medium, Mesh, PointLights, Rays, Scene, SpotLights


def _scene(sigma_s=(2.0, 2.0, 2.0), sigma_a=(0.2, 0.2, 0.2), light=(1.0, 1.0, 1.0), **fields):
    medium = Medium(
        bounds=jnp.asarray([[0.0, 0, 0], [1, 1, 1]]),
        sigma_s=jnp.asarray(sigma_s, jnp.float32),
        sigma_a=jnp.asarray(sigma_a, jnp.float32),
        g=fields.pop("g", jnp.float32(0.0)),
        **fields,
    )
    sun = DirectionalLights(jnp.asarray([[0.6, -0.8, 0.0]]), jnp.asarray([light], jnp.float32))
    return Scene(medium=medium, directional_lights=sun)


def _camera(size=8):
    pose = cameras.look_at([0.5, 0.6, 3.0], [0.5, 0.5, 0.5], [0, 1, 0])
    return Camera(jnp.asarray(pose), jnp.float32(0.6), size, size)


SMALL = {"resolution": 8, "rays_per_voxel": 2.0, "samples_per_pixel": 1}


def _picture(scene, **options):
    plan = lattice_boltzmann.plan(scene, _camera(), **(SMALL | options))
    return lattice_boltzmann.render(scene, _camera(), plan, seed=0), plan


@pytest.fixture(scope="module")
def grey():
    return _picture(_scene())


def test_layers_are_claimed_and_books_balance(grey):
    estimate, plan = grey
    assert plan.num_channels == 1 and any("one spectrum" in reason for reason in plan.skipped)
    claimed = {claim.name for claim in lattice_boltzmann.claims(_scene())}
    assert claimed == {"volume_from_light", "volume_from_volume", "volume_from_multiple", "volume_from_surface"}
    found = dict(items(estimate.mean))
    assert set(found) == claimed
    assert not np.any(found["volume_from_surface"]) and all(np.isfinite(v).all() for v in found.values())
    diagnostics = estimate.diagnostics
    assert bool(diagnostics["converged"]) and float(diagnostics["residual"].max()) < 2e-4
    assert float(diagnostics["live"][0]) < 1e-4 * float(diagnostics["sent"][0])


def test_three_equal_channels_are_one(grey):
    """Grey media solve one channel; three channels give the same picture (and the colour of the light is kept)."""
    three, plan = _picture(_scene(sigma_a=(0.2, 0.2, 0.2000001)))
    assert plan.num_channels == 3
    for (name, a), (_, b) in zip(items(grey[0].mean), items(three.mean), strict=True):
        np.testing.assert_allclose(a, b, rtol=2e-3, atol=2e-4 * float(np.max(np.asarray(b)) + 1e-9), err_msg=name)
    coloured, plan = _picture(_scene(light=(2.0, 1.0, 0.5)))
    assert plan.num_channels == 1
    expected = np.asarray(grey[0].mean.volume_from_light)[..., :1] * np.array([2.0, 1.0, 0.5])
    np.testing.assert_allclose(coloured.mean.volume_from_light, expected, rtol=1e-4, atol=1e-6)


def test_constant_grid_is_homogeneous(grey):
    """T12."""
    gridded, _ = _picture(_scene(density=jnp.ones((8, 8, 8))))
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
        scene = eqx.tree_at(lambda s: s.medium.bounds, _scene(density=density), bounds)
        found, plan = _picture(scene)
        plans.append(plan)
        pictures.append(found.mean)
        inside = materials.cropped(scene.medium)
        shapes.append((inside.density.shape, materials.make_grid(inside, resolution=8).shape))
    assert plans[0] == plans[1] and shapes == [((8, 8, 8), (8, 8, 8))] * 2
    for (name, a), (_, b) in zip(*(items(p) for p in pictures), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-3, atol=1e-4 * float(np.max(np.asarray(a)) + 1e-9), err_msg=name)


def test_resampled_density_is_the_trilinear_mean():
    """A grid that does not fit the voxels, against the density looked up at the same points."""
    medium = _scene(density=jnp.asarray(np.random.default_rng(0).random((5, 6, 7)), jnp.float32)).medium
    bounds = np.array([[-0.09, 0.0, 0.05], [1.11, 1.2, 1.25]])  # no sample on a face
    found = materials._density(medium, bounds, (9, 9, 9))
    axes = [bounds[0, a] + (np.arange(18) + 0.5) * 1.2 / 18 for a in range(3)]
    points = jnp.asarray(np.stack(np.meshgrid(*axes, indexing="ij"), -1), jnp.float32)
    expected = np.asarray(media.density(medium, points)).reshape(9, 2, 9, 2, 9, 2).mean((1, 3, 5))
    np.testing.assert_allclose(found, expected, atol=1e-5)


def test_homogeneous_boxes_solve_with_numbers(grey):
    assert grey[1].homogeneous and any("homogeneous box" in reason for reason in grey[1].skipped)
    fields, plan = _picture(_scene(), specialize="structure")
    assert not plan.homogeneous and plan.num_channels == 3
    for (name, a), (_, b) in zip(items(grey[0].mean), items(fields.mean), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-5 * float(np.max(np.asarray(a)) + 1e-9), err_msg=name)


def test_first_order_in_a_cube_is_exact_up_to_its_lit_faces():
    """Single scattering at sigma_t h = 0.55, the light of the outer half voxels included, against quadrature."""
    scattering, extinction, n = 4.0, 4.4, 8
    scene = _scene(sigma_s=(scattering,) * 3, sigma_a=(extinction - scattering,) * 3)
    plan = lattice_boltzmann.plan(scene, None, resolution=n, rays_per_voxel=16.0, view_step=0.25)
    light = lattice_boltzmann.illuminate(scene, plan)
    x, z = (a.ravel() for a in np.meshgrid((np.arange(16) + 0.5) / 16, (np.arange(16) + 0.5) / 16, indexing="ij"))
    origin, down = np.stack([x, np.full(256, 2.0), z], 1), np.tile([0.0, -1.0, 0.0], (256, 1))
    rays = Rays(*(jnp.asarray(v, jnp.float32) for v in (origin, down, np.full(256, np.inf))))
    ours = lattice_boltzmann.radiance(scene, rays, plan, light)["volume_from_light"][:, 0].mean()
    depth = (np.arange(4000) + 0.5) / 4000
    lit = np.minimum(x[:, None] / 0.6, depth[None] / 0.8)  # way of the sun's light (0.6, -0.8, 0) inside the cube
    exact = np.mean(scattering / (4 * np.pi) * np.exp(-extinction * (lit + depth[None])))
    assert ours == pytest.approx(exact, rel=0.03)  # held constant in the outer half voxels it is 8 % dark


def test_an_index_of_one_is_no_index():
    plan = lattice_boltzmann.plan(_scene(ior=jnp.float32(1.00005)), None, **SMALL)
    assert not plan.refract and plan.margin == 0 and any("straight rays" in reason for reason in plan.skipped)
    assert lattice_boltzmann.plan(_scene(ior=jnp.float32(1.01)), None, **SMALL).refract


@pytest.mark.slow
def test_bent_rays_scatter_anisotropically_as_straight_ones_do():
    """An index of 1.001 bends nothing to speak of: the bent march, solve and view against the straight ones, g = 0.6."""
    options = {"anisotropy": "first_order", "corrections": 0, "resolution": 24}
    straight, plan = _picture(_scene(g=jnp.float32(0.6)), **options)
    bent, bent_plan = _picture(_scene(g=jnp.float32(0.6), ior=jnp.float32(1.001)), **options)
    assert not plan.refract and bent_plan.refract and bent_plan.first_order
    name = "volume_from_light+volume_from_volume+volume_from_multiple"
    a, b = (np.asarray(x.mean.sums[name]) for x in (straight, bent))
    assert b.sum() == pytest.approx(a.sum(), rel=0.05)


def test_power_scales_the_picture(grey):
    double, _ = _picture(_scene(light=(2.0, 2.0, 2.0)))
    np.testing.assert_allclose(double.mean.volume_from_multiple, 2 * np.asarray(grey[0].mean.volume_from_multiple), rtol=1e-4)


def test_anisotropic_media_claim_only_the_sum():
    claim, _ = lattice_boltzmann.claims(_scene(g=jnp.float32(0.5)))
    assert claim.layers == ("volume_from_light", "volume_from_volume", "volume_from_multiple") and "anisotropy" in claim.partial


def test_nothing_scatters_no_lattice():
    plan = lattice_boltzmann.plan(_scene(sigma_s=(0.0, 0.0, 0.0)), None, **SMALL)
    assert not plan.solve and any("nothing scatters" in reason for reason in plan.skipped)


def test_coarse_lattice_is_warned_with_the_resolution_that_would_do():
    plan = lattice_boltzmann.plan(_scene(sigma_s=(40.0, 40.0, 40.0)), None, **SMALL)
    (warning,) = [reason for reason in plan.skipped if reason.startswith("warning")]
    assert "resolution = 41" in warning and plan.probability_map == "exp"


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"lattice": "19"}, "lattice = '19' must be one of paper, 18, 26"),
        ({"filter_width": 0.3}, "filter_width = 0.3 must be within"),
        ({"march_step": 1.5}, "march_step = 1.5 must be within"),
        ({"probability_map": "linear"}, "probability_map"),
        ({"boundary_reflectance": 1.2}, "must be within"),
    ],
)
def test_bad_options(options, message):
    with pytest.raises(ValueError, match=message):
        lattice_boltzmann.plan(_scene(), None, **(SMALL | options))


def test_closed_white_box_is_refused_with_the_reason():
    scene = _scene(sigma_a=(0.0, 0.0, 0.0))
    with pytest.raises(ValueError, match="no steady state"):
        lattice_boltzmann.plan(scene, None, **SMALL, boundary_reflectance=1.0)
    assert lattice_boltzmann.plan(scene, None, **SMALL).solve  # an open one of albedo 1 works


def test_missing_medium():
    assert lattice_boltzmann.claims(Scene()) == ()
    with pytest.raises(ValueError, match="medium is missing"):
        lattice_boltzmann.plan(Scene(), None)


def test_light_rays_carry_the_lights_power():
    low, high = np.zeros(3), np.ones(3)
    sun = _scene()
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
    medium = _scene(sigma_s=(0.0,) * 3, sigma_a=(1e-5,) * 3).medium
    scene = Scene(medium=medium, **lights)
    plan = lattice_boltzmann.plan(scene, None, resolution=5, rays_per_voxel=256.0, surface_rays=0)
    light = lattice_boltzmann.illuminate(scene, plan)
    assert float(light.from_light[0, 2, 2, 2]) * light.spectrum[0] / 0.2**2 == pytest.approx(fluence, rel=0.03)


def test_shadows_cut_light_rays():
    wall = trimesh.creation.box(extents=[0.02, 8.0, 8.0])
    wall.apply_translation([-0.5, 0.0, 0.0])
    mesh = Mesh(jnp.asarray(wall.vertices, jnp.float32), jnp.asarray(wall.faces), jnp.zeros((len(wall.faces), 3)))
    scene = eqx.tree_at(lambda s: s.mesh, _scene(), mesh, is_leaf=lambda x: x is None)
    scene = eqx.tree_at(lambda s: s.directional_lights.direction, scene, jnp.asarray([[1.0, 0.0, 0.0]]))
    plan = lattice_boltzmann.plan(scene, None, **SMALL)
    light = lattice_boltzmann.illuminate(scene, plan)
    assert float(jnp.max(light.from_light)) == 0.0


def test_quadrature_of_the_fine_sweeps():
    points = fine_sweeps.directions()
    vectors, weights = np.array([v for v, _ in points]), np.array([w for _, w in points])
    assert len(points) == 40 and 2 * weights.sum() == pytest.approx(1, abs=1e-6)
    np.testing.assert_allclose(np.linalg.norm(vectors, axis=1), 1, atol=1e-6)
    assert 2 * np.sum(weights * vectors[:, 0] ** 4) == pytest.approx(1 / 5, abs=2e-4)


def test_fine_sweeps_against_straight_integration():
    """Fluence in the middle of a uniform source with absorption, against the integral over directions in float64."""
    n, x = 12, 0.3
    phi = fine_sweeps.transport(jnp.full((n,) * 3, x), jnp.ones((n,) * 3))
    rng = np.random.default_rng(0)
    directions = rng.normal(size=(20000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    center = np.full(3, n / 2)
    length = np.min(np.where(directions > 0, n - center, center) / np.abs(directions), axis=1)
    expected = np.mean((1 - np.exp(-x * length)) / x)
    assert float(np.mean(np.asarray(phi)[5:7, 5:7, 5:7])) == pytest.approx(expected, rel=0.01)


def test_fine_sweeps_keep_all_power():
    """From the middle of a thick cube next to nothing escapes: all of the source is met by extinction."""
    n, x = 24, 1.0
    source = jnp.zeros((n,) * 3).at[12, 11, 12].set(1.0)
    for kind in ("pade", "exp"):
        phi = fine_sweeps.transport(jnp.full((n,) * 3, x), source, kind=kind)
        assert float(jnp.sum(x * phi)) == pytest.approx(1.0, abs=2e-4)


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
def test_walls_in_a_medium_with_straight_rays_against_the_path_tracer():
    """A white cube in fog: with `walls` light comes back from it into the fog, without it passes through."""
    cube = trimesh.creation.box(extents=[0.5] * 3)
    cube.apply_translation([0.5] * 3)
    mesh = Mesh(jnp.asarray(cube.vertices, jnp.float32), jnp.asarray(cube.faces), jnp.full((len(cube.faces), 3), 0.9))
    scene = eqx.tree_at(lambda s: s.mesh, _scene(sigma_s=(6.0,) * 3), mesh, is_leaf=lambda x: x is None)
    camera = _camera(16)
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
    script = Path(__file__).resolve().parents[3] / "experiments" / "lattice_photons.py"
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(script.parent))
        module = importlib.import_module("lattice_photons")
    sigma_s, sigma_a, ior, g = 15.2, 0.8, 1.3, 0.6
    books, exact = module.photon_tracer(sigma_s, sigma_a, ior, 200_000, g=g)
    assert sum(books.values()) == pytest.approx(1.0, abs=1e-9)
    absorbed, shells = module.lattice_books(sigma_s, sigma_a, ior, 32, g=g)
    assert absorbed == pytest.approx(books["absorbed"], rel=0.04)
    assert np.abs(shells - exact).sum() / exact.sum() < 0.1


@pytest.mark.slow
@pytest.mark.parametrize(("case", "limit"), [("beam", 0.08), ("point", 0.03)])
def test_fluence_in_a_cube_against_monte_carlo(case, limit):
    """The default lattice at tau 16, albedo 0.9, 32^3; the walks' own noise is below a third of the limit."""
    script = Path(__file__).resolve().parents[3] / "experiments" / "lattice_accuracy.py"
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(script.parent))
        module = importlib.import_module("lattice_accuracy")
    photons = 1_000_000
    exact = module.monte_carlo(case, 16.0, 0.9, photons)
    assert np.sqrt(exact * photons).sum() / (exact * photons).sum() < limit / 3
    found = module.collisions("26", 2, 16.0, 0.9, module.first_collisions(case, 16.0, 32))
    assert np.abs(found - exact).sum() / exact.sum() < limit


@pytest.mark.slow
def test_emission_density_of_a_slab_against_the_integral_equation():
    """Optical thickness 16, albedo 0.9, 32 voxels: sigma_s Phi within 5 % (relative L1) of float64 quadrature."""
    script = Path(__file__).resolve().parents[3] / "experiments" / "lattice_accuracy.py"
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(script.parent))
        module = importlib.import_module("lattice_accuracy")
    (row,) = module.slab_emission(forms=(("26", 2),))
    assert row["error"] < 0.05


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


def test_illumination_is_linear_in_its_stages():
    """Marched light alone carries the first layer: without scattering orders beyond it nothing else is lit."""
    scene = _scene(sigma_s=(1e-4,) * 3, sigma_a=(1.0,) * 3)
    plan = lattice_boltzmann.plan(scene, None, **SMALL)
    light = illumination.illuminate(scene, plan)
    assert float(jnp.max(light.scattered)) < 1e-3 * float(jnp.max(light.from_light))


def _exitance(scene, plan, light, tau, width, side):
    """Irradiance that leaves the middle of a slab's face, by quadrature over the hemisphere of radiance."""
    nodes, weights = np.polynomial.legendre.leggauss(12)
    mu, phi = (a.ravel() for a in np.meshgrid(0.5 * (nodes + 1), (np.arange(8) + 0.5) / 4 * np.pi, indexing="ij"))
    weight = np.repeat(0.5 * weights, 8) * mu * 2 * np.pi / 8
    r = np.sqrt(1 - mu * mu)
    direction = np.stack([r * np.cos(phi), r * np.sin(phi), mu if side == 0 else -mu], 1)
    origin = np.array([width / 2, width / 2, 0.0 if side == 0 else tau]) - 1e-3 * direction
    rays = Rays(*(jnp.asarray(x, jnp.float32) for x in (origin, direction, np.full(len(mu), np.inf))))
    found = lattice_boltzmann.radiance(scene, rays, plan, light)
    return float(sum((v[:, 0] * weight).sum() for v in found.values()))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("tau", "mu0", "reflectance", "count", "width"),
    [
        (1.0, 1.0, 0.341329, 8, 12.0),
        (2.0, 1.0, 0.517515, 8, 20.0),
        pytest.param(
            *(8.0, 1.0, 0.821804, 16, 48.0),
            marks=pytest.mark.xfail(strict=True, reason="T is 4.2 % low since the view extrapolates at lit faces; 3 % asked"),
        ),
        (1.0, 0.5, 0.498376, 8, 12.0),
    ],
)
def test_slab_reflectance_and_transmittance(tau, mu0, reflectance, count, width):
    """T4: collimated light on a slab of albedo 1; R and T by radiance within 3 %."""
    medium = Medium(jnp.asarray([[0, 0, 0], [width, width, tau]], jnp.float32), jnp.ones(3), jnp.zeros(3), jnp.float32(0))
    sun = DirectionalLights(jnp.asarray([[np.sqrt(1 - mu0**2), 0.0, mu0]], jnp.float32), jnp.full((1, 3), 1 / mu0))
    scene = Scene(medium=medium, directional_lights=sun)
    plan = lattice_boltzmann.plan(scene, None, resolution=round(width * count / tau), rays_per_voxel=1.0, view_step=0.25)
    light = lattice_boltzmann.illuminate(scene, plan)
    up, down = (_exitance(scene, plan, light, tau, width, side) for side in (0, 1))
    assert up == pytest.approx(reflectance, rel=0.03)
    assert down + np.exp(-tau / mu0) == pytest.approx(1 - reflectance, rel=0.03)


@pytest.fixture(scope="module")
def diffusely_lit_slab():
    """T5: transmittance and reflectance of a slab of optical thickness 1 and albedo 1 under diffuse light from one side."""
    tau, width, count = 1.0, 12.0, 8
    medium = Medium(jnp.asarray([[0, 0, 0], [width, width, tau]], jnp.float32), jnp.ones(3), jnp.zeros(3), jnp.float32(0))
    nodes, weights = np.polynomial.legendre.leggauss(6)
    mu, phi = (a.ravel() for a in np.meshgrid(0.5 * (nodes + 1), (np.arange(6) + 0.5) / 3 * np.pi, indexing="ij"))
    flux = np.repeat(0.5 * weights, 6) * 2 * mu / 6  # of a unit irradiance
    r = np.sqrt(1 - mu * mu)
    direction = np.stack([r * np.cos(phi), r * np.sin(phi), mu], 1)
    suns = DirectionalLights(
        jnp.asarray(direction, jnp.float32), jnp.asarray(np.repeat((flux / mu)[:, None], 3, 1), jnp.float32)
    )
    scene = Scene(medium=medium, directional_lights=suns)
    options = {"view_step": 0.25}  # fewer rays than the default sample grazing light too coarsely: 1.5 % of the power lost
    plan = lattice_boltzmann.plan(scene, None, resolution=round(width * count / tau), **options)
    light = lattice_boltzmann.illuminate(scene, plan)
    straight = float(np.sum(flux * np.exp(-tau / mu)))
    down = _exitance(scene, plan, light, tau, width, 1) + straight
    return down, _exitance(scene, plan, light, tau, width, 0)


@pytest.mark.slow
def test_diffuse_light_through_a_slab(diffusely_lit_slab):
    assert diffusely_lit_slab[0] == pytest.approx(0.55341, rel=0.03)


@pytest.mark.slow
def test_diffuse_light_back_from_a_slab(diffusely_lit_slab):
    assert diffusely_lit_slab[1] == pytest.approx(1 - 0.55341, rel=0.03)
