"""Long jobs that can be stopped: atomic files, finished parts that survive, progress, Ctrl-C.

Nothing here knows what a job computes. A job cuts its work into named parts, asks `Parts` which are done, computes the
rest inside `stoppable()` and reports through `progress()`.
"""

import hashlib
import json
import os
import re
import secrets
import signal
import sys
import threading
import time
import zipfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TextIO

import numpy as np
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

MANIFEST = "manifest.json"
_PART_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._+=,-]{0,150}")
_PART_FILE = re.compile(r".+-[0-9a-f]{16}\.npz")
_TEMPORARY_FILE = re.compile(r"\..{1,100}-[0-9a-f]{12}\.(npz|json)")  # as `atomic_write` names them; a killed job leaves one


@contextmanager
def atomic_write(path: str | os.PathLike) -> Iterator[Path]:
    """Yield a temporary path beside `path` that takes its place, flushed to disk, when the block ends without an error.

    After an error, a full disk or Ctrl-C `path` is as it was and the temporary file is gone. Missing parent folders are
    made; a symbolic link is followed. Raises OSError, also where `path` is a folder or a device.
    """
    target = Path(os.path.realpath(path))
    if target.exists() and not target.is_file():
        raise OSError(f"{os.fspath(path)}: cannot be written, it is not a regular file")
    target.parent.mkdir(parents=True, exist_ok=True)
    # The suffix stays, because some writers choose the format by it.
    temporary = target.with_name(f".{target.stem[:100]}-{secrets.token_hex(6)}{target.suffix}")
    try:
        yield temporary
        with open(temporary, "rb+") as file:
            os.fsync(file.fileno())
        os.replace(temporary, target)
    except OSError as error:
        if error.errno is None or error.filename is not None:
            raise
        raise OSError(error.errno, error.strerror, os.fspath(path)) from error  # a full disk does not say which file
    finally:
        temporary.unlink(missing_ok=True)
    folder = os.open(target.parent, os.O_RDONLY)
    try:
        os.fsync(folder)  # makes the new name itself survive a power cut
    finally:
        os.close(folder)


def write_bytes(path: str | os.PathLike, data: bytes) -> None:
    """Write a whole file atomically."""
    with atomic_write(path) as temporary:
        temporary.write_bytes(data)


def write_json(path: str | os.PathLike, value: Any) -> None:
    """Write indented JSON atomically. Raises ValueError for NaN and infinities, which JSON does not have."""
    text = json.dumps(value, indent=2, allow_nan=False, default=_plain)
    write_bytes(path, (text + "\n").encode())


def config_json(config: Any) -> str:
    """The canonical JSON text of a job's configuration: sorted keys, numpy scalars and arrays as plain numbers."""
    return json.dumps(config, sort_keys=True, separators=(",", ":"), default=_plain)


def config_hash(config: Any) -> str:
    """64 hexadecimal digits (SHA-256) that name a job's configuration."""
    return hashlib.sha256(config_json(config).encode()).hexdigest()


def _plain(value: Any) -> Any:
    """What `json` does not know: numpy and jax arrays and scalars, paths."""
    if isinstance(value, os.PathLike):
        return os.fspath(value)
    if hasattr(value, "tolist"):
        return value.tolist()
    raise TypeError(f"{type(value).__name__} has no JSON form")


