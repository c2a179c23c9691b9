"""Particles from the lights' side: mean power against closed forms, irradiance they bring to a plane, per kind of light."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxvol import emission, lights, sampling
from jaxvol.types import DirectionalLights, Medium, Mesh, PointLights, Scene, SpotLights

NUM = 1 << 19
INTENSITY = np.array([3.0, 1.0, 0.25])
# A medium of no consequence that gives the scene its extent: bounding sphere of radius 2 sqrt(3) about the origin.
EXTENT = Medium(jnp.asarray([[-2.0] * 3, [2.0] * 3]), jnp.ones(3), jnp.zeros(3), jnp.float32(0.0))


def rgb(scale=1.0):
    return jnp.asarray(scale * INTENSITY[None], jnp.float32)


def vectors(*v):
    return jnp.asarray(v, jnp.float32)


def lamp():
    """A square of edge 1 at z = 1, facing down, as two triangles."""
    corners = vectors([-0.5, -0.5, 1], [0.5, -0.5, 1], [0.5, 0.5, 1], [-0.5, 0.5, 1])
    faces = jnp.asarray([[0, 2, 1], [0, 3, 2]])
    return Mesh(corners, faces, jnp.zeros((2, 3)), emission=jnp.asarray(np.stack([INTENSITY, INTENSITY]), jnp.float32))


def cutoff_cone():
    cutoff, falloff = jnp.asarray([0.9]), jnp.asarray([0.5])
    return SpotLights(vectors([0, 0, 1]), vectors([0, 0, -1]), rgb(), cutoff=cutoff, falloff=falloff)


def spot_power(cutoff=0.9, falloff=0.5):
    """Per unit intensity: 2 pi int min(1, (cutoff - a)/(cutoff - falloff)) sin a da."""
    ramp = (np.sin(cutoff) - np.sin(falloff)) / (cutoff - falloff) - np.cos(falloff)
    return 2 * np.pi * ((1 - np.cos(falloff)) - ramp)


def scenes():
    """Scene, total power into it over INTENSITY, irradiance on the plane z = 0 (upper side) at points x, y, over INTENSITY."""
    tilted = np.array([0.6, 0.0, -0.8])
    radius2 = 12.0
    mesh = lamp()

    def point(x, y):
        return 1.0 / (1.0 + x * x + y * y) ** 1.5

    def spot(x, y):
        angle = np.arctan(np.hypot(x, y))
        return point(x, y) * np.clip((0.9 - angle) / 0.4, 0.0, 1.0)

    def square(x, y):  # both cosines 1/d: int dA / (pi... ) by Gauss-Legendre
        node, weight = np.polynomial.legendre.leggauss(12)
        u, v = np.meshgrid(node / 2, node / 2)
        d2 = 1.0 + (x[..., None, None] - u) ** 2 + (y[..., None, None] - v) ** 2
        return np.sum(np.outer(weight, weight) / 4 / d2**2, axis=(-1, -2))

    sky = lights.environment_light(INTENSITY)
    return {
        "point": (Scene(point_lights=PointLights(vectors([0, 0, 1]), rgb())), 4 * np.pi, point),
        "spot": (Scene(spot_lights=cutoff_cone()), spot_power(), spot),
        "directional": (
            Scene(directional_lights=DirectionalLights(vectors(tilted), rgb())),
            np.pi * radius2,
            lambda x, y: 0.8 + 0 * x,
        ),
        "area": (Scene(mesh=mesh, area_lights=lights.area_lights(mesh)), np.pi, square),
        "environment": (Scene(environment=sky), 4 * np.pi**2 * radius2, lambda x, y: np.pi + 0 * x),
    }


def emit(scene):
    counter = jnp.arange(NUM, dtype=jnp.uint32)
    u = [*sampling.uniforms(5, sampling.stream("test"), counter, 0), *sampling.uniforms(5, sampling.stream("test"), counter, 1)]
    found = jax.jit(lambda s, *u: emission.sample_emission(s, *u))(scene, *u[:5])
    return jax.tree.map(lambda x: np.asarray(x, np.float64), found)


@pytest.fixture(scope="module")
def cases():
    found = {}
    for name, (scene, power, irradiance) in scenes().items():
        whole = Scene(**{**vars(scene), "medium": EXTENT})
        found[name] = (emit(whole), power, irradiance)
    return found


KINDS = ("point", "spot", "directional", "area", "environment")


@pytest.mark.parametrize("kind", KINDS)
def test_mean_power_is_the_light_s_power(cases, kind):
    particles, power, _ = cases[kind]
    draws = particles.power[:, 0] / INTENSITY[0]
    error = draws.std() / np.sqrt(NUM)
    assert error < 0.003 * power
    assert abs(draws.mean() - power) < max(4 * error, 5e-4 * power)
    np.testing.assert_allclose(particles.power / particles.power[:, :1], np.broadcast_to(INTENSITY / 3.0, (NUM, 3)), rtol=1e-4)
    np.testing.assert_allclose(np.linalg.norm(particles.direction, axis=1), 1.0, atol=1e-5)


@pytest.mark.parametrize("kind", KINDS)
def test_irradiance_on_a_plane(cases, kind):
    """Particles that cross z = 0 downwards, summed in 4 x 4 tiles of [-1, 1]^2, against closed forms and quadrature."""
    particles, _, irradiance = cases[kind]
    down = particles.direction[:, 2] < 0
    t = -particles.position[:, 2] / np.where(down, particles.direction[:, 2], -1.0)
    hit = particles.position + t[:, None] * particles.direction
    arrives = down & (t > 0) & np.all(np.abs(hit[:, :2]) < 1.0, axis=1)
    tile = np.floor((hit[:, :2] + 1.0) * 2.0).astype(int)
    power = particles.power[:, 0] / INTENSITY[0]
    fine = -1 + 2 * (np.arange(64) + 0.5) / 64
    x, y = np.meshgrid(fine, fine, indexing="ij")
    expected = irradiance(x, y).reshape(4, 16, 4, 16).mean(axis=(1, 3))
    for i in range(4):
        for j in range(4):
            draws = np.where(arrives & (tile[:, 0] == i) & (tile[:, 1] == j), power, 0.0) / 0.25
            error = draws.std() / np.sqrt(NUM)
            assert abs(draws.mean() - expected[i, j]) < 4 * error + 1e-3 * expected[i, j], (i, j)
            assert error < 0.05 * expected.max()
    draws = np.where(arrives, power, 0.0) / 4.0
    error = draws.std() / np.sqrt(NUM)
    assert abs(draws.mean() - expected.mean()) < 3.5 * error + 1e-3 * expected.mean()
    assert error < 0.012 * expected.mean()


def test_lights_are_chosen_by_their_power():
    """Two point lights 9 : 1: every particle carries nearly the same power, a tenth leaves the second light."""
    lamps = PointLights(vectors([0, 0, 1], [1, 0, 0]), jnp.concatenate([rgb(9.0), rgb(1.0)]))
    particles = emit(Scene(point_lights=lamps, medium=EXTENT))
    np.testing.assert_allclose(particles.power[:, 0], 4 * np.pi * 10 * INTENSITY[0], rtol=1e-4)
    second = particles.position[:, 0] > 0.5
    assert abs(second.mean() - 0.1) < 4 * np.sqrt(0.09 / NUM)


def test_particles_of_distant_lights_start_upstream_of_the_scene(cases):
    for kind in ("directional", "environment"):
        particles, _, _ = cases[kind]
        depth = np.sum(particles.position * particles.direction, axis=1)
        np.testing.assert_allclose(depth, -2 * np.sqrt(3), rtol=1e-3)
        assert not particles.on_surface.any()
    particles, _, _ = cases["area"]
    assert particles.on_surface.all() and np.all(particles.direction[:, 2] < 0)
    np.testing.assert_allclose(particles.position[:, 2], 1.0, atol=1e-6)


def test_bounding_sphere_covers_mesh_and_medium():
    center, radius = emission.bounding_sphere(Scene(mesh=lamp(), medium=EXTENT))
    np.testing.assert_allclose(center, 0.0, atol=1e-6)
    assert float(radius) == pytest.approx(2 * np.sqrt(3), rel=1e-3)
    center, radius = emission.bounding_sphere(Scene())
    assert float(radius) == 1.0


def test_a_scene_without_lights_is_refused():
    u = jnp.full((2,), 0.5)
    with pytest.raises(ValueError, match="no light"):
        emission.sample_emission(Scene(medium=EXTENT), u, u, u, u, u)
