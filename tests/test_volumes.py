"""Density files: what is read equals what was written, whatever is damaged is refused in one line."""

import gzip
import re
import struct
import sys
import zipfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from jaxvol import volumes
from jaxvol.volumes import Volume, read_volume

VDB = Path(__file__).parent / "vdb"  # written by OpenVDB 10.0.1


def some_volume(shape=(5, 6, 7)):
    density = np.random.default_rng(0).random(shape, dtype=np.float32)
    return Volume(density=density, bounds=np.array([[-1.0, 0.0, 0.5], [1.0, 2.5, 4.0]]))


def assert_same(a, b):
    np.testing.assert_array_equal(a.density, b.density)
    np.testing.assert_array_equal(a.bounds, b.bounds)
    assert a.density.dtype == np.float32 and a.density.flags.c_contiguous and a.bounds.dtype == np.float64


def refusal(path, data=None):
    """The message with which a file is refused; one line that begins with its path."""
    if data is not None:
        path.write_bytes(data)
    with pytest.raises(ValueError) as caught:
        read_volume(path)
    message = str(caught.value)
    assert message.startswith(f"{path}: ") and "\n" not in message
    return message


def unpacked(name, tmp_path):
    path = tmp_path / f"{name}.vdb"
    path.write_bytes(gzip.decompress((VDB / f"{name}.vdb.gz").read_bytes()))
    return path


# ---- .npz and .vol


@pytest.mark.parametrize("suffix", ["npz", "vol"])
@pytest.mark.parametrize("shape", [(5, 6, 7), (1, 1, 1)])
def test_written_volumes_come_back(suffix, shape, tmp_path):
    volume, path = some_volume(shape), tmp_path / f"a.{suffix}"
    {"npz": volumes.write_npz, "vol": volumes.write_vol}[suffix](path, volume)
    assert_same(read_volume(path), volume)
    assert_same(read_volume(path.rename(tmp_path / f"a.{suffix.upper()}")), volume)


def test_vol_layout_is_mitsubas(tmp_path):
    """Header and order of values written out by hand: x runs fastest."""
    values = np.arange(2 * 3 * 4, dtype="<f4")
    data = b"VOL\x03" + struct.pack("<5i6f", 1, 2, 3, 4, 1, 0, 0, 0, 1, 1, 1) + values.tobytes()
    assert len(data) == 48 + values.nbytes
    (tmp_path / "a.vol").write_bytes(data)
    volume = read_volume(tmp_path / "a.vol")
    assert volume.density.shape == (2, 3, 4)
    for (x, y, z), value in np.ndenumerate(volume.density):
        assert value == x + 2 * y + 6 * z
    volumes.write_vol(tmp_path / "b.vol", volume)
    assert (tmp_path / "b.vol").read_bytes() == data


@pytest.mark.parametrize(
    ("arrays", "low", "high"),
    [
        ({}, (0, 0, 0), (0.5, 0.25, 1)),
        ({"voxel_size": 2.0}, (0, 0, 0), (4, 2, 8)),
        ({"voxel_size": [1, 2, 3], "first_sample": [0, 0, 0]}, (-0.5, -1, -1.5), (1.5, 1, 10.5)),
        ({"world_min": [0, 1, 2], "world_max": [3, 4, 5], "voxel_size": [9, 9, 9]}, (0, 1, 2), (3, 4, 5)),
    ],
)
@pytest.mark.parametrize("dtype", ["f2", ">f4", "f8", "u1", "i4"])
def test_npz_keys_and_types(arrays, low, high, dtype, tmp_path):
    values = np.arange(8).reshape(2, 1, 4)
    for order in "CF":
        np.savez(tmp_path / "a.npz", density=np.asarray(values, dtype, order=order), **arrays)
        volume = read_volume(tmp_path / "a.npz")
        np.testing.assert_array_equal(volume.density, values)
        np.testing.assert_allclose(volume.bounds, [low, high])


