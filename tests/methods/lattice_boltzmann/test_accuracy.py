"""Against quadrature, Monte Carlo, and exact slabs (problems T4 and T5)."""

import jax.numpy as jnp
import numpy as np
import pytest

from jaxvol.methods import lattice_boltzmann
from jaxvol.types import DirectionalLights, Medium, Rays, Scene
from tests.methods.lattice_boltzmann.builders import box_scene, experiment


def test_first_order_in_a_cube_is_exact_up_to_its_lit_faces():
    """Single scattering at sigma_t h = 0.55, the light of the outer half voxels included, against quadrature."""
    scattering, extinction, n = 4.0, 4.4, 8
    scene = box_scene(sigma_s=(scattering,) * 3, sigma_a=(extinction - scattering,) * 3)
    plan = lattice_boltzmann.plan(scene, None, resolution=n, rays_per_voxel=16.0, view_step=0.25)
    light = lattice_boltzmann.illuminate(scene, plan)
    x, z = (a.ravel() for a in np.meshgrid((np.arange(16) + 0.5) / 16, (np.arange(16) + 0.5) / 16, indexing="ij"))
    origin, down = np.stack([x, np.full(256, 2.0), z], 1), np.tile([0.0, -1.0, 0.0], (256, 1))
    rays = Rays(*(jnp.asarray(v, jnp.float32) for v in (origin, down, np.full(256, np.inf))))
    ours = lattice_boltzmann.radiance(scene, rays, plan, light)["volume_from_light"][:, 0].mean()
    depth = (np.arange(4000) + 0.5) / 4000
    lit = np.minimum(x[:, None] / 0.6, depth[None] / 0.8)  # way of the sun's light (0.6, -0.8, 0) inside the cube
    exact = np.mean(scattering / (4 * np.pi) * np.exp(-extinction * (lit + depth[None])))
    assert ours == pytest.approx(exact, rel=0.03)  # held constant in the outer half voxels it is 8 % dark


@pytest.mark.slow
@pytest.mark.parametrize(("case", "limit"), [("beam", 0.08), ("point", 0.03)])
def test_fluence_in_a_cube_against_monte_carlo(case, limit):
    """The default lattice at tau 16, albedo 0.9, 32^3; the walks' own noise is below a third of the limit."""
    module = experiment("lattice_accuracy")
    photons = 1_000_000
    exact = module.monte_carlo(case, 16.0, 0.9, photons)
    assert np.sqrt(exact * photons).sum() / (exact * photons).sum() < limit / 3
    found = module.collisions("26", 2, 16.0, 0.9, module.first_collisions(case, 16.0, 32))
    assert np.abs(found - exact).sum() / exact.sum() < limit


@pytest.mark.slow
def test_emission_density_of_a_slab_against_the_integral_equation():
    """Optical thickness 16, albedo 0.9, 32 voxels: sigma_s Phi within 5 % (relative L1) of float64 quadrature."""
    module = experiment("lattice_accuracy")
    (row,) = module.slab_emission(forms=(("26", 2),))
    assert row["error"] < 0.05


@pytest.mark.slow
@pytest.mark.parametrize(
    ("tau", "mu0", "reflectance", "count", "width"),
    [
        (1.0, 1.0, 0.341329, 8, 12.0),
        (2.0, 1.0, 0.517515, 8, 20.0),
        (8.0, 1.0, 0.821804, 16, 48.0),
        (1.0, 0.5, 0.498376, 8, 12.0),
    ],
)
def test_slab_reflectance_and_transmittance(tau, mu0, reflectance, count, width):
    """T4: collimated light on a slab of albedo 1; R and T by radiance within 3 %."""
    medium = Medium(jnp.asarray([[0, 0, 0], [width, width, tau]], jnp.float32), jnp.ones(3), jnp.zeros(3), jnp.float32(0))
    sun = DirectionalLights(jnp.asarray([[np.sqrt(1 - mu0**2), 0.0, mu0]], jnp.float32), jnp.full((1, 3), 1 / mu0))
    scene = Scene(medium=medium, directional_lights=sun)
    plan = lattice_boltzmann.plan(scene, None, resolution=round(width * count / tau), rays_per_voxel=1.0, view_step=0.25)
    light = lattice_boltzmann.illuminate(scene, plan)
    up, down = (experiment("lattice_accuracy").exitance(scene, plan, light, tau, width, side) for side in (0, 1))
    assert up == pytest.approx(reflectance, rel=0.03)
    assert down + np.exp(-tau / mu0) == pytest.approx(1 - reflectance, rel=0.03)


@pytest.fixture(scope="module")
def diffusely_lit_slab():
    """T5: transmittance and reflectance of a slab of optical thickness 1 and albedo 1 under diffuse light from one side."""
    tau, width, count = 1.0, 12.0, 8
    medium = Medium(jnp.asarray([[0, 0, 0], [width, width, tau]], jnp.float32), jnp.ones(3), jnp.zeros(3), jnp.float32(0))
    nodes, weights = np.polynomial.legendre.leggauss(6)
    mu, phi = (a.ravel() for a in np.meshgrid(0.5 * (nodes + 1), (np.arange(6) + 0.5) / 3 * np.pi, indexing="ij"))
    flux = np.repeat(0.5 * weights, 6) * 2 * mu / 6  # of a unit irradiance
    r = np.sqrt(1 - mu * mu)
    direction = np.stack([r * np.cos(phi), r * np.sin(phi), mu], 1)
    suns = DirectionalLights(
        jnp.asarray(direction, jnp.float32), jnp.asarray(np.repeat((flux / mu)[:, None], 3, 1), jnp.float32)
    )
    scene = Scene(medium=medium, directional_lights=suns)
    options = {"view_step": 0.25}  # fewer rays than the default sample grazing light too coarsely: 1.5 % of the power lost
    plan = lattice_boltzmann.plan(scene, None, resolution=round(width * count / tau), **options)
    light = lattice_boltzmann.illuminate(scene, plan)
    straight = float(np.sum(flux * np.exp(-tau / mu)))
    down = experiment("lattice_accuracy").exitance(scene, plan, light, tau, width, 1) + straight
    return down, experiment("lattice_accuracy").exitance(scene, plan, light, tau, width, 0)


@pytest.mark.slow
def test_diffuse_light_through_a_slab(diffusely_lit_slab):
    assert diffusely_lit_slab[0] == pytest.approx(0.55341, rel=0.03)


@pytest.mark.slow
def test_diffuse_light_back_from_a_slab(diffusely_lit_slab):
    assert diffusely_lit_slab[1] == pytest.approx(1 - 0.55341, rel=0.03)
