"""The command line: what it prints and writes, its exit status, and that nothing is half written."""

import json
import os
import resource
import subprocess
import sys
import tomllib
from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np
import pytest

from jaxvol import cli, image, layers, rendering
from jaxvol.layers import Claim
from jaxvol.types import Estimate, Layers

SCENE = """
[camera]
origin = [0, 1, 5]
target = [0, 1, 0]
width = 8
height = 8

[medium]
bounds = [[-1, 0, -1], [1, 2, 1]]
scattering = 0.5

[[shapes]]
mesh = "builtin:plane"

[[lights]]
kind = "point"
position = [0, 1.5, 0]
intensity = 5
"""


@pytest.fixture
def scene(tmp_path):
    path = tmp_path / "tiny.toml"
    path.write_text(SCENE)
    return path


def run(*arguments):
    """Exit status of the command, run in this process."""
    with pytest.raises(SystemExit) as stop:
        cli.main(arguments=[str(argument) for argument in arguments])
    return stop.value.code or 0


def fake_method(value=1.0):
    """A method that paints one layer, deterministic and at once."""

    def plan(scene, camera, *, num_steps: int = 4, mode: str = "fast"):
        return SimpleNamespace(skipped=("nothing to skip",), num_steps=num_steps)

    def render(scene, camera, plan, *, seed=0, samples=1, on_progress=None, on_stage=None):
        on_progress(0.5)
        on_stage("paint")
        rgb = jnp.full((camera.height, camera.width, 3), value)
        return Estimate(mean=Layers(emission=rgb), diagnostics={"num_steps": jnp.int32(plan.num_steps)})

    claims = (Claim(("emission",)), Claim(("volume_from_light",), partial="half of it"))
    return SimpleNamespace(claims=lambda scene: claims, plan=plan, render=render)


@pytest.fixture
def fake(monkeypatch):
    monkeypatch.setattr(rendering, "load_method", lambda name: fake_method())


# --- the whole program, in its own process


def program(*arguments, **options):
    return subprocess.run([sys.executable, "-m", "jaxvol", *arguments], capture_output=True, text=True, timeout=120, **options)


def test_help_lists_the_commands_without_importing_jax():
    code = "import sys, jaxvol.cli\ntry: jaxvol.cli.main(arguments=['--help'])\nexcept SystemExit: print('jax' in sys.modules)"
    got = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert got.stdout.rstrip().endswith("False")
    for name in ("render", "compare", "schema"):
        assert f"\n  {name} " in got.stdout


def test_bad_input_ends_with_status_2_and_one_line(tmp_path):
    got = program("render", tmp_path / "gone.toml")
    assert got.returncode == 2 and got.stdout == ""
    assert got.stderr.count("\n") == 1 and "gone.toml does not exist" in got.stderr


def test_an_unwritable_home_only_costs_the_cache(tmp_path):
    (tmp_path / "file").write_text("")
    environment = {k: v for k, v in os.environ.items() if k != "JAX_COMPILATION_CACHE_DIR"}
    got = program("schema", env=environment | {"HOME": str(tmp_path / "file"), "XDG_CACHE_HOME": str(tmp_path / "file" / "x")})
    assert got.returncode == 0 and json.loads(got.stdout)["title"] == "jaxvol scene"
    assert got.stderr == ""


# --- commands


def test_schema_is_json(capsys):
    assert run("schema") == 0
    assert "medium" in json.loads(capsys.readouterr().out)["properties"]


def test_unknown_commands_and_options_end_with_status_2(capsys, scene):
    assert run("rendr") == 2
    assert "render" in capsys.readouterr().err
    assert run("render", scene, "--sampels", 3) == 2


def test_render_writes_exr_png_and_json(fake, scene, tmp_path, capsys):
    out = tmp_path / "deep" / "out"
    options = ("--set", "camera.width=6", "--set", "render.path_tracing.num_steps=9", "--samples", 3, "--seed", 4)
    assert run("render", scene, "--out", out, *options) == 0
    assert sorted(path.name for path in out.iterdir()) == ["tiny.exr", "tiny.json", "tiny.png"]
    report = json.loads((out / "tiny.json").read_text())
    assert set(report["seconds"]) == {"plan", "compile", "run"} and all(t >= 0 for t in report["seconds"].values())
    assert list(report["stages"]) == ["paint"]
    assert report["claims"][1] == {"layers": "volume_from_light", "partial": "half of it"}
    assert report["skipped"] == ["nothing to skip"] and report["nonfinite_pixels"] == 0
    assert report["device"].startswith("cpu") and set(report["versions"]) >= {"jaxvol", "jax", "jaxlib"}
    assert report["arguments"] == {"num_steps": 9, "samples": 3, "seed": 4} and report["diagnostics"] == {"num_steps": 9}
    picture = image.read_picture(out / "tiny.exr")
    assert picture.rgb.shape == (8, 6, 3) and np.all(picture.rgb == 1)
    assert picture.metadata["seed"] == 4 and picture.metadata["config"]["camera"]["width"] == 6
    printed = capsys.readouterr().out
    assert "tiny.png" in printed and "stops" in printed and "tiny.exr" in printed and "first picture" in printed


def test_exposure_of_the_scene_file_is_kept(fake, scene, tmp_path, capsys):
    assert run("render", scene, "--out", tmp_path, "--set", "render.exposure=-2") == 0
    assert "exposure -2.00 stops" in capsys.readouterr().out