@pytest.mark.parametrize(
    ("arrays", "problem"),
    [
        ({"dens": np.ones((2, 2, 2))}, "has no array 'density'; it has dens"),
        ({"de\nns": np.ones((2, 2, 2))}, "it has de ns"),
        ({"density": np.ones((2, 2))}, r"grid \[x, y, z\]"),
        ({"density": np.ones((2, 0, 2))}, "the grid is empty"),
        ({"density": np.full((2, 2, 2), np.nan)}, "8 of 8 densities are not finite"),
        ({"density": np.full((2, 2, 2), 1e300)}, "not finite"),
        ({"density": np.array([[[1.0, -0.5]]])}, "1 of 2 densities are negative"),
        ({"density": np.array([[["a"]]])}, "not real numbers"),
        ({"density": np.ones((1, 1, 1), complex)}, "not real numbers"),
        ({"density": np.ones((1, 1, 1)), "voxel_size": [1, 2]}, "'voxel_size' must hold 3 numbers"),
        ({"density": np.ones((1, 1, 1)), "voxel_size": 0.0}, "are no box"),
        ({"density": np.ones((1, 1, 1)), "world_min": [0, 0, 0], "world_max": [1, np.inf, 1]}, "are no box"),
    ],
)
def test_npz_with_bad_contents(arrays, problem, tmp_path):
    np.savez(tmp_path / "a.npz", **arrays)
    assert re.search(problem, refusal(tmp_path / "a.npz"))


def test_npz_never_reads_pickles(tmp_path):
    np.savez(tmp_path / "a.npz", density=np.array([[[{}]]], dtype=object))
    assert "not real numbers" in refusal(tmp_path / "a.npz")


def npy(shape, data=b"", version=1):
    header = repr({"descr": "<f4", "fortran_order": False, "shape": shape}).encode() + b"\n"
    length = struct.pack("<H" if version == 1 else "<I", len(header))
    return b"\x93NUMPY" + bytes([version, 0]) + length + header + data


