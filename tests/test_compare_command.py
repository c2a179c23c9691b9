"""`jaxvol compare` as a user runs it: JSON alone on stdout, errors that name files."""

import json

import numpy as np
import pytest

from jaxvol import image
from jaxvol.commands.compare import compare

NAMES = ["relmse", "relative_l1", "bias", "p99", "reference_noise"]


def write(path, layers, variance=0.0):
    total = sum(layers.values())
    channels = {}
    for name, value in {"": total, **{f"{name}.": value for name, value in layers.items()}}.items():
        channels |= {name + letter: np.full((8, 6), value, np.float32) for letter in "RGB"}
    for name in layers:
        channels |= {f"variance.{name}.{letter}": np.full((8, 6), variance, np.float32) for letter in "RGB"}
    image.write_exr(path, channels)
    return path


@pytest.fixture
def pair(tmp_path):
    a = write(tmp_path / "a.exr", {"emission": 1.0, "volume_from_light": 3.0})
    reference = write(tmp_path / "r.exr", {"emission": 1.0, "volume_from_light": 1.0}, variance=0.02)
    return a, reference


def run(capsys, *arguments, **options):
    compare(*arguments, **options)
    printed = capsys.readouterr()
    return json.loads(printed.out), printed.err


def test_pictures(pair, capsys):
    errors, notes = run(capsys, *pair)
    assert list(errors)[:5] == NAMES and notes == ""
    assert errors["bias"] == pytest.approx(1) and errors["relative_l1"] == pytest.approx(1)
    assert errors["relmse"] == pytest.approx((4 - 0.04) / (4 + 0.04)) and errors["p99"] == pytest.approx(1)
    assert errors["reference_noise"] == pytest.approx(0.04**0.5 / 2)


def test_layers_and_blocks(pair, capsys):
    assert run(capsys, *pair, layer="emission")[0]["bias"] == 0
    assert run(capsys, *pair, layer="volume_from_light")[0]["bias"] == pytest.approx(2)
    errors, _ = run(capsys, *pair, layer="emission+volume_from_light", block=2)
    assert errors["bias"] == pytest.approx(1) and errors["reference_noise"] == pytest.approx(0.04**0.5 / 2 / 2)


def test_a_picture_that_lacks_layers_is_noted(pair, tmp_path, capsys):
    part = write(tmp_path / "part.exr", {"emission": 1.0})
    errors, notes = run(capsys, part, pair[1])
    assert errors["bias"] == pytest.approx(-0.5) and "volume_from_light" in notes and notes.count("\n") == 1


def test_bad_input(pair, tmp_path):
    with pytest.raises(FileNotFoundError, match="absent"):
        compare(tmp_path / "absent.exr", pair[1])
    with pytest.raises(ValueError, match="a.exr against .*r.exr: layer 'fog' is unknown"):
        compare(*pair, layer="fog")
    with pytest.raises(ValueError, match="block = -1"):
        compare(*pair, block=-1)
    write(tmp_path / "nan.exr", {"emission": np.nan})
    with pytest.raises(ValueError, match="nan.exr against .*144 of 144 values of the image are not finite"):
        compare(tmp_path / "nan.exr", pair[1])
    image.write_exr(tmp_path / "small.exr", {letter: np.ones((3, 3)) for letter in "RGB"})
    with pytest.raises(ValueError, match="of one size"):
        compare(tmp_path / "small.exr", pair[1])
