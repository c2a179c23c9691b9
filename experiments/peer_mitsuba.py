"""Our path tracer against Mitsuba 3: are the pictures equal, and which is faster to equal error?

    python experiments/peer_mitsuba.py [NAME | SCENE.toml ...] [--set key=value ...]

A NAME is an entry of peer_mitsuba.toml (all of them by default); a scene file is taken with its defaults, and --set
overrides those. Both render each scene in one run, in batches with seeds of their own:

* one scattering: emission + surface_from_light + volume_from_light against Mitsuba with max_depth 2,
* two: and the four *_from_surface and *_from_volume, against max_depth 3,
* total: all layers, against no limit.

The test is Welch's of the batch means, for every block and channel, corrected for their number after Sidak (1 % for the
whole picture); a sum passes when 99.75 % of the blocks pass and the means of the whole picture are within 3 standard
errors (`stacked z`, the blocks' z added up and divided by the root of their number, tells small differences that a few
noisy blocks hide; it is not part of the verdict). Batches of heavy tails look quieter than they are: where Mitsuba's
spectral sampling leaves rare bright pixels (channels 100 apart), `per_channel` renders one grey picture a channel. Below
a systematic difference of 2e-4 (rays that Mitsuba starts off its surfaces, grown media) nothing is told.

Times are warm: CPU seconds of the process, both on all cores, compilation apart. With relMSE from the variances of the
two totals, which fall as 1 / time, the ratio of times to equal error is the ratio of the products of time and relMSE.
Our lanes idle while the longest paths of a batch end: for times choose samples times pixels far above `num_lanes`.
"""

import argparse
import csv
import os
import re
import sys
import tempfile
import time
import tomllib
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy import stats

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE.parent))

import matplotlib  # noqa: E402

matplotlib.use("Agg")
import jax.numpy as jnp  # noqa: E402
import matplotlib.pyplot as plt  # noqa: E402

from jaxvol import image, mitsuba_export, mitsuba_phong  # noqa: E402
from jaxvol.layers import NAMES, select  # noqa: E402
from jaxvol.methods import path_tracing  # noqa: E402
from jaxvol.scene import load_scene  # noqa: E402

ONE = ("emission", "surface_from_light", "volume_from_light")
TWO = (*ONE, "surface_from_surface", "surface_from_volume", "volume_from_surface", "volume_from_volume")
SUMS = {"one": (ONE, 2), "two": (TWO, 3), "total": (NAMES, -1)}  # our layers, Mitsuba's max_depth
SYSTEMATIC = 2e-4  # relative difference below which nothing is told
SIGNIFICANCE = 0.01  # of the whole picture
LEAST_LLVM = 19  # 19 and 22 work, 14 and 15 abort ("Cannot select: fmaximum")


@dataclass
class Batches:
    """Pictures [batch, height, width, 3] of each sum, and the seconds that all batches of the total took."""

    pictures: dict[str, np.ndarray]
    variance: np.ndarray  # of one batch of the total, [height, width, 3]
    cpu: float
    wall: float
    compile: float  # wall seconds of the first call


def choose_variant():
    """`llvm_ad_rgb` where a library that it can use is found, else `scalar_rgb`; the library goes to the environment."""
    if "DRJIT_LIBLLVM_PATH" in os.environ:
        return "llvm_ad_rgb"
    found = []
    for path in Path("/usr/lib").glob("*/libLLVM*.so*"):
        version = re.search(r"(\d+)(\.\d+)*$", path.name.replace(".so", "")) or re.search(r"-(\d+)", path.name)
        if version and int(version.group(1)) >= LEAST_LLVM:
            found.append((int(version.group(1)), str(path)))
    if not found:
        return "scalar_rgb"
    os.environ["DRJIT_LIBLLVM_PATH"] = max(found)[1]
    return "llvm_ad_rgb"


def clocks():
    return time.process_time(), time.perf_counter()


