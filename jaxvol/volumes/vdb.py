"""OpenVDB's `.vdb` (file version 222 and later): float, double and half 5-4-3 trees into a dense grid.

A file holds grids; a grid is a transform and a tree of 32^3, 16^3 and 8^3 nodes. First comes the topology of all nodes
(with the values of tiles), then the values of all leaves. Values may be packed by active mask, ZIP or Blosc, and
stored as halves. Samples lie AT integer index positions, so that a grid of n samples from i on covers [i - .5, i + n - .5].
"""

import os
import struct
import zlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from jaxvol.volumes.grid import Volume, check_shape, checked

_MAGIC = b" BDV\0\0\0\0"
_ZIP, _ACTIVE_MASK, _BLOSC = 1, 2, 4
_VALUE_TYPES = {"Tree_float_5_4_3": "<f4", "Tree_double_5_4_3": "<f8", "Tree_half_5_4_3": "<f2"}
_SIDES = (32, 16, 8)  # children (or voxels) along a side of the three kinds of node
_SPANS = (4096, 128, 8)  # voxels along a side of the three kinds of node
_MAX_SPARSE = 1 << 26  # voxels up to which a dense grid may be as empty as it likes
_MIN_FILL = 0.05  # active share of larger ones


class _Stream:
    """Little-endian values from a file in memory; running past the end is a ValueError."""

    def __init__(self, path: Path, data: bytes):
        self.path, self.data, self.position = path, data, 0

    def error(self, problem: str) -> ValueError:
        printable = "".join(c if c.isprintable() else "?" for c in problem)  # names in a damaged file may hold anything
        return ValueError(f"{self.path}: {printable}")

    def take(self, num_bytes: int) -> bytes:
        end = self.position + num_bytes
        if num_bytes < 0 or end > len(self.data):
            raise self.error(f"is truncated or damaged (wants {num_bytes} bytes at {self.position} of {len(self.data)})")
        self.position, start = end, self.position
        return self.data[start:end]

    def unpack(self, form: str) -> tuple:
        return struct.unpack("<" + form, self.take(struct.calcsize("<" + form)))

    def integer(self, form: str = "I") -> int:
        return self.unpack(form)[0]

    def text(self) -> str:
        return self.take(self.integer()).decode("utf-8", errors="replace")

    def seek(self, position: int) -> None:
        if not 0 < position <= len(self.data):
            raise self.error(f"is truncated or damaged (a grid lies at {position} of {len(self.data)})")
        self.position = position


@dataclass(frozen=True)
class _Entry:
    """Where a grid is, from the file's table of grids."""

    name: str
    kind: str  # "Tree_float_5_4_3"
    stored_as_half: bool
    instance_of: str
    position: int
    end: int


@dataclass(frozen=True)
class _Values:
    """How a grid packs values."""

    compression: int
    dtype: np.dtype  # in the tree
    stored: np.dtype  # in the file
    background: float


@dataclass(frozen=True)
class _Block:
    """A tile (one value) or a leaf (8^3 values) of the tree."""

    origin: tuple[int, int, int]  # index of its first voxel
    span: int  # voxels along a side
    values: np.ndarray  # [] or [8, 8, 8]
    active: np.ndarray  # the same shape


def read_vdb(path: str | os.PathLike) -> Volume:
    """The grid "density" of a `.vdb` file, or its only scalar grid, over the box of its active voxels and tiles.

    Raises ValueError for a damaged or older file, no such grid, several without one named "density", a rotated or
    sheared transform, a grid without active voxels; also where Blosc was used and `numcodecs` is not installed; OSError.
    """
    path = Path(path)
    stream = _Stream(path, path.read_bytes())
    entry = _choose(stream, _read_table(stream))
    stream.seek(entry.position)
    compression = stream.integer()
    _skip_metadata(stream)
    matrix = _read_transform(stream)
    background, blocks = _read_tree(stream, entry, compression)
    if stream.position != entry.end:
        raise stream.error(f"is damaged: grid {entry.name!r} ends at {stream.position} instead of {entry.end}")
    return _dense(path, blocks, background, matrix)


def _read_table(stream: _Stream) -> list[_Entry]:
    if stream.data[:8] != _MAGIC:
        raise stream.error("is not an OpenVDB file")
    stream.position = 8
    version = stream.integer()
    if version < 222:
        raise stream.error(f"is of file version {version}; OpenVDB 3.0 and later write 222 and up")
    stream.unpack("II")  # library version
    if not stream.integer("B"):
        raise stream.error("was written as a stream without offsets of its grids, which is not supported")
    stream.take(36)  # unique name
    _skip_metadata(stream)
    entries = []
    for _ in range(stream.integer("i")):
        name, kind, instance_of = stream.text(), stream.text(), stream.text()
        position, _, end = stream.unpack("qqq")
        plain = kind.removesuffix("_HalfFloat")
        entries.append(_Entry(name.split("\x1e")[0], plain, kind != plain, instance_of, position, end))
        stream.seek(end)
    return entries


