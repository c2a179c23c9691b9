"""Baked irradiance on an open plane below a point light in fog, against the path tracer: errors by albedo, g and reflectance.

`python experiments/bake_open_plane.py [--samples 16384]` writes bake_open_plane.csv and .png: ours, the paper's mode
(no image source, no back-scattering), attenuated light alone. Targets: 3 % up to albedo 0.5, 6 % up to 0.99.
"""

import argparse
import csv
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

from jaxvol import image, layers
from jaxvol.methods import impulse_response, path_tracing
from jaxvol.scene import make_scene

CASES = (
    (0.5, 0.0, 0.0),
    (0.9, 0.0, 0.0),
    (0.99, 0.0, 0.0),
    (0.9, 0.5, 0.0),
    (0.9, -0.5, 0.0),
    (0.5, 0.0, 0.5),
    (0.9, 0.0, 0.5),
)
MODES = {
    "ours": {},
    "paper": {"image": False, "back_scattering": False},
    "attenuated": {"scattering": "attenuated"},
}
SIZE, RADII = 12.0, np.linspace(0.0, 3.0, 9)


def scene(c, g, reflectance):
    s = SIZE
    plane = (np.array([[-s, -s, 0], [s, -s, 0], [s, s, 0], [-s, s, 0]]), np.array([[0, 1, 2], [0, 2, 3]]))
    medium = {"density": 1.0, "bounds": [[-s, -s, 0], [s, s, s]], "scattering": c, "absorption": 1 - c, "anisotropy": g}
    light = {"kind": "point", "position": [0, 0, 1], "intensity": 1}
    return make_scene({"shapes": [{"mesh": plane, "reflectance": reflectance}], "medium": medium, "lights": [light]}).scene


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--samples", type=int, default=16384, help="of the path tracer, per receiver")
    parser.add_argument("--paths", type=int, default=1024, help="of the bake, per receiver")
    parser.add_argument("--out", type=Path, default=Path("out"))
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    points = np.zeros((len(RADII), 3), np.float32)
    points[:, 0] = RADII
    normals = np.tile(np.float32([0, 0, 1]), (len(RADII), 1))
    rows, figure = [], plt.figure(figsize=(14, 6), layout="constrained")
    for number, (c, g, reflectance) in enumerate(CASES):
        what = scene(c, g, reflectance)
        reference = path_tracing.irradiance(what, points + 1e-3 * normals, normals, samples=arguments.samples)
        truth = np.asarray(layers.total(reference.mean))[:, :1]
        noise = np.sqrt(np.asarray(next(iter(reference.variance.sums.values())))[:, :1])
        axes = figure.add_subplot(2, 4, number + 1)
        axes.errorbar(RADII, truth[:, 0], 2 * noise[:, 0], fmt="k.", label="path tracing, 2 standard errors")
        for mode, options in MODES.items():
            paths = arguments.paths if reflectance else 1
            bounces = 6 if reflectance else 0
            found = impulse_response.irradiance(what, points, normals, samples=paths, max_bounces=bounces, **options)
            total = np.asarray(layers.total(found.mean))[:, :1]
            error = image.relative_l1(total, truth)
            far = image.relative_l1(total[len(RADII) // 2 :], truth[len(RADII) // 2 :])
            rows.append([c, g, reflectance, mode, error, far, image.bias(total, truth), noise.sum() / truth.sum()])
            axes.plot(RADII, total[:, 0], label=f"{mode}, {error:.1%}")
            print(
                f"albedo {c}, g {g}, plane {reflectance}, {mode}: relative L1 {error:.2%}, noise {rows[-1][-1]:.2%}", flush=True
            )
        axes.set(title=f"albedo {c}, g {g}, plane {reflectance}", yscale="log", xlabel="mean free paths", ylabel="irradiance")
        axes.legend(fontsize=7)
    figure.savefig(arguments.out / "bake_open_plane.png", dpi=110)
    with open(arguments.out / "bake_open_plane.csv", "w", newline="") as file:
        table = csv.writer(file)
        table.writerow(["albedo", "g", "reflectance", "mode", "relative_l1", "relative_l1_far", "bias", "reference_noise"])
        table.writerows(rows)


if __name__ == "__main__":
    main()
