"""Bad and extreme input (issue section 7): each gets one clear line or a correct, finite picture."""

import copy
import subprocess
import sys
from pathlib import Path

import numpy as np
import OpenEXR
import pytest
import trimesh

from jaxvol.layers import SURFACE, VOLUME, items, total
from jaxvol.methods import path_tracing
from jaxvol.scene import load_scene, make_scene

BOX = [[-1, -1, -1], [1, 1, 1]]
CAMERA = {"origin": [0, 0.5, 5], "target": [0, 0, 0], "fov_y": 40, "width": 8, "height": 8}
GRID = np.full((4, 4, 4), 0.5)


def refused(config, *parts, base="."):
    """The one line by which a scene is refused; it must name all of `parts`."""
    with pytest.raises(ValueError) as caught:
        make_scene(config, base=base)
    line = str(caught.value)
    assert "\n" not in line and len(line) < 400
    for part in parts:
        assert part in line, line
    return line


def medium(**keys):
    return {"medium": {"bounds": BOX} | keys}


# --- grids


@pytest.mark.parametrize("shape", [(0, 4, 4), (0, 0, 0)])
def test_empty_grids(shape):
    refused(medium(density=np.zeros(shape)), "medium.density", "none of length 0", str(list(shape)))


@pytest.mark.parametrize(
    ("value", "complaint"),
    [(np.nan, "1 of 64 values are not finite"), (np.inf, "not finite"), (-0.5, "1 of 64 values are below 0")],
)
def test_densities_that_are_not_finite_or_negative(value, complaint):
    grid = GRID.copy()
    grid[1, 2, 3] = value
    refused(medium(density=grid), "medium.density", complaint)


def test_grids_of_other_things():
    refused(medium(density=np.zeros((2, 2, 2), complex)), "medium.density", "numbers")
    refused(medium(density=np.zeros((2, 2))), "medium.density")
    refused(medium(density="builtin:smoke"), "medium.density", "plume")
    refused(medium(refractive_index=np.full((2, 2, 2), 0.0)), "medium.refractive_index", "below 0.1")


@pytest.mark.parametrize("name", ["a.npz", "a.vdb", "a.vol"])
@pytest.mark.parametrize("content", [b"", b"PK\x03\x04", b"VOL\x03\x01\0\0\0", bytes(range(256)) * 4])
def test_broken_volumes(tmp_path, name, content):
    (tmp_path / name).write_bytes(content)
    refused({"medium": {"density": name}}, "medium.density", name, base=tmp_path)


def test_missing_and_wrong_files_are_named(tmp_path):
    refused({"medium": {"density": "gone.vdb"}}, "medium.density", "gone.vdb does not exist", base=tmp_path)
    refused({"medium": {"density": "a.png"}}, "medium.density", ".npz, .vdb, .vol", base=tmp_path)
    refused({"shapes": [{"mesh": "gone.ply"}]}, "shapes.0.mesh", "gone.ply does not exist", base=tmp_path)
    light = {"kind": "environment", "file": "gone.exr"}
    refused({"lights": [light]}, "lights.0.file", "gone.exr does not exist", base=tmp_path)
    refused(medium(phase="gone.json"), "medium.phase", "gone.json does not exist", base=tmp_path)


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("a.json", "[1, 2"),
        ("a.json", '{"a": 1}'),
        ("a.json", "[0.5, 0.1]"),
        ("a.txt", "1 x"),
        ("a.txt", ""),
        ("a.npz", "no"),
        ("a.csv", "1"),
    ],
)
def test_broken_moments(tmp_path, name, content):
    (tmp_path / name).write_text(content)
    refused(medium(phase=name), "medium.phase", base=tmp_path)


def test_moments_that_are_no_phase_function():
    refused(medium(phase=[1.0, 1.5]), "medium.phase", "[-1, 1]")
    refused(medium(phase=[1.0, 0.99]), "medium.phase", "negative")  # 1 + 3 * 0.99 cos is negative backwards


