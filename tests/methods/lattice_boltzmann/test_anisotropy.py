"""Scattering that depends on direction: the Theta of moments, its solve, and the exact first order in the picture."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
import pytest

from jaxvol import camera as cameras
from jaxvol import direct, phase
from jaxvol.methods import lattice_boltzmann
from jaxvol.methods.lattice_boltzmann import anisotropy, fine_sweeps, illumination, materials, preconditioner, view
from jaxvol.methods.lattice_boltzmann.krylov import BiconjugateGradients
from jaxvol.methods.lattice_boltzmann.lattice import LATTICES, coefficients
from jaxvol.methods.lattice_boltzmann.solver import solve
from jaxvol.types import Camera, DirectionalLights, Medium, Rays, Scene

LATTICE = LATTICES["26"]


@pytest.mark.parametrize("degree", [1, 2, 3])
def test_theta_loses_only_what_is_absorbed_and_keeps_the_mean_cosine(degree):
    scattering, absorption, g = 0.4, 0.1, 0.6
    matrix = anisotropy.theta(LATTICE, scattering, absorption, g, degree)
    lengths, weights = LATTICE.lengths, LATTICE.weights
    x = (scattering + absorption) * lengths
    beta = 1 / (1 + x / 2)
    emitted = np.sum(weights * beta)  # what a source's watt sends into the links; the rest stays in the voxel
    np.testing.assert_allclose(matrix.sum(axis=0), 1 - x * beta + scattering * lengths * beta * emitted, atol=2e-2 * scattering)
    # Legendre moments of one voxel's phase function between links, lambda_l, by the links' own quadrature
    unit = np.array(LATTICE.directions) / lengths[:, None]
    phase = (matrix - np.diag(1 - x * beta)) / np.outer(weights * beta, scattering * lengths * beta)
    f = g ** (degree + 1)
    for j in (0, 7, 25):
        assert np.sum(weights * phase[:, j]) == pytest.approx(1, abs=1e-6)
        assert np.sum(weights * phase[:, j] * (unit @ unit[j])) == pytest.approx((g - f) / (1 - f), abs=1e-6)


def test_without_a_preferred_direction_it_is_the_isotropic_lattice():
    shape = (7, 8, 9)
    rng = np.random.default_rng(0)
    scattering, absorption = jnp.asarray(rng.random(shape), jnp.float32), jnp.full(shape, 0.1)
    deposit = jnp.asarray(rng.random(shape), jnp.float32)
    sources = jnp.zeros((4, *shape)).at[0].set(deposit)
    run = jax.jit(lambda g: anisotropy.solve(LATTICE, scattering, absorption, g, sources, degree=1, tolerance=1e-6))
    found = run(jnp.zeros(shape))
    levels = preconditioner.build(shape, scattering + absorption, absorption)
    exact = jax.jit(
        lambda: solve(LATTICE, coefficients(LATTICE, scattering, absorption), deposit, tolerance=1e-6, levels=levels)
    )()
    assert bool(found.converged)
    np.testing.assert_allclose(found.moments[0], exact.phi, rtol=1e-4)
    forward = run(jnp.full(shape, 0.5))
    assert bool(forward.converged) and float(jnp.max(jnp.abs(forward.moments[0] / exact.phi - 1))) > 0.02


def test_first_collisions_of_a_beam_have_the_moments_of_its_direction():
    direction = np.array([0.48, -0.6, 0.64])
    track = jnp.full((2, 2, 2), 3.0)
    flow = jnp.asarray(direction, jnp.float32)[:, None, None, None] * track
    g = jnp.full((2, 2, 2), 0.5)
    found = anisotropy.first_collisions(jnp.full((2, 2, 2), 0.2), track, flow, g, 2)
    f = 0.125
    scale = [1.0, (0.5 - f) / (1 - f), (0.25 - f) / (1 - f)]
    expected = [0.6 * scale[l] * y for l, y in zip(anisotropy.orders(2), anisotropy.basis(*direction, 2), strict=True)]
    np.testing.assert_allclose(found[:, 0, 1, 0], expected, rtol=1e-5, atol=1e-6)


def test_biconjugate_gradients_solve_what_is_not_symmetric():
    rng = np.random.default_rng(1)
    matrix = jnp.asarray(np.eye(30) + 0.3 * rng.normal(size=(30, 30)) / np.sqrt(30), jnp.float32)
    right = jnp.asarray(rng.normal(size=30), jnp.float32)
    answer = lx.linear_solve(lx.MatrixLinearOperator(matrix), right, BiconjugateGradients(tolerance=1e-6, max_steps=60))
    np.testing.assert_allclose(answer.value, np.linalg.solve(np.asarray(matrix, float), right), rtol=1e-3, atol=1e-4)


def _thin(g, sigma_s=0.03):
    medium = Medium(jnp.asarray([[0.0, 0, 0], [1, 1, 1]]), jnp.full(3, sigma_s), jnp.full(3, 0.01), jnp.float32(g))
    sun = DirectionalLights(jnp.asarray([[0.0, 0.0, -1.0]]), jnp.ones((1, 3)))
    return Scene(medium=medium, directional_lights=sun)


def _camera(origin, size=6):
    return Camera(jnp.asarray(cameras.look_at(origin, [0.5, 0.5, 0.5], [0, 1, 0])), jnp.float32(0.3), size, size)


@pytest.mark.parametrize("anisotropy", ["first_order", "directional"])
def test_thin_media_scatter_by_the_exact_phase_function(anisotropy):
    """Against single scattering by quadrature (`direct`), towards the light and away from it, 10 to 1 apart."""
    scene = _thin(0.6)
    for origin in ([0.5, 0.6, 3.0], [0.6, 0.5, -2.0]):
        camera = _camera(origin)
        options = {"resolution": 12, "samples_per_pixel": 1, "view_step": 0.5, "anisotropy": anisotropy}
        found = lattice_boltzmann.render(scene, camera, lattice_boltzmann.plan(scene, camera, **options))
        (ours,) = (np.asarray(v) for v in found.mean.sums.values())
        exact = np.asarray(direct.render(scene, camera, direct.plan(scene, camera, samples_per_pixel=4)).mean.volume_from_light)
        # what is left is light that was scattered twice
        assert 0.97 * exact.sum() < ours.sum() < 1.06 * exact.sum()


@pytest.mark.slow
def test_reflectance_of_a_slab_that_scatters_forwards():
    """T4: g = 0.75, thickness 2, albedo 1, light along the normal: R = 0.163176; similarity .203, moments of degree 1 .177."""
    tau, width, count = 2.0, 20.0, 8
    medium = Medium(jnp.asarray([[0, 0, 0], [width, width, tau]], jnp.float32), jnp.ones(3), jnp.zeros(3), jnp.float32(0.75))
    scene = Scene(medium=medium, directional_lights=DirectionalLights(jnp.asarray([[0.0, 0, 1]]), jnp.ones((1, 3))))
    plan = lattice_boltzmann.plan(
        scene, None, resolution=round(width * count / tau), rays_per_voxel=1.0, view_step=0.25, degree=2
    )
    light = lattice_boltzmann.illuminate(scene, plan)
    assert bool(light.diagnostics["converged"])
    nodes, weights = np.polynomial.legendre.leggauss(12)
    mu, phi = (a.ravel() for a in np.meshgrid(0.5 * (nodes + 1), (np.arange(8) + 0.5) / 4 * np.pi, indexing="ij"))
    r = np.sqrt(1 - mu * mu)
    up = np.stack([r * np.cos(phi), r * np.sin(phi), mu], 1)
    origin = np.array([width / 2, width / 2, 0.0]) - 1e-3 * up
    rays = Rays(*(jnp.asarray(x, jnp.float32) for x in (origin, up, np.full(len(mu), np.inf))))
    (radiance,) = (v[:, 0] for v in lattice_boltzmann.radiance(scene, rays, plan, light).values())
    reflectance = float(np.sum(radiance * np.repeat(0.5 * weights, 8) * mu) * 2 * np.pi / 8)
    assert reflectance == pytest.approx(0.163176, rel=0.02)


def test_corrections_along_many_directions_agree_where_nothing_is_left_to_correct():
    """Moments by 72 directions against 26 for a source that fills a cube: equal to 3 %; isotropic ones as without moments."""
    shape = (9, 9, 9)
    rng = np.random.default_rng(0)
    sigma = jnp.asarray(0.3 + 0.2 * rng.random(shape), jnp.float32)
    source = jnp.asarray(rng.random(shape), jnp.float32)
    sources = jnp.zeros((4, *shape)).at[0].set(source).at[3].set(0.4 * source)
    fine = jax.jit(lambda s: fine_sweeps.moments(sigma, s, degree=1))(sources)
    coarse = jax.jit(lambda s: anisotropy.transport(LATTICE, sigma, s, degree=1))(sources)
    size = float(jnp.mean(fine[0]))
    np.testing.assert_allclose(jnp.mean(fine, axis=(1, 2, 3)) / size, jnp.mean(coarse, axis=(1, 2, 3)) / size, atol=0.03)
    alone = fine_sweeps.transport(sigma, source)
    with_moments = fine_sweeps.moments(sigma, sources.at[3].set(0.0), degree=1)
    np.testing.assert_allclose(with_moments[0], alone, rtol=1e-4)


@pytest.mark.parametrize("g", [-0.99, 0.6])
def test_light_from_half_the_sky_is_scattered_no_brighter_than_the_sky(g):
    """4 pi p of spread light: the exact one for a beam, normalised, and below 1 / (1 - s); along the axis of half a sky 2 F."""
    medium = Medium(jnp.asarray([[0.0] * 3, [1.0] * 3]), jnp.ones(3), jnp.zeros(3), jnp.float32(g))
    parts = [medium]
    if g > 0:
        parts.append(replace(medium, g=jnp.float32(0), phase=phase.phase_table(phase.moments(medium, 64))))
    cosine = jnp.linspace(-1.0, 1.0, 2001)
    for part in parts:
        np.testing.assert_allclose(view._spread(part, cosine, 1.0), 4 * np.pi * phase.evaluate(part, cosine), rtol=0.02)
        for straightness in (0.95, 0.5, 0.0):
            found = np.asarray(view._spread(part, cosine, straightness))
            assert 0.5 * np.trapezoid(found, cosine) == pytest.approx(1, abs=0.01)
            assert found.max() < 1.001 / (1 - straightness)
    # the share F of scattered light that stays in the half sky, or goes back into it
    size = abs(g)
    share = (1 - g * g) / (2 * size) * (1 / (1 - size) - 1 / np.sqrt(1 + g * g))
    assert float(view._spread(medium, jnp.sign(jnp.float32(g)), 0.5)) == pytest.approx(2 * share, rel=0.15)


def test_plan_refuses_what_directions_cannot_do():
    scene = _thin(0.5)
    with pytest.raises(ValueError, match="needs lattice = '26'"):
        lattice_boltzmann.plan(scene, None, resolution=8, anisotropy="directional", lattice="paper")
    with pytest.raises(ValueError, match="anisotropy = 'exact' must be one of"):
        lattice_boltzmann.plan(scene, None, resolution=8, anisotropy="exact")
    assert lattice_boltzmann.plan(_thin(0.0), None, resolution=8, anisotropy="directional").degree == 0


def test_moments_of_scattering_never_exceed_one():
    """Beyond one they make light: a forward part g^(degree + 1) of backward scattering gave -500 at g = -.999."""
    g = jnp.linspace(-0.999, 0.999, 101)
    for degree in range(4):
        scales = jnp.stack(anisotropy.eigenvalues(g, degree))
        assert float(jnp.max(jnp.abs(scales))) <= 1 + 1e-5
        part = materials.forward_part(g, degree)
        assert np.allclose((1 - part) * scales + part, [g**l for l in range(degree + 1)], atol=1e-5)


def test_track_beside_denser_voxels():
    """A voxel filled by a tenth holds ten times the track where it is dense, and as much as the others where all is thin."""
    share = jnp.ones((1, 4, 4, 4)).at[:, 0].set(0.1)
    for density, expected in ((1e3, 0.1), (1e-3, 1.0)):
        found = illumination._beside_denser(density * share)
        np.testing.assert_allclose(found[0, 0], expected, rtol=2e-3)
        np.testing.assert_allclose(found[0, 1:], 1.0, rtol=1e-6)


def test_a_white_voxel_as_thick_as_float32_has_digits_lets_all_light_out():
    """One voxel of 1e7 mean free paths against the closed form; 1 less what stays in it has no digits in float32."""
    thickness = 1e7
    full = lambda x: jnp.full((1, 1, 1), x, jnp.float32)  # noqa: E731
    solve = jax.jit(partial(anisotropy.solve, LATTICE, degree=0, kind="exp"))
    found = solve(full(thickness), full(0.0), full(0.0), full(1.0)[None])
    assert bool(found.converged)
    assert float(found.moments[0, 0, 0, 0]) == pytest.approx(1.0 / np.sum(LATTICE.weights / LATTICE.lengths), rel=1e-3)
