"""The reference against itself in other units, places, turns and roles, and against float64 quadrature in odd positions."""

import math

import jax.numpy as jnp
import numpy as np
import pytest
import trimesh

from jaxvol import layers, lights
from jaxvol.methods import path_tracing
from jaxvol.types import Medium, Mesh, PointLights, Scene
from tests.methods.path_tracing.builders import assert_equal, box, point, rays, sun, total_and_error, z_limit

SLOW_GRID, SLOW_MESH = (pytest.param(kind, marks=pytest.mark.slow) for kind in ("grid", "mesh"))
CORNER = 0.25  # of the voxels of an 8^3 grid in [-1, 1]^3


def cloudy(seed=0):
    """A density of 8^3 voxels, whose majorant cells are 4^3 voxels wide; one eighth of it empty."""
    density = np.random.default_rng(seed).uniform(0.1, 2.0, (8, 8, 8)).astype(np.float32)
    density[:4, :4, 4:] = 0.0
    return density


def mesh_of(shape, albedo=0.5):
    triangles = np.asarray(shape.vertices, np.float32), np.asarray(shape.faces, np.int32)
    return Mesh(jnp.asarray(triangles[0]), jnp.asarray(triangles[1]), jnp.full((len(triangles[1]), 3), albedo, jnp.float32))


def floor(y=-1.2, half=2.0, albedo=(0.8, 0.5, 0.2)):
    corners = jnp.asarray([[-half, y, -half], [-half, y, half], [half, y, half], [half, y, -half]], jnp.float32)
    return Mesh(corners, jnp.asarray([[0, 1, 2], [0, 2, 3]]), jnp.broadcast_to(jnp.asarray(albedo, jnp.float32), (2, 3)))


def medium_of(kind, **optics):
    """Media that fill [-1, 1]^3: "homogeneous", "grid" (see `cloudy`), or "mesh" = homogeneous within a cube's faces."""
    optics = {"sigma_s": [1.2, 0.8, 0.3], "sigma_a": [0.1, 0.3, 0.6], "g": 0.4} | optics
    if kind == "grid":
        return box([-1] * 3, [1] * 3, grid=cloudy(), **optics)
    if kind == "mesh":
        return box([-1.5] * 3, [1.5] * 3, boundary=mesh_of(trimesh.creation.box(extents=[2, 2, 2])), **optics)
    return box([-1] * 3, [1] * 3, **optics)


# --- Reciprocity ---------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["grid", "mesh"])
def test_light_and_detector_may_change_places(kind):
    """The fluence at x of an isotropic source at y is that at y of one at x: clouds, a coloured floor, g = 0.4."""
    x, y = [0.3, 0.6, 0.2], [-0.4, -0.9, 0.5]
    found = []
    for source, detector in ((x, y), (y, x)):
        scene = Scene(mesh=floor(), medium=medium_of(kind), point_lights=point(source))
        spots = np.tile(detector, (128, 1))
        found.append(total_and_error(path_tracing.fluence(scene, spots, samples=2048), copies=128))
    (a, error_a), (b, error_b) = found
    assert_equal(a, error_a, b, power=0.03, exact_error=error_b)


# --- Units, places and turns -----------------------------------------------------------------------------------------


def moved(scene, view, *, scale=1.0, turn=None, shift=(0.0, 0.0, 0.0)):
    """The same scene and rays, lengths times `scale`, turned and shifted (turns keep axes unless meshes bound all)."""
    turn = np.eye(3) if turn is None else turn
    place = lambda p: jnp.asarray(scale * (np.asarray(p, np.float64) @ turn.T) + np.asarray(shift), jnp.float32)  # noqa: E731
    medium, light, mesh = scene.medium, scene.point_lights, scene.mesh

    def mesh_moved(m):
        return None if m is None else Mesh(place(m.vertices), m.faces, m.albedo)

    corners = np.asarray(place(np.asarray(medium.bounds)))
    if medium.boundary is not None and np.any(turn != np.eye(3)):  # the box only has to hold the mesh
        reach = np.sqrt(3.0) * scale * np.max(np.abs(np.asarray(medium.bounds)))
        corners = np.asarray(shift) + np.array([[-reach] * 3, [reach] * 3])
    fields = {f: getattr(medium, f) for f in Medium.__dataclass_fields__}
    fields["sigma_s"], fields["sigma_a"] = medium.sigma_s / scale, medium.sigma_a / scale
    fields["bounds"] = jnp.asarray(np.sort(corners, axis=0), jnp.float32)
    fields["boundary"] = mesh_moved(medium.boundary)
    other = Scene(
        mesh=mesh_moved(mesh),
        medium=Medium(**fields),
        point_lights=PointLights(place(light.position), light.intensity * scale**2),
    )
    return other, rays(np.asarray(place(view.origin)), np.asarray(view.direction, np.float64) @ turn.T)


