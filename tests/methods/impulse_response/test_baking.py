"""Receivers, probes and baked files."""

import io
import json

import jax.numpy as jnp
import numpy as np
import pytest
import trimesh

from jaxvol import harmonics, image, jobs
from jaxvol.cli import main
from jaxvol.commands.bake import surface_notes
from jaxvol.methods import impulse_response
from jaxvol.methods.impulse_response import baking, lightmap, probes
from jaxvol.ray_casting import topology
from jaxvol.scene import make_scene
from jaxvol.types import Mesh

SCENE = """
[[shapes]]
mesh = "builtin:box"
reflectance = 0.5
[[lights]]
kind = "point"
position = [3.0, 2.0, 1.5]
intensity = 10.0
"""


def mesh_of(vertices, faces):
    return Mesh(jnp.asarray(vertices, jnp.float32), jnp.asarray(faces, jnp.int32), jnp.full((len(faces), 3), 0.5, jnp.float32))


@pytest.fixture(scope="module")
def box():
    return make_scene({"shapes": [{"mesh": "builtin:box"}]}).scene.mesh


def test_texels_lie_on_the_mesh_and_cover_it(box):
    found = lightmap.unwrap(box, resolution=64)
    corners = np.asarray(box.vertices)
    low, high = corners.min(axis=0), corners.max(axis=0)
    on_face = np.min(np.minimum(np.abs(found.receiver - low), np.abs(found.receiver - high)), axis=1)
    assert on_face.max() < 1e-5
    assert np.all(found.receiver > low - 1e-5) and np.all(found.receiver < high + 1e-5)
    assert found.covered.sum() == len(found.receiver) > 0.4 * found.covered.size
    outward = np.sum(found.normal * (found.receiver - 0.5 * (low + high)), axis=1)
    assert np.all(outward > 0)
    counts = [np.sum(found.normal @ axis > 0.9) for axis in np.concatenate([np.eye(3), -np.eye(3)])]
    assert min(counts) > 0.8 * max(counts)  # every side of the cube gets its share


def test_corners_are_split_between_the_sides_of_a_box(box):
    found = lightmap.vertices(box)
    assert len(found.position) == 24 and found.faces.max() == 23
    np.testing.assert_allclose(found.receiver, found.position, atol=5e-3)
    assert np.all(found.receiver != found.position, axis=1).sum() == 0  # each keeps one coordinate: it stays on its side


def test_faces_without_area_are_dropped_and_all_of_them_refused():
    corners = [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0.5, 0, 0]]
    some = mesh_of(corners, [[0, 1, 2], [0, 1, 3], [1, 1, 2]])
    assert lightmap.vertices(some).num_dropped == 2
    assert lightmap.unwrap(some, resolution=32).num_dropped == 2
    for make in (lightmap.vertices, lambda mesh: lightmap.unwrap(mesh, resolution=32)):
        with pytest.raises(ValueError, match="no face has an area"):
            make(mesh_of(corners, [[0, 1, 3]]))
    with pytest.raises(ValueError, match="resolution: 4"):
        lightmap.unwrap(some, resolution=4)


def test_a_fin_of_three_faces_at_one_edge_bakes():
    """Not manifold: three faces share an edge."""
    fin = mesh_of([[0, 0, 0], [0, 0, 1], [1, 0, 0], [0, 1, 0], [-1, -1, 0]], [[0, 1, 2], [0, 1, 3], [0, 1, 4]])
    found = lightmap.unwrap(fin, resolution=64)
    assert found.covered.sum() > 300 and np.all(np.isfinite(found.receiver))


def test_own_lightmap_coordinates_and_what_is_wrong_with_them():
    square = mesh_of([[0, 0, 0], [2, 0, 0], [2, 1, 0], [0, 1, 0]], [[0, 1, 2], [0, 2, 3], [0, 1, 1]])
    corners = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], float)
    uv = corners[[[0, 1, 2], [0, 2, 3], [0, 1, 1]]]
    found = lightmap.unwrap(square, resolution=16, uv=uv)
    assert found.covered.all() and found.covered.shape == (16, 16) and found.num_dropped == 1
    np.testing.assert_allclose(found.receiver[0], [2 * 0.5 / 16, 1 - 0.5 / 16, 0], atol=3e-3)  # row 0 is the top
    bad = {"must be finite": np.nan, "0 to 1": 1.5}
    for text, value in bad.items():
        with pytest.raises(ValueError, match=text):
            lightmap.unwrap(square, resolution=16, uv=np.where(np.arange(2) == 0, value, uv))
    with pytest.raises(ValueError, match="2 faces with an area have none"):
        lightmap.unwrap(square, resolution=16, uv=np.full((3, 3, 2), 0.5))
    with pytest.raises(ValueError, match="overlap in 120 texels"):
        lightmap.unwrap(square, resolution=16, uv=uv[[0, 0, 2]])


