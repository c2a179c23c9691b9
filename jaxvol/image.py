"""Pictures in and out (OpenEXR, PNG), tone mapping, and the error of one picture against another.

An EXR file holds the picture in `R, G, B`, every layer in `<layer>.R/.G/.B`, the variance of the mean in
`variance.<layer>.R/.G/.B`, guides in `depth.Z`, `transmittance.R/.G/.B`, `albedo.R/.G/.B`, `normal.X/.Y/.Z`, and one
JSON string of metadata (ARCHITECTURE section 3). Values are linear RGB radiance in float32; row 0 is the top.
"""

import importlib
import importlib.util
import io
import json
import mmap
import os
import struct
import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, redirect_stdout
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
from PIL import Image

from jaxvol import jobs
from jaxvol.layers import NAMES, from_items, items, select, total
from jaxvol.types import Auxiliary, Estimate, Layers

RGB = ("R", "G", "B")
METADATA = "jaxvol"  # name of the header attribute that holds the JSON string
LUMINANCE = np.array([0.2126, 0.7152, 0.0722])  # of linear sRGB

_GUIDES = {"depth": ("Z",), "transmittance": RGB, "albedo": RGB, "normal": ("X", "Y", "Z")}
_MAX_UNPACKED = 1 << 28  # bytes that any file may unpack to; larger pictures need a file in proportion
_MAX_RATIO = 2000  # unpacked over packed; deflate reaches 1032


@dataclass(frozen=True)
class Picture:
    """What an EXR file holds; arrays are float32 numpy arrays `[H, W]` or `[H, W, 3]`."""

    rgb: np.ndarray  # the picture itself
    layers: Layers  # absent ones None; empty for files of other programs
    variance: Layers | None = None  # of the mean
    auxiliary: Auxiliary | None = None
    metadata: dict[str, Any] = field(default_factory=dict)


def estimate_channels(estimate: Estimate) -> dict[str, np.ndarray]:
    """EXR channels `[H, W]` of an estimate: the sum of its layers in R, G, B, then layers, variances and guides."""
    channels = _split("", np.asarray(total(estimate.mean)), RGB)
    for name, image in items(estimate.mean):
        channels |= _split(f"{name}.", np.asarray(image), RGB)
    if estimate.variance is not None:
        for name, image in items(estimate.variance):
            channels |= _split(f"variance.{name}.", np.asarray(image), RGB)
    if estimate.auxiliary is not None:
        for name, letters in _GUIDES.items():
            guide = getattr(estimate.auxiliary, name)
            if guide is not None:
                channels |= _split(f"{name}.", np.asarray(guide).reshape(*np.shape(guide)[:2], -1), letters)
    return channels


def _split(prefix: str, image: np.ndarray, letters: tuple[str, ...]) -> dict[str, np.ndarray]:
    return {prefix + letter: image[..., i] for i, letter in enumerate(letters)}


def write_exr(
    path: str | os.PathLike, channels: Mapping[str, np.ndarray], *, metadata: Mapping[str, Any] | None = None
) -> None:
    """Write channels `[H, W]` as float32 (ZIP) and the metadata as one JSON string, atomically.

    Raises ValueError for no channels, empty or unequal shapes; OSError when the disk is full or the path cannot be
    written, leaving an existing file as it was.
    """
    # OpenEXR writes non-contiguous arrays wrong without an error, refuses float64, and changes the dict it is given.
    arrays = {name: np.ascontiguousarray(array, dtype=np.float32) for name, array in channels.items()}
    shapes = {array.shape for array in arrays.values()}
    if len(shapes) != 1 or len(shape := shapes.pop()) != 2 or 0 in shape:
        raise ValueError(f"{path}: channels must be one or more arrays [H, W] of one size that is not empty")
    header = {
        "compression": OpenEXR.ZIP_COMPRESSION,
        "type": OpenEXR.scanlineimage,
        METADATA: jobs.config_json(dict(metadata or {})),
    }
    with jobs.atomic_write(path) as temporary, _captured() as printed:
        try:
            OpenEXR.File(header, arrays).write(os.fspath(temporary))
        except RuntimeError as error:
            raise OSError(f"{path}: cannot be written ({_cause(error, printed(), temporary)})") from error
        _check_complete(path, temporary, height=shape[0])


