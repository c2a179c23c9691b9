"""Whole frames: exact zeros, symmetries, media of every kind, references, bad options."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

from jaxvol import media
from jaxvol.common_stages import CommonStages
from jaxvol.methods import deep_screen_space as method
from jaxvol.methods.deep_screen_space import frame, references, splatting
from jaxvol.types import Mesh, Scene
from tests.methods.deep_screen_space.conftest import SMALL, lamp, lumps, make_medium, make_mesh, room

ALL_PAIRS = SMALL | {"num_levels": 1, "strides": (1,), "dense_from": 0, "blur": "none"}


def render(scene, camera, seed=0, **options):
    plan = method.plan(scene, camera, **(SMALL | options))
    return method.render(scene, camera, plan, seed=seed)


def image(*args, **options):
    return np.asarray(render(*args, **options).mean.volume_from_surface)


def test_nothing_to_do_is_exactly_zero_and_says_so(cloud_scene, camera):
    for change, words in (
        ({"medium": None}, "no medium"),
        ({"mesh": None}, "no surfaces"),
        ({"point_lights": None}, "no lights"),
        ({"mesh": eqx.tree_at(lambda m: m.albedo, cloud_scene.mesh, jnp.zeros_like(cloud_scene.mesh.albedo))}, "black"),
    ):
        scene = Scene(**{k: getattr(cloud_scene, k) for k in ("mesh", "medium", "point_lights")} | change)
        plan = method.plan(scene, camera)
        assert not plan.active and words in plan.skipped[0]
        found = method.render(scene, camera, plan).mean.volume_from_surface
        assert found.shape == (24, 32, 3) and (np.asarray(found) == 0).all()


def test_unlit_surfels_give_exact_zero(cloud_scene, camera):
    """A lamp in a closed box: lit inside, dark outside, and nothing infinite."""
    dark = eqx.tree_at(lambda s: s.point_lights, cloud_scene, lamp(power=0.0))
    assert (image(dark, camera) == 0).all()


def test_pixels_without_medium_are_exactly_zero(cloud_scene, camera):
    found = image(cloud_scene, camera)
    opaque = image(cloud_scene, camera, blur="none").sum(axis=-1) > 0
    assert np.isfinite(found).all() and (found >= 0).all()
    assert (found[~opaque] == 0).all() and opaque.any() and (~opaque).any()


def test_linear_in_light_power(cloud_scene, camera):
    bright = eqx.tree_at(lambda s: s.point_lights, cloud_scene, lamp(power=300.0))
    np.testing.assert_allclose(image(bright, camera), 100 * image(cloud_scene, camera), rtol=2e-4, atol=1e-6)


def test_scaled_scene_has_the_same_radiance(cloud_scene, camera):
    """Lengths times 8, sigma over 8, intensity times 64."""
    medium = cloud_scene.medium
    scaled = Scene(
        mesh=eqx.tree_at(lambda m: m.vertices, cloud_scene.mesh, 8 * cloud_scene.mesh.vertices),
        medium=eqx.tree_at(
            lambda m: (m.bounds, m.sigma_s, m.sigma_a), medium, (8 * medium.bounds, medium.sigma_s / 8, medium.sigma_a / 8)
        ),
        point_lights=eqx.tree_at(
            lambda p: (p.position, p.intensity),
            cloud_scene.point_lights,
            (8 * cloud_scene.point_lights.position, 64 * cloud_scene.point_lights.intensity),
        ),
    )
    view = camera.world_from_camera.at[:3, 3].multiply(8.0)
    far = eqx.tree_at(lambda c: c.world_from_camera, camera, view)
    a, b = image(scaled, far, **ALL_PAIRS), image(cloud_scene, camera, **ALL_PAIRS)
    np.testing.assert_allclose(a, b, rtol=0.02, atol=0.002 * b.max())  # the table picks surfels by rounded weights
    assert abs(a.sum() / b.sum() - 1) < 2e-3


def test_single_disk_on_the_axis_of_a_homogeneous_ray():
    """One surfel, one ray along its axis, medium up to the surfel: float64 quadrature of sigma_s T p T' cos dA/d^2."""
    from jaxvol import camera as cameras
    from jaxvol.types import Camera

    radius, side = 0.05, 0.05 * np.sqrt(np.pi)
    wall = make_mesh([([-side / 2, -side / 2, -1.5], [side, 0, 0], [0, side, 0])], [[0.8, 0.8, 0.8]])
    scene = Scene(mesh=wall, medium=make_medium(0.6, 0.2, half=1.0), point_lights=lamp(2.0, (0.0, 0.0, 1.5)))
    view = Camera(cameras.look_at([0.0, 0.0, 4.0], [0.0, 0.0, 0.0], [0.0, 1.0, 0.0]), jnp.float32(1e-4), 1, 1)
    plan = method.plan(scene, view, **(ALL_PAIRS | {"num_surfels": 512, "num_intervals": 64, "table_resolution": 64}))
    found = image(scene, view, **(ALL_PAIRS | {"num_surfels": 512, "num_intervals": 64, "table_resolution": 64}))
    assert plan.active
    z = -1 + (np.arange(20000) + 0.5) * 2 / 20000
    sigma = 0.8
    radiance = 0.8 / np.pi * 2.0 / 9.0 * np.exp(-2 * sigma)  # both ways through the box: length 2 towards the lamp
    solid = 2 * np.pi * (1 - (z + 1.5) / np.hypot(z + 1.5, radius))
    exact = np.sum(0.6 * np.exp(-sigma * (1 - z)) * solid * radiance * np.exp(-sigma * (z + 1)) / (4 * np.pi)) * 2 / 20000
    np.testing.assert_allclose(found[0, 0], exact, rtol=0.01)


