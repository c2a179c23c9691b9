"""Every compiled stage of a render in float32 against itself in float64, and its slopes against central differences.

`python experiments/stress_precision.py [--scene fog_room_point] [--method NAME ...] [--out DIR]` renders one scene of
`jaxvol.stress.scenes` by each method, and writes stress_precision.csv and .png: per stage the relative L1 distance of its
values, of its slopes (along one direction in all floating-point inputs, `jaxvol.stress.gradients`), and of the slopes in
float64 from central differences. The last is no error where a stage draws or chooses by what is changed.
"""

import argparse
import csv
from pathlib import Path

import jax
import matplotlib
import numpy as np

matplotlib.use("Agg")
import matplotlib.pyplot as plt

from jaxvol import rendering
from jaxvol.stress import checks, gradients, scenes

COLUMNS = ("method", "stage", "outputs", "values", "slopes", "differences")


def distance(a, b):
    """Sum of |a - b| over that of |b|, where both are finite."""
    a, b = (np.concatenate([np.zeros(0), *(np.asarray(x, np.float64).ravel() for x in y)]) for y in (a, b))
    both = np.isfinite(a) & np.isfinite(b)
    size = np.abs(b[both]).sum()
    return float(np.abs(a[both] - b[both]).sum() / size) if size > 0 else 0.0


def stages_of(method, config):
    """One row per stage of a render."""
    with gradients.recording() as stages:
        checks.render(config, method)
    for key, stage in stages.items():
        values, slopes = gradients.derivative(key, stage)
        with jax.enable_x64(True):
            exact, right = gradients.derivative(key, stage, kind=np.float64)
            steps = gradients.differences(stage)
        if values:
            count = sum(x.size for x in values)
            found = (distance(values, exact), distance(slopes, right), distance(steps, right))
            yield dict(zip(COLUMNS, (method, stage.name, count, *found), strict=True))


def plot(rows, path):
    """One line per stage, a mark per distance."""
    figure, axes = plt.subplots(figsize=(9, 1 + 0.22 * len(rows)), layout="constrained")
    for column, mark in zip(COLUMNS[3:], "os|", strict=True):
        axes.plot([max(row[column], 1e-11) for row in rows], range(len(rows)), mark, ls="none", label=column)
    axes.set_yticks(range(len(rows)), [f"{row['method']}: {row['stage'].split('.', 1)[-1]}" for row in rows], fontsize=6)
    axes.invert_yaxis()
    axes.set(xscale="log", xlabel="relative L1 distance (at most 1e-11: at the left)")
    axes.legend(fontsize=7)
    figure.savefig(path, dpi=150)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scene", default="fog_room_point", choices=tuple(scenes.CLASSES))
    parser.add_argument("--method", nargs="*", default=[m for m in checks.METHODS if m != "auto"], choices=checks.METHODS)
    parser.add_argument("--out", type=Path, default=Path("out/stress_precision"))
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    config = scenes.draw(arguments.scene, np.random.default_rng(0))
    rows = []
    for method in arguments.method:
        rendering.load_method(method)
        rows += stages_of(method, config)
        for row in rows:
            if row["method"] == method:
                print(
                    "{method:28s} {stage:60s} {outputs:8d} {values:9.1e} {slopes:9.1e} {differences:9.1e}".format(**row),
                    flush=True,
                )
    with open(arguments.out / "stress_precision.csv", "w", newline="") as file:
        table = csv.DictWriter(file, fieldnames=COLUMNS)
        table.writeheader()
        table.writerows(rows)
    plot(rows, arguments.out / "stress_precision.png")


if __name__ == "__main__":
    main()