def test_closed_parts_that_are_wound_inward_are_counted():
    sides = {"mesh": "builtin:box", "transform": {"translate": [5.0, 0.0, 0.0]}}
    shapes = [{"mesh": "builtin:box"}, sides, {"mesh": "builtin:plane", "flip_normals": True}]
    for inward in (0, 1, 2):
        for index, shape in enumerate(shapes[:2]):
            shape["flip_normals"] = index < inward
        mesh = make_scene({"shapes": shapes}).scene.mesh
        what = lightmap.vertices(mesh)
        assert what.num_inward == inward  # the plane has no inside
        assert [note.partition(":")[0] for note in surface_notes(what)] == [
            f"{inward} closed part{'s are' * (inward == 2)}{' is' * (inward == 1)} wound inward"
        ] * (inward > 0)
    assert topology.num_inward_bodies(np.asarray(mesh.vertices), np.asarray(mesh.faces)[1:]) == 1  # a hole: no inside


def test_dilation_fills_from_neighbours_only():
    image_, covered = np.zeros((5, 7, 3), np.float32), np.zeros((5, 7), bool)
    image_[2, 1], covered[2, 1] = 3.0, True
    grown = lightmap.dilate(image_, covered, steps=2)
    assert np.all(grown[:, :4] == 3.0) and np.all(grown[:, 4:] == 0.0)


