"""Work-precision plots (log error over log time) and scaling curves; matplotlib's Agg, files written atomically."""

from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt  # noqa: E402
import numpy as np  # noqa: E402
from matplotlib import ticker  # noqa: E402

from jaxvol import image, jobs  # noqa: E402
from jaxvol.benchmark import report  # noqa: E402
from jaxvol.benchmark.driver import PEER, Record  # noqa: E402


def _save(figure: plt.Figure, path: Path) -> Path:
    with jobs.atomic_write(path) as temporary:
        figure.savefig(temporary, dpi=100)
    plt.close(figure)
    return path


def work_precision(records: list[Record], rows: list[Record], out: Path, truths: dict[str, image.Picture]) -> list[Path]:
    """One figure per scene: a panel for each set of layers that a method owns, with the path tracer's line for the same."""
    found = []
    for scene in dict.fromkeys(row["scene"] for row in rows):
        here = [row for row in rows if row["scene"] == scene]
        sums = list(dict.fromkeys(tuple(row["names"]) for row in here if row["names"]))
        columns = min(len(sums), 3)
        lines = -(-len(sums) // columns)
        figure, axes = plt.subplots(
            lines, columns, figsize=(4.2 * columns, 3.5 * lines), constrained_layout=True, squeeze=False
        )
        for axis in axes.ravel()[len(sums) :]:
            axis.set_axis_off()
        for axis, names in zip(axes.ravel(), sums, strict=False):
            _panel(axis, records, out, scene, names, truths[scene])
        figure.suptitle(f"{scene}: error over time")
        found.append(_save(figure, out / f"{scene}.work_precision.png"))
    return found


def _panel(axis, records, out, scene, names, truth):
    times = []
    for method in dict.fromkeys(r["method"] for r in records if r.get("scene") == scene and "errors" in r):
        points = [r for r in records if r.get("scene") == scene and r.get("method") == method and "errors" in r]
        points = [r for r in points if tuple(n for n in r["names"] if n in r["lit"]) == names and "own" in r["errors"]]
        points = [r for r in points if "nonfinite" not in r["errors"]["own"]]
        if not points:
            continue
        points.sort(key=lambda r: r["warm_seconds"])
        x = [r["warm_seconds"] for r in points]
        y = [max(r["errors"]["own"]["relmse"], r["errors"]["own"]["relmse_error"], 1e-9) for r in points]
        axis.loglog(x, y, "o-", label=f"{method}{' (spread of batches)' if method == PEER else ''}", ms=4)
        times += x
    cost = report.path_tracer_cost(records, out, scene, list(names), truth)
    if cost is not None and times:
        x = np.array([min(times) / 3, max(times) * 3])
        axis.loglog(x, cost / x, "k--", lw=1, label="path_tracing, its variance")
    axis.set_title(report.short(list(names)), fontsize=8)
    axis.set_xlabel("seconds, warm", fontsize=8)
    axis.set_ylabel("relMSE", fontsize=8)
    axis.grid(True, which="both", alpha=0.2)
    axis.legend(fontsize=6)
    for one, (low, high) in ((axis.xaxis, axis.get_xlim()), (axis.yaxis, axis.get_ylim())):
        steps = (1.0, 2.0, 5.0) if high < 100 * low else (1.0,)  # labels of all nine would lie upon each other
        one.set_major_locator(ticker.LogLocator(subs=steps))
        one.set_major_formatter(ticker.FormatStrFormatter("%g"))
        one.set_minor_formatter(ticker.NullFormatter())
    axis.tick_params(labelsize=7)


def scaling(rows: list[Record], out: Path) -> Path:
    """All scaling curves, each over its count, with its exponent."""
    figure, axis = plt.subplots(figsize=(6.4, 4.4), constrained_layout=True)
    for row in rows:
        label = f"{row['scaling']} ({row['method']}): {row['exponent']:.2f}"
        axis.loglog(row["counts"], row["seconds"], "o-", label=label, ms=4)
    axis.set_xlabel("count")
    axis.set_ylabel("seconds, warm")
    axis.grid(True, which="both", alpha=0.2)
    axis.legend(fontsize=7)
    return _save(figure, out / "scaling.png")