def test_environments(tmp_path):
    sky = {"kind": "environment", "file": "a.exr"}
    (tmp_path / "a.exr").write_bytes(b"no picture")
    refused({"lights": [sky]}, "lights.0.file", "a.exr", base=tmp_path)

    def write(pixels):
        channels = {c: np.ascontiguousarray(pixels[..., i], np.float32) for i, c in enumerate("RGB")}
        OpenEXR.File({"type": OpenEXR.scanlineimage}, channels).write(str(tmp_path / "a.exr"))

    pixels = np.ones((4, 8, 3))
    pixels[1, 2, 0] = np.nan
    write(pixels)
    refused({"lights": [sky]}, "lights.0.file", "not finite", base=tmp_path)
    pixels[1, 2, 0] = -1e-3
    write(pixels)
    file = make_scene({"lights": [sky]}, base=tmp_path)
    assert "1 of 96 values are negative and count as 0" in file.notes[0]
    assert float(file.scene.environment.radiance.min()) == 0


# --- values


@pytest.mark.parametrize("g", [1, -1, 1.0, -1.0, 1.5, float("nan"), "0.3", True])
def test_anisotropy_out_of_range(g):
    refused(medium(anisotropy=g), "medium.anisotropy", "(-1, 1)")


@pytest.mark.parametrize(
    ("config", "parts"),
    [
        ({"camera": CAMERA | {"width": 0}}, ("camera.width = 0", "[1, 16384]")),
        ({"camera": CAMERA | {"height": 10**9}}, ("camera.height = 1000000000", "[1, 16384]")),
        ({"camera": CAMERA | {"height": -3}}, ("camera.height",)),
        ({"camera": CAMERA | {"width": 16384, "height": 16384}}, ("camera: width * height = 268435456", "33554432")),
        ({"camera": CAMERA | {"width": 1.5}}, ("camera.width", "whole number")),
        ({"camera": CAMERA | {"fov_y": 180}}, ("camera.fov_y = 180", "degrees")),
        ({"camera": CAMERA | {"target": CAMERA["origin"]}}, ("camera.target", "differ from camera.origin")),
        ({"camera": CAMERA | {"up": [0, 0.5, 5]}}, ("camera.up", "parallel")),
        ({"camera": CAMERA | {"up": [0, -1, -10]}}, ("camera.up", "parallel")),
        ({"camera": CAMERA | {"up": [0, 0, 0]}}, ("camera.up", "not all zero")),
        ({"camera": CAMERA | {"origin": [0, 0, float("inf")]}}, ("camera.origin",)),
        ({"camera": {"origin": [0, 0, 1]}}, ("camera.target is missing",)),
        ({"camera": CAMERA | {"focus": 3}}, ("camera", "'focus'", "known: origin")),
        ({"camra": CAMERA}, ("'camra'", "did you mean 'camera'")),
        (medium(scattering=-1), ("medium.scattering", ">= 0")),
        (medium(scattering=[1, 2]), ("medium.scattering", "three numbers")),
        (medium(scattering=float("nan")), ("medium.scattering",)),
        (medium(bounds=[[0, 0, 0], [1, 0, 1]]), ("medium.bounds", "below the second")),
        (medium(bounds=[[0, 0, 0], [1, 1, float("inf")]]), ("medium.bounds", "finite")),
        ({"medium": {"density": 1}}, ("medium", "bounds is missing")),
        ({"medium": {"density": GRID}}, ("medium.bounds is missing",)),
        (medium(anisotropy=0.3, phase=[1, 0.5]), ("anisotropy and phase exclude each other",)),
        (medium(density=1e25, scattering=1e10), ("medium.scattering", "1e30")),
        (medium(refractive_index=0), ("medium.refractive_index", "[0.1, 10]")),
        (medium(resolution=8), ("resolution", "builtin")),
        (medium(inclusions=[{"density": 1}]), ("medium.inclusions.0.shape is missing",)),
        ({"shapes": [{"mesh": "builtin:box", "reflectance": 1.01}]}, ("shapes.0.reflectance = 1.01", "[0, 1]")),
        ({"shapes": [{"mesh": "builtin:box", "reflectance": 0.7, "specular": 0.5}]}, ("shapes.0", "specular = 1.2")),
        ({"shapes": [{"mesh": "builtin:teapot"}]}, ("shapes.0.mesh", "builtin:sphere")),
        ({"shapes": [{"mesh": "builtin:box", "transform": {"scale": 0}}]}, ("shapes.0.transform.scale",)),
        ({"shapes": [{"mesh": "builtin:box", "transform": {"rotate": [0, 0, 0, 9]}}]}, ("shapes.0.transform", "axis")),
        ({"lights": [{"kind": "laser"}]}, ("lights.0.kind = 'laser'", "point, spot, directional, environment")),
        ({"lights": [{"kind": "point", "position": [0, 0, 0], "intensity": -1}]}, ("lights.0.intensity",)),
        ({"lights": [{"kind": "directional", "direction": [0, 0, 0], "irradiance": 1}]}, ("lights.0.direction", "zero")),
        ({"lights": [{"kind": "environment", "radiance": 1, "file": "a.exr"}]}, ("either file or radiance",)),
        ({"lights": [{"kind": "environment", "radiance": 1}] * 2}, ("at most one environment",)),
        ({"lights": 3}, ("lights", "[[lights]]")),
        ({"render": {"samples": 0}}, ("render.samples",)),
        ({"render": {"metod": "direct"}}, ("'metod'", "did you mean 'method'")),
        ({"medium": 3}, ("medium", "table")),
    ],
)
def test_bad_values_name_key_value_and_range(config, parts):
    refused(config, *parts)


