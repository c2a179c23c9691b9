"""`jaxvol tabulate`: impulse-response tables from a configuration, and the verification of a table file."""

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from jaxvol import jobs, tables


class Format(StrEnum):
    """File formats of tables."""

    npz = "npz"
    json = "json"
    exr = "exr"


def tabulate(
    config: Annotated[Path | None, typer.Argument(help="Configuration (TOML); not needed with --verify.")] = None,
    out: Annotated[Path, typer.Option(help="File to write.")] = Path("out/tables.npz"),
    format: Annotated[Format | None, typer.Option(help="Format; default: by the file's ending, else npz.")] = None,
    verify: Annotated[
        Path | None, typer.Option(help="Check this .npz file instead: recompute random entries independently.")
    ] = None,
    num: Annotated[int, typer.Option(help="Entries per table that --verify recomputes.", min=1, max=100)] = 1,
    seed: Annotated[int, typer.Option(help="Which random entries --verify takes.", min=0)] = 0,
) -> None:
    """Compute the tables of CONFIG and write them to --out; a job that was stopped goes on where it was.

    Finished parts are kept in OUT.parts until the file is written. Raises ValueError for a bad configuration or table file.
    Exit status 1 where --verify finds an entry that disagrees, or after Ctrl-C.
    """
    if verify is not None:
        _verify(verify, num, seed)
        return
    if config is None:
        raise ValueError("tabulate needs a CONFIG.toml, or --verify FILE")
    from jaxvol.fit import job, table_config, texture

    settings = table_config.load(config)
    chosen = format or Format._value2member_map_.get(out.suffix[1:], Format.npz)
    if chosen is Format.exr and set(settings.emitters) != {"point", "directional", "area"}:
        raise ValueError("the exr texture holds all three emitters; emitters must name point, directional and area")
    folder = job.parts_folder(out)
    try:
        table = job.tabulate(settings, parts_folder=folder)
    except job.Interrupted as stopped:
        print(f"stopped: {stopped}; the same command goes on from there")
        raise typer.Exit(1) from None
    if chosen is Format.npz:
        tables.save(out, table)
    elif chosen is Format.json:
        jobs.write_bytes(out, tables.to_json(table).encode())
    else:
        texture.save(out, settings, table)
    jobs.Parts(folder, config={}, restart=True).clear()
    for name, error in table.metadata["errors"].items():
        print(f"{name}: estimated relative error {error:.1e}")
    for name, seconds in table.metadata["part_seconds"].items():
        print(f"{name}: compile {seconds['compile']:.2f} s, run {seconds['run']:.2f} s (on a core {seconds['cpu']:.2f} s)")
    wall = table.metadata["seconds"]
    print(
        f"wrote {out} ({out.stat().st_size / 1e3:.0f} kB); plan {wall['plan']} s, parts {wall['parts']} s on all cores, "
        f"join {wall['join']} s, estimating errors {wall['errors']} s"
    )


def _verify(path: Path, num: int, seed: int) -> None:
    from jaxvol.fit import job

    checks = job.verify(tables.load(path), num=num, seed=seed)
    for check in checks:
        verdict = "ok" if check.error <= check.limit else "FAILED"
        print(f"{check.name} at {check.where}: relative error {check.error:.1e}, limit {check.limit:.1e}: {verdict}")
    failed = sum(check.error > check.limit for check in checks)
    print(f"{path}: {len(checks) - failed} of {len(checks)} entries agree with independent quadrature")
    if failed:
        raise typer.Exit(1)