def scene_and_view(kind):
    scene = Scene(mesh=floor(), medium=medium_of(kind), point_lights=point([0.4, 1.5, 0.3], 3.0))
    rng = np.random.default_rng(3)
    target = rng.uniform(-0.8, 0.8, (256, 3))
    origin = np.array([0.5, 0.4, 3.5])
    return scene, rays(origin, target - origin)


def picture(scene, view, **options):
    return total_and_error(path_tracing.radiance(scene, view, samples=128, **options))


def assert_same_picture(found, other):
    """Statistically: the mean of all rays, and the spread of single ones about each other."""
    (a, error_a), (b, error_b) = found, other
    spread = np.hypot(error_a, error_b)
    n = len(a)
    rounding = 1e-4 * np.abs(a)  # direct light has no other error
    means = np.abs(a.mean(axis=0) - b.mean(axis=0)) / (np.sqrt((spread**2).sum(axis=0)) / n + rounding.mean(axis=0))
    assert np.all(means < z_limit(3)), means
    assert np.all(np.sqrt((spread**2).sum(axis=0)) / n < 0.02 * a.mean(axis=0))
    assert np.mean(np.abs(a - b) > 4.0 * spread + rounding) < 0.02


@pytest.mark.parametrize("scale", [1e-3, 1e3])
@pytest.mark.parametrize("kind", ["homogeneous", SLOW_GRID, SLOW_MESH])
def test_units_of_length_do_not_matter(kind, scale):
    """Lengths times s, sigma / s, intensity times s^2: the same paths with the same seed, but for rounding."""
    scene, view = scene_and_view(kind)
    a, b = picture(scene, view), picture(*moved(scene, view, scale=scale))
    assert_same_picture(a, b)
    assert np.mean(np.isclose(a[0], b[0], rtol=1e-3)) > (0.8 if kind == "grid" else 0.95)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["homogeneous", "grid", "mesh"])
def test_places_do_not_matter(kind):
    scene, view = scene_and_view(kind)
    assert_same_picture(picture(scene, view), picture(*moved(scene, view, shift=(100.0, -30.0, 7.0)), seed=1))


@pytest.mark.slow
def test_turns_do_not_matter():
    """A mesh-bounded medium and a floor, turned together about an odd axis: no box and no grid knows the axes."""
    turn = trimesh.transformations.rotation_matrix(0.7, [0.3, 1.0, -0.5])[:3, :3]
    scene, view = scene_and_view("mesh")
    assert_same_picture(picture(scene, view), picture(*moved(scene, view, turn=turn), seed=1))


@pytest.mark.slow
def test_turns_of_a_grid_do_not_matter():
    """x -> y -> z -> x of everything, the grid's axes included."""
    turn = np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]])  # new x = old z
    scene, view = scene_and_view("grid")
    other, other_view = moved(scene, view, turn=turn)
    turned = box(
        [-1] * 3,
        [1] * 3,
        sigma_s=scene.medium.sigma_s,
        sigma_a=scene.medium.sigma_a,
        g=scene.medium.g,
        grid=np.transpose(cloudy(), (2, 0, 1)),
    )
    other = Scene(mesh=other.mesh, medium=turned, point_lights=other.point_lights)
    assert_same_picture(picture(scene, view), picture(other, other_view, seed=1))


# --- Linearity -------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_light_adds_up():
    """The picture of two lights is the sum of the pictures of each; four times the light is four times the picture."""
    medium, view = medium_of("grid"), scene_and_view("grid")[1]
    at = {"point_lights": point([0.4, 1.5, 0.3], 3.0), "directional_lights": sun([0.6, -0.8, 0.0], 2.0)}
    one, other = (picture(Scene(mesh=floor(), medium=medium, **{k: v}), view) for k, v in at.items())
    both = picture(Scene(mesh=floor(), medium=medium, **at), view, seed=1)
    assert_same_picture(both, (one[0] + other[0], np.hypot(one[1], other[1])))
    fourfold = Scene(mesh=floor(), medium=medium, point_lights=point([0.4, 1.5, 0.3], 12.0))
    np.testing.assert_array_equal(picture(fourfold, view)[0], 4.0 * one[0])


