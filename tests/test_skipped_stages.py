"""What is skipped is not run: stages that are not called, and those that are called with less.

A render is stopped where it comes to a stage, and that stage is traced with what it was to be called with.
"""

from functools import partial

import jax.numpy as jnp
import numpy as np
import pytest

from jaxvol.common_stages import CommonStages
from jaxvol.direct import sky_field
from jaxvol.layers import total
from jaxvol.methods.deep_screen_space import kernel, splatting
from jaxvol.methods.deep_screen_space.camera_rays import map_rays
from jaxvol.methods.instant_multiple_scattering import rendering, stages
from jaxvol.methods.instant_multiple_scattering.light_paths import Vertices
from jaxvol.methods.instant_multiple_scattering.virtual_lights import blocks, virtual_lights
from jaxvol.methods.lattice_boltzmann import illumination, marching, solver
from jaxvol.methods.lattice_boltzmann import materials as voxels
from jaxvol.rendering import render_scene
from jaxvol.stress import gradients
from tests.skips import Reached, calls_of, prepared, program, reached, sides, skip_named


def light_march(monkeypatch, scene, plan):
    """(name, primitives) of the first round of light rays in a lattice's render."""
    stages = {"_straight_round": (1, 2), "_bent_round": (2, 4)}
    whole = {name: getattr(marching, name) for name in stages}
    with monkeypatch.context() as patch:
        calls = {name: calls_of(patch, marching, name) for name in stages}
        name = reached(lambda: illumination.illuminate(scene, plan))
    return name, program(whole[name], calls[name][0][0], statics=stages[name])


def test_a_grey_lattice_marches_and_solves_one_channel(monkeypatch):
    """One field of track and one exponential a step instead of three, one solve."""
    found = []
    for scene, _, plan in prepared(skip_named("grey, lattice")):
        name, march = light_march(monkeypatch, scene, plan)
        assert name == "_straight_round"
        found.append((march["scatter-add"], march["expm1"], len(solved(monkeypatch, scene, plan))))
    assert [b / a for a, b in zip(*found, strict=True)] == [3, 3, 3]


def solved(monkeypatch, scene, plan):
    """Calls of the lattice's solve, one a channel; the marched light is made up."""
    with monkeypatch.context() as patch:

        def marched(materials, plan, rays, power, seed, blocks):
            ones = jnp.ones_like(materials.scattering)
            books = [np.zeros(plan.num_channels)] * 3
            return illumination._Light(ones, *books, 0, None, None)

        patch.setattr(illumination, "march", marched)
        patch.setattr(illumination, "solve_channel", lambda *args, **_: _nothing_solved(args[2]))
        patch.setattr(illumination, "fine_transport", lambda extinction, source, kind: jnp.zeros_like(source))
        calls = calls_of(patch, illumination, "_channel", ends=False)
        illumination.illuminate(scene, plan)
    return calls


def _nothing_solved(deposit):
    zero = jnp.zeros_like(deposit)
    return solver.Solution(zero, zero, jnp.int32(0), jnp.float32(0.0), jnp.asarray(True))


def test_a_medium_of_albedo_0_has_no_lattice(monkeypatch):
    ours, theirs = (solved(monkeypatch, scene, plan) for scene, _, plan in prepared(skip_named("albedo 0 of the medium")))
    assert not ours and theirs


def test_without_an_index_rays_are_straight(monkeypatch):
    """No index, no gradient of it among the voxels' fields, no interpolation in the march."""
    (scene, _, plan), (bent, _, curved) = prepared(skip_named("no refraction"))
    (name, ours), (other, theirs) = (light_march(monkeypatch, *side) for side in ((scene, plan), (bent, curved)))
    assert (name, other) == ("_straight_round", "_bent_round")
    assert ours["gather"] == 1 and theirs["gather"] >= 8 and "rsqrt" in theirs and "rsqrt" not in ours
    fields = [
        voxels.build(s.medium, voxels.make_grid(s.medium, resolution=6), num_channels=1, filter_width=1.0)
        for s in (scene, bent)
    ]
    assert fields[0].ior is None and fields[0].gradient is None and fields[1].gradient.shape[0] == 3


