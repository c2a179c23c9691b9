"""What a scene does not need is not traced, cast, marched or evaluated: no medium, no surfaces, homogeneous, g = 0,
albedo 0, optically thin. Each test makes the skipped function fail and renders, in a tile size that nothing else compiles."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

from jaxvol import layers, media, phase, ray_casting
from jaxvol.methods import instant_multiple_scattering as ims
from jaxvol.methods.instant_multiple_scattering import compensation, gathering, light_paths, pairs, receivers
from jaxvol.types import Mesh
from tests.methods.instant_multiple_scattering.scenes import floats, lit, make_camera, make_medium

SMALL = {"num_paths": 96, "tile": 96}


def forbid(monkeypatch, module, *names):
    """Calls of these functions fail."""

    def fail(*_, **__):
        raise AssertionError(f"{names} must not be called here")

    for name in names:
        monkeypatch.setattr(module, name, fail)


def corner(color=0.5):
    """A floor and a wall."""
    vertices = floats([-1, -1, -1], [1, -1, -1], [1, -1, 1], [-1, -1, 1], [-1, 1, -1], [1, 1, -1])
    faces = jnp.asarray([[0, 2, 1], [0, 3, 2], [0, 1, 5], [0, 5, 4]], jnp.int32)
    return Mesh(vertices=vertices, faces=faces, albedo=jnp.full((4, 3), color))


def total_of(scene, size, **options):
    camera = make_camera(size)
    plan = ims.plan(scene, camera, **{**SMALL, **options})
    return float(jnp.sum(layers.total(ims.render(scene, camera, plan, seed=1).mean))), plan


def test_no_surfaces_no_rays(monkeypatch):
    forbid(monkeypatch, ray_casting, "intersect", "occluded", "hits")
    total, plan = total_of(lit(make_medium(), position=(0.0, 2.0, 0.0)), 9)
    assert total > 0 and not plan.surface and not plan.costly


def test_homogeneous_no_marching_no_tracking(monkeypatch):
    forbid(monkeypatch, receivers, "columns_along")
    forbid(monkeypatch, media, "majorants")
    forbid(monkeypatch, light_paths, "_track", "_tentative", "_flight_tracked")
    forbid(monkeypatch, compensation, "coarse_density", "block_means")
    total, plan = total_of(lit(make_medium(), position=(0.0, 2.1, 0.0)), 10)
    assert total > 0 and any("homogeneous" in reason for reason in plan.skipped)


def test_isotropic_no_phase_function_in_the_kernels(monkeypatch):
    forbid(monkeypatch, pairs, "henyey_greenstein")
    total, plan = total_of(lit(make_medium(), position=(0.0, 2.2, 0.0)), 11)
    assert total > 0 and plan.isotropic
    forbidden = pytest.raises(AssertionError)
    with forbidden:
        total_of(lit(make_medium(g=0.3), position=(0.0, 2.2, 0.0)), 11)


def test_grey_one_exponential(monkeypatch):
    assert total_of(lit(make_medium(), position=(0.0, 2.2, 0.0)), 9)[1].grey
    assert not total_of(lit(make_medium(sigma_s=(0.8, 0.5, 0.8)), position=(0.0, 2.2, 0.0)), 9)[1].grey


def test_no_medium_no_flights_no_transmittance(monkeypatch):
    forbid(monkeypatch, media, "box_interval", "density", "sigma_t")
    forbid(monkeypatch, phase, "sample", "evaluate")
    forbid(monkeypatch, receivers, "column_between", "sample_transmittance")
    total, plan = total_of(lit(None, mesh=corner(), position=(0.2, 0.3, 0.1)), 12)
    assert total > 0 and not plan.volume and any("no medium" in reason for reason in plan.skipped)


@pytest.mark.parametrize(
    "scene",
    [
        lambda: lit(make_medium(sigma_s=(0.0,) * 3)),
        lambda: lit(make_medium(density=np.zeros((4, 4, 4)))),
        lambda: lit(None),
        lambda: lit(None, mesh=corner(0.0)),
        lambda: dataclasses.replace(lit(make_medium(), mesh=corner()), point_lights=None),
    ],
    ids=["albedo 0", "empty grid", "nothing", "black surfaces alone", "no light"],
)
def test_nothing_to_see_nothing_traced(monkeypatch, scene):
    forbid(monkeypatch, light_paths, "trace", "emit")
    forbid(monkeypatch, ray_casting, "intersect", "occluded")
    assert total_of(scene(), 9)[0] == 0.0


def test_albedo_zero_beside_surfaces_has_no_lights_and_no_gathering_in_the_medium(monkeypatch):
    forbid(monkeypatch, gathering, "gather_segments")
    total, plan = total_of(lit(make_medium(sigma_s=(0.0,) * 3), mesh=corner(), position=(0.2, 0.3, 0.1)), 9)
    assert total > 0 and plan.surface and not plan.volume


def test_optically_thin_or_absorbing_media_need_fewer_compensation_steps():
    """Steps until what the next one would add is below 0.4 %: 0.7 min(0.35, thickness) albedo a step, one at least."""
    camera = make_camera(8)
    levels = lambda s, a: ims.plan(lit(make_medium(sigma_s=(s,) * 3, sigma_a=(a,) * 3)), camera).num_levels  # noqa: E731
    assert levels(3.0, 0.0) == 3
    assert levels(1.5, 1.5) == 2
    assert levels(0.02, 0.0) == 2
    assert levels(0.001, 0.0) == 1
    thin = ims.plan(lit(make_medium(sigma_s=(0.001,) * 3, sigma_a=(0.0,) * 3)), camera)
    assert any("optically thin" in reason and "1 compensation steps" in reason for reason in thin.skipped)
    assert ims.plan(lit(make_medium(sigma_s=(0.001,) * 3), mesh=corner()), camera).num_levels == 3
    assert ims.plan(lit(make_medium(sigma_s=(0.001,) * 3)), camera, specialize="structure").num_levels == 3


def test_skipped_steps_are_not_missed():
    """A thin medium with the planned steps against three: the same picture within the tolerance."""
    scene = lit(make_medium(sigma_s=(0.02,) * 3, sigma_a=(0.0,) * 3), position=(0.0, 0.3, 0.0))
    few, plan = total_of(scene, 8, num_paths=4096, num_direct=32, jitter=False)
    all_steps, _ = total_of(scene, 8, num_paths=4096, num_direct=32, jitter=False, num_levels=3)
    assert plan.num_levels == 2
    assert few == pytest.approx(all_steps, rel=0.01)


def test_what_is_skipped_is_said():
    camera = make_camera(8)
    words = {
        "no surfaces": make_medium(),
        "homogeneous": make_medium(),
        "g = 0": make_medium(),
        "grey": make_medium(),
        "scatters nothing": make_medium(sigma_s=(0.0,) * 3),
        "optically thin": make_medium(sigma_s=(0.01,) * 3, sigma_a=(0.0,) * 3),
    }
    for word, medium in words.items():
        assert any(word in reason for reason in ims.plan(lit(medium), camera).skipped), word
    assert any("no medium" in reason for reason in ims.plan(lit(None), camera).skipped)
