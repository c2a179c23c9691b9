"""Composites: who computes what, what is refused, and that the sum is the sum of what each method gives alone."""

from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np
import pytest

from jaxvol import composite, costs, layers, rendering
from jaxvol.common_stages import CommonStages
from jaxvol.layers import Claim
from jaxvol.scene import make_scene
from jaxvol.types import Estimate

CAMERA = {"origin": [0, 1, 4.0], "target": [0, 1, 0], "width": 12, "height": 8}
LAMP = {"kind": "point", "position": [0.3, 1.7, 0.4], "intensity": 2}
FOG = {"bounds": [[-1, 0, -1], [1, 2, 1]], "scattering": 0.5, "absorption": 0.05}
FLOOR = {"mesh": "builtin:plane"}
SUM = "volume_from_light+volume_from_volume+volume_from_multiple"


def scene_file(render=None, **changes):
    table = {"camera": CAMERA, "medium": FOG, "shapes": [FLOOR], "lights": [LAMP], "render": render or {}} | changes
    return make_scene({key: value for key, value in table.items() if value is not None})


def claims_from(**claims):
    """A `claims_of` from layer names by method; a trailing ! makes a claim partial."""
    return lambda name: tuple(
        Claim(tuple(x.rstrip("!").split("+")), "half of it" if x.endswith("!") else None) for x in claims.get(name, ())
    )


def from_table(table, claims, **options):
    return composite.from_table(table, scene_file().scene, claims, **options)


def test_the_table_names_every_method_once_and_what_nobody_computes():
    claims = claims_from(a=("emission", "surface_from_light"), b=("volume_from_light",))
    found = from_table({"surface_from_light": "a", "volume_from_light": "b"}, claims)
    assert [(s.method, s.layers) for s in found.shares] == [("a", ("surface_from_light",)), ("b", ("volume_from_light",))]
    assert "volume_from_surface" in found.missing and "surface_from_light" not in found.missing
    assert "emission" not in found.missing  # a point light is not seen


@pytest.mark.parametrize(
    ("table", "complaint"),
    [
        ({"volume_from_light": "a", SUM: "b"}, "volume_from_light is given to a and b; a layer has one method"),
        ({"volume_from_light": "a", "volume_from_light+emission": "a"}, "volume_from_light is given to a twice"),
        ({"volume_from_volume": "a"}, "render.layers.volume_from_volume = 'a': not computed by a in this scene; it computes"),
        ({"volume_from_light": "b"}, "b cannot split .* here, but only volume_from_light is asked of it"),
        ({"surface_from_light": "a"}, "a computes surface_from_light only in part here .half of it.; allow it with"),
    ],
)
def test_what_is_refused(table, complaint):
    claims = claims_from(a=("volume_from_light", "surface_from_light!", "emission"), b=(SUM,))
    with pytest.raises(ValueError, match=complaint):
        from_table(table, claims)


def test_partial_claims_can_be_allowed():
    claims = claims_from(a=("surface_from_light!",))
    found = from_table({"surface_from_light": "a"}, claims, allow_partial=True)
    assert found.shares[0].claims[0].partial == "half of it"
    with pytest.raises(ValueError, match="no method computes emission completely.*allow_partial"):
        composite.choose(scene_file(lights=[{"kind": "environment", "radiance": 1}]).scene, claims_from(direct=("emission!",)))


def test_a_scene_file_refuses_before_anything_runs():
    with pytest.raises(ValueError, match="not computed by direct in this scene"):
        rendering.render_scene(scene_file({"layers": {"volume_from_volume": "direct"}}))
    with pytest.raises(ValueError, match="--time: a composite does not refine"):
        job = rendering.Job(None, None, {"seconds": 1.0})
        rendering.render_scene(scene_file({"method": "auto"}), job=job)


def names(assignment):
    return {layer: share.method for share in assignment.shares for layer in share.layers}


def automatic(**changes):
    return rendering.assign(scene_file({"method": "auto"} | changes.pop("render", {}), **changes), automatic=True)


