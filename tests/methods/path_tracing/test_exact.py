"""The reference against exact answers at full power: standard errors of at most 0.1 % (problems T2, T3, T4, T7, T12).

The lesser power of `test_path_tracing.py` runs by default; these take minutes together.
"""

import math

import jax.numpy as jnp
import numpy as np
import pytest

from jaxvol import layers, lights
from jaxvol import scene as scenes
from jaxvol.methods import path_tracing
from jaxvol.types import Mesh, Scene
from tests import problems
from tests.methods.path_tracing.builders import assert_equal, box, point, rays, sun, total_and_error

pytestmark = pytest.mark.slow

POWER = 1e-3
COPIES = 256  # of each estimate, so that sums in single precision stay short
ALBEDOS = (0.5, 0.9, 0.99)  # three media in three channels


def three_albedos(low, high):
    c = np.asarray(ALBEDOS)
    return box(low, high, sigma_s=c, sigma_a=1 - c)


def source(c):
    """T2: an isotropic source of power 1 in a medium without end, as far as its light gets."""
    medium = box([-60] * 3, [60] * 3, sigma_s=c, sigma_a=1 - c)
    return Scene(medium=medium, point_lights=point([0, 0, 0], 1 / (4 * math.pi)))


@pytest.mark.parametrize(
    ("c", "place", "samples"),
    [
        (0.5, 0, 5120),
        (0.5, 1, 16384),
        (0.5, 2, 61440),
        (0.9, 0, 15360),
        (0.9, 1, 49152),
        pytest.param(0.99, 0, 20480, marks=pytest.mark.timeout(2400)),  # a hundred vertices a path
    ],
)
def test_fluence_around_a_point_source(c, place, samples):
    r = problems.POINT_SOURCE_RADII[place]
    estimate = path_tracing.fluence(source(c), np.tile([r, 0, 0], (COPIES, 1)), samples=samples)
    value, error = total_and_error(estimate, copies=COPIES)
    assert_equal(value[:, :1], error[:, :1], problems.POINT_SOURCE_FLUENCE[c][1][place], power=POWER)


@pytest.mark.parametrize("direction", [[0.0, 0.6, 0.8], [0.6, -0.8, 0.0]], ids=["across", "away"])
def test_radiance_around_a_point_source(direction):
    """T2: rays from r = 1 that do not meet the source; isotropic scattering re-emits the fluence along them."""
    view = rays([[1.0, 0, 0]], [direction], copies=COPIES)
    value, error = total_and_error(path_tracing.radiance(source(0.5), view, samples=36864), copies=COPIES)
    exact = problems.point_source_radiance([1.0, 0, 0], direction, 0.5)
    assert_equal(value[:, :1], error[:, :1], exact, power=POWER)


def half_space(**light):
    """T3: three albedos in the channels of a slab so deep that nothing returns from its end."""
    return Scene(medium=three_albedos([-3000, -3000, -120], [3000, 3000, 0]), **light)


def irradiance(scene, z, normal, samples):
    """At a height z on the side of +-z, W/m2."""
    spots, normals = np.tile([0, 0, z], (COPIES, 1)), np.tile([0, 0, normal], (COPIES, 1))
    return total_and_error(path_tracing.irradiance(scene, spots, normals, samples=samples), copies=COPIES)


def test_half_space_in_collimated_light():
    """T3: plane albedo at mu0 = 1."""
    found = irradiance(half_space(directional_lights=sun()), 1e-3, -1.0, 5120)
    assert_equal(*found, [problems.HALF_SPACE_PLANE_ALBEDO[:3]], power=POWER)


def test_radiance_of_a_half_space():
    """T3: reflected at mu = 1 and 1/2 of light at mu0 = 1."""
    mu = {1.0: problems.HALF_SPACE_H_AT_1, 0.5: problems.HALF_SPACE_H_AT_HALF}
    view = rays([[0, 0, 1.0]] * 2, [[-math.sqrt(1 - m * m), 0, -m] for m in mu], copies=COPIES)
    estimate = path_tracing.radiance(half_space(directional_lights=sun()), view, samples=5120)
    exact = [[problems.half_space_radiance(m, 1.0, c, mu[m][i], mu[1.0][i]) for i, c in enumerate(ALBEDOS)] for m in mu]
    assert_equal(*total_and_error(estimate, copies=COPIES), exact, power=POWER)


def test_half_space_in_diffuse_light():
    """T3: spherical albedo, light of radiance 1 from everywhere above."""
    found = irradiance(half_space(environment=lights.environment_light([1.0, 1.0, 1.0])), 1e-3, -1.0, 5120)
    assert_equal(*found, [math.pi * np.array(problems.HALF_SPACE_SPHERICAL_ALBEDO[:3])], power=POWER)


SLAB_SAMPLES = ((7680, 2048), (6144, 6144), (6144, 51200), (7680, 6144), (51200, 10240))  # reflected, transmitted


