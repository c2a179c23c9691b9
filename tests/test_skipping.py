"""What is skipped is not in the program: operations of the compiled kernels, and gradients where nothing may be skipped."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxvol import interval_map, media, transmittance
from jaxvol.benchmark.skips import SKIPS
from jaxvol.layers import total
from jaxvol.methods.deep_screen_space import kernel
from jaxvol.rendering import load_method, method_arguments, render_scene
from jaxvol.scene import make_scene
from jaxvol.types import Medium

SIZE = {"width": 6, "height": 6}


def skip_named(name):
    return next(skip for skip in SKIPS if skip.name == name)


def sides(skip):
    """Scene files of both sides, small."""
    small = {"resolution": 6, "num_surfels": 64, "num_paths": 8, "samples": 2}
    for config, options in ((skip.present, skip.options), (skip.absent, skip.options | skip.without)):
        options = {key: small.get(key, value) for key, value in options.items()}
        yield make_scene(config | {"camera": config["camera"] | SIZE, "render": {skip.method: options}})


def plan_of(skip, file):
    module = load_method(skip.method)
    return module.plan(file.scene, file.camera, **method_arguments(module, skip.method, file)[0])


@pytest.mark.parametrize("skip", SKIPS, ids=lambda skip: skip.name)
def test_both_sides_are_scenes_and_the_plans_tell_them_apart(skip):
    """Nothing is skipped in silence: the plan, its list of reasons, or the scene's structure differs."""
    files = list(sides(skip))
    plans = [plan_of(skip, file) for file in files]
    structures = [(jax.tree.structure(f.scene), [x.shape for x in jax.tree.leaves(f.scene)]) for f in files]
    by_value = {"empty space", "unlit surfels", "invisible medium", "thin medium"}  # found while it runs
    assert plans[0] != plans[1] or structures[0] != structures[1] or skip.name in by_value


@pytest.mark.parametrize("name", ["albedo 0 of surfaces", "single light"])
def test_pictures_are_equal(name):
    skip = skip_named(name)
    pictures = [np.asarray(total(render_scene(file, method=skip.method).estimate.mean)) for file in sides(skip)]
    assert pictures[1].max() > 0
    assert np.abs(pictures[0] - pictures[1]).sum() <= skip.equal * pictures[1].sum()


def operations(function, *arguments):
    """Names of the primitives in a function's jaxpr, inner ones too, with how often they occur."""
    found = {}

    def walk(jaxpr):
        for equation in jaxpr.eqns:
            found[equation.primitive.name] = found.get(equation.primitive.name, 0) + 1
            for value in jax.tree.leaves(equation.params, is_leaf=lambda x: hasattr(x, "eqns") or hasattr(x, "jaxpr")):
                if hasattr(value, "eqns"):
                    walk(value)
                elif hasattr(value, "jaxpr"):
                    walk(value.jaxpr)

    walk(jax.make_jaxpr(function)(*arguments).jaxpr)
    return found


def medium_of(density=None, g=0.0):
    return Medium(
        bounds=jnp.asarray([[-1.0] * 3, [1.0] * 3]),
        sigma_s=jnp.asarray([1.0, 0.8, 0.6]),
        sigma_a=jnp.asarray([0.1, 0.1, 0.1]),
        g=jnp.float32(g),
        density=density,
        majorants=None if density is None else media.majorants(density),
    )


RAYS = jnp.zeros((4, 3)) - jnp.asarray([2.0, 0.0, 0.0]), jnp.asarray([[1.0, 0.0, 0.0]] * 4), jnp.zeros(4), jnp.full(4, 4.0)


def column(medium):
    return operations(lambda m, *rays: transmittance.density_column(m, *rays, num_steps=8), medium, *RAYS)


def test_a_homogeneous_medium_has_no_lookups_and_no_loop():
    homogeneous, grid = column(medium_of()), column(medium_of(jnp.ones((4, 4, 4))))
    assert "gather" in grid and ({"scan", "while"} & set(grid))
    assert not {"gather", "scan", "while"} & set(homogeneous)
    assert sum(homogeneous.values()) < 0.5 * sum(grid.values())


def splat_pair(phase, *arguments):
    row = dict(zip(kernel.COLUMNS, (0.3, 0.0, 0.0, -0.6, 0.0, 0.8, 0.0, 1e9, 1e-3, 1.0, 1.0, 1.0), strict=True))
    row = {name: jnp.full((1, 1), value) for name, value in row.items()}
    ray = tuple(jnp.full((1, 1), x) for x in (0.0, 0.0, 1.0))
    return kernel.pair_samples(ray, [jnp.ones((1, 1))], row, phase=phase, g=arguments[0] if arguments else None)[0]


def test_g_0_leaves_the_phase_function_out():
    isotropic = operations(lambda g: splat_pair("isotropic", g), jnp.float32(0.0))
    forward = operations(lambda g: splat_pair("henyey_greenstein", g), jnp.float32(0.0))
    assert sum(isotropic.values()) < 0.8 * sum(forward.values()) and isotropic["mul"] < 0.75 * forward["mul"]
    closed = jax.make_jaxpr(lambda g: splat_pair("isotropic", g))(jnp.float32(0.0)).jaxpr
    assert closed.invars[0] not in {v for e in closed.eqns for v in e.invars if not hasattr(v, "val")}  # g is read by nobody


def test_a_grey_medium_has_one_weight_a_ray():
    def weights(grey):
        medium = medium_of(jnp.ones((4, 4, 4)))
        return interval_map.interval_map(medium, *RAYS, num_intervals=4, num_steps=8, grey=grey).weight

    assert weights(True).shape[0] == 1 and weights(False).shape[0] == 4  # one for all intervals, or one for each


def test_cost_analysis_tells_the_homogeneous_medium_cheaper():
    cost = []
    for density in (None, jnp.ones((8, 8, 8))):
        compiled = (
            jax.jit(transmittance.density_column, static_argnames="num_steps")
            .lower(medium_of(density), *RAYS, num_steps=32)
            .compile()
        )
        found = compiled.cost_analysis()
        cost.append((found[0] if isinstance(found, list) else found)["flops"])
    assert cost[0] < 0.2 * cost[1]


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

    slope = np.asarray(jax.grad(red)(jnp.ones(3)))
    assert abs(slope[0]) > 1e-3 and np.all(np.abs(slope[1:]) < 1e-6)  # the others only move the samples