class Parts:
    """The finished parts of one job, kept in a folder: `name -> dict of numpy arrays`.

    `manifest.json` holds the job's configuration and the SHA-256 of every part; a part is one `.npz` file without
    pickles. Overwriting a part (a running accumulator) is safe: the old one stays valid until the manifest names the
    new one. A part whose file is missing, truncated or edited counts as not done; its name and what is wrong are
    collected in `damaged`, so that the job can say what it computes again.

    A folder with another configuration is refused with ValueError (naming the keys that differ) unless `restart` is
    True, which drops its parts. An unreadable manifest is refused likewise.
    """

    def __init__(self, folder: str | os.PathLike, *, config: Mapping[str, Any], restart: bool = False):
        self.folder = Path(folder)
        self.damaged: dict[str, str] = {}
        self._config = json.loads(config_json(config))
        self._digests: dict[str, str] = {}
        self.folder.mkdir(parents=True, exist_ok=True)
        if restart:
            self._save_manifest()
        elif (self.folder / MANIFEST).exists():
            self._digests = self._load_manifest()
        else:
            self._save_manifest()
        self._remove_unlisted()

    def __contains__(self, name: str) -> bool:
        return self.get(name) is not None

    def __len__(self) -> int:
        return len(self._digests)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parts that the manifest lists, in the order in which they were finished."""
        return tuple(self._digests)

    def get(self, name: str) -> dict[str, np.ndarray] | None:
        """The arrays of a finished part, or None where it is not done or its file is damaged."""
        digest = self._digests.get(name)
        if digest is None:
            return None
        try:
            with open(self._file(name, digest), "rb") as file:
                found = hashlib.file_digest(file, "sha256").hexdigest()
                if found != digest:
                    return self._drop(name, "does not match its checksum (truncated or edited)")
                file.seek(0)
                with np.load(file, allow_pickle=False) as arrays:
                    return {key: arrays[key] for key in arrays.files}
        except OSError as error:
            return self._drop(name, f"cannot be read ({error.strerror})")

    def put(self, name: str, arrays: Mapping[str, Any]) -> None:
        """Save a finished part; returns when it is on disk. Raises ValueError for a bad name or arrays of objects."""
        if not _PART_NAME.fullmatch(name):
            raise ValueError(f"part name {name!r} must match {_PART_NAME.pattern}")
        plain = {key: np.asarray(value) for key, value in arrays.items()}
        sha256 = hashlib.sha256()  # names the file, so it is known first: twice the work, but no copy of large arrays
        _write_npz(sha256.update, plain)
        digest, old = sha256.hexdigest(), self._digests.get(name)
        with atomic_write(self._file(name, digest)) as temporary, open(temporary, "wb") as file:
            _write_npz(file.write, plain)
        self._digests[name] = digest
        self._save_manifest()
        if old is not None and old != digest:
            self._file(name, old).unlink(missing_ok=True)

    def clear(self) -> None:
        """Forget and delete every part, and the folder too if nothing else is in it; for when the job has ended."""
        self._digests.clear()
        self._remove_unlisted()
        (self.folder / MANIFEST).unlink(missing_ok=True)
        if self.folder.is_dir() and not any(self.folder.iterdir()):
            self.folder.rmdir()

    def _file(self, name: str, digest: str) -> Path:
        return self.folder / f"{name}-{digest[:16]}.npz"

    def _drop(self, name: str, problem: str) -> None:
        self.damaged[name] = f"{self._file(name, self._digests[name])}: {problem}"
        del self._digests[name]

    def _save_manifest(self) -> None:
        manifest = {"config": self._config, "config_hash": config_hash(self._config), "parts": self._digests}
        write_json(self.folder / MANIFEST, manifest)

    def _load_manifest(self) -> dict[str, str]:
        path = self.folder / MANIFEST
        try:
            manifest = json.loads(path.read_bytes())
            config, named_hash, digests = manifest["config"], manifest["config_hash"], dict(manifest["parts"])
            sound = all(_PART_NAME.fullmatch(name) and re.fullmatch("[0-9a-f]{64}", d) for name, d in digests.items())
        except (ValueError, KeyError, TypeError) as error:
            raise ValueError(f"{path}: is no manifest of finished parts ({error}); delete it to start again") from error
        if not sound or config_hash(config) != named_hash:
            raise ValueError(f"{path}: was edited, its checksum does not fit; delete the folder to start again")
        if config != self._config:
            differing = ", ".join(_differing_keys(config, self._config))
            raise ValueError(f"{self.folder}: holds parts of another job (differs in {differing}); delete it or choose another")
        return digests

    def _remove_unlisted(self) -> None:
        listed = {self._file(name, digest).name for name, digest in self._digests.items()}
        for file in list(self.folder.glob("*")):
            if _TEMPORARY_FILE.fullmatch(file.name) or (file.name not in listed and _PART_FILE.fullmatch(file.name)):
                file.unlink(missing_ok=True)


class _Sink:
    """A file of which zipfile knows only how to write: the same bytes come out whatever takes them."""

    def __init__(self, take: Callable[[bytes], Any]):
        self._take = take

    def write(self, data: bytes) -> int:
        self._take(data)
        return len(data)

    def flush(self) -> None:
        """Whoever takes the bytes flushes them."""


def _write_npz(take: Callable[[bytes], Any], arrays: Mapping[str, np.ndarray]) -> None:
    """Hand over an uncompressed .npz piece by piece; like `np.savez`, but for any key, without pickles and clocks."""
    with zipfile.ZipFile(_Sink(take), "w") as archive:
        for key, value in arrays.items():
            if value.dtype.hasobject:
                raise ValueError(f"array {key!r} holds Python objects; a part holds numbers only")
            with archive.open(zipfile.ZipInfo(key + ".npy"), "w", force_zip64=True) as member:
                np.lib.format.write_array(member, value, allow_pickle=False)


def _differing_keys(a: Any, b: Any, prefix: str = "") -> list[str]:
    """Dotted names of the leaves in which two JSON values differ."""
    if isinstance(a, dict) and isinstance(b, dict):
        keys = sorted(set(a) | set(b))
        missing = object()
        return [
            name
            for key in keys
            if a.get(key, missing) != b.get(key, missing)
            for name in _differing_keys(a.get(key), b.get(key), f"{prefix}.{key}" if prefix else key)
        ]
    return [prefix or "its form"]


@contextmanager
def progress(
    description: str, *, total: float, stream: TextIO | None = None, interval: float = 10.0
) -> Iterator[Callable[..., None]]:
    """Show how far a job is, on `stream` (default stderr); yields `advance(n=1, note="")`.

    A terminal gets a bar with the time that is left; anything else gets one plain line every `interval` seconds and
    one at the end, so that log files stay short.
    """
    stream = sys.stderr if stream is None else stream
    if stream.isatty():
        with _bar(description, total, stream) as advance:
            yield advance
        return

    start = last = time.monotonic()
    done, last_note = 0.0, ""

    def line() -> None:
        seconds = time.monotonic() - start
        share = f"{100 * done / total:.0f} %" if total > 0 else "100 %"
        left = f", about {seconds * (total - done) / done:.0f} s left" if 0 < done < total else ""
        print(f"{description}: {share} after {seconds:.0f} s{left}{last_note}", file=stream, flush=True)

    def advance(n: float = 1, note: str = "") -> None:
        nonlocal done, last, last_note
        done += n
        last_note = f" ({note})" if note else ""
        if time.monotonic() - last >= interval:
            last = time.monotonic()
            line()

    try:
        yield advance
    finally:
        line()


@contextmanager
def _bar(description: str, total: float, stream: TextIO) -> Iterator[Callable[..., None]]:
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
        TextColumn("{task.fields[note]}"),
    )
    with Progress(*columns, console=Console(file=stream)) as bar:
        task = bar.add_task(description, total=total, note="")

        def advance(n: float = 1, note: str = "") -> None:
            bar.update(task, advance=n, note=note)

        yield advance


class Stop:
    """A flag that turns true once the user has asked the job to end: `while not stop: ...`."""

    requested = False

    def __bool__(self) -> bool:
        return self.requested


@contextmanager
def stoppable(*, message: str = "stopping after the current step; Ctrl-C again to abort at once") -> Iterator[Stop]:
    """Yield a `Stop` that the first Ctrl-C (SIGINT) sets, printing `message` to stderr; the second raises KeyboardInterrupt.

    The former handler is put back at the end. Outside the main thread, where Python allows no handlers, the flag simply
    never turns true.
    """
    stop = Stop()
    if threading.current_thread() is not threading.main_thread():
        yield stop
        return

    def handle(number: int, frame: Any) -> None:
        if stop.requested:
            raise KeyboardInterrupt
        stop.requested = True
        os.write(2, f"\n{message}\n".encode())  # not print: a handler may interrupt another print

    former = signal.signal(signal.SIGINT, handle)
    try:
        yield stop
    finally:
        signal.signal(signal.SIGINT, former)
