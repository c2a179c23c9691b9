"""Table 1: CPU time by stage at 800x600; at 400x300 the time and error of lists, dense form and path tracer.

    python experiments/deep_screen_space_timing.py [key=value ...]

Writes out/deep_screen_space/timing_table.csv, timing_forms.csv and timing.png. CPU seconds of all cores, the least of
three warm frames; the load average stands beside them because wall times on a busy machine mean little.
"""

import time

import numpy as np
from deep_screen_space_common import (
    Clock,
    block_errors,
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


def forms(settings):
    """Time and error of the forms against all pairs, and of the path tracer at the same error."""
    problem, camera = load(settings["scene"], width=settings["width"], height=settings["height"])
    base = {"num_surfels": settings["surfels"]}
    every = layer(problem, camera, **base, num_levels=1, strides=(1,), dense_from=0, blur="none")
    rows = []
    for name, options in {
        "lists": {},
        "dense from level 2": {"dense_from": 2},
        "every sample on all levels": {"strides": (1,) * 6},
        "epsilon 0.24": {"epsilon": 0.24},
        "without transport": {"transport": "none"},
    }.items():
        clock, estimate = frame(problem, camera, method.plan(problem, camera, **base, **options))
        pairs = sum(float(v) for k, v in estimate.diagnostics.items() if k.startswith("pairs_"))
        splat = sum(v for k, v in clock.cpu.items() if k.startswith("splat"))
        image = np.asarray(estimate.mean.volume_from_surface)
        error = np.abs(image - every).sum() / every.sum()
        rows.append([name, sum(clock.cpu.values()), splat, pairs, 1e9 * splat / pairs, error])
    header = ["form", "frame_cpu_s", "splat_cpu_s", "pairs", "ns_per_pair", "error_against_all_pairs"]
    write_csv("timing_forms.csv", header, rows)
    return problem, camera, rows


def against_path_tracer(problem, camera, settings, ours):
    """CPU seconds that the path tracer needs for our error: its relative L1 falls with the root of its time."""
    pixels = blocks_with_medium(problem, camera, size=settings["block"], num=settings["num_blocks"])
    mean, variance, _ = path_traced(problem, camera, pixels, num_samples=settings["samples"], seed=1)
    start = time.process_time()
    again, _, _ = path_traced(problem, camera, pixels, num_samples=settings["samples"], seed=2)
    seconds = time.process_time() - start
    medium_pixels = int((ours.sum(axis=-1) > 0).sum())
    whole = seconds * medium_pixels / pixels.size  # a picture's pixels that show medium, the others for nothing
    single = np.abs(again - mean).sum() / mean.sum() / np.sqrt(2.0)
    error, bias, noise = block_errors(ours, 0.5 * (mean + again), 0.5 * variance, pixels)
    per_pixel = np.abs(ours.reshape(-1, 3)[pixels] - 0.5 * (mean + again)).sum() / mean.sum()
    honest = np.sqrt(max(per_pixel**2 - 0.5 * single**2, error**2))  # the reference's own noise taken out
    return [
        ["path tracer, error per pixel", single],
        ["path tracer, CPU s", whole],
        ["ours, error over blocks", error],
        ["ours, bias", bias],
        ["reference noise over blocks", noise],
        ["path tracer, CPU s to an error of 5 % per pixel", whole * (single / 0.05) ** 2],
        ["ours, error per pixel, reference noise taken out (upper estimate)", float(honest)],
    ]


def main():
    """Both tables and the chart."""
    settings = config()
    table = stage_table(settings)
    problem, camera, rows = forms(settings)
    ours = layer(problem, camera, num_surfels=settings["surfels"])
    found = against_path_tracer(problem, camera, settings, ours)
    found.append(["times faster at 5 %", found[5][1] / rows[0][1]])
    write_csv("timing_path_tracer.csv", ["what", "value"], found)
    fig, axes = plt.subplots(figsize=(6.0, 4.0), constrained_layout=True)
    names = [r[0] for r in table if r[2] > 0 and r[0] != "frame"]
    axes.barh(names, [r[1] for r in table if r[0] in names])
    axes.set_xlabel("CPU ms, 800x600")
    fig.savefig(out("timing.png"), dpi=110)
    plt.close(fig)


if __name__ == "__main__":
    main()
