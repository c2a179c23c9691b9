"""EXR and PNG files, tone mapping, and error measures against their definitions written out in plain loops."""

import json
import resource

import jax.numpy as jnp
import numpy as np
import OpenEXR
import pytest
from PIL import Image

from jaxvol import image, layers
from jaxvol.types import Auxiliary, Estimate

SUM = "volume_from_light+volume_from_volume+volume_from_multiple"


def random(*shape, seed=0):
    return np.random.default_rng(seed).random(shape).astype(np.float32)


@pytest.fixture(scope="module")
def estimate():
    shape = (9, 7, 3)
    means = {"emission": random(*shape), "surface_from_light": random(*shape, seed=1), SUM: random(*shape, seed=2)}
    depth = random(9, 7)
    depth[0, 0] = np.inf
    return Estimate(
        mean=layers.from_items({name: jnp.asarray(value) for name, value in means.items()}),
        variance=layers.from_items({name: jnp.asarray(value) / 100 for name, value in means.items()}),
        auxiliary=Auxiliary(depth=jnp.asarray(depth), normal=jnp.asarray(random(*shape, seed=3))),
    )


@pytest.fixture
def written(estimate, tmp_path):
    path = tmp_path / "picture.exr"
    image.write_exr(path, image.estimate_channels(estimate), metadata={"seed": 3, "sigma": np.float32(0.5), "name": "Nebel"})
    return path


# ---- files


def test_a_picture_comes_back_exactly(estimate, written):
    picture = image.read_picture(written)
    assert picture.metadata == {"seed": 3, "sigma": 0.5, "name": "Nebel"}
    np.testing.assert_array_equal(picture.rgb, layers.total(estimate.mean))
    for held, given in ((picture.layers, estimate.mean), (picture.variance, estimate.variance)):
        assert [name for name, _ in layers.items(held)] == ["emission", "surface_from_light", SUM]
        for (_, ours), (_, theirs) in zip(layers.items(held), layers.items(given), strict=True):
            np.testing.assert_array_equal(ours, theirs)
    np.testing.assert_array_equal(picture.auxiliary.depth, estimate.auxiliary.depth)
    np.testing.assert_array_equal(picture.auxiliary.normal, estimate.auxiliary.normal)
    assert picture.auxiliary.albedo is None


def test_channels_are_named_as_the_format_says(written):
    with OpenEXR.File(str(written), separate_channels=True) as file:
        names, text = set(file.channels()), dict(file.header())[image.METADATA]
    for name in ("R", "emission.G", f"{SUM}.B", "variance.emission.R", f"variance.{SUM}.B", "depth.Z", "normal.Y"):
        assert name in names
    assert json.loads(text)["seed"] == 3


def test_writing_leaves_its_input_alone_and_takes_float64_and_strides(tmp_path):
    wide = np.random.default_rng(0).random((5, 4, 3))
    channels = {letter: wide[::-1, :, i] for i, letter in enumerate("RGB")}
    before = {name: array.copy() for name, array in channels.items()}
    image.write_exr(tmp_path / "a.exr", channels)
    for name, array in channels.items():
        np.testing.assert_array_equal(array, before[name])
    np.testing.assert_array_equal(image.read_picture(tmp_path / "a.exr").rgb, wide[::-1].astype(np.float32))


def test_a_grey_file_and_a_half_float_file_of_other_programs(tmp_path):
    values = random(6, 5).astype(np.float16)
    OpenEXR.File({"compression": OpenEXR.ZIP_COMPRESSION}, {"Y": values.copy()}).write(str(tmp_path / "y.exr"))
    picture = image.read_picture(tmp_path / "y.exr")
    assert picture.rgb.dtype == np.float32 and picture.metadata == {} and picture.variance is None
    np.testing.assert_array_equal(picture.rgb, np.repeat(values[..., None], 3, axis=-1).astype(np.float32))


@pytest.mark.parametrize("channels", [{}, {"R": np.zeros((0, 4))}, {"R": np.zeros((3, 4)), "G": np.zeros((4, 3))}])
def test_impossible_channels_are_refused(channels, tmp_path):
    with pytest.raises(ValueError, match="channels must be"):
        image.write_exr(tmp_path / "a.exr", channels)
    assert not list(tmp_path.iterdir())