def _choose(stream: _Stream, entries: list[_Entry]) -> _Entry:
    scalar = [entry for entry in entries if entry.kind in _VALUE_TYPES]
    if not scalar:
        held = ", ".join(f"{entry.name} ({entry.kind})" for entry in entries[:8]) or "none"
        raise stream.error(f"has no float, double or half grid; its grids: {held}")
    named = [entry for entry in scalar if entry.name == "density"] or scalar
    if len(named) > 1:
        raise stream.error(f"has the grids {', '.join(e.name for e in named[:8])}; one must be named density")
    if named[0].instance_of:
        raise stream.error(f"grid {named[0].name!r} shares the tree of {named[0].instance_of!r}, which is not supported")
    return named[0]


def _skip_metadata(stream: _Stream) -> None:
    for _ in range(stream.integer()):
        stream.text(), stream.text()
        stream.take(stream.integer())


def _read_transform(stream: _Stream) -> np.ndarray:
    """The 4 x 4 matrix M of world = [i j k 1] M."""
    kind = stream.text()
    matrix = np.eye(4)
    if kind in ("AffineMap", "UnitaryMap"):
        return np.array(stream.unpack("16d")).reshape(4, 4)
    if kind in ("TranslationMap", "ScaleTranslateMap", "UniformScaleTranslateMap"):
        matrix[3, :3] = stream.unpack("3d")
    if kind in ("ScaleMap", "UniformScaleMap", "ScaleTranslateMap", "UniformScaleTranslateMap"):
        matrix[range(3), range(3)] = stream.unpack("3d")
        stream.take(4 * 24)  # voxel size and three inverses
    elif kind != "TranslationMap":
        raise stream.error(f"has a transform {kind!r}, which is not supported")
    return matrix


def _read_tree(stream: _Stream, entry: _Entry, compression: int) -> tuple[float, list[_Block]]:
    """Background value, tiles and leaves of a tree."""
    dtype = np.dtype(_VALUE_TYPES[entry.kind])
    stored = np.dtype("<f2") if entry.stored_as_half else dtype
    if (num_buffers := stream.integer()) != 1:
        raise stream.error(f"has {num_buffers} buffers per leaf; 1 is expected")
    values = _Values(compression, dtype, stored, _one(stream, dtype))
    num_tiles, num_children = stream.unpack("II")
    blocks, leaves = [], []
    for _ in range(num_tiles):
        origin, value = stream.unpack("3i"), _one(stream, dtype)
        blocks.append(_Block(origin, _SPANS[0], value, np.array(stream.integer("B") != 0)))
    for _ in range(num_children):
        _read_node(stream, values, stream.unpack("3i"), 0, blocks, leaves)
    for origin, mask in leaves:
        if stream.take(64) != mask:
            raise stream.error(f"is damaged: the leaf at {origin} has two different masks")
        active = _bits(mask)
        blocks.append(_Block(origin, 8, _read_values(stream, values, active).reshape(8, 8, 8), active.reshape(8, 8, 8)))
    return values.background, blocks


def _read_node(
    stream: _Stream,
    values: _Values,
    origin: tuple[int, int, int],
    level: int,
    blocks: list[_Block],
    leaves: list[tuple[tuple[int, int, int], bytes]],
) -> None:
    """Topology of an inner node: appends its tiles, and (origin, mask) of its leaves in the order of their values."""
    side, span = _SIDES[level], _SPANS[level + 1]
    num_bytes = side**3 // 8
    children, active = _bits(stream.take(num_bytes)), _bits(stream.take(num_bytes))
    tiles = _read_values(stream, values, active)
    origins = origin + np.stack(np.unravel_index(np.arange(side**3), (side, side, side)), axis=-1) * span
    for n in np.flatnonzero(~children & (active | (tiles != values.background))):
        blocks.append(_Block(tuple(origins[n].tolist()), span, tiles[n], active[n]))
    for n in np.flatnonzero(children):
        at = tuple(origins[n].tolist())
        if level == 1:
            leaves.append((at, stream.take(64)))
        else:
            _read_node(stream, values, at, level + 1, blocks, leaves)


def _one(stream: _Stream, dtype: np.dtype) -> np.generic:
    return np.frombuffer(stream.take(dtype.itemsize), dtype)[0]


def _bits(mask: bytes) -> np.ndarray:
    return np.unpackbits(np.frombuffer(mask, np.uint8), bitorder="little").astype(bool)


