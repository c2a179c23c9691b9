"""Small helpers of the lattice-Boltzmann experiments: results folder, tables, figures, times."""

import argparse
import csv
import time
from contextlib import contextmanager
from pathlib import Path

import matplotlib
import numpy as np

matplotlib.use("Agg")
import matplotlib.pyplot as plt  # noqa: E402

from jaxvol.layers import VOLUME, items  # noqa: E402

HERE = Path(__file__).resolve().parent


def arguments(description, **options):
    """The command line: `--out FOLDER` and one option per keyword, its default giving the type."""
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument("--out", type=Path, default=Path("out/lattice_boltzmann"))
    for name, default in options.items():
        kind = {"nargs": "+", "type": type(default[0])} if isinstance(default, list) else {"type": type(default)}
        parser.add_argument(f"--{name.replace('_', '-')}", default=default, **kind)
    chosen = parser.parse_args()
    chosen.out.mkdir(parents=True, exist_ok=True)
    return chosen


class Seconds:
    """CPU and wall seconds of a block."""

    cpu = wall = 0.0


@contextmanager
def timed():
    """Yields `Seconds`, filled at the end."""
    found, cpu, wall = Seconds(), time.process_time(), time.perf_counter()
    yield found
    found.cpu, found.wall = time.process_time() - cpu, time.perf_counter() - wall


def write_csv(path, rows):
    """Rows are dictionaries with the same keys; also printed."""
    with open(path, "w", newline="") as file:
        writer = csv.DictWriter(file, fieldnames=list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)
    for row in rows:
        print("  ".join(f"{key} {value:.4g}" if isinstance(value, float) else f"{key} {value}" for key, value in row.items()))
    print("wrote", path)


def volume_image(layers):
    """The sum of all volume layers of an estimate's mean, [H, W, 3]."""
    images = [np.asarray(v) for name, v in items(layers) if all(part in VOLUME for part in name.split("+"))]
    return np.sum(images, axis=0)


def pictures(path, images, titles, *, columns=3, exposure=None):
    """Pictures side by side with one exposure: linear RGB, gamma 2.2."""
    scale = exposure or 0.8 / max(np.percentile(np.concatenate([np.ravel(i) for i in images]), 98), 1e-12)
    rows = -(-len(images) // columns)
    fig, axes = plt.subplots(rows, columns, figsize=(2.8 * columns, 3.0 * rows), constrained_layout=True, squeeze=False)
    for axis in axes.ravel():
        axis.set_axis_off()
    for axis, image, title in zip(axes.ravel(), images, titles, strict=False):
        axis.imshow(np.clip(image * scale, 0, 1) ** (1 / 2.2), interpolation="nearest")
        axis.set_title(title, fontsize=8)
    fig.savefig(path, dpi=110)
    plt.close(fig)
    print("wrote", path)
