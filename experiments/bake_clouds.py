"""Baked irradiance of the ground below LES cumulus clouds against the path tracer: heterogeneous media and their fallback.

`python experiments/bake_clouds.py [--size 24] [--samples 2048]` writes bake_clouds.csv and .png: ours with the segments of much
contrast marched, never marched (the paper's mean along each segment), attenuated light alone. Target: 10 % relative L1.
"""

import argparse
import csv
from pathlib import Path

import numpy as np
from bake_figures import errors, show, traced

from jaxvol import jobs, layers
from jaxvol.methods import impulse_response
from jaxvol.scene import load_scene

SCENE = Path(__file__).resolve().parent / "scenes" / "les_cumulus.toml"
MODES = {
    "ours, marched": {},
    "one marched leg": {"legs": 1},
    "never marched": {"contrast": None, "bounded": None},
    "attenuated only": {"scattering": "attenuated"},
    "surface-only": {"scattering": "surface"},
}


def receivers(size):
    """Points on the ground where the clouds' shadows fall, and beside them."""
    x, y = np.meshgrid(np.linspace(-0.5, 4.0, size), np.linspace(-0.5, 4.0, size), indexing="xy")
    points = np.stack([x, y, np.zeros_like(x)], axis=-1).astype(np.float32)
    return points, np.broadcast_to(np.float32([0, 0, 1]), points.shape)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--size", type=int, default=24)
    parser.add_argument("--samples", type=int, default=2048, help="of the path tracer, per receiver")
    parser.add_argument("--paths", type=int, default=256, help="of the bake, per receiver")
    parser.add_argument("--out", type=Path, default=Path("out"))
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    scene = load_scene(SCENE).scene
    points, normals = receivers(arguments.size)
    config = {"size": arguments.size, "samples": arguments.samples}
    parts = jobs.Parts(arguments.out / f"bake_clouds_{arguments.size}_{arguments.samples}.parts", config=config)
    done = parts.get("reference")
    if done is None:
        truth, variance, straight = traced(scene, points, normals, arguments.samples)
        done = {"truth": truth, "variance": variance, "straight": straight}
        parts.put("reference", done)
    truth, variance = done["truth"].reshape(-1, 3), done["variance"].reshape(-1, 3)
    rows, pictures = [], {"path tracing": done["truth"]}
    for name, options in MODES.items():
        paths = 4 if "surface" in name else arguments.paths
        found = impulse_response.irradiance(scene, points, normals, samples=paths, max_bounces=1, **options)
        total = np.asarray(layers.total(found.mean))
        row = errors(name, total.reshape(-1, 3), truth, variance)
        rows.append(row | {"marched_share": float(found.diagnostics["marched_share"])})
        pictures[f"{name}: {row['relative_l1']:.1%}"] = total
    with open(arguments.out / "bake_clouds.csv", "w", newline="") as file:
        table = csv.DictWriter(file, fieldnames=list(rows[0]))
        table.writeheader()
        table.writerows(rows)
    show(arguments.out / "bake_clouds.png", pictures)


if __name__ == "__main__":
    main()
