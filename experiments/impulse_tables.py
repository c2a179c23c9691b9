"""Figures 5, 6 and 10 of Dubouchet et al. 2019 and the error studies of the tables: `python experiments/impulse_tables.py`.

Writes CSV and PNG files into out/impulse_tables (first argument: another folder; further arguments: only these studies).
"""

import sys
from pathlib import Path

import jax
import matplotlib
import numpy as np
from matplotlib.figure import Figure

from jaxvol import harmonics, tables, zonal_lookup
from jaxvol.fit import (
    assemble,
    compact,
    green,
    half_space,
    phase_moments,
    report,
    sigma_ratio,
    wavenumber,
    zonal_axis,
    zonal_tables,
)

ISOTROPIC = np.ones(1)


def figure_5():
    """The radiance of patches at tau = 1 over the direction in the plane of normal and light, and its zonal fits."""
    theta_n = np.radians([0, 30, 60, 85])
    half = zonal_tables.area_table(1.0, theta_n, order=11)[0]
    axes = {"exact SH": None, "optimal linear axis": zonal_axis.optimal_linear(half), "L2 axis": zonal_axis.fit(half)}
    angle = np.linspace(-np.pi, np.pi, 361)
    polynomials = harmonics.normalised_legendre(np.cos(angle), 11)
    basis = np.stack([polynomials[band, m] * np.sin(angle) ** m for band, m in harmonics.half_index(11)], axis=-1)
    figure = Figure(figsize=(14, 4))
    plots = figure.subplots(1, 4, subplot_kw={"projection": "polar"})
    rows = []
    for i, plot in enumerate(plots):
        for name, psi in axes.items():
            coefficients = half[i] if psi is None else zonal_axis.reconstruct(zonal_axis.project(half[i], psi[i]), psi[i])
            plot.plot(angle, np.maximum(basis @ coefficients, 0), label=name)
            if psi is not None:
                l2, irradiance = zonal_axis.errors(half[i], coefficients)
                rows.append({"theta_n": np.degrees(theta_n[i]), "axis": name, "angle": np.degrees(psi[i]),
                             "d_fit": np.sin(psi[i]), "l2": float(l2), "irradiance": float(irradiance)})  # fmt: skip
        plot.set_title(f"theta_n = {np.degrees(theta_n[i]):.0f} degrees")
        plot.set_yticklabels([])
    plots[0].legend(loc="lower left", fontsize=7)
    return rows, figure


def figure_6():
    """One table and the responses of other media, before and after the sigma-ratio (sigma_r^2 L(sigma_r d))."""
    distance = np.geomspace(0.02, 10, 16)
    table_x = np.geomspace(0.01, 40, 200)
    table = zonal_tables.unscale_point(zonal_tables.point_table(table_x, order=1), table_x)[:, 0]
    figure = Figure(figsize=(10, 4))
    left, right = figure.subplots(1, 2)
    left.loglog(table_x, table, "k", lw=3, alpha=0.3, label="table, sigma = 1")
    rows = []
    for sigma in (0.5, 1.0, 2.0):
        ones = np.full(distance.size, sigma)
        values = sigma_ratio.physical_responses("point, 1 scattering", distance, ones, ones)
        left.loglog(distance, values, label=f"sigma = {sigma}")
        mapped = sigma**2 * np.exp(np.interp(np.log(sigma * distance), np.log(table_x), np.log(table)))
        exact = (
            sigma**2 * zonal_tables.unscale_point(zonal_tables.point_table(sigma * distance, order=1), sigma * distance)[:, 0]
        )
        (line,) = right.loglog(distance, np.maximum(np.abs(mapped / values - 1), 1e-16), label=f"sigma = {sigma}")
        right.loglog(distance, np.maximum(np.abs(exact / values - 1), 1e-16), ":", color=line.get_color())
        rows += [{"sigma": sigma, "distance": d, "L_0": v, "from_table": m, "error_exact_table": e / v - 1}
                 for d, v, m, e in zip(distance, values, mapped, exact, strict=True)]  # fmt: skip
    left.set(xlabel="distance", title="band 0 of the response, physical units")
    right.set(xlabel="distance", title="relative error of sigma^2 L(sigma d)\nsolid: 200 log bins, linear; dotted: exact table")
    left.legend()
    right.legend()
    return rows, figure


