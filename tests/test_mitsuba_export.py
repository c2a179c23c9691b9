"""The export to Mitsuba 3: files read back, conventions against Mitsuba's own lookups, pictures against its renderer."""

import struct
from xml.etree import ElementTree

import numpy as np
import pytest
import trimesh

from jaxvol import camera as cameras
from jaxvol import lights, materials, media, mitsuba_export, mitsuba_phong, volumes
from jaxvol.scene import make_scene

RAMP = np.random.default_rng(5).uniform(0.1, 2.0, (5, 3, 4)).astype(np.float32)
BOX = [[-1.0, -0.5, -0.8], [1.0, 0.5, 0.4]]
SCALE = 10.0


def make(*, density=RAMP, **changes):
    """A small scene with every kind of light, a grid of three colours, two materials and a lamp."""
    config = {
        "camera": {"origin": [0.3, 0.2, 4.0], "target": [0, 0.1, 0], "fov_y": 30, "width": 9, "height": 6},
        "medium": {"density": density, "bounds": BOX, "scattering": [2.0, 1.0, 0.5], "absorption": 0.1, "anisotropy": 0.4},
        "shapes": [
            {"mesh": "builtin:plane", "reflectance": [0.5, 0.4, 0.3], "transform": {"scale": 3, "translate": [0, -0.5, 0]}},
            {
                "mesh": "builtin:plane",
                "reflectance": 0.0,
                "emission": [1, 2, 3],
                "transform": {"scale": 2, "translate": [0, 3, 0]},
            },
        ],
        "lights": [
            {"kind": "point", "position": [0, 1, 0.5], "intensity": [1, 2, 3]},
            {"kind": "spot", "position": [0, 2, 0], "direction": [0.3, -1, 0.2], "intensity": 5.0, "angle": 40, "falloff": 15},
            {"kind": "directional", "direction": [0, -1, 1], "irradiance": [3, 2, 1]},
            {"kind": "environment", "radiance": [0.1, 0.2, 0.3]},
        ],
    } | changes
    return make_scene(config)


def a_sky():
    """A turned map of random radiances."""
    radiance = np.random.default_rng(2).uniform(0, 1, (4, 7, 3))
    return lights.environment_light(radiance, rotation_degrees=77.0)


def directions(num):
    d = np.random.default_rng(3).normal(size=(num, 3))
    return (d / np.linalg.norm(d, axis=-1, keepdims=True)).astype(np.float32)


def plugin(root, kind, index=0):
    return root.findall(f".//*[@type='{kind}']")[index]


def numbers(element):
    return np.array([float(x) for x in element.get("value").split(",")])


def named(element, name):
    return element.find(f"./*[@name='{name}']")


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """The scene's XML tree, and the folder with its files."""
    folder = tmp_path_factory.mktemp("exported")
    file = make()
    mitsuba_export.write_mitsuba_xml(folder / "scene.xml", file.scene, file.camera, scale=SCALE, samples=8)
    return ElementTree.parse(folder / "scene.xml").getroot(), folder


def test_lights_of_the_xml_file(written):
    root, _ = written
    point = plugin(root, "point")
    np.testing.assert_allclose(numbers(named(point, "position")), [0, 10, 5])
    np.testing.assert_allclose(numbers(named(point, "intensity")), [100, 200, 300])
    sun = plugin(root, "directional")
    np.testing.assert_allclose(numbers(named(sun, "irradiance")), [3, 2, 1])  # radiance does not scale
    np.testing.assert_allclose(numbers(named(sun, "direction")), np.array([0, -1, 1]) / np.sqrt(2), rtol=1e-6)
    spot = plugin(root, "spot")
    pose = numbers(spot.find("transform/matrix")).reshape(4, 4)
    np.testing.assert_allclose(pose[:3, 2], np.array([0.3, -1, 0.2]) / np.linalg.norm([0.3, -1, 0.2]), atol=1e-6)
    np.testing.assert_allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-6)
    np.testing.assert_allclose(pose[:3, 3], [0, 20, 0])
    assert float(named(spot, "cutoff_angle").get("value")) == pytest.approx(40)
    assert float(named(spot, "beam_width").get("value")) == pytest.approx(15)
    np.testing.assert_allclose(numbers(named(plugin(root, "constant"), "radiance")), [0.1, 0.2, 0.3], rtol=1e-6)


