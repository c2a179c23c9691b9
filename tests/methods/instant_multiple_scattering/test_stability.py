"""The specification's stability table (section 7): every pitfall has a test here or, where it says so, elsewhere.

Light on the shading point, value and gradient: `test_gathering`. HG at g -> 1, 0 and negative: `test_pairs`. Truncated
paths at albedo 1, empty grids: `test_light_paths`.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxvol import layers, sampling
from jaxvol.methods import instant_multiple_scattering as ims
from jaxvol.methods.instant_multiple_scattering import compensation, light_paths, pairs, rendering
from tests.methods.instant_multiple_scattering.scenes import floats, lit, make_camera, make_medium

SMALL = {"num_paths": 64, "num_levels": 2, "num_chains": 1, "num_direct": 1, "tile": 64}


@pytest.mark.parametrize(
    ("kind", "settings"),
    [
        ("peaked", {"g": 0.95}),
        ("backwards", {"g": -0.9}),
        ("albedo 1", {"sigma_s": (2.0,) * 3, "sigma_a": (0.0,) * 3}),
        ("no extinction", {"sigma_s": (0.0,) * 3, "sigma_a": (0.0,) * 3}),
        ("nearly none", {"sigma_s": (1e-9,) * 3, "sigma_a": (0.0,) * 3}),
        ("thick", {"sigma_s": (300.0,) * 3, "sigma_a": (100.0,) * 3}),
        ("one channel", {"sigma_s": (3.0, 0.0, 0.0), "sigma_a": (0.0, 0.1, 50.0)}),
        ("empty grid", {"density": np.zeros((4, 4, 4))}),
        ("one voxel", {"density": np.eye(4)[0][:, None, None] * np.eye(4)[1][None, :, None] * np.eye(4)[2]}),
    ],
)
@pytest.mark.parametrize("position", [(0.0, 0.0, 0.0), pytest.param((1.0, 1.0, 1.0), marks=pytest.mark.slow)])
def test_pictures_stay_finite(kind, settings, position):
    """The light in the medium's middle, and on a corner of its box; layers are finite and not negative."""
    scene, camera = lit(make_medium(**settings), position=position), make_camera(8)
    plan = ims.plan(scene, camera, **SMALL, max_depth=64)
    with jax.debug_nans(True):
        estimate = ims.render(scene, camera, plan, seed=2)
    total = np.asarray(layers.total(estimate.mean))
    assert np.all(np.isfinite(total)) and total.min() >= 0.0
    if kind in ("no extinction", "empty grid"):
        assert total.max() == 0.0
    elif kind != "thick":  # nothing comes through a thickness of 400
        assert total.max() > 0.0


def test_albedo_one_keeps_its_energy():
    """Every path ends by leaving: an albedo-1 medium sends out what comes in, so weights stay 1 / num_paths each."""
    scene = lit(make_medium(sigma_s=(2.0,) * 3, sigma_a=(0.0,) * 3))
    vertices, counts = light_paths.trace(scene, None, seed=1, paths=np.arange(256), max_depth=256)
    assert counts["num_truncated"] == 0
    power = vertices.incident * np.asarray(scene.medium.sigma_s)  # W of each collision
    np.testing.assert_allclose(power, power[0, 0], rtol=1e-3)


def test_uniforms_never_make_a_logarithm_infinite():
    u = np.concatenate(sampling.uniforms(jnp.uint32(1), 7, jnp.arange(1 << 16, dtype=jnp.uint32), 0))
    assert u.min() > 0.0 and u.max() < 1.0
    flights = np.asarray(sampling.sample_exponential(jnp.asarray(u), jnp.float32(1.0)))
    assert np.all(np.isfinite(flights)) and flights.max() < 25


def test_truncated_exponential_keeps_its_limit():
    d = jnp.float32(0.3)
    t = compensation.sample_distance_exponential(floats(0.25, 0.5), d, jnp.float32(1e-9))
    np.testing.assert_allclose(np.asarray(t), [0.075, 0.15], rtol=1e-5)
    assert np.all(np.asarray(t) > 0)


def test_residual_vanishes_with_the_clamp_distance():
    """b -> inf: nothing is clamped and nothing compensated; b -> 0: everything is residual, and it is finite."""
    scene, camera = lit(make_medium(), position=(0.0, 2.0, 0.0)), make_camera(8)
    totals = {}
    for number in (1e-4, 1e4):
        plan = ims.plan(scene, camera, **SMALL, mean_free_paths=number)
        bare = ims.plan(scene, camera, **{**SMALL, "num_levels": 0}, mean_free_paths=number)
        images = [rendering.render_set(scene, camera, p, seed=4)[0] for p in (plan, bare)]
        totals[number] = [float(sum(x.values()).mean()) for x in images]
    assert totals[1e-4][0] == pytest.approx(totals[1e-4][1], rel=1e-3)
    assert totals[1e4][1] < 0.7 * totals[1e4][0]  # the clamped part of everything within the box
    assert np.isfinite(totals[1e4][0])


def test_gradients_through_sampling_are_finite_at_the_edges():
    def value(h2, clamp):
        t, weight = pairs.sample_along_ray(jnp.float32(0.3), jnp.float32(-1.0), jnp.float32(1.0), h2, clamp)
        return t + weight

    for h2 in (0.0, 1e-12, 1.0):
        gradients = jax.grad(value, argnums=(0, 1))(jnp.float32(h2), jnp.float32(0.2))
        assert all(bool(jnp.isfinite(x)) for x in gradients)


def test_lights_and_levels_that_scenes_do_not_need_are_skipped():
    """Static flags of the skip list: no medium, no surfaces, homogeneous, g = 0, albedo 0, optically thin."""
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
    plan = ims.plan(lit(make_medium(g=0.5)), camera)
    assert not plan.isotropic and not plan.costly and plan.grey