@pytest.mark.parametrize("shape", [(10**6, 10**6, 10**6), (2**31, 2**31, 1), (1000, 1000, 1000), (-1, -1, 8), (3, 3, 3)])
def test_npz_that_claims_more_than_it_holds_takes_no_memory(shape, tmp_path):
    with zipfile.ZipFile(tmp_path / "a.npz", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("density.npy", npy(shape, bytes(32)))
    assert "claims" in refusal(tmp_path / "a.npz")


def test_npz_of_newer_header_version(tmp_path):
    with zipfile.ZipFile(tmp_path / "a.npz", "w") as archive:
        archive.writestr("density.npy", npy((2, 2, 2), bytes(32), version=2))
    assert read_volume(tmp_path / "a.npz").density.shape == (2, 2, 2)


def vol(encoding=1, shape=(2, 2, 2), channels=1, box=(0, 0, 0, 1, 1, 1), count=8):
    return b"VOL\x03" + struct.pack("<5i6f", encoding, *shape, channels, *box) + bytes(4 * count)


@pytest.mark.parametrize(
    ("data", "problem"),
    [
        (b"", "is not a Mitsuba volume"),
        (b"VOL\x02" + bytes(44), "is not a Mitsuba volume"),
        (vol()[:30], "truncated in its header"),
        (vol(count=7), "is truncated"),
        (vol(count=9), "does not end where it should"),
        (vol(encoding=3), "encoding 3"),
        (vol(channels=3), "3 channels"),
        (vol(shape=(2, 0, 2), count=0), "empty"),
        (vol(shape=(-2, -2, 2)), "empty"),
        (vol(shape=(2**31 - 1,) * 3), "at most"),
        (vol(shape=(1000, 1000, 500)), "is truncated"),
        (vol(box=(0, 0, 0, 1, 0, 1)), "are no box"),
        (vol(box=(0, 0, 0, np.nan, 1, 1)), "are no box"),
    ],
)
def test_vol_with_bad_contents(data, problem, tmp_path):
    assert problem in refusal(tmp_path / "a.vol", data)


def test_paths_that_cannot_be_read(tmp_path):
    assert "No such file" in refusal(tmp_path / "absent.npz")
    (tmp_path / "folder.vdb").mkdir()
    assert "cannot be read" in refusal(tmp_path / "folder.vdb")
    assert ".npz, .vdb, .vol, not from .nvdb" in refusal(tmp_path / "a.nvdb", b"")
    assert "files without suffix" in refusal(tmp_path / "a", b"")
    for suffix in ("npz", "vdb", "vol"):
        assert "is" in refusal(tmp_path / f"text.{suffix}", b"Not a volume at all, but long enough for every header.")


# ---- .vdb


def ball(kind):
    """What the fixtures hold by construction, over the box of active voxels; their first index."""
    low, high = ((-4, -9, 2), (11, 6, 17)) if kind != 4 else ((-4, -9, 2), (25, 17, 17))
    i, j, k = np.mgrid[low[0] : high[0], low[1] : high[1], low[2] : high[2]]
    density = np.full(i.shape, 0.125 if kind == 3 else 0.0)
    inside = (i - 3) ** 2 + (j + 2) ** 2 + (k - 9) ** 2 <= 49
    density[inside] = (0.25 + (((3 * i + 5 * j + 7 * k) & 63) / 64))[inside]
    # Values of inactive voxels.
    density[(i == -4) & (j == -9)] = 0.5
    density[(i == 10) & (j == 5) & (k % 2 == 1)] = 0.75
    if kind >= 2:
        density[(i == 10) & (j == 4)] = 0.25
        line = (i == -4) & (j == -8)
        density[line] = k[line] / 32
    if kind == 4:  # an active tile, an inactive one, a single voxel
        density[(i >= 16) & (i < 24) & (j >= 0) & (j < 8) & (k >= 8) & (k < 16)] = 1.5
        density[(i >= 16) & (i < 24) & (j >= 8) & (j < 16) & (k >= 8) & (k < 16)] = 2.5
        density[(i == 24) & (j == 16) & (k == 16)] = 3
    return density, np.array(low)


@pytest.mark.parametrize(
    ("name", "kind", "scale", "shift"),
    [
        ("float_none_1", 1, (0.5, 0.5, 0.5), (1, 2, 3)),  # ScaleTranslateMap
        ("float_mask_2", 2, (0.5, 1, 2), (1, 2, 3)),
        ("float_zipmask_4_half", 4, (0.5, -0.25, 2), (1, 2, 3)),  # AffineMap that mirrors
        ("double_zip_2", 2, (1, 1, 1), (1, 2, 3)),  # TranslationMap
        ("double_mask_3_half", 3, (0.5, 0.5, 0.5), (0, 0, 0)),  # UniformScaleMap
        ("float_bloscmask_1_half", 1, (0.5, 0.5, 0.5), (0, 0, 0)),
        ("double_bloscmask_4", 4, (1, 1, 1), (1, 2, 3)),
    ],
)
def test_vdb_files_of_openvdb(name, kind, scale, shift, tmp_path):
    if "blosc" in name:
        pytest.importorskip("numcodecs", reason="Blosc needs numcodecs")
    volume = read_volume(unpacked(name, tmp_path))
    density, first = ball(kind)
    if scale[1] < 0:
        density = density[:, ::-1]
    np.testing.assert_array_equal(volume.density, density)
    # Samples lie at integer index positions.
    corners = np.array([first - 0.5, first + np.array(density.shape) - 0.5]) * scale + shift
    np.testing.assert_allclose(volume.bounds, np.sort(corners, axis=0), rtol=1e-14)


def test_vdb_inactive_values_of_every_kind(tmp_path):
    """Leaves whose inactive voxels hold one value, two, the background and one other, many."""
    i, j, k = np.mgrid[0:32, 0:8, 0:8]
    off = np.choose(i // 8, [np.full(k.shape, 0.5), np.where(k < 4, 0.5, 0.75), np.where(k < 4, 0.25, 0.75), k / 8])
    wanted = np.where((i + j + k) % 2 == 0, 1 + (i + 8 * j + 64 * k) / 1024, off)
    np.testing.assert_array_equal(read_volume(unpacked("flags", tmp_path)).density, wanted.astype(np.float32))


def test_vdb_equals_its_dense_copy(shared_data):
    """The WDAS cloud as OpenVDB wrote it against its dense half-float copy, made by other means."""
    sparse = read_volume(shared_data / "volumes/wdas_cloud_sixteenth.vdb")
    dense = read_volume(shared_data / "volumes/wdas_cloud_sixteenth.npz")
    assert sparse.density.shape == (126, 86, 154)
    np.testing.assert_array_equal(sparse.density.astype(np.float16), dense.density)
    np.testing.assert_allclose(sparse.bounds, dense.bounds, rtol=1e-12)


@pytest.mark.parametrize(
    ("path", "shape"),
    [
        ("volumes/les_rico_32x37x26.npz", (32, 37, 26)),
        ("volumes/les_rico_122x106x39.npz", (122, 106, 39)),
        ("extra/les_stcu_64x64x16.npz", (64, 64, 16)),
        ("extra/smoke_houdini.npz", (111, 222, 112)),
    ],
)
def test_real_npz(path, shape, shared_data):
    volume = read_volume(shared_data / path)
    assert volume.density.shape == shape and volume.density.max() > 1
    with np.load(shared_data / path, allow_pickle=False) as arrays:
        np.testing.assert_allclose((volume.bounds[1] - volume.bounds[0]) / shape, arrays["voxel_size"], rtol=1e-6)


def test_vdb_takes_the_only_scalar_grid_and_refuses_what_it_cannot_read(tmp_path):
    assert read_volume(unpacked("several", tmp_path)).density.shape == (15, 15, 15)  # beside a vector grid and "heat"
    assert "rotated or sheared" in refusal(unpacked("rotated", tmp_path))
    path = unpacked("several", tmp_path)
    data = path.read_bytes()
    ambiguous = data.replace(b"\x07\0\0\0density\x10\0\0\0Tree_float", b"\x07\0\0\0densitx\x10\0\0\0Tree_float")
    assert "has the grids heat, densitx; one must be named density" in refusal(path, ambiguous)
    assert "has no float, double or half grid" in refusal(path, data.replace(b"Tree_float", b"Tree_int\n2"))
    assert "file version 221" in refusal(path, data[:8] + struct.pack("<I", 221) + data[12:])
    assert "without offsets" in refusal(path, data[:20] + b"\0" + data[21:])


def test_vdb_packed_by_blosc_says_what_is_missing(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "numcodecs", None)
    assert "numcodecs" in refusal(unpacked("float_bloscmask_1_half", tmp_path))


def test_vdb_with_values_that_are_no_density(tmp_path):
    path = unpacked("float_none_1", tmp_path)
    data = path.read_bytes()
    for value, problem in ((-1.0, "negative"), (np.nan, "not finite")):
        assert problem in refusal(path, data.replace(struct.pack("<f", 0.75), struct.pack("<f", value)))


# ---- damage of every kind


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """Sound files of every kind, by name."""
    folder = tmp_path_factory.mktemp("sound")
    volumes.write_npz(folder / "a.npz", some_volume())
    np.savez(folder / "b.npz", density=np.asfortranarray(some_volume().density), voxel_size=2.0)
    volumes.write_vol(folder / "a.vol", some_volume())
    sound = {path.name: path.read_bytes() for path in folder.iterdir()}
    for name in ("float_none_1", "float_zipmask_4_half", "double_mask_3_half", "flags"):
        sound[f"{name}.vdb"] = gzip.decompress((VDB / f"{name}.vdb.gz").read_bytes())
    return sound


def read_or_refuse(path):
    try:
        volume = read_volume(path)
    except ValueError as error:
        assert str(error).startswith(f"{path}: ") and "\n" not in str(error)
    else:
        assert np.isfinite(volume.density).all() and (volume.density >= 0).all() and volume.density.ndim == 3


@settings(max_examples=300, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    which=st.integers(0, 6),
    damage=st.lists(
        st.tuples(
            st.floats(0, 1, exclude_max=True),
            st.one_of(
                st.binary(min_size=1, max_size=8),
                st.sampled_from([b"\xff" * 4, b"\0" * 4, b"\xff\xff\xff\x7f", b"\0\0\0\x80", b"\x01\0\0\0", b"\xff" * 8]),
            ),
            st.sampled_from([1.0, 0.2, 0.02, 0.004]),  # mostly near the start, where the headers are
        ),
        min_size=1,
        max_size=4,
    ),
    keep=st.one_of(st.just(1.0), st.floats(0, 1)),
)
@example(which=0, damage=[(0.0, b"P", 1.0)], keep=0.5)
def test_damaged_files_are_read_or_refused(which, damage, keep, files, tmp_path):
    name = sorted(files)[which]
    data = bytearray(files[name])
    for place, patch, part in damage:
        start = int(place * part * len(data))
        data[start : start + len(patch)] = patch
    path = tmp_path / f"damaged{Path(name).suffix}"
    path.write_bytes(bytes(data[: int(keep * len(data))]))
    read_or_refuse(path)


@pytest.mark.parametrize("which", range(7))
def test_every_truncation_is_refused(which, files, tmp_path):
    name = sorted(files)[which]
    data = files[name]
    lengths = sorted({int(n) for n in np.linspace(0, len(data) - 1, 60)} | {len(data) - 1})
    for length in lengths:
        refusal(tmp_path / f"cut{Path(name).suffix}", data[:length])
