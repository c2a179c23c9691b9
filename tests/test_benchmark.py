"""The benchmark: its files, what it measures, its tables against numbers worked out by hand, and that it goes on."""

import json
import math
import os
from functools import partial

import jax
import numpy as np
import pytest

from jaxvol import image, layers
from jaxvol.benchmark import driver, errors, measure, report, runners, workers
from jaxvol.benchmark.config import BenchmarkTable, ReferenceTable, load_config
from jaxvol.benchmark.references import reference, reference_path
from jaxvol.jobs import Stop
from jaxvol.types import Layers
from tests.test_cli import SCENE, run

CONFIG = """
repeats = 1
block = 2
[reference]
seconds = 0.5
[mitsuba]
enabled = false
[[scenes]]
file = "tiny.toml"
width = 8
height = 6
[[methods]]
name = "path_tracing"
settings = [{ samples = 2 }, { samples = 8 }]
[[methods]]
name = "mine"
entry = "tests.test_benchmark:fog_only"
rays_per_pixel = 16
[[methods]]
name = "lattice_boltzmann"
settings = [{ resolution = 1 }, { resolution = 4 }]
curves = []
[[scaling]]
name = "pixels"
scene = "tiny"
method = "path_tracing"
overrides = ["camera.width={n}", "camera.height={n}", "render.samples=1"]
values = [4, 8]
power = 2
"""


def fog_only(scene, rays, seed):
    """A researcher's method: light scattered once, by the direct quadrature along the given rays."""
    from jaxvol import direct

    plan = direct.plan(scene, None, samples_per_pixel=1, volume_samples_per_pixel=1)
    return Layers(volume_from_light=direct.radiance(scene, rays, plan, seed=seed).volume_from_light)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("benchmark")
    (path / "tiny.toml").write_text(SCENE)
    (path / "config.toml").write_text(CONFIG)
    return path


@pytest.fixture(scope="module")
def ran(folder):
    config = load_config(folder / "config.toml")
    return config, driver.run_benchmark(config, folder, folder / "out")


def test_records_hold_what_a_reader_needs(ran):
    _, records = ran
    traced, more, mine, refused, *curve = records
    assert traced["method"] == "path_tracing" and traced["settings"] == {"samples": 2} and more["index"] == 1
    for record in (traced, mine):
        assert {"seconds", "cpu_seconds", "peak_mib", "device", "versions", "errors"} <= set(record)
        assert record["seconds"]["run"] > 0 and record["peak_mib"] > 50
        own = record["errors"]["own"]
        assert {"relmse", "relative_l1", "bias", "p99", "reference_noise"} <= set(own)
    assert set(traced["errors"]) >= {"surface_from_light", "volume_from_light", "own"}
    assert "resolution = 1 must be within [2, 1024]" in refused["refused"]
    assert [r["count"] for r in curve] == [16, 64] and all(r["warm_seconds"] > 0 for r in curve)


def test_a_function_over_rays_gets_its_errors_beside_ours(ran):
    mine = ran[1][2]
    own = mine["errors"]["own"]
    assert mine["names"] == ["volume_from_light"]
    # The quadrature has no noise: what is left is the reference's and that of 16 rays a pixel.
    assert own["relative_l1"] < 3 * own["reference_noise"] + 0.1


def test_a_finished_benchmark_runs_nothing_again(ran, folder, monkeypatch):
    config, records = ran
    monkeypatch.setattr(runners, "run_method", lambda *_, **__: pytest.fail("ran again"))
    assert driver.run_benchmark(config, folder, folder / "out") == records
    lines = (folder / "out" / driver.RESULTS).read_text().splitlines()
    (folder / "out" / driver.RESULTS).write_text("\n".join([*lines, '{"key": "cut sho']))
    assert len(driver.read_records(folder / "out")) == len(lines)
    (folder / "out" / driver.RESULTS).write_text("\n".join(["{", *lines]))
    with pytest.raises(ValueError, match="line 1 is no result"):
        driver.read_records(folder / "out")
    (folder / "out" / driver.RESULTS).write_text("\n".join(lines) + "\n")


def test_the_command_prints_table_curves_and_refusals(ran, folder, capsys):
    assert run("benchmark", folder / "config.toml", "--out", folder / "out") == 0
    printed = capsys.readouterr().out
    for words in ("x PT", "mine", "LVE", "refused: tiny, lattice_boltzmann", "exponent", "tiny.work_precision.png"):
        assert words in printed
    summary = json.loads((folder / "out" / "summary.json").read_text())
    assert {row["method"] for row in summary["equal_error"]} == {"path_tracing", "mine"}


