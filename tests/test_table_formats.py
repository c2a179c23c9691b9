"""The shading-language lookup of docs/tables.md compiled and compared with ours; the texture; the commands."""

import ctypes
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from jaxvol import image, tables
from jaxvol.fit import table_config, texture, zonal_axis, zonal_tables

ROOT = Path(__file__).resolve().parents[1]
SHIM = """
#include <math.h>
#define in
#define exp expf
#define log logf
static float clamp(float x, float a, float b) { return x < a ? a : x > b ? b : x; }
"""


@pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler to run the shading-language block with")
def test_shader_lookup(tmp_path):
    block = re.search(r"```glsl\n(.*?)```", (ROOT / "docs" / "tables.md").read_text(), re.S).group(1)
    (tmp_path / "lookup.c").write_text(SHIM + block)
    library = tmp_path / "lookup.so"
    subprocess.run(["cc", "-shared", "-fPIC", "-O1", str(tmp_path / "lookup.c"), "-o", str(library), "-lm"], check=True)
    function = ctypes.CDLL(str(library)).zonal_coefficient
    function.restype = ctypes.c_float
    arrays = tables.default_file().arrays
    coefficients = np.ascontiguousarray(arrays["point.compact"].T, dtype=np.float32)
    pointer = coefficients.ctypes.data_as(ctypes.POINTER(ctypes.c_float))
    low, high = arrays["point.compact_range"]
    for distance, sigma_s, sigma_t in ((0.5, 0.3, 1.0), (2.0, 3.0, 4.0), (30.0, 0.1, 0.4)):
        tau = sigma_t * distance
        truth = sigma_s / distance * zonal_tables.point_table(tau)[0] * np.exp(-tau)
        for band in (0, 1, 5, 10):
            numbers = [ctypes.c_float(v) for v in (distance, sigma_s, sigma_t, low, high)]
            assert abs(function(pointer, band, *numbers) / truth[band] - 1) < 1e-5


def test_texture(tmp_path):
    config = table_config.parse(
        {"order": 4, "texture": {"num_bins": 12, "num_angles": 3, "albedo": 0.5}, "multiple": {"bounces": 2}}
    )
    texture.save(tmp_path / "t.exr", config, tables.seal({}, {"config": {}}))
    channels, metadata = image.read_exr(tmp_path / "t.exr")[:2]
    assert metadata["format"] == tables.FORMAT
    assert channels["G"].shape == (texture.rows(config), 12) == (4 * 5 + 3, 12)
    tau = texture.bin_tau(config)
    np.testing.assert_allclose(channels["G"][:4].T, zonal_tables.point_table(tau, order=4), rtol=1e-6)
    np.testing.assert_allclose(channels["R"][4:8].T, zonal_tables.directional_table(tau, order=4, g=0.5), rtol=1e-5, atol=1e-6)
    half = zonal_tables.area_table(tau, texture.angles(config)[1], order=4)[:, 0]
    psi = zonal_axis.optimal_linear(half)
    np.testing.assert_allclose(channels["G"][12:16].T, zonal_axis.project(half, psi), rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(channels["G"][21], np.sin(psi), rtol=1e-5)
    assert np.all(channels["A"][:4] > 0)


def command(*arguments, cwd):
    return subprocess.run(
        [sys.executable, "-m", "jaxvol", *arguments], cwd=cwd, capture_output=True, text=True, timeout=300, env=None
    )


@pytest.mark.slow
def test_commands(tmp_path):
    (tmp_path / "t.toml").write_text('emitters = ["point"]\norder = 3\nmoments = 2\n')
    done = command("tabulate", str(tmp_path / "t.toml"), "--out", str(tmp_path / "t.npz"), cwd=ROOT)
    assert done.returncode == 0, done.stderr
    assert not (tmp_path / "t.npz.parts").exists()
    assert command("tabulate", "--verify", str(tmp_path / "t.npz"), cwd=ROOT).returncode == 0
    table = tables.load(tmp_path / "t.npz")
    arrays = {**table.arrays, "point.single": table.arrays["point.single"] * 1.01}
    tables.save(tmp_path / "wrong.npz", tables.seal(arrays, table.metadata))
    assert command("tabulate", "--verify", str(tmp_path / "wrong.npz"), cwd=ROOT).returncode == 1
    (tmp_path / "bad.toml").write_text('emitters = ["lamp"]\n')
    failed = command("tabulate", str(tmp_path / "bad.toml"), cwd=ROOT)
    assert failed.returncode == 2 and failed.stderr.count("\n") == 1 and "lamp" in failed.stderr