def test_auto_follows_what_the_scene_is():
    thin = names(automatic())
    assert thin["surface_from_light"] == thin["volume_from_light"] == "direct"
    assert thin["volume_from_surface"] == "deep_screen_space"
    assert thin["volume_from_multiple"] == "instant_multiple_scattering"
    assert set(thin) == set(layers.NAMES) - {"emission"}
    dense = names(automatic(shapes=[], medium=FOG | {"scattering": 8}))
    assert dense == {
        "volume_from_light": "direct",
        "volume_from_volume": "lattice_boltzmann",
        "volume_from_multiple": "lattice_boltzmann",
    }
    bare = names(automatic(medium=None))
    assert set(bare) == {"surface_from_light", "surface_from_surface", "surface_from_multiple"}
    peaked = names(automatic(shapes=[], medium=FOG | {"anisotropy": 0.95}))
    assert peaked["volume_from_multiple"] == "path_tracing"
    body = names(automatic(medium={"shape": "builtin:sphere", "scattering": 8}))
    assert body["volume_from_multiple"] == "path_tracing" and body["volume_from_light"] == "direct"


def test_auto_says_why_and_what_it_cannot_do_completely():
    reasons = [reason for share in automatic().shares for reason in share.reasons]
    assert any("optically thin" in reason for reason in reasons)
    glass = FOG | {"refractive_index": 1.3}
    with pytest.raises(ValueError, match="no method computes .* completely in this scene; lattice_boltzmann does but for"):
        automatic(medium=glass)
    found = automatic(medium=glass, render={"allow_partial": True})
    assert {share.method for share in found.shares} == {"lattice_boltzmann"} and "surface_from_surface" in found.missing


def test_auto_weighs_time_where_paths_are_traced_anyway():
    """Peaked fog wants paths for the rest: quadratures join them only where they are a small part of their time."""
    few, many = (automatic(medium=FOG | {"anisotropy": 0.8}, render={"samples": samples}) for samples in (1, 65536))
    assert set(names(few).values()) == {"path_tracing"}
    assert names(many)["volume_from_light"] == "direct" and names(many)["volume_from_multiple"] == "path_tracing"
    reasons = {claim.name: why for share in few.shares for claim, why in zip(share.claims, share.reasons, strict=True)}
    assert "direct would add" in reasons["volume_from_light"]
    assert not any("beside" in reason for share in automatic().shares for reason in share.reasons)  # no paths: nothing to weigh


def test_weighed_takes_the_cheapest_first_and_splits_no_sum():
    claim = {name: Claim((name,)) for name in ("emission", "volume_from_light", "surface_from_light")}
    both = Claim(("volume_from_surface", "volume_from_volume"))
    shares = (
        composite.Share("direct", tuple(claim.values()), ("x",) * 3),
        composite.Share("other", (both,), ("y",)),
        composite.Share("path_tracing", (Claim(("volume_from_multiple",)),), ("z",)),
    )
    base = tuple(Claim((name,)) for name in layers.NAMES)
    seconds = {"emission": 0.1, "volume_from_light": 0.2, "surface_from_light": 0.16}
    found = composite.weighed(shares, base, costs.Costs(1.04, {"direct": seconds}))
    assert {s.method: s.layers for s in found} == {
        "direct": ("emission", "surface_from_light"),
        "path_tracing": ("volume_from_light", "volume_from_multiple"),
        "other": both.layers,
    }
    assert composite.weighed(shares[:2], base, costs.Costs(0.0, {"direct": seconds})) == shares[:2]


def test_costs_of_direct_light_count_its_connections():
    """Twice the pixels, twice the time; a grid is marched towards every light; what is not computed costs nothing."""
    direct = rendering.load_method("direct")

    def seconds(**changes):
        file = scene_file(**changes)
        return costs.direct(file.scene, file.camera, direct.plan(file.scene, file.camera))

    plain = seconds()
    wide = seconds(camera=CAMERA | {"width": 24})
    assert plain["emission"] == 0.0  # a point light is not seen
    assert wide["volume_from_light"] == pytest.approx(2 * plain["volume_from_light"])
    assert seconds(lights=[LAMP, LAMP])["surface_from_light"] < 2 * plain["surface_from_light"]
    grid = seconds(medium=FOG | {"density": np.ones((32, 32, 32))})
    assert grid["volume_from_light"] > 3 * plain["volume_from_light"]


