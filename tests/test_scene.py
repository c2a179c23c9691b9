"""Scene files and dictionaries: every key arrives where it should, and the same from Python as from a file."""

import inspect
import json
import tomllib

import numpy as np
import pytest

from jaxvol import camera, meshes, ray_casting, scene_config
from jaxvol.scene import apply_overrides, load_scene, make_scene, read_moments

EVERYTHING = """
[camera]
origin = [0, 1, 5]
target = [0, 1, 0]
up = [0, 2, 0]
fov_y = 60
width = 32
height = 16

[medium]
density = 2.0
bounds = [[-1, 0, -1], [1, 2, 1]]
scattering = [0.5, 1.0, 1.5]
absorption = 0.25
anisotropy = 0.3
refractive_index = 1.33

[[medium.inclusions]]
density = 3
scattering = 2
shape = { mesh = "builtin:sphere", transform = { scale = 0.25, translate = [0, 1, 0] } }

[[medium.inclusions]]
shape = "builtin:box"
absorption = [1, 2, 3]

[[shapes]]
mesh = "builtin:plane"
reflectance = [0.1, 0.2, 0.3]
transform = { scale = 4, translate = [0, -1, 0] }

[[shapes]]
mesh = "builtin:box"
reflectance = 0.5
specular = 0.25
exponent = 30
emission = 7

[[lights]]
kind = "point"
position = [1, 2, 3]
intensity = 10

[[lights]]
kind = "spot"
position = [0, 3, 0]
direction = [0, -2, 0]
intensity = [1, 2, 3]
angle = 30
falloff = 20

[[lights]]
kind = "directional"
direction = [0, -3, 4]
irradiance = [3, 2, 1]

[[lights]]
kind = "environment"
radiance = 0.5
rotation = 90
scale = [2, 4, 6]

[render]
method = "direct"
samples = 16
seed = 7
max_scatterings = 3
russian_roulette = false
exposure = -1.5

[render.direct]
num_steps = 32
"""


@pytest.fixture(scope="module")
def everything():
    return make_scene(tomllib.loads(EVERYTHING))


def test_camera(everything):
    got = everything.camera
    assert (got.width, got.height) == (32, 16)
    assert float(got.fov_y) == pytest.approx(np.radians(60))
    middle = camera.generate_rays(got, np.array([16.0, 8.0], np.float32))
    assert np.allclose(middle.origin, [0, 1, 5]) and np.allclose(middle.direction, [0, 0, -1], atol=1e-6)
    top = camera.generate_rays(got, np.array([16.0, 0.0], np.float32))
    assert np.degrees(np.arctan2(top.direction[1], -top.direction[2])) == pytest.approx(30, abs=1e-3)


def test_homogeneous_density_multiplies_the_coefficients(everything):
    medium = everything.scene.medium
    assert medium.density is None and medium.majorants is None
    assert np.allclose(medium.sigma_s, [1, 2, 3])
    assert np.allclose(medium.sigma_a, 0.5)
    assert float(medium.g) == pytest.approx(0.3)
    assert float(medium.ior) == pytest.approx(1.33)
    assert np.allclose(medium.bounds, [[-1, 0, -1], [1, 2, 1]])
    assert medium.boundary is None and medium.phase is None


def test_inclusions_keep_their_order_and_shapes(everything):
    ball, box = everything.scene.medium.inclusions
    assert np.allclose(ball.sigma_s, 6)
    assert np.allclose(np.linalg.norm(np.asarray(ball.boundary.vertices) - [0, 1, 0], axis=1), 0.25, atol=1e-6)
    assert (np.asarray(ball.bounds[0]) < [-0.25, 0.75, -0.25]).all() and (np.asarray(ball.bounds[1]) > [0.25, 1.25, 0.25]).all()
    assert np.allclose(box.sigma_a, [1, 2, 3]) and np.allclose(box.sigma_s, 1) and float(box.g) == 0


def test_shapes_merge(everything):
    mesh = everything.scene.mesh
    assert mesh.faces.shape == (14, 3)
    assert np.allclose(mesh.albedo[:2], [0.1, 0.2, 0.3]) and np.allclose(mesh.albedo[2:], 0.5)
    assert np.allclose(mesh.specular[2:], 0.25) and np.allclose(mesh.exponent[2:], 30)
    floor = np.asarray(mesh.vertices)[np.asarray(mesh.faces[:2])]
    assert np.allclose(floor[..., 1], -1) and np.ptp(floor[..., 0]) == 8


