"""Choosing lights: proportions, no change of the mean, fewer lights with less noise than as many paths give."""

import jax.numpy as jnp
import numpy as np
import pytest

from jaxvol import ray_casting
from jaxvol.methods import instant_multiple_scattering as ims
from jaxvol.methods.instant_multiple_scattering import rendering, selection, virtual_lights
from jaxvol.types import Mesh
from tests.methods.instant_multiple_scattering.scenes import floats, lit, make_camera, make_medium


def floor():
    """A floor below the medium's middle and a wall behind it, glossy."""
    vertices = floats([-1, -0.9, -1], [1, -0.9, -1], [1, -0.9, 1], [-1, -0.9, 1], [-1, 1, -1], [1, 1, -1])
    faces = jnp.asarray([[0, 2, 1], [0, 3, 2], [0, 1, 5], [0, 5, 4]], jnp.int32)
    shiny = {"specular": jnp.full((4, 3), 0.2), "exponent": jnp.full(4, 8.0)}
    return Mesh(vertices=vertices, faces=faces, albedo=jnp.full((4, 3), 0.5), **shiny)


SCENES = {
    "homogeneous": lambda: lit(make_medium(sigma_s=(2.0,) * 3), position=(1.5, 1.8, 1.2)),
    "coloured grid": lambda: lit(
        make_medium(sigma_s=(4.0, 2.0, 1.0), g=0.5, density=np.random.default_rng(0).uniform(0, 1, (6, 6, 6)))
    ),
    "surfaces": lambda: lit(make_medium(), position=(0.3, 0.4, 0.2), mesh=floor()),
    "surfaces alone": lambda: lit(None, position=(0.3, 0.4, 0.2), mesh=floor()),
}


def test_systematic_choice_is_proportional():
    """Every row comes floor or ceil of its share times; its mean count over the starting point is its share."""
    weight = np.random.default_rng(1).uniform(0.01, 1.0, 57)
    starts = (np.arange(2000) + 0.5) / 2000
    counts = np.array([np.bincount(selection.systematic(weight, 20, u), minlength=57) for u in starts])
    share = 20 * weight / weight.sum()
    assert np.all((counts >= np.floor(share)) & (counts <= np.ceil(share)))
    np.testing.assert_allclose(counts.mean(axis=0), share, atol=2e-3)


@pytest.mark.parametrize("name", list(SCENES))
def test_strength_is_kept_on_average(name):
    """Sum of strength times a function of position over the chosen lights = over all, within 3.5 standard errors."""
    scene, camera = SCENES[name](), make_camera(8)
    caster = ray_casting.caster_for(scene.mesh)
    plan = ims.plan(scene, camera, num_paths=1024, max_lights=128)
    lights, _ = rendering.trace_lights(scene, caster, plan, seed=1)

    def moments(found):
        parts = [np.asarray(b.strength * (1.0 + b.position[:, :1] ** 2)) for _, b in virtual_lights.blocks(found)]
        return np.concatenate(parts).sum(axis=0, dtype=np.float64)

    chosen = [selection.select(scene, caster, camera, lights, plan, seed=k) for k in range(24)]
    assert max(virtual_lights.num_lights(c) for c in chosen) < 0.7 * virtual_lights.num_lights(lights)
    values, exact = np.array([moments(c) for c in chosen]), moments(lights)
    error = values.std(axis=0, ddof=1) / np.sqrt(len(values))
    assert np.all(error < 0.05 * exact)
    assert np.all(np.abs(values.mean(axis=0) - exact) < 3.5 * error)


@pytest.mark.parametrize("name", list(SCENES))
def test_every_light_may_be_chosen(name):
    scene, camera = SCENES[name](), make_camera(8)
    caster = ray_casting.caster_for(scene.mesh)
    plan = ims.plan(scene, camera, num_paths=256, max_lights=64)
    lights, _ = rendering.trace_lights(scene, caster, plan, seed=1)
    rows = selection.pilots(scene, caster, camera, seed=1)
    for _, block in virtual_lights.blocks(lights):
        weight = selection.importance(scene, camera, rows, block, jnp.float32(0.1), isotropic=plan.isotropic)
        assert bool(jnp.all(jnp.isfinite(weight))) and float(jnp.max(weight)) > 0


@pytest.mark.parametrize("name", ["surfaces"])
def test_pictures_of_chosen_lights_are_finite(name):
    scene, camera = SCENES[name](), make_camera(8)
    small = {"num_levels": 1, "num_chains": 1, "num_direct": 1, "tile": 64}
    plan = ims.plan(scene, camera, num_paths=1024, max_lights=64, **small)
    images, counts = rendering.render_set(scene, camera, plan, seed=2)
    assert counts["num_lights"] < counts["num_traced"]
    assert np.isfinite(sum(images.values())).all()


def test_chosen_lights_are_worth_more():
    """128 lights chosen from 2048 paths against the 128 or so of 96 paths: a fifth of the variance or less."""
    scene, camera = SCENES["homogeneous"](), make_camera(8)
    noise = {}
    for name, options in {"all": {"num_paths": 96}, "chosen": {"num_paths": 2048, "max_lights": 128}}.items():
        plan = ims.plan(scene, camera, num_levels=0, tile=64, **options)
        sizes = {}
        runs = np.array([sum(rendering.render_set(scene, camera, plan, seed=k, sizes=sizes)[0].values()) for k in range(12)])
        noise[name] = np.mean(runs.var(axis=0, ddof=1) / runs.mean(axis=0) ** 2)
    assert noise["chosen"] < 0.2 * noise["all"]


def test_few_lights_stay_as_they_are():
    scene, camera = SCENES["homogeneous"](), make_camera(8)
    plan = ims.plan(scene, camera, num_paths=16, max_lights=4096)
    lights, _ = rendering.trace_lights(scene, None, plan, seed=1)
    assert selection.select(scene, None, camera, lights, plan, seed=1) is lights
    with pytest.raises(ValueError, match="max_lights"):
        ims.plan(scene, camera, max_lights=3)


def test_kinds_of_like_number_share_a_size():
    """Both in the medium, both on surfaces: one program instead of two, unless one kind would take much from the other."""
    counts = {"volume_first": 200, "volume_later": 390, "surface_first": 100, "surface_later": 310}
    sizes = selection.even_counts(counts)
    assert sizes["volume_first"] == sizes["volume_later"] == virtual_lights.capacity(295)
    assert sizes["surface_first"] == virtual_lights.capacity(100) < sizes["surface_later"] == virtual_lights.capacity(310)
    assert selection.even_counts({"volume_first": 70}) == {"volume_first": virtual_lights.capacity(70)}
