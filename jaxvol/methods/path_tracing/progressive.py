"""Rendering as a job: batch after batch until a number of samples, a time or an error is reached; saved, resumed, stopped."""

import hashlib
import math
import time
from collections.abc import Callable
from functools import partial

import jax
import numpy as np

from jaxvol.jobs import Parts, Stop
from jaxvol.methods.path_tracing.estimate import Plan, add_samples, lanes_for
from jaxvol.methods.path_tracing.film import empty_film, to_estimate, total_moments
from jaxvol.types import Camera, Estimate, Scene

_BLOCK = 8  # pixels: errors are told over blocks of this size
_LEAST_BATCHES = 16  # before an error is believed
_LEAST_SAMPLES = 64
_FIRST_BATCH = 1 << 18  # paths: enough to keep the lanes busy, few enough that there soon is something to show
_BATCH_SECONDS = 8.0
_SAVE_SECONDS = 10.0
_LARGE_FILM = 1 << 28  # bytes


class _GivenUp(Exception):
    """The user wants what is there, not the rest of this batch."""


def render(
    scene: Scene,
    camera: Camera,
    plan: Plan,
    *,
    seed: int = 0,
    samples: int = 64,
    seconds: float | None = None,
    until_error: float | None = None,
    parts: Parts | None = None,
    stop: Stop | None = None,
    on_progress: Callable[..., None] | None = None,
) -> Estimate:
    """The picture in all nine layers [H, W, 3] with the variance of each mean; unbiased.

    Ends after `samples` paths a pixel; or, where given instead, after about `seconds`, or as soon as `block_error` is at
    most `until_error` (from at least 64 samples in 16 batches). `parts` keeps the accumulators, so that a killed job
    goes on where it was, to the same result. `stop` ends it early with what is there. `on_progress(share, note)` is
    called as it goes. Diagnostics: `error` (as `block_error`), `resumed_samples`, `stopped`. Raises ValueError for
    values out of range.
    """
    _check(samples, seconds, until_error)
    film, done, batches = empty_film(camera.height * camera.width, plan.groups), 0, 0
    if parts is not None and (saved := parts.get("accumulator")) is not None:
        film, done, batches = saved["film"], int(saved["samples"]), int(saved.get("batches", 0))
    resumed = done
    shape = (camera.height, camera.width)
    lanes = lanes_for(camera.height * camera.width * _LEAST_SAMPLES, plan.num_lanes)  # one compilation for all batches
    limit = samples if seconds is None and until_error is None else None
    begin = saved_at = time.monotonic()
    batch, error, stopped = _first_batch(camera, until_error), block_error(film, plan, done, shape), False
    # A large film has no second beside it for the batch: then the batch that was begun is finished.
    large = film.nbytes > _LARGE_FILM
    while not _enough(done, limit, error, until_error, batches, seconds, time.monotonic() - begin):
        size = batch if limit is None else min(batch, limit - done)
        started = time.monotonic()
        added = film if large else np.zeros_like(film)

        target = (limit, error, until_error, seconds, begin)
        report = partial(_report, on_progress, stop if done and not large else None, done, size, target)
        try:
            add_samples(
                added,
                scene,
                camera,
                plan,
                seed=seed,
                first_sample=done,
                num_samples=size,
                num_lanes=lanes,
                on_progress=report,
            )
        except _GivenUp:
            stopped = True
            break
        # Loops on a device do not report by themselves; a batch that is complete is not given up.
        _report(on_progress, None, done, size, target, 1.0)
        if not large:
            film += added
        done, batches = done + size, batches + 1
        error = block_error(film, plan, done, shape)
        took = time.monotonic() - started
        if parts is not None and time.monotonic() - saved_at > _SAVE_SECONDS:
            parts.put("accumulator", {"film": film, "samples": np.int64(done), "batches": np.int64(batches)})
            saved_at = time.monotonic()
        if stop:
            stopped = True
            break
        if done >= _LEAST_SAMPLES or limit is not None:
            batch = int(min(max(size * _BATCH_SECONDS / max(took, 1e-3), size / 2, 1), 4 * size))
        if seconds is not None:
            left = seconds - (time.monotonic() - begin)
            batch = max(1, min(batch, int(left / max(took / size, 1e-6))))
    if parts is not None:
        if stopped:
            parts.put("accumulator", {"film": film, "samples": np.int64(done), "batches": np.int64(batches)})
        else:
            parts.clear()
    estimate = to_estimate(film, plan.groups, done, shape)
    estimate.diagnostics.update(error=np.float32(error), resumed_samples=np.int32(resumed), stopped=np.bool_(stopped))
    return estimate