def _check_complete(path: str | os.PathLike, written: Path, *, height: int) -> None:
    """Raise OSError unless the last chunk ends where the file ends: OpenEXR ignores a disk that fills at the last flush."""
    num_chunks = -(-height // 16)  # ZIP packs 16 rows
    try:
        with open(written, "rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
            position = 8
            while data[position]:  # attributes: name, type, length, value
                position = data.find(b"\0", data.find(b"\0", position) + 1) + 1
                position += 4 + struct.unpack_from("<I", data, position)[0]
            (last,) = struct.unpack_from("<Q", data, position + 1 + 8 * (num_chunks - 1))
            end = last + 8 + struct.unpack_from("<I", data, last + 4)[0]
    except (IndexError, ValueError, struct.error):
        end = -1
    if end != os.path.getsize(written):
        raise OSError(f"{path}: cannot be written (No space left on device, or the file would be too large)")


def read_exr(path: str | os.PathLike) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Channels `[H, W]` (float32) and metadata of an EXR file; metadata is empty for files of other programs.

    Raises OSError when the file cannot be opened, ValueError when it is damaged, of another kind, has several parts or
    subsampled channels, or claims a size out of proportion to the file.
    """
    path = Path(path)
    with open(path, "rb") as file:
        magic, num_bytes = file.read(4), os.fstat(file.fileno()).st_size
    if magic != b"\x76\x2f\x31\x01":
        raise ValueError(f"{path}: is not an OpenEXR file")
    with _captured() as printed:
        try:
            with OpenEXR.File(os.fspath(path), header_only=True) as file:
                num_parts, header = len(file.parts), dict(file.header())
            _check_size(path, header, num_parts, num_bytes)
            with OpenEXR.File(os.fspath(path), separate_channels=True) as file:
                arrays = {name: np.array(channel.pixels, np.float32) for name, channel in file.channels().items()}
        except (RuntimeError, MemoryError, TypeError) as error:
            raise ValueError(f"{path}: is a damaged OpenEXR file ({_cause(error, printed(), path)})") from error
        except ValueError as error:  # ours above, or the library's "has 0 parts" whose cause is only printed
            if str(error).startswith(str(path)):
                raise
            raise ValueError(f"{path}: is a damaged OpenEXR file ({_cause(error, printed(), path)})") from error
    if len({array.shape for array in arrays.values()}) != 1:
        raise ValueError(f"{path}: has no channels, or channels of different sizes, which is not supported")
    try:
        metadata = json.loads(header.get(METADATA, "{}"))
    except (ValueError, TypeError) as error:
        raise ValueError(f"{path}: its metadata is not JSON ({error})") from error
    return arrays, metadata if isinstance(metadata, dict) else {}


def _check_size(path: Path, header: dict[str, Any], num_parts: int, num_bytes: int) -> None:
    if num_parts != 1:
        raise ValueError(f"{path}: has {num_parts} parts, one is expected")
    low, high = (np.asarray(corner, np.int64) for corner in header["dataWindow"])
    width, height = (int(n) for n in high - low + 1)
    unpacked = width * height * 4 * len(header["channels"])
    if width < 1 or height < 1 or unpacked > max(_MAX_UNPACKED, _MAX_RATIO * num_bytes):
        raise ValueError(f"{path}: claims {width} x {height} pixels, out of proportion to its {num_bytes} bytes")


@contextmanager
def _captured() -> Iterator[Any]:
    """OpenEXR prints the cause of an error to the process's stderr and a warning to Python's stdout, which may be JSON.

    Yields a function that returns what stderr got.
    """
    sys.stderr.flush()
    kept = os.dup(2)
    with tempfile.TemporaryFile() as file, redirect_stdout(io.StringIO()):
        os.dup2(file.fileno(), 2)

        def printed() -> str:
            file.seek(0)
            return file.read().decode(errors="replace")

        try:
            yield printed
        finally:
            os.dup2(kept, 2)
            os.close(kept)


def _cause(error: Exception, printed: str, path: Path) -> str:
    """The first line of what OpenEXR printed or raised, without the file's name."""
    text = (printed or str(error)).strip().splitlines()
    return (text[0] if text else type(error).__name__).replace(f"{path}: ", "").replace(str(path), "the file")


def read_picture(path: str | os.PathLike) -> Picture:
    """The picture, its layers, variances, guides and metadata from an EXR file; one channel Y serves as grey.

    Channels that are none of ours are ignored. Raises OSError and ValueError as `read_exr`, and ValueError when there
    is no picture or a layer lacks one of its channels.
    """
    channels, metadata = read_exr(path)
    if set(RGB).isdisjoint(channels) and "Y" in channels:
        channels |= dict.fromkeys(RGB, channels["Y"])
    rgb = _join(path, channels, "", RGB)
    if rgb is None:
        raise ValueError(f"{path}: has no picture in channels R, G, B; it has {', '.join(sorted(channels)[:12])}")
    means, variances = {}, {}
    for prefix in dict.fromkeys(name.rpartition(".")[0] for name in channels):
        name = prefix.removeprefix("variance.")
        if all(part in NAMES for part in name.split("+")):
            (means if name == prefix else variances)[name] = _join(path, channels, f"{prefix}.", RGB)
    guides = {name: _join(path, channels, f"{name}.", letters) for name, letters in _GUIDES.items()}
    if guides["depth"] is not None:
        guides["depth"] = guides["depth"][..., 0]
    return Picture(
        rgb=rgb,
        layers=from_items(means),
        variance=from_items(variances) if variances else None,
        auxiliary=None if all(guide is None for guide in guides.values()) else Auxiliary(**guides),
        metadata=metadata,
    )


def _join(path: Any, channels: Mapping[str, np.ndarray], prefix: str, letters: tuple[str, ...]) -> np.ndarray | None:
    missing = [prefix + letter for letter in letters if prefix + letter not in channels]
    if len(missing) == len(letters):
        return None
    if missing:
        raise ValueError(f"{path}: lacks channel {missing[0]}")
    return np.stack([channels[prefix + letter] for letter in letters], axis=-1)


def read_environment(path: str | os.PathLike) -> tuple[np.ndarray, int]:
    """Radiance `[h, w, 3]` of a latitude-longitude EXR map and the number of negative values that were set to 0.

    Compressed maps ring a little below zero, and a negative radiance has no meaning. Raises OSError and ValueError as
    `read_picture`, and ValueError for a value that is not finite.
    """
    radiance = read_picture(path).rgb
    num_bad = int(np.sum(~np.isfinite(radiance)))
    if num_bad:
        raise ValueError(f"{path}: {num_bad} of {radiance.size} values are not finite, so it cannot be an environment")
    return np.maximum(radiance, 0), int(np.sum(radiance < 0))


def choose_exposure(rgb: np.ndarray) -> float:
    """Exposure in stops that suits a picture `[H, W, 3]`: displayed = tone_map(2 ** exposure * radiance).

    The median luminance of the lit pixels goes to 0.2, unless that puts the 98th percentile outside 0.7 to 1.6. A
    picture without light gets 0.
    """
    luminance = np.asarray(rgb, np.float64) @ LUMINANCE
    peak = np.max(luminance, initial=0, where=np.isfinite(luminance))
    lit = luminance[np.isfinite(luminance) & (luminance > 1e-4 * peak)]
    if lit.size == 0:
        return 0.0
    middle, bright = np.percentile(lit, (50, 98))
    return float(np.log2(np.clip(0.2 / middle, 0.7 / bright, 1.6 / bright)))


def tone_map(rgb: np.ndarray, *, exposure: float = 0.0) -> np.ndarray:
    """8-bit sRGB `[H, W, 3]` of linear radiance: exact up to 0.8 of white, then a shoulder that fades towards white.

    The shoulder is that of the Khronos PBR Neutral tone mapper (2024; without its Fresnel offset), which keeps hues.
    Negative values are black; pixels that are not finite are magenta, so that they are seen.
    """
    start, desaturation = 0.8, 0.15
    bad = ~np.isfinite(rgb).all(axis=-1, keepdims=True)
    linear = np.where(bad, 0, np.maximum(rgb, 0)).astype(np.float64) * 2.0**exposure
    peak = linear.max(axis=-1, keepdims=True)
    compressed = 1 - (1 - start) ** 2 / np.maximum(peak + 1 - 2 * start, 1 - start)
    white = 1 - 1 / (1 + desaturation * np.maximum(peak - compressed, 0))
    shoulder = linear * (compressed / np.maximum(peak, start)) * (1 - white) + compressed * white
    display = np.where(peak > start, shoulder, linear)
    encoded = np.where(display <= 0.0031308, 12.92 * display, 1.055 * np.maximum(display, 1e-9) ** (1 / 2.4) - 0.055)
    encoded = np.where(bad, (1.0, 0.0, 1.0), encoded)
    return np.round(255 * np.clip(encoded, 0, 1)).astype(np.uint8)


def write_png(path: str | os.PathLike, rgb: np.ndarray, *, exposure: float | None = None) -> float:
    """Tone map a picture `[H, W, 3]` into a PNG, atomically; returns the exposure in stops, chosen where None.

    Raises OSError when the path cannot be written.
    """
    rgb = np.asarray(rgb)
    exposure = choose_exposure(rgb) if exposure is None else exposure
    with jobs.atomic_write(path) as temporary:
        Image.fromarray(tone_map(rgb, exposure=exposure)).save(temporary, format="PNG")
    return exposure


def relative_l1(a: np.ndarray, reference: np.ndarray, *, block: int = 1) -> float:
    """sum |a - r| / sum r, of images `[H, W]` or `[H, W, C]`, after averaging over `block` x `block` pixels.

    In all five error measures: averaging at the right and bottom edge takes the pixels that there are, and weighs a
    block by their number; values must be finite and a reference that is all black equal to `a` (ValueError).
    """
    a, r, _, weight = _averaged(a, reference, None, block)
    return _over(np.sum(weight * np.abs(a - r)), np.sum(weight * r))


def relmse(a: np.ndarray, reference: np.ndarray, *, variance: np.ndarray | None = None, block: int = 1) -> float:
    """mean(((a - r)^2 - var_r) / (r^2 + 0.01 mean(r)^2)), with the variance of the reference's mean taken out.

    Without `variance` the reference's noise counts as error of `a`. Of two equal expectations the result is noise
    around the relative variance of `a`, so it may be slightly negative. `block`, errors raised: see `relative_l1`.
    """
    a, r, variance, weight = _averaged(a, reference, variance, block)
    squares = (a - r) ** 2 - (0 if variance is None else variance)
    mean = np.average(r, weights=weight)
    return 0.0 if mean == 0 else float(np.average(squares / (r * r + 0.01 * mean * mean), weights=weight))


def bias(a: np.ndarray, reference: np.ndarray, *, block: int = 1) -> float:
    """sum a / sum r - 1. `block` (which does not change it), errors raised: see `relative_l1`."""
    a, r, _, weight = _averaged(a, reference, None, block)
    return _over(np.sum(weight * (a - r)), np.sum(weight * r))


def p99(a: np.ndarray, reference: np.ndarray, *, block: int = 1) -> float:
    """The 99th percentile of |a - r| / max(r, 0.05 mean r). `block`, errors raised: see `relative_l1`."""
    a, r, _, weight = _averaged(a, reference, None, block)
    mean = np.average(r, weights=weight)
    return 0.0 if mean == 0 else float(np.percentile(np.abs(a - r) / np.maximum(r, 0.05 * mean), 99))


def reference_noise(reference: np.ndarray, variance: np.ndarray, *, block: int = 1) -> float:
    """Sum of the reference's standard errors / sum r: what the reference itself adds to `relative_l1`, about.

    Pixels count as independent when blocks are averaged. `block`, errors raised: see `relative_l1`.
    """
    _, r, variance, weight = _averaged(reference, reference, variance, block)
    return _over(np.sum(weight * np.sqrt(variance)), np.sum(weight * r))


def _over(numerator: float, denominator: float) -> float:
    return 0.0 if numerator == 0 else float(numerator / denominator)


def _averaged(a: Any, r: Any, variance: Any, block: int) -> tuple[np.ndarray, np.ndarray, np.ndarray | None, np.ndarray]:
    """Block means of both images and variance of the reference's, in float64, and the weight of every block."""
    a, r = np.asarray(a, np.float64), np.asarray(r, np.float64)
    if a.shape != r.shape or r.ndim not in (2, 3) or r.size == 0:
        raise ValueError(f"images must be [H, W] or [H, W, C] of one size; got {a.shape} and {r.shape}")
    if variance is not None and np.shape(variance) != r.shape:
        raise ValueError(f"the variance {np.shape(variance)} must have the size of the reference {r.shape}")
    if block < 1:
        raise ValueError(f"block = {block} must be 1 or more")
    for name, image in (("the image", a), ("the reference", r), ("the reference's variance", variance)):
        if image is not None and (num_bad := np.sum(~np.isfinite(image))):
            raise ValueError(f"{num_bad} of {r.size} values of {name} are not finite")
    if r.sum() <= 0 and (r.any() or a.any()):
        raise ValueError("the reference is black, so that errors relative to it have no meaning")
    counts = _block_sums(np.ones(r.shape), block)
    if variance is not None:
        variance = _block_sums(np.maximum(np.asarray(variance, np.float64), 0), block) / counts**2
    return _block_sums(a, block) / counts, _block_sums(r, block) / counts, variance, counts / counts.sum()


def _block_sums(image: np.ndarray, block: int) -> np.ndarray:
    for axis in (0, 1):
        image = np.add.reduceat(image, np.arange(0, image.shape[axis], block), axis=axis)
    return image


def compare(a: Picture, reference: Picture, *, layers: Sequence[str] | None = None, block: int = 1) -> dict[str, float | None]:
    """Errors of one picture against another: relmse, relative_l1, bias, p99, reference_noise, and flip where installed.

    Compares the pictures, or the sums over `layers`. The reference's variance is the sum over its `variance.*`
    layers, taken as uncorrelated; without them `reference_noise` is None. FLIP (Andersson et al. 2021, HDR) is of the
    pictures without averaging. Raises ValueError for layers that are absent, different sizes, values that are not
    finite, a black reference.
    """
    if layers is None:
        image, r = a.rgb, reference.rgb
        stored = [name for name, _ in items(reference.layers)]
        names = "+".join(stored).split("+") if stored else []
    else:
        names = list(layers)
        image, r = (np.asarray(select(picture.layers, names)) for picture in (a, reference))
    variance = _variance(reference, names)
    errors = {
        "relmse": relmse(image, r, variance=variance, block=block),
        "relative_l1": relative_l1(image, r, block=block),
        "bias": bias(image, r, block=block),
        "p99": p99(image, r, block=block),
        "reference_noise": None if variance is None else reference_noise(r, variance, block=block),
    }
    if importlib.util.find_spec("flip_evaluator") and np.max(r) > 0:
        errors["flip"] = _flip(image, r)
    return errors


def _variance(picture: Picture, names: Sequence[str]) -> np.ndarray | None:
    """Variance of the sum over layers, None where the file does not hold all that is asked for."""
    if picture.variance is None or not names:
        return None
    held = {part for name, _ in items(picture.variance) for part in name.split("+")}
    missing = {part for name in names for part in name.split("+")} - held
    return None if missing else np.asarray(select(picture.variance, names))


def _flip(image: np.ndarray, reference: np.ndarray) -> float:
    """Mean HDR FLIP. The library wants contiguous float32 without negatives, and ends the process when all is black."""
    flip_evaluator = importlib.import_module("flip_evaluator")
    r, a = (np.ascontiguousarray(np.maximum(x, 0), np.float32) for x in (reference, image))
    return float(flip_evaluator.evaluate(r, a, "HDR")[1])
