"""Run cases through methods, keep what was found (stress.jsonl), go on where it was stopped."""

import json
import math
import time
from contextlib import nullcontext
from pathlib import Path
from typing import Any

from jaxvol import jobs
from jaxvol.stress import checks, extremes, gradients, scenes

RESULTS = "stress.jsonl"
# Of each class every second scene in other units, every tenth turned, every twenty-fifth differentiated.
_EVERY_UNITS, _EVERY_TURN, _EVERY_GRADIENT = 2, 10, 25
CHECKS = ("sound", "linear", "units", "turned", "furnace", "gradient")
_EXTREME = "extreme: "
_MOST_DRAWS = 4  # random scenes a method is offered, for each that it shall take

Record = dict[str, Any]
Case = tuple[str, str, int | None, scenes.Config]  # key, class, number or None for extremes, scene


def cases(first: int, num: int) -> list[Case]:
    """(key, class, number, scene) of the random scenes first .. first + num - 1."""
    return [(f"random {k}", *_numbered(k)) for k in range(first, first + num)]


def _numbered(number: int) -> tuple[str, int, scenes.Config]:
    name, config = scenes.random_scene(number)
    return name, number, config


def extreme_cases() -> list[Case]:
    """(key, "extreme", None, scene) of all extremes."""
    return [(f"{_EXTREME}{name}", "extreme", None, config) for name, config in extremes.extremes()]


def run_case(config: scenes.Config, number: int | None, name: str, method: str, *, differentiated: bool = False) -> Record:
    """All checks of one scene by one method: {"refused": why} or {"failed": [...], "passed": [...]}.

    Every stage that the scene goes through is `differentiated` if so asked.
    """
    failed, passed = [], []

    def note(what: str, found: str | None) -> None:
        if found:
            failed.append(f"{what}: {found}")
        else:
            passed.append(what)

    start = time.perf_counter()
    try:
        with gradients.recording() if differentiated else nullcontext() as stages:
            layers = checks.render(config, method)
    except checks.Refused as error:
        return {"refused": str(error)}
    except (ValueError, TypeError, ArithmeticError, IndexError) as error:
        return {"failed": [f"raised {type(error).__name__}: {error}"], "passed": [], "seconds": 0.0}
    problem = checks.sound(layers)
    note("sound", problem)
    if problem is None:
        base = checks.picture(layers)
        try:
            note("linear", checks.linear(config, method, base))
            turn = None if number is None else number // len(scenes.CLASSES)  # scenes of this class before
            if turn is None or turn % _EVERY_UNITS == 0:
                large = turn % (2 * _EVERY_UNITS) > 0 if turn is not None else checks.size(config) > 1e3
                factor = 1 / checks.UNIT if large else checks.UNIT
                note("units", checks.unit_free(config, method, base, factor=factor))
            if turn is not None and turn % _EVERY_TURN == 0:
                note("turned", checks.turns(config, method))
            if name.endswith("furnace"):
                note("furnace", checks.furnace(config, method))
            if differentiated:
                note("gradient", gradients.finite(stages))
        except checks.Refused as error:  # the scene was taken before: its other forms must be, but for numbers out of range
            note("range" if "must be" in str(error) else "refused", None if "must be" in str(error) else str(error))
    return {"failed": failed, "passed": passed, "seconds": time.perf_counter() - start}


def run(
    out: Path, *, first: int, num: int, methods: tuple[str, ...], stop: jobs.Stop | None = None, again: bool = False
) -> list[Record]:
    """The extremes and, from scene number `first` on, random scenes by all methods, until each has taken `num` of them.

    Scenes that a method refuses count apart; after `_MOST_DRAWS` times `num` scenes a method is done all the same. Cases
    that `out` holds are taken from there, failed ones run again with `again`.
    """
    out.mkdir(parents=True, exist_ok=True)
    path = out / RESULTS
    done = _read(path)
    if again:
        done = {k: r for k, r in done.items() if not r.get("failed")}
    records = []
    for method in methods:
        wanted, drawn, short = extreme_cases(), 0, num
        while True:
            _run_cases(path, done, wanted, method, stop)
            mine = [done[case[0], method] for case in wanted if (case[0], method) in done]
            records += mine
            if stop:
                return records
            short -= sum(r["class"] != "extreme" and "refused" not in r for r in mine)
            wanted = cases(first + drawn, _next_draw(num, drawn, short))
            if not wanted:
                break
            drawn += len(wanted)
    return records


def _next_draw(num: int, drawn: int, short: int) -> int:
    """How many scenes more give `short` that are taken, about, if as large a share is taken as of those drawn before."""
    if short <= 0:
        return 0
    taken = max(num - short, 1) / drawn if drawn else 1.0
    return min(math.ceil(short / taken), _MOST_DRAWS * num - drawn)


def _run_cases(
    path: Path, done: dict[tuple[str, str], Record], wanted: list[Case], method: str, stop: jobs.Stop | None
) -> None:
    """Those of the cases that are not in `done` by one method, into `done` and the file."""
    # Class by class, so that compiled programs are used again before they are dropped.
    todo = sorted((case for case in wanted if (case[0], method) not in done), key=lambda case: case[1])
    before = None
    with jobs.progress(f"stress, {method}", total=len(todo)) as advance:
        for count, (key, name, number, config) in enumerate(todo, start=1):
            if stop:
                break
            if name != before:
                checks.clear_caches()  # the next class has other shapes, and hundreds of programs would fill the memory
            before = name
            found = run_case(config, number, name, method, differentiated=_is_differentiated(key, number))
            done[key, method] = {"case": key, "class": name, "method": method} | found
            advance(1, note=key)
            if count % 20 == 0:
                _write(path, done)
    _write(path, done)


def _is_differentiated(key: str, number: int | None) -> bool:
    if number is None:
        return key.removeprefix(_EXTREME).startswith(extremes.CORNERS)
    return number // len(scenes.CLASSES) % _EVERY_GRADIENT == 0


def _read(path: Path) -> dict[tuple[str, str], Record]:
    if not path.exists():
        return {}
    records = [json.loads(line) for line in path.read_text().splitlines()]
    return {(r["case"], r["method"]): r for r in records}


def _write(path: Path, records: dict[tuple[str, str], Record]) -> None:
    jobs.write_bytes(path, "".join(json.dumps(r) + "\n" for r in records.values()).encode())


def table(records: list[Record]) -> str:
    """Cases tried, refused and failed, by method, and checks made."""
    head = f"{'method':28s} {'scenes':>7s} {'random':>7s} {'refused':>8s} {'failed':>7s} {'checks':>7s}"
    lines = [head + "  sound linear  units turned furnace gradient"]
    for method in dict.fromkeys(r["method"] for r in records):
        mine = [r for r in records if r["method"] == method]
        run_ = [r for r in mine if "refused" not in r]
        made = {k: sum(k in r["passed"] for r in run_) for k in CHECKS}
        total = sum(len(r["passed"]) + len(r["failed"]) for r in run_)
        lines.append(
            f"{method:28s} {len(run_):7d} {sum(r['class'] != 'extreme' for r in run_):7d} {len(mine) - len(run_):8d} "
            f"{sum(bool(r['failed']) for r in run_):7d} {total:7d}  " + " ".join(f"{v:6d}" for v in made.values())
        )
    return "\n".join(lines)


def failures(records: list[Record]) -> list[str]:
    """One line for every check that failed."""
    return [f"{r['method']}, {r['case']} ({r['class']}): {line}" for r in records for line in r.get("failed", ())]
