"""Table files, configurations, the job, and lookups in both precisions."""

import contextlib
import json
import signal
import subprocess
import sys
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxvol import tables, zonal_lookup
from jaxvol.fit import assemble, compact, half_space, job, table_config, wavenumber, zonal_tables

ROOT = Path(__file__).resolve().parents[1]
SMALL = {
    "order": 4,
    "moments": 3,
    "num_tau": 20,
    "area": {"order": 3, "moments": 2, "num_tau": 8, "num_angle": 4},
    "multiple": {"num_tau": 10, "num_albedo": 3, "num_g": 2, "g": [-0.2, 0.2], "albedo": [0.2, 0.6], "bounces": 3,
                 "area": {"num_tau": 8, "num_albedo": 3, "num_g": 2, "source_bands": 4}},
}  # fmt: skip


@pytest.fixture(scope="module")
def small():
    return job.tabulate(table_config.parse(SMALL))


@pytest.fixture(scope="module")
def default():
    return tables.default_file()


@pytest.fixture(scope="module")
def lookups(default):
    return default.lookups()


# -- files


def test_round_trips(tmp_path, small):
    tables.save(tmp_path / "t.npz", small)
    again = tables.load(tmp_path / "t.npz")
    assert again.metadata == small.metadata
    parsed = tables.from_json(tables.to_json(small))
    for other in (again, parsed):
        assert set(other.arrays) == set(small.arrays)
        for name, value in small.arrays.items():
            np.testing.assert_array_equal(other.arrays[name], value)
            assert other.arrays[name].dtype == np.float64


def test_damaged_files_are_refused(tmp_path, small):
    path = tmp_path / "t.npz"
    tables.save(path, small)
    data = path.read_bytes()
    (tmp_path / "cut.npz").write_bytes(data[: len(data) // 2])
    with pytest.raises(ValueError, match=r"cut.npz: is not a whole table"):
        tables.load(tmp_path / "cut.npz")
    edited = dict(small.arrays)
    edited["point.single"] = edited["point.single"] * (1 + 1e-15) + 1e-12
    tables.save(path, tables.TableFile(edited, small.metadata))
    with pytest.raises(ValueError, match="checksum"):
        tables.load(path)
    tables.save(path, tables.TableFile(small.arrays, {**small.metadata, "errors": {}}))
    with pytest.raises(ValueError, match="checksum"):
        tables.load(path)
    np.savez(path, something=np.ones(3))
    with pytest.raises(ValueError, match="not a whole table"):
        tables.load(path)
    path.write_bytes(b"\x93NUMPY nonsense")
    with pytest.raises(ValueError, match="not a whole table"):
        tables.load(path)
    np.savez(path, metadata=np.array([{"a": 1}], dtype=object))
    with pytest.raises(ValueError, match="not a whole table"):
        tables.load(path)
    with pytest.raises(ValueError, match="checksum"):
        tables.from_json(tables.to_json(small).replace("0.2", "0.3", 1))


def test_default_set_is_complete_and_small(default):
    size = (ROOT / "jaxvol" / "data" / "default_tables.npz").stat().st_size
    assert size < 1_000_000
    config = table_config.load(ROOT / "experiments" / "tables" / "default.toml")
    assert default.metadata["config"] == config.model_dump(mode="json")
    expected = {f"{kind}.{field}" for kind in KINDS for field in ("single", "multiple", "bounces")}
    assert expected <= set(default.arrays)


def test_default_set_is_regenerated(default):
    """Single scattering and one slice of each multiple-scattering table; the test after this does the rest."""
    config = table_config.load(ROOT / "experiments" / "tables" / "default.toml")
    for kind in config.emitters:
        fresh = assemble._chebyshev(assemble.compute_part(f"{kind}-single", config)["values"], (0, 2))
        np.testing.assert_allclose(default.arrays[f"{kind}.single"], fresh, atol=1e-8 * np.abs(fresh).max())
    fresh = assemble.compute_part("point-multiple-4", config)["values"]
    g = assemble._gs(config, config.multiple.num_g)[4]
    along_g = compact.evaluate(default.arrays["point.multiple"], [np.arctanh(g)], *default.arrays["g_range"], axis=3)[..., 0, :]
    u = np.sqrt(1 - assemble._albedos(config, config.multiple.num_albedo))
    along_u = compact.evaluate(along_g, u, *default.arrays["albedo_range"], axis=2)
    fresh = compact.transform(fresh)
    np.testing.assert_allclose(along_u, fresh, atol=1e-7 * np.abs(fresh).max())


@pytest.mark.slow
def test_a_killed_command_goes_on_and_regenerates_the_default_set(default, tmp_path):
    """SIGKILL after some parts; the same command computes the rest, and the file equals the one that is shipped."""
    out = tmp_path / "tables.npz"
    command = [sys.executable, "-m", "jaxvol", "tabulate", "experiments/tables/default.toml", "--out", str(out)]
    parts = job.parts_folder(out)
    child = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    while child.poll() is None and len(list(parts.glob("*.npz"))) < 5:
        time.sleep(0.05)
    child.kill()
    assert child.wait() == -signal.SIGKILL, "it ended before it could be killed"
    assert not out.exists()
    # done is what the manifest names: the kill may fall between a part's file and its entry, and that part is computed again
    finished = json.loads((parts / "manifest.json").read_bytes())["parts"]
    files = [parts / f"{name}-{digest[:16]}.npz" for name, digest in finished.items()]
    saved = {path: path.stat().st_mtime_ns for path in files}
    assert len(saved) >= 4
    child = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    seen = {path: set() for path in saved}
    while child.poll() is None:
        for path, times in seen.items():
            with contextlib.suppress(FileNotFoundError):  # the parts go once the table is written
                times.add(path.stat().st_mtime_ns)
        time.sleep(0.05)
    assert child.wait() == 0 and not parts.exists()
    assert seen == {path: {when} for path, when in saved.items()}  # none was computed again
    fresh = tables.load(out)
    for name, value in fresh.arrays.items():
        np.testing.assert_allclose(default.arrays[name], value, atol=1e-7 * np.abs(value).max(), err_msg=name)


# -- configurations


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"emitters": ["spot"]}, "emitters.0 = 'spot': input should be 'point', 'directional' or 'area'"),
        ({"ordr": 3}, "unknown key ordr; did you mean order?"),
        ({"order": -1}, "order = -1: input should be greater than or equal to 1"),
        ({"multiple": {"g": [-1.0, 0.5]}}, "multiple.g.0 = -1.0: input should be greater than -1"),
        ({"multiple": {"bounce_g": [1.0]}}, "multiple.bounce_g.0 = 1.0: input should be less than 1"),
        ({"multiple": {"albedo": [0.0, 1.5]}}, "multiple.albedo.1 = 1.5"),
        ({"multiple": {"num_taus": 3}}, "unknown key multiple.num_taus; did you mean num_tau?"),
        ({"multiple": {"g": [0.5, 0.5]}}, "num_g = 17 does not fit"),
        ({"compact": {"tau": [2.0, 1.0]}}, "must be [low, high]"),
        ({"num_tau": "many"}, "num_tau = 'many'"),
        ({"emitters": []}, "emitters"),
    ],
)
def test_bad_configurations(change, message):
    with pytest.raises(ValueError) as error:
        table_config.parse(change, source="t.toml")
    assert str(error.value).startswith("t.toml: ")
    assert message in str(error.value) and "\n" not in str(error.value)