def render_ours(scene, camera, case, sums=SUMS):
    """Our batches of the chosen sums."""
    plan = path_tracing.plan(scene, camera, num_lanes=case["num_lanes"])
    begin = time.perf_counter()
    path_tracing.render(scene, camera, plan, seed=case["seed"] + 10_000, samples=1)
    first = time.perf_counter() - begin
    pictures, variances = {name: [] for name in sums}, []
    cpu, wall = clocks()
    for batch in range(case["batches"]):
        estimate = path_tracing.render(scene, camera, plan, seed=case["seed"] + batch, samples=case["samples"])
        for name, (layers, _) in sums.items():
            pictures[name].append(np.asarray(select(estimate.mean, layers), np.float64))
        variances.append(np.asarray(select(estimate.variance, NAMES), np.float64))
    cpu, wall = (after - before for after, before in zip(clocks(), (cpu, wall), strict=True))
    return Batches({k: np.stack(v) for k, v in pictures.items()}, np.mean(variances, axis=0), cpu, wall, first)


def channel_of(medium, channel):
    """The medium with the coefficients of one channel in all three."""
    grey = lambda sigma: jnp.full(3, sigma[channel])  # noqa: E731
    inclusions = tuple(channel_of(inclusion, channel) for inclusion in medium.inclusions)
    return replace(medium, sigma_s=grey(medium.sigma_s), sigma_a=grey(medium.sigma_a), inclusions=inclusions)


def render_peer(scene, camera, case, folder, sums=SUMS):
    """Mitsuba's batches of the chosen sums; `per_channel`: each channel from a grey picture of its own."""
    import mitsuba

    options = {"integrator": case["integrator"], "scale": case["scale"]}
    scenes = [scene]
    if case["per_channel"]:
        scenes = [replace(scene, medium=channel_of(scene.medium, channel)) for channel in range(3)]
    loaded = []
    for index, one in enumerate(scenes):
        described = mitsuba_export.to_mitsuba_dict(one, camera, Path(folder) / str(index), **options)
        loaded.append(mitsuba.load_dict(described))
    pictures, first = {}, 0.0
    for name, (_, max_depth) in sums.items():
        integrator = mitsuba.load_dict({"type": case["integrator"], "max_depth": max_depth})

        def draw(seed, samples, how=integrator):
            found = [
                np.array(mitsuba.render(one, integrator=how, seed=case["seed"] + seed + 1000 * index, spp=samples), np.float64)
                for index, one in enumerate(loaded)
            ]
            return found[0] if len(found) == 1 else np.stack([found[c][..., c] for c in range(3)], axis=-1)

        begin = time.perf_counter()
        draw(10_000, 1)
        first = time.perf_counter() - begin
        cpu, wall = clocks()
        pictures[name] = np.stack([draw(batch + 1, case["peer_samples"]) for batch in range(case["batches"])])
        cpu, wall = (after - before for after, before in zip(clocks(), (cpu, wall), strict=True))
    return Batches(pictures, pictures["total"].var(axis=0, ddof=1), cpu, wall, first)


def blocks_of(pictures, block):
    """Means of blocks of pixels; what does not fill a block at the border is left out."""
    n, height, width, _ = pictures.shape
    rows, columns = height // block, width // block
    cut = pictures[:, : rows * block, : columns * block]
    return cut.reshape(n, rows, block, columns, block, 3).mean(axis=(2, 4))


def welch(a, b):
    """Two-sided p values of equal means of batches [batch, ...], and the signed z of the same probability."""
    with np.errstate(divide="ignore", invalid="ignore"):
        va, vb = a.var(axis=0, ddof=1) / len(a), b.var(axis=0, ddof=1) / len(b)
        difference = a.mean(axis=0) - b.mean(axis=0)
        floor = (SYSTEMATIC * 0.5 * (a.mean(axis=0) + b.mean(axis=0))) ** 2
        degrees = (va + vb) ** 2 / (va**2 / (len(a) - 1) + vb**2 / (len(b) - 1))
        t = difference / np.sqrt(va + vb + floor)
    t = np.where(difference == 0, 0.0, t)
    degrees = np.where(np.isfinite(degrees), degrees, len(a) - 1)
    half = stats.t.sf(np.abs(t), degrees)
    return 2 * half, np.sign(t) * stats.norm.isf(np.maximum(half, 1e-300))


