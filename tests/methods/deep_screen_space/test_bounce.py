"""The second bounce against the energy that a closed surface keeps."""

import jax.numpy as jnp
import numpy as np
import trimesh

from jaxvol import ray_casting
from jaxvol.methods.deep_screen_space import bounce, lighting
from jaxvol.methods.deep_screen_space import surfels as sf
from jaxvol.methods.deep_screen_space.camera_rays import transmittance_of
from jaxvol.types import Mesh, Scene
from tests.methods.deep_screen_space.conftest import lamp, make_medium, make_mesh

ALBEDO = np.array([0.5, 0.4, 0.2], np.float32)


def test_a_closed_surface_receives_all_that_it_sends():
    """In a closed sphere without medium all light sent arrives: the second bounce's power is albedo times the first's.

    With a lamp in the middle both are even, so that it is also what every part sends.
    """
    shape = trimesh.creation.icosphere(subdivisions=2)
    albedo = jnp.asarray(np.tile(ALBEDO, (len(shape.faces), 1)))
    mesh = Mesh(jnp.asarray(shape.vertices, jnp.float32), jnp.asarray(shape.faces, jnp.int32), albedo)
    cut = sf.subdivide(mesh.vertices, mesh.faces, np.zeros(3), num_surfels=1300)
    cloud, _ = sf.tessellate(cut, capacity=1536)
    caster = ray_casting.caster_for(mesh)
    clear = transmittance_of(make_medium(0.0, 0.0), (None,), num_steps=4)
    for place in ((0.0, 0.0, 0.0), (0.3, -0.4, 0.2)):
        scene = Scene(mesh=mesh, point_lights=lamp(2.0, place))
        choices = lighting.light_choices(scene, num_area_samples=1, num_environment_samples=1)
        first, _ = lighting.illuminate(scene, cloud, caster, clear, seed=1, choices=choices)
        padded = lighting.order_for_strata(first, capacity=1536)
        again = bounce.illuminate(padded, cloud, mesh, caster, clear, seed=2, num_connections=16)
        power = [np.sum(lit.area[:, None] * lit.radiance, axis=0) for lit in (first, again)]
        np.testing.assert_allclose(power[1] / power[0], ALBEDO, rtol=0.02)
        if place == (0.0, 0.0, 0.0):
            north = again.position[:, 2] > 0
            share = np.sum(again.area[north, None] * again.radiance[north], axis=0) / power[1]
            np.testing.assert_allclose(share, 0.5, rtol=0.03)


def test_walls_between_and_fog_take_light_away():
    """Two squares face to face: the form factor of what one sends to the other; nothing behind a third, less through fog."""
    floor, top = ([-1, -0.5, 1], [2, 0, 0], [0, 0, -2]), ([-1, 0.5, -1], [2, 0, 0], [0, 0, 2])
    between = ([-1, 0.0, 1], [2, 0, 0], [0, 0, -2])
    shares = {}
    for name, quads, sigma in (("clear", [floor, top], 0.0), ("fog", [floor, top], 1.0), ("wall", [floor, top, between], 0.0)):
        mesh = make_mesh(quads, [[0.5, 0.5, 0.5]] * len(quads))
        cut = sf.subdivide(mesh.vertices, mesh.faces, np.array([0, 0, 3.0]), num_surfels=300)
        cloud, _ = sf.tessellate(cut, capacity=512)
        low = np.flatnonzero(np.asarray(cloud.valid) & (np.asarray(cloud.position)[:, 1] < -0.4))
        position, area = np.asarray(cloud.position)[low], np.asarray(cloud.area)[low]
        first = lighting.LitSurfels(position, np.tile(np.float32([0, 1, 0]), (len(low), 1)), area, np.ones_like(position))
        through = transmittance_of(make_medium(sigma, 0.0, half=5.0), (None,), num_steps=4)
        padded, caster = lighting.order_for_strata(first, capacity=512), ray_casting.caster_for(mesh)
        again = bounce.illuminate(padded, cloud, mesh, caster, through, seed=2, num_connections=16)
        above = again.position[:, 1] > 0.4
        shares[name] = np.sum(again.area[above] * again.radiance[above, 0]) / np.sum(area) / 0.5
    assert abs(shares["clear"] - 0.4153) < 0.01  # squares of side 2 at distance 1 (Howell's C-11)
    assert shares["wall"] == 0.0
    assert np.exp(-2) < shares["fog"] / shares["clear"] < np.exp(-1)