def test_explain(fake, scene, tmp_path, capsys):
    assert run("render", scene, "--out", tmp_path, "--explain") == 0
    printed = capsys.readouterr().out
    assert "homogeneous medium" in printed and "no inclusions" in printed
    assert "path_tracing skips: nothing to skip" in printed
    assert "volume_from_light, partly: half of it" in printed
    assert "does not compute surface_from_light" in printed


def test_the_lattice_warns_of_coarse_voxels_and_of_a_solve_that_ended_early(scene, tmp_path, capsys):
    options = ["--method", "lattice_boltzmann", "--set", "medium.scattering=20"]
    own = ["resolution=8", "max_applications=1", "surface_rays=0", "tolerance=1e-6", "samples_per_pixel=1"]
    for key in own:
        options += ["--set", f"render.lattice_boltzmann.{key}"]
    assert run("render", scene, "--out", tmp_path, *options) == 0
    told = capsys.readouterr().err
    assert "warning: sigma_t' h = 5 is coarse for the lattice; resolution = 40 brings it to 1" in told
    assert "warning: the solve did not converge, residual" in told


def test_pixels_that_are_not_finite_end_with_status_1(monkeypatch, scene, tmp_path, capsys):
    monkeypatch.setattr(rendering, "load_method", lambda name: fake_method(jnp.nan))
    assert run("render", scene, "--out", tmp_path) == 1
    assert json.loads((tmp_path / "tiny.json").read_text())["nonfinite_pixels"] == 64
    assert "64 pixels are not finite" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("option", "complaint"),
    [
        ("render.path_tracing.num_step=3", "unknown key 'num_step'; did you mean 'num_steps'"),
        ("render.path_tracing.num_steps=[1]", "render.path_tracing.num_steps = [1] must be int"),
        ("render.method=path_trasing", "did you mean 'path_tracing'"),
        ("render.samples=0", "render.samples = 0 must be a whole number in [1, "),
        ("render.path_tracing=1", "path_tracing must be a table"),
    ],
)
def test_bad_render_options(fake, scene, tmp_path, capsys, option, complaint):
    assert run("render", scene, "--out", tmp_path / "out", "--set", option) == 2
    assert complaint in capsys.readouterr().err


def test_a_scene_without_a_camera_is_refused(fake, tmp_path, capsys):
    (tmp_path / "a.toml").write_text('[[shapes]]\nmesh = "builtin:box"\n')
    assert run("render", tmp_path / "a.toml", "--out", tmp_path) == 2
    assert "camera is missing" in capsys.readouterr().err


# --- nothing half written


def test_an_output_folder_that_cannot_be_made_is_refused_before_rendering(monkeypatch, scene, tmp_path, capsys):
    monkeypatch.setattr(rendering, "render_scene", lambda *_, **__: pytest.fail("rendered in vain"))
    (tmp_path / "file").write_text("")
    assert run("render", scene, "--out", tmp_path / "file" / "out") == 2
    assert capsys.readouterr().err.count("\n") == 1
    assert run("render", scene, "--out", tmp_path / "file") == 2


def test_a_disk_that_fills_leaves_no_half_written_file(fake, scene, tmp_path, capsys):
    assert run("render", scene, "--out", tmp_path / "warm") == 0  # compiles, so that JAX's own cache needs no disk below
    out = tmp_path / "out"
    out.mkdir()
    (out / "tiny.exr").write_bytes(b"the picture of yesterday")
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (300, hard))  # writing beyond 300 bytes fails, as on a full disk
    try:
        status = run("render", scene, "--out", out)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert status == 2
    assert [path.name for path in out.iterdir()] == ["tiny.exr"]
    assert (out / "tiny.exr").read_bytes() == b"the picture of yesterday"
    assert capsys.readouterr().err.strip().splitlines()[-1].startswith("error: cannot write the picture into ")


# --- the real thing


def test_render_and_compare_with_the_reference(scene, tmp_path, capsys):
    assert run("render", scene, "--out", tmp_path / "a", "--samples", 4) == 0
    assert run("render", scene, "--out", tmp_path / "b", "--samples", 4, "--seed", 1) == 0
    capsys.readouterr()
    picture = image.read_picture(tmp_path / "a" / "tiny.exr")
    names = [name for name, _ in layers.items(picture.layers)]
    assert names == list(layers.NAMES) and picture.variance is not None
    assert np.allclose(layers.total(picture.layers), picture.rgb, rtol=1e-5, atol=1e-6)
    assert picture.rgb.max() > 0
    assert run("compare", tmp_path / "a" / "tiny.exr", tmp_path / "b" / "tiny.exr") == 0
    errors = json.loads(capsys.readouterr().out)
    assert 0 < errors["relative_l1"] < 2
    assert run("compare", tmp_path / "a" / "tiny.exr", tmp_path / "a" / "tiny.exr") == 0
    assert json.loads(capsys.readouterr().out)["relative_l1"] == 0


def test_two_values_of_a_float_share_one_compilation(scene, tmp_path):
    assert run("render", scene, "--out", tmp_path, "--samples", 1) == 0
    assert run("render", scene, "--out", tmp_path, "--samples", 1, "--set", "medium.scattering=0.6") == 0
    assert json.loads((tmp_path / "tiny.json").read_text())["seconds"]["compile"] < 1.0


def test_the_registered_commands_exist(root):
    for name in cli.COMMANDS:
        assert (root / "jaxvol" / "commands" / f"{name}.py").is_file()


def test_the_console_script_is_declared(root):
    scripts = tomllib.loads((root / "pyproject.toml").read_text())["project"]["scripts"]
    assert scripts == {"jaxvol": "jaxvol.cli:main"}
