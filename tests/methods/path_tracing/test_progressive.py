"""Rendering as a job: resumed to the same picture, stopped with what is there, ended by error or time."""

import signal
import subprocess
import sys
import time
from concurrent.futures import CancelledError

import jax.numpy as jnp
import numpy as np
import pytest

from jaxvol import layers
from jaxvol.camera import look_at
from jaxvol.jobs import Parts, Stop
from jaxvol.methods import path_tracing
from jaxvol.methods.path_tracing import estimate, progressive
from jaxvol.methods.path_tracing.film import empty_film
from jaxvol.types import Camera, Medium, PointLights, Scene


@pytest.fixture(autouse=True)
def small_batches(monkeypatch):
    monkeypatch.setattr(progressive, "_FIRST_BATCH", 16 * 256)


def fog_scene():
    medium = Medium(
        bounds=jnp.asarray([[-1.0, -1, -1], [1, 1, 1]]),
        sigma_s=jnp.full(3, 0.8),
        sigma_a=jnp.full(3, 0.1),
        g=jnp.float32(0.2),
    )
    scene = Scene(medium=medium, point_lights=PointLights(jnp.asarray([[0.0, 2.0, 0.5]]), jnp.ones((1, 3))))
    camera = Camera(look_at([0, 0.3, 4], [0, 0, 0], [0, 1, 0]), jnp.float32(0.6), height=16, width=16)
    return scene, camera, path_tracing.plan(scene, camera, num_lanes=1024)


@pytest.fixture(scope="module")
def fog():
    return fog_scene()


def picture(estimate):
    return np.asarray(layers.total(estimate.mean))


@pytest.mark.parametrize("large", [False, True])
def test_a_stopped_job_resumes_to_the_same_picture(fog, tmp_path, monkeypatch, large):
    """Also where the film is too large to have a second one beside it."""
    if large:
        monkeypatch.setattr(progressive, "_LARGE_FILM", 0)
    scene, camera, plan = fog
    whole = path_tracing.render(scene, camera, plan, samples=96, seed=2)
    config = {"scene": path_tracing.scene_digest(scene, camera)}
    stop = Stop()

    def interrupt(share, note=""):
        stop.requested = share > 0.3

    parts = Parts(tmp_path / "parts", config=config)
    part = path_tracing.render(scene, camera, plan, samples=96, seed=2, parts=parts, stop=stop, on_progress=interrupt)
    assert bool(part.diagnostics["stopped"]) and 0 < int(part.num_samples) < 96
    assert np.isfinite(picture(part)).all() and picture(part).max() > 0
    rest = path_tracing.render(scene, camera, plan, samples=96, seed=2, parts=Parts(tmp_path / "parts", config=config))
    assert int(rest.diagnostics["resumed_samples"]) == int(part.num_samples) and int(rest.num_samples) == 96
    assert np.allclose(picture(rest), picture(whole), rtol=1e-5, atol=1e-7)
    assert not (tmp_path / "parts").exists()  # a finished job leaves nothing behind


_CHILD = """
import sys
from jaxvol.jobs import Parts
from jaxvol.methods import path_tracing
from jaxvol.methods.path_tracing import progressive
from tests.methods.path_tracing.test_progressive import fog_scene
progressive._FIRST_BATCH, progressive._SAVE_SECONDS, progressive._BATCH_SECONDS = 16 * 256, 0.0, 0.2
scene, camera, plan = fog_scene()
path_tracing.render(scene, camera, plan, samples=4000, seed=2, parts=Parts(sys.argv[1], config={}))
"""