def _report(on_progress, stop, done, size, target, share):
    """Pass on how far the job is while a batch of `size` samples is at `share`; give the batch up where `stop` asks."""
    if stop:
        raise _GivenUp
    if on_progress is not None:
        limit, error, until_error, seconds, begin = target
        reached = _share(done + share * size, limit, error, until_error, seconds, time.monotonic() - begin)
        on_progress(reached, "" if math.isinf(error) else f"error {error:.2%}")


def _check(samples, seconds, until_error):
    if samples < 1:
        raise ValueError(f"samples: {samples} is not allowed, must be >= 1")
    if seconds is not None and not 0 < seconds < math.inf:
        raise ValueError(f"seconds: {seconds} is not allowed, must be > 0 and finite")
    if until_error is not None and not 0 < until_error < 1:
        raise ValueError(f"until_error: {until_error} is not allowed, must be between 0 and 1")


def _first_batch(camera, until_error):
    """Samples a pixel; a sixteenth of the least that an error is told from, or few of a large picture."""
    pixels = camera.height * camera.width
    if until_error is None:
        return max(1, _FIRST_BATCH // pixels)
    return max(_LEAST_SAMPLES // _LEAST_BATCHES, _FIRST_BATCH // (_LEAST_BATCHES * pixels))


def _enough(done, limit, error, until_error, batches, seconds, elapsed):
    if limit is not None:
        return done >= limit
    if done == 0:
        return False
    if seconds is not None and elapsed >= seconds:
        return True
    return until_error is not None and error <= until_error and batches >= _LEAST_BATCHES and done >= _LEAST_SAMPLES


def _share(done, limit, error, until_error, seconds, elapsed):
    """Part of the job that is done; the error falls with the square root of the samples."""
    if limit is not None:
        return done / limit
    shares = [elapsed / seconds] if seconds is not None else []
    if until_error is not None:
        shares.append(0.0 if math.isinf(error) else min((until_error / max(error, 1e-9)) ** 2, 0.99))
    return max(shares)


def block_error(film: np.ndarray, plan: Plan, num_samples: int, shape: tuple[int, int]) -> float:
    """Mean over blocks of 8 x 8 pixels of the standard error of the block's mean, over the mean of the image.

    0 for a black image; inf for fewer than two samples.
    """
    if num_samples < 2:
        return math.inf
    mean, variance = total_moments(film, plan.groups, num_samples)
    height, width = (size - size % _BLOCK if size >= _BLOCK else size for size in shape)
    rows, columns = max(height // _BLOCK, 1), max(width // _BLOCK, 1)
    cut = variance.reshape(*shape, 3)[:height, :width].astype(np.float64)
    pixels = (height // rows) * (width // columns)
    sums = cut.reshape(rows, height // rows, columns, width // columns, 3).sum(axis=(1, 3))
    average = float(mean.mean(dtype=np.float64))
    return float(np.sqrt(sums).mean() / pixels / average) if average > 0 else 0.0


def scene_digest(scene: Scene, camera: Camera) -> str:
    """64 hexadecimal digits of every number in scene and camera: what a resumed job has to share with its past."""
    digest = hashlib.sha256()
    leaves, structure = jax.tree.flatten((scene, camera))
    digest.update(str(structure).encode())
    for leaf in leaves:
        digest.update(np.ascontiguousarray(np.asarray(leaf)).tobytes())
    return digest.hexdigest()
