"""The report of `jaxvol fit`: each fit as rows for a CSV file and a figure."""

import csv
import io
import os
from pathlib import Path
from typing import Annotated, Literal

import matplotlib
import numpy as np
from matplotlib.figure import Figure
from pydantic import BaseModel, ConfigDict, Field

from jaxvol import jobs
from jaxvol.fit import compact, heterogeneous, sigma_ratio, zonal_axis, zonal_tables

matplotlib.use("Agg")
Positive = Annotated[float, Field(gt=0, le=50)]


class FitConfig(BaseModel):
    """What `jaxvol fit` runs."""

    model_config = ConfigDict(extra="forbid")
    fits: tuple[Literal["axis", "sigma_ratio", "compact", "effective_sigma"], ...] = (
        "axis",
        "sigma_ratio",
        "compact",
        "effective_sigma",
    )
    order: Annotated[int, Field(ge=2, le=16)] = 11
    axis_tau: tuple[Positive, ...] = (0.1, 1.0, 4.0)
    axis_num_angles: Annotated[int, Field(ge=2, le=180)] = 18
    media: Annotated[int, Field(ge=8, le=1000)] = 24
    seed: Annotated[int, Field(ge=0)] = 0
    compact_tau: tuple[Positive, Positive] = (0.01, 20.0)
    compact_num: tuple[Annotated[int, Field(ge=2, le=64)], ...] = (8, 12, 16, 20)


Rows = list[dict]


def axis(config: FitConfig) -> tuple[Rows, Figure]:
    """Angles and errors of the axis fits by tau and theta_n (Figure 5)."""
    theta = np.pi * (np.arange(config.axis_num_angles) + 0.5) / config.axis_num_angles
    half = zonal_tables.area_table(np.array(config.axis_tau), theta, order=config.order)
    axes = {
        "light": np.zeros(half.shape[:2]),
        "optimal linear": zonal_axis.optimal_linear(half),
        "L2 fit": zonal_axis.fit(half),
        "irradiance fit": zonal_axis.fit(half, criterion="irradiance"),
    }
    rows = []
    figure = Figure(figsize=(12, 4))
    plots = figure.subplots(1, 3)
    for name, psi in axes.items():
        l2, irradiance = zonal_axis.errors(half, zonal_axis.reconstruct(zonal_axis.project(half, psi), psi))
        for i, tau in enumerate(config.axis_tau):
            rows += [
                {
                    "tau": tau,
                    "theta_n": np.degrees(t),
                    "axis": name,
                    "psi": np.degrees(psi[i, j]),
                    "l2": l2[i, j],
                    "irradiance": irradiance[i, j],
                }
                for j, t in enumerate(theta)
            ]
        middle = len(config.axis_tau) // 2
        for plot, values in zip(plots, (np.degrees(psi), l2, irradiance), strict=True):
            plot.plot(np.degrees(theta), values[middle], label=name)
    titles = ("angle of the axis [degrees]", "L2 error", "largest irradiance error")
    for plot, title in zip(plots, titles, strict=True):
        plot.set(xlabel="theta_n [degrees]", title=f"{title}, tau = {config.axis_tau[len(config.axis_tau) // 2]}")
    plots[0].legend()
    return rows, figure


def sigma(config: FitConfig) -> tuple[Rows, Figure]:
    """Exponents of the sigma-ratio by least squares against independent responses (section 4.3)."""
    rows = []
    for kind, expected in sigma_ratio.EXPECTED.items():
        result = sigma_ratio.fit(kind, num=config.media, seed=config.seed)
        names = ("distance sigma_t", "distance sigma_s", "value sigma_t", "value albedo")
        for name, value, truth in zip(names, result.exponents, expected, strict=True):
            rows.append(
                {
                    "response": kind,
                    "exponent": name,
                    "fitted": value,
                    "expected": truth,
                    "error": value - truth,
                    "max_residual": result.max_residual,
                    "steps": result.num_steps,
                }
            )
    figure = Figure(figsize=(8, 4))
    plot = figure.subplots()
    plot.bar(range(len(rows)), [max(abs(r["error"]), 1e-17) for r in rows])
    plot.set_yscale("log")
    plot.axhline(1e-6, color="k", lw=0.8)
    plot.set_xticks(range(len(rows)), [f"{r['response']}: {r['exponent']}" for r in rows], rotation=90, fontsize=6)
    plot.set(title="error of the fitted exponents (line: 1e-6)")
    return rows, figure


