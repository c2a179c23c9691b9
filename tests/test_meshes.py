"""Mesh files with the traps of each format, builtin shapes, transforms, merging, watertightness."""

import json
import struct

import numpy as np
import pytest
import trimesh
from PIL import Image

from jaxvol import meshes
from jaxvol.mesh_files import Triangles, linear_from_srgb, read_mesh

SQUARE_OBJ = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\n"


def write(path, content):
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


def corners(triangles):
    return triangles.vertices[triangles.faces]


def areas_and_volume(triangles):
    a, b, c = np.moveaxis(corners(triangles), 1, 0)
    cross = np.cross(b - a, c - a)
    return 0.5 * np.linalg.norm(cross, axis=1), np.einsum("ij,ij->", a, cross) / 6.0


def glb(tmp_path, *, material=None, node=None, extensions=()):
    """A GLB of one triangle, written byte by byte, so that nothing between us and the file rounds anything."""
    positions = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], "<f4").tobytes()
    indices = np.array([0, 1, 2], "<u2").tobytes() + b"\0\0"
    primitive = {"attributes": {"POSITION": 0}, "indices": 1} | ({"material": 0} if material else {})
    header = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0} | (node or {})],
        "meshes": [{"primitives": [primitive]}],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3", "min": [0, 0, 0], "max": [1, 1, 0]},
            {"bufferView": 1, "componentType": 5123, "count": 3, "type": "SCALAR"},
        ],
        "bufferViews": [
            {"buffer": 0, "byteOffset": 0, "byteLength": len(positions)},
            {"buffer": 0, "byteOffset": len(positions), "byteLength": 6},
        ],
        "buffers": [{"byteLength": len(positions + indices)}],
    }
    header |= {"materials": [material]} if material else {}
    header |= {"extensionsUsed": list(extensions), "extensionsRequired": list(extensions)} if extensions else {}
    text = json.dumps(header).encode()
    text += b" " * (-len(text) % 4)
    binary = positions + indices
    body = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(binary), b"BIN\0") + binary
    return write(tmp_path / "a.glb", struct.pack("<4sII", b"glTF", 2, 12 + len(body)) + body)


# --- OBJ and MTL


def test_obj_relative_indices_tabs_and_polygons(tmp_path):
    plain = read_mesh(write(tmp_path / "plain.obj", SQUARE_OBJ + "f 1 2 3\nf 1 3 4\n"))
    tricky = SQUARE_OBJ.replace("v ", "v\t").replace(" ", "\t") + "f\t-4 -3\t-2 -1  # a quad\n"
    other = read_mesh(write(tmp_path / "tricky.obj", tricky))
    assert np.array_equal(corners(plain), corners(other))


def test_obj_relative_indices_count_from_where_they_stand(tmp_path):
    text = "v 0 0 0\nv 1 0 0\nv 0 1 0\nf -3 -2 -1\nv 0 0 5\nv 1 0 5\nv 0 1 5\nf -3 -2 -1\n"
    z = corners(read_mesh(write(tmp_path / "a.obj", text)))[..., 2]
    assert sorted(z.mean(axis=1)) == [0.0, 5.0]


def test_obj_index_out_of_range_is_refused_with_its_line(tmp_path):
    with pytest.raises(ValueError, match=r"line 5: index 9 is outside the 4"):
        read_mesh(write(tmp_path / "a.obj", SQUARE_OBJ + "f 1 2 9\n"))


def test_mtl_colours_and_emission_are_exact(tmp_path):
    write(tmp_path / "m.mtl", "newmtl a\nKd 0.123456 0.7 0.000321\nnewmtl lamp\nKd 0.5 0.5 0.5\nKe 17.25 12 4.0625\n")
    obj = SQUARE_OBJ + "mtllib m.mtl\nusemtl a\nf 1 2 3\nusemtl lamp\nf 1 3 4\n"
    got = read_mesh(write(tmp_path / "a.obj", obj))
    lamp = got.emission.any(axis=1)
    assert np.count_nonzero(lamp) == 1
    assert np.array_equal(got.emission[lamp], [[17.25, 12.0, 4.0625]])
    assert np.array_equal(got.albedo[~lamp], [[0.123456, 0.7, 0.000321]])
    assert got.notes == ()


def test_missing_material_file_is_noted(tmp_path):
    got = read_mesh(write(tmp_path / "a.obj", SQUARE_OBJ + "mtllib gone.mtl\nusemtl a\nf 1 2 3\n"))
    assert got.albedo is None
    assert "gone.mtl does not exist" in got.notes[0]