def figure_10():
    """Zonal responses by bounce, point and directional, scaled as the paper plots them (each bin over its band 0)."""
    tau = np.geomspace(0.01, 20, 128)
    figure = Figure(figsize=(14, 6))
    plots = figure.subplots(2, 4)
    rows = []
    directional = half_space.bounce_tables(tau, moments=ISOTROPIC, num_bounces=4)
    for column in range(4):
        n = column + 1
        point = wavenumber.point_table(tau, moments=ISOTROPIC, albedo=1.0, first=n, last=n)
        below = zonal_tables.directional_table(tau) * np.exp(-tau)[:, None] if n == 1 else directional[n - 2]
        for plot, table, kind in ((plots[0, column], point, "point"), (plots[1, column], below, "directional")):
            for band in range(11):
                colour = matplotlib.colormaps["turbo"](1 - band / 10)
                plot.semilogx(tau, table[:, band] / table[:, 0], color=colour, label=f"l = {band}")
            plot.set(title=f"{kind}, {n} scattering{'s' * (n > 1)}", ylim=(-1.1, 1.7), xlabel="tau")
            rows += [{"emitter": kind, "bounce": n, "tau": t, **{f"L_{b}": v for b, v in enumerate(line)}}
                     for t, line in zip(tau[::8], table[::8], strict=True)]  # fmt: skip
    plots[0, 0].legend(fontsize=6, ncols=2)
    return rows, figure


def _errors_of_lookups(tau):
    """Patches at four angles, and the infinite sum at g = 0.5, albedo 0.9 for tau <= 30, in float64."""
    theta = np.radians([0, 50, 88, 130])
    moments = wavenumber.effective_moments(0.5)
    with jax.enable_x64(True):
        lookups = tables.default_file().lookups(dtype=np.float64)
        area = zonal_lookup.medium_response(lookups, "area")
        patch = np.asarray(zonal_lookup.scaled_single(area, np.tile(tau[:, None], 4), theta_n=np.tile(theta, (tau.size, 1))))
        point = zonal_lookup.medium_response(lookups, "point", g=0.5, albedo=0.9)
        more = np.asarray(zonal_lookup.scaled_multiple(point, tau))
    truth, truth_more = zonal_tables.area_table(tau, theta), wavenumber.point_table(tau, moments=moments, albedo=0.9)
    patch_error = (np.abs(patch - truth) / truth[..., :1].max(axis=1, keepdims=True)).max(axis=(1, 2))
    more_error = (np.abs(more - truth_more) / truth_more[:, :1]).max(axis=1)
    more_error = np.where((tau >= 1e-3) & (tau <= 30), more_error, np.nan)
    return {"area, default table": patch_error, "point, scattered twice or more, g 0.5, albedo 0.9": more_error}


def error_over_tau():
    """Default tables (Chebyshev, float64) and the compact form against fresh quadrature over tau in [1e-4, 50]."""
    tau = np.geomspace(1e-4, 50, 160)
    arrays = tables.default_file().arrays
    truth = zonal_tables.point_table(tau)
    quarter = arrays["point.single_range"][1] ** 0.25
    series = compact.evaluate(arrays["point.single"][:, 0, 0, :, 0], tau**0.25, 0.0, quarter)
    low, high = np.log(arrays["point.compact_range"])
    inside = (np.log(tau) >= low) & (np.log(tau) <= high)
    form = np.full_like(truth, np.nan)
    form[inside] = np.exp(compact.evaluate(arrays["point.compact"], np.log(tau[inside]), low, high))
    below = zonal_tables.directional_table(tau)
    series_below = compact.evaluate(arrays["directional.single"][:, 0, 0, :, 0], tau**0.25, 0.0, quarter)
    columns = {
        "quadrature, 80 nodes": np.abs(zonal_tables.point_table(tau, num_nodes=80) / truth - 1).max(axis=1),
        "point, default table": np.abs(series / truth - 1).max(axis=1),
        "point, compact 16 x 11": np.abs(form / truth - 1).max(axis=1),
        "directional, default table": (np.abs(series_below - below) / below[:, :1]).max(axis=1),
        **_errors_of_lookups(tau),
    }
    rows = [{"tau": t, **{k: v[i] for k, v in columns.items()}} for i, t in enumerate(tau)]
    figure = Figure(figsize=(7, 4))
    plot = figure.subplots()
    for name, values in columns.items():
        plot.loglog(tau, np.maximum(values, 1e-16), label=name)
    plot.set(xlabel="tau", title="largest relative error over bands (once scattered unless said)")
    plot.legend(fontsize=6)
    return rows, figure


