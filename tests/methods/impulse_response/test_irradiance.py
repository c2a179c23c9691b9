"""Irradiance over an open plane against the path tracer, inside a sphere against a geometric series, and the house rules."""

import jax.numpy as jnp
import numpy as np
import pytest

from jaxvol import direct, harmonics, layers, lights, ray_casting
from jaxvol.methods import impulse_response
from jaxvol.methods.impulse_response import light_sources, probes, surface_paths
from jaxvol.methods.impulse_response import receivers as receivers_of
from jaxvol.methods.impulse_response.receivers import Reflection
from jaxvol.scene import make_scene
from jaxvol.types import Medium, Mesh, PointLights, Scene, SpotLights

SIZE = 12.0
RADII = (0.0, 0.5, 1.0, 2.0, 3.0)
# Irradiance scattered once, and everything beyond that, at RADII on a plane below a point light of intensity 1 one mean free
# path up, 12 mean free paths of medium around: path_tracing.irradiance, 16384 samples each (standard error 1 to 3 %, the
# first row 262144 samples and 3 %), by (albedo of the medium, g, albedo of the plane).
REFERENCE = {
    (0.5, 0.0, 0.0): ((0.1425, 0.1100, 0.0440, 0.007141, 0.001303), (0.0684, 0.05538, 0.03023, 0.007691, 0.002092)),
    (0.9, 0.0, 0.0): ((0.2566, 0.1981, 0.07921, 0.01285, 0.002346), (0.3942, 0.3011, 0.1836, 0.06694, 0.02499)),
    (0.99, 0.0, 0.0): ((0.2822, 0.2179, 0.08713, 0.01414, 0.002580), (0.5851, 0.4590, 0.2999, 0.1248, 0.05564)),
    (0.9, 0.5, 0.0): ((0.2904, 0.2141, 0.09193, 0.01559, 0.003262), (0.2782, 0.2351, 0.1392, 0.05923, 0.02452)),
    (0.9, -0.5, 0.0): ((0.2166, 0.1588, 0.06253, 0.009118, 0.001369), (0.4942, 0.3795, 0.2027, 0.05988, 0.02296)),
    (0.5, 0.0, 0.5): ((0.1425, 0.1100, 0.0440, 0.007141, 0.001303), (0.09862, 0.07433, 0.03975, 0.01053, 0.002961)),
    (0.9, 0.0, 0.5): ((0.2566, 0.1981, 0.07921, 0.01285, 0.002346), (0.5271, 0.4087, 0.2567, 0.09994, 0.03790)),
}


def open_plane(c, g=0.0, albedo=0.0, **changes):
    s = SIZE
    corners = np.array([[-s, -s, 0], [s, -s, 0], [s, s, 0], [-s, s, 0]], np.float32)
    mesh = Mesh(jnp.asarray(corners), jnp.array([[0, 1, 2], [0, 2, 3]]), jnp.full((2, 3), albedo, jnp.float32))
    medium = Medium(
        bounds=jnp.array([[-s, -s, 0], [s, s, s]]),
        sigma_s=jnp.full(3, c, jnp.float32),
        sigma_a=jnp.full(3, 1 - c, jnp.float32),
        g=jnp.float32(g),
    )
    light = PointLights(jnp.array([[0.0, 0.0, 1.0]]), jnp.ones((1, 3)))
    return Scene(**({"mesh": mesh, "medium": medium, "point_lights": light} | changes))


def receivers():
    points = np.zeros((5, 3), np.float32)
    points[:, 0] = RADII
    return points, np.tile(np.float32([0, 0, 1]), (5, 1))


def found(estimate, name):
    return np.asarray(getattr(estimate.mean, name))[..., 0]


