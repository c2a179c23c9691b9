"""Densities in numpy's `.npz`: `density` [x, y, z], and where it lies.

The box is `world_min`, `world_max` (outer faces of the cells), else `first_sample` (centre of the first cell) with
`voxel_size`, else `voxel_size` from the origin on. A file with `density` alone gets cubic cells from the origin on,
its longest side of length 1.
"""

import os
import struct
import tokenize
import zipfile
import zlib
from pathlib import Path

import numpy as np

from jaxvol import jobs
from jaxvol.volumes.grid import Volume, check_shape, checked

# What zipfile and numpy's header parser raise for damaged files, beside ValueError.
_DAMAGE = (
    zipfile.BadZipFile,
    zlib.error,
    struct.error,
    tokenize.TokenError,
    SyntaxError,
    EOFError,
    KeyError,
    TypeError,
    RuntimeError,  # also NotImplementedError: encryption, compression methods
    OverflowError,
    MemoryError,
)
_MAX_HEADER = 1 << 16


def read_npz(path: str | os.PathLike) -> Volume:
    """The density field of an `.npz` file; keys as in the module's docstring, others ignored. Raises ValueError, OSError.

    A header that claims more than the file holds is refused before memory is taken for it. Pickles are not read.
    """
    path = Path(path)
    try:
        with zipfile.ZipFile(path) as archive:
            density = _read_array(path, archive, "density")
            if density is None:
                keys = ", ".join(name.removesuffix(".npy") for name in archive.namelist()[:12]) or "nothing"
                raise ValueError(f"{path}: has no array 'density'; it has {_one_line(keys)}")
            check_shape(path, density.shape)
            return checked(path, density, _bounds(path, archive, density.shape))
    except _DAMAGE as error:
        raise ValueError(f"{path}: is a damaged .npz file ({type(error).__name__}: {_one_line(error)})") from error
    except ValueError as error:
        if str(error).startswith(str(path)):
            raise
        raise ValueError(f"{path}: is a damaged .npz file ({_one_line(error)})") from error


def _one_line(text: object) -> str:
    """What a damaged file may have put into an error or a name, fit to print."""
    return "".join(c if c.isprintable() else " " for c in str(text))[:200]


def _read_array(path: Path, archive: zipfile.ZipFile, key: str) -> np.ndarray | None:
    """One array of numbers, or None where the archive lacks it; its size is checked against the archive's first."""
    if key + ".npy" not in archive.namelist():
        return None
    info = archive.getinfo(key + ".npy")
    with archive.open(info) as member:
        major, _ = np.lib.format.read_magic(member)
        length = struct.unpack("<H" if major == 1 else "<I", member.read(2 if major == 1 else 4))[0]
        if length > _MAX_HEADER:
            raise ValueError(f"{path}: the header of {key!r} claims {length} bytes")
        offset = member.tell()
        member.seek(0)
        np.lib.format.read_magic(member)
        read_header = np.lib.format.read_array_header_1_0 if major == 1 else np.lib.format.read_array_header_2_0
        shape, fortran_order, dtype = read_header(member)
        if dtype.kind not in "fiu" or dtype.itemsize > 8:
            raise ValueError(f"{path}: {key!r} holds {dtype}, not real numbers")
        num_values = int(np.prod([int(n) for n in shape], dtype=object))
        claimed, held = num_values * dtype.itemsize, info.file_size - offset - length
        # The archive's own size may lie too: deflate packs at most 1032 : 1.
        if min(shape, default=1) < 0 or claimed != held or held > 1032 * max(info.compress_size, 1):
            raise ValueError(f"{path}: {key!r} claims {shape} values of {dtype}, the file holds {max(held, 0)} bytes")
        if key == "density":
            check_shape(path, shape)
        data = member.read()  # to the end, so that the checksum is verified
    array = np.frombuffer(data, dtype, count=num_values)
    return array.reshape(shape[::-1]).T if fortran_order else array.reshape(shape)


def _bounds(path: Path, archive: zipfile.ZipFile, shape: tuple[int, int, int]) -> np.ndarray:
    def vector(key: str) -> np.ndarray | None:
        value = _read_array(path, archive, key)
        if value is not None and value.size not in (1, 3):
            raise ValueError(f"{path}: {key!r} must hold 3 numbers (or 1); it has shape {value.shape}")
        return None if value is None else np.broadcast_to(value.ravel().astype(np.float64), 3)

    low, high = vector("world_min"), vector("world_max")
    if low is None or high is None:
        size, first = vector("voxel_size"), vector("first_sample")
        if size is None:
            size = np.full(3, 1 / max(shape))
        low = size * 0 if first is None else first - size / 2
        high = low + size * shape
    return np.array([low, high])


def write_npz(path: str | os.PathLike, volume: Volume) -> None:
    """Write density (float32), world_min, world_max, voxel_size and first_sample, compressed, atomically. Raises OSError."""
    low, high = volume.bounds
    voxel_size = (high - low) / volume.density.shape
    arrays = {"density": volume.density, "voxel_size": voxel_size, "first_sample": low + voxel_size / 2}
    with jobs.atomic_write(path) as temporary, open(temporary, "wb") as file:
        np.savez_compressed(file, world_min=low, world_max=high, **arrays)
