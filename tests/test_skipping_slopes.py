"""Gradients where nothing may be skipped: those of the program that has the stage."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxvol import direct, first_hit, interval_map, materials
from jaxvol.common_stages import CommonStages
from jaxvol.direct import surface
from jaxvol.methods import lattice_boltzmann
from jaxvol.methods.deep_screen_space import kernel
from jaxvol.methods.instant_multiple_scattering import picking
from jaxvol.methods.instant_multiple_scattering.receivers import Points
from jaxvol.methods.instant_multiple_scattering.virtual_lights import VirtualLights
from jaxvol.methods.lattice_boltzmann import illumination, marching
from jaxvol.scene import make_scene
from tests.skips import RAYS, SIZE, medium_of, plan_of, sides, skip_named, splat_pair


def test_gradients_under_structure_are_those_of_differences():
    """At g = 0 the general kernel knows d/dg = 3 cos p; the one without a phase function would say 0."""

    def value(g):
        scale = kernel.phase_scale("henyey_greenstein", g)
        return jnp.sum(scale * splat_pair("henyey_greenstein", g))

    slope = float(jax.grad(value)(jnp.float32(0.0)))
    step = 1e-2
    difference = (float(value(jnp.float32(step))) - float(value(jnp.float32(-step)))) / (2 * step)
    assert abs(slope) > 1e-4 and slope == pytest.approx(difference, rel=1e-2)
    same = float(jnp.sum(kernel.phase_scale("isotropic", 0.0) * splat_pair("isotropic")))
    assert float(value(jnp.float32(0.0))) == pytest.approx(same, rel=1e-6)


def test_gradients_of_equal_channels_stay_apart():
    """A grey medium whose red is changed: the program for three channels has a gradient for each."""
    density = jnp.ones((4, 4, 4))

    def red(sigma_s):
        medium = medium_of(density)
        object.__setattr__(medium, "sigma_s", sigma_s)
        found = interval_map.interval_map(medium, *RAYS, num_intervals=4, num_steps=8, grey=False)
        return jnp.sum(found.weight[:, 0])

    slope = np.asarray(jax.jit(jax.jacfwd(red))(jnp.ones(3)))
    assert abs(slope[0]) > 1e-3 and np.all(np.abs(slope[1:]) < 1e-6)  # the others only move the samples


def test_gradients_by_an_albedo_of_0_are_those_of_a_grey_one():
    """Under "structure" black surfaces are asked: light of one reflection is linear in the albedo."""
    skip = skip_named("albedo 0 of surfaces")
    file = make_scene(skip.present | {"camera": skip.present["camera"] | SIZE})
    assert direct.plan(file.scene, file.camera, specialize="structure").surface
    rays = CommonStages(file.scene, file.camera).center_rays
    hits = first_hit.first_hits(file.scene, rays, CommonStages(file.scene, file.camera).caster)

    def light(albedo):
        scene = eqx.tree_at(lambda s: s.mesh.albedo, file.scene, jnp.full_like(file.scene.mesh.albedo, albedo))
        pixel = jnp.arange(36, dtype=jnp.uint32)
        args = scene, None, None, rays.direction, hits, pixel, jnp.zeros_like(pixel), jnp.uint32(0)
        return jnp.sum(surface.connect(*args, kind="point", num_light=1, num_bsdf=0).value)

    value, slope = jax.jit(jax.value_and_grad(light))(jnp.float32(0.0))
    assert float(value) == 0.0 and float(slope) > 0
    assert float(slope) == pytest.approx(float(light(jnp.float32(1.0))), rel=1e-5)


def test_gradients_by_an_albedo_of_0_reach_the_picks_of_virtual_lights():
    """Lights are picked by what they send; a black receiver, for which all of them send nothing, picks all the same."""
    rng = np.random.default_rng(0)
    position = jnp.asarray(rng.random((8, 3)), jnp.float32)
    up, ones = jnp.asarray([[0.0, 1.0, 0.0]] * 8), jnp.ones((8, 3))
    above = VirtualLights(position + 2.0 * up, -up, ones, -up)
    medium = medium_of()

    def light(albedo):
        walls = materials.Surface(albedo=albedo * ones)
        points = Points(position, up, 0.0 * ones, jnp.full(8, 0.1), jnp.ones(8, bool), up, walls)
        picks = picking.pick_for_points(points, position[:, 0], above, medium, num_groups=2, isotropic=True)
        same = {"isotropic": True, "num_steps": 4}
        return jnp.sum(picking.evaluate_points(points, picks, None, None, above, medium, medium, **same))

    found = jax.jit(jax.value_and_grad(light))
    (value, slope), (bright, _) = found(jnp.float32(0.0)), found(jnp.float32(0.5))
    assert float(value) == 0.0 and float(slope) == pytest.approx(2.0 * float(bright), rel=1e-4) and bright > 0


def test_gradients_by_an_index_of_1_bend_rays():
    """A grid of index 1 under "structure" is marched as any index: positions move by what differences say."""
    skip = skip_named("no refraction")
    file = list(sides(skip))[1]
    plan = plan_of(skip, file)
    advance = marching.STEPS[plan.integrator]
    bump = jnp.asarray(np.random.default_rng(0).random((6, 6, 6)), jnp.float32)
    start, ahead = jnp.asarray([[0.5, 2.6, 2.2]]), jnp.asarray([[1.0, 0.0, 0.0]])

    def end(amount):
        index = 1.0 + amount * bump
        table = marching.corner_table(*jnp.gradient(0.5 * index * index), index)

        def body(_, state):
            position, momentum, n = state
            found = advance(lambda x: marching.interpolate(table, bump.shape, x), position, momentum, n, plan.march_step)
            return found[:3]

        position, _, _ = jax.lax.fori_loop(0, 6, body, (start, ahead, jnp.ones(1)))
        return position[0, 1:]  # across the ray

    found = jax.jit(lambda amount: jax.jvp(end, (amount,), (jnp.float32(1.0),)))
    _, slope = found(jnp.float32(0.0))
    high, low = (found(jnp.float32(a))[0] for a in (1e-2, -1e-2))
    assert plan.refract and float(jnp.max(jnp.abs(slope))) > 0.1
    np.testing.assert_allclose(slope, (high - low) / 2e-2, rtol=2e-2, atol=1e-3)


def test_gradients_by_a_scattering_of_0_are_those_of_light_scattered_once():
    """Under "structure" the lattice is solved where nothing scatters: the slope is the light that a little scattering makes."""
    skip = skip_named("albedo 0 of the medium")
    file = list(sides(skip))[0]
    options = {"resolution": 4, "lattice": "paper", "preconditioned": False, "specialize": "structure"}
    plan = lattice_boltzmann.plan(file.scene, file.camera, **options)
    assert plan.solve
    track = jnp.asarray(np.random.default_rng(0).random((4, 4, 4)), jnp.float32)

    def light(sigma):
        scattering, absorption = jnp.full((4, 4, 4), sigma), jnp.full((4, 4, 4), 0.1)
        solution = illumination.solve_channel(scattering, absorption, sigma * track, None, 0.0, 1e-6, plan=plan)
        return jnp.sum(track * solution.phi)

    found = jax.jit(lambda sigma: jax.jvp(light, (sigma,), (jnp.float32(1.0),)))
    (dark, slope), (little, _) = found(jnp.float32(0.0)), found(jnp.float32(1e-3))
    assert float(dark) == 0.0 and float(slope) > 0
    assert float(slope) == pytest.approx(float(little) / 1e-3, rel=1e-2)
