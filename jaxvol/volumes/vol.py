"""Mitsuba's `.vol`: `VOL`, 3, five int32 (encoding, nx, ny, nz, channels), six float32 (box), float32 [z, y, x, channel]."""

import os
import struct
from pathlib import Path

import numpy as np

from jaxvol import jobs
from jaxvol.volumes.grid import Volume, check_shape, checked

_HEADER = struct.Struct("<3sB5i6f")  # 48 bytes
_FLOAT32 = 1


def read_vol(path: str | os.PathLike) -> Volume:
    """The single-channel float32 grid of a `.vol` file, values at cell centres. Raises ValueError, OSError."""
    path = Path(path)
    with open(path, "rb") as file:
        head = file.read(_HEADER.size)
        if head[:4] != b"VOL\x03":
            raise ValueError(f"{path}: is not a Mitsuba volume (.vol, version 3)")
        if len(head) < _HEADER.size:
            raise ValueError(f"{path}: is truncated in its header")
        _, _, encoding, nx, ny, nz, num_channels, *box = _HEADER.unpack(head)
        if encoding != _FLOAT32:
            raise ValueError(f"{path}: encoding {encoding} is not supported, only float32 (1)")
        if num_channels != 1:
            raise ValueError(f"{path}: has {num_channels} channels; density has 1")
        check_shape(path, (nx, ny, nz))
        claimed, held = 4 * nx * ny * nz, os.fstat(file.fileno()).st_size - _HEADER.size
        if claimed != held:
            problem = "is truncated" if held < claimed else "does not end where it should"
            raise ValueError(f"{path}: {problem}: {nx} x {ny} x {nz} voxels need {claimed} bytes, it has {held}")
        values = np.frombuffer(file.read(), "<f4").reshape(nz, ny, nx)
    return checked(path, values.transpose(2, 1, 0), np.array(box))


def write_vol(path: str | os.PathLike, volume: Volume) -> None:
    """Write a `.vol` file, atomically; bounds are rounded to float32. Raises OSError.

    A density of four axes [x, y, z, channel] makes a file of several channels, which Mitsuba takes for colours.
    """
    grid = volume.density if volume.density.ndim == 4 else volume.density[..., None]
    head = _HEADER.pack(b"VOL", 3, _FLOAT32, *grid.shape, *volume.bounds.ravel())
    jobs.write_bytes(path, head + np.ascontiguousarray(grid.transpose(2, 1, 0, 3), "<f4").tobytes())
