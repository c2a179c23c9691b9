"""Means of every claimed layer against the path tracer, with the standard errors of both sides (CSV and a figure).

Scenes: infinite medium (against quadrature of the exact fluence), homogeneous cube (g = 0, 0.7), heterogeneous plume, fog
with surfaces in it. Usage: python experiments/instant_verification.py [SCENE ...] [--sets 64] [--samples 1024].
"""

import argparse

import numpy as np
from instant_common import SCENES, figure, out_folder, square_camera, write_csv

from jaxvol import layers
from jaxvol.methods import instant_multiple_scattering as ims
from jaxvol.methods import path_tracing
from jaxvol.methods.instant_multiple_scattering.rendering import NAMES, render_set


def set_means(scene, camera, plan, number, *, seed):
    """Picture means of every layer for each of `number` sets of lights, [number, 6]."""
    sizes: dict[str, int] = {}
    rows = []
    for k in range(number):
        images, _ = render_set(scene, camera, plan, seed=seed + k, sizes=sizes)
        rows.append([images[name].mean(dtype=np.float64) for name in NAMES])
    return np.array(rows)


def verify(name, *, paths, sets, samples, size, options):
    """Rows (scene, layer, mean, se, reference, its se, difference, z) of one scene."""
    scene, camera = SCENES[name](), square_camera(size)
    plan = ims.plan(scene, camera, num_paths=paths, tile=max(size * size, 64), **options)
    means = set_means(scene, camera, plan, sets, seed=1000)
    reference = path_tracing.render(scene, camera, path_tracing.plan(scene, camera), seed=3, samples=samples)
    variances = dict(layers.items(reference.variance))
    rows = []
    for i, layer in enumerate(NAMES):
        exact = np.asarray(getattr(reference.mean, layer), np.float64)
        if exact.mean() == 0:
            continue
        mean, error = means[:, i].mean(), means[:, i].std(ddof=1) / np.sqrt(sets)
        reference_error = np.sqrt(np.asarray(variances[layer], np.float64).sum()) / exact.size
        difference = mean / exact.mean() - 1
        z = (mean - exact.mean()) / np.hypot(error, reference_error)
        rows.append([name, layer, mean, error / mean, exact.mean(), reference_error / exact.mean(), difference, z])
        print(
            f"{name:8s} {layer:22s} {mean:.5g} +- {error / mean:.2%}  reference {exact.mean():.5g} "
            f"+- {reference_error / exact.mean():.2%}  difference {difference:+.2%}  z {z:+.1f}",
            flush=True,
        )
    return rows


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scenes", nargs="*", default=list(SCENES))
    parser.add_argument("--paths", type=int, default=2048)
    parser.add_argument("--sets", type=int, default=64)
    parser.add_argument("--samples", type=int, default=1024)
    parser.add_argument("--size", type=int, default=16)
    parser.add_argument("--levels", type=int, default=3)
    arguments = parser.parse_args()
    rows = []
    for name in arguments.scenes:
        options = {"num_levels": arguments.levels}
        rows += verify(
            name, paths=arguments.paths, sets=arguments.sets, samples=arguments.samples, size=arguments.size, options=options
        )
        header = ["scene", "layer", "mean", "relative_se", "reference", "reference_se", "difference", "z"]
        write_csv(out_folder() / f"verification_{'_'.join(arguments.scenes)}.csv", header, rows)
    with figure(out_folder() / f"verification_{'_'.join(arguments.scenes)}.png") as axes:
        y = np.arange(len(rows))
        axes.errorbar([100 * r[6] for r in rows], y, xerr=[100 * np.hypot(r[3], r[5]) for r in rows], fmt="o")
        axes.axvline(0, color="k", lw=0.5)
        axes.axvspan(-1, 1, alpha=0.1)
        axes.set_yticks(y, [f"{r[0]}: {r[1]}" for r in rows])
        axes.set_xlabel("difference of the mean from the path tracer, % (bars: one standard error)")


if __name__ == "__main__":
    main()