def error_over_size():
    """Error on tau in [0.01, 20] by number of entries: the paper's linear bins and better ways to spend them."""
    truth_tau = np.geomspace(0.01, 20, 2000)
    truth = zonal_tables.point_table(truth_tau)
    plain = zonal_tables.unscale_point(truth, truth_tau)
    rows = []

    def worst(found, reference):
        return float(np.abs(found / reference - 1).max())

    for num in (8, 16, 32, 64, 128, 256):
        linear, logarithmic = np.linspace(0.01, 20, num), np.geomspace(0.01, 20, num)
        values = {}
        for name, grid, axis in (("linear bins", linear, truth_tau), ("log bins", logarithmic, np.log(truth_tau))):
            at = zonal_tables.point_table(grid)
            knots = grid if name == "linear bins" else np.log(grid)
            values[f"{name}, L"] = worst(
                np.stack([np.interp(axis, knots, c) for c in zonal_tables.unscale_point(at, grid).T], axis=1), plain
            )
            values[f"{name}, tau e^tau L"] = worst(np.stack([np.interp(axis, knots, c) for c in at.T], axis=1), truth)
        if num <= 32:
            ends = np.log([0.01, 20])
            at = zonal_tables.point_table(np.exp(compact.nodes(num, *ends)))
            found = np.exp(compact.evaluate(compact.transform(np.log(at)), np.log(truth_tau), *ends))
            values["Chebyshev in ln tau"] = worst(found, truth)
        rows.append({"num": num, **values})
    figure = Figure(figsize=(7, 4))
    plot = figure.subplots()
    for name in rows[0]:
        if name != "num":
            plot.loglog(*zip(*[(r["num"], r[name]) for r in rows if name in r], strict=True), "o-", label=name)
    plot.set(xlabel="entries per band", title="largest relative error on tau in [0.01, 20], l <= 10")
    plot.legend()
    for row in rows:
        row.setdefault("Chebyshev in ln tau", "")
    return rows, figure


def linear_in_g():
    """Three tables at g = -0.5, 0, 0.5 interpolated (paper) against phase-moment tables: worst band and irradiance, tau = 1."""
    moments = zonal_tables.point_moment_table(1.0, num_moments=48, num_nodes=140)[0]
    cosine = harmonics.clamped_cosine(11)
    rows = []
    for g in np.linspace(-0.9, 0.9, 37):
        exact = zonal_tables.point_table(1.0, g=g, num_nodes=160)[0]
        row = {"g": g}
        for name, chi in (
            ("linear in g", phase_moments.three_g(g, 0.5, 48)),
            ("8 moments", phase_moments.henyey_greenstein(g, 8)),
            ("16 moments", phase_moments.henyey_greenstein(g, 16)),
        ):
            found = moments[:, : chi.size] @ chi
            row[f"{name}, coefficient"] = np.abs(found / exact - 1).max()
            row[f"{name}, irradiance"] = abs(cosine @ found / (cosine @ exact) - 1)
        rows.append(row)
    figure = Figure(figsize=(10, 4))
    for plot, what in zip(figure.subplots(1, 2), ("coefficient", "irradiance"), strict=True):
        for name in ("linear in g", "8 moments", "16 moments"):
            plot.semilogy([r["g"] for r in rows], [max(r[f"{name}, {what}"], 1e-16) for r in rows], label=name)
        plot.set(xlabel="g", title=f"relative error of {'the worst coefficient' if what == 'coefficient' else 'irradiance'}")
        plot.legend()
    return rows, figure


