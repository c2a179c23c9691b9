"""`jaxvol fit`: the fits behind the tables, as CSV files and figures."""

from pathlib import Path
from typing import Annotated

import typer


def fit(
    config: Annotated[Path, typer.Argument(help="Configuration (TOML).", show_default=False)],
    out: Annotated[Path, typer.Option(help="Folder for the report; made where missing.")] = Path("out/fit"),
) -> None:
    """Run the fits of CONFIG (axis, sigma_ratio, compact, effective_sigma); write a CSV file and a figure for each.

    Raises ValueError for a bad configuration.
    """
    from jaxvol.fit import report, table_config

    settings = table_config.load(config, model=report.FitConfig)
    results = report.run(settings, out)
    if "sigma_ratio" in results:
        worst = max(abs(row["error"]) for row in results["sigma_ratio"])
        print(f"sigma_ratio: largest error of an exponent {worst:.1e}")
    if "compact" in results:
        for row in results["compact"]:
            print(f"compact, {row['num']} coefficients: error {row['interpolation']:.1e}, fitted {row['least_squares']:.1e}")
    if "axis" in results:
        for name in dict.fromkeys(row["axis"] for row in results["axis"]):
            worst = max(row["irradiance"] for row in results["axis"] if row["axis"] == name)
            print(f"axis {name}: largest irradiance error {worst:.3f}")
    if "effective_sigma" in results:
        for row in results["effective_sigma"][:8]:
            print(f"effective sigma, {row['case']}: irradiance ratio {row['irradiance']:.3f}")
    print(f"wrote {', '.join(results)} to {out}")