# --- Odd positions, against quadrature -----------------------------------------------------------------------------------


def density_at(density, points):
    """Trilinear in [-1, 1]^3, values at voxel centres, held at the border; 0 outside. None = 1 inside."""
    inside = np.all(np.abs(points) <= 1.0, axis=-1)
    if density is None:
        return inside.astype(np.float64)
    at = np.clip((points + 1.0) / CORNER - 0.5, 0.0, 7.0)
    low = np.minimum(at.astype(int), 6)
    f = at - low
    total = 0.0
    for i, j, k in np.ndindex(2, 2, 2):
        weight = np.prod(np.where(np.array([i, j, k]), f, 1 - f), axis=-1)
        total = total + weight * density[low[..., 0] + i, low[..., 1] + j, low[..., 2] + k]
    return total * inside


def box_chord(origin, direction):
    """Where lines enter and leave [-1, 1]^3, from 0 on."""
    with np.errstate(divide="ignore", invalid="ignore"):
        a, b = (-1.0 - origin) / direction, (1.0 - origin) / direction
    still = direction == 0.0
    low = np.where(still, np.where(np.abs(origin) <= 1.0, -np.inf, np.inf), np.minimum(a, b))
    high = np.where(still, np.inf, np.maximum(a, b))
    t0 = np.maximum(low.max(axis=-1), 0.0)
    return t0, np.maximum(high.min(axis=-1), t0)


def columns(density, origin, direction, length, num=200):
    """int density dt along segments [n], by the midpoint rule within the box."""
    t0, t1 = box_chord(origin, direction)
    t1 = np.minimum(t1, length)
    t0 = np.minimum(t0, t1)
    if density is None:
        return t1 - t0
    t = t0[:, None] + (t1 - t0)[:, None] * (np.arange(num) + 0.5) / num
    points = origin[:, None] + t[..., None] * direction[:, None]
    return density_at(density, points).mean(axis=1) * (t1 - t0)


def transmittance_by_quadrature(density, sigma_t, origin, direction):
    column = columns(density, origin[None], direction[None], np.array([np.inf]), num=20_000)
    return np.exp(-column * sigma_t)


def scattering_by_quadrature(density, sigma_s, sigma_t, g, origin, direction, light, num=600):
    """Radiance of light of intensity 1 at `light` scattered once along a ray from `origin`."""
    t0, t1 = (float(x[0]) for x in box_chord(origin[None], direction[None]))
    width = (t1 - t0) / num
    t = t0 + width * (np.arange(num) + 0.5)
    points = origin + t[:, None] * direction
    here = density_at(density, points)
    before = np.concatenate([[0.0], np.cumsum(here)[:-1]]) * width + 0.5 * here * width
    to_light = light - points
    distance = np.linalg.norm(to_light, axis=1)
    to_light = to_light / distance[:, None]
    column = before + columns(density, points, to_light, distance)
    cosine = to_light @ direction  # light travels along -to_light and then towards the eye, along -direction
    phase = (1 - g * g) / (4 * math.pi * (1 + g * g - 2 * g * cosine) ** 1.5)
    return (np.exp(-column[:, None] * sigma_t) * sigma_s * (here * phase / distance**2)[:, None]).sum(axis=0) * width


ODD_RAYS = {  # origin, direction
    "along an edge of voxels": ([CORNER, 0.5, 3.0], [0, 0, -1]),
    "along an edge of majorant cells": ([0.0, 0.0, 3.0], [0, 0, -1]),
    "in a plane of majorant cells": ([0.0, 0.3, 3.0], [0.0, -0.1, -1.0]),
    "through all corners of a diagonal": ([-3.0, -3.0, -3.0], [1, 1, 1]),
    "diagonal in a plane": ([-2.0, 2.0, CORNER], [1, -1, 0]),
    "from a corner of voxels": ([CORNER, CORNER, CORNER], [-1, 0, 0]),
    "from the centre": ([0.0, 0.0, 0.0], [0, 1, 0]),
    "from inside, askew": ([0.3, -0.2, 0.7], [-0.5, 0.3, -0.8]),
    "from a face, inwards": ([0.2, 1.0, 0.1], [0, -1, 0]),
    "from a face, outwards": ([0.2, 1.0, 0.1], [0, 1, 0]),
}