def test_texture_becomes_the_linear_colour_of_each_face(tmp_path):
    image = np.zeros((8, 8, 3), np.uint8)
    image[:, :4], image[:, 4:] = (255, 0, 0), (0, 128, 0)  # left red, right dark green, sRGB
    Image.fromarray(image).save(tmp_path / "t.png")
    write(tmp_path / "m.mtl", "newmtl a\nKd 1 1 1\nmap_Kd t.png\n")
    text = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 5 0 0\nv 6 0 0\nv 5 1 0\n"
    text += "vt 0.05 0.1\nvt 0.45 0.1\nvt 0.05 0.9\nvt 0.55 0.1\nvt 0.95 0.1\nvt 0.95 0.9\n"
    text += "mtllib m.mtl\nusemtl a\nf 1/1 2/2 3/3\nf 4/4 5/5 6/6\n"
    got = read_mesh(write(tmp_path / "a.obj", text))
    left = corners(got)[..., 0].max(axis=1) < 2
    assert np.allclose(got.albedo[left], [1, 0, 0])
    assert np.allclose(got.albedo[~left], [0, linear_from_srgb(np.array(128 / 255)), 0])


# --- PLY, STL


def test_ply_vertex_colours_are_decoded_from_srgb(tmp_path):
    mesh = trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]], process=False)
    mesh.visual.vertex_colors = [[255, 0, 128, 255]] * 3
    got = read_mesh(write(tmp_path / "a.ply", mesh.export(file_type="ply")))
    assert np.allclose(got.albedo, [[1.0, 0.0, 0.2158605]], atol=1e-6)


@pytest.mark.parametrize("kind", ["ply", "stl", "glb", "obj"])
def test_formats_agree(tmp_path, kind):
    mesh = trimesh.creation.icosphere(subdivisions=2, radius=1.5)
    data = mesh.export(file_type=kind)
    got = read_mesh(write(tmp_path / f"a.{kind}", data))
    assert len(got.faces) == len(mesh.faces)
    assert areas_and_volume(got)[1] == pytest.approx(mesh.volume, rel=1e-5)
    assert meshes.open_edges(got.vertices, got.faces) == 0


# --- glTF


def test_glb_factors_are_exact_and_linear(tmp_path):
    material = {
        "name": "a",
        "pbrMetallicRoughness": {"baseColorFactor": [0.123456, 0.7, 0.000321, 1.0]},
        "emissiveFactor": [0.5, 0.25, 0.125],
        "extensions": {"KHR_materials_emissive_strength": {"emissiveStrength": 8.0}},
    }
    got = read_mesh(glb(tmp_path, material=material))
    assert np.allclose(got.albedo, [[0.123456, 0.7, 0.000321]], atol=1e-12)
    assert np.allclose(got.emission, [[4.0, 2.0, 1.0]], atol=1e-12)


def test_glb_node_transforms_apply_and_mirrors_keep_the_front(tmp_path):
    got = read_mesh(glb(tmp_path, node={"translation": [10, 20, 30], "scale": [2, 2, 2]}))
    assert np.allclose(corners(got)[0].max(axis=0), [12, 22, 30])
    plain = read_mesh(glb(tmp_path))
    mirrored = read_mesh(glb(tmp_path, node={"scale": [1, 1, -1]}))  # mirrors z: the triangle in z = 0 stays in place

    def normal(triangles):
        a, b, c = corners(triangles)[0]
        return np.cross(b - a, c - a)

    assert np.allclose(normal(plain), [0, 0, 1])
    assert np.allclose(normal(mirrored), [0, 0, -1])  # the front side is mirrored with the triangle


def test_draco_without_a_decoder_is_refused(tmp_path):
    with pytest.raises(ValueError, match="KHR_draco_mesh_compression.*export without compression"):
        read_mesh(glb(tmp_path, extensions=["KHR_draco_mesh_compression"]))


# --- broken files


