"""Table 1: CPU time by stage at 800x600; at 400x300 the time and error of lists, dense form and path tracer.

    python experiments/deep_screen_space_timing.py [key=value ...]

Writes out/deep_screen_space/timing_table.csv, timing_forms.csv, timing_path_tracer.csv and timing.png; beside the path
tracer's time stands what it takes of Mitsuba's to the same error of the same picture (mitsuba = false leaves that out).
Useful pairs are inside a shell, before the surfel and in the medium. CPU seconds of all cores, the least of
three warm frames; the load average stands beside them because wall times on a busy machine mean little.
"""

import dataclasses
import tomllib
from unittest import mock

import jax.numpy as jnp
import numpy as np
from deep_screen_space_common import (
    Clock,
    blocks_with_medium,
    config,
    layer,
    load,
    load_average,
    method,
    out,
    path_traced,
    plt,
    write_csv,
)

from jaxvol.methods.deep_screen_space import kernel, splatting


def frame(problem, camera, plan, *, repeats=3):
    """The cheapest of several warm frames: CPU seconds by stage, the estimate."""
    method.render(problem, camera, plan)
    best = None
    for _ in range(repeats):
        clock = Clock()
        estimate = method.render(problem, camera, plan, on_stage=clock)
        if best is None or sum(clock.cpu.values()) < sum(best.cpu.values()):
            best = clock
    return best, estimate


def stage_table(settings):
    """Stage times of one frame at the paper's size."""
    problem, camera = load(settings["scene"], width=settings["paper_width"], height=settings["paper_height"])
    clock, _ = frame(problem, camera, method.plan(problem, camera, num_surfels=settings["surfels"]))
    rows = [[name, 1e3 * clock.cpu[name], 1e3 * clock.wall[name]] for name in clock.cpu]
    rows.append(["splat, sum", sum(r[1] for r in rows if r[0].startswith("splat")), 0.0])
    rows.append(["frame", 1e3 * sum(clock.cpu.values()), 1e3 * sum(clock.wall.values())])
    rows.append(["load average", load_average(), 0.0])
    write_csv("timing_table.csv", ["stage", "cpu_ms", "wall_ms"], rows)
    return rows


def splat_calls(problem, camera, plan):
    """What `splatting.splat` is called with in one frame, level by level: (arguments, keywords)."""
    calls, splat = [], splatting.splat

    def listen(*arguments, **keywords):
        calls.append((arguments, keywords))
        return splat(*arguments, **keywords)

    with mock.patch.object(splatting, "splat", listen):
        method.render(problem, camera, plan)
    return calls


def useful_pairs(calls):
    """Pairs with a value above zero: the splat again with every surfel's light 1 wherever the kernel is above 0."""
    count = 0.0
    pair_samples = kernel.pair_samples

    def ones(*arguments, **keywords):
        return [jnp.where(value > 0, 1.0, 0.0) for value in pair_samples(*arguments, **keywords)]

    with mock.patch.object(kernel, "pair_samples", ones):
        for (rays, surfels, tile, group, num_pairs, _, g, table), keywords in calls:
            row = surfels.row.at[..., 9:12].set((surfels.row[..., 9:12].max(axis=-1, keepdims=True) > 0).astype(jnp.float32))
            bare, bright = dataclasses.replace(rays, weight=None, cell=None), dataclasses.replace(surfels, row=row)
            image = splatting.splat.__wrapped__(bare, bright, tile, group, num_pairs, None, g, table, **keywords)
            real = np.abs(np.asarray(rays.direction)).max(axis=1) > 0  # padding has no direction
            count += np.sum(np.asarray(image[:, 0], np.float64) * real) / float(kernel.phase_scale(keywords["phase"], g))
    return count


def temporaries(calls):
    """Largest temporary storage of the splat's programs, MB: XLA's own account."""
    sizes = [splatting.splat.lower(*a, **k).compile().memory_analysis().temp_size_in_bytes for a, k in calls]
    return max(sizes) / 1e6