def test_multiple_scattering_of_a_thin_medium_is_left_out_by_its_bound():
    haze = FOG | {"scattering": 1e-5, "absorption": 0.0}
    thin = automatic(shapes=[], medium=haze)
    assert thin.negligible == ("volume_from_volume", "volume_from_multiple") and not thin.missing
    assert names(thin) == {"volume_from_light": "direct"} and "scattered twice" in thin.bound
    assert composite.multiple_scattering_bound(scene_file(shapes=None, medium=haze).scene) == pytest.approx(
        1e-5 * 12**0.5, rel=1e-3
    )
    for changes in ({"shapes": [FLOOR]}, {"medium": FOG}, {"render": {"negligible": 0.0}}):
        assert not automatic(**({"shapes": [], "medium": haze} | changes)).negligible


def test_restricted_switches_off_what_nobody_asks():
    direct = rendering.load_method("direct")
    file = scene_file()
    plan = direct.plan(file.scene, file.camera)
    only = rendering.restricted(plan, ("volume_from_light",))
    assert plan.surface and plan.volume and only.volume and not only.surface
    assert rendering.restricted(plan, ("surface_from_light", "volume_from_light")) == plan
    assert rendering.restricted(SimpleNamespace(volume=True), ()).volume  # no plan of ours: left alone


def test_compose_takes_of_each_what_it_was_asked_for():
    def estimate(value, *held, **diagnostics):
        images = {name: jnp.full((2, 3, 3), value) for name in held}
        return Estimate(mean=layers.from_items(images), variance=layers.from_items(images), diagnostics=diagnostics)

    a = composite.Share("a", (Claim(("emission",)),), ("",))
    b = composite.Share("b", (Claim(tuple(SUM.split("+"))),), ("",))
    found = composite.compose(
        [(a, estimate(1.0, "emission", "surface_from_light")), (b, estimate(2.0, SUM, "volume_from_surface", converged=True))]
    )
    assert [name for name, _ in layers.items(found.mean)] == ["emission", SUM]
    assert [name for name, _ in layers.items(found.variance)] == ["emission", SUM]
    assert np.all(np.asarray(layers.total(found.mean)) == 3.0)
    assert found.diagnostics["b.converged"] and found.diagnostics["converged"]


@pytest.fixture(scope="module")
def small():
    """A composite of two deterministic methods, and each of them alone."""
    options = {"direct": {"samples_per_pixel": 2}, "deep_screen_space": {"num_surfels": 256, "num_levels": 2}}
    table = {"surface_from_light": "direct", "volume_from_light": "direct", "volume_from_surface": "deep_screen_space"}
    file = scene_file(options | {"layers": table, "samples": 2})
    return file, rendering.render_scene(file)


def test_the_composite_is_the_sum_of_its_methods(small):
    file, result = small
    assert [share.method for share in result.shares] == ["direct", "deep_screen_space"]
    assert "volume_from_volume" in result.missing and result.nonfinite_pixels == 0
    assert result.method == "direct+deep_screen_space" and result.seconds["run"] > 0
    whole = 0
    for share in result.shares:
        alone = rendering.render_scene(file, method=share.method)
        for layer in share.layers:
            one, other = (np.asarray(getattr(x.estimate.mean, layer)) for x in (alone, result))
            assert one.max() > 0
            np.testing.assert_allclose(other, one, rtol=1e-5, atol=1e-7)
            whole = whole + one
    np.testing.assert_allclose(np.asarray(layers.total(result.estimate.mean)), whole, rtol=1e-5)


def test_primary_hits_and_tables_are_made_once(small, monkeypatch):
    file, result = small
    made = []

    class Counted(CommonStages):
        def __init__(self, *arguments):
            super().__init__(*arguments)
            made.append(self)

    monkeypatch.setattr(rendering, "CommonStages", Counted)
    again = rendering.render_scene(file)
    (common,) = made
    assert {"caster", "marching", "center_hits"} <= set(vars(common))  # both methods asked, and found what was there
    guides, before = again.estimate.auxiliary, result.estimate.auxiliary
    np.testing.assert_array_equal(np.asarray(guides.depth), np.asarray(before.depth))
    t = common.center_hits[0].reshape(8, 12)
    np.testing.assert_allclose(np.asarray(guides.depth), t, rtol=1e-5)