def test_references_are_kept_by_scene_hash(folder, monkeypatch):
    entry = load_config(folder / "config.toml").scenes[0]
    settings = ReferenceTable(seconds=0.5)
    file, other = (runners.load_file(entry, folder, overrides=o) for o in ((), ("medium.scattering=0.6",)))
    kept = reference_path(file, settings, folder / "out" / "references")
    assert kept.exists() and reference_path(other, settings, kept.parent) != kept
    from jaxvol.methods import path_tracing

    monkeypatch.setattr(path_tracing, "render", lambda *_, **__: pytest.fail("traced again"))
    assert reference(file, settings, kept.parent).variance is not None


def test_equal_error_table_by_hand(tmp_path):
    """A method with relMSE .01 in 2 s against a path tracer whose noise is .04 after 1 s: 4 s, twice as fast."""
    shape = (8, 8, 3)
    truth = image.Picture(np.ones(shape), Layers(volume_from_light=np.ones(shape)))
    noise = 0.04 * 1.01
    channels = {c: np.ones((8, 8)) for c in "RGB"}
    channels |= {f"volume_from_light.{c}": np.ones((8, 8)) for c in "RGB"}
    channels |= {f"variance.volume_from_light.{c}": np.full((8, 8), noise) for c in "RGB"}
    image.write_exr(tmp_path / "pt.exr", channels)
    own = {"relmse": 0.01, "relmse_error": 1e-4, "relative_l1": 0.1, "bias": 0.0, "p99": 0.2, "reference_noise": 0.01}
    base = {"scene": "s", "index": 0, "cpu_seconds": 1.0, "peak_mib": 1.0, "seconds": {"compile": 1.0}, "claims": []}
    base |= {"names": ["volume_from_light"], "lit": ["volume_from_light"], "errors": {"own": own}}
    records = [
        base | {"method": "path_tracing", "warm_seconds": 1.0, "picture": "pt.exr"},
        base | {"method": "fast", "warm_seconds": 2.0},
        base | {"method": "vague", "warm_seconds": 2.0, "errors": {"own": own | {"relmse": 0.001, "relmse_error": 0.001}}},
        base | {"method": "mitsuba", "warm_seconds": 3.0, "errors": {"own": {"relmse": 0.02, "relmse_error": 0.0}}},
    ]
    _, fast, vague = report.equal_error(records, tmp_path, {"s": truth})
    assert fast["path_tracing_seconds"] == pytest.approx(4.0, rel=1e-5) and fast["path_tracing_speedup"] == pytest.approx(
        2.0, rel=1e-5
    )
    assert fast["mitsuba_seconds"] == pytest.approx(6.0)  # .02 after 3 s
    assert vague["at_least"] and vague["relmse"] == pytest.approx(0.003) and not fast["at_least"]
    text = report.table_text([fast, vague])
    assert "LVE" in text and ">13" in text


def test_exponents_of_straight_lines():
    def curve(name, seconds):
        counts = [100, 200, 400, 800]
        return [{"scaling": name, "scene": "s", "method": "m", "count": c, "warm_seconds": seconds(c)} for c in counts]

    line, fixed = report.exponents(curve("line", lambda c: 3e-6 * c) + curve("fixed", lambda c: 1e-3 + 1e-6 * c))
    assert line["exponent"] == pytest.approx(1.0) and line["fixed_seconds"] == pytest.approx(0.0, abs=1e-9)
    assert line["nanoseconds_each"] == pytest.approx(3000)
    assert fixed["fixed_seconds"] == pytest.approx(1e-3) and 0.1 < fixed["exponent"] < 0.5


def test_errors_take_the_reference_noise_out():
    rng = np.random.default_rng(0)
    sigma = 0.1
    noisy = 1 + sigma * rng.standard_normal((64, 64, 3))
    reference_ = image.Picture(noisy, Layers(emission=noisy), variance=Layers(emission=np.full((64, 64, 3), sigma**2)))
    found = errors.errors_of(Layers(emission=np.ones((64, 64, 3))), reference_, ["emission"], block=4)
    assert abs(found["relmse"]) < 4 * found["relmse_error"] < 2e-3  # without it: .01
    assert found["reference_noise"] == pytest.approx(sigma / 4, rel=0.05)
    dark = image.Picture(noisy, Layers(emission=0 * noisy), variance=Layers(emission=0 * noisy))
    assert errors.errors_of(Layers(emission=noisy), dark, ["emission"], block=1) is None
    assert errors.errors_of(Layers(emission=noisy * np.nan), reference_, ["emission"], block=1)["nonfinite"] == noisy.size


