"""`jaxvol stress`: random and extreme scenes through every method; exit status 1 where a check failed."""

from pathlib import Path
from typing import Annotated

import typer

from jaxvol import jobs
from jaxvol.stress import checks, driver


def stress(
    scenes: Annotated[int, typer.Option(help="Random scenes that each method shall take, besides the extremes.", min=0)] = 500,
    first: Annotated[int, typer.Option(help="Number of the first random scene.", min=0)] = 0,
    methods: Annotated[list[str] | None, typer.Option("--method", help="Method; may be repeated. Default: all.")] = None,
    out: Annotated[Path, typer.Option(help="Folder for results; one that holds some goes on.")] = Path("out/stress"),
    again: Annotated[bool, typer.Option("--again", help="Run cases that failed once more.")] = False,
) -> None:
    """Check values, linearity in light, units, turns and energy in many scenes; print cases tried and failed."""
    chosen = tuple(methods or checks.METHODS)
    for name in chosen:
        if name not in checks.METHODS:
            raise ValueError(f"--method {name!r} must be one of {', '.join(checks.METHODS)}")
    with jobs.stoppable(message="stopping after the current case; Ctrl-C again to abort at once") as stop:
        records = driver.run(out, first=first, num=scenes, methods=chosen, stop=stop, again=again)
    print(driver.table(records))
    failed = driver.failures(records)
    for line in failed:
        print(line)
    print(out / driver.RESULTS)
    if failed or stop:
        raise typer.Exit(1)
