"""What the README shows works as it stands there."""

import re
import tomllib

import pytest

from jaxvol import scene_config
from jaxvol.cli import COMMANDS
from jaxvol.scene import make_scene


@pytest.fixture(scope="module")
def readme(root):
    return (root / "README.md").read_text()


def block(readme, language):
    return re.search(rf"```{language}\n(.*?)```", readme, re.DOTALL)[1]


def test_the_scene_file_loads_and_names_every_key(readme):
    text = block(readme, "toml")
    file = make_scene(tomllib.loads(text))
    assert file.scene.mesh.faces.shape == (36, 3) and len(file.scene.medium.inclusions) == 1
    tables = ("CameraTable", "MediumTable", "ShapeTable", "PointTable", "SpotTable", "DirectionalTable", "EnvironmentTable")
    for table in (*tables, "TransformTable", "RenderTable"):
        for key in getattr(scene_config, table).model_fields:
            assert key in text or key in ("options", "layers"), f"{table}.{key} is not explained"


def test_commands_files_and_methods_exist(root, readme):
    for command in COMMANDS:
        assert f"jaxvol {command}" in readme
    for picture in re.findall(r'src="([^"]+)"', readme):
        assert (root / picture).is_file(), picture
        assert (root / picture).stat().st_size < 400_000
    for method in scene_config.method_names():
        assert f"| `{method}` |" in readme
    for target in re.findall(r"`?make ([a-z-]+)", readme):
        assert f"\n{target}:" in (root / "Makefile").read_text()


@pytest.mark.slow
def test_the_python_example_runs(readme, tmp_path, monkeypatch, root):
    code = block(readme, "python")
    assert len(code.strip().splitlines()) == 5
    code = code.replace('"experiments/', f'"{root}/experiments/').replace("=128", "=32").replace("samples=16", "samples=2")
    monkeypatch.chdir(tmp_path)
    exec(compile(code, "README.md", "exec"), {})
    assert (tmp_path / "fog.png").stat().st_size > 500