def compact_form(config: FitConfig) -> tuple[Rows, Figure]:
    """Residual of the compact form by number of coefficients: interpolation at nodes and least squares."""
    low, high = np.log(config.compact_tau)
    x = np.linspace(low, high, 400)
    truth = zonal_tables.point_table(np.exp(x), order=config.order)
    rows = []
    for num in config.compact_num:
        nodes = zonal_tables.point_table(np.exp(compact.nodes(num, low, high)), order=config.order)
        found = np.exp(compact.evaluate(compact.transform(np.log(nodes)), x, low, high))
        fitted = compact.fit_log(x, truth, num=num, low=low, high=high)
        rows.append(
            {
                "num": num,
                "interpolation": np.abs(found / truth - 1).max(),
                "least_squares": fitted.max_residual,
                "least_squares_rms": fitted.rms_residual,
                "steps": fitted.num_steps,
            }
        )
    figure = Figure(figsize=(5, 4))
    plot = figure.subplots()
    for key in ("interpolation", "least_squares", "least_squares_rms"):
        plot.semilogy([r["num"] for r in rows], [r[key] for r in rows], "o-", label=key)
    plot.set(xlabel="coefficients per band", title="relative error of the compact form")
    plot.legend()
    return rows, figure


def effective_sigma(config: FitConfig) -> tuple[Rows, Figure]:
    """Effective sigma against the truth on layered and spherical media (section 4.4), and on a sweep of contrast."""
    rows = [{"case": name, **heterogeneous.compare(*case)._asdict()} for name, case in heterogeneous.CASES.items()]
    contrasts = np.linspace(-0.95, 0.95, 21)
    sweep = [heterogeneous.compare(heterogeneous.Layers(1 + c, 1 - c, 0.5), 1.0) for c in contrasts]
    rows += [{"case": f"layers {1 + c:.3f} | {1 - c:.3f}", **r._asdict()} for c, r in zip(contrasts, sweep, strict=True)]
    figure = Figure(figsize=(6, 4))
    plot = figure.subplots()
    for key in ("irradiance", "band_0", "irradiance_with_direct"):
        plot.plot(contrasts, [getattr(r, key) for r in sweep], label=key.replace("_", " "))
    plot.axhline(1, color="k", lw=0.6)
    plot.set(
        xlabel="contrast: sigma = 1 + c at the receiver, 1 - c at the source",
        title="effective sigma over truth, once scattered",
    )
    plot.legend()
    return rows, figure


FITS = {"axis": axis, "sigma_ratio": sigma, "compact": compact_form, "effective_sigma": effective_sigma}


def write_csv(path: str | os.PathLike, rows: Rows) -> None:
    """Write rows with the first row's keys as header, atomically."""
    text = io.StringIO()
    writer = csv.DictWriter(text, fieldnames=list(rows[0]))
    writer.writeheader()
    writer.writerows(rows)
    jobs.write_bytes(path, text.getvalue().encode())


def write_figure(path: str | os.PathLike, figure: Figure) -> None:
    """Write a figure as PNG, atomically."""
    figure.tight_layout()
    with jobs.atomic_write(path) as temporary:
        figure.savefig(temporary, dpi=120)


def run(config: FitConfig, folder: Path) -> dict[str, Rows]:
    """Run the chosen fits and write `<fit>.csv` and `<fit>.png` for each into the folder."""
    results = {}
    with jobs.progress("fits", total=len(config.fits)) as advance:
        for name in config.fits:
            rows, figure = FITS[name](config)
            write_csv(folder / f"{name}.csv", rows)
            write_figure(folder / f"{name}.png", figure)
            results[name] = rows
            advance(1, note=name)
    return results