@pytest.mark.parametrize("side", [0, 1], ids=["reflectance", "transmittance"])
@pytest.mark.parametrize("number", range(len(problems.SLABS)))
def test_slab_in_collimated_light(number, side):
    """T4: each side to 0.1 %; the tau = 8 slab is the thick-slab limit of T3 at c = 1 as well."""
    slab = problems.SLABS[number]
    medium = box([-3000, -3000, -slab.tau], [3000, 3000, 0], sigma_s=slab.c, sigma_a=1 - slab.c, g=slab.g)
    light = sun([-math.sqrt(1 - slab.mu0**2), 0, -slab.mu0], 1 / slab.mu0)
    z, normal, exact = ((1e-3, -1.0, slab.reflectance), (-slab.tau - 1e-3, 1.0, slab.transmittance))[side]
    value, error = irradiance(Scene(medium=medium, directional_lights=light), z, normal, SLAB_SAMPLES[number][side])
    assert_equal(value[:, :1], error[:, :1], exact, power=POWER)


def wall(x):
    """A black wall across the x axis, to end rays."""
    corners = jnp.asarray([[x, -1, -1], [x, 1, -1], [x, 1, 1], [x, -1, 1]], jnp.float32)
    return Mesh(corners, jnp.asarray([[0, 1, 2], [0, 2, 3]]), jnp.zeros((2, 3), jnp.float32))


@pytest.mark.parametrize("problem", [*problems.AIRLIGHT, problems.Airlight(1e-7, 2.0, 0.3, 80.0, 0.0)], ids=str)
def test_airlight_of_a_point_light(problem):
    """T7: single scattering of an isotropic point light along a ray (Sun et al. 2005); the last one without extinction."""
    sigma, distance, angle, length, exact = problem
    exact = exact or problems.airlight_in_vacuum(distance, angle, length)
    medium = box([-80] * 3, [80] * 3, sigma_s=0.5 * sigma, sigma_a=0.5 * sigma)
    light = point([distance * math.cos(angle), distance * math.sin(angle), 0.0])
    mesh = wall(length) if length == 2.0 else None
    scene = Scene(mesh=mesh, medium=medium, point_lights=light)
    view = rays([[0.0, 0, 0]], [[1.0, 0, 0]], copies=COPIES)
    estimate = path_tracing.radiance(scene, view, samples=5120, max_scatterings=1)
    value, error = total_and_error(estimate, copies=COPIES, layer="volume_from_light")
    per_unit = 0.5 * sigma / (4 * math.pi)
    assert_equal(value / per_unit, error / per_unit, exact, power=POWER)


T12 = {  # lights, samples of the homogeneous medium and of the grid, options
    "sun": ({"directional_lights": sun([0.6, -0.8, 0.0])}, 20480, 25600, {}),
    "point light inside, scattered once": ({"point_lights": point([0.5, 0.3, 0.5])}, 5120, 10240, {"max_scatterings": 1}),
    "point light inside": ({"point_lights": point([0.5, 0.3, 0.5])}, 196608, 131072, {}),
}


@pytest.mark.parametrize("case", T12)
def test_a_constant_grid_equals_the_homogeneous_medium(case):
    """T12: in every channel, also 100 : 1 apart and with albedo 0."""
    light, *samples, options = T12[case]
    view = rays([[0.2, 0.1, 4.0]], [[0.0, 0.0, -1.0]], copies=COPIES)
    found = []
    for grid, count in zip((None, 8), samples, strict=True):
        medium = box([-1] * 3, [1] * 3, sigma_s=[1.0, 0.01, 0.0], sigma_a=[0.1, 0.001, 0.25], g=0.3, grid=grid)
        estimate = path_tracing.radiance(Scene(medium=medium, **light), view, samples=count, seed=len(found), **options)
        value, error = total_and_error(estimate, copies=COPIES)
        assert value[0, 2] == error[0, 2] == 0.0
        found.append((value[:, :2], error[:, :2]))
    (exact, exact_error), (value, error) = found
    assert_equal(exact, exact_error, exact, power=POWER)
    assert_equal(value, error, exact, power=POWER, exact_error=exact_error)


def test_a_translucent_bunny_in_a_furnace_is_not_to_be_seen(shared_data):
    """A body that only scatters, bounded by a mesh, in light of radiance 1 from everywhere; hundreds of flights a path."""
    file = scenes.make_scene(
        {
            "camera": {"origin": [-0.08, 0.19, 0.42], "target": [-0.017, 0.105, 0.0], "fov_y": 30.0, "width": 24, "height": 24},
            "medium": {
                "shape": str(shared_data / "meshes" / "stanford_bunny_16k_closed.ply"),
                "scattering": [130.0, 118.0, 90.0],
                "absorption": 0.0,
                "anisotropy": 0.2,
            },
            "lights": [{"kind": "environment", "radiance": 1.0}],
        }
    )
    plan = path_tracing.plan(file.scene, file.camera)
    estimate = path_tracing.render(file.scene, file.camera, plan, samples=2048)
    picture, variance = np.asarray(layers.total(estimate.mean)), np.asarray(estimate.variance.sums["+".join(layers.NAMES)])
    body = np.asarray(estimate.mean.emission)[..., 0] < 0.999
    assert body.sum() > 100
    error = np.sqrt(variance[body].sum(axis=0, dtype=np.float64)) / body.sum()
    assert_equal(picture[body].mean(axis=0, dtype=np.float64), error, 1.0, power=1.2e-3)
