"""What is skipped is not in the program: operations of the compiled kernels."""

import dataclasses

import jax
import jax.numpy as jnp
import pytest

from jaxvol import direct, interval_map, transmittance
from jaxvol.benchmark.skips import SKIPS
from jaxvol.common_stages import CommonStages
from jaxvol.direct import connections
from jaxvol.methods import path_tracing
from jaxvol.methods.instant_multiple_scattering import gathering
from jaxvol.methods.instant_multiple_scattering.receivers import Points
from jaxvol.methods.instant_multiple_scattering.virtual_lights import VirtualLights
from jaxvol.methods.path_tracing import driver
from jaxvol.methods.path_tracing.flight import mean_medium
from jaxvol.methods.path_tracing.lanes import idle
from jaxvol.methods.path_tracing.step import Work, step
from jaxvol.scene import make_scene
from tests.skips import RAYS, medium_of, operations, plan_of, sides, skip_named, splat_pair


@pytest.mark.parametrize("skip", SKIPS, ids=lambda skip: skip.name)
def test_both_sides_are_scenes_and_the_plans_tell_them_apart(skip):
    """Nothing is skipped in silence: the plan, its list of reasons, or the scene's structure differs."""
    files = list(sides(skip))
    plans = [plan_of(skip, file) for file in files]
    structures = [(jax.tree.structure(f.scene), [x.shape for x in jax.tree.leaves(f.scene)]) for f in files]
    by_value = {"empty space", "empty space, marched", "unlit surfels"}  # found while it runs
    assert plans[0] != plans[1] or structures[0] != structures[1] or skip.name in by_value


def column(medium):
    return operations(lambda m, *rays: transmittance.density_column(m, *rays, num_steps=8), medium, *RAYS)


def test_a_homogeneous_medium_has_no_lookups_and_no_loop():
    homogeneous, grid = column(medium_of()), column(medium_of(jnp.ones((4, 4, 4))))
    assert "gather" in grid and ({"scan", "while"} & set(grid))
    assert not {"gather", "scan", "while"} & set(homogeneous)
    assert sum(homogeneous.values()) < 0.5 * sum(grid.values())


def test_g_0_leaves_the_phase_function_out():
    isotropic = operations(lambda g: splat_pair("isotropic", g), jnp.float32(0.0))
    forward = operations(lambda g: splat_pair("henyey_greenstein", g), jnp.float32(0.0))
    assert sum(isotropic.values()) < 0.8 * sum(forward.values()) and isotropic["mul"] < 0.75 * forward["mul"]
    closed = jax.make_jaxpr(lambda g: splat_pair("isotropic", g))(jnp.float32(0.0)).jaxpr
    assert closed.invars[0] not in {v for e in closed.eqns for v in e.invars if not hasattr(v, "val")}  # g is read by nobody


def test_a_grey_medium_has_one_weight_a_ray():
    def weights(grey):
        medium = medium_of(jnp.ones((4, 4, 4)))
        options = {"num_intervals": 4, "num_steps": 8, "grey": grey}
        return jax.eval_shape(lambda m: interval_map.interval_map(m, *RAYS, **options).weight, medium)

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
