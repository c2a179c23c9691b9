"""All runs of a benchmark file in order, each appended to results.jsonl when it is done; finished ones are not repeated."""

import dataclasses
import gc
import json
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import jax
import numpy as np

from jaxvol import image, jobs, rendering
from jaxvol.benchmark import errors, peer, runners
from jaxvol.benchmark.config import BenchmarkTable, MethodEntry, ScalingEntry, SceneEntry, Settings, scene_name
from jaxvol.benchmark.measure import First
from jaxvol.benchmark.references import reference
from jaxvol.layers import NAMES
from jaxvol.methods import path_tracing
from jaxvol.scene import SceneFile

Record = dict[str, Any]
RESULTS = "results.jsonl"
PEER = "mitsuba"


@dataclasses.dataclass(frozen=True)
class Task:
    """One line of results.jsonl: what is run and what names it."""

    key: str
    title: str
    run: Callable[[First | None], Record]
    scene: str = ""
    compile: Callable[[], First] | None = None  # the first call alone, where it may be made beside others


def run_benchmark(config: BenchmarkTable, base: Path, out: Path, *, stop: jobs.Stop | None = None) -> list[Record]:
    """Run what is not done yet (until `stop`) and return all records of this benchmark, in order."""
    out.mkdir(parents=True, exist_ok=True)
    done = read_records(out)
    tasks = list(_tasks(config, base, out))
    left = [task for task in tasks if task.key not in done]
    with jobs.progress("benchmark", total=len(tasks)) as advance:
        advance(len(tasks) - len(left))
        firsts: dict[str, First] = {}
        for task in left:
            if config.compile_threads > 1 and task.compile is not None and task.key not in firsts:
                advance(0, note=f"{task.scene}, compiling")
                if firsts:
                    _forget_programs()
                firsts |= _compile([t for t in left if t.scene == task.scene and t.compile], config.compile_threads, stop)
            if stop:
                break
            record = {"key": task.key} | task.run(firsts.get(task.key))
            done[task.key] = record
            _write(out, done)
            advance(1, note=task.title)
    return [done[task.key] for task in tasks if task.key in done]


def _forget_programs() -> None:
    """Drop the programs of the scenes before, of which few are shared: memory, and time to collect garbage.

    A run that kept those of four scenes once ended in a segmentation fault while two threads compiled the fifth's; the
    cause was not found.
    """
    gc.unfreeze()
    jax.clear_caches()
    gc.collect()


def _compile(tasks: list[Task], num_threads: int, stop: jobs.Stop | None) -> dict[str, First]:
    """First calls by key, of several methods at a time: XLA compiles outside Python's lock. None are begun after `stop`.

    Settings of one method share programs, and two threads would compile them twice: they take turns. Garbage is
    collected afterwards: tracing makes little, and walking all that it keeps takes long.
    """

    def of_method(title: str) -> dict[str, First]:
        return {task.key: task.compile() for task in tasks if task.title == title and not stop}

    gc.disable()
    try:
        with ThreadPoolExecutor(num_threads) as pool:
            groups = pool.map(of_method, dict.fromkeys(task.title for task in tasks))
            return {key: first for group in groups for key, first in group.items()}
    finally:
        gc.enable()


def read_records(out: Path) -> dict[str, Record]:
    """Records by key; a last line that a kill cut short is dropped. Raises ValueError for another kind of file."""
    path, found = out / RESULTS, {}
    if not path.exists():
        return found
    lines = path.read_text().splitlines()
    for number, line in enumerate(lines, start=1):
        try:
            record = json.loads(line)
            found[record["key"]] = record
        except (ValueError, KeyError, TypeError) as error:
            if number == len(lines):
                break
            raise ValueError(f"{path}: line {number} is no result ({error}); delete it or choose another folder") from error
    return found


def _write(out: Path, records: dict[str, Record]) -> None:
    text = "".join(json.dumps(record, allow_nan=False, default=_plain) + "\n" for record in records.values())
    jobs.write_bytes(out / RESULTS, text.encode())


def _plain(value: Any) -> Any:
    return value.tolist() if hasattr(value, "tolist") else str(value)


def _tasks(config: BenchmarkTable, base: Path, out: Path) -> Iterator[Task]:
    for entry in config.scenes:
        file = runners.load_file(entry, base)
        told = {"scene": path_tracing.scene_digest(file.scene, file.camera), "name": file.name, "block": config.block}
        told |= {"repeats": config.repeats, "seed": config.seed, "reference": config.reference.model_dump()}
        told["versions"] = rendering.versions()
        for method in config.methods:
            if entry.methods is not None and method.name not in entry.methods:
                continue
            whole = method.curves is None or file.name in method.curves
            for index, settings in enumerate(method.settings if whole else method.settings[:1]):
                key = jobs.config_hash(
                    told | {"method": method.model_dump(exclude={"settings", "curves"}), "settings": settings}
                )
                run, compile = _method_task(config, base, out, entry, method, index, settings)
                yield Task(key, f"{file.name}, {method.name}", run, file.name, compile)
        if config.mitsuba.enabled and entry.peer and peer.installed():
            for samples in config.mitsuba.samples:
                peers = {"integrator": entry.peer_integrator, "scale": entry.peer_scale, "batches": config.mitsuba.batches}
                key = jobs.config_hash(told | {"method": PEER, "samples": samples} | peers)
                yield Task(key, f"{file.name}, {PEER}", _peer_task(config, base, out, entry, samples))
    for scaling in config.scaling:
        entry = next((s for s in config.scenes if scene_name(s) == scaling.scene), None)
        if entry is None:
            raise ValueError(f"scaling {scaling.name!r}: no scene of the name {scaling.scene!r} among the benchmark's")
        for value in scaling.values:
            told = {"scaling": scaling.model_dump(exclude={"values"}), "value": value, "entry": entry.model_dump()}
            key = jobs.config_hash(told | {"repeats": config.repeats, "versions": rendering.versions()})
            yield Task(key, f"{scaling.name} {value}", _scaling_task(config, base, entry, scaling, value))