@pytest.mark.parametrize("kind", ["ply", "ply_ascii", "stl", "stl_ascii", "glb"])
def test_truncated_files_are_refused(tmp_path, kind):
    mesh = trimesh.creation.icosphere(subdivisions=1)
    options = {"encoding": "ascii"} if kind == "ply_ascii" else {}
    data = mesh.export(file_type=kind.removesuffix("_ascii") if kind != "stl_ascii" else kind, **options)
    data = data if isinstance(data, bytes) else data.encode()
    path = tmp_path / f"a.{kind.removesuffix('_ascii')}"
    for length in range(0, len(data) - 12, len(data) // 40):
        with pytest.raises(ValueError, match=r"a\."):
            read_mesh(write(path, data[:length]))


@pytest.mark.parametrize("suffix", [".ply", ".stl", ".glb", ".obj", ".gltf"])
def test_garbage_is_refused(tmp_path, suffix):
    rng = np.random.default_rng(5)
    for size in (1, 100, 5000):
        with pytest.raises(ValueError, match="a" + suffix):
            read_mesh(write(tmp_path / f"a{suffix}", rng.integers(0, 256, size, np.uint8).tobytes()))


def test_lying_counts_are_refused(tmp_path):
    ply = "ply\nformat ascii 1.0\nelement vertex 999999999\nproperty float x\nproperty float y\nproperty float z\n"
    with pytest.raises(ValueError, match="claims"):
        read_mesh(write(tmp_path / "a.ply", ply + "end_header\n0 0 0\n"))
    data = bytearray(trimesh.creation.box().export(file_type="stl"))
    data[80:84] = struct.pack("<I", 2**31)
    with pytest.raises(ValueError, match="truncated"):
        read_mesh(write(tmp_path / "a.stl", bytes(data)))


def test_not_finite_vertices_are_refused(tmp_path):
    with pytest.raises(ValueError, match="1 of 4 vertices are not finite"):
        read_mesh(write(tmp_path / "a.obj", SQUARE_OBJ.replace("v 1 1 0", "v nan 1 0") + "f 1 2 3\nf 1 3 4\n"))


def test_missing_and_unknown_files_are_named(tmp_path):
    with pytest.raises(ValueError, match=r"gone\.ply does not exist"):
        read_mesh(tmp_path / "gone.ply")
    with pytest.raises(ValueError, match=r"a\.xyz is no mesh format"):
        read_mesh(write(tmp_path / "a.xyz", "1"))
    with pytest.raises(ValueError, match=r"does not exist"):
        (tmp_path / "folder.ply").mkdir()
        read_mesh(tmp_path / "folder.ply")


# --- builtin shapes, transforms, merging


@pytest.mark.parametrize(("name", "volume", "tolerance"), [("sphere", 4 * np.pi / 3, 2e-3), ("box", 8.0, 1e-12)])
def test_closed_builtins_face_outwards(name, volume, tolerance):
    shape = meshes.builtin(name)
    assert meshes.open_edges(shape.vertices, shape.faces) == 0
    assert areas_and_volume(shape)[1] == pytest.approx(volume, rel=tolerance)


def test_plane_faces_up_and_cornell_box_faces_inwards():
    a, b, c = corners(meshes.builtin("plane"))[0]
    assert np.cross(b - a, c - a)[1] > 0
    box = meshes.builtin("cornell_box")
    assert len(box.faces) == 36
    walls = Triangles(box.vertices, box.faces[:10])
    centre = corners(walls).mean(axis=1)
    a, b, c = np.moveaxis(corners(walls), 1, 0)
    assert (np.einsum("ij,ij->i", np.cross(b - a, c - a), [0.0, 1.0, 0.0] - centre) > 0).all()
    lamp = box.emission.any(axis=1)
    a, b, c = np.moveaxis(corners(box)[lamp], 1, 0)
    assert (np.cross(b - a, c - a)[:, 1] < 0).all(), "the lamp must shine down"


def test_unknown_builtin_is_refused():
    with pytest.raises(ValueError, match="builtin:cornell_box"):
        meshes.builtin("teapot")


def test_transform_scales_then_rotates_then_translates():
    point = Triangles(np.array([[1.0, 0.0, 0.0]] * 3), np.array([[0, 1, 2]]))
    moved = meshes.transform(point, scale=(2, 1, 1), rotate=(0, 0, 1, 90), translate=(10, 0, 0))
    assert np.allclose(moved.vertices[0], [10, 2, 0])  # (1,0,0) -> (2,0,0) -> (0,2,0) -> (10,2,0)


@pytest.mark.parametrize("scale", [(-1, 1, 1), (-1, -2, -3), (1, 2, 3)])
def test_a_mirroring_scale_keeps_outside_outside(scale):
    volume = areas_and_volume(meshes.transform(meshes.builtin("sphere"), scale=scale))[1]
    assert volume == pytest.approx(4 * np.pi / 3 * abs(np.prod(scale)), rel=2e-3)


def test_flipped_normals_turn_inside_out():
    sphere = meshes.builtin("sphere")
    assert areas_and_volume(meshes.flip_normals(sphere))[1] == pytest.approx(-areas_and_volume(sphere)[1])


def test_build_mesh_keeps_every_shape_apart():
    shapes = [
        ("shapes.0", meshes.builtin("plane"), {"reflectance": (0.1, 0.2, 0.3)}),
        ("shapes.1", meshes.builtin("cornell_box"), {}),
        ("shapes.2", meshes.builtin("box"), {"specular": (0.4, 0.4, 0.4), "exponent": 50.0}),
    ]
    mesh, notes = meshes.build_mesh(shapes)
    assert notes == []
    assert mesh.faces.shape == (2 + 36 + 12, 3)
    assert np.allclose(mesh.albedo[:2], [0.1, 0.2, 0.3])
    assert np.allclose(mesh.albedo[-1], 0.5)  # the default
    assert np.allclose(mesh.specular[:38], 0) and np.allclose(mesh.specular[38:], 0.4)
    assert np.allclose(mesh.exponent[38:], 50)
    assert np.allclose(mesh.emission[:36], 0) and np.allclose(mesh.emission[36:38], [17, 12, 4])
    assert np.allclose(np.ptp(np.asarray(mesh.vertices)[mesh.faces[:2]].reshape(-1, 3), axis=0), [2, 0, 2])


def test_absent_is_none():
    assert meshes.build_mesh([]) == (None, [])
    mesh, _ = meshes.build_mesh([("shapes.0", meshes.builtin("box"), {"emission": (0.0, 0.0, 0.0)})])
    assert mesh.emission is None and mesh.specular is None and mesh.exponent is None


def test_too_much_reflection_is_refused():
    with pytest.raises(ValueError, match=r"shapes.0: reflectance \+ specular = 1.1 must be in \[0, 1\]"):
        meshes.build_mesh([("shapes.0", meshes.builtin("box"), {"reflectance": (0.6,) * 3, "specular": (0.5,) * 3})])


def test_triangles_without_area_are_dropped_and_noted():
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [2, 0, 0], [1e-9, 0, 0]], float)
    faces = np.array([[0, 1, 2], [0, 1, 3], [0, 0, 2]])  # the second is a line, the third a repeated corner
    mesh, notes = meshes.build_mesh([("shapes.0", Triangles(vertices, faces), {})])
    assert mesh.faces.shape == (1, 3)
    assert notes == ["shapes.0: 2 of 3 triangles have no area and are left out"]
    tiny = Triangles(1e-6 * vertices, faces[:1])
    assert meshes.build_mesh([("shapes.0", tiny, {})])[0].faces.shape == (1, 3), "small is not flat"