def test_constant_grid_equals_homogeneous(cloud_scene, camera):
    """Per channel, channels 100:1 apart (test problem T12)."""
    options = ALL_PAIRS | {"num_steps": 64}
    sigma = dict(sigma_s=[0.03, 0.8, 3.0], sigma_a=[0.0, 0.2, 0.1])
    plain = image(eqx.tree_at(lambda s: s.medium, cloud_scene, make_medium(**sigma)), camera, **options)
    grid = make_medium(**sigma, density=np.ones((4, 4, 4)))
    gridded = image(eqx.tree_at(lambda s: s.medium, cloud_scene, grid), camera, **options)
    np.testing.assert_allclose(gridded.sum(axis=(0, 1)), plain.sum(axis=(0, 1)), rtol=3e-3)
    np.testing.assert_allclose(gridded, plain, rtol=0.05, atol=2e-3 * plain.max())


@pytest.mark.parametrize("g", [0.0, 0.6])
def test_a_box_shaped_boundary_equals_the_box(cloud_scene, camera, g):
    import trimesh

    box = trimesh.creation.box(extents=(1.1, 1.1, 1.1))
    shape = Mesh(jnp.asarray(box.vertices, jnp.float32), jnp.asarray(box.faces, jnp.int32), jnp.zeros((12, 3)))
    whole = make_medium(2.0, 0.4, g=g)
    options = ALL_PAIRS | {"num_steps": 128, "specialize": "structure"}
    plain = image(eqx.tree_at(lambda s: s.medium, cloud_scene, whole), camera, **options)
    bounded = eqx.tree_at(lambda m: (m.bounds, m.boundary), whole, (3 * whole.bounds, shape), is_leaf=lambda x: x is None)
    found = image(eqx.tree_at(lambda s: s.medium, cloud_scene, bounded), camera, **options)
    assert abs(found.sum() / plain.sum() - 1) < 0.01
    # An inclusion that fills the whole medium replaces it, phase function and all.
    outer = make_medium(7.0, 0.0, g=-0.3)
    filled = eqx.tree_at(lambda m: m.inclusions, outer, (bounded,))
    found = image(eqx.tree_at(lambda s: s.medium, cloud_scene, filled), camera, **options)
    assert abs(found.sum() / plain.sum() - 1) < 0.01


def test_camera_inside_the_medium_and_lamp_at_a_surface(cloud_scene, camera):
    view = camera.world_from_camera.at[:3, 3].set(jnp.array([0.1, 0.0, 0.3]))
    inside = eqx.tree_at(lambda c: c.world_from_camera, camera, view)
    touching = eqx.tree_at(lambda s: s.point_lights, cloud_scene, lamp(1.0, (0.0, -1.0 + 1e-6, 0.0)))
    for scene in (cloud_scene, touching):
        found = image(scene, inside)
        assert np.isfinite(found).all() and found.max() > 0


def test_surfels_inside_the_medium(cloud_scene, camera):
    """A board in the thick of the medium: finite, without spikes (splitting surfels and the bound A/delta: `test_kernel`)."""
    board = make_mesh([([-0.3, -0.1, 0.3], [0.6, 0, 0], [0, 0, -0.6])], [[0.7, 0.7, 0.7]])
    found = image(eqx.tree_at(lambda s: s.mesh, cloud_scene, board), camera)
    assert np.isfinite(found).all() and found.min() >= 0
    assert 0 < found.max() < 100 * found.mean()


def test_a_second_bounce_is_a_layer_of_its_own_and_never_claimed(cloud_scene, camera):
    alone, both = render(cloud_scene, camera).mean, render(cloud_scene, camera, second_bounce=8).mean
    assert alone.volume_from_multiple is None
    np.testing.assert_array_equal(both.volume_from_surface, alone.volume_from_surface)
    again = np.asarray(both.volume_from_multiple)
    assert np.isfinite(again).all() and again.min() >= 0
    assert 0.02 < again.sum() / both.volume_from_surface.sum() < 0.7  # albedos of .1 to .7, an open room
    (claim,) = method.claims(cloud_scene)
    assert "volume_from_multiple" not in claim.layers
    assert any("partial" in line for line in method.plan(cloud_scene, camera, second_bounce=8).skipped)


