"""The fixed point of the lattice: conservation, symmetry, equality of every way to reach it, gradients."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxvol.methods.lattice_boltzmann import marching, preconditioner, stepping
from jaxvol.methods.lattice_boltzmann.lattice import LATTICES, coefficients
from jaxvol.methods.lattice_boltzmann.materials import Grid, Materials
from jaxvol.methods.lattice_boltzmann.solver import solve
from jaxvol.methods.lattice_boltzmann.sweeps import transport

SHAPE = (8, 9, 10)
ALBEDO = 0.9


@pytest.fixture(scope="module")
def medium():
    rng = np.random.default_rng(3)
    extinction = jnp.asarray(rng.random(SHAPE) ** 3, jnp.float32).at[3:5, 3:5, 3:5].set(0.0)  # with a void
    deposit = jnp.asarray(rng.random(SHAPE), jnp.float32)
    return extinction, deposit


def _solve(name, extinction, deposit, albedo=ALBEDO, preconditioned=True, **options):
    co = coefficients(LATTICES[name], extinction * albedo, extinction * (1 - albedo), **options)
    levels = preconditioner.build(deposit.shape, extinction, extinction * (1 - albedo)) if preconditioned else None
    return co, solve(LATTICES[name], co, deposit, tolerance=1e-6, levels=levels)


_solve_jit = jax.jit(_solve, static_argnums=0, static_argnames=("preconditioned", "kind"))


@pytest.mark.parametrize(("name", "kind"), [("paper", "pade"), ("26", "exp")])
def test_every_way_to_the_fixed_point_agrees_and_conserves(medium, name, kind):
    extinction, deposit = medium
    co, solution = _solve_jit(name, extinction, deposit, kind=kind)
    assert bool(solution.converged) and float(solution.residual) < 2e-6
    stepped = jax.jit(stepping.iterate, static_argnums=0, static_argnames="check_every")(
        LATTICES[name], co, deposit, threshold=1e-7, check_every=20
    )
    np.testing.assert_allclose(stepped.phi, solution.phi, rtol=2e-4, atol=1e-5 * float(jnp.max(solution.phi)))
    absorbed = float(jnp.sum(co.absorption * stepped.phi))
    escaped = float(stepping.escaping(LATTICES[name], stepped.outgoing))
    assert absorbed + escaped == pytest.approx(float(jnp.sum(deposit)), rel=1e-5)


def test_blocks_have_the_same_fixed_point(medium):
    extinction, deposit = medium
    co, solution = _solve_jit("paper", extinction, deposit)
    blocks = jax.jit(stepping.iterate_blocks, static_argnums=0, static_argnames=("num_exchanges", "inner"))(
        LATTICES["paper"], co, deposit, num_exchanges=60, inner=3
    )
    np.testing.assert_allclose(blocks.phi, solution.phi, rtol=1e-3, atol=1e-4 * float(jnp.max(solution.phi)))


def test_one_impulse_added_up_is_the_steady_source(medium):
    extinction, deposit = medium
    lat = LATTICES["paper"]
    co = coefficients(lat, extinction * ALBEDO, extinction * (1 - ALBEDO))
    none = jnp.zeros_like(deposit)
    num = 12
    impulse = stepping.steps(lat, co, none, stepping.start(lat, SHAPE), 0)
    once = jax.jit(stepping._step, static_argnums=0)
    dark = stepping.start(lat, SHAPE)
    impulse = once(lat, stepping._tables(lat, co, deposit), dark, dark)
    steady, accumulated = impulse, stepping.phi_of(lat, co, deposit, impulse)
    for _ in range(num):
        impulse = once(lat, stepping._tables(lat, co, none), impulse, dark)
        steady = once(lat, stepping._tables(lat, co, deposit), steady, dark)
        accumulated = accumulated + stepping.phi_of(lat, co, none, impulse)
    exact = stepping.phi_of(lat, co, deposit, steady)
    assert float(jnp.linalg.norm(accumulated - exact) / jnp.linalg.norm(exact)) < 1e-5


def test_marching_and_diffusing_in_turn_changes_nothing():
    """Table I: whatever the length of the ray history buffer, the steady state is that of marching first."""
    shape = (8, 8, 8)
    lat = LATTICES["paper"]
    grid = Grid(jnp.zeros(3), jnp.float32(1.0), shape)
    scattering, absorption = jnp.full((1, *shape), 0.4), jnp.full((1, *shape), 0.1)
    materials = Materials(grid, scattering, absorption, None, None, None)
    rng = np.random.default_rng(0)
    origin = np.concatenate([rng.random((500, 2)) * 8, np.full((500, 1), -3.0)], axis=1)
    direction = np.tile([0.28, 0.0, 0.96], (500, 1))
    rays = (origin, direction, np.full(500, np.inf), np.full((500, 1), 0.002))
    co = coefficients(lat, scattering[0], absorption[0])
    track = marching.march_straight(materials, *rays).track
    apart = jax.jit(stepping.iterate, static_argnums=0, static_argnames="threshold")(
        lat, co, scattering[0] * track[0], threshold=1e-6
    )
    for k in (2, 5):
        rounds = [(count, scattering[0] * t[0]) for count, t in marching.march_straight_by(materials, *rays, num_steps=k)]
        assert len(rounds) > 8 // k and rounds[0][0] > 300 and rounds[-1][0] == 0
        mixed = stepping.interleave(lat, co, [deposit for _, deposit in rounds], threshold=1e-6)
        assert bool(mixed.converged)
        np.testing.assert_allclose(mixed.phi, apart.phi, rtol=2e-4)


@pytest.mark.parametrize("name", ["paper", "26"])
def test_transport_is_symmetric(medium, name):
    extinction, a = medium
    b = a[::-1, :, ::-1] ** 2
    wall = jnp.zeros(SHAPE, bool).at[0].set(True)
    co = coefficients(LATTICES[name], extinction * 0.8, extinction * 0.2, wall=wall, wall_reflectance=0.5)
    apply = jax.jit(transport, static_argnums=0)
    forward = float(jnp.sum(b * apply(LATTICES[name], co, a)))
    assert forward == pytest.approx(float(jnp.sum(a * apply(LATTICES[name], co, b))), rel=1e-5)


def test_cube_symmetry():
    """The fluence of a symmetric source in a homogeneous cube has the symmetry of the cube."""
    deposit = jnp.zeros((9, 9, 9)).at[4, 4, 4].set(1.0)
    _, solution = _solve_jit("26", jnp.asarray(0.4), deposit, jnp.asarray(ALBEDO))
    for turned in (jnp.transpose(solution.phi, (1, 2, 0)), solution.phi[::-1], jnp.rot90(solution.phi)):
        np.testing.assert_allclose(turned, solution.phi, rtol=1e-4, atol=1e-7)


def test_dark_media_need_few_applications():
    """Albedo 0.04: hardly more than the one sweep that it could be cut to, at a residual of 1e-6."""
    deposit = jnp.zeros((9, 9, 9)).at[4, 4, 4].set(1.0)
    _, solution = _solve_jit("26", jnp.asarray(0.4), deposit, jnp.asarray(0.04))
    assert bool(solution.converged) and int(solution.num_applications) <= 6


@pytest.mark.parametrize("name", ["paper", "26"])
def test_few_applications_at_high_albedo(name):
    """A beam in a cube of thickness 16 and albedo 0.99, homogeneous and with a hole: 8 and 15, as at any resolution."""
    n, x = 24, 16 / 24
    depth = jnp.exp(-x * jnp.arange(n))
    deposit = jnp.zeros((n, n, n)).at[9:15, 9:15].set(depth)
    lat = LATTICES[name]

    @jax.jit
    def run(extinction):
        co = coefficients(lat, 0.99 * extinction, 0.01 * extinction)
        levels = preconditioner.build(deposit.shape, extinction, 0.01 * extinction)
        return solve(lat, co, deposit * extinction, levels=levels)

    even = jnp.full((n, n, n), x)
    for extinction, most in ((even, 8), (even.at[6:18, 12:20, 4:12].multiply(0.02), 15)):
        found = run(extinction)
        assert bool(found.converged) and float(found.residual) < 2e-4 and int(found.num_applications) <= most


def test_preconditioner_is_symmetric_and_positive(medium):
    extinction, a = medium
    b = a[::-1, :, ::-1] ** 2 - 0.3
    levels = preconditioner.build(SHAPE, extinction, 0.1 * extinction)
    cycle = jax.jit(preconditioner.v_cycle)
    assert float(jnp.sum(b * cycle(levels, a))) == pytest.approx(float(jnp.sum(a * cycle(levels, b))), rel=1e-4)
    assert float(jnp.sum(b * cycle(levels, b))) > 0


def test_diffuse_walls_conserve_and_close():
    """From a closed white box with absorption nothing escapes."""
    shape = (6, 6, 6)
    wall = jnp.ones(shape, bool).at[1:-1, 1:-1, 1:-1].set(False)
    deposit = jnp.zeros(shape).at[2, 3, 3].set(1.0)
    co = coefficients(LATTICES["26"], jnp.full(shape, 0.3), jnp.full(shape, 0.1), wall=wall, wall_reflectance=1.0)
    solution = jax.jit(solve, static_argnums=0)(LATTICES["26"], co, deposit, tolerance=1e-6)
    assert bool(solution.converged)
    assert float(jnp.sum(co.absorption * solution.phi)) == pytest.approx(1.0, rel=1e-4)


def test_white_furnace():
    """T1: between closed white walls without absorption a uniform arrival on every link stays as it is."""
    shape = (5, 6, 7)
    lat = LATTICES["paper"]
    wall = jnp.ones(shape, bool).at[1:-1, 1:-1, 1:-1].set(False)
    inner = np.zeros(shape, bool)
    inner[1:-1, 1:-1, 1:-1] = True
    co = coefficients(lat, jnp.where(wall, 0.0, 0.6), jnp.zeros(shape), wall=wall, wall_reflectance=1.0)
    # six directions: each face voxel of the wall has one link to the medium and four along the wall
    arrivals = 1.0
    phi_medium = 6 * arrivals
    source = jnp.asarray(np.where(inner, 0.6 * phi_medium, 6.0 * arrivals), jnp.float32)
    phi = transport(lat, co, source)
    np.testing.assert_allclose(phi[2:-2, 2:-2, 2:-2], phi_medium, rtol=1e-5)
    np.testing.assert_allclose(phi[1:-1, 1:-1, 1:-1], phi_medium, rtol=1e-5)


def test_albedo_one_in_an_open_box():
    deposit = jnp.zeros((8, 8, 8)).at[4, 4, 4].set(1.0)
    _, solution = _solve_jit("26", jnp.asarray(0.5), deposit, jnp.asarray(1.0))
    assert bool(solution.converged) and bool(jnp.all(solution.phi > 0))


def test_gradient_of_the_solve_against_finite_differences(medium):
    extinction, deposit = medium
    weight = jnp.linspace(0.0, 1.0, SHAPE[0])[:, None, None]

    @jax.jit
    @jax.value_and_grad
    def response(albedo):
        return jnp.sum(weight * _solve("26", extinction, deposit, albedo)[1].phi)

    step = 0.01
    _, gradient = response(jnp.asarray(0.9))
    high, low = response(jnp.asarray(0.9 + step))[0], response(jnp.asarray(0.9 - step))[0]
    assert float(gradient) == pytest.approx(float((high - low) / (2 * step)), rel=1e-2)


def test_slopes_by_the_scattering_of_empty_voxels():
    """sqrt(k) has none at 0: light that a little of the medium would scatter in a void, once and again."""
    rng = np.random.default_rng(5)
    void = jnp.zeros((4, 4, 4)).at[1:3, 1:3, 1:3].set(1.0)
    filled, deposit = (jnp.asarray(x, jnp.float32) for x in rng.random((2, 4, 4, 4)))

    @jax.jit
    def light(amount):
        def parts(amount):
            co = coefficients(LATTICES["paper"], jnp.where(void > 0, amount, 0.7 * filled), jnp.full((4, 4, 4), 0.05))
            found = solve(LATTICES["paper"], co, deposit * (void == 0), tolerance=1e-6)
            return jnp.stack([jnp.sum(found.phi_first), jnp.sum(found.phi)])

        return jax.jvp(parts, (amount,), (jnp.float32(1.0),))

    _, slope = light(jnp.float32(0.0))
    (high, _), (low, _) = light(jnp.float32(0.02)), light(jnp.float32(0.01))
    (dark, _) = light(jnp.float32(0.0))
    expected = (4.0 * low - high - 3.0 * dark) / 0.02  # one-sided, second order
    np.testing.assert_allclose(slope, expected, rtol=2e-2)


def test_two_albedos_compile_once():
    lat = LATTICES["paper"]
    traces = []

    @jax.jit
    def run(albedo):
        traces.append(1)
        co = coefficients(lat, 0.3 * albedo, 0.3 * (1 - albedo))
        return solve(lat, co, jnp.ones((4, 4, 4))).phi

    run(jnp.float32(0.5)), run(jnp.float32(0.6))
    assert len(traces) == 1