def test_bad_toml(tmp_path):
    (tmp_path / "t.toml").write_text("order = = 3")
    with pytest.raises(ValueError, match="not valid TOML"):
        table_config.load(tmp_path / "t.toml")
    with pytest.raises(OSError):
        table_config.load(tmp_path / "absent.toml")


# -- job


def test_job_resumes(tmp_path, small, monkeypatch):
    values = {**SMALL, "emitters": ["point"]}
    config = table_config.parse(values)
    calls = []
    compute = assemble.compute_part

    def counted(name, settings):
        calls.append(name)
        if len(calls) == 4:
            raise KeyboardInterrupt
        return compute(name, settings)

    monkeypatch.setattr(assemble, "compute_part", counted)
    with pytest.raises(KeyboardInterrupt):
        job.tabulate(config, parts_folder=tmp_path / "parts", workers=1)
    resumed = job.tabulate(config, parts_folder=tmp_path / "parts", workers=1)
    assert len(calls) == len(assemble.part_names(config)) + 1  # only the interrupted part ran twice
    for name, value in resumed.arrays.items():
        np.testing.assert_array_equal(small.arrays[name], value)
    with pytest.raises(ValueError, match="another job"):
        job.tabulate(table_config.parse({**values, "order": 5}), parts_folder=tmp_path / "parts")


def test_small_set_is_accurate_enough_to_verify(small):
    checks = job.verify(small)
    assert {check.name for check in checks} >= {"point.single", "area.multiple", "directional.multiple", "point.compact"}
    assert all(check.error <= check.limit for check in checks), checks