def test_lights(everything):
    scene = everything.scene
    assert np.allclose(scene.point_lights.position, [[1, 2, 3]]) and np.allclose(scene.point_lights.intensity, 10)
    spots = scene.spot_lights
    assert np.allclose(spots.direction, [[0, -1, 0]]) and np.allclose(spots.intensity, [[1, 2, 3]])
    assert np.allclose(np.degrees([spots.cutoff, spots.falloff]), [[30], [20]])
    assert np.allclose(scene.directional_lights.direction, [[0, -0.6, 0.8]])
    assert np.allclose(scene.directional_lights.irradiance, [[3, 2, 1]])
    assert np.allclose(scene.environment.radiance, [1, 2, 3])
    assert set(np.asarray(scene.area_lights.face).tolist()) == set(range(2, 14))


def test_render_settings(everything):
    render = everything.render
    assert (render.method, render.samples, render.seed, render.max_scatterings) == ("direct", 16, 7, 3)
    assert render.russian_roulette is False and render.exposure == -1.5
    assert render.options == {"direct": {"num_steps": 32}}


def test_config_is_complete_and_json(everything):
    config = json.loads(json.dumps(everything.config))
    assert config["medium"]["scattering"] == [0.5, 1.0, 1.5] and config["lights"][1]["angle"] == 30
    assert make_scene(config | {"render": {}}).config["medium"] == config["medium"], "the record rebuilds the scene"


def test_absent_is_none():
    file = make_scene({})
    scene = file.scene
    assert file.camera is None and scene.mesh is None and scene.medium is None and scene.environment is None
    assert scene.point_lights is scene.spot_lights is scene.directional_lights is scene.area_lights is None
    assert "no light" in file.notes[0]


def test_a_black_environment_is_no_environment():
    assert make_scene({"lights": [{"kind": "environment", "radiance": 0}]}).scene.environment is None


def test_spot_falloff_default():
    spot = {"kind": "spot", "position": [0, 0, 0], "direction": [1, 0, 0], "intensity": 1, "angle": 40}
    assert np.degrees(make_scene({"lights": [spot]}).scene.spot_lights.falloff) == pytest.approx(30)


def test_arrays_from_python():
    density = np.linspace(0, 1, 24).reshape(2, 3, 4)
    triangle = (np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], np.float32), np.array([[0, 1, 2]]))
    file = make_scene(
        {
            "camera": {"origin": np.array([0.0, 0, 4]), "target": (0, 0, 0), "width": np.int64(8), "height": 8},
            "medium": {
                "density": density,
                "bounds": np.array([[-1, -1, -1], [1, 1, 1]]),
                "scattering": np.float32(2),
                "phase": [1.0, 0.5, 0.25],
            },
            "shapes": [{"mesh": triangle, "reflectance": np.array([0.8, 0.2, 0.2])}],
            "lights": [{"kind": "point", "position": [0, 3, 0], "intensity": np.float64(10)}],
        }
    )
    medium = file.scene.medium
    assert np.allclose(medium.density, density) and medium.density.dtype == np.float32
    assert medium.majorants is not None and float(np.max(medium.majorants.density)) == 1.0
    assert np.allclose(medium.sigma_s, 2) and float(medium.g) == 0.5 and medium.phase is not None
    assert file.scene.mesh.faces.shape == (1, 3)
    json.dumps(file.config)


def test_a_mesh_bounds_its_medium():
    file = make_scene({"medium": {"shape": "builtin:sphere", "scattering": 5}})
    medium = file.scene.medium
    low, high = np.asarray(medium.bounds)
    assert (low < -1).all() and (low > -1.01).all() and (high > 1).all() and (high < 1.01).all()
    assert medium.boundary.faces.shape == (20480, 3)


@pytest.mark.parametrize(
    ("name", "content"),
    [("m.json", "[1, 0.6, 0.3]"), ("m2.json", '{"moments": [1, 0.6, 0.3]}'), ("m.txt", "1 0.6\n0.3\n"), ("m.npz", None)],
)
def test_moment_files(tmp_path, name, content):
    if content is None:
        np.savez(tmp_path / name, moments=[1, 0.6, 0.3])
    else:
        (tmp_path / name).write_text(content)
    assert read_moments(tmp_path / name).tolist() == [1, 0.6, 0.3]
    medium = {"bounds": [[0, 0, 0], [1, 1, 1]], "phase": name}
    assert float(make_scene({"medium": medium}, base=tmp_path).scene.medium.g) == pytest.approx(0.6)


# --- overrides


