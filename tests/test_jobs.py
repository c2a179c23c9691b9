"""Atomic files, resumable parts, progress and Ctrl-C: what is left after every kind of interruption."""

import io
import json
import os
import resource
import signal
import threading

import numpy as np
import pytest

from jaxvol import jobs


@pytest.fixture
def folder(tmp_path):
    return tmp_path / "parts"


CONFIG = {"scene": "fog", "seed": 1, "render": {"samples": 16, "g": np.float32(0.5)}}


def part(seed):
    rng = np.random.default_rng(seed)
    return {"mean": rng.random((4, 5, 3)).astype(np.float32), "count": np.int64(seed)}


def assert_same(a, b):
    assert a.keys() == b.keys()
    for key in a:
        np.testing.assert_array_equal(a[key], b[key])
        assert a[key].dtype == np.asarray(b[key]).dtype


# ---- atomic files


@pytest.mark.parametrize("error", [RuntimeError, KeyboardInterrupt, OSError])
def test_a_failed_write_leaves_the_old_file_and_nothing_else(error, tmp_path):
    path = tmp_path / "a.txt"
    jobs.write_bytes(path, b"old")
    with pytest.raises(error), jobs.atomic_write(path) as temporary:
        assert temporary.parent == tmp_path and temporary.suffix == ".txt"
        temporary.write_bytes(b"half")
        raise error
    assert path.read_bytes() == b"old" and list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("step", ["fsync", "replace"])
def test_a_failure_while_finishing_leaves_the_old_file(step, tmp_path, monkeypatch):
    path = tmp_path / "a.txt"
    jobs.write_bytes(path, b"old")

    def fail(*arguments):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, step, fail)
    with pytest.raises(OSError, match="No space left"):
        jobs.write_bytes(path, b"new")
    assert path.read_bytes() == b"old" and list(tmp_path.iterdir()) == [path]


def test_a_full_disk_leaves_nothing(tmp_path):
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (1000, limits[1]))
        with pytest.raises(OSError, match="too large.*a.txt"):
            jobs.write_bytes(tmp_path / "a.txt", bytes(1001))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert not list(tmp_path.iterdir())


def test_folders_are_made_links_followed_devices_and_folders_refused(tmp_path):
    path = tmp_path / "deep" / "er" / "a.txt"
    jobs.write_bytes(path, b"1")
    link = tmp_path / "link.txt"
    link.symlink_to(path)
    jobs.write_bytes(link, b"2")
    assert link.is_symlink() and path.read_bytes() == b"2"
    for target in (tmp_path / "deep", "/dev/null"):
        with pytest.raises(OSError, match="not a regular file"):
            jobs.write_bytes(target, b"3")


def test_json_refuses_what_json_does_not_have(tmp_path):
    jobs.write_json(tmp_path / "a.json", {"seconds": np.float32(0.5), "shape": np.arange(2), "path": tmp_path})
    assert json.loads((tmp_path / "a.json").read_text()) == {"seconds": 0.5, "shape": [0, 1], "path": str(tmp_path)}
    with pytest.raises(ValueError, match="JSON"):
        jobs.write_json(tmp_path / "b.json", {"x": float("nan")})
    assert not (tmp_path / "b.json").exists()


# ---- parts


def test_parts_survive_the_process(folder):
    parts = jobs.Parts(folder, config=CONFIG)
    assert parts.get("tile_0") is None and len(parts) == 0
    for i in range(3):
        parts.put(f"tile_{i}", part(i))
    again = jobs.Parts(folder, config=CONFIG)
    assert again.names == ("tile_0", "tile_1", "tile_2") and "tile_1" in again and "tile_3" not in again
    for i in range(3):
        assert_same(again.get(f"tile_{i}"), part(i))
    assert again.damaged == {}
    again.clear()
    assert not folder.exists()


def test_an_accumulator_may_be_overwritten_and_interrupted(folder, monkeypatch):
    parts = jobs.Parts(folder, config=CONFIG)
    parts.put("sum", part(1))
    parts.put("sum", part(2))
    assert len(list(folder.glob("*.npz"))) == 1
    # The power fails between the new part and the manifest that names it.
    monkeypatch.setattr(jobs.Parts, "_save_manifest", lambda self: (_ for _ in ()).throw(KeyboardInterrupt))
    with pytest.raises(KeyboardInterrupt):
        parts.put("sum", part(3))
    monkeypatch.undo()
    again = jobs.Parts(folder, config=CONFIG)
    assert_same(again.get("sum"), part(2))
    assert len(list(folder.glob("*.npz"))) == 1  # the orphan is gone
    again.put("sum", part(2))  # the same again must not delete itself
    assert_same(jobs.Parts(folder, config=CONFIG).get("sum"), part(2))


def test_what_a_killed_job_was_writing_goes_with_the_rest(folder, monkeypatch):
    parts = jobs.Parts(folder, config=CONFIG)
    parts.put("a", part(0))
    written = []
    monkeypatch.setattr(jobs.os, "replace", lambda temporary, target: written.append((temporary, temporary.read_bytes())))
    parts.put("b" * 140, part(1))  # a part and the manifest
    monkeypatch.undo()
    for temporary, data in written:
        temporary.write_bytes(data)  # a killed process does not come to delete it
    (folder / "notes-of-the-user.npz").touch()
    assert {file.suffix for file, _ in written} == {".npz", ".json"} and len(list(folder.iterdir())) == 5
    again = jobs.Parts(folder, config=CONFIG)
    assert again.names == ("a",) and len(list(folder.iterdir())) == 3
    again.clear()
    assert [file.name for file in folder.iterdir()] == ["notes-of-the-user.npz"]


