"""How fast is the path tracer: time to equal error against Mitsuba 3, scene by scene, both on all cores in one run.

    python experiments/bench_reference.py [NAME ...] [--set key=value ...] [--out DIR]

The scenes and their defaults are those of peer_mitsuba.toml, which shows that the pictures are equal; here they are large
enough to keep all lanes busy (`[bench]` there). Times are warm. The noise of a picture falls as 1 / time, so the ratio of
times to equal error is the ratio of the products of time and relMSE: below 1 we are faster.
"""

import argparse
import csv
import os
import sys
import tempfile
import tomllib
from pathlib import Path

import numpy as np

HERE = Path(__file__).resolve().parent
sys.path[:0] = [str(HERE), str(HERE.parent)]

import matplotlib.pyplot as plt  # noqa: E402
import peer_mitsuba as peers  # noqa: E402

from jaxvol.scene import load_scene  # noqa: E402

TOTAL = {"total": peers.SUMS["total"]}


def measure(name, case):
    """One row of the table."""
    overrides = [f"camera.{side}={case[side]}" for side in ("width", "height")] + case["overrides"]
    file = load_scene(case["scene"], overrides=overrides)
    ours = peers.render_ours(file.scene, file.camera, case, TOTAL)
    with tempfile.TemporaryDirectory() as folder:
        peer = peers.render_peer(file.scene, file.camera, case | {"batches": case["peer_batches"]}, folder, TOTAL)
    mean = 0.5 * (ours.pictures["total"].mean(axis=0) + peer.pictures["total"].mean(axis=0))
    noise = [peers.relmse_of_noise(x.variance, mean) for x in (ours, peer)]  # of one batch
    batches = case["batches"], case["peer_batches"]
    pixels = case["width"] * case["height"]
    row = {"scene": name, "load": round(os.getloadavg()[0], 1)}
    for label, part, samples, count in (
        ("", ours, case["samples"], batches[0]),
        ("peer_", peer, case["peer_samples"], batches[1]),
    ):
        row[f"{label}cpu_us_per_path"] = part.cpu / (pixels * samples * count) * 1e6
        row[f"{label}wall_us_per_path"] = part.wall / (pixels * samples * count) * 1e6
        row[f"{label}first_call"] = part.compile
    row["relmse_per_path"], row["peer_relmse_per_path"] = noise[0] * case["samples"], noise[1] * case["peer_samples"]
    for clock in ("cpu", "wall"):
        times = row[f"{clock}_us_per_path"], row[f"peer_{clock}_us_per_path"]
        row[f"equal_error_{clock}_ratio"] = times[0] * row["relmse_per_path"] / (times[1] * row["peer_relmse_per_path"])
    return row


def figure(path, rows):
    """Bars of the ratios, on a logarithmic axis."""
    fig, axis = plt.subplots(figsize=(8, 1 + 0.4 * len(rows)), constrained_layout=True)
    place = np.arange(len(rows))
    for shift, clock in ((-0.18, "wall"), (0.18, "cpu")):
        axis.barh(place + shift, [r[f"equal_error_{clock}_ratio"] for r in rows], 0.34, label=f"{clock} time")
    axis.axvline(1.0, color="black", lw=1)
    axis.set_xscale("log")
    axis.set_yticks(place, [r["scene"] for r in rows])
    axis.invert_yaxis()
    axis.set_xlabel("our time / Mitsuba's, to equal relMSE")
    axis.legend()
    fig.savefig(path, dpi=100)
    plt.close(fig)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scenes", nargs="*", metavar="NAME")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="a key of [bench]")
    parser.add_argument("--out", type=Path, default=Path("out/bench_reference"))
    chosen = parser.parse_args()
    config = tomllib.loads((HERE / "peer_mitsuba.toml").read_text())
    settings = config["bench"] | tomllib.loads("\n".join(chosen.set))
    chosen.out.mkdir(parents=True, exist_ok=True)
    variant = peers.choose_variant()
    import mitsuba

    mitsuba.set_variant(variant)
    peers.mitsuba_phong.register()
    print(f"Mitsuba {mitsuba.__version__}, {variant}; {os.cpu_count()} cores")
    rows = []
    for name, case in peers.cases(chosen.scenes, settings, config):
        rows.append(row := measure(name, case))
        print(
            f"{name:22s} ours / Mitsuba to equal error: wall {row['equal_error_wall_ratio']:.2f}, CPU "
            f"{row['equal_error_cpu_ratio']:.2f}  (CPU us a path {row['cpu_us_per_path']:.2f}, "
            f"{row['peer_cpu_us_per_path']:.2f}; relMSE of one path {row['relmse_per_path']:.3g}, "
            f"{row['peer_relmse_per_path']:.3g}; first call {row['first_call']:.1f} s, {row['peer_first_call']:.1f} s; "
            f"load {row['load']})",
            flush=True,
        )
        with open(chosen.out / "bench_reference.csv", "w", newline="") as file:
            table = csv.DictWriter(file, fieldnames=list(rows[0]))
            table.writeheader()
            table.writerows(rows)
    figure(chosen.out / "bench_reference.png", rows)
    print("wrote", chosen.out / "bench_reference.csv", "and", chosen.out / "bench_reference.png")


if __name__ == "__main__":
    main()