def green_function():
    """The wavenumber solution and sums of K bounces against Case's Green's function."""
    tau = np.geomspace(0.01, 20, 60)
    direct = np.exp(-tau) / tau**2
    figure = Figure(figsize=(11, 4))
    left, right = figure.subplots(1, 2)
    rows = []
    for albedo in (0.5, 0.9, 0.99):
        exact = green.fluence_total(tau, albedo)
        keywords = {"moments": ISOTROPIC, "albedo": albedo, "order": 1, "first": 1}
        solved = direct + albedo * np.sqrt(4 * np.pi) * wavenumber.point_table(tau, **keywords)[:, 0]
        left.loglog(tau, np.maximum(np.abs(solved / exact - 1), 1e-17), label=f"albedo {albedo}")
        partial = {}
        for bounces in (1, 2, 5, 10, 40):
            summed = direct + albedo * np.sqrt(4 * np.pi) * wavenumber.point_table(tau, **keywords, last=bounces)[:, 0]
            partial[bounces] = 1 - summed / exact
            if albedo == 0.9:
                right.loglog(tau, np.maximum(partial[bounces], 1e-12), label=f"{bounces} bounces")
        for i, (t, e, s) in enumerate(zip(tau, exact, solved, strict=True)):
            missing = {f"missing_{bounces}": share[i] for bounces, share in partial.items()}
            rows.append({"albedo": albedo, "tau": t, "fluence": e, "error": s / e - 1, **missing})
    left.set(xlabel="tau", title="infinite sum against Case's solution, relative error")
    right.set(xlabel="tau", title="share of the fluence that K bounces miss, albedo 0.9", ylim=(1e-6, 2))
    left.legend()
    right.legend()
    return rows, figure


def effective_sigma():
    """Figure 7's approximation: cases of the specification and a sweep of contrast."""
    return report.effective_sigma(report.FitConfig())


def source_moments():
    """Area emitters scattered twice or more: error by the number of emission moments."""
    tau, theta = np.array([0.01, 0.1, 1.0, 5.0]), np.linspace(0, np.pi, 13)
    rows = []
    for g in (0.0, 0.5):
        medium = {"moments": wavenumber.effective_moments(g), "albedo": 0.9, "order": 5}
        truth = assemble.area_response(tau, theta, source_bands=22, **medium)
        for limit in (2, 4, 6, 8, 10, 14):
            error = np.abs(assemble.area_response(tau, theta, source_bands=limit, **medium) - truth)
            rows.append(
                {"g": g, "source_bands": limit, "error": float((error / truth[..., :1].max(axis=1, keepdims=True)).max())}
            )
    figure = Figure(figsize=(5, 4))
    plot = figure.subplots()
    for g in (0.0, 0.5):
        plot.semilogy(
            *zip(*[(r["source_bands"], r["error"]) for r in rows if r["g"] == g], strict=True), "o-", label=f"g = {g}"
        )
    plot.set(xlabel="highest moment of the patch's emission", title="error over the largest L_00")
    plot.legend()
    return rows, figure


STUDIES = {f.__name__: f for f in (figure_5, figure_6, figure_10, error_over_tau, error_over_size, linear_in_g, green_function,
                                   effective_sigma, source_moments)}  # fmt: skip


def main(arguments: list[str]) -> None:
    """Run the named studies, or all."""
    folder = Path(arguments[0]) if arguments else Path("out/impulse_tables")
    for name in arguments[1:] or STUDIES:
        rows, figure = STUDIES[name]()
        report.write_csv(folder / f"{name}.csv", rows)
        report.write_figure(folder / f"{name}.png", figure)
        print(f"{name}: {len(rows)} rows, {folder / name}.png", flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