@pytest.mark.parametrize(
    ("override", "get", "value"),
    [
        ("medium.anisotropy=-0.5", lambda f: float(f.scene.medium.g), -0.5),
        ("shapes.0.reflectance=[0.9, 0.8, 0.7]", lambda f: f.scene.mesh.albedo[0].tolist(), [0.9, 0.8, 0.7]),
        ("lights.1.intensity=3", lambda f: f.scene.spot_lights.intensity[0].tolist(), [3, 3, 3]),
        ("medium.inclusions.1.absorption=.5", lambda f: f.scene.medium.inclusions[1].sigma_a.tolist(), [0.5] * 3),
        ("camera.width = 48", lambda f: f.camera.width, 48),
        ("render.method=path_tracing", lambda f: f.render.method, "path_tracing"),
        ("render.direct.num_steps=8", lambda f: f.render.options["direct"]["num_steps"], 8),
        ("shapes.1.transform.translate=[0,9,0]", lambda f: float(f.scene.mesh.vertices[:, 1].max()), 10.0),
        ("shapes.0.flip_normals=true", lambda f: ray_casting.face_normals(f.scene.mesh)[0].tolist(), [0, -1, 0]),
        ("render.exposure=auto", lambda f: f.render.exposure, "auto"),
    ],
)
def test_set_overrides_any_key(override, get, value):
    got = get(make_scene(apply_overrides(tomllib.loads(EVERYTHING), [override])))
    assert got == pytest.approx(value) if not isinstance(value, str) else got == value


def test_overrides_do_not_touch_the_table_and_apply_in_order():
    table = {"a": {"b": [1, 2]}}
    assert apply_overrides(table, ["a.b.1=5", "a.b.1=6", "c.d=x"]) == {"a": {"b": [1, 6]}, "c": {"d": "x"}}
    assert table == {"a": {"b": [1, 2]}}


@pytest.mark.parametrize("bad", ["medium", "=3", "a..b=3", "lights.9.intensity=1", "lights.x=1", "camera.width.a=1"])
def test_malformed_overrides_are_refused(bad):
    with pytest.raises(ValueError, match="--set"):
        apply_overrides(tomllib.loads(EVERYTHING), [bad])


# --- files


def test_paths_are_relative_to_the_scene_file(tmp_path):
    (tmp_path / "sub").mkdir()
    mesh = meshes.builtin("box")
    lines = [f"v {x} {y} {z}" for x, y, z in mesh.vertices] + [f"f {a + 1} {b + 1} {c + 1}" for a, b, c in mesh.faces]
    (tmp_path / "box.obj").write_text("\n".join(lines))
    (tmp_path / "sub" / "scene.toml").write_text('[[shapes]]\nmesh = "../box.obj"\n')
    file = load_scene(tmp_path / "sub" / "scene.toml")
    assert file.name == "scene" and file.scene.mesh.faces.shape == (12, 3)


def test_given_bounds_stretch_the_grid(tmp_path):
    density = np.ones((2, 3, 4), np.float32)
    np.savez(tmp_path / "a.npz", density=density, world_min=[0.0, 0, 0], world_max=[2.0, 3, 4])
    medium = {"density": "a.npz"}
    own = make_scene({"medium": medium}, base=tmp_path).scene.medium
    assert np.allclose(own.bounds, [[0, 0, 0], [2, 3, 4]])
    stretched = make_scene({"medium": medium | {"bounds": [[0, 0, 0], [1, 1, 1]]}}, base=tmp_path).scene.medium
    assert np.allclose(stretched.bounds, [[0, 0, 0], [1, 1, 1]]) and stretched.density.shape == (2, 3, 4)


@pytest.mark.parametrize("name", ["plume", "cumulus", "checker"])
def test_builtin_densities(name):
    medium = {"density": f"builtin:{name}", "resolution": 16, "seed": 3}
    got = make_scene({"medium": medium}).scene.medium
    again = make_scene({"medium": medium}).scene.medium
    assert max(got.density.shape) == 16
    assert float(got.density.max()) > 0 and np.array_equal(got.density, again.density)


def test_every_example_scene_loads(root):
    paths = sorted((root / "experiments" / "scenes").glob("*.toml"))
    assert len(paths) >= 3
    for path in paths:
        text = path.read_text()
        if "shared/data" in text and not (root.parent / "shared" / "data").is_dir():
            continue
        file = load_scene(path, overrides=["medium.resolution=16"] if "\nresolution" in text else ())
        assert file.camera is not None


# --- schema


def test_schema_knows_every_key_and_refuses_others():
    schema = scene_config.json_schema()
    assert set(schema["properties"]) == {"camera", "medium", "shapes", "lights", "render"}
    keys = set(schema["$defs"]["MediumTable"]["properties"])
    assert keys >= {"density", "bounds", "scattering", "absorption", "anisotropy", "phase", "refractive_index", "shape"}
    assert all(d["additionalProperties"] is False for d in schema["$defs"].values() if d.get("type") == "object")
    assert "options" not in schema["$defs"]["RenderTable"]["properties"]
    assert "direct" in schema["$defs"]["RenderTable"]["properties"]
    json.dumps(schema, allow_nan=False)


def test_every_table_of_the_schema_is_explained():
    for name, table in inspect.getmembers(scene_config, inspect.isclass):
        if issubclass(table, scene_config.Table):
            assert table.__doc__, name