def _told(file: Any, entry: SceneEntry, config: BenchmarkTable) -> Record:
    return {
        "scene": file.name, "width": entry.width, "height": entry.height, "block": config.block,
        "device": rendering.device(), "versions": rendering.versions(),
    }  # fmt: skip


def _method_task(
    config: BenchmarkTable, base: Path, out: Path, entry: SceneEntry, method: MethodEntry, index: int, settings: Settings
) -> tuple[Callable[[First | None], Record], Callable[[], First] | None]:
    """The run, and its first call alone for methods of ours."""
    name = method.method or method.name

    def load() -> SceneFile:
        return runners.load_file(entry, base, overrides=() if method.entry else runners.as_overrides(name, settings))

    def compile() -> First:
        try:
            file = load()
        except ValueError as error:
            return First(0.0, error)
        return runners.compile_method(file, name, seed=config.seed)

    def run(first: First | None) -> Record:
        record = {"method": method.name, "settings": settings, "index": index}
        try:
            file = load()
            record = _told(file, entry, config) | record
            right = reference(runners.load_file(entry, base), config.reference, out / "references")
            if method.entry is None:
                found = runners.run_method(file, name, repeats=config.repeats, seed=config.seed, first=first)
            else:
                function = runners.load_function(method.entry)
                found = runners.run_function(file, method, function, repeats=config.repeats, seed=config.seed)
        except ValueError as error:
            return record | {"refused": str(error)}
        record |= _costs(found.cost) | {"seconds": found.seconds} | found.about
        record["errors"] = errors.all_errors(found.estimate.mean, right, block=config.block)
        record["names"] = list(errors.names_of(found.estimate.mean))
        record["lit"] = list(errors.lit(NAMES, right))
        picture = out / "pictures" / f"{file.name}.{method.name}.{index}.exr"
        image.write_exr(picture, image.estimate_channels(found.estimate), metadata=record)
        return record | {"picture": str(picture.relative_to(out))}

    shares_programs = name == "auto"  # with all others: compiled after them
    return run, None if method.entry or shares_programs else compile


def _peer_task(
    config: BenchmarkTable, base: Path, out: Path, entry: SceneEntry, samples: int
) -> Callable[[First | None], Record]:
    def run(_: First | None) -> Record:
        file = runners.load_file(entry, base)
        record = _told(file, entry, config) | {"method": PEER, "settings": {"samples": samples}, "index": 0}
        right = reference(file, config.reference, out / "references")
        try:
            found = peer.run_peer(file, entry, config.mitsuba, samples=samples, seed=config.seed)
        except ValueError as error:
            return record | {"refused": str(error)}
        noise = errors.relmse_of_noise(found.variance, right.rgb)
        against = image.bias(found.mean.astype(np.float32), right.rgb)
        seconds = {"plan": 0.0, "compile": max(found.cost.first_seconds - found.cost.seconds, 0.0), "run": found.cost.seconds}
        record |= _costs(found.cost) | {"seconds": seconds, "lit": list(errors.lit(NAMES, right)), "names": list(NAMES)}
        return record | {"errors": {"own": {"relmse": noise, "relmse_error": 0.0, "bias": against}}}

    return run


def _scaling_task(
    config: BenchmarkTable, base: Path, entry: SceneEntry, scaling: ScalingEntry, value: int
) -> Callable[[First | None], Record]:
    def run(_: First | None) -> Record:
        overrides = tuple(text.replace("{n}", str(value)) for text in scaling.overrides)
        file = runners.load_file(entry, base, overrides=overrides)
        record = _told(file, entry, config) | {"scaling": scaling.name, "method": scaling.method, "value": value}
        if scaling.method == "bake":
            cost, count = runners.run_bake(file, texels=value, repeats=config.repeats, seed=config.seed)
        else:
            cost = runners.run_method(file, scaling.method, repeats=config.repeats, seed=config.seed).cost
            count = value**scaling.power
        return record | _costs(cost) | {"count": count, "seconds": {"run": cost.seconds}}

    return run


def _costs(cost: Any) -> Record:
    return {"warm_seconds": cost.seconds, "cpu_seconds": cost.cpu_seconds, "peak_mib": cost.peak_mib, "load": cost.load}