def test_surfaces_of_the_xml_file(written):
    root, folder = written
    shapes = [shape for shape in root.findall("shape") if shape.find("bsdf").get("type") == "twosided"]
    assert len(shapes) == 2
    lamps = [shape for shape in shapes if shape.find("emitter") is not None]
    assert len(lamps) == 1
    np.testing.assert_allclose(numbers(named(lamps[0].find("emitter"), "radiance")), [1, 2, 3])
    for shape in shapes:
        mesh = trimesh.load(folder / named(shape, "filename").get("value"), process=False)
        height = 30.0 if shape is lamps[0] else -5.0
        assert len(mesh.faces) == 2
        np.testing.assert_allclose(mesh.vertices[:, 1], height, rtol=1e-6)
        np.testing.assert_allclose(mesh.face_normals, [[0, 1, 0]] * 2, atol=1e-6)  # fronts stay in front
        assert named(shape, "face_normals").get("value") == "true"


def test_medium_of_the_xml_file(written):
    root, folder = written
    medium = plugin(root, "heterogeneous")
    assert float(named(medium, "scale").get("value")) == pytest.approx(2.1 / SCALE)
    np.testing.assert_allclose(numbers(named(medium, "albedo")), np.array([2 / 2.1, 1 / 1.1, 0.5 / 0.6]), rtol=1e-6)
    data = (folder / "density_0.vol").read_bytes()
    assert struct.unpack_from("<5i", data, 4) == (1, 5, 3, 4, 3)
    np.testing.assert_allclose(struct.unpack_from("<6f", data, 24), np.ravel(BOX) * SCALE)
    grid = np.frombuffer(data[48:], "<f4").reshape(4, 3, 5, 3).transpose(2, 1, 0, 3)
    np.testing.assert_allclose(grid, RAMP[..., None] * np.array([2.1, 1.1, 0.6]) / 2.1, rtol=1e-6)
    pose = numbers(plugin(root, "cube").find("transform/matrix")).reshape(4, 4)
    low, high = pose[:3, 3] - np.diag(pose)[:3], pose[:3, 3] + np.diag(pose)[:3]
    np.testing.assert_allclose(high, np.array(BOX[1]) * SCALE)
    touched = np.array([0, 2e-4, 0]) * SCALE  # the floor lies in the lower side: the box sticks out by 1e-4 of its size
    np.testing.assert_allclose(low, np.array(BOX[0]) * SCALE - touched, rtol=1e-7)


def test_a_grey_grid_is_one_channel(tmp_path):
    file = make(medium={"density": RAMP, "bounds": BOX, "scattering": 3.0, "absorption": 1.0})
    mitsuba_export.write_mitsuba_xml(tmp_path / "scene.xml", file.scene, file.camera)
    volume = volumes.read_vol(tmp_path / "density_0.vol")
    np.testing.assert_array_equal(volume.density, RAMP)
    np.testing.assert_allclose(volume.bounds, BOX)
    root = ElementTree.parse(tmp_path / "scene.xml").getroot()
    assert named(plugin(root, "heterogeneous"), "has_spectral_extinction").get("value") == "false"


@pytest.mark.parametrize("inside", [True, False])
def test_the_camera_knows_its_medium(tmp_path, inside):
    origin = [0.9, 0.0, 0.0] if inside else [1.1, 0.0, 0.0]
    file = make(camera={"origin": origin, "target": [0, 0, 0], "width": 4, "height": 4})
    mitsuba_export.write_mitsuba_xml(tmp_path / "scene.xml", file.scene, file.camera)
    sensor = ElementTree.parse(tmp_path / "scene.xml").getroot().find("sensor")
    assert (named(sensor, "medium") is not None) == inside


