"""Density fields: files (.npz, .vdb, .vol) in and out, and procedural ones."""

import os
from pathlib import Path

from jaxvol.volumes.fields import NAMES, procedural
from jaxvol.volumes.grid import Volume
from jaxvol.volumes.npz import read_npz, write_npz
from jaxvol.volumes.vdb import read_vdb
from jaxvol.volumes.vol import read_vol, write_vol

__all__ = ["NAMES", "Volume", "procedural", "read_npz", "read_vdb", "read_vol", "read_volume", "write_npz", "write_vol"]

READERS = {".npz": read_npz, ".vdb": read_vdb, ".vol": read_vol}


def read_volume(path: str | os.PathLike) -> Volume:
    """The density field in a file, by its suffix.

    Raises ValueError, in one line that names the file and the problem, for a missing, unreadable, truncated, damaged
    or lying file, one of another kind, and for densities that are negative or not finite.
    """
    path = Path(path)
    reader = READERS.get(path.suffix.lower())
    if reader is None:
        suffix = path.suffix or "files without suffix"
        raise ValueError(f"{path}: volumes are read from {', '.join(READERS)}, not from {suffix}")
    try:
        return reader(path)
    except OSError as error:
        raise ValueError(f"{path}: cannot be read ({error.strerror or error})") from error
