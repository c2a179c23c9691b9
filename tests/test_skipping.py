"""What is skipped is not in the program: operations of the compiled kernels, and gradients where nothing may be skipped."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxvol import direct, interval_map, media, transmittance
from jaxvol.benchmark.skips import SKIPS
from jaxvol.common_stages import CommonStages
from jaxvol.direct import connections
from jaxvol.layers import total
from jaxvol.methods import path_tracing
from jaxvol.methods.deep_screen_space import kernel
from jaxvol.methods.instant_multiple_scattering import gathering
from jaxvol.methods.instant_multiple_scattering.receivers import Points
from jaxvol.methods.instant_multiple_scattering.virtual_lights import VirtualLights
from jaxvol.methods.path_tracing import driver
from jaxvol.methods.path_tracing.flight import mean_medium
from jaxvol.methods.path_tracing.lanes import idle
from jaxvol.methods.path_tracing.step import Work, step
from jaxvol.rendering import assign, load_method, method_arguments, render_scene
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
        yield make_scene(config | {"camera": config["camera"] | SIZE, "render": skip.render(options)})


def plan_of(skip, file):
    if skip.method == "auto":
        return assign(file, automatic=True)
    module = load_method(skip.method)
    return module.plan(file.scene, file.camera, **method_arguments(module, skip.method, file)[0])


@pytest.mark.parametrize("skip", SKIPS, ids=lambda skip: skip.name)
def test_both_sides_are_scenes_and_the_plans_tell_them_apart(skip):
    """Nothing is skipped in silence: the plan, its list of reasons, or the scene's structure differs."""
    files = list(sides(skip))
    plans = [plan_of(skip, file) for file in files]
    structures = [(jax.tree.structure(f.scene), [x.shape for x in jax.tree.leaves(f.scene)]) for f in files]
    by_value = {"empty space", "unlit surfels"}  # found while it runs
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


def step_operations(file, *, num_lanes=64):
    """Of the path tracer's step: what one turn of all lanes computes."""
    plan = path_tracing.plan(file.scene, file.camera)
    scene = dataclasses.replace(file.scene, medium=None) if plan.drop_medium else file.scene
    settings = plan.settings
    lanes = idle(
        num_lanes,
        groups=plan.groups,
        num_shadows=plan.num_shadows,
        tracked=settings.tracked,
        equiangular=settings.equiangular,
    )
    work = Work(jnp.uint32(0), jnp.uint32(36), jnp.uint32(0), jnp.int32(0), 36)
    proxy = mean_medium(scene.medium) if settings.equiangular else None

    def one(scene, lanes):
        return step(scene, proxy, file.camera, settings, jnp.uint32(0), lanes, driver.no_casts(lanes), work)[0]

    return operations(one, scene, lanes)


@pytest.mark.parametrize(
    ("name", "gone", "share"),
    [
        ("no medium", {"log", "log1p"}, 0.6),  # free flights
        ("no surfaces", set(), 0.9),
        ("homogeneous, traced", {"while", "scan"}, None),  # tracking; closed forms and two connections take its place
    ],
)
def test_the_path_tracers_step_lacks_what_the_scene_lacks(name, gone, share):
    ours, theirs = (step_operations(file) for file in sides(skip_named(name)))
    assert not gone & set(ours) and (not gone or gone & set(theirs))
    if share is not None:
        assert sum(ours.values()) < share * sum(theirs.values())


def test_virtual_lights_without_a_phase_function():
    points, lights = 8, 4
    args = Points(*(jnp.ones((points, 3)) for _ in range(3)), jnp.ones(points))
    sent = VirtualLights(*(jnp.ones((lights, 3)) for _ in range(3)))
    counts = [
        operations(lambda m, i=isotropic: gathering.gather_points(args, sent, m, grey=True, isotropic=i), medium_of())
        for isotropic in (True, False)
    ]
    assert sum(counts[0].values()) < 0.9 * sum(counts[1].values())


@pytest.mark.parametrize(
    ("name", "field", "values"),
    [
        ("albedo 0 of surfaces", "surface", (False, True)),
        ("albedo 0 of the medium", "solve", (False, True)),
        ("grey, lattice", "num_channels", (1, 3)),
        ("no refraction", "refract", (False, True)),
        ("zero-size bounce", "surface", (False, True)),
        ("g = 0, virtual lights", "isotropic", (True, False)),
        ("grey", "grey", (True, False)),
    ],
)
def test_stages_that_a_plan_leaves_out(name, field, values):
    """A static choice: no stage, channel or factor of the other program is called; under "structure" none is left out."""
    skip = skip_named(name)
    files = list(sides(skip))
    assert tuple(getattr(plan_of(skip, file), field) for file in files) == values
    kept = plan_of(skip, make_scene(skip.present | {"render": skip.render(skip.options | {"specialize": "structure"})}))
    assert getattr(kept, field) == values[1] or name == "no refraction"  # what the scene does not have stays out


def test_one_light_is_one_turn_and_no_surface_no_ray():
    turns = []
    for file in sides(skip_named("single light")):
        plan = direct.plan(file.scene, file.camera)
        turns.append(len(connections.light_runs(file.scene, None, plan, None, None)))
    assert turns == [1, 2]
    bare, walled = sides(skip_named("no surfaces, direct"))
    assert CommonStages(bare.scene, bare.camera).caster is None and CommonStages(walled.scene, walled.camera).caster is not None