def relmse_of_noise(variance, mean):
    """relMSE (image.py) that a picture of this variance has against the truth."""
    return float(np.mean(variance / (mean**2 + 0.01 * np.mean(mean) ** 2)))


def test_sum(ours, peer, block):
    """The z-test of one sum, as a row of the table."""
    a, b = blocks_of(ours, block), blocks_of(peer, block)
    p, z = welch(a, b)
    errors = np.sqrt(a.var(axis=0, ddof=1) / len(a) + b.var(axis=0, ddof=1) / len(b))
    lit = a.mean(axis=0) + b.mean(axis=0) > 0
    alpha = 1 - (1 - SIGNIFICANCE) ** (1 / p.size)
    passed = float(np.mean(p > alpha))
    _, whole = welch(ours.mean(axis=(1, 2)), peer.mean(axis=(1, 2)))
    mean = 0.5 * (ours.mean() + peer.mean())
    error = np.hypot(*(x.mean(axis=(1, 2, 3)).std(ddof=1) / np.sqrt(len(x)) for x in (ours, peer)))
    return {
        "passes": bool(passed >= 0.9975 and np.max(np.abs(whole)) <= 3.0),
        "blocks_passed": passed,
        "largest_z": float(np.max(np.abs(z))),
        "sidak_z": float(stats.norm.isf(alpha / 2)),
        "block_error": float(np.median(2 * errors[lit] / (a.mean(axis=0) + b.mean(axis=0))[lit])),
        "rms_z": float(np.sqrt(np.mean(z**2))),
        "stacked_z": " ".join(f"{x:+.2f}" for x in np.sum(z, axis=(0, 1)) / np.sqrt(np.sum(z != 0, axis=(0, 1)))),
        "image_z": " ".join(f"{x:+.2f}" for x in whole),
        "difference": float(ours.mean() / peer.mean() - 1),
        "standard_error": float(error / mean),
    }


def compare(name, case, out):
    """Render a scene with both and return its rows of the table."""
    overrides = [f"camera.{side}={case[side]}" for side in ("width", "height")] + case["overrides"]
    file = load_scene(case["scene"], overrides=overrides)
    with tempfile.TemporaryDirectory() as folder:
        peer = render_peer(file.scene, file.camera, case, folder)
    ours = render_ours(file.scene, file.camera, case)
    mean = 0.5 * (ours.pictures["total"].mean(axis=0) + peer.pictures["total"].mean(axis=0))
    noise = [relmse_of_noise(x.variance / case["batches"], mean) for x in (ours, peer)]
    claimed = relmse_of_noise(ours.pictures["total"].var(axis=0, ddof=1) / case["batches"], mean) / noise[0]
    rows = []
    for which in SUMS:
        row = {"scene": name, "sum": which} | test_sum(ours.pictures[which], peer.pictures[which], case["block"])
        rows.append(row)
        verdict = "passes" if row["passes"] else "FAILS "
        print(
            f"{name:22s} {which:5s} {verdict} blocks {row['blocks_passed']:7.2%}  largest |z| {row['largest_z']:5.2f} "
            f"(Sidak {row['sidak_z']:.2f}, error {row['block_error']:.2%})  rms z {row['rms_z']:.2f}  "
            f"image z {row['image_z']}  stacked z {row['stacked_z']}  "
            f"difference {row['difference']:+.3%} +- {row['standard_error']:.3%}",
            flush=True,
        )
    times = {
        "samples": case["samples"] * case["batches"],
        "peer_samples": case["peer_samples"] * case["batches"],
        "cpu": ours.cpu,
        "peer_cpu": peer.cpu,
        "wall": ours.wall,
        "peer_wall": peer.wall,
        "first_call": ours.compile,
        "peer_first_call": peer.compile,
        "relmse": noise[0],
        "peer_relmse": noise[1],
        "batch_over_claimed_variance": claimed,
        "equal_error_cpu_ratio": ours.cpu * noise[0] / (peer.cpu * noise[1]),
        "equal_error_wall_ratio": ours.wall * noise[0] / (peer.wall * noise[1]),
        "load": os.getloadavg()[0],
    }
    for row in rows:
        row |= times if row["sum"] == "total" else dict.fromkeys(times, "")
    print(
        f"{name:22s} time to equal relMSE, ours / Mitsuba: CPU {times['equal_error_cpu_ratio']:.2f}, "
        f"wall {times['equal_error_wall_ratio']:.2f}  (CPU s {ours.cpu:.1f}, {peer.cpu:.1f}; relMSE {noise[0]:.3g}, "
        f"{noise[1]:.3g}; batch / claimed variance {claimed:.2f}; load {times['load']:.1f})",
        flush=True,
    )
    figure(out / f"{name}.png", ours.pictures, peer.pictures, case["block"], name)
    return rows