# --- shapes of media


def test_holes_are_counted():
    box = meshes.builtin("box")
    with pytest.raises(ValueError, match=r"medium.shape: the mesh is not watertight \(3 open edges\)"):
        meshes.boundary("medium.shape", Triangles(box.vertices, box.faces[1:]))
    with pytest.raises(ValueError, match="4 open edges"):
        meshes.boundary("medium.shape", meshes.builtin("plane"))


def test_welding_is_by_position_so_an_stl_is_watertight():
    box = meshes.builtin("box")
    soup = Triangles(box.vertices[box.faces].reshape(-1, 3), np.arange(36).reshape(12, 3))
    assert meshes.open_edges(soup.vertices, soup.faces) == 0


def test_inside_out_boundaries_are_turned_round():
    box = meshes.builtin("box")
    mesh, notes = meshes.boundary("medium.shape", Triangles(box.vertices, box.faces[:, ::-1]))
    got = Triangles(np.asarray(mesh.vertices, float), np.asarray(mesh.faces))
    assert areas_and_volume(got)[1] == pytest.approx(8.0)
    assert "turned round" in notes[0]


def test_a_boundary_without_volume_is_refused():
    sheet = Triangles(np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], float), np.array([[0, 1, 2], [0, 2, 1]]))
    with pytest.raises(ValueError, match="encloses no volume"):
        meshes.boundary("medium.shape", sheet)


# --- real files


def test_real_meshes(shared_data):
    folder = shared_data / "meshes"
    cornell = read_mesh(folder / "CornellBox-Original.obj")
    assert len(cornell.faces) == 36
    assert np.array_equal(np.unique(cornell.emission, axis=0), [[0, 0, 0], [17, 12, 4]])
    assert [0.63, 0.065, 0.05] in cornell.albedo.tolist()
    street = read_mesh(folder / "sionna_simple_street_canyon.glb")
    assert len(street.faces) == 74
    assert np.allclose(np.ptp(street.vertices, axis=0), [186, 121, 51], atol=0.5)
    for name, faces, num_open in (("spot", 5856, 0), ("stanford_bunny_16k_closed", 16000, 0), ("suzanne_cc0", 14842, 160)):
        mesh = read_mesh(folder / f"{name}.ply")
        assert len(mesh.faces) == faces
        assert meshes.open_edges(mesh.vertices, mesh.faces) == num_open
