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

_STATUS = Path("/proc/self/status")
_CLEAR = Path("/proc/self/clear_refs")


@dataclass(frozen=True)
class Cost:
    """What calls took; seconds are medians over the warm calls."""

    first_seconds: float  # of the first call, which compiles
    seconds: float
    cpu_seconds: float  # of all threads
    peak_mib: float  # resident memory of the process at its highest during the warm calls
    load: float  # processes that wanted a core in the last minute


def measured(call: Callable[[int], Any], *, repeats: int) -> tuple[Any, Any, Cost]:
    """Results of call(0), the first, and of the last warm call(k), k = 1 .. repeats, and what they cost."""
    start = time.perf_counter()
    first = call(0)
    first_seconds = time.perf_counter() - start
    gc.collect()
    reset_peak()
    walls, cpus, last = [], [], first
    for k in range(1, repeats + 1):
        wall, cpu = time.perf_counter(), time.process_time()
        last = call(k)
        walls.append(time.perf_counter() - wall)
        cpus.append(time.process_time() - cpu)
    cost = Cost(first_seconds, statistics.median(walls), statistics.median(cpus), peak_mib(), os.getloadavg()[0])
    return first, last, cost


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