@pytest.mark.parametrize("harm", ["truncate", "edit", "empty", "delete", "swap"])
def test_a_damaged_part_is_found_and_computed_again(harm, folder):
    parts = jobs.Parts(folder, config=CONFIG)
    for i in range(3):
        parts.put(f"tile_{i}", part(i))
    file, other = next(folder.glob("tile_1-*")), next(folder.glob("tile_2-*"))
    data = file.read_bytes()
    if harm == "delete":
        file.unlink()
    else:
        middle = len(data) // 2
        edited = data[:middle] + bytes([data[middle] ^ 1]) + data[middle + 1 :]
        file.write_bytes({"truncate": data[:-1], "edit": edited, "empty": b"", "swap": other.read_bytes()}[harm])
    again = jobs.Parts(folder, config=CONFIG)
    assert again.get("tile_1") is None
    assert list(again.damaged) == ["tile_1"] and str(file) in again.damaged["tile_1"]
    assert_same(again.get("tile_2"), part(2))
    again.put("tile_1", part(1))
    assert_same(jobs.Parts(folder, config=CONFIG).get("tile_1"), part(1))


def test_another_configuration_is_refused_by_name_or_dropped(folder):
    jobs.Parts(folder, config=CONFIG).put("a", part(0))
    other = {**CONFIG, "render": {"samples": 32, "g": 0.5}}
    with pytest.raises(ValueError, match=r"another job \(differs in render.samples\)"):
        jobs.Parts(folder, config=other)
    fresh = jobs.Parts(folder, config=other, restart=True)
    assert len(fresh) == 0 and not list(folder.glob("*.npz"))


@pytest.mark.parametrize(
    "text", ["", "[]", "{}", "not json", '{"config": {}, "config_hash": "0", "parts": {}}', '{"config": 1, "parts": 2}', "\xff"]
)
def test_an_edited_manifest_is_refused(text, folder):
    jobs.Parts(folder, config=CONFIG).put("a", part(0))
    (folder / jobs.MANIFEST).write_text(text, encoding="latin-1")
    with pytest.raises(ValueError, match="manifest.json"):
        jobs.Parts(folder, config=CONFIG)
    assert len(list(folder.glob("*.npz"))) == 1  # refusing deletes nothing


def test_a_manifest_cannot_point_outside_the_folder(folder):
    parts = jobs.Parts(folder, config=CONFIG)
    parts.put("a", part(0))
    manifest = json.loads((folder / jobs.MANIFEST).read_text())
    manifest["parts"] = {"../../a": "0" * 64}
    (folder / jobs.MANIFEST).write_text(json.dumps(manifest))
    with pytest.raises(ValueError, match="edited"):
        jobs.Parts(folder, config=CONFIG)


def test_parts_hold_numbers_only_and_other_files_are_left_alone(folder):
    parts = jobs.Parts(folder, config=CONFIG)
    (folder / "notes.txt").write_text("mine")
    (folder / "mine.npz").write_text("mine too")
    with pytest.raises(ValueError, match="objects"):
        parts.put("a", {"x": np.array([{}])})
    with pytest.raises(ValueError, match="part name"):
        parts.put("../a", {"x": 1})
    jobs.Parts(folder, config=CONFIG).clear()
    assert {file.name for file in folder.iterdir()} == {"notes.txt", "mine.npz"}


# ---- progress and Ctrl-C


class Terminal(io.StringIO):
    def isatty(self):
        return True


def test_progress_writes_few_plain_lines_into_a_log():
    log = io.StringIO()
    with jobs.progress("rendering", total=1000, stream=log) as advance:
        for _ in range(1000):
            advance()
    (line,) = log.getvalue().splitlines()
    assert line.startswith("rendering: 100 % after 0 s")
    log = io.StringIO()
    with jobs.progress("rendering", total=4, stream=log, interval=0) as advance:
        for i in range(3):
            advance(note=f"pass {i}")
    lines = log.getvalue().splitlines()
    assert len(lines) == 4 and lines[0].startswith("rendering: 25 %") and "pass 0" in lines[0] and " s left" in lines[1]


def test_progress_draws_a_bar_on_a_terminal():
    screen = Terminal()
    with jobs.progress("rendering", total=2, stream=screen) as advance:
        advance(2, note="done")
    assert "rendering" in screen.getvalue() and "2/2" in screen.getvalue() and "\x1b" in screen.getvalue()


def test_first_interrupt_asks_second_aborts(capfd):
    before = signal.getsignal(signal.SIGINT)
    steps = 0
    with jobs.stoppable() as stop:
        while not stop:
            steps += 1
            if steps == 3:
                os.kill(os.getpid(), signal.SIGINT)
        with pytest.raises(KeyboardInterrupt):
            os.kill(os.getpid(), signal.SIGINT)
    assert steps == 3 and signal.getsignal(signal.SIGINT) is before
    assert "stopping" in capfd.readouterr().err


def test_stoppable_works_outside_the_main_thread():
    seen = []

    def work():
        with jobs.stoppable() as stop:
            seen.append(bool(stop))

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert seen == [False]