@pytest.mark.parametrize(("c", "g"), [(0.5, 0.0), (0.9, 0.0), (0.99, 0.0), (0.9, 0.5), (0.9, -0.5)])
def test_open_black_plane(c, g):
    estimate = impulse_response.irradiance(open_plane(c, g), *receivers(), samples=1, max_bounces=0)
    distance = np.sqrt(1 + np.square(RADII))
    direct = np.exp(-distance) / distance**3
    np.testing.assert_allclose(found(estimate, "surface_from_light"), direct, rtol=2e-5)
    once, rest = REFERENCE[c, g, 0.0]
    if g == 0:  # facing the light: quadrature, to the truncation of order 11
        assert found(estimate, "surface_from_volume")[0] == pytest.approx(0.2811740 * c, rel=3e-3)
    everything = direct + once + rest
    total = np.asarray(layers.total(estimate.mean))[:, 0]
    assert np.abs(total - everything).sum() / everything.sum() < (0.03 if c <= 0.5 else 0.06)


@pytest.mark.parametrize("c", [0.5, 0.9])
def test_reflecting_plane_lights_itself_through_the_fog(c):
    once, rest = REFERENCE[c, 0.0, 0.5]
    distance = np.sqrt(1 + np.square(RADII))
    truth = np.exp(-distance) / distance**3 + once + rest
    scene = open_plane(c, albedo=0.5)
    estimate = impulse_response.irradiance(scene, *receivers(), samples=800, max_bounces=5)
    total = np.asarray(layers.total(estimate.mean))[:, 0]
    assert np.abs(total - truth).sum() / truth.sum() < 0.03
    assert np.all(found(estimate, "surface_from_surface") == 0)  # a plane does not see itself
    rays_alone = impulse_response.irradiance(scene, *receivers(), samples=8, max_bounces=5, back_scattering=False)
    dark = np.asarray(layers.total(rays_alone.mean))[:, 0]
    assert dark.sum() < 0.95 * truth.sum()


@pytest.mark.parametrize("g", [0.0, 0.4])
def test_the_papers_trick_for_patches_behind(g):
    """A floor of radiosity pi Le gives back by the rule 2 pi Le c / 2 p(pi) int max(0, cos)^2 dw: quadrature over both legs.

    At g = 0 that is 1/6 c pi Le, where .2046 of it would be right (specification 8).
    """
    c, albedo = 0.8, 0.5
    scene = open_plane(c, g, albedo=albedo)
    plan = impulse_response.plan(scene, None, scattering="single", back_scattering="epsilon")
    kit = impulse_response.prepare(scene, plan)
    num = 1 << 15
    position, normal = jnp.zeros((num, 3)), jnp.tile(jnp.float32([0, 0, 1]), (num, 1))
    index, seed = jnp.arange(num), jnp.uint32(0)
    arguments = (index, index, seed, jnp.int32(1), kit.probe_sigma)
    proposal = surface_paths.propose(scene.mesh, kit.faces, position, normal, *arguments, shares=plan.shares)
    t, face = ray_casting.intersect(kit.caster, proposal.origin, proposal.direction, proposal.t_max)
    hits = jnp.asarray(t), jnp.asarray(face)
    arrival = surface_paths.arrive(scene.mesh, kit.faces, position, normal, proposal, *hits)
    yes, tau = jnp.ones(num, bool), jnp.ones((num, 3))
    receiver = receivers_of.Irradiance(normal)
    common = (proposal, arrival, yes, yes, tau, kit.probe_sigma, None, None)
    plain, scattered = surface_paths.transport(
        scene.mesh, kit.faces, kit.responses, receiver, *common, shares=plan.shares, image=False
    )
    t, weight = np.polynomial.legendre.leggauss(60)
    leg, cosine, half = 10 * (t + 1), 0.5 * (t + 1), 0.5 * weight
    along = np.sum(20 * half * c * np.exp(-2 * leg)) * (1 - g) / (1 + g) ** 2 / (4 * np.pi)
    around = 2 * np.pi * np.sum(half * cosine * cosine)
    rule = 2 * np.pi * along * around  # over c pi Le with Le = 1
    assert rule == pytest.approx(c * np.pi / 6 * (1 - g) / (1 + g) ** 2, rel=1e-6)
    found = np.asarray(scattered, np.float64)[:, 0] / (albedo / np.pi)
    assert np.all(np.asarray(plain) == 0)  # nothing of it arrives straight
    assert found.mean() == pytest.approx(rule, abs=4 * found.std() / num**0.5)
    assert found.mean() == pytest.approx(rule, rel=0.03)


