"""The whole method: exact radiance in an infinite medium, claims, plans, scenes in which nothing happens."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

from jaxvol import camera as pinhole
from jaxvol import layers, media, ray_casting
from jaxvol.common_stages import CommonStages
from jaxvol.methods import instant_multiple_scattering as ims
from jaxvol.methods.instant_multiple_scattering import eye_rays, rendering, stages, upsampling
from jaxvol.methods.instant_multiple_scattering.upsampling import Guides
from jaxvol.methods.instant_multiple_scattering.virtual_lights import LightSet
from jaxvol.types import Mesh, PointLights, Scene
from tests.methods.instant_multiple_scattering.scenes import (
    EXACT,
    floats,
    lit,
    make_camera,
    make_medium,
    radiance_past_the_source,
)

SMALL = {"num_paths": 64, "num_levels": 1, "tile": 64}


def test_infinite_medium():
    """Radiance of light scattered at least twice along a ray past a point source: mean of 40 sets of lights."""
    mean, error = radiance_past_the_source(sets=40, light_stride=1)
    assert error < 0.015 * EXACT
    assert abs(mean - EXACT) < 3.5 * error


def test_claims_are_the_six_layers_of_twice_scattered_light():
    names = [c.name for c in ims.claims(lit(make_medium()))]
    assert sorted(names) == sorted(rendering.NAMES)
    assert all(name in layers.NAMES for name in names)


@pytest.mark.parametrize(
    "options",
    [{"num_paths": 0}, {"light_stride": 3}, {"end": "open"}, {"mean_free_paths": -1.0}, {"visibility": "map"}],
)
def test_plan_refuses(options):
    with pytest.raises(ValueError, match=next(iter(options))):
        ims.plan(lit(make_medium()), make_camera(), **options)


@pytest.mark.parametrize("key", ["ior", "boundary", "inclusions"])
def test_media_that_the_method_cannot_follow_are_refused_in_one_line(key):
    """Bent rays, a mesh around the medium, media inside it: no claims, and a plan says why and what to use instead."""
    ball = Mesh(vertices=floats([0, 0, 0], [1, 0, 0], [0, 1, 0]), faces=jnp.asarray([[0, 1, 2]]), albedo=jnp.ones((1, 3)))
    inside = dataclasses.replace(make_medium(half=0.3), boundary=ball)
    value = {"ior": jnp.float32(1.3), "boundary": ball, "inclusions": (inside,)}[key]
    medium = dataclasses.replace(make_medium(), **{key: value})
    with pytest.raises(ValueError, match=rf"medium\.{key}: .*path_tracing") as refusal:
        ims.plan(lit(medium), make_camera())
    assert "\n" not in str(refusal.value)
    assert ims.claims(lit(medium)) == ()


@pytest.mark.parametrize("kind", ["no light", "albedo 0", "empty grid", "no medium"])
def test_scenes_in_which_nothing_scatters_twice_are_black(kind):
    scene = {
        "no light": Scene(medium=make_medium()),
        "albedo 0": lit(make_medium(sigma_s=(0.0,) * 3)),
        "empty grid": lit(make_medium(density=np.zeros((4, 4, 4)))),
        "no medium": lit(None),
    }[kind]
    camera = make_camera()
    estimate = ims.render(scene, camera, ims.plan(scene, camera, **SMALL))
    assert float(jnp.max(layers.total(estimate.mean))) == 0.0


def test_float_values_share_a_compilation():
    camera = make_camera()
    settings = [lit(make_medium(sigma_s=(s,) * 3, g=0.1 * s)) for s in (0.8, 0.9)]
    plans = [ims.plan(scene, camera, **SMALL) for scene in settings]
    counts = []
    sizes = {"volume_first": 128, "volume_later": 128}
    for scene, plan in zip(settings, plans, strict=True):
        rendering.render_set(scene, camera, plan, seed=1, sizes=sizes)
        counts.append(rendering._volume_at_once._cache_size())
    assert counts[0] == counts[1]


def test_surfaces_light_each_other_without_a_medium():
    """A floor lit by a point light, a wall beside it that the light cannot see: all its light came from the floor."""
    vertices = floats([-1, 0, -1], [1, 0, -1], [1, 0, 1], [-1, 0, 1], [-1, 0, -1.2], [1, 0, -1.2], [1, 1, -1.2], [-1, 1, -1.2])
    mesh = Mesh(
        vertices=vertices,
        faces=jnp.asarray([[0, 2, 1], [0, 3, 2], [4, 5, 6], [4, 6, 7]], jnp.int32),
        albedo=jnp.full((4, 3), 0.5),
    )
    scene = Scene(mesh=mesh, point_lights=PointLights(position=floats([0.0, 1.0, 0.0]), intensity=floats([1.0] * 3)))
    camera = make_camera()
    estimate = ims.render(scene, camera, ims.plan(scene, camera, **SMALL))
    assert float(jnp.mean(estimate.mean.surface_from_surface)) > 0
    assert float(jnp.max(estimate.mean.surface_from_volume)) == 0.0
    assert bool(jnp.all(jnp.isfinite(layers.total(estimate.mean))))


def guides(n, *, end, source):
    ones = jnp.ones(n)
    return Guides(ones, end, ones > 0, ones < 0, jnp.tile(floats([0.0, 0.0, 1.0]), (n, 1)), source, jnp.zeros((n, 3)))


def test_a_constant_source_is_reconstructed_exactly():
    """Radiance of a unit source differs from pixel to pixel; its demodulated value does not."""
    rng = np.random.default_rng(0)
    full = jnp.asarray(rng.uniform(0.1, 1.0, (64, 3)), jnp.float32)
    low = jnp.asarray(rng.uniform(0.1, 1.0, (4, 3)), jnp.float32)
    value = {"volume_from_volume": 2.5 * low}
    built, weight = upsampling.reconstruct(
        value,
        guides(4, end=jnp.ones(4), source=low),
        guides(64, end=jnp.ones(64), source=full),
        height=8,
        width=8,
        factor=4,
    )
    np.testing.assert_allclose(np.asarray(built["volume_from_volume"]), 2.5 * np.asarray(full), rtol=1e-5)
    np.testing.assert_allclose(np.asarray(weight), 1.0, rtol=1e-5)


def test_pixels_unlike_their_neighbours_are_asked_for_again():
    far = jnp.ones(64).at[20].set(5.0)
    ones = jnp.ones((64, 3))
    _, weight = upsampling.reconstruct(
        {"volume_from_volume": jnp.ones((4, 3))},
        guides(4, end=jnp.ones(4), source=jnp.ones((4, 3))),
        guides(64, end=far, source=ones),
        height=8,
        width=8,
        factor=4,
    )
    assert np.flatnonzero(np.asarray(weight) < 0.25).tolist() == [20]


def test_low_resolution_evaluates_fewer_pixels():
    scene, camera = lit(make_medium(sigma_s=(2.0,) * 3), position=(0.0, 2.0, 1.0)), make_camera(16)
    plan = ims.plan(scene, camera, upsample=4, jitter=False, **SMALL)
    estimate = ims.render(scene, camera, plan, seed=2)
    exact = ims.render(scene, camera, dataclasses.replace(plan, upsample=1), seed=2)
    assert int(estimate.diagnostics["num_evaluated"]) < 200
    a, b = (float(jnp.mean(layers.total(e.mean))) for e in (estimate, exact))
    assert a == pytest.approx(b, rel=0.2)


def test_jittered_pixels_weigh_what_lies_behind_them():
    """Mean of the weight times what is seen of a unit source = its mean over the pixel, at the edge of the medium too."""
    scene, camera = lit(make_medium()), make_camera(8)
    n = 4096
    index = jnp.arange(n, dtype=jnp.uint32)
    for corner in ([1.0, 2.0], [0.0, 4.0]):
        xy = jnp.tile(floats(corner), (n, 1))
        places, weight = eye_rays.choose_in_pixel(scene, camera, xy, index, jnp.uint32(3))
        assert bool(jnp.all((places >= xy) & (places <= xy + 1)))

        def source(p):
            rays = pinhole.generate_rays(camera, p)
            t0, t1 = media.box_interval(scene.medium.bounds, rays.origin, rays.direction)
            return 1 - jnp.exp(-(t1 - t0))

        grid = (jnp.stack(jnp.meshgrid(jnp.arange(64), jnp.arange(64)), -1).reshape(-1, 2) + 0.5) / 64
        exact = float(jnp.mean(source(floats(corner) + grid)))
        assert float(jnp.mean(weight * source(places))) == pytest.approx(exact, rel=5e-3)


def lamp_behind_a_board():
    """A bright wall behind a dark board that covers the lower half of the picture, its edge inside a row of pixels."""
    vertices = floats([-9, -9, -2], [9, -9, -2], [9, 9, -2], [-9, 9, -2], [-9, -9, 0], [9, -9, 0], [9, 0.04, 0], [-9, 0.04, 0])
    mesh = Mesh(
        vertices=vertices,
        faces=jnp.asarray([[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]], jnp.int32),
        albedo=jnp.asarray([[0.5] * 3] * 4),
    )
    return lit(make_medium(), mesh=mesh, position=(0.0, 2.0, 0.5))


def test_edges_are_found_where_a_pixel_shows_two_surfaces():
    """The row that the board's edge crosses, not the seams between triangles of one plane; none without surfaces."""
    scene, camera = lamp_behind_a_board(), make_camera(8)
    edges = CommonStages(scene, camera).edge_pixels.reshape(8, 8)
    assert edges[3].all() and np.count_nonzero(edges) == 8
    assert not CommonStages(dataclasses.replace(scene, mesh=None), camera).edge_pixels.any()
    painted = dataclasses.replace(scene.mesh, albedo=scene.mesh.albedo.at[0].set(0.1))  # one triangle of the wall
    assert np.count_nonzero(CommonStages(dataclasses.replace(scene, mesh=painted), camera).edge_pixels) > 8