def test_verify_finds_a_wrong_table(small):
    kept = ("point.single", "point.single_range", "point.compact", "point.compact_range")
    arrays = {name: small.arrays[name] for name in kept}
    arrays["point.single"] = arrays["point.single"] * 1.001
    config = {**small.metadata["config"], "emitters": ["point"], "multiple": None}
    wrong = tables.seal(arrays, {**small.metadata, "config": config})
    assert any(check.error > check.limit for check in job.verify(wrong) if check.name == "point.single")


# -- accuracy of the default set and of its evaluation


def test_compact_form_within_1e6(default):
    """Issue: 16 x 11 numbers within 1e-6 on tau in [0.01, 20]."""
    tau = np.geomspace(0.01, 20, 301)
    form = default.arrays["point.compact"]
    assert form.shape == (16, 11)
    found = np.exp(compact.evaluate(form, np.log(tau), *np.log(default.arrays["point.compact_range"])))
    assert np.max(np.abs(found / zonal_tables.point_table(tau) - 1)) < 1e-6


def test_single_scattering_within_1e6(lookups):
    tau = np.geomspace(1e-4, 50, 80)
    response = zonal_lookup.medium_response(lookups, "point", g=0.3)
    truth = zonal_tables.point_table(tau, g=0.3)
    found = jax.jit(zonal_lookup.scaled_single)(response, tau.astype(np.float32))
    assert np.max(np.abs(found / truth - 1)) < 2e-5  # float32 and 16 moments
    response = zonal_lookup.medium_response(lookups, "area")
    theta = np.full(80, 1.1, np.float32)
    truth = zonal_tables.area_table(tau, 1.1)[:, 0]
    assert (
        np.max(np.abs(zonal_lookup.scaled_single(response, tau.astype(np.float32), theta_n=theta) - truth) / truth[:, :1])
        < 1e-4
    )


def test_multiple_scattering_of_the_default_set(lookups):
    tau = np.geomspace(2e-3, 10, 9).astype(np.float32)
    g, albedo = 0.45, 0.93
    moments = wavenumber.effective_moments(g)
    for kind, truth in (
        ("point", wavenumber.point_table(tau, moments=moments, albedo=albedo)),
        ("directional", half_space.directional_table(tau, moments=moments, albedo=albedo, num_streams=64)),
    ):
        response = zonal_lookup.medium_response(lookups, kind, g=g, albedo=albedo)
        found = zonal_lookup.scaled_multiple(response, tau)
        assert np.max(np.abs(found - truth) / truth[:, :1]) < 5e-4, kind
    response = zonal_lookup.medium_response(lookups, "area", g=g, albedo=albedo)
    truth = assemble.area_response(tau, [0.4, 2.0], moments=moments, albedo=albedo, order=5, source_bands=14)
    for column, theta in enumerate((0.4, 2.0)):
        found = zonal_lookup.scaled_multiple(response, tau, theta_n=np.full(9, theta, np.float32))
        assert np.max(np.abs(found - truth[:, column]) / truth[..., :1].max(axis=1)) < 5e-3


def test_bounces(lookups):
    tau = np.float32([0.05, 1, 5])
    response = zonal_lookup.bounce_response(lookups, "point", num_scatterings=4)
    truth = wavenumber.point_table(tau, moments=np.ones(1), albedo=1.0, first=4, last=4)
    assert np.max(np.abs(zonal_lookup.scaled_multiple(response, tau) - truth) / truth[:, :1]) < 1e-4
    with pytest.raises(ValueError, match="bounce 9"):
        zonal_lookup.bounce_response(lookups, "point", num_scatterings=9)
    with pytest.raises(ValueError, match="no bounce table"):
        zonal_lookup.bounce_response(lookups, "point", num_scatterings=2, g=0.3)


def radiance(lookups, kind, tau, g, albedo, theta):
    """Scattered radiance at sigma_t = tau, distance 1."""
    response = zonal_lookup.medium_response(lookups, kind, g=g, albedo=albedo)
    if kind == "directional":
        return zonal_lookup.scattered_directional(response, 1.0, sigma_s=albedo * tau, sigma_t=tau)
    theta = None if kind == "point" else theta
    return zonal_lookup.scattered_point(response, 1.0, sigma_s=albedo * tau, sigma_t=tau, theta_n=theta)


KINDS = ("point", "directional", "area")