@pytest.mark.parametrize("text", ["", "[camera", "a = ", "\0\1\2", "camera = 3", "[camera]\norigin = 3"])
def test_scene_files_that_are_none(tmp_path, text):
    (tmp_path / "a.toml").write_text(text)
    if not text:
        assert load_scene(tmp_path / "a.toml").camera is None
        return
    with pytest.raises(ValueError, match=r"a\.toml"):
        load_scene(tmp_path / "a.toml")


def test_unreadable_scene_files(tmp_path):
    for path in (tmp_path, tmp_path / "gone.toml"):
        with pytest.raises(ValueError, match=path.name):
            load_scene(path)
    (tmp_path / "b.toml").write_bytes(b"a = '\xff\xfe'")
    with pytest.raises(ValueError, match=r"b\.toml"):
        load_scene(tmp_path / "b.toml")


def test_holes_in_the_shape_of_a_medium(tmp_path):
    box = trimesh.creation.box()
    trimesh.Trimesh(box.vertices, box.faces[2:], process=False).export(tmp_path / "open.ply")
    refused({"medium": {"shape": "open.ply"}}, "medium.shape", "4 open edges", base=tmp_path)
    inclusion = {"medium": {"bounds": BOX, "inclusions": [{"shape": "open.ply"}]}}
    refused(inclusion, "medium.inclusions.0.shape", "4 open edges", base=tmp_path)


def test_real_mesh_with_holes(shared_data):
    refused({"medium": {"shape": str(shared_data / "meshes" / "suzanne_cc0.ply")}}, "medium.shape", "160 open edges")


def test_a_method_that_cannot_bend_rays_says_so(tmp_path):
    (tmp_path / "a.toml").write_text(
        "[camera]\norigin = [0, 0, 5]\ntarget = [0, 0, 0]\n"
        "[medium]\nbounds = [[-1, -1, -1], [1, 1, 1]]\nrefractive_index = 1.5\n"
        '[[lights]]\nkind = "point"\nposition = [0, 2, 0]\nintensity = 1\n'
    )
    command = [sys.executable, "-m", "jaxvol", "render", "a.toml"]
    got = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path, timeout=120)
    assert got.returncode == 2
    (line,) = (line for line in got.stderr.splitlines() if line.startswith("error"))
    assert "refractive_index" in line and not list(Path(tmp_path / "out").glob("*"))


# --- extreme input that must render: one small scene, its values changed one at a time

SCENE = {
    "camera": CAMERA,
    "medium": {"density": 1.0, "bounds": BOX, "scattering": 0.5, "absorption": 0.1, "anisotropy": 0.2},
    "shapes": [{"mesh": "builtin:plane", "reflectance": 0.6, "transform": {"scale": 0.9, "translate": [0, -0.8, 0]}}],
    "lights": [{"kind": "point", "position": [0.3, 0.5, 0.2], "intensity": 4.0}],
}


def changed(**changes):
    """SCENE with `table_key=value` (or `table_0_key`) replaced."""
    config = copy.deepcopy(SCENE)
    for path, value in changes.items():
        *heads, last = path.split("__")
        target = config
        for head in heads:
            target = target[int(head)] if isinstance(target, list) else target[head]
        target[last] = value
    return config