def test_maps_are_exact_on_the_rows_of_mitsuba(tmp_path):
    """Mitsuba's bilinear lookup (rows at pi r / (h - 1)), written out in numpy, on the exported map."""
    sky = a_sky()
    described = mitsuba_export._environment(sky, tmp_path)
    from jaxvol import image

    rows = image.read_picture(tmp_path / "environment.exr").rgb
    d = directions(500)
    local = d @ described["to_world"][:3, :3]
    u = np.mod(np.arctan2(local[:, 0], -local[:, 2]) / (2 * np.pi) * 7 - 0.5, 7)
    v = np.arccos(np.clip(local[:, 1], -1, 1)) / np.pi * (len(rows) - 1)
    c, r = np.floor(u).astype(int) % 7, np.minimum(np.floor(v).astype(int), len(rows) - 2)
    fu, fv = (u - np.floor(u))[:, None], (v - r)[:, None]
    top = rows[r, c] * (1 - fu) + rows[r, (c + 1) % 7] * fu
    bottom = rows[r + 1, c] * (1 - fu) + rows[r + 1, (c + 1) % 7] * fu
    np.testing.assert_allclose(top * (1 - fv) + bottom * fv, lights.environment_radiance(sky, d), atol=2e-5)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"medium": {"bounds": BOX, "refractive_index": 1.3}}, "refractive_index"),
        (
            {
                "medium": {
                    "bounds": BOX,
                    "inclusions": [{"shape": {"mesh": "builtin:box", "transform": {"scale": 9.0}}, "density": 2.0}],
                }
            },
            "inclusion within its medium",
        ),
    ],
)
def test_what_mitsuba_cannot_express_is_refused(tmp_path, changes, message):
    file = make(**changes)
    with pytest.raises(ValueError, match=message):
        mitsuba_export.write_mitsuba_xml(tmp_path / "scene.xml", file.scene, file.camera)
    with pytest.raises(ValueError, match="integrator"):
        mitsuba_export.write_mitsuba_xml(tmp_path / "scene.xml", file.scene, file.camera, integrator="path")


# From here on Mitsuba itself is asked.


@pytest.fixture(scope="module")
def mitsuba():
    module = pytest.importorskip("mitsuba", reason="the extra 'peer' (Mitsuba 3) is not installed")
    module.set_variant("scalar_rgb")
    return module


@pytest.fixture(scope="module")
def loaded(mitsuba, tmp_path_factory):
    file = make()
    file_dict = mitsuba_export.to_mitsuba_dict(file.scene, file.camera, tmp_path_factory.mktemp("dict"), samples=4)
    return file, mitsuba.load_dict(file_dict)


def test_both_forms_are_the_same_scene(mitsuba, loaded, tmp_path):
    file, scene = loaded
    mitsuba_export.write_mitsuba_xml(tmp_path / "scene.xml", file.scene, file.camera, samples=4)
    other = mitsuba.load_file(str(tmp_path / "scene.xml"))
    assert len(other.shapes()) == len(scene.shapes()) == 3
    assert len(other.emitters()) == len(scene.emitters()) == 5
    values = []
    for one in (scene, other):
        found = [getattr(value, "matrix", value) for _, value in mitsuba.traverse(one)]
        values.append(sorted(float(np.sum(np.square(np.array(value, np.float64)))) for value in found))
    np.testing.assert_allclose(values[0], values[1], rtol=1e-5, atol=1e-6)


def test_grids_agree_at_every_point(mitsuba, loaded, tmp_path):
    """Values at cell centres, bounds as outer faces, the border value held: the same in both."""
    file, _ = loaded
    volume = volumes.Volume(density=RAMP, bounds=np.array(BOX))
    volumes.write_vol(tmp_path / "grid.vol", volume)
    grid = mitsuba.load_dict({"type": "gridvolume", "filename": str(tmp_path / "grid.vol"), "use_grid_bbox": True, "raw": True})
    points = np.random.default_rng(1).uniform(*(np.array(BOX) * 0.999), (60, 3)).astype(np.float32)
    theirs = []
    for point in points:
        interaction = mitsuba.Interaction3f()
        interaction.p = point.tolist()
        theirs.append(grid.eval_1(interaction))
    np.testing.assert_allclose(theirs, media.density(file.scene.medium, points), atol=2e-5)


def test_spots_agree_in_every_direction(mitsuba, loaded):
    file, scene = loaded
    (spot,) = [e for e in scene.emitters() if "SpotLight" in str(e)]
    spots = file.scene.spot_lights
    towards = np.asarray(spots.direction) + np.linspace(0, 1, 60)[:, None] * directions(60)
    towards = (towards / np.linalg.norm(towards, axis=-1, keepdims=True)).astype(np.float32)
    ours = np.asarray(lights.spot_falloff(spots, np.zeros(60, int), towards))
    assert np.ptp(ours) == 1 and np.any((ours > 0) & (ours < 1))
    theirs = []
    for direction in towards:
        interaction = mitsuba.SurfaceInteraction3f()
        interaction.p = (np.asarray(spots.position[0]) + 2.0 * direction).tolist()
        theirs.append(np.array(spot.sample_direction(interaction, [0.5, 0.5])[1])[0])
    np.testing.assert_allclose(theirs, ours * 5.0 / 4.0, atol=1e-4)


