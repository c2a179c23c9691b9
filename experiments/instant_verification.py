"""Means of every claimed layer against the path tracer, with the standard errors of both sides (CSV and a figure).

Scenes: infinite medium (one ray past a point source, against quadrature of the exact fluence), homogeneous cube (g = 0,
0.7), heterogeneous plume, fog with surfaces in it. Picture means of independent sets of lights, and of independent runs
of the reference, are appended to files, so that a run goes on where the last one stopped; errors are their spread.
Usage: python experiments/instant_verification.py [SCENE ...] [--sets 64] [--runs 32] [--minutes 4] [--side reference].
"""

import argparse
import csv
import time

import jax.numpy as jnp
import numpy as np
from instant_bias_table import exact_radiance
from instant_common import SCENES, figure, infinite, out_folder, square_camera, write_csv

from jaxvol.methods import instant_multiple_scattering as ims
from jaxvol.methods import path_tracing
from jaxvol.methods.instant_multiple_scattering.rendering import NAMES, gather_rays, make_context, render_set
from jaxvol.methods.instant_multiple_scattering.virtual_lights import sizes as sizes_of

# Many paths in a set and few lights of them gathered or marched to: paths are most of the noise of a mean over a picture.
SETTINGS = {
    "infinite": {"num_paths": 8192, "num_direct": 8, "jitter": False},
    "cube": {"num_paths": 65536, "max_lights": 4096, "num_direct": 8},
    "cube_g": {"num_paths": 65536, "max_lights": 8192, "num_direct": 32},
    "plume": {"num_paths": 32768, "max_lights": 8192, "num_direct": 8, "group_size": 40},
    "room": {"num_paths": 16384, "max_lights": None, "num_direct": 8, "group_size": 100, "light_stride": 16},
    "corner": {"num_paths": 65536, "max_lights": None, "num_direct": 8, "group_size": 100, "light_stride": 16},
}
SIZE = 24
SAMPLES = {"cube": 512, "cube_g": 512, "plume": 512, "room": 1024, "corner": 1024}  # of one run of the reference
LANES = 256


def infinite_set(plan, scene, seed, sizes):
    """Radiance of light scattered at least twice along a ray of length 6 past the source, in the six layers' places."""
    context, _ = make_context(scene, plan, seed=seed, sizes=sizes)
    sizes.update(sizes_of(context.lights))
    origin = jnp.tile(jnp.float32([[-3.0, 0.0, 0.0]]), (LANES, 1))
    direction = jnp.tile(jnp.float32([[1.0, 0.0, 0.0]]), (LANES, 1))
    index = jnp.arange(LANES, dtype=jnp.uint32)
    found = gather_rays(context, origin, direction, jnp.full(LANES, 6.0), jnp.full(LANES, -1, jnp.int32), index)
    value = np.asarray(found["volume_from_volume"] + found["volume_from_multiple"], np.float64).mean()
    return [value if name == "volume_from_multiple" else 0.0 for name in NAMES]


def ours(name):
    """A function that gives the picture means of every layer of the set with a given number."""
    scene, sizes = (infinite() if name == "infinite" else SCENES[name]()), {}
    camera = square_camera(SIZE)
    plan = ims.plan(scene, camera, tile=max(SIZE * SIZE, 64), **SETTINGS[name])
    if name == "infinite":
        return lambda k: infinite_set(plan, scene, 1000 + k, sizes)

    def one(k):
        images, _ = render_set(scene, camera, plan, seed=1000 + k, sizes=sizes)
        return [images[layer].mean(dtype=np.float64) for layer in NAMES]

    return one


def theirs(name):
    """The same of runs of the reference."""
    if name == "infinite":
        exact = exact_radiance()
        return lambda k: [exact if layer == "volume_from_multiple" else 0.0 for layer in NAMES]
    scene, camera = SCENES[name](), square_camera(SIZE)
    plan = path_tracing.plan(scene, camera)

    def one(k):
        mean = path_tracing.render(scene, camera, plan, seed=3 + k, samples=SAMPLES[name]).mean
        return [np.asarray(getattr(mean, layer), np.float64).mean() for layer in NAMES]

    return one


def continued(path, function, number, deadline):
    """Rows function(0), function(1), ... up to `number`, those in the file first; stops at the deadline."""
    rows = []
    if path.exists():
        with open(path, newline="") as file:
            rows = [[float(x) for x in row] for row in csv.reader(file)]
    while len(rows) < number and (len(rows) < 2 or time.monotonic() < deadline):
        rows.append([float(x) for x in function(len(rows))])
        with open(path, "a", newline="") as file:
            csv.writer(file).writerow(rows[-1])
    return np.array(rows)


def verify(name, sets, runs, minutes, side):
    """Rows (scene, layer, mean, se, reference, its se, difference, z) of one scene; `side`: whose means are added to."""
    folder = out_folder()
    share = (60.0 if side != "both" else 30.0) * minutes
    number = sets if side != "reference" else 0
    found = continued(folder / f"means_{name}.csv", ours(name), number, time.monotonic() + share)
    number = runs if side != "ours" else 0
    exact = continued(folder / f"means_{name}_reference.csv", theirs(name), number, time.monotonic() + share)
    rows = []
    if len(found) < 2 or len(exact) < 2:
        return rows
    for i, layer in enumerate(NAMES):
        mean, reference = found[:, i].mean(), exact[:, i].mean()
        if reference == 0:
            continue
        error = found[:, i].std(ddof=1) / np.sqrt(len(found))
        reference_error = exact[:, i].std(ddof=1) / np.sqrt(len(exact))
        z = (mean - reference) / np.hypot(error, reference_error)
        rows.append([name, layer, mean, error / mean, reference, reference_error / reference, mean / reference - 1, z])
        print(
            f"{name:8s} {layer:22s} {mean:.5g} +- {error / mean:.2%} ({len(found)} sets)  reference {reference:.5g} "
            f"+- {reference_error / reference:.2%} ({len(exact)})  difference {mean / reference - 1:+.2%}  z {z:+.1f}",
            flush=True,
        )
    return rows


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scenes", nargs="*", default=list(SETTINGS))
    parser.add_argument("--sets", type=int, default=64)
    parser.add_argument("--runs", type=int, default=32)
    parser.add_argument("--minutes", type=float, default=60.0, help="per scene; go on with the same command")
    parser.add_argument("--side", choices=["both", "ours", "reference"], default="both", help="whose means to add to")
    arguments = parser.parse_args()
    rows = []
    for name in arguments.scenes:
        rows += verify(name, arguments.sets, arguments.runs, arguments.minutes, arguments.side)
        header = ["scene", "layer", "mean", "relative_se", "reference", "reference_se", "difference", "z"]
        write_csv(out_folder() / f"verification_{'_'.join(arguments.scenes)}.csv", header, rows)
    if not rows:
        return
    with figure(out_folder() / f"verification_{'_'.join(arguments.scenes)}.png", size=(7, 4.5)) as axes:
        y = np.arange(len(rows))
        axes.errorbar([100 * r[6] for r in rows], y, xerr=[100 * np.hypot(r[3], r[5]) for r in rows], fmt="o")
        axes.axvline(0, color="k", lw=0.5)
        axes.axvspan(-1, 1, alpha=0.1)
        axes.set_yticks(y, [f"{r[0]}: {r[1]}" for r in rows])
        axes.set_xlabel("difference of the mean from the reference, %\n(bars: one standard error)")


if __name__ == "__main__":
    main()