def test_rays_at_edges_are_averaged_over_their_pixel():
    """Other pixels keep their one ray; a coverage of 0 or 1 becomes its mean over the pixel, without bias."""
    scene, camera = lamp_behind_a_board(), make_camera(8)
    pixels, number = np.arange(64, dtype=np.uint32), 64
    edges = CommonStages(scene, camera).edge_pixels
    pixel, ray, share = eye_rays.lanes(pixels, edges, number)
    assert len(pixel) == 64 + 8 * 63 and np.bincount(pixel)[edges].tolist() == [number] * 8
    plan = ims.plan(scene, camera, edge_rays=number)
    context = stages.Context(scene, ray_casting.caster_for(scene.mesh), LightSet(), None, plan, 1, scene.medium)
    (_, _, t, _, index), weight = eye_rays.through_pixels(context, camera, pixel, ray=ray)
    assert len(np.unique(np.asarray(index))) == len(pixel) and weight == 1.0
    np.testing.assert_allclose(np.bincount(pixel, share), 1.0, rtol=1e-6)
    mean = np.bincount(pixel, share * (np.asarray(t) < 4.5)).reshape(8, 8)  # the board, not the wall
    covered = 0.5 * 8 * 0.04 / (4.0 * np.tan(0.3))  # of the row above the middle
    np.testing.assert_allclose(mean[3], covered, atol=0.02)
    assert np.all(mean[:3] == 0) and np.all(mean[4:] == 1)


def test_rays_at_edges_need_surfaces_jitter_and_every_pixel():
    scene, camera = lamp_behind_a_board(), make_camera(8)
    assert ims.plan(scene, camera).edge_rays == 4
    assert [ims.plan(scene, camera, **off).edge_rays for off in ({"jitter": False}, {"upsample": 2})] == [1, 1]
    assert ims.plan(lit(make_medium()), camera).edge_rays == 1