@pytest.mark.parametrize("kind", KINDS)
def test_float32_against_float64(default, lookups, kind):
    """Issue: float32 within 1e-5 of float64 (relative to band 0), no overflow at tau 1e-12 .. 1e6."""
    tau = np.concatenate([[1e-12, 1e-8], np.geomspace(1e-4, 20, 40), [1e3, 1e6]])
    evaluate = jax.jit(lambda tables, t: jax.vmap(lambda x: radiance(tables, kind, x, 0.4, 0.8, 1.0))(t))
    single = np.asarray(evaluate(lookups, tau.astype(np.float32)))
    with jax.enable_x64(True):
        double = np.asarray(evaluate(default.lookups(dtype=np.float64), tau.astype(np.float32).astype(np.float64)))
    assert single.dtype == np.float32 and double.dtype == np.float64
    assert np.all(np.isfinite(single)) and np.all(np.isfinite(double))
    inside = tau <= 20
    assert np.max(np.abs(single - double)[inside] / double[inside, :1]) < 1e-5


@pytest.mark.parametrize("kind", KINDS)
def test_values_and_gradients_are_finite_at_the_edges(lookups, kind):
    """Issue: finite at sigma 0, albedo 0 and 1, theta 0 and pi (and pi/2, g = 0)."""
    function = jax.jit(
        jax.value_and_grad(lambda t, g, c, theta: jnp.sum(radiance(lookups, kind, t, g, c, theta)), argnums=(0, 1, 2, 3))
    )
    for tau, g, albedo, theta in (
        (0.0, 0.0, 0.5, 0.0),
        (1e-12, 0.3, 0.0, np.pi),
        (1.0, 0.0, 1.0, np.pi / 2),
        (1.0, 0.6, 0.0, 1.0),
        (50.0, -0.6, 1.0, np.pi),
        (1e6, 0.0, 1.0, 0.0),
    ):
        values = jax.tree.leaves(function(*map(jnp.float32, (tau, g, albedo, theta))))
        assert all(np.isfinite(v) for v in values), (tau, g, albedo, theta, values)
    zero = radiance(lookups, kind, jnp.float32(0), 0.0, 0.5, 0.0)
    assert np.all(np.asarray(zero) == 0)


@pytest.mark.slow
def test_gradient_agrees_with_finite_differences(default):
    with jax.enable_x64(True):
        lookups = default.lookups(dtype=np.float64)
        function = jax.jit(lambda t, g, c, theta: jnp.sum(radiance(lookups, "area", t, g, c, theta)))
        point = [0.8, 0.2, 0.7, 1.2]
        slopes = jax.grad(function, argnums=(0, 1, 2, 3))(*point)
        for index, slope in enumerate(slopes):
            step = [1e-5 * (i == index) for i in range(4)]
            up, down = (function(*(p + sign * s for p, s in zip(point, step, strict=True))) for sign in (1, -1))
            assert abs(float(slope) - float(up - down) / 2e-5) < 1e-6 * max(1, abs(float(slope)))


def test_one_compilation_for_two_media(lookups):
    function = jax.jit(lambda tables, t, g, c: radiance(tables, "point", t, g, c, 0.0))
    for g, c in ((0.1, 0.5), (0.2, 0.9)):
        function(lookups, jnp.float32(1), jnp.float32(g), jnp.float32(c))
    assert function._cache_size() == 1


def test_sigma_ratio_of_the_lookup(lookups):
    """Doubling sigma at half the distance multiplies point responses by 4, and leaves directional ones."""
    response = zonal_lookup.medium_response(lookups, "point", albedo=0.5)
    once = zonal_lookup.scattered_point(response, 1.0, sigma_s=0.5, sigma_t=1.0)
    twice = zonal_lookup.scattered_point(response, 0.5, sigma_s=1.0, sigma_t=2.0)
    np.testing.assert_allclose(twice, 4 * once, rtol=1e-5)


def test_queries_outside_are_counted(lookups):
    response = zonal_lookup.medium_response(lookups, "point", g=0.95, albedo=0.5)
    counts = zonal_lookup.outside(lookups, response, jnp.float32([1, 100, 200]), 0.95)
    assert int(counts["tau_outside"]) == 2 and int(counts["g_outside"]) == 1
    with pytest.raises(ValueError, match="no table for emitter 'spot'"):
        zonal_lookup.medium_response(lookups, "spot")


def test_metadata(default):
    meta = default.metadata
    assert meta["format"] == tables.FORMAT and meta["version"]
    assert meta["errors"]["point.single"] < 1e-7
    assert meta["errors"]["area.multiple"] < 5e-3
    assert meta["errors"]["point.multiple"] < 1e-4 and meta["errors"]["directional.multiple"] < 3e-4
    assert all(np.isfinite(error) for error in meta["errors"].values())
    assert meta["config"]["multiple"]["g"] == [-0.9, 0.9]
    assert set(meta["part_seconds"]["point-single"]) == {"compile", "run", "cpu"}
    assert len(meta["checksum"]) == 64
    json.dumps(meta, allow_nan=False)
