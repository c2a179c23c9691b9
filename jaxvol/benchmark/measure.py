"""Seconds, CPU seconds and peak memory of a call; the median of several."""

import gc
import os
import re
import resource
import statistics
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax

from jaxvol.rendering import compile_seconds

_STATUS = Path("/proc/self/status")
_WARM = 0.05  # share of a call that may go into tracing and compiling
_CLEAR = Path("/proc/self/clear_refs")
_MAPS = Path("/proc/self/maps")
_MANY_MAPS = 8_000  # Linux allows a process 65,530; programs of a scene take up to 20,000 in each of two processes


@dataclass(frozen=True)
class Cost:
    """What calls took; seconds are medians over the warm calls."""

    first_seconds: float  # of the first call, which compiles
    seconds: float
    cpu_seconds: float  # of all threads
    peak_mib: float  # resident memory of the process at its highest during the warm calls
    load: float  # processes that wanted a core in the last minute


@dataclass(frozen=True)
class First:
    """A first call that was made beforehand: seconds, or what it refused. Its result is not kept."""

    seconds: float
    error: ValueError | None = None


def first_call(call: Callable[[int], Any]) -> First:
    """Make call(0), which compiles."""
    start = time.perf_counter()
    try:
        call(0)
    except ValueError as error:
        return First(time.perf_counter() - start, error)
    return First(time.perf_counter() - start)


def measured(call: Callable[[int], Any], *, repeats: int, first: First | None = None) -> tuple[Any, Cost]:
    """The result of the last warm call(k), k = 1 .. repeats, and what they cost; call(0) unless it was made already.

    A call that compiled after all (its random numbers ask for arrays of other sizes) is made once more. Raises the ValueError
    of the first call.
    """
    first = first_call(call) if first is None else first
    if first.error is not None:
        raise first.error
    gc.collect()
    gc.freeze()  # compiled programs and their traces stay: the next collection need not walk them (a second each time)
    reset_peak()
    walls, cpus, last = [], [], None
    for k in range(1, repeats + 1):
        last, wall, cpu, compiling = _timed(call, k)
        if compiling > _WARM * wall:
            last, wall, cpu, _ = _timed(call, k)
        walls.append(wall)
        cpus.append(cpu)
    cost = Cost(first.seconds, statistics.median(walls), statistics.median(cpus), peak_mib(), os.getloadavg()[0])
    return last, cost


def _timed(call: Callable[[int], Any], k: int) -> tuple[Any, float, float, float]:
    """call(k), its seconds, CPU seconds, and those of the seconds that went into tracing and compiling."""
    wall, cpu = time.perf_counter(), time.process_time()
    with compile_seconds() as compiling:
        result = call(k)
    return result, time.perf_counter() - wall, time.process_time() - cpu, compiling[0]


def forget_programs() -> None:
    """Drop compiled programs where there are very many, of scenes before: they keep memory and memory maps."""
    if not _MAPS.exists() or _MAPS.read_bytes().count(b"\n") > _MANY_MAPS:
        gc.unfreeze()
        jax.clear_caches()
        gc.collect()


def reset_peak() -> None:
    """Start counting peak memory anew, where the system allows it (Linux); else it counts from the process's start."""
    try:
        descriptor = os.open(_CLEAR, os.O_WRONLY)
    except OSError:
        return
    try:
        os.write(descriptor, b"5")
    except OSError:
        pass  # a container may forbid it
    finally:
        os.close(descriptor)


def peak_mib() -> float:
    """Peak resident memory of this process since `reset_peak`, MiB."""
    if _STATUS.exists():
        found = re.search(r"VmHWM:\s+(\d+) kB", _STATUS.read_text())
        if found:
            return int(found.group(1)) / 1024
    unit = 1024**2 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / unit
