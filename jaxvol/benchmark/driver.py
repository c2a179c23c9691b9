"""All runs of a benchmark file in order, each appended to results.jsonl when it is done; finished ones are not repeated."""

import dataclasses
import gc
import json
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from jaxvol import image, jobs, rendering
from jaxvol.benchmark import errors, peer, runners
from jaxvol.benchmark.config import BenchmarkTable, MethodEntry, ScalingEntry, SceneEntry, Settings, scene_name
from jaxvol.benchmark.measure import First, forget_programs
from jaxvol.benchmark.references import reference
from jaxvol.benchmark.workers import Workers
from jaxvol.layers import NAMES
from jaxvol.methods import path_tracing
from jaxvol.scene import SceneFile

Record = dict[str, Any]
RESULTS = "results.jsonl"
PEER = "mitsuba"


@dataclasses.dataclass(frozen=True)
class Task:
    """One line of results.jsonl: what is run, for which worker, and what names it."""

    key: str
    scene: str
    method: str
    run: Callable[[First | None], Record]  # picklable, as is `compile`
    compile: Callable[[], First] | None = None  # the first call alone, where it may be made beside others
    uses: tuple[str, ...] = ()  # other methods whose programs it needs too


def run_benchmark(config: BenchmarkTable, base: Path, out: Path, *, stop: jobs.Stop | None = None) -> list[Record]:
    """Run what is not done yet (until `stop`) and return all records of this benchmark, in order."""
    out.mkdir(parents=True, exist_ok=True)
    done = read_records(out)
    tasks = list(_tasks(config, base, out))
    left = [task for task in tasks if task.key not in done]
    with Workers(config.processes if left else 1) as workers, jobs.progress("benchmark", total=len(tasks)) as advance:
        advance(len(tasks) - len(left))
        scene, made, took = None, {}, {}
        for task in left:
            if stop:
                break
            if task.scene != scene:
                scene = task.scene
                advance(0, note=f"{scene}, first calls")
                workers.call_all(forget_programs)
                made = _first_calls([t for t in left if t.scene == scene and t.compile], workers, took, stop)
            if stop:
                break
            worker, first = made.get(task.key, (0, None))
            done[task.key] = {"key": task.key} | workers.call(worker, partial(task.run, first))
            _write(out, done)
            advance(1, note=f"{task.scene}, {task.method}")
    return [done[task.key] for task in tasks if task.key in done]


def _first_calls(
    tasks: list[Task], workers: Workers, took: dict[str, float], stop: jobs.Stop | None
) -> dict[str, tuple[int, First]]:
    """(worker, first call) by key. Settings of one method, and a composite with its methods, take turns in one worker.

    Longest first, by what they `took` in the scene before.
    """
    teams: dict[str, str] = {}
    for task in tasks:
        teams |= dict.fromkeys((task.method, *task.uses), task.method)
    groups: dict[str, list[Task]] = {}
    for task in tasks:
        groups.setdefault(teams[task.method], []).append(task)
    expected = {name: sum(took.get(method, np.inf) for method in {task.method for task in g}) for name, g in groups.items()}
    order = [groups[name] for name in sorted(groups, key=lambda name: -expected[name])]
    made = workers.spread([[partial(_compile, task.compile) for task in group] for group in order], stop)
    found, spent = {}, {}
    for group, (worker, firsts) in zip(order, made, strict=True):
        for task, first in zip(group, firsts, strict=False):  # fewer after `stop`
            found[task.key] = worker, first
            spent[task.method] = spent.get(task.method, 0.0) + first.seconds
    took.update(spent)
    return found


def _compile(call: Callable[[], First]) -> First:
    """A first call. Garbage is collected later: tracing makes little, walking what it keeps takes long."""
    gc.disable()
    try:
        return call()
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
                call = partial(_run_method, config, base, out, entry, method, index, settings)
                first = None if method.entry else partial(_compile_method, config, base, entry, method, settings)
                uses = _used(entry, base, settings) if _method(method) == "auto" else ()
                yield Task(key, file.name, method.name, call, first, uses)
        if config.mitsuba.enabled and entry.peer and peer.installed():
            for samples in config.mitsuba.samples:
                peers = {"integrator": entry.peer_integrator, "scale": entry.peer_scale, "batches": config.mitsuba.batches}
                key = jobs.config_hash(told | {"method": PEER, "samples": samples} | peers)
                call = partial(_run_peer, config, base, out, entry, samples)
                yield Task(key, file.name, PEER, call, partial(_compile_peer, config, base, entry, samples))
    for scaling in config.scaling:
        entry = next((s for s in config.scenes if scene_name(s) == scaling.scene), None)
        if entry is None:
            raise ValueError(f"scaling {scaling.name!r}: no scene of the name {scaling.scene!r} among the benchmark's")
        for value in scaling.values:
            told = {"scaling": scaling.model_dump(exclude={"values"}), "value": value, "entry": entry.model_dump()}
            key = jobs.config_hash(told | {"repeats": config.repeats, "versions": rendering.versions()})
            yield Task(
                key, scaling.name, f"{scaling.method} {value}", partial(_run_scaling, config, base, entry, scaling, value)
            )


