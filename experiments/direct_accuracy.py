"""Direct light against the path tracer's same two layers, on every example scene at default settings.

Per scene and layer: relative L1 over blocks of pixels with the reference's noise, and per pixel against another seed of
direct light (its own noise: the sum of two runs' errors, over sqrt 2). The reference stops at one scattering and is kept
in the folder of results: each call with `--seconds` adds that much to it.
"""

import argparse
import csv
import sys
import time
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from jaxvol import direct, image, scene  # noqa: E402
from jaxvol.methods import path_tracing  # noqa: E402

LAYERS = ("surface_from_light", "volume_from_light")
SCENES = sorted(path.stem for path in (ROOT / "experiments" / "scenes").glob("*.toml"))


def load(name, width):
    """A scene and its camera, the picture `width` pixels wide with the same field of view."""
    file = scene.load_scene(ROOT / "experiments" / "scenes" / f"{name}.toml")
    height = round(width * file.camera.height / file.camera.width)
    file = scene.load_scene(
        ROOT / "experiments" / "scenes" / f"{name}.toml", overrides=[f"camera.width={width}", f"camera.height={height}"]
    )
    return file.scene, file.camera


def layers(values):
    """The two layers as one array [2, H, W, 3]."""
    return np.stack([np.asarray(getattr(values, name), np.float64) for name in LAYERS])


def reference(problem, camera, path, *, seconds):
    """Means and variances [2, H, W, 3] of the two layers, after `seconds` more of paths than the file held."""
    old = dict(np.load(path)) if path.exists() else None
    if seconds:
        plan = path_tracing.plan(problem, camera, max_scatterings=1)
        found = path_tracing.render(problem, camera, plan, seed=0 if old is None else int(old["runs"]), seconds=seconds)
        mean, variance = (
            np.stack([np.asarray(getattr(x, n), np.float64) for n in LAYERS]) for x in (found.mean, found.variance)
        )
        new = {"mean": mean, "variance": variance, "samples": float(found.num_samples), "runs": 1}
        if old is not None:
            a = float(old["samples"]) / (float(old["samples"]) + new["samples"])
            new["mean"] = a * old["mean"] + (1 - a) * new["mean"]
            new["variance"] = a * a * old["variance"] + (1 - a) ** 2 * new["variance"]
            new["samples"], new["runs"] = new["samples"] + float(old["samples"]), int(old["runs"]) + 1
        np.savez(path, **new)
        old = new
    if old is None:
        raise SystemExit(f"{path} is missing: give --seconds to compute it")
    return old["mean"], old["variance"]


def rows_of(name, arguments):
    """One row of results per layer, and the pictures."""
    problem, camera = load(name, arguments.width)
    mean, variance = reference(problem, camera, arguments.out / f"{name}_{arguments.width}.npz", seconds=arguments.seconds)
    plan = direct.plan(problem, camera)
    pictures = []
    for seed in (1, 0):  # the second run is warm
        cpu = time.process_time()
        found = direct.render(problem, camera, plan, seed=seed)
        pictures.append(layers(found.mean))
        cpu = time.process_time() - cpu
    other, mine = pictures
    rows = []
    for i, layer in enumerate(LAYERS):
        if mean[i].sum() == 0:
            assert mine[i].sum() == 0, f"{name} {layer}: the reference is black"
            continue
        block = arguments.block
        rows.append({
            "scene": name, "layer": layer,
            "relative_l1": image.relative_l1(mine[i], mean[i], block=block),
            "reference_noise": image.reference_noise(mean[i], variance[i], block=block),
            "bias": image.bias(mine[i], mean[i]),
            "pixel_noise": image.relative_l1(other[i], mine[i]) / np.sqrt(2),
            "cpu_seconds": cpu, "width": camera.width, "height": camera.height, "block": block,
        })  # fmt: skip
    np.savez(arguments.out / f"{name}_{arguments.width}_direct.npz", mine=mine)
    figure(arguments.out / f"{name}.png", mine, mean)
    return rows


def figure(path, mine, mean):
    """Direct light, the reference and the relative difference, one row per layer."""
    _, axes = plt.subplots(2, 3, figsize=(10, 6))
    for row, a, b, layer in zip(axes, mine, mean, LAYERS, strict=True):
        exposure = image.choose_exposure(b)
        row[0].imshow(image.tone_map(a, exposure=exposure))
        row[1].imshow(image.tone_map(b, exposure=exposure))
        error = (a - b).mean(axis=-1) / max(b.mean(), 1e-30)
        row[2].imshow(error, cmap="coolwarm", vmin=-0.1, vmax=0.1)
        for axis, title in zip(row, (f"direct, {layer}", "path tracer", "difference over mean, +-10 %"), strict=True):
            axis.set_title(title, fontsize=8)
            axis.axis("off")
    plt.tight_layout()
    plt.savefig(path, dpi=110)
    plt.close()


def main():
    """Measure, print, write `accuracy.csv` and one figure per scene."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scenes", nargs="*", default=SCENES)
    parser.add_argument("--seconds", type=float, default=0.0, help="path tracing to add to each reference")
    parser.add_argument("--width", type=int, default=48)
    parser.add_argument("--block", type=int, default=4)
    parser.add_argument("--out", type=Path, default=ROOT / "out" / "direct_accuracy")
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    rows = []
    for name in arguments.scenes:
        for row in rows_of(name, arguments):
            print("  ".join(f"{k} {v:.3g}" if isinstance(v, float) else f"{v}" for k, v in row.items()), flush=True)
            rows.append(row)
    with open(arguments.out / "accuracy.csv", "w", newline="") as file:
        writer = csv.DictWriter(file, fieldnames=list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)
    print("wrote", arguments.out / "accuracy.csv")


if __name__ == "__main__":
    main()
