"""Baked irradiance on an open plane below a point light in fog, against the path tracer and quadrature: errors by medium.

`python experiments/bake_open_plane.py [--samples 65536] [--only 0]` writes bake_open_plane.csv and .png: ours, the paper's
mode (no image source, back-scattering by the epsilon trick), attenuated light alone. The reference of light scattered once on a
black plane is a quadrature without noise, that of everything is the path tracer with independent samples per receiver;
finished cases are kept in bake_open_plane.parts. Targets: scattered once 3 %, everything 3 % up to albedo 0.5, 6 % up to 0.99.
"""

import argparse
import csv
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

from jaxvol import image, jobs, layers
from jaxvol.methods import impulse_response, path_tracing
from jaxvol.scene import make_scene

CASES = tuple((c, g, a, 1.0) for a in (0.0, 0.5) for c in (0.5, 0.9, 0.99) for g in (0.0, 0.5, -0.5)) + (
    (0.5, 0.0, 0.0, 0.3),
    (0.99, 0.0, 0.0, 0.3),
    (0.5, 0.0, 0.0, 3.0),
    (0.99, 0.0, 0.0, 3.0),
)
MODES = {
    "ours": {},
    "no image": {"image": False},
    "paper": {"image": False, "back_scattering": "epsilon"},
    "attenuated": {"scattering": "attenuated"},
}
SIZE, RADII = 12.0, np.linspace(0.0, 3.0, 9)


def scene(c, g, reflectance, height=1.0):
    """A plane in the middle of 12 mean free paths of fog, a point light of intensity 1 `height` above it."""
    s = SIZE
    plane = (np.array([[-s, -s, 0], [s, -s, 0], [s, s, 0], [-s, s, 0]]), np.array([[0, 1, 2], [0, 2, 3]]))
    medium = {"density": 1.0, "bounds": [[-s, -s, 0], [s, s, s]], "scattering": c, "absorption": 1 - c, "anisotropy": g}
    light = {"kind": "point", "position": [0, 0, height], "intensity": 1}
    return make_scene({"shapes": [{"mesh": plane, "reflectance": reflectance}], "medium": medium, "lights": [light]}).scene


def scattered_once(c, g, radius, height, *, num=400):
    """Irradiance that a point light sends onto the plane after one scattering, sigma_t = 1: quadrature of equation (16).

    The half-angle form of the specification with the receiver's clamped cosine integrated over azimuth in closed form.
    """
    x, weight = np.polynomial.legendre.leggauss(num)
    x, weight = 0.5 * (x + 1), 0.5 * weight
    graded, by = x * x * (3 - 2 * x), weight * 6 * x * (1 - x)  # clusters nodes at the ends
    s, ws = np.pi / 2 * graded[:, None], np.pi / 2 * by[:, None]
    a, w = s * graded[None, :], s * (1 - graded[None, :])
    measure = ws * s * by[None, :]
    distance = np.hypot(radius, height)
    excess = 2 * np.sin(a) * np.sin(w) / np.cos(s)
    phase = (1 - g * g) / (4 * np.pi * (1 + g * g - 2 * g * np.cos(2 * s)) ** 1.5)
    along, across = height / distance * np.cos(2 * a), radius / distance * np.sin(2 * a)
    p = np.arccos(np.clip(-along / np.maximum(across, 1e-300), -1, 1))
    facing = 2 * (along * p + across * np.sin(p))
    return c * 4 / distance * np.sum(measure * phase * facing * np.exp(-distance * (1 + excess)))


def reference(case, samples, parts):
    """Path-traced irradiance and its standard error, in batches of samples that are kept."""
    points, normals = receivers()
    total, square, count = 0.0, 0.0, 0
    for batch in range(max(1, samples // 65536)):
        label = "_".join(map(str, case)) + f"_{batch}"
        done = parts.get(label)
        if done is None:
            found = path_tracing.irradiance(
                scene(*case), points + 1e-3 * normals, normals, samples=min(samples, 65536), seed=batch
            )
            done = {
                "mean": np.asarray(layers.total(found.mean)).mean(axis=1),
                "variance": np.asarray(next(iter(found.variance.sums.values())))[:, 1],
            }
            parts.put(label, done)
        total, square, count = total + done["mean"], square + done["variance"], count + 1
    return total / count, np.sqrt(square) / count


def receivers():
    points = np.zeros((len(RADII), 3), np.float32)
    points[:, 0] = RADII
    return points, np.tile(np.float32([0, 0, 1]), (len(RADII), 1))


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--samples", type=int, default=65536, help="of the path tracer, per receiver")
    parser.add_argument("--paths", type=int, default=4096, help="of the bake, per receiver")
    parser.add_argument("--only", type=int, nargs="*", help="numbers of cases")
    parser.add_argument("--out", type=Path, default=Path("out"))
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    points, normals = receivers()
    parts = jobs.Parts(arguments.out / "bake_open_plane.parts", config={"samples": arguments.samples})
    cases = [case for number, case in enumerate(CASES) if arguments.only is None or number in arguments.only]
    rows, figure = [], plt.figure(figsize=(22, 4.2 * -(-len(cases) // 6)), layout="constrained")
    for number, case in enumerate(cases):
        c, g, reflectance, height = case
        truth, noise = reference(case, arguments.samples, parts)
        once = np.array([scattered_once(c, g, radius, height) for radius in RADII])
        axes = figure.add_subplot(-(-len(cases) // 6), 6, number + 1)
        axes.errorbar(RADII, truth, 2 * noise, fmt="k.", label="path tracing, 2 standard errors")
        for mode, options in MODES.items():
            paths, bounces = (arguments.paths, 6) if reflectance else (1, 0)
            found = impulse_response.irradiance(scene(*case), points, normals, samples=paths, max_bounces=bounces, **options)
            total = np.asarray(layers.total(found.mean))[:, 0]
            error = image.relative_l1(total[:, None], truth[:, None])
            # On a black plane this layer is light scattered once; a reflecting plane adds nothing to it.
            single = image.relative_l1(np.asarray(found.mean.surface_from_volume)[:, :1], once[:, None])
            own = np.sqrt(sum(np.asarray(getattr(found.variance, name))[:, 0] for name in layers.SURFACE)).sum() / total.sum()
            rows.append(
                [*case, mode, single, error, image.bias(total[:, None], truth[:, None]), noise.sum() / truth.sum(), own]
            )
            axes.plot(RADII, total, label=f"{mode}, {error:.1%}")
            print(
                f"albedo {c}, g {g}, plane {reflectance}, height {height}, {mode}: scattered once {single:.2%}, everything "
                f"{error:.2%} (reference noise {rows[-1][-2]:.2%}, own {own:.2%})",
                flush=True,
            )
        axes.set(title=f"albedo {c}, g {g}, plane {reflectance}, height {height}", yscale="log", xlabel="mean free paths")
        axes.set_ylabel("irradiance")
        axes.legend(fontsize=7)
    figure.savefig(arguments.out / "bake_open_plane.png", dpi=80)
    with open(arguments.out / "bake_open_plane.csv", "w", newline="") as file:
        table = csv.writer(file)
        names = ["scattered_once", "everything", "bias", "reference_noise", "own_noise"]
        table.writerow(["albedo", "g", "reflectance", "height", "mode", *names])
        table.writerows(rows)


if __name__ == "__main__":
    main()