def test_unreadable_files_are_refused_in_one_line(written, tmp_path, capfd):
    whole = written.read_bytes()
    header_end = whole.index(b"screenWindowWidth")
    window = whole.index(b"dataWindow\0box2i\0") + len(b"dataWindow\0box2i\0") + 4
    huge = whole[: window + 8] + np.array([2**20, 2**20], "<i4").tobytes() + whole[window + 16 :]
    backwards = whole[: window + 8] + np.array([-5, -5], "<i4").tobytes() + whole[window + 16 :]
    cases = {"empty": b"", "text": b"hello" * 100, "cut header": whole[:header_end], "cut pixels": whole[: len(whole) // 2]}
    cases |= {"last byte": whole[:-1], "lying size": huge, "negative size": backwards, "magic alone": whole[:4]}
    for name, data in cases.items():
        path = tmp_path / f"{name}.exr"
        path.write_bytes(data)
        with pytest.raises(ValueError) as caught:
            image.read_picture(path)
        assert str(caught.value).startswith(str(path)) and "\n" not in str(caught.value), name
    with pytest.raises(FileNotFoundError):
        image.read_picture(tmp_path / "absent.exr")
    assert capfd.readouterr() == ("", "")  # OpenEXR prints to both, and stdout may be promised to hold JSON alone


def test_a_file_without_a_picture_says_what_it_has(tmp_path):
    image.write_exr(tmp_path / "a.exr", {"depth.Z": random(3, 3)})
    with pytest.raises(ValueError, match="no picture in channels R, G, B; it has depth.Z"):
        image.read_picture(tmp_path / "a.exr")
    image.write_exr(tmp_path / "b.exr", {name: random(3, 3) for name in ("R", "G", "B", "emission.R")})
    with pytest.raises(ValueError, match="lacks channel emission.G"):
        image.read_picture(tmp_path / "b.exr")


@pytest.mark.parametrize("kind", ["exr", "png"])
def test_a_full_disk_leaves_the_old_file_and_nothing_else(kind, tmp_path):
    path = tmp_path / f"a.{kind}"
    picture = random(64, 64, 3)
    write = {
        "exr": lambda: image.write_exr(path, {c: picture[..., i] for i, c in enumerate("RGB")}),
        "png": lambda: image.write_png(path, picture),
    }[kind]
    write()
    before = path.read_bytes()
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    try:
        # Python ignores SIGXFSZ, so that a write beyond the limit fails as on a full disk.
        resource.setrlimit(resource.RLIMIT_FSIZE, (len(before) - 1, limits[1]))
        with pytest.raises(OSError, match=r"(?i)too large"):
            write()
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert path.read_bytes() == before
    assert [file.name for file in tmp_path.iterdir()] == [path.name]


# ---- environment maps


def test_environment_negatives_are_clamped_and_counted(tmp_path):
    radiance = random(4, 8, 3)
    radiance[0, 0] = -1e-4
    image.write_exr(tmp_path / "env.exr", {c: radiance[..., i] for i, c in enumerate("RGB")})
    loaded, num_clamped = image.read_environment(tmp_path / "env.exr")
    assert num_clamped == 3 and loaded.min() == 0
    np.testing.assert_array_equal(loaded, np.maximum(radiance, 0))
    radiance[1, 1, 1] = np.inf
    image.write_exr(tmp_path / "env.exr", {c: radiance[..., i] for i, c in enumerate("RGB")})
    with pytest.raises(ValueError, match="1 of 96 values are not finite"):
        image.read_environment(tmp_path / "env.exr")


@pytest.mark.parametrize(("name", "has_negatives"), [("city", False), ("sunset", True)])
def test_real_environment_maps(name, has_negatives, shared_data):
    radiance, num_clamped = image.read_environment(shared_data / f"envmaps/{name}.exr")
    assert radiance.shape == (512, 1024, 3) and radiance.dtype == np.float32
    assert radiance.min() >= 0 and num_clamped < 1e-3 * radiance.size
    assert (num_clamped > 0) == has_negatives
    assert radiance[:200].mean() > radiance[-200:].mean()  # sky above, row 0 at the top


# ---- tone mapping


def test_tone_map_is_srgb_below_the_shoulder_and_monotone_above():
    linear = np.linspace(0, 8, 4001)
    grey = image.tone_map(np.repeat(linear[None, :, None], 3, axis=-1))[0, :, 0].astype(int)
    below = linear <= 0.8
    srgb = [12.92 * x if x <= 0.0031308 else 1.055 * x ** (1 / 2.4) - 0.055 for x in linear[below]]
    np.testing.assert_array_equal(grey[below], np.round(255 * np.array(srgb)))
    assert (np.diff(grey) >= 0).all() and np.diff(grey[~below]).max() <= 1
    assert grey[-1] < 255  # a shoulder, no clipping at ten times the start


def test_exposure_doubles_and_hue_survives():
    orange = np.full((2, 2, 3), (0.3, 0.15, 0.05))
    np.testing.assert_array_equal(image.tone_map(orange, exposure=1), image.tone_map(2 * orange))
    bright = image.tone_map(4 * orange)[0, 0].astype(int)
    assert bright[0] > bright[1] > bright[2]


def test_chosen_exposure_ignores_scale_black_and_nonfinite_pixels():
    picture = random(40, 40, 3) + 0.1
    exposure = image.choose_exposure(picture)
    assert image.choose_exposure(picture * 1e-3) == pytest.approx(exposure + np.log2(1000), abs=1e-3)
    framed = np.zeros((80, 80, 3), np.float32)
    framed[20:60, 20:60] = picture
    assert image.choose_exposure(framed) == pytest.approx(exposure)
    framed[0, 0] = np.nan
    framed[1, 1] = np.inf
    assert image.choose_exposure(framed) == pytest.approx(exposure)
    assert image.choose_exposure(np.zeros((4, 4, 3))) == 0


def test_png_holds_the_tone_mapped_picture_and_marks_nan(tmp_path):
    picture = random(6, 8, 3)
    picture[2, 3] = np.nan
    exposure = image.write_png(tmp_path / "a.png", picture)
    assert exposure == image.choose_exposure(picture)
    stored = np.asarray(Image.open(tmp_path / "a.png"))
    assert stored.shape == (6, 8, 3) and tuple(stored[2, 3]) == (255, 0, 255)
    np.testing.assert_array_equal(stored, image.tone_map(picture, exposure=exposure))
    assert image.write_png(tmp_path / "a.png", picture, exposure=2.0) == 2.0


# ---- errors


def by_hand(a, r, variance, block):
    """The definitions of ARCHITECTURE section 4 as loops over blocks; edge blocks hold fewer pixels and weigh less."""
    height, width, _ = r.shape
    cells = []
    for top in range(0, height, block):
        for left in range(0, width, block):
            for channel in range(3):
                at = np.s_[top : top + block, left : left + block, channel]
                n = r[at].size
                cells.append((float(a[at].mean()), float(r[at].mean()), float(variance[at].sum()) / n**2, n))
    total = sum(n for *_, n in cells)
    mean = sum(n * y for _, y, _, n in cells) / total
    sum_r = sum(n * y for _, y, _, n in cells)
    ratios = sorted(abs(x - y) / max(y, 0.05 * mean) for x, y, _, _ in cells)
    place = 0.99 * (len(ratios) - 1)
    low = int(place)
    return {
        "relative_l1": sum(n * abs(x - y) for x, y, _, n in cells) / sum_r,
        "relmse": sum(n * ((x - y) ** 2 - v) / (y * y + 0.01 * mean * mean) for x, y, v, n in cells) / total,
        "bias": sum(n * x for x, _, _, n in cells) / sum_r - 1,
        "p99": ratios[low] + (place - low) * (ratios[min(low + 1, len(ratios) - 1)] - ratios[low]),
        "reference_noise": sum(n * v**0.5 for _, _, v, n in cells) / sum_r,
    }


@pytest.mark.parametrize("block", [1, 2, 4, 5, 100])
def test_errors_follow_their_definitions(block):
    a, r, variance = (random(12, 11, 3, seed=seed).astype(np.float64) for seed in range(3))
    r[:4] *= 1e-3  # dark parts, where the floors of relmse and p99 matter
    wanted = by_hand(a, r, variance, block)
    assert image.relative_l1(a, r, block=block) == pytest.approx(wanted["relative_l1"], rel=1e-12)
    assert image.relmse(a, r, variance=variance, block=block) == pytest.approx(wanted["relmse"], rel=1e-12)
    assert image.bias(a, r, block=block) == pytest.approx(wanted["bias"], rel=1e-12)
    assert image.p99(a, r, block=block) == pytest.approx(wanted["p99"], rel=1e-12)
    assert image.reference_noise(r, variance, block=block) == pytest.approx(wanted["reference_noise"], rel=1e-12)


def test_removing_the_variance_leaves_no_error_of_a_perfect_image():
    rng = np.random.default_rng(5)
    truth = 1 + random(200, 200, 3).astype(np.float64)
    reference = truth + rng.normal(0, 0.05, truth.shape)
    # The noise in the denominator leaves 6 v^2 E[1/r^4] = 1.1e-5; the standard error of this size is 5e-6.
    assert abs(image.relmse(truth, reference, variance=np.full(truth.shape, 0.05**2))) < 3e-5
    assert image.relmse(truth, reference) == pytest.approx(0.05**2 * np.mean(1 / truth**2), rel=0.03)


def test_identical_and_black_images():
    black, grey = np.zeros((4, 4, 3)), np.full((4, 4, 3), 0.5)
    for picture in (black, grey):
        for measure in (image.relative_l1, image.relmse, image.bias, image.p99):
            assert measure(picture, picture) == 0
        assert image.reference_noise(picture, np.zeros_like(picture)) == 0
    for measure in (image.relative_l1, image.relmse, image.bias, image.p99):
        with pytest.raises(ValueError, match="reference is black"):
            measure(grey, black)
    assert image.bias(1.25 * grey, grey, block=3) == pytest.approx(0.25)


@pytest.mark.parametrize("measure", [image.relative_l1, image.relmse, image.bias, image.p99])
def test_bad_images_are_refused(measure):
    good = np.ones((4, 4, 3))
    bad = good.copy()
    bad[1, 2, 0] = np.nan
    with pytest.raises(ValueError, match="1 of 48 values of the image are not finite"):
        measure(bad, good)
    with pytest.raises(ValueError, match="1 of 48 values of the reference are not finite"):
        measure(good, bad)
    with pytest.raises(ValueError, match="of one size"):
        measure(good, good[:3])
    with pytest.raises(ValueError, match="block = 0"):
        measure(good, good, block=0)


# ---- comparing pictures


def test_compare_uses_the_picture_and_all_variances_by_default(written, estimate):
    picture = image.read_picture(written)
    brighter = image.Picture(rgb=1.1 * picture.rgb, layers=layers.from_items({"emission": 2 * picture.layers.emission}))
    result = image.compare(brighter, picture, block=2)
    variance = sum(np.asarray(value, np.float64) for _, value in layers.items(estimate.variance))
    wanted = by_hand(brighter.rgb.astype(np.float64), picture.rgb.astype(np.float64), variance, 2)
    assert {name: result[name] for name in wanted} == pytest.approx(wanted, rel=1e-6)
    assert result["bias"] == pytest.approx(0.1, rel=1e-5)


def test_compare_selects_layers(written):
    picture = image.read_picture(written)
    changed = {"emission": 1.5 * picture.layers.emission, "surface_from_light": picture.layers.surface_from_light}
    other = image.Picture(rgb=picture.rgb, layers=layers.from_items(changed))
    assert image.compare(other, picture, layers=["emission"])["bias"] == pytest.approx(0.5, rel=1e-6)
    assert image.compare(other, picture, layers=["surface_from_light"])["relative_l1"] == 0
    both = image.compare(other, picture, layers=["surface_from_light+emission"])
    share = picture.layers.emission.sum() / (picture.layers.emission + picture.layers.surface_from_light).sum()
    assert both["bias"] == pytest.approx(0.5 * share, rel=1e-5)
    with pytest.raises(ValueError, match="volume_from_light is not in the picture"):
        image.compare(other, picture, layers=["volume_from_light"])
    with pytest.raises(ValueError, match="unknown"):
        image.compare(other, picture, layers=["fog"])


def test_compare_without_variance_has_no_reference_noise(written):
    picture = image.read_picture(written)
    plain = image.Picture(rgb=picture.rgb, layers=picture.layers)
    result = image.compare(picture, plain)
    assert result["reference_noise"] is None and result["relmse"] == 0


def test_flip_where_installed(written):
    pytest.importorskip("flip_evaluator", reason="the extra `flip` is not installed")
    picture = image.read_picture(written)
    noisy = image.Picture(rgb=picture.rgb - 0.5, layers=picture.layers)  # has negatives, which FLIP turns into 0 error
    assert image.compare(picture, picture)["flip"] == pytest.approx(0, abs=1e-6)
    assert 0.05 < image.compare(noisy, picture)["flip"] <= 1
    black = image.Picture(rgb=np.zeros_like(picture.rgb), layers=layers.Layers())
    assert "flip" not in image.compare(black, black)  # the library would end the process


def test_flip_is_left_out_where_absent(written, monkeypatch):
    monkeypatch.setattr(image.importlib.util, "find_spec", lambda name: None)
    picture = image.read_picture(written)
    assert list(image.compare(picture, picture)) == ["relmse", "relative_l1", "bias", "p99", "reference_noise"]