@pytest.mark.slow
def test_a_killed_job_resumes_to_the_same_picture(root, tmp_path):
    """SIGKILL in the middle of a batch: what was saved before is whole, and the rest is the rest."""
    child = subprocess.Popen([sys.executable, "-c", _CHILD, tmp_path / "parts"], cwd=root)
    manifest = tmp_path / "parts" / "manifest.json"
    while child.poll() is None and not (manifest.exists() and "accumulator" in manifest.read_text()):
        time.sleep(0.05)
    time.sleep(0.5)
    child.kill()
    assert child.wait() == -signal.SIGKILL, "it ended before it could be killed"
    scene, camera, plan = fog_scene()
    rest = path_tracing.render(scene, camera, plan, samples=4000, seed=2, parts=Parts(tmp_path / "parts", config={}))
    assert 0 < int(rest.diagnostics["resumed_samples"]) < 4000 and int(rest.num_samples) == 4000
    whole = path_tracing.render(scene, camera, plan, samples=4000, seed=2)
    for a, b in ((rest.mean, whole.mean), (rest.variance, whole.variance)):
        for name, image in layers.items(a):
            other = np.asarray(dict(layers.items(b))[name])
            np.testing.assert_allclose(np.asarray(image), other, rtol=2e-5, atol=1e-6 * other.max(), err_msg=name)


def test_an_error_in_one_thread_ends_the_others_and_is_told(fog, monkeypatch):
    scene, camera, plan = fog
    told_to_leave = []

    def run(*_, first_sample, on_step, **__):
        if first_sample:  # the second share
            raise OSError("broken")
        try:
            for _ in range(1000):
                time.sleep(0.01)
                on_step(0.0)
        except CancelledError:
            told_to_leave.append(True)
            raise

    monkeypatch.setattr(estimate.driver, "run", run)
    monkeypatch.setattr(estimate, "host_threads", lambda: 2)
    with pytest.raises(OSError, match="broken"):
        path_tracing.render(scene, camera, plan, samples=8)
    assert told_to_leave


def test_a_resumed_job_remembers_its_batches(fog, tmp_path):
    """What was good enough when it was stopped is good enough at once."""
    scene, camera, plan = fog
    found = path_tracing.render(scene, camera, plan, samples=640)
    parts, film = Parts(tmp_path / "parts", config={}), empty_film(256, plan.groups)
    estimate.add_samples(film, scene, camera, plan, seed=0, first_sample=0, num_samples=640, num_lanes=1024)
    parts.put("accumulator", {"film": film, "samples": np.int64(640), "batches": np.int64(16)})
    goal = 1.1 * float(found.diagnostics["error"])
    resumed = path_tracing.render(scene, camera, plan, until_error=goal, parts=parts)
    assert int(resumed.num_samples) == int(resumed.diagnostics["resumed_samples"]) == 640
    assert np.allclose(picture(resumed), picture(found), rtol=1e-5)


def test_until_error_stops_at_the_error_it_names(fog):
    scene, camera, plan = fog
    found = path_tracing.render(scene, camera, plan, until_error=0.05)
    assert float(found.diagnostics["error"]) <= 0.05 and int(found.num_samples) >= 64
    # The error is the spread that independent pictures really have.
    others = [picture(path_tracing.render(scene, camera, plan, samples=int(found.num_samples), seed=s)) for s in range(1, 9)]
    blocks = np.stack(others).reshape(8, 2, 8, 2, 8, 3).mean(axis=(2, 4))
    spread = blocks.std(axis=0, ddof=1).mean() / blocks.mean()
    assert 0.6 < spread / float(found.diagnostics["error"]) < 1.5


def test_a_time_limit_ends_the_job_with_a_picture(fog):
    scene, camera, plan = fog
    found = path_tracing.render(scene, camera, plan, seconds=0.5)
    assert int(found.num_samples) >= 1 and picture(found).max() > 0


@pytest.mark.parametrize(
    ("goal", "name"), [({"samples": 0}, "samples"), ({"seconds": 0.0}, "seconds"), ({"until_error": 2.0}, "until_error")]
)
def test_goals_out_of_range_are_named(fog, goal, name):
    scene, camera, plan = fog
    with pytest.raises(ValueError, match=name):
        path_tracing.render(scene, camera, plan, **goal)


def test_the_digest_sees_every_number(fog):
    scene, camera, _ = fog
    other = Camera(camera.world_from_camera, camera.fov_y + 1e-6, height=16, width=16)
    assert path_tracing.scene_digest(scene, camera) == path_tracing.scene_digest(scene, camera)
    assert path_tracing.scene_digest(scene, camera) != path_tracing.scene_digest(scene, other)