def odd_view(copies):
    origin, direction = (np.array([np.asarray(r[i], np.float64) for r in ODD_RAYS.values()]) for i in (0, 1))
    return origin, direction / np.linalg.norm(direction, axis=1, keepdims=True), rays(origin, direction, copies=copies)


@pytest.mark.parametrize("kind", ["homogeneous", "grid", SLOW_MESH])
def test_transmittance_along_odd_rays(kind):
    """Radiance 1 behind the medium, nothing scattered: transmittance, per channel."""
    medium = medium_of(kind)
    origin, direction, view = odd_view(64)
    scene = Scene(medium=medium, environment=lights.environment_light([1.0, 1.0, 1.0]))
    estimate = path_tracing.radiance(scene, view, samples=512, max_scatterings=0)
    sigma_t = np.asarray(medium.sigma_s + medium.sigma_a, np.float64)
    density = cloudy().astype(np.float64) if kind == "grid" else None
    exact = np.array([transmittance_by_quadrature(density, sigma_t, o, d) for o, d in zip(origin, direction, strict=True)])
    value, error = total_and_error(estimate, copies=64)
    clear = np.allclose(exact[-1], 1.0) and list(ODD_RAYS)[-1].endswith("outwards")
    assert clear and np.all(np.abs(value[-1] - 1.0) < 1e-3)
    assert_equal(value[:-1], error[:-1], exact[:-1], power=0.05, rounding=1e-4)


LIGHTS = {"on a face": [0.3, 1.0, -0.4], "on an edge": [1.0, 1.0, 0.2], "inside": [0.4, 0.37, 0.13], "outside": [0.5, 2.0, 0.4]}


@pytest.mark.parametrize("light", LIGHTS)
@pytest.mark.parametrize("kind", ["homogeneous", "grid", SLOW_MESH])
def test_single_scattering_along_odd_rays(kind, light):
    """Lights on the medium's boundary, in it and outside; rays from inside it and along its grid."""
    medium = medium_of(kind)
    origin, direction, view = odd_view(64)
    scene = Scene(medium=medium, point_lights=point(LIGHTS[light]))
    estimate = path_tracing.radiance(scene, view, samples=512, max_scatterings=1)
    value, error = total_and_error(estimate, copies=64, layer="volume_from_light")
    np.testing.assert_array_equal(value, total_and_error(estimate, copies=64)[0])
    sigma_s = np.asarray(medium.sigma_s, np.float64)
    sigma_t = sigma_s + np.asarray(medium.sigma_a, np.float64)
    density = cloudy().astype(np.float64) if kind == "grid" else None
    exact = np.array(
        [
            scattering_by_quadrature(density, sigma_s, sigma_t, float(medium.g), o, d, np.asarray(LIGHTS[light]))
            for o, d in zip(origin, direction, strict=True)
        ]
    )
    assert np.all(exact[-1] == 0.0) and np.all(np.abs(value[-1]) <= 1e-3 * exact.mean())
    assert_equal(value[:-1], error[:-1], exact[:-1], power=0.03, rounding=1e-3)


# --- Casting on the device -------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["none", "homogeneous", "grid", "mesh"])
def test_casting_on_the_device_equals_the_host(kind):
    """The same steps under `lax.while_loop` with the BVH: the same paths as with Embree, but for rays that graze."""
    scene, view = scene_and_view("mesh" if kind == "none" else kind)
    ball = mesh_of(trimesh.creation.icosphere(subdivisions=2, radius=0.4))
    mesh = Mesh(
        jnp.concatenate([scene.mesh.vertices, ball.vertices]),
        jnp.concatenate([scene.mesh.faces, ball.faces + len(scene.mesh.vertices)]),
        jnp.concatenate([scene.mesh.albedo, ball.albedo]),
    )
    scene = Scene(mesh=mesh, medium=None if kind == "none" else scene.medium, point_lights=scene.point_lights)
    found = {caster: path_tracing.radiance(scene, view, samples=144, caster=caster) for caster in ("embree", "bvh")}
    pictures = {caster: total_and_error(estimate) for caster, estimate in found.items()}
    assert_same_picture(pictures["embree"], pictures["bvh"])
    for name, image in layers.items(found["bvh"].mean):
        a, b = np.asarray(image), np.asarray(getattr(found["embree"].mean, name))
        assert np.mean(np.isclose(a, b, rtol=1e-3, atol=1e-6)) > 0.97, name