def _told(file: Any, entry: SceneEntry, config: BenchmarkTable) -> Record:
    return {
        "scene": file.name, "width": entry.width, "height": entry.height, "block": config.block,
        "device": rendering.device(), "versions": rendering.versions(),
    }  # fmt: skip


def _method(method: MethodEntry) -> str:
    return method.method or method.name


def _load(entry: SceneEntry, base: Path, method: MethodEntry, settings: Settings) -> SceneFile:
    return runners.load_file(entry, base, overrides=() if method.entry else runners.as_overrides(_method(method), settings))


def _used(entry: SceneEntry, base: Path, settings: Settings) -> tuple[str, ...]:
    """The methods that "auto" puts together; none where it refuses the scene."""
    try:
        file = runners.load_file(entry, base, overrides=runners.as_overrides("auto", settings))
        return tuple(share.method for share in rendering.assign(file, automatic=True).shares)
    except ValueError:
        return ()


def _compile_method(config: BenchmarkTable, base: Path, entry: SceneEntry, method: MethodEntry, settings: Settings) -> First:
    try:
        file = _load(entry, base, method, settings)
    except ValueError as error:
        return First(0.0, error)
    return runners.compile_method(file, _method(method), seed=config.seed)


def _run_method(
    config: BenchmarkTable,
    base: Path,
    out: Path,
    entry: SceneEntry,
    method: MethodEntry,
    index: int,
    settings: Settings,
    first: First | None,
) -> Record:
    record = {"method": method.name, "settings": settings, "index": index}
    try:
        file = _load(entry, base, method, settings)
        record = _told(file, entry, config) | record
        right = reference(runners.load_file(entry, base), config.reference, out / "references")
        if method.entry is None:
            found = runners.run_method(file, _method(method), repeats=config.repeats, seed=config.seed, first=first)
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


def _compile_peer(config: BenchmarkTable, base: Path, entry: SceneEntry, samples: int) -> First:
    return peer.compile_peer(runners.load_file(entry, base), entry, samples=samples, seed=config.seed)


def _run_peer(config: BenchmarkTable, base: Path, out: Path, entry: SceneEntry, samples: int, first: First | None) -> Record:
    file = runners.load_file(entry, base)
    record = _told(file, entry, config) | {"method": PEER, "settings": {"samples": samples}, "index": 0}
    right = reference(file, config.reference, out / "references")
    try:
        found = peer.run_peer(file, entry, config.mitsuba, samples=samples, seed=config.seed, first=first)
    except ValueError as error:
        return record | {"refused": str(error)}
    noise = errors.relmse_of_noise(found.variance, right.rgb)
    against = image.bias(found.mean.astype(np.float32), right.rgb)
    seconds = {"plan": 0.0, "compile": max(found.cost.first_seconds - found.cost.seconds, 0.0), "run": found.cost.seconds}
    record |= _costs(found.cost) | {"seconds": seconds, "lit": list(errors.lit(NAMES, right)), "names": list(NAMES)}
    return record | {"errors": {"own": {"relmse": noise, "relmse_error": 0.0, "bias": against}}}


def _run_scaling(
    config: BenchmarkTable, base: Path, entry: SceneEntry, scaling: ScalingEntry, value: int, _: First | None
) -> Record:
    overrides = tuple(text.replace("{n}", str(value)) for text in scaling.overrides)
    file = runners.load_file(entry, base, overrides=overrides)
    record = _told(file, entry, config) | {"scaling": scaling.name, "method": scaling.method, "value": value}
    if scaling.method == "bake":
        cost, count = runners.run_bake(file, texels=value, repeats=config.repeats, seed=config.seed)
    else:
        cost = runners.run_method(file, scaling.method, repeats=config.repeats, seed=config.seed).cost
        count = value**scaling.power
    return record | _costs(cost) | {"count": count, "seconds": {"run": cost.seconds}}


def _costs(cost: Any) -> Record:
    return {"warm_seconds": cost.seconds, "cpu_seconds": cost.cpu_seconds, "peak_mib": cost.peak_mib, "load": cost.load}
