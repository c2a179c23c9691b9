"""Processes that make a benchmark's runs: first calls, which compile, in all of them at a time; what is timed, alone.

Processes and not threads: tracing holds Python's lock, and the programs of several scenes come near the number of memory
maps that Linux allows one process (65,530; beyond them the compiler crashes), so each holds its share.
"""

import multiprocessing
import signal
from collections.abc import Callable, Sequence
from multiprocessing.connection import Connection, wait
from typing import Any

from jaxvol.jobs import Stop

Call = Callable[[], Any]  # picklable


class Workers:
    """`num` processes that live from `with` to its end; with one, calls are made in this process.

    A call's ValueError is raised here; anything else ends its process, and raises RuntimeError here.
    """

    def __init__(self, num: int):
        self._num = num
        self._lines: list[Connection] = []
        self._processes: list[multiprocessing.Process] = []

    def __enter__(self) -> "Workers":
        context = multiprocessing.get_context("spawn")  # threads of XLA do not survive a fork
        for _ in range(self._num if self._num > 1 else 0):
            here, there = context.Pipe()
            process = context.Process(target=_serve, args=(there,), daemon=True)
            process.start()
            there.close()  # so that its end is noticed here
            self._lines.append(here)
            self._processes.append(process)
        return self

    def __exit__(self, *_: object) -> None:
        for line, process in zip(self._lines, self._processes, strict=True):
            line.close()
            process.terminate()  # idle, or asked for by a second Ctrl-C
            process.join()

    def call(self, worker: int, call: Call) -> Any:
        """What one worker makes of a call."""
        if not self._lines:
            return call()
        self._send(worker, call)
        return self._receive(worker)

    def call_all(self, call: Call) -> None:
        """The same call in every worker."""
        for worker in range(max(len(self._lines), 1)):
            self.call(worker, call)

    def spread(self, groups: Sequence[Sequence[Call]], stop: Stop | None = None) -> list[tuple[int, list[Any]]]:
        """(worker, results) of each group, one call after the other; the next group goes to whoever is idle.

        None is begun after `stop`: results may be fewer than calls.
        """
        if not self._lines:
            return [(0, [call() for call in group if not stop]) for group in groups]
        found: list[tuple[int, list[Any]]] = [(0, []) for _ in groups]
        waiting, busy = [k for k, group in enumerate(groups) if group], {}
        while busy or (waiting and not stop):
            for worker in range(len(self._lines)):
                if worker not in busy and waiting and not stop:
                    busy[worker] = waiting.pop(0)
                    found[busy[worker]] = (worker, [])
                    self._send(worker, groups[busy[worker]][0])
            ready = wait([self._lines[worker] for worker in busy])
            for worker in [worker for worker in busy if self._lines[worker] in ready]:
                calls, results = groups[busy[worker]], found[busy[worker]][1]
                results.append(self._receive(worker))
                if len(results) < len(calls) and not stop:
                    self._send(worker, calls[len(results)])
                else:
                    del busy[worker]
        return found

    def _send(self, worker: int, call: Call) -> None:
        try:
            self._lines[worker].send(call)
        except BrokenPipeError:
            raise self._ended(worker) from None

    def _receive(self, worker: int) -> Any:
        try:
            result, error = self._lines[worker].recv()
        except (EOFError, ConnectionResetError):
            raise self._ended(worker) from None
        if error is not None:
            raise error
        return result

    def _ended(self, worker: int) -> RuntimeError:
        process = self._processes[worker]
        process.join(5.0)
        return RuntimeError(f"a worker ended early (exit code {process.exitcode}); the same command goes on from here")


def _serve(line: Connection) -> None:
    """Make calls until the other end is closed. Ctrl-C, which a terminal sends to all, is for the caller."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    while True:
        try:
            call = line.recv()
        except EOFError:
            return
        try:
            found = (call(), None)
        except ValueError as error:
            found = (None, error)
        line.send(found)
