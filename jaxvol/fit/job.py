"""The table job: parts computed on all cores, saved as they finish, joined, judged and written; and its verification."""

import os
import threading
import time
from collections.abc import Iterator
from concurrent.futures import FIRST_COMPLETED, ThreadPoolExecutor, wait
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np
from threadpoolctl import threadpool_limits

from jaxvol import __version__, jobs, tables, zonal_lookup
from jaxvol.fit import assemble, compact, phase_moments, validation, wavenumber
from jaxvol.fit.table_config import TableConfig, parse

_compiling = threading.local()  # seconds that this thread has spent in the compiler
_COMPILE_EVENTS = ("/jax/core/compile/jaxpr_to_mlir_module_duration", "/jax/core/compile/backend_compile_duration")


def _note_compilation(event: str, duration: float, **_) -> None:
    if event in _COMPILE_EVENTS:
        _compiling.seconds = getattr(_compiling, "seconds", 0.0) + duration


jax.monitoring.register_event_duration_secs_listener(_note_compilation)


class Seconds(NamedTuple):
    """What one part took: compilation, everything else, and the share of it that its thread had a core."""

    compile: float
    run: float
    cpu: float


class Interrupted(Exception):
    """The user stopped the job; the finished parts are kept."""


def tabulate(
    config: TableConfig, *, parts_folder: str | os.PathLike | None = None, workers: int | None = None
) -> tables.TableFile:
    """All tables of a configuration, sealed. With `parts_folder` finished parts are saved there and reused.

    The folder is left in place (the caller clears it once the result is safe). Raises `Interrupted` after the first Ctrl-C,
    ValueError where the folder belongs to another configuration.
    """
    start = time.perf_counter()
    values = config.model_dump(mode="json")
    store = None if parts_folder is None else jobs.Parts(parts_folder, config={"tables": values, "version": __version__})
    names = assemble.part_names(config)
    done = {} if store is None else {name: store.get(name) for name in names}
    done = {name: arrays for name, arrays in done.items() if arrays is not None}
    plan = time.perf_counter() - start
    start = time.perf_counter()
    timing: dict[str, Seconds] = {}
    missing = [name for name in names if name not in done]
    with jobs.stoppable() as stop, jobs.progress("tables", total=len(names)) as advance:
        advance(len(done), note="from an earlier run" if done else "")
        for name, arrays, seconds in _computed(missing, config, workers or os.cpu_count() or 1, stop):
            done[name], timing[name] = arrays, seconds
            if store is not None:
                store.put(name, arrays)
            advance(1, note=name)
    if len(done) < len(names):
        raise Interrupted(f"{len(done)} of {len(names)} parts are done")
    parts = time.perf_counter() - start
    arrays = assemble.join(done, config)
    joined = time.perf_counter() - start - parts
    errors = assemble.estimate_errors(arrays, config)
    seconds = {"plan": plan, "parts": parts, "join": joined, "errors": time.perf_counter() - start - parts - joined}
    seconds = {key: round(value, 2) for key, value in seconds.items()}
    return tables.seal(arrays, {"config": values, "errors": errors, "seconds": seconds, "part_seconds": _by_table(timing)})


def _by_table(timing: dict[str, Seconds]) -> dict[str, dict[str, float]]:
    """Seconds of one thread by table (parts of one table together): of this run's parts only."""
    total: dict[str, dict[str, float]] = {}
    for name, seconds in timing.items():
        entry = total.setdefault("-".join(name.split("-")[:2]), {"compile": 0.0, "run": 0.0, "cpu": 0.0})
        entry["compile"] += seconds.compile
        entry["run"] += seconds.run
        entry["cpu"] += seconds.cpu
    return {name: {key: round(value, 3) for key, value in sorted(entry.items())} for name, entry in sorted(total.items())}


def _timed(name: str, config: TableConfig) -> tuple[dict[str, np.ndarray], Seconds]:
    compiled, start, cpu = getattr(_compiling, "seconds", 0.0), time.perf_counter(), time.thread_time()
    arrays = assemble.compute_part(name, config)
    compiled = getattr(_compiling, "seconds", 0.0) - compiled
    run = time.perf_counter() - start - compiled
    return arrays, Seconds(compiled, run, min(run, time.thread_time() - cpu))


def _computed(
    names: list[str], config: TableConfig, workers: int, stop
) -> Iterator[tuple[str, dict[str, np.ndarray], Seconds]]:
    """(name, arrays, seconds) as they finish, on a few threads (numpy releases the interpreter); none new once `stop` is set.

    Linear algebra keeps to one thread per part: two levels of threads take each other's cores.
    """
    with threadpool_limits(1, user_api="blas"), ThreadPoolExecutor(max_workers=workers) as pool:
        waiting, running = list(names), {}
        while waiting or running:
            while waiting and len(running) < workers and not stop:
                name = waiting.pop(0)
                running[pool.submit(_timed, name, config)] = name
            if not running:
                return
            for future in wait(running, return_when=FIRST_COMPLETED).done:
                yield running.pop(future), *future.result()