def _read_values(stream: _Stream, values: _Values, active: np.ndarray) -> np.ndarray:
    """The values of one node, with inactive ones put back where only active ones are stored."""
    flag = stream.integer("B")
    if flag > 6:
        raise stream.error(f"is damaged (inactive-value flag {flag})")
    # Inactive voxels hold `outside`, or `inside` where a selection mask says so; flags as in OpenVDB's Compression.h.
    outside, inside = (values.background if flag == 0 else -values.background), values.background
    if flag in (2, 4, 5):
        outside = _one(stream, values.dtype)
    if flag == 5:
        inside = _one(stream, values.dtype)
    selected = _bits(stream.take(active.size // 8)) if flag in (3, 4, 5) else np.zeros(active.size, bool)
    if not values.compression & _ACTIVE_MASK or flag == 6:
        return _read_data(stream, values, active.size).astype(values.dtype)
    dense = np.where(selected, inside, outside).astype(values.dtype)
    dense[active] = _read_data(stream, values, int(active.sum()))
    return dense


def _read_data(stream: _Stream, values: _Values, count: int) -> np.ndarray:
    num_bytes = count * values.stored.itemsize
    packed = values.compression & (_ZIP | _BLOSC)
    if packed and count == 0 and values.stored != values.dtype:
        return np.empty(0, values.stored)  # OpenVDB writes nothing at all here, unlike for an empty block of floats
    data = _unpack(stream, values.compression, num_bytes) if packed else stream.take(num_bytes)
    return np.frombuffer(data, values.stored, count)


def _unpack(stream: _Stream, compression: int, num_bytes: int) -> bytes:
    size = stream.integer("q")
    if num_bytes == 0:  # a chunk of no values, which Blosc libraries refuse to unpack
        stream.take(abs(size))
        return b""
    if size <= 0:  # stored as it is
        data = stream.take(-size)
    elif compression & _BLOSC:
        data = _unblosc(stream, stream.take(size), num_bytes)
    else:
        try:
            data = zlib.decompressobj().decompress(stream.take(size), max(num_bytes, 1))
        except zlib.error as error:
            raise stream.error(f"is damaged ({error})") from error
    # Blosc blocks are padded to 128 bytes.
    if len(data) < num_bytes or (len(data) > num_bytes and not compression & _BLOSC):
        raise stream.error(f"is damaged (a block holds {len(data)} bytes instead of {num_bytes})")
    return data[:num_bytes]


def _unblosc(stream: _Stream, data: bytes, num_bytes: int) -> bytes:
    try:
        from numcodecs import blosc
    except ImportError as error:
        raise stream.error("is packed by Blosc, which needs the package numcodecs (pip install numcodecs)") from error
    # Bytes 4-7 and 12-15 of a Blosc chunk hold its unpacked and its packed size.
    unpacked, _, packed = struct.unpack("<3I", data[4:16]) if len(data) >= 16 else (0, 0, 0)
    if packed != len(data) or not num_bytes <= unpacked <= num_bytes + 128:
        raise stream.error("is damaged (a Blosc block of the wrong size)")
    try:
        return blosc.decompress(data)
    except RuntimeError as error:
        raise stream.error(f"is damaged ({error})") from error


def _dense(path: Path, blocks: list[_Block], background: float, matrix: np.ndarray) -> Volume:
    """The box of all active voxels and tiles as an array; inactive voxels in it keep the value that the tree has."""
    corners = []
    for block in blocks:
        if block.active.ndim == 0 and block.active:
            corners += [block.origin, np.add(block.origin, block.span)]
        elif block.active.any():
            inside = np.argwhere(block.active)
            corners += [block.origin + inside.min(axis=0), block.origin + inside.max(axis=0) + 1]
    if not corners:
        raise ValueError(f"{path}: its grid is empty (no active voxels)")
    low, high = np.min(corners, axis=0), np.max(corners, axis=0)
    shape = tuple(int(n) for n in high - low)
    check_shape(path, shape)
    num_active = sum(int(b.active.sum()) * (b.span**3 if b.active.ndim == 0 else 1) for b in blocks)
    if np.prod(shape) > max(_MAX_SPARSE, num_active / _MIN_FILL):
        raise ValueError(f"{path}: {num_active} active voxels spread over {shape} are too sparse to be held as a dense grid")

    density = np.full(shape, background, np.float32)
    for block in blocks:
        start = np.maximum(np.subtract(low, block.origin), 0)
        stop = np.minimum(np.subtract(high, block.origin), block.span)
        if (start < stop).all():
            inside = tuple(slice(i, j) for i, j in zip(start, stop, strict=True))
            at = tuple(slice(i, j) for i, j in zip(block.origin + start - low, block.origin + stop - low, strict=True))
            density[at] = block.values if block.active.ndim == 0 else block.values[inside]

    scale = np.diag(matrix)[:3]
    if np.abs(matrix[:3, :3] - np.diag(scale)).max() > 1e-6 * np.abs(scale).max():
        raise ValueError(f"{path}: its grid is rotated or sheared against the axes, which is not supported")
    faces = np.array([low - 0.5, high - 0.5]) * scale + matrix[3, :3]
    flips = tuple(slice(None, None, -1 if step < 0 else 1) for step in scale)
    return checked(path, density[flips], np.sort(faces, axis=0))
