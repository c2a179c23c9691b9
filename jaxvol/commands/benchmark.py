"""`jaxvol benchmark`: run time against error, for scenes x methods x settings."""

from pathlib import Path
from typing import Annotated

import typer

from jaxvol import jobs
from jaxvol.benchmark import driver, plots, report
from jaxvol.benchmark.config import load_config
from jaxvol.benchmark.references import reference
from jaxvol.benchmark.runners import load_file


def benchmark(
    config: Annotated[Path, typer.Argument(help="Benchmark file (TOML).", show_default=False)],
    out: Annotated[Path, typer.Option(help="Folder for results; one that holds some goes on.")] = Path("out/benchmark"),
) -> None:
    """Run CONFIG and write DIR/results.jsonl, work-precision plots, the equal-error table and scaling exponents.

    A benchmark that was stopped goes on; references are kept by scene hash.
    """
    table = load_config(config)
    with jobs.stoppable(message="stopping after the current run; Ctrl-C again to abort at once") as stop:
        records = driver.run_benchmark(table, config.parent, out, stop=stop)
    truths = {}
    if not stop:
        for entry in table.scenes:
            file = load_file(entry, config.parent)
            if entry.methods == () and not entry.peer:  # there for scaling curves only
                continue
            truths[file.name] = reference(file, table.reference, out / "references")
    else:
        raise typer.Exit(1)
    rows = report.equal_error(records, out, truths)
    text = report.table_text(rows)
    print(text)
    print(
        "\nPT s, Mitsuba s: their seconds to the same relMSE of the same layers; x: how many times faster the method is. "
        "> and <: told\nby the reference's noise only. *: some layer is computed in part. L1 and noise (of the reference) are "
        f"over {table.block} x {table.block} pixels.\nLayers are paths from light (L) to eye (E), S surface, V volume; "
        "L**SE, L**VE: two vertices or more before the last."
    )
    for line in report.refusals(records):
        print(f"refused: {line}")
    curves = report.exponents(records)
    if curves:
        scaling = report.scaling_text(curves)
        print(f"\n{scaling}")
        text += f"\n\n{scaling}"
        print(plots.scaling(curves, out))
    for path in plots.work_precision(records, rows, out, truths):
        print(path)
    jobs.write_bytes(out / "table.txt", (text + "\n").encode())
    jobs.write_json(out / "summary.json", report.summary(rows) | {"scaling": curves})
    print(out / driver.RESULTS)