def test_probes_give_back_a_smooth_light():
    """SH of order 3 -> irradiance on the probe's planes -> SH, and relighting facing anywhere."""
    rng = np.random.default_rng(0)
    truth = rng.normal(size=(9, 3)) * 0.1
    truth[0] = 1.0
    facing, _ = probes.directions()
    there = np.asarray(harmonics.sh_irradiance(jnp.asarray(truth.T, jnp.float32), jnp.asarray(facing, jnp.float32)[:, None]))
    back = probes.radiance_from_irradiance(there)
    np.testing.assert_allclose(back, truth, atol=1e-5)
    low, step, shape = probes.grid([[0, 0, 0], [2, 2, 1]], 1.0)
    assert shape == (2, 2, 1)
    many = probes.Probes(low, step, np.broadcast_to(back, (*shape, 9, 3)))
    normal = rng.normal(size=(4, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    expected = np.asarray(harmonics.sh_irradiance(jnp.asarray(truth.T, jnp.float32), jnp.asarray(normal, jnp.float32)[:, None]))
    np.testing.assert_allclose(probes.relight(many, rng.uniform(-1, 3, (4, 3)), normal), expected, atol=1e-5)
    with pytest.raises(ValueError, match="spacing"):
        probes.grid([[0, 0, 0], [1, 1, 1]], 0.0)


def test_probe_of_a_distant_point_light():
    """One lamp far away: what order 3 keeps of its clamped cosine, 1/4 + cos/2 + 5/16 P_2; 32 directions alias 3 % into it."""
    light = {"kind": "point", "position": [0, 100, 0], "intensity": 1e4}
    scene = make_scene({"shapes": [{"mesh": "builtin:box"}], "lights": [light]}).scene
    facing, _ = probes.directions()
    point = np.tile([0.0, 5.0, 0.0], (len(facing), 1))
    found = impulse_response.irradiance(scene, point, facing, samples=1, max_bounces=0)
    radiance = probes.radiance_from_irradiance(np.asarray(found.mean.surface_from_light))
    one = probes.Probes(np.zeros(3), np.ones(3), radiance[None, None, None])
    normals = np.array([[0, 1.0, 0], [1, 0, 0], [0, -1, 0]])
    there = probes.relight(one, np.zeros((3, 3)), normals)[:, 0] / (1e4 / 95**2)
    np.testing.assert_allclose(there, [1.0625, 0.09375, 0.0625], atol=0.035)


def test_a_bake_goes_on_from_its_parts(tmp_path, box, monkeypatch):
    scene = make_scene(
        {"shapes": [{"mesh": "builtin:box"}], "lights": [{"kind": "point", "position": [3, 2, 1.5], "intensity": 10}]}
    ).scene
    monkeypatch.setattr(baking, "_PART", 10)
    plan = impulse_response.plan(scene, None, max_bounces=0)
    kit = impulse_response.prepare(scene, plan)
    corners = lightmap.vertices(box)
    arguments = (kit, plan, corners.receiver, corners.normal)
    whole = baking.bake(*arguments, name="v", samples=1)
    parts, stop = jobs.Parts(tmp_path, config={}), jobs.Stop()

    def press(_):
        stop.requested = True

    with pytest.raises(baking.Interrupted, match="10 of 24"):
        baking.bake(*arguments, name="v", samples=1, parts=parts, stop=stop, on_progress=press)
    again = baking.bake(*arguments, name="v", samples=1, parts=jobs.Parts(tmp_path, config={}))
    np.testing.assert_array_equal(baking.total(whole), baking.total(again))
    assert baking.total(whole).max() > 0


def _check_gltf(data):
    """The accessor rules of glTF 2.0 that viewers rely on, read from the bytes of a GLB."""
    magic, version, length = np.frombuffer(data[:12], np.uint32)
    assert magic == 0x46546C67 and version == 2 and length == len(data)
    size = int.from_bytes(data[12:16], "little")
    document = json.loads(data[20 : 20 + size])
    binary = data[20 + size + 8 :]
    components = {5121: np.uint8, 5123: np.uint16, 5125: np.uint32, 5126: np.float32}
    widths = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
    values = []
    for accessor in document["accessors"]:
        view = document["bufferViews"][accessor["bufferView"]]
        kind = np.dtype(components[accessor["componentType"]])
        start = view.get("byteOffset", 0) + accessor.get("byteOffset", 0)
        count = accessor["count"] * widths[accessor["type"]]
        assert start % kind.itemsize == 0 and "byteStride" not in view
        assert accessor.get("byteOffset", 0) + count * kind.itemsize <= view["byteLength"]
        values.append(np.frombuffer(binary, kind, count, start).reshape(accessor["count"], -1))
    for primitive in (p for mesh in document["meshes"] for p in mesh["primitives"]):
        attributes = primitive["attributes"]
        position = document["accessors"][attributes["POSITION"]]
        np.testing.assert_allclose(position["min"], values[attributes["POSITION"]].min(axis=0), rtol=1e-6)
        np.testing.assert_allclose(position["max"], values[attributes["POSITION"]].max(axis=0), rtol=1e-6)
        assert values[primitive["indices"]].max() < position["count"] and position["componentType"] == 5126
        assert all(document["accessors"][index]["count"] == position["count"] for index in attributes.values())
        if "COLOR_0" in attributes:
            colour = document["accessors"][attributes["COLOR_0"]]
            assert colour["type"] in ("VEC3", "VEC4") and (colour["componentType"] == 5126 or colour["normalized"])
    return document


def test_the_command_writes_what_others_read(tmp_path, capsys):
    scene = tmp_path / "cube.toml"
    scene.write_text(SCENE)
    options = ["--target", "lightmap", "--target", "vertices", "--target", "probes", "--samples", "2"]
    options += ["--resolution", "32", "--spacing", "1.0", "--max-bounces", "0"]
    with pytest.raises(SystemExit) as ended:
        main(arguments=["bake", str(scene), "--out", str(tmp_path), *options])
    assert ended.value.code in (0, None)
    channels, metadata = image.read_exr(tmp_path / "cube_lightmap.exr")
    outgoing = channels["G"][channels["covered"] > 0]
    assert outgoing.max() > 0.05 and metadata["samples"] == 2
    layers = sum(channels[f"{name}.G"] for name in ("surface_from_light", "surface_from_surface", "surface_from_multiple"))
    np.testing.assert_allclose(layers + channels["surface_from_volume.G"], channels["G"], atol=1e-5)
    textured = trimesh.load(io.BytesIO((tmp_path / "cube_lightmap.glb").read_bytes()), file_type="glb", force="mesh")
    assert channels["sh.l0.m0.G"].max() > 0.02 and "sh.l2.m-2.R" in channels and "sh.l1.m+1.B" in channels
    assert textured.visual.material.emissiveTexture is not None and len(textured.faces) == 12
    document = _check_gltf((tmp_path / "cube_lightmap.glb").read_bytes())
    assert document["materials"][0]["emissiveFactor"] == [1, 1, 1] and "TEXCOORD_0" in str(document["meshes"])
    assert "COLOR_0" in str(_check_gltf((tmp_path / "cube_vertices.glb").read_bytes())["meshes"])
    coloured = trimesh.load(io.BytesIO((tmp_path / "cube_vertices.glb").read_bytes()), file_type="glb", force="mesh")
    assert np.ptp(coloured.visual.vertex_colors[:, 0]) > 50
    with np.load(tmp_path / "cube_probes.npz", allow_pickle=False) as baked:
        assert baked["radiance"].shape[-2:] == (9, 3)
    assert not (tmp_path / "cube_bake.parts").exists()
    assert "receivers" in capsys.readouterr().out
