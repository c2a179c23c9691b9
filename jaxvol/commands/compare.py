"""`jaxvol compare`: the error of one picture against a reference, as JSON."""

import json
import sys
from pathlib import Path
from typing import Annotated

import typer

from jaxvol import image
from jaxvol.layers import items


def compare(
    a: Annotated[Path, typer.Argument(help="EXR picture to judge.")],
    reference: Annotated[Path, typer.Argument(help="EXR picture that it is judged by.")],
    layer: Annotated[
        str | None, typer.Option(help="Compare this layer or sum, as in L or L+L2; default: the pictures.")
    ] = None,
    block: Annotated[int, typer.Option(help="Average over blocks of N x N pixels first.")] = 1,
) -> None:
    """Print relmse, relative_l1, bias, p99 and reference_noise (and flip where installed) of A against REFERENCE as JSON.

    The reference's variance is taken from its own `variance.*` channels; without them reference_noise is null and
    relmse counts the reference's noise as error. Raises ValueError and OSError for unreadable files, absent layers,
    unequal sizes and values that are not finite.
    """
    pictures = image.read_picture(a), image.read_picture(reference)
    try:
        errors = image.compare(*pictures, layers=None if layer is None else [layer], block=block)
    except ValueError as error:
        raise ValueError(f"{a} against {reference}: {error}") from error
    if layer is None:
        _warn_of_unequal_layers(*pictures)
    print(json.dumps(errors, indent=2, allow_nan=False))


def _warn_of_unequal_layers(a: image.Picture, reference: image.Picture) -> None:
    """A method that computes some layers only is judged by those; its whole picture against a whole one says little."""
    ours, theirs = ({part for name, _ in items(p.layers) for part in name.split("+")} for p in (a, reference))
    if ours and theirs and ours != theirs:
        unequal = ", ".join(sorted(ours ^ theirs))
        print(f"note: only one of the pictures holds {unequal}; --layer compares what both hold", file=sys.stderr)