def sphere(albedo, **medium):
    table = {"shapes": [{"mesh": "builtin:sphere", "reflectance": albedo}]}
    table["lights"] = [{"kind": "point", "position": [0, 0, 0], "intensity": 1}]
    return make_scene(table | ({"medium": medium} if medium else {})).scene


def inside(scene, num=6):
    corners = np.asarray(scene.mesh.vertices)[np.asarray(scene.mesh.faces)]
    chosen = corners[:: len(corners) // num][:num]
    normal = np.cross(chosen[:, 1] - chosen[:, 0], chosen[:, 2] - chosen[:, 0])
    normal = normal / np.linalg.norm(normal, axis=1, keepdims=True)
    centre = chosen.mean(axis=1)
    return centre, normal * np.where(np.sum(normal * centre, axis=1, keepdims=True) > 0, -1, 1)


def test_integrating_sphere():
    """E = E_direct (1 + a + a^2 + ...) everywhere inside a white sphere, order by order."""
    scene = sphere(0.6)
    estimate = impulse_response.irradiance(scene, *inside(scene), samples=2048, max_bounces=3)
    direct = found(estimate, "surface_from_light")
    np.testing.assert_allclose(found(estimate, "surface_from_surface"), 0.6 * direct, rtol=0.02)
    np.testing.assert_allclose(found(estimate, "surface_from_multiple"), (0.36 + 0.216) * direct, rtol=0.06)
    assert "surface-only" in " ".join(impulse_response.plan(scene, None).skipped)


def test_attenuated_only():
    """Absorption and out-scattering alone: the light of each chord loses e^-tau."""
    scene = sphere(0.6, density=1.0, bounds=[[-2, -2, -2], [2, 2, 2]], scattering=0.5, absorption=0.5)
    dim = impulse_response.irradiance(scene, *inside(scene), samples=4096, max_bounces=1, scattering="attenuated")
    points, normals = inside(scene)
    clear = impulse_response.irradiance(scene, points, normals, samples=16, max_bounces=1, scattering="surface")
    radius = np.linalg.norm(points, axis=1)
    np.testing.assert_allclose(
        found(dim, "surface_from_light"), np.exp(-radius) * found(clear, "surface_from_light"), rtol=1e-4
    )
    # Chords of a unit sphere under a cosine lobe have the density l / 2 on [0, 2].
    chord = np.exp(-radius) * (1 - 3 * np.exp(-2)) / 2
    np.testing.assert_allclose(found(dim, "surface_from_surface"), chord * found(clear, "surface_from_surface"), rtol=0.04)
    assert np.all(found(dim, "surface_from_volume") == 0)


def test_results_do_not_depend_on_the_batches():
    scene = open_plane(0.9, albedo=0.5)
    points, normals = receivers()
    whole = impulse_response.irradiance(scene, points, normals, samples=80, max_bounces=1)
    part = impulse_response.irradiance(scene, points[3:], normals[3:], samples=80, max_bounces=1, first_item=3)
    np.testing.assert_allclose(layers.total(whole.mean)[3:], layers.total(part.mean), rtol=1e-4)


def test_occluders_take_scattered_light_and_the_share_is_told():
    scene = open_plane(0.9)
    wall = np.array([[0.5, -3, 0], [0.5, 3, 0], [0.5, 3, 4], [0.5, -3, 4]], np.float32)
    mesh = Mesh(
        jnp.concatenate([scene.mesh.vertices, jnp.asarray(wall)]),
        jnp.concatenate([scene.mesh.faces, jnp.array([[4, 5, 6], [4, 6, 7]])]),
        jnp.zeros((4, 3)),
    )
    behind = open_plane(0.9, mesh=mesh)
    estimate = impulse_response.irradiance(behind, *receivers(), samples=1, max_bounces=0, occlusion="drop")
    assert np.all(np.asarray(layers.total(estimate.mean))[2:] == 0)
    open_once = found(impulse_response.irradiance(scene, *receivers(), samples=1, max_bounces=0), "surface_from_volume")
    share = open_once[2:].sum() / open_once.sum()  # at 0.5 the receiver stands in the wall's foot and is hidden or not
    assert share - 0.01 < float(estimate.diagnostics["occluded_share"]) < share + open_once[1] / open_once.sum() + 0.01


def test_the_papers_modes_of_multiple_scattering():
    """At g = 0 similarity and three values of g change nothing; at g = 0.5 similarity is too dark (specification 3)."""
    modes = {"similarity": True, "g_range": 0.5}
    totals = {}
    for g in (0.0, 0.5):
        for name, options in (("table", {}), ("paper", modes)):
            estimate = impulse_response.irradiance(
                open_plane(0.5, g), *receivers(), samples=1, max_bounces=0, image=False, **options
            )
            totals[g, name] = found(estimate, "surface_from_multiple").sum(), found(estimate, "surface_from_volume").sum()
    np.testing.assert_allclose(totals[0.0, "paper"], totals[0.0, "table"], rtol=2e-3)
    assert totals[0.5, "paper"][0] < 0.9 * totals[0.5, "table"][0]
    np.testing.assert_allclose(totals[0.5, "paper"][1], totals[0.5, "table"][1], rtol=1e-3)  # 0.5 is one of the three


def test_lookups_beyond_the_tables_are_counted():
    thick = Medium(jnp.array([[-9.0] * 3, [9.0] * 3]), jnp.full(3, 20.0), jnp.full(3, 1.0), jnp.float32(0.0))
    estimate = impulse_response.irradiance(open_plane(0.9, medium=thick), *receivers(), samples=1, max_bounces=0)
    # 21 per unit: the receivers beyond radius 1.02 lie more than 30 mean free paths off.
    share = float(estimate.diagnostics["beyond_share"])
    assert share == pytest.approx(2 / 5, abs=0.01) and np.all(np.isfinite(layers.total(estimate.mean)))
    near = impulse_response.irradiance(open_plane(0.9), *receivers(), samples=1, max_bounces=0)
    assert float(near.diagnostics["beyond_share"]) == 0


def test_receivers_in_an_edge_of_a_box():
    """Next vertices within the rays' offset had no density and a weight of 1e30."""
    table = {"shapes": [{"mesh": "builtin:cornell_box"}]}
    table["medium"] = {"density": 1.0, "bounds": [[-1, 0, -1], [1, 2, 1]], "scattering": 0.25, "absorption": 0.01}
    scene = make_scene(table).scene
    points = np.tile(np.float32([[-1, 0, 0.5], [-1, 0, -1]]), (64, 1))
    normals = np.tile(np.float32([0, 1, 0]), (128, 1))
    for options in ({}, {"back_scattering": False}):
        estimate = impulse_response.irradiance(scene, points, normals, samples=2, occlusion="drop", **options)
        assert float(jnp.max(layers.total(estimate.mean))) < 100


def test_claims_say_what_is_missed():
    assert [claim.partial for claim in impulse_response.claims(open_plane(0.9))] == [None] * 4
    spot = SpotLights(jnp.zeros((1, 3)), jnp.array([[0, 0, -1.0]]), jnp.ones((1, 3)), jnp.ones(1), jnp.ones(1))
    partial = [claim.partial for claim in impulse_response.claims(open_plane(0.9, spot_lights=spot))]
    assert partial[:2] == [None, None] and "cone" in partial[2]
    box = make_scene(
        {"shapes": [{"mesh": "builtin:box"}], "medium": {"density": 1.0, "bounds": [[-1, 0, -1], [1, 2, 1]], "scattering": 1.0}}
    ).scene
    assert "occluders" in impulse_response.claims(box)[3].partial


def test_bad_input():
    scene = open_plane(0.9)
    for options, text in (
        ({"scattering": "all"}, "scattering: 'all'"),
        ({"max_bounces": -1}, "max_bounces: -1"),
        ({"num_lanes": 0}, "num_lanes: 0"),
        ({"occlusion": "grid"}, "occlusion: 'grid'"),
        ({"contrast": 2.0}, "contrast: 2.0"),
        ({"back_scattering": "area"}, "back_scattering: 'area'"),
        ({"epsilon": 0.0}, "epsilon: 0.0"),
        ({"back_scattering": "epsilon", "bounded": 99.0}, "back_scattering: 'epsilon' belongs to segments that are looked up"),
        ({"bounded": -1.0}, "bounded: -1.0"),
        ({"legs": 0}, "legs: 0"),
        ({"g_range": 1.0}, "g_range: 1.0"),
    ):
        with pytest.raises(ValueError, match=text):
            impulse_response.plan(scene, None, **options)
    with pytest.raises(ValueError, match="mesh is missing"):
        impulse_response.plan(Scene(medium=scene.medium), None)
    bent = Medium(scene.medium.bounds, scene.medium.sigma_s, scene.medium.sigma_a, scene.medium.g, ior=jnp.float32(1.3))
    with pytest.raises(ValueError, match="refractive_index"):
        impulse_response.plan(open_plane(0.9, medium=bent), None)
    point = Mesh(jnp.zeros((3, 3)), jnp.array([[0, 1, 2]]), jnp.zeros((1, 3)))
    with pytest.raises(ValueError, match="no face has an area"):
        impulse_response.irradiance(open_plane(0.9, mesh=point), *receivers())
    with pytest.raises(ValueError, match="samples"):
        impulse_response.irradiance(scene, *receivers(), samples=0)
    with pytest.raises(ValueError, match="shape"):
        impulse_response.irradiance(scene, np.zeros((2, 3)), np.zeros((3, 3)))


def test_a_medium_that_only_absorbs_needs_no_tables():
    plan = impulse_response.plan(open_plane(0.0), None)
    assert plan.scattering == "attenuated" and "only absorbs" in " ".join(plan.skipped)


def test_render_takes_the_surface_layers():
    table = {"shapes": [{"mesh": "builtin:cornell_box"}], "camera": {"origin": [0, 1, 4.6], "target": [0, 1, 0], "fov_y": 32}}
    table["camera"] |= {"width": 12, "height": 12}
    table["medium"] = {"density": 1.0, "bounds": [[-1, 0, -1], [1, 2, 1]], "scattering": [0.2, 0.3, 0.4], "absorption": 0.01}
    file = make_scene(table)
    plan = impulse_response.plan(file.scene, file.camera, max_bounces=1, occlusion="drop")
    assert not plan.grey
    estimate = impulse_response.render(file.scene, file.camera, plan, samples=2)
    picture = np.asarray(layers.total(estimate.mean))
    assert picture.shape == (12, 12, 3) and np.all(np.isfinite(picture)) and picture.mean() > 0.02
    for name in layers.SURFACE:
        assert np.asarray(getattr(estimate.mean, name)).mean() > 0, name


def test_render_reflects_in_phong_lobes():
    """Direct light on a glossy floor against `direct`."""
    table = {
        "shapes": [{"mesh": "builtin:plane", "reflectance": 0.3, "specular": 0.5, "exponent": 20.0, "transform": {"scale": 50}}]
    }
    table["camera"] = {"origin": [0, 2, 3], "target": [0, 0, 0], "fov_y": 30, "width": 8, "height": 8}
    table["lights"] = [{"kind": "directional", "direction": [0, -1, 1.5], "irradiance": 2.0}]
    file = make_scene(table)
    plan = impulse_response.plan(file.scene, file.camera, max_bounces=0)
    found = impulse_response.render(file.scene, file.camera, plan, samples=256).mean.surface_from_light
    truth = direct.render(file.scene, file.camera, direct.plan(file.scene, file.camera)).mean.surface_from_light
    np.testing.assert_allclose(found, truth, rtol=0.05)
    assert np.ptp(np.asarray(truth)[..., 0]) > 0.1 * np.asarray(truth).mean()  # a highlight is in the picture
    assert [claim.partial for claim in impulse_response.claims(file.scene)][0] is None


def test_phong_lobe_of_scattered_light():
    """A narrow lobe against quadrature of its BSDF times the cosine, off the normal."""
    normal, eye = np.array([0.0, 0, 1]), np.array([np.sin(0.6), 0, np.cos(0.6)])
    axis = 2 * eye[2] * normal - eye
    mu, weight = np.polynomial.legendre.leggauss(200)
    phi = np.pi * np.arange(400) / 200
    sine = np.sqrt(1 - mu * mu)
    w = np.stack([sine[:, None] * np.cos(phi), sine[:, None] * np.sin(phi), mu[:, None] + 0 * phi], -1)
    zonal = np.array([1.0, 0.4, 0.2, 0.1, 0.05])
    light = np.polynomial.legendre.legval(w @ np.array([0.6, 0.0, 0.8]), zonal * harmonics.zonal_norm(5))
    lobe = 82 / (2 * np.pi) * np.maximum(w @ axis, 0) ** 80 * np.maximum(w @ normal, 0)
    truth = np.sum(weight[:, None] * light * lobe) * np.pi / 200
    one = lambda v: jnp.asarray(v, jnp.float32)[None]  # noqa: E731
    receiver = Reflection(one(normal), one(axis), jnp.zeros((1, 3)), jnp.ones((1, 3)), one(80.0))
    found = receiver.zonal(one(zonal)[:, None], one([0.6, 0.0, 0.8]))
    np.testing.assert_allclose(found[0], truth, rtol=0.02)


@pytest.mark.parametrize("rows", [1, 8])
def test_the_sky_lights_an_open_plane(rows):
    """A constant sky without noise, a map against its quadrature; with a medium all directions are found."""
    columns = 2 * rows if rows > 1 else 1
    radiance = np.random.default_rng(0).uniform(0, 2, (rows, columns, 3)).astype(np.float32)
    light = lights.environment_light(radiance)
    scene = open_plane(0.9, medium=None, point_lights=None, environment=light)
    points, normals = receivers()
    estimate = impulse_response.irradiance(scene, points, normals, samples=1 if rows == 1 else 4096)
    w, weight = probes.directions(num_polar=64)
    arriving = np.asarray(lights.environment_radiance(light, jnp.asarray(w, jnp.float32)), np.float64)
    truth = np.einsum("n,n,nc->c", weight, np.maximum(w[:, 2], 0), arriving)
    tolerance = 1e-5 if rows == 1 else 0.03
    truth = np.pi * radiance[0, 0] if rows == 1 else truth
    np.testing.assert_allclose(estimate.mean.surface_from_light, np.broadcast_to(truth, (5, 3)), rtol=tolerance)
    u = [jnp.asarray(x, jnp.float32) for x in np.random.default_rng(1).random((4, 20000))]
    place, up = jnp.zeros((20000, 3)), jnp.tile(jnp.array([0.0, 0, 1]), (20000, 1))
    seen = light_sources.see(scene, place, up, "environment", jnp.zeros(20000, jnp.int32), u, scatters=True)
    whole = np.einsum("n,nc->c", weight, arriving) if rows > 1 else 4 * np.pi * radiance[0, 0]
    np.testing.assert_allclose(np.mean(seen.strength, axis=0), whole, rtol=0.03)