def forms(settings):
    """Time and error of the forms against all pairs, and of the path tracer at the same error."""
    problem, camera = load(settings["scene"], width=settings["width"], height=settings["height"])
    base = {"num_surfels": settings["surfels"]}
    every = layer(problem, camera, **base, num_levels=1, strides=(1,), dense_from=0, blur="none")
    rows = []
    for name, options in {
        "lists": {},
        "dense on every level": {"dense_from": 0},
        "every sample on all levels": {"strides": (1,) * 6},
        "epsilon 0.24": {"epsilon": 0.24},
        "without transport": {"transport": "none"},
    }.items():
        clock, estimate = frame(problem, camera, method.plan(problem, camera, **base, **options), repeats=2)
        pairs = sum(float(v) for k, v in estimate.diagnostics.items() if k.startswith("pairs_"))
        splat = sum(v for k, v in clock.cpu.items() if k.startswith("splat") or k in ("tiles", "lists"))
        calls = splat_calls(problem, camera, method.plan(problem, camera, **base, **options))
        useful = useful_pairs(calls)
        image = np.asarray(estimate.mean.volume_from_surface)
        error = np.abs(image - every).sum() / every.sum()
        costs = [pairs, 1e9 * splat / pairs, useful, 1e9 * splat / useful]
        rows.append([name, sum(clock.cpu.values()), splat, *costs, error, temporaries(calls)])
    header = ["form", "frame_cpu_s", "lists_and_splat_cpu_s", "pairs", "ns_per_pair", "useful_pairs", "ns_per_useful_pair"]
    header += ["error_against_all_pairs", "temporaries_MB"]
    write_csv("timing_forms.csv", header, rows)


def against_path_tracer(settings):
    """CPU seconds that the path tracer needs for our error at single pixels: its mean square error falls as 1 / time.

    With two independent references A and B, the mean of (ours - A) (ours - B) is our mean square error, without theirs.
    """
    problem, camera = load(settings["scene"], width=settings["width"], height=settings["height"])
    clock, estimate = frame(problem, camera, method.plan(problem, camera, num_surfels=settings["surfels"]))
    ours, spent = np.asarray(estimate.mean.volume_from_surface), sum(clock.cpu.values())
    pixels = blocks_with_medium(problem, camera, size=1, num=settings["num_pixels"])
    first, _, _ = path_traced(problem, camera, pixels, num_samples=settings["samples"], seed=1)
    second, _, seconds = path_traced(problem, camera, pixels, num_samples=settings["samples"], seed=2)
    medium_pixels = int((ours.sum(axis=-1) > 0).sum())
    whole = seconds * medium_pixels / pixels.size  # a picture's pixels that show medium, the others for nothing
    scale = np.mean(first * second)
    image = ours.reshape(-1, 3)[pixels]
    products = np.mean((image - first) * (image - second), axis=(1, 2)) / scale
    error, uncertain = products.mean(), products.std(ddof=1) / np.sqrt(products.size)
    theirs = 0.5 * np.mean((first - second) ** 2) / scale
    least = whole * theirs / (error + 2 * uncertain) / spent
    found = [
        ["ours, CPU s", spent],
        ["ours, bias", image.sum() / (0.5 * (first + second)).sum() - 1],
        ["ours, relMSE per pixel", error],
        ["its standard error", uncertain],
        ["path tracer, CPU s", whole],
        ["path tracer, relMSE per pixel", theirs],
        ["times faster at our error", whole * theirs / error / spent],
        ["times faster at our error and two standard errors more", least],
    ]
    if settings["mitsuba"]:
        found.append(["path tracer's time / Mitsuba's to equal error", against_mitsuba(settings)])
    write_csv("timing_path_tracer.csv", ["what", "value"], found)


def against_mitsuba(settings):
    """CPU time of our path tracer over that of Mitsuba's volpath to equal error of the whole picture, both at 64 x 48."""
    import bench_reference
    import mitsuba
    import peer_mitsuba as peers

    mitsuba.set_variant(peers.choose_variant())
    config = tomllib.loads((bench_reference.HERE / "peer_mitsuba.toml").read_text())
    own = {"scale": 10.0, "width": 64, "height": 48}
    scene = str(bench_reference.HERE / "scenes" / f"{settings['scene']}.toml")
    ((name, case),) = peers.cases([scene], config["bench"] | own, config)
    return bench_reference.measure(name, case)["equal_error_cpu_ratio"]


def chart(table, settings):
    """Bars of the stages."""
    fig, axes = plt.subplots(figsize=(6.0, 4.0), constrained_layout=True)
    names = [r[0] for r in table if r[2] > 0 and r[0] != "frame"]
    axes.barh(names, [r[1] for r in table if r[0] in names])
    axes.set_xlabel(f"CPU ms, {settings['paper_width']} x {settings['paper_height']}")
    fig.savefig(out("timing.png"), dpi=110)
    plt.close(fig)


def main():
    """The parts asked for."""
    settings = config()
    if "table" in settings["parts"]:
        chart(stage_table(settings), settings)
    if "forms" in settings["parts"]:
        forms(settings)
    if "path_tracer" in settings["parts"]:
        against_path_tracer(settings)


if __name__ == "__main__":
    main()