def test_skies_agree_in_every_direction(mitsuba, tmp_path):
    sky = a_sky()
    file = make()
    from jaxvol.types import Scene

    scene = Scene(mesh=file.scene.mesh, environment=sky)
    loaded = mitsuba.load_dict(mitsuba_export.to_mitsuba_dict(scene, file.camera, tmp_path))
    d, theirs = directions(60), []
    for direction in d:
        interaction = mitsuba.SurfaceInteraction3f()
        interaction.wi = (-direction).tolist()
        theirs.append(np.array(loaded.environment().eval(interaction)))
    np.testing.assert_allclose(theirs, lights.environment_radiance(sky, d), atol=2e-5)


def test_cameras_agree_in_every_pixel(loaded):
    file, scene = loaded
    pixels = np.array([[0.5, 0.5], [8.9, 0.1], [0.1, 5.9], [4.5, 3.0]], np.float32)
    ours = cameras.generate_rays(file.camera, pixels)
    for i, pixel in enumerate(pixels):
        place = (pixel / [9, 6]).tolist()
        ray, _ = scene.sensors()[0].sample_ray(0.0, 0.5, place, [0.5, 0.5])
        np.testing.assert_allclose(np.array(ray.d), ours.direction[i], atol=1e-5)
        np.testing.assert_allclose(np.array(ray.o), ours.origin[i], atol=1e-3)


def test_phase_tables_agree(mitsuba):
    """Forward is forward: the table's value for a light that goes straight on, aside and back."""
    file = make(medium={"bounds": BOX, "phase": [1.0, 0.6, 0.36, 0.2]})
    described = mitsuba_export._phase(file.scene.medium)
    table = mitsuba.load_dict(described)
    context, medium = mitsuba.PhaseFunctionContext(), mitsuba.MediumInteraction3f()
    travel = np.array([0.0, 0.0, 1.0])
    medium.wi = (-travel).tolist()  # points back to where light came from
    medium.sh_frame = mitsuba.Frame3f(medium.wi)
    from jaxvol import phase

    for cosine in (1.0, 0.5, 0.0, -0.5, -1.0):
        outgoing = [float(np.sqrt(1 - cosine**2)), 0.0, cosine]
        theirs = table.eval_pdf(context, medium, outgoing)[1]
        assert theirs == pytest.approx(float(phase.evaluate(file.scene.medium, np.float32(cosine))), abs=1e-3)


@pytest.mark.parametrize("exponent", [0.0, 3.5, 40.0])
def test_phong_surfaces_agree(mitsuba, tmp_path, exponent):
    """Value and density against our materials, on both sides; the sampler's weights are value over density."""
    mitsuba_phong.register()
    shape = {"mesh": "builtin:plane", "reflectance": [0.2, 0.3, 0.1], "specular": [0.5, 0.1, 0.3], "exponent": exponent}
    file = make(shapes=[shape], medium=None)
    (mesh,) = mitsuba.load_dict(mitsuba_export.to_mitsuba_dict(file.scene, file.camera, tmp_path)).shapes()
    bsdf, context = mesh.bsdf(), mitsuba.BSDFContext()
    surface = materials.surface_at(file.scene.mesh, np.zeros(40, int))
    towards, outgoing, up = directions(80)[:40], directions(80)[40:], np.array([0.0, 0.0, 1.0], np.float32)
    value = np.asarray(materials.evaluate(surface, up, -towards, outgoing)) * np.abs(outgoing[:, 2:])
    pdf = np.asarray(materials.sample_pdf(surface, up, -towards, outgoing))
    above = towards[:, 2] * outgoing[:, 2] > 0
    assert 10 < np.sum(above) < 30
    for i in range(40):
        si = mitsuba.SurfaceInteraction3f()
        si.wi = towards[i].tolist()
        theirs, density = bsdf.eval_pdf(context, si, mitsuba.Vector3f(outgoing[i].tolist()))
        np.testing.assert_allclose(np.array(theirs), value[i], atol=1e-4)
        assert density == pytest.approx(float(pdf[i]) if above[i] else 0.0, abs=1e-4)
        found, weight = bsdf.sample(context, si, (i + 0.5) / 40, mitsuba.Point2f(0.3, 0.7))
        if found.pdf > 0:
            again, density = bsdf.eval_pdf(context, si, found.wo)
            np.testing.assert_allclose(np.array(weight) * density, np.array(again), rtol=1e-3)