def test_measured_counts_warm_calls_only():
    calls = []
    last, cost = measure.measured(lambda k: calls.append(k) or k, repeats=3)
    assert calls == [0, 1, 2, 3] and last == 3 and cost.seconds <= cost.first_seconds + 1e-3
    _, cost = measure.measured(calls.append, repeats=1, first=measure.First(7.0))
    assert calls[4:] == [1] and cost.first_seconds == 7.0
    with pytest.raises(ValueError, match="no"):
        measure.measured(calls.append, repeats=1, first=measure.First(0.0, ValueError("no")))
    shapes = []  # a call that compiles, as its arrays have another size, is made again

    def grows(k):
        shapes.append(k)
        return jax.block_until_ready(jax.jit(lambda x: x + 1)(np.ones(k + 1))) if len(shapes) == 2 else None

    measure.measured(grows, repeats=2)
    assert shapes == [0, 1, 1, 2]
    measure.reset_peak()
    before = measure.peak_mib()
    block = np.ones(16 << 20)  # 128 MiB
    assert measure.peak_mib() >= before + 100 and block.size


def test_workers_share_calls_and_say_when_one_ends():
    with workers.Workers(2) as several:
        found = several.spread([[os.getpid, os.getpid]] * 3 + [[]])
        pids = {worker: pids[0] for worker, pids in found[:3]}
        assert len(pids) == 2 and os.getpid() not in pids.values() and found[3] == (0, [])
        assert all(own == [pids[worker]] * 2 for worker, own in found[:3])
        assert several.call(1, os.getpid) == pids[1]
        with pytest.raises(ValueError, match="factorial"):
            several.call(0, partial(math.factorial, -1))
        with pytest.raises(RuntimeError, match=r"exit code 3\); the same command goes on"):
            several.call(1, partial(os._exit, 3))
        assert several.call(0, os.getpid) == pids[0]
    stop = Stop()
    with workers.Workers(1) as one:
        groups = [[os.getpid, partial(setattr, stop, "requested", True), os.getpid], [os.getpid]]
        assert one.spread(groups, stop) == [(0, [os.getpid(), None]), (0, [])]


def test_a_composite_takes_turns_with_its_methods_in_one_worker():
    def task(method, seconds=1.0, uses=()):
        return driver.Task(method, "s", method, run=None, compile=partial(measure.First, seconds), uses=uses)

    tasks = [task("a", 2.0), task("a", 0.5), task("b"), task("c"), task("auto", uses=("a", "c"))]
    took = {}
    with workers.Workers(1) as one:
        made = driver._first_calls(tasks, one, took, None)
    assert took == {"a": 2.5, "b": 1.0, "c": 1.0, "auto": 1.0}
    assert set(made) == {"a", "b", "c", "auto"} and made["b"] == (0, measure.First(1.0))


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        ({"methods": [{"name": "path_trasing"}]}, "did you mean 'path_tracing'"),
        ({"methods": [{"name": "direct"}, {"name": "direct"}]}, "two have one name"),
        ({"scenes": [{"file": "a.toml", "methods": ["direkt"]}]}, "did you mean 'direct'"),
        ({"repeats": 0}, "repeats"),
        ({"methods": [{"name": "direct", "curves": ["b"]}]}, "curves: no scene 'b'"),
    ],
)
def test_bad_files(tmp_path, change, complaint):
    table = {"scenes": [{"file": "a.toml"}], "methods": [{"name": "direct"}]} | change
    (tmp_path / "a.toml").write_text("")
    with pytest.raises(ValueError, match=complaint):
        BenchmarkTable.model_validate(table)
    with pytest.raises(ValueError, match="cannot be read"):
        load_config(tmp_path / "gone.toml")


def test_functions_that_cannot_be_loaded():
    for name, complaint in (("no_such_module:f", "cannot be loaded"), ("nobody", "no entry point of that name")):
        with pytest.raises(ValueError, match=complaint):
            runners.load_function(name)
    assert runners.load_function("tests.test_benchmark:fog_only").__name__ == "fog_only"


def test_the_shipped_files_are_sound(root):
    for name in ("benchmark_small", "benchmark_full", "benchmark_scaling"):
        config = load_config(root / "experiments" / f"{name}.toml")
        for scene in config.scenes:
            assert (root / "experiments" / scene.file).is_file()


def test_short_names_cover_all_layers():
    assert set(report.SHORT) == set(layers.NAMES)