def test_exact_pairs_tell_the_transport_table_apart(cloud_scene, camera):
    """A1: without transport both are the same sum; with it the table is within 4 %, without it far off."""
    options = ALL_PAIRS | {"cluster_size": 16, "table_resolution": 16}
    plan = method.plan(cloud_scene, camera, **options)
    pixels = np.flatnonzero(image(cloud_scene, camera, **ALL_PAIRS).sum(axis=-1).reshape(-1) > 0)[::3]
    take = lambda a: a.reshape(-1, 3)[pixels]  # noqa: E731
    bare = references.exact_pairs(cloud_scene, camera, plan, pixels, visibility=False, attenuation=False)
    np.testing.assert_allclose(take(image(cloud_scene, camera, **options, transport="none")), bare, rtol=1e-4, atol=1e-8)
    exact = references.exact_pairs(cloud_scene, camera, plan, pixels)
    error = lambda a: np.abs(a - exact).sum() / exact.sum()  # noqa: E731
    assert error(take(image(cloud_scene, camera, **options))) < 0.04
    assert error(bare) > 0.15


def test_gathering_agrees_with_exact_pairs(cloud_scene, camera):
    """A2 has no surfels: the sums over a few rays agree within 3 standard errors and 1 %."""
    plan = method.plan(cloud_scene, camera, **(ALL_PAIRS | {"num_surfels": 2048}))
    pixels = np.flatnonzero(image(cloud_scene, camera, **ALL_PAIRS).sum(axis=-1).reshape(-1) > 0)[::12]
    exact = references.exact_pairs(cloud_scene, camera, plan, pixels)
    mean, error = references.gather(cloud_scene, camera, plan, pixels, num_directions=256)
    spread = np.sqrt(np.sum(error**2)) / mean.sum()
    assert spread < 0.02
    assert abs(exact.sum() / mean.sum() - 1) < 0.01 + 3 * spread


def test_one_compilation_for_two_values(cloud_scene, camera):
    image(cloud_scene, camera)
    before = splatting.splat._cache_size()
    changed = eqx.tree_at(lambda s: s.medium.sigma_s, cloud_scene, 1.3 * cloud_scene.medium.sigma_s)
    image(changed, camera, epsilon=0.05)
    assert splatting.splat._cache_size() == before


def test_plan_says_what_it_skipped(cloud_scene, camera):
    words = " | ".join(method.plan(cloud_scene, camera).skipped)
    assert "phase function is constant" in words and "grey" in words and "no lobes" in words
    general = method.plan(cloud_scene, camera, specialize="structure")
    assert general.phase == "henyey_greenstein" and not general.grey and hash(general)
    assert "closed form" in " ".join(method.plan(eqx.tree_at(lambda s: s.medium, cloud_scene, make_medium()), camera).skipped)


def test_structure_and_values_agree(cloud_scene, camera):
    general = image(cloud_scene, camera, **ALL_PAIRS, specialize="structure")
    np.testing.assert_allclose(general, image(cloud_scene, camera, **ALL_PAIRS), rtol=2e-3, atol=1e-5)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"epsilon": -1.0}, "epsilon = -1.0 is outside"),
        ({"num_levels": 9}, "num_levels = 9 is outside"),
        ({"radius": "linear"}, "radius = 'linear' is unknown"),
        ({"cluster_size": 100}, "cluster_size = 100 must be a power of two"),
        ({"strides": (3, 1, 1, 1, 1, 1)}, "divisor of 16"),
        ({"weights": "paper"}, "right-endpoint"),
    ],
)
def test_bad_options_are_refused(cloud_scene, camera, options, words):
    with pytest.raises(ValueError, match=words):
        method.plan(cloud_scene, camera, **options)


def test_claims():
    (claim,) = method.claims(Scene(mesh=room(), medium=make_medium(density=lumps())))
    assert claim.layers == ("volume_from_surface",) and claim.partial is None
    bent = make_medium(ior=jnp.float32(1.3))
    assert "refractive" in method.claims(Scene(mesh=room(), medium=bent))[0].partial
    assert media.is_grey(bent)


def test_paper_mode_runs_and_is_far_off(cloud_scene, camera):
    """What the formulas of the default buy: the paper's weights and missing attenuation are tens of per cent."""
    paper = dict(weights="paper", position="far", transport="none", blur="paper", radius="paper", tail=False, pattern="paper")
    ours, theirs = image(cloud_scene, camera), image(cloud_scene, camera, **paper)
    assert np.isfinite(theirs).all() and np.abs(theirs - ours).sum() > 0.15 * ours.sum()


def test_first_radius_unit_is_the_mean_lit_radiance(cloud_scene, camera):
    plan = method.plan(cloud_scene, camera, **SMALL)
    cloud, lost = frame.make_surfels(cloud_scene, camera, plan)
    lit, glossy = frame.light_surfels(cloud_scene, cloud, plan, CommonStages(cloud_scene, camera), seed=0)
    area, brightest = np.asarray(lit.area), np.asarray(lit.radiance).max(axis=1)
    np.testing.assert_allclose(frame.mean_radiance(lit), (area * brightest).sum() / area.sum(), rtol=1e-5)
    assert glossy is None and lost == 0
