"""Tables of a benchmark: who owns which layers with which error, equal-error speed-ups, exponents of the scaling curves."""

from pathlib import Path
from typing import Any

import numpy as np

from jaxvol import image
from jaxvol.benchmark.driver import PEER, Record
from jaxvol.benchmark.errors import relmse_of_noise
from jaxvol.layers import NAMES, select

SHORT = dict(zip(NAMES, ("LE", "LSE", "LSSE", "LVSE", "L**SE", "LVE", "LSVE", "LVVE", "L**VE"), strict=True))
BASE = "path_tracing"


def path_tracer_cost(records: list[Record], out: Path, scene: str, names: list[str], truth: image.Picture) -> float | None:
    """Seconds times relMSE of the path tracer for the sum over `names`: its noise falls as 1 / time.

    From the variance that it claims itself (within 5 % of the spread of batches), in its longest run.
    """
    ours = [r for r in records if r.get("scene") == scene and r.get("method") == BASE and "picture" in r]
    if not ours:
        return None
    longest = max(ours, key=lambda r: r["warm_seconds"])
    picture = image.read_picture(out / longest["picture"])
    variance, mean = (np.asarray(select(x, names), np.float64) for x in (picture.variance, truth.layers))
    return relmse_of_noise(variance, mean) * longest["warm_seconds"]


def equal_error(records: list[Record], out: Path, truths: dict[str, image.Picture]) -> list[Record]:
    """A row per scene and method at default settings: error, and the others' time to the same relMSE of the same layers.

    Where relMSE is not told from the reference's noise (below twice its standard error) the row is a bound: `at_least`.
    """
    rows = []
    for record in records:
        if record.get("index") != 0 or "errors" not in record or record["method"] == PEER:
            continue
        own = record["errors"].get("own")
        if own is None or "nonfinite" in own:
            continue
        truth = truths[record["scene"]]
        names = [name for name in record["names"] if name in record["lit"]]
        at_least = own["relmse"] < 2 * own["relmse_error"]
        relmse = max(own["relmse"], 0.0) + 2 * own["relmse_error"] if at_least else own["relmse"]
        row = {key: record[key] for key in ("scene", "method", "warm_seconds", "cpu_seconds", "peak_mib")}
        row |= {key: own[key] for key in ("relative_l1", "bias", "p99", "reference_noise")}
        row |= {"names": names, "relmse": relmse, "at_least": at_least, "compile": record["seconds"]["compile"]}
        row["partial"] = [claim["layers"] for claim in record["claims"] if claim["partial"]]
        cost = path_tracer_cost(records, out, record["scene"], names, truth)
        row["path_tracing_seconds"] = None if cost is None else cost / relmse
        if record["method"] == BASE:  # its claimed variance against itself says nothing
            row["path_tracing_seconds"] = None
        whole = set(record["lit"]) <= set(record["names"])
        peers = [r for r in records if r.get("scene") == record["scene"] and r.get("method") == PEER and "errors" in r]
        row["mitsuba_seconds"] = None
        if whole and peers:  # its best run counts: a rare bright pixel makes the spread of few batches useless
            cost = min(r["errors"]["own"]["relmse"] * r["warm_seconds"] for r in peers)
            row["mitsuba_seconds"] = cost / relmse
        for name in ("path_tracing", "mitsuba"):
            seconds = row[f"{name}_seconds"]
            row[f"{name}_speedup"] = None if seconds is None else seconds / row["warm_seconds"]
        rows.append(row)
    return rows


def short(names: list[str]) -> str:
    """Layers as paths from light to eye, `L**SE` being light of two or more vertices before the surface."""
    return " ".join(SHORT[name] for name in names)


def table_text(rows: list[Record]) -> str:
    """The equal-error table as text."""
    head = (
        "scene",
        "method",
        "layers it owns",
        "s",
        "L1 %",
        "noise %",
        "bias %",
        "relMSE",
        "PT s",
        "x PT",
        "Mitsuba s",
        "x Mi",
    )
    lines = [head]
    for row in rows:
        bound = ">" if row["at_least"] else ""
        star = "*" if row["partial"] else ""
        lines.append((
            row["scene"], row["method"] + star, short(row["names"]), f"{row['warm_seconds']:.2f}",
            f"{100 * row['relative_l1']:.1f}", f"{100 * row['reference_noise']:.1f}", f"{100 * row['bias']:+.1f}",
            f"{'<' if row['at_least'] else ''}{row['relmse']:.2g}",
            *_speed(row, "path_tracing", bound), *_speed(row, "mitsuba", bound),
        ))  # fmt: skip
    return _aligned(lines)


def _speed(row: Record, name: str, bound: str) -> tuple[str, str]:
    seconds, factor = row[f"{name}_seconds"], row[f"{name}_speedup"]
    return ("-", "-") if seconds is None else (f"{bound}{seconds:.3g}", f"{bound}{factor:.2g}")


def _aligned(lines: list[tuple[str, ...]]) -> str:
    widths = [max(len(line[i]) for line in lines) for i in range(len(lines[0]))]
    return "\n".join("  ".join(cell.ljust(width) for cell, width in zip(line, widths, strict=True)).rstrip() for line in lines)


def refusals(records: list[Record]) -> list[str]:
    """What methods refused, one line each."""
    refused = {(r.get("scene", "?"), r["method"]): r["refused"] for r in records if "refused" in r}
    return [f"{scene}, {method}: {why}" for (scene, method), why in refused.items()]


def exponents(records: list[Record]) -> list[Record]:
    """Per scaling curve the fitted exponent p of seconds ~ count^p, and the share of the longest run that is fixed cost.

    The fixed cost is that of a straight line a + b count through the runs, weighted by 1 / seconds; 0 is the aim.
    """
    rows = []
    for name in dict.fromkeys(r["scaling"] for r in records if "scaling" in r):
        runs = sorted((r for r in records if r.get("scaling") == name), key=lambda r: r["count"])
        if len(runs) < 2:
            continue
        count = np.array([r["count"] for r in runs], np.float64)
        seconds = np.array([r["warm_seconds"] for r in runs])
        (slope, start), *_ = np.linalg.lstsq(
            np.stack([count, np.ones_like(count)], axis=1) / seconds[:, None], np.ones_like(count), rcond=None
        )
        rows.append({
            "scaling": name, "scene": runs[0]["scene"], "method": runs[0]["method"], "counts": count.tolist(),
            "seconds": seconds.tolist(), "exponent": float(np.polyfit(np.log(count), np.log(seconds), 1)[0]),
            "last_exponent": float(np.log(seconds[-1] / seconds[-2]) / np.log(count[-1] / count[-2])),
            "fixed_seconds": float(start), "nanoseconds_each": float(slope * 1e9),
        })  # fmt: skip
    return rows


def scaling_text(rows: list[Record]) -> str:
    """The scaling curves as text."""
    lines: list[tuple[str, ...]] = [
        ("curve", "scene", "method", "counts", "seconds", "exponent", "last pair", "fixed s", "ns each")
    ]
    for row in rows:
        lines.append((
            row["scaling"], row["scene"], row["method"], " ".join(f"{c:.0f}" for c in row["counts"]),
            " ".join(f"{s:.3g}" for s in row["seconds"]), f"{row['exponent']:.2f}", f"{row['last_exponent']:.2f}",
            f"{row['fixed_seconds']:.3g}", f"{row['nanoseconds_each']:.3g}",
        ))  # fmt: skip
    return _aligned(lines)


def summary(rows: list[Record]) -> dict[str, Any]:
    """Everything that the tables print, for summary.json."""
    return {"equal_error": rows, "short_names": SHORT}