def picture(config, samples=16):
    """The layers as numpy arrays, checked to be finite and not negative."""
    file = make_scene(config)
    decided = path_tracing.plan(file.scene, file.camera)
    estimate = path_tracing.render(file.scene, file.camera, decided, seed=0, samples=samples)
    layers = {name: np.asarray(image) for name, image in items(estimate.mean)}
    for name, image in layers.items():
        assert np.isfinite(image).all() and (image >= 0).all(), name
    for name, image in items(estimate.variance):
        assert np.isfinite(np.asarray(image)).all(), f"variance of {name}"
    layers["total"] = np.asarray(total(estimate.mean))
    layers["variance"] = np.asarray(sum(np.asarray(image) for _, image in items(estimate.variance)))
    return layers


@pytest.fixture(scope="module")
def usual():
    return picture(SCENE)


def test_the_usual_picture_has_light_on_surfaces_and_in_the_volume(usual):
    assert usual["surface_from_light"].max() > 0 and usual["volume_from_light"].max() > 0


@pytest.mark.parametrize("position", [[0, 1.0, 0], [1, 1, 1], [0, -0.8, 0], [0, 1.2, 0], [30, 40, 50], [0, 0.5, 5]])
def test_lights_on_the_boundary_outside_on_a_surface_and_on_the_camera(position):
    layers = picture(changed(lights__0__position=position))
    assert layers["total"].max() > 0


def test_black_and_white_surfaces(usual):
    black, white = picture(changed(shapes__0__reflectance=0)), picture(changed(shapes__0__reflectance=1))
    assert all(not black[name].any() for name in SURFACE), "a black surface reflects nothing"
    assert np.allclose(white["surface_from_light"], usual["surface_from_light"] / 0.6, rtol=1e-4)


def test_albedo_of_the_medium_0_and_1(usual):
    dark = picture(changed(medium__scattering=0.0, medium__absorption=0.6))
    assert all(not dark[name].any() for name in VOLUME), "a medium that only absorbs scatters nothing"
    bright = picture(changed(medium__absorption=0.0))
    assert bright["volume_from_light"].sum() > usual["volume_from_light"].sum()


def test_sigma_0_is_no_medium():
    empty = picture(changed(medium__scattering=0.0, medium__absorption=0.0))
    without = changed()
    del without["medium"]
    assert np.allclose(empty["total"], picture(without)["total"], rtol=1e-5, atol=1e-7)


@pytest.mark.parametrize("scale", [1e-12, 1e6])
def test_tiny_and_huge_sigma(scale, usual):
    layers = picture(changed(medium__density=scale))
    if scale < 1:
        clear = changed(medium__scattering=0.0, medium__absorption=0.0)
        assert np.allclose(layers["surface_from_light"], picture(clear)["surface_from_light"], rtol=1e-4)
        assert layers["volume_from_light"].max() < 1e-6
    else:
        middle = layers["surface_from_light"][3:5, 3:5]
        assert not middle.any(), "nothing is seen through an optical thickness of a million"


def test_cameras_that_look_away_or_stand_inside():
    away = picture(changed(camera__target=[0, 0.5, 10]))
    assert not away["total"].any()
    assert picture(changed(camera__origin=[0.1, 0.2, 0.3]))["total"].max() > 0


@pytest.mark.parametrize("g", [-0.999, 0.999])
def test_extreme_anisotropy(g):
    assert picture(changed(medium__anisotropy=g))["total"].max() > 0


@pytest.mark.parametrize("grid", [np.ones((1, 1, 1)), np.zeros((3, 3, 3))], ids=["one voxel", "all zero"])
def test_trivial_grids(grid, usual):
    layers = picture(changed(medium__density=grid), samples=64)
    if not grid.any():
        assert all(not layers[name].any() for name in VOLUME)
        return
    truth = picture(SCENE, samples=64)  # the homogeneous medium: the same, within noise
    error = np.sqrt(layers["variance"].sum() + truth["variance"].sum())
    assert error < 0.2 * truth["total"].sum()
    assert abs(layers["total"].sum() - truth["total"].sum()) < 4 * error