def figure(path, ours, peer, block, name):
    """Our picture, Mitsuba's, their difference over blocks and its z, for each sum."""
    fig, axes = plt.subplots(len(SUMS), 4, figsize=(11, 8), constrained_layout=True)
    for row, which in zip(axes, SUMS, strict=True):
        a, b = ours[which].mean(axis=0), peer[which].mean(axis=0)
        exposure = image.choose_exposure(b)
        for axis, picture, title in ((row[0], a, "jaxvol"), (row[1], b, "Mitsuba 3")):
            axis.imshow(image.tone_map(picture, exposure=exposure), interpolation="nearest")
            axis.set_title(f"{which}: {title}", fontsize=8)
        small = [blocks_of(x, block) for x in (ours[which], peer[which])]
        difference = (small[0].mean(axis=0) - small[1].mean(axis=0)).mean(axis=-1) / b.mean()
        z = welch(small[0].mean(axis=-1), small[1].mean(axis=-1))[1]
        limit = max(float(np.max(np.abs(difference))), 1e-6)
        shown = row[2].imshow(difference, cmap="RdBu", vmin=-limit, vmax=limit)
        row[2].set_title("difference / mean of the picture", fontsize=8)
        fig.colorbar(shown, ax=row[2], shrink=0.8)
        shown = row[3].imshow(z, cmap="RdBu", vmin=-4, vmax=4)
        row[3].set_title("z", fontsize=8)
        fig.colorbar(shown, ax=row[3], shrink=0.8)
    for axis in axes.ravel():
        axis.set_axis_off()
    fig.suptitle(name, fontsize=9)
    fig.savefig(path, dpi=90)
    plt.close(fig)
    print("wrote", path)


def cases(names, settings, config):
    """Name and settings of each comparison."""
    for name in names or list(config["scenes"]):
        if name not in config["scenes"] and not Path(name).is_file():
            raise SystemExit(f"{name!r} is no scene file and none of {', '.join(config['scenes'])}")
        own = config["scenes"].get(name, {"scene": name})
        case = {"overrides": []} | config["defaults"] | own | settings
        if name in config["scenes"]:
            case["scene"] = HERE / "scenes" / f"{own.get('scene', name)}.toml"
        yield Path(name).stem, case


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scenes", nargs="*", metavar="NAME|SCENE.toml")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="a key of [defaults]")
    parser.add_argument("--out", type=Path, default=Path("out/peer_mitsuba"))
    chosen = parser.parse_args()
    settings = tomllib.loads("\n".join(chosen.set))
    config = tomllib.loads((HERE / "peer_mitsuba.toml").read_text())
    chosen.out.mkdir(parents=True, exist_ok=True)
    variant = choose_variant()
    import mitsuba

    mitsuba.set_variant(variant)
    mitsuba_phong.register()
    print(f"Mitsuba {mitsuba.__version__}, {variant}, {os.environ.get('DRJIT_LIBLLVM_PATH', 'no libLLVM')}")
    rows = []
    for name, case in cases(chosen.scenes, settings, config):
        rows += compare(name, case, chosen.out)
        path = chosen.out / ("comparison.csv" if not chosen.scenes else f"{name}.csv")
        with open(path, "w", newline="") as file:
            table = csv.DictWriter(file, fieldnames=list(rows[0]))
            table.writeheader()
            table.writerows(rows)
        print("wrote", path, flush=True)
    raise SystemExit(0 if all(row["passes"] for row in rows) else 1)


if __name__ == "__main__":
    main()