def test_surfels_that_send_nothing_are_no_rows_of_the_splat(monkeypatch):
    """The same program over fewer surfels; those that are left send all the light."""
    calls = calls_of(monkeypatch, splatting, "splat")
    for file in sides(skip_named("unlit surfels"), num_surfels=600):
        assert reached(partial(render_scene, file, method="deep_screen_space")) == "splat"
    ours, theirs = (args[1].row for args, _ in calls)
    first = kernel.COLUMNS.index("red")
    assert ours.size < 0.75 * theirs.size
    assert float(jnp.sum(ours[..., first:])) == pytest.approx(float(jnp.sum(theirs[..., first:])), rel=1e-4) != 0


def test_rays_that_show_no_medium_are_no_rays_of_the_splat():
    """Of a picture's rays those that cross some density; those that are left show all of it."""
    found = []
    for scene, camera, plan in prepared(skip_named("invisible medium"), size={"width": 32, "height": 32}):
        active = map_rays(scene, camera, plan, CommonStages(scene, camera), seed=0)
        shown = np.asarray(active.map.one_minus_transmittance)[:, : active.num_rays]
        found.append((len(active.direction), float(shown.sum())))
    (ours, opacity), (theirs, same) = found
    assert ours < 0.5 * theirs and opacity == pytest.approx(same, rel=1e-2) and opacity > 0


def test_a_field_of_the_sky_ends_where_the_medium_does(monkeypatch):
    """Sweeps get the filled part of the grid alone."""
    sizes = []

    def sweeps(backend):
        def sweep(medium, sweeps, density, eyes, *, grey):
            sizes.append(density.size)
            raise Reached("sweep")

        return sweep

    monkeypatch.setattr(sky_field, "_jitted_sweep", sweeps)
    for file in sides(skip_named("empty space")):
        assert reached(partial(render_scene, file, method="direct")) == "sweep"
    assert sizes[0] < 0.3 * sizes[1]


def test_black_surfaces_have_no_virtual_lights_and_no_bounce_to_the_eye(monkeypatch):
    """A bounce of size zero: vertices of light paths on black walls become no lights, and no kernel asks for their light."""
    monkeypatch.setattr(rendering, "_volume", lambda context, origin, *_: stages.zero_sums(len(origin)))
    calls = calls_of(monkeypatch, rendering, "_surface")
    face, row = np.array([0, 1, -1, -1], np.int32), np.arange(4, dtype=np.int32)
    vector, number, flag = np.ones((4, 3), np.float32), np.ones(4, np.float32), np.ones(4, bool)
    vertices = Vertices(row, 0 * row, vector, vector, vector, face, number, vector, vector, flag, flag)
    ends, kinds = [], []
    for scene, _, plan in prepared(skip_named("zero-size bounce")):
        lights = virtual_lights(scene, vertices, num_paths=4)
        kinds.append([kind for kind, _ in blocks(lights)])
        context = stages.Context(scene, None, lights, None, plan, 0, scene.medium)
        ends.append(reached(partial(rendering.gather_rays, context, vector, vector, number, face, row)))
    assert ends == [None, "_surface"] and len(calls) == 1
    assert kinds == [["volume_first"], ["volume_first", "surface_first"]]


@pytest.mark.parametrize(("name", "gone"), [("albedo 0 of surfaces", {"direct.surface.connect"}), ("single light", set())])
def test_pictures_are_equal_by_fewer_stages(name, gone):
    """Compiled stages that run on one side alone: those of what is skipped."""
    skip = skip_named(name)
    pictures, ran = [], []
    for file in sides(skip):
        with gradients.recording() as stages:
            pictures.append(np.asarray(total(render_scene(file, method=skip.method).estimate.mean)))
        ran.append({stage.name for stage in stages.values()})
    assert pictures[1].max() > 0
    assert np.abs(pictures[0] - pictures[1]).sum() <= skip.equal * pictures[1].sum()
    assert ran[0] <= ran[1] and gone <= ran[1] - ran[0]