class Check(NamedTuple):
    """One entry of a table, recomputed."""

    name: str
    where: str
    error: float  # relative to the response's band 0
    limit: float


def verify(table: tables.TableFile, *, num: int = 2, seed: int = 0, lookup=zonal_lookup) -> list[Check]:
    """Recompute random entries by the independent routes of `validation`; the configuration comes from the file itself.

    The limit of each check is four times the error that the file claims for that table, at least 2e-6 (the quadratures'
    own accuracy; 5e-5 for area emitters, 5e-4 for multiple scattering).
    """
    config = parse(table.metadata["config"], source="the table's own configuration")
    rng = np.random.default_rng(seed)
    lookups = table.lookups()
    checks = []
    for kind in config.emitters:
        for _ in range(num):
            checks.append(_check_single(kind, lookups, table, config, rng, lookup))
            if config.multiple is not None:
                checks.append(_check_multiple(kind, lookups, table, config, rng, lookup))
    if "point.compact" in table.arrays:
        checks.append(_check_compact(table, config, rng))
    return checks


def _limit(table, name: str, floor: float) -> float:
    return max(4 * float(table.metadata["errors"][name]), floor)


def _error(found, truth) -> float:
    return float(np.max(np.abs(np.asarray(found, dtype=np.float64) - truth)) / abs(truth[0]))


def _check_single(kind, lookups, table, config, rng, lookup) -> Check:
    tau = float(np.exp(rng.uniform(np.log(1e-3), np.log(min(config.tau_max, 20)))))
    g = float(rng.uniform(-0.3, 0.3))
    num = config.area.moments if kind == "area" else config.moments
    moments = phase_moments.henyey_greenstein(g, num)
    response = lookup.medium_response(lookups, kind, moments=moments)
    where, name = f"tau = {tau:.4g}, g = {g:.3f}", f"{kind}.single"
    if kind == "area":
        theta = float(rng.uniform(0, np.pi))
        truth = validation.area_entry(tau, theta, moments=moments, order=config.area.order)
        found = lookup.scaled_single(response, np.float32(tau), theta_n=np.float32(theta))
        return Check(name, f"{where}, theta = {theta:.3f}", _error(found, truth), _limit(table, name, 2e-4))
    make = validation.point_entry if kind == "point" else validation.directional_entry
    truth = make(tau, moments=moments, order=config.order)
    return Check(name, where, _error(lookup.scaled_single(response, np.float32(tau)), truth), _limit(table, name, 1e-5))


def _check_multiple(kind, lookups, table, config, rng, lookup) -> Check:
    low, high = config.multiple.tau
    tau = float(np.exp(rng.uniform(np.log(max(low, 0.01)), np.log(min(high, 10)))))
    u = [float(np.sqrt(1 - c)) for c in reversed(config.multiple.albedo)]
    albedo = float(min(1 - rng.uniform(*u) ** 2, 0.995))
    g = float(np.tanh(rng.uniform(*np.arctanh(config.multiple.g)))) * 0.7
    if config.multiple.num_g == 1:
        g = config.multiple.g[0]
    moments = wavenumber.effective_moments(g, tolerance=1e-7)
    response = lookup.medium_response(lookups, kind, g=np.float32(g), albedo=np.float32(albedo))
    where, name = f"tau = {tau:.4g}, albedo = {albedo:.4f}, g = {g:.3f}", f"{kind}.multiple"
    order = config.area.order if kind == "area" else config.order
    if kind == "directional":
        truth = validation.gathered_directional(tau, moments=moments, albedo=albedo, order=order)
        found = lookup.scaled_multiple(response, np.float32(tau))
    else:
        truth = validation.gathered_point(tau, moments=moments, albedo=albedo, order=order)
        found = lookup.scaled_multiple(response, np.float32(tau))
        if kind == "area":  # patches of every orientation together emit like a point: mean over normals = point / 4
            node, weight = np.polynomial.legendre.leggauss(16)
            zonal = [i for i, (_, m) in enumerate(assemble.harmonics.half_index(order)) if m == 0]
            theta = np.arccos(node).astype(np.float32)
            values = np.asarray(lookup.scaled_multiple(response, np.full(16, tau, np.float32), theta_n=theta), dtype=np.float64)
            found, truth = weight / 2 @ values[:, zonal], truth / 4
    return Check(name, where, _error(found, truth), _limit(table, name, 5e-4))


def _check_compact(table, config, rng) -> Check:
    low, high = config.compact.tau
    tau = float(np.exp(rng.uniform(np.log(low), np.log(high))))
    truth = validation.point_entry(tau, moments=np.ones(1), order=config.order)
    form = compact.evaluate(table.arrays["point.compact"], [np.log(tau)], np.log(low), np.log(high))[0]
    return Check("point.compact", f"tau = {tau:.4g}", _error(np.exp(form), truth), 2e-6)


def parts_folder(out: str | os.PathLike) -> Path:
    """Where the job that writes `out` keeps its finished parts."""
    out = Path(out)
    return out.with_name(out.name + ".parts")
