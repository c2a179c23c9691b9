"""Scenes, clocks and pictures of the experiments on deep screen space (figures of Nalbach et al. 2014)."""

import csv
import os
import sys
import time
import tomllib
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from jaxvol import camera as cameras  # noqa: E402
from jaxvol import scene  # noqa: E402
from jaxvol.common_stages import CommonStages  # noqa: E402
from jaxvol.image import choose_exposure, tone_map  # noqa: E402
from jaxvol.methods import deep_screen_space as method  # noqa: E402
from jaxvol.methods import path_tracing  # noqa: E402
from jaxvol.methods.deep_screen_space import references  # noqa: E402
from jaxvol.methods.deep_screen_space.camera_rays import map_rays  # noqa: E402

PAPER = {
    "radius": "paper",
    "tail": False,
    "weights": "paper",
    "position": "jittered",
    "transport": "none",
    "blur": "paper",
    "pattern": "paper",
    "num_intervals": 15,
    "num_steps": 200,
    "strides": (1, 1, 1, 1, 1, 1),
}


def config():
    """The experiments' numbers; NAME=VALUE on the command line overrides a key of the script's own table."""
    name = Path(sys.argv[0]).stem
    table = tomllib.loads((ROOT / "experiments" / "deep_screen_space.toml").read_text())[name]
    for argument in sys.argv[1:]:
        key, _, value = argument.partition("=")
        if key not in table:
            raise SystemExit(f"{key!r} is unknown; {name} has {', '.join(table)}")
        table[key] = tomllib.loads(f"v = {value}")["v"]
    return table


def load(name, *, width=None, height=None):
    """A scene of experiments/scenes and its camera, at another size if wanted."""
    overrides = [f"camera.{k}={v}" for k, v in (("width", width), ("height", height)) if v]
    file = scene.load_scene(ROOT / "experiments" / "scenes" / f"{name}.toml", overrides=overrides)
    return file.scene, file.camera


def out(name):
    """A path under out/deep_screen_space."""
    folder = ROOT / "out" / "deep_screen_space"
    folder.mkdir(parents=True, exist_ok=True)
    return folder / name


def write_csv(name, header, rows):
    """A table with a header line, also printed."""
    with open(out(name), "w", newline="") as file:
        csv.writer(file).writerows([header, *rows])
    for row in [header, *rows]:
        print("  ".join(f"{v:.4g}" if isinstance(v, float) else str(v) for v in row), flush=True)


class Clock:
    """CPU and wall seconds by stage: an `on_stage` for `render`."""

    def __init__(self):
        self.cpu, self.wall = {}, {}
        self.last = time.process_time(), time.perf_counter()

    def __call__(self, name):
        now = time.process_time(), time.perf_counter()
        self.cpu[name] = self.cpu.get(name, 0.0) + now[0] - self.last[0]
        self.wall[name] = self.wall.get(name, 0.0) + now[1] - self.last[1]
        self.last = now


def timed(function, *, repeats=3):
    """Least CPU seconds of a warm call, its wall seconds, and what it returned."""
    function()
    best = None
    for _ in range(repeats):
        cpu, wall = time.process_time(), time.perf_counter()
        value = np.asarray(function())
        spent = time.process_time() - cpu, time.perf_counter() - wall
        best = spent if best is None or spent < best else best
    return *best, value


def load_average():
    """Processes that wanted a core during the last minute: how far to trust wall times."""
    return os.getloadavg()[0]


def layer(problem, camera, *, seed=0, on_stage=None, **options):
    """The layer `volume_from_surface` as numpy."""
    plan = method.plan(problem, camera, **options)
    return np.asarray(method.render(problem, camera, plan, seed=seed, on_stage=on_stage).mean.volume_from_surface)


def blocks_with_medium(problem, camera, *, size, num, seed=0):
    """Flat pixel indices [num, size^2] of blocks of pixels, chosen among those whose every ray crosses the medium."""
    plan = method.plan(problem, camera, num_intervals=4, num_steps=64, strides=(1,), num_levels=1)
    active = map_rays(problem, camera, plan, CommonStages(problem, camera), seed=0)
    shown = np.zeros(camera.height * camera.width, bool)
    shown[active.pixel[: active.num_rays]] = True
    rows, columns = camera.height // size, camera.width // size
    index = np.arange(camera.height * camera.width).reshape(camera.height, camera.width)[: rows * size, : columns * size]
    index = index.reshape(rows, size, columns, size).swapaxes(1, 2).reshape(-1, size * size)
    index = index[shown[index].any(axis=1)]
    return np.random.default_rng(seed).permutation(index)[:num]


def path_traced(problem, camera, pixels, *, num_samples, seed=0):
    """A3: the path tracer's `volume_from_surface` along the centres of flat pixels: mean, variance of the mean, CPU s.

    Two scatterings at most: longer paths belong to other layers.
    """
    rays = cameras.generate_rays(camera, cameras.pixel_centers(camera)[pixels.reshape(-1)])
    start = time.process_time()
    found = path_tracing.radiance(problem, rays, samples=num_samples, seed=seed, max_scatterings=2)
    mean, variance = (np.asarray(f.volume_from_surface, np.float64) for f in (found.mean, found.variance))
    return mean.reshape(*pixels.shape, 3), variance.reshape(*pixels.shape, 3), time.process_time() - start


def block_errors(image, mean, variance, pixels):
    """relative L1, bias and the reference's own noise, of block averages."""
    found = image.reshape(-1, 3)[pixels].mean(axis=1)
    reference, noise = mean.mean(axis=1), np.sqrt(variance.sum(axis=1)) / pixels.shape[1]
    total = reference.sum()
    return np.abs(found - reference).sum() / total, found.sum() / total - 1, noise.sum() / total


def pictures(name, rows, *, titles, labels=None):
    """Rows of pictures, one exposure a row, written as one PNG."""
    fig, axes = plt.subplots(
        len(rows), len(rows[0]), figsize=(3.0 * len(rows[0]), 2.4 * len(rows)), squeeze=False, constrained_layout=True
    )
    for r, images in enumerate(rows):
        exposure = choose_exposure(np.asarray(images[0], np.float64))
        for c, image in enumerate(images):
            axes[r, c].imshow(tone_map(np.asarray(image, np.float64), exposure=exposure))
            axes[r, c].set_xticks([])
            axes[r, c].set_yticks([])
            if r == 0:
                axes[r, c].set_title(titles[c], fontsize=9)
        if labels:
            axes[r, 0].set_ylabel(labels[r], fontsize=9)
    fig.savefig(out(name), dpi=110)
    plt.close(fig)


__all__ = [
    "PAPER",
    "Clock",
    "block_errors",
    "blocks_with_medium",
    "config",
    "layer",
    "load",
    "load_average",
    "method",
    "out",
    "path_traced",
    "pictures",
    "plt",
    "references",
    "timed",
    "write_csv",
]
