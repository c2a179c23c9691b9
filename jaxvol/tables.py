"""Table files: arrays with their parameters, version, error estimates and a checksum, as .npz, OpenEXR or JSON.

A `.npz` holds float64 arrays named `<emitter>.<field>` and `<field>` (see `zonal_lookup`), and `metadata`, a JSON text with
the configuration, the version, error estimates and the SHA-256 of everything else. No pickles. `load` refuses a file
that is truncated, edited or of another kind.
"""

import hashlib
import io
import json
import os
import zipfile
import zlib
from importlib import resources
from typing import Any, NamedTuple

import numpy as np

from jaxvol import __version__, jobs, zonal_lookup

FORMAT = "jaxvol impulse-response tables 1"


class TableFile(NamedTuple):
    """What a table file holds."""

    arrays: dict[str, np.ndarray]
    metadata: dict[str, Any]

    def lookups(self, *, dtype=np.float32) -> zonal_lookup.ZonalTables:
        """The tables as a pytree for `zonal_lookup`; float64 needs an enabled x64 mode."""
        return zonal_lookup.from_arrays(self.arrays, dtype=dtype)


def checksum(arrays: dict[str, np.ndarray], metadata: dict[str, Any]) -> str:
    """SHA-256 over names, types, shapes and bytes of all arrays and the metadata without its own checksum."""
    digest = hashlib.sha256()
    for name in sorted(arrays):
        value = np.ascontiguousarray(arrays[name])
        digest.update(f"{name} {value.dtype.str} {value.shape}\n".encode())
        digest.update(value.tobytes())
    rest = {key: value for key, value in metadata.items() if key != "checksum"}
    digest.update(jobs.config_json(rest).encode())
    return digest.hexdigest()


def seal(arrays: dict[str, np.ndarray], metadata: dict[str, Any]) -> TableFile:
    """Arrays and metadata with format, version and checksum filled in."""
    metadata = {**json.loads(jobs.config_json(metadata)), "format": FORMAT, "version": __version__}
    metadata["checksum"] = checksum(arrays, metadata)
    return TableFile(arrays, metadata)


def save(path: str | os.PathLike, table: TableFile) -> None:
    """Write a sealed table as .npz, atomically."""
    text = np.frombuffer(json.dumps(table.metadata, sort_keys=True).encode(), dtype=np.uint8)
    buffer = io.BytesIO()
    np.savez_compressed(buffer, metadata=text, **table.arrays)
    jobs.write_bytes(path, buffer.getvalue())


def load(path: str | os.PathLike) -> TableFile:
    """Read and check a .npz table. Raises ValueError naming what is wrong with the file, OSError where it can't be read."""
    name = os.fspath(path)
    with open(path, "rb") as file:
        data = file.read()
    return _parse(data, name)


def _parse(data: bytes, name: str) -> TableFile:
    try:
        with np.load(io.BytesIO(data), allow_pickle=False) as archive:
            arrays = {key: archive[key] for key in archive.files}
        metadata = json.loads(arrays.pop("metadata").tobytes())
        claimed, kind = metadata["checksum"], metadata["format"]
    except (ValueError, KeyError, TypeError, AttributeError, EOFError, zipfile.BadZipFile, zlib.error) as error:
        raise ValueError(f"{name}: is not a whole table file ({error})") from error
    if kind != FORMAT:
        raise ValueError(f"{name}: holds {kind!r}, this version reads {FORMAT!r}")
    if checksum(arrays, metadata) != claimed:
        raise ValueError(f"{name}: checksum does not match, the file was edited or damaged")
    return TableFile(arrays, metadata)


def default_file() -> TableFile:
    """The default set that ships with the package (experiments/tables/default.toml)."""
    resource = resources.files("jaxvol") / "data" / "default_tables.npz"
    return _parse(resource.read_bytes(), "jaxvol/data/default_tables.npz")


def to_json(table: TableFile) -> str:
    """The same content as JSON: {"metadata": {...}, "arrays": {name: {"shape": [...], "data": [flat, C order]}}}."""
    arrays = {
        name: {"shape": list(value.shape), "data": [float(v) for v in value.ravel()]}
        for name, value in sorted(table.arrays.items())
    }
    return json.dumps({"metadata": table.metadata, "arrays": arrays}, sort_keys=True, allow_nan=False) + "\n"


def from_json(text: str, *, name: str = "JSON") -> TableFile:
    """Inverse of `to_json`, with the same checks as `load`."""
    try:
        content = json.loads(text)
        arrays = {
            key: np.array(entry["data"], dtype=np.float64).reshape(entry["shape"]) for key, entry in content["arrays"].items()
        }
        metadata = content["metadata"]
        claimed = metadata["checksum"]
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise ValueError(f"{name}: is not a whole table file ({error})") from error
    if checksum(arrays, metadata) != claimed:
        raise ValueError(f"{name}: checksum does not match, the file was edited or damaged")
    return TableFile(arrays, metadata)
