"""Scenes on purpose and by chance: their forms are what they say, the checks find what they look for, physics stays finite."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxvol import extinction, interval_map, media, phase, transmittance
from jaxvol.direct import cells
from jaxvol.layers import items
from jaxvol.methods.deep_screen_space import kernel
from jaxvol.methods.path_tracing import flight
from jaxvol.scene import make_scene
from jaxvol.stress import checks, driver, extremes, gradients, scenes
from jaxvol.types import Layers, Medium

FEW = settings(max_examples=60, deadline=None)


# --- scenes


def test_every_scene_is_taken_in_every_form():
    for number in range(3 * len(scenes.CLASSES)):
        name, config = scenes.random_scene(number)
        assert name == tuple(scenes.CLASSES)[number % len(scenes.CLASSES)]
        for form in (
            config,
            scenes.in_units(config, 2.0**17),
            scenes.turned(config, np.ones(3)),
            scenes.with_light(config, 4.0),
        ):
            make_scene(form)
    names = [name for name, config in extremes.extremes() if make_scene(config)]
    assert len(names) == len(set(names)) > 40


def test_a_class_is_one_structure():
    """Floats differ, shapes do not: hundreds of scenes share a few compilations."""
    for name in scenes.CLASSES:
        forms = {jax.tree.structure(make_scene(scenes.draw(name, np.random.default_rng(seed))).scene) for seed in range(4)}
        assert len(forms) <= 3, name  # majorant grids may have three sizes


def test_turning_four_times_is_no_turn():
    _, config = scenes.random_scene(2)
    turned = config
    for _ in range(4):
        turned = scenes.turned(turned, np.zeros(3))
    a, b = make_scene(config).scene, make_scene(turned).scene
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        np.testing.assert_allclose(np.asarray(x), np.asarray(y), rtol=1e-5, atol=1e-6)


# --- checks


def test_checks_find_what_they_look_for():
    good = Layers(emission=jnp.ones((2, 2, 3)))
    assert checks.sound(good) is None
    assert "not finite" in checks.sound(Layers(emission=jnp.full((2, 2, 3), jnp.nan)))
    assert "least value -1" in checks.sound(Layers(emission=-jnp.ones((2, 2, 3))))
    assert checks.differs(np.ones(4), np.ones(4)) is None and "0.1" in checks.differs(np.ones(4), np.full(4, 0.9))
    faint = 1e-28 * np.ones(4), 2e-28 * np.ones(4)
    assert "0.5" in checks.differs(*faint) and checks.differs(*faint, dark=1e-27) is None
    assert "0.5" in checks.differs(*faint, dark=1.5e-28)  # one of them is not dark


def test_pictures_are_dark_against_their_own_light():
    """Brightness is linear in light, the same in any unit, and that of the brightest light."""
    for number in range(len(scenes.CLASSES)):
        _, config = scenes.random_scene(number)
        bright = checks.brightest(config)
        assert bright > 0
        assert checks.brightest(scenes.with_light(config, 4.0)) == pytest.approx(4 * bright)
        assert checks.brightest(scenes.in_units(config, 2.0**17)) == pytest.approx(bright)
    lamp = {"camera": {"origin": [0, 0, 2], "target": [0, 0, 0]}, "shapes": [], "lights": []}
    assert checks.brightest(lamp) == 0.0
    assert checks.brightest(lamp | {"lights": [{"intensity": [1, 8, 2]}, {"radiance": [1, 1, 1]}]}) == 2.0


@pytest.mark.parametrize(
    ("wrong", "complaint"),
    [
        (lambda config, seed: config["lights"][0]["intensity"].sum() ** 2, "light x 4"),
        (lambda config, seed: np.linalg.norm(config["camera"]["origin"]), "lengths x"),
        (lambda config, seed: 1.0 + abs(config["camera"]["origin"][0]) + 1e-3 * seed, "turned"),
    ],
)
def test_a_wrong_method_is_caught(monkeypatch, wrong, complaint):
    """Methods that are not linear, not free of units, not the same for a turned scene."""
    rendered = lambda config, method, seed=0: Layers(emission=jnp.full((2, 2, 3), float(wrong(config, seed))))  # noqa: E731
    monkeypatch.setattr(checks, "render", rendered)
    config = scenes.draw("fog_point", np.random.default_rng(1))
    config["lights"][0]["intensity"] = np.ones(3)
    found = driver.run_case(config, 0, "fog_point", "any")
    assert any(complaint in line for line in found["failed"])


def test_light_from_nothing_is_caught(monkeypatch):
    monkeypatch.setattr(checks, "render", lambda config, method, seed=0: Layers(emission=jnp.full((2, 2, 3), 1.1)))
    config = scenes.draw("fog_furnace", np.random.default_rng(1))
    assert any("their mean 1.1" in line for line in driver.run_case(config, 8, "fog_furnace", "any")["failed"])


@jax.jit
def stage(numbers, count):
    """The first slope is infinite where a number is zero, the second, of a sum that names its type, nowhere."""
    zero = jnp.zeros(numbers.shape, jnp.float32)
    total, _ = jax.lax.scan(lambda total, _: (total + jnp.sin(numbers), None), zero, None, length=1)
    return jnp.sqrt(numbers) * count, total, count


def test_slopes_that_are_not_finite_are_found(monkeypatch):
    """In stages of any module, at the inputs they were given; once for each shape, and not inside another stage."""
    monkeypatch.setattr(phase, "stage", stage, raising=False)
    for numbers, complaint in (([1.0, 2.0, 3.0], None), ([1.0, 0.0, 3.0], "stage: 1 of 3 slopes of output 0")):
        with gradients.recording() as stages:
            for _ in range(2):
                phase.stage(jnp.asarray(numbers), 3)
            jax.jit(lambda x: phase.stage(x, 3))(jnp.asarray(numbers))
        assert len(stages) == 1
        found = gradients.finite(stages)
        assert found is None if complaint is None else complaint in found
    assert phase.stage is stage


def test_slopes_are_those_of_float64_and_of_differences():
    """One direction, both precisions; integers are no parameters."""
    key, told = "stage", gradients.Stage("stage", stage.__wrapped__, ((np.array([1.0, 2.0], np.float32), np.int32(3)), {}))
    values, slopes = gradients.derivative(key, told)
    with jax.enable_x64(True):
        exact, right = gradients.derivative(key, told, kind=np.float64)
        differences = gradients.differences(told)
    assert [x.dtype for x in (*values, *slopes, *exact, *right)] == [np.float32] * 4 + [np.float64] * 4
    for found, wanted in zip((*values, *slopes), (*exact, *right), strict=True):
        np.testing.assert_allclose(found, wanted, rtol=1e-6)
    along = right[0] * 2 * np.sqrt([1.0, 2.0]) / 3
    np.testing.assert_allclose(right[1], np.cos([1.0, 2.0]) * along)
    for found, wanted in zip(differences, right, strict=True):
        np.testing.assert_allclose(found, wanted, rtol=1e-7)


def test_a_crash_is_a_failure_and_a_refusal_is_none(monkeypatch):
    def crash(config, method, seed=0):
        raise IndexError("out of range")

    config = scenes.draw("fog_point", np.random.default_rng(1))
    monkeypatch.setattr(checks, "render", crash)
    assert driver.run_case(config, 0, "fog_point", "any")["failed"] == ["raised IndexError: out of range"]
    monkeypatch.undo()
    assert "mesh is missing" in driver.run_case(config, 0, "fog_point", "impulse_response")["refused"]


def test_a_stopped_run_goes_on(tmp_path, monkeypatch):
    calls = []

    def run_case(config, number, name, method, *, differentiated=False):
        calls.append(number)
        return {"failed": [], "passed": ["sound"], "seconds": 0.0}

    monkeypatch.setattr(driver, "run_case", run_case)
    first = driver.run(tmp_path, first=0, num=3, methods=("direct",))
    again = driver.run(tmp_path, first=0, num=5, methods=("direct",))
    assert len(again) == len(first) + 2 == len(calls)
    assert "direct" in driver.table(again) and not driver.failures(again)


def test_scenes_are_drawn_until_enough_are_taken(tmp_path, monkeypatch):
    """Two of five classes refused: 30 are taken all the same, apart from the refused; a method that takes none ends."""
    monkeypatch.setattr(driver, "extreme_cases", list)

    def run_case(config, number, name, method, *, differentiated=False):
        if method == "impulse_response" and number % 5 < 2 or method == "lattice_boltzmann":
            return {"refused": "no"}
        return {"failed": [], "passed": ["sound"], "seconds": 0.0}

    monkeypatch.setattr(driver, "run_case", run_case)
    for method, most in (("direct", 30), ("impulse_response", 60), ("lattice_boltzmann", 120)):
        found = driver.run(tmp_path, first=7, num=30, methods=(method,))
        taken = sum("refused" not in r for r in found)
        assert taken >= 30 if method != "lattice_boltzmann" else taken == 0 and len(found) == 4 * 30
        assert [r["case"] for r in found] == [f"random {k}" for k in range(7, 7 + len(found))] and len(found) <= most


@pytest.mark.parametrize("method", ("direct", "deep_screen_space"))
def test_the_worst_of_the_past(method):
    """Scenes in which methods once failed: tiny units with lights beside the eye ray, a cloud too thick for any sample."""
    found = dict(extremes.extremes())
    name = {"direct": "scene scale 1e-06, fog", "deep_screen_space": "optical depth 1e+06, grid"}[method]
    record = driver.run_case(found[name], None, "extreme", method)
    assert not record["failed"], record["failed"]


# --- physics at the ends of its ranges: values and gradients


def tiny_medium(sigma, g, density=None):
    density = None if density is None else jnp.asarray(density, jnp.float32)
    return Medium(
        bounds=jnp.asarray([[-1.0] * 3, [1.0] * 3]),
        sigma_s=jnp.full(3, 0.5 * sigma, jnp.float32),
        sigma_a=jnp.full(3, 0.5 * sigma, jnp.float32),
        g=jnp.float32(g),
        density=density,
        majorants=None if density is None else media.majorants(density),
    )


@FEW
@given(st.floats(-0.999, 0.999), st.floats(-1.0, 1.0))
def test_henyey_greenstein_is_finite_with_its_gradient_and_right(g, cosine):
    value, slope = jax.value_and_grad(phase.henyey_greenstein, argnums=1)(jnp.float32(cosine), jnp.float32(g))
    a, c = float(np.float32(g)), float(np.float32(cosine))
    exact = (1 - a * a) / (4 * np.pi * (1 + a * a - 2 * a * c) ** 1.5)
    assert np.isfinite(value) and np.isfinite(slope)
    assert abs(float(value) / exact - 1) < 5e-3  # at g = .999 float32 holds 1 - g to 6e-5


@jax.jit
def through_with_gradients(sigma, grid, medium):
    """Transmittance along a ray through the box, and its derivatives by sigma and by every voxel."""
    origin, direction = jnp.asarray([[-2.0, 0.1, 0.2]]), jnp.asarray([[1.0, 0.0, 0.0]])

    def through(sigma, grid):
        found = eqx.tree_at(lambda m: m.density, medium, grid)
        column = transmittance.density_column(found, origin, direction, jnp.zeros(1), jnp.full(1, 4.0), num_steps=64)
        return jnp.sum(jnp.exp(-sigma * column))

    return jax.value_and_grad(through, argnums=(0, 1))(sigma, grid)


@FEW
@given(st.floats(-12, 6), st.floats(0, 8), st.integers(0, 5))
def test_columns_are_finite_with_their_gradients(exponent, contrast, seed):
    """Optical depth 1e-12 .. 1e6 through a grid of any contrast: float32 against float64, and d/d sigma, d/d density."""
    rng = np.random.default_rng(seed)
    density = (10.0 ** -(contrast * rng.random((3, 3, 3)))).astype(np.float32)
    medium = tiny_medium(10.0**exponent, 0.0, density)
    sigma = jnp.float32(np.mean(np.asarray(media.sigma_t(medium))))
    value, (by_sigma, by_density) = through_with_gradients(sigma, jnp.asarray(density), medium)
    assert 0 <= float(value) <= 1 and np.isfinite(by_sigma) and np.isfinite(np.asarray(by_density)).all()
    assert float(by_sigma) <= 0
    x = np.linspace(-2, 2, 20001)
    inside = np.abs(x) < 1
    points = np.stack([x[inside], np.full(inside.sum(), 0.1), np.full(inside.sum(), 0.2)], axis=-1)
    fine = np.asarray(media.density(medium, jnp.asarray(points, jnp.float32)), np.float64)
    exact = np.exp(-float(sigma) * fine.mean() * 2)
    assert abs(float(value) - exact) < 2e-2 * max(1.0, -np.log(max(exact, 1e-30))) * exact + 1e-6


@FEW
@given(st.floats(-0.999, 0.999), st.floats(-6, 6), st.floats(-6, 2))
def test_the_pair_kernel_is_finite_with_its_gradient(g, log_distance, log_area):
    """A surfel at any distance from the sample, also on it, of any size, any g."""
    d = jnp.full((1, 1), 10.0**log_distance)
    area = 10.0**log_area

    def value(g, d):
        row = dict(
            zip(kernel.COLUMNS, (0.0, 0.0, 0.0, 0.6, 0.0, 0.8, 0.0, np.inf, area / 2 / np.pi, 1.0, 1.0, 1.0), strict=True)
        )
        row = {name: jnp.full((1, 1), v, jnp.float32) for name, v in row.items()}
        ray = tuple(jnp.full((1, 1), v, jnp.float32) for v in (0.0, 0.0, 1.0))
        return jnp.sum(kernel.pair_samples(ray, [d], row, phase="henyey_greenstein", g=g)[0])

    found, slopes = jax.value_and_grad(value, argnums=(0, 1))(jnp.float32(g), d)
    assert np.isfinite(found) and float(found) >= 0
    assert all(np.isfinite(np.asarray(x)).all() for x in slopes)


def test_layers_of_an_empty_scene_are_sound():
    """No light at all: exact zeros, everywhere."""
    config = dict(extremes.extremes())["no light"]
    for name, image in items(checks.render(config, "direct")):
        assert float(np.abs(np.asarray(image)).max()) == 0.0, name


def of_direct(medium):
    """Weights of nodes on an eye ray, `direct`."""
    marching = extinction.marching_medium(medium)
    borders = jnp.linspace(1.0, 3.0, 17)[:, None]
    cut = cells.build(marching, *RAY, borders, None)
    return jnp.sum(cells.place(marching, cut, jnp.linspace(0.05, 0.95, 8)[:, None]).weight)


def of_intervals(medium):
    """Weights and places of samples in drops of transmittance, `deep_screen_space`."""
    found = interval_map.interval_map(medium, *RAY, jnp.ones(1), jnp.full(1, 3.0), num_intervals=4, num_steps=16)
    return jnp.sum(found.weight * found.distance[:, None])


def of_flights(medium):
    """Weights of free flights, `path_tracing`."""
    medium = eqx.tree_at(lambda m: m.density, medium, None, is_leaf=lambda x: x is None)
    u = jnp.linspace(0.05, 0.95, 8)
    spans = jnp.tile(jnp.asarray([[1.0, 3.0]]), (8, 1)), jnp.zeros((8, 1), jnp.int32)
    return jnp.sum(flight.sample_homogeneous(medium, spans, jnp.ones((8, 3)), u, u[::-1])[4])


RAY = jnp.asarray([[-2.0, 0.1, 0.2]]), jnp.asarray([[1.0, 0.0, 0.0]])


@pytest.mark.slow
@pytest.mark.parametrize("stage", [of_direct, of_intervals, of_flights])
def test_float32_is_float64_with_gradients_in_every_parameter(stage):
    """Optical depth 1e-6 to 1e3 through a grid of contrast 1e4: values and slopes by sigma_s, sigma_a and every voxel."""
    density = 10.0 ** (-4.0 * np.random.default_rng(3).random((3, 3, 3)))

    def value(told):
        bounds = jnp.asarray([[-1.0] * 3, [1.0] * 3])
        return stage(Medium(bounds, told["sigma_s"], told["sigma_a"], jnp.float32(0.3), told["density"], None))

    def with_slopes(told, kind):
        return jax.jit(jax.value_and_grad(value))(jax.tree.map(lambda x: jnp.asarray(x, kind), told))

    for tau in (1e-6, 1.0, 1e3):
        told = {"sigma_s": tau * np.array([0.5, 0.3, 0.4]), "sigma_a": tau * np.array([0.1, 0.2, 0.4]), "density": density}
        found, slopes = with_slopes(told, jnp.float32)
        with jax.enable_x64(True):
            exact, right = jax.device_get(with_slopes(told, jnp.float64))
        assert float(found) == pytest.approx(float(exact), rel=2e-3)
        for name, slope in slopes.items():
            assert np.isfinite(slope).all(), (tau, name)
            # What a relative change of the parameter does, to a hundred roundings of the value.
            parts = (np.asarray(x, np.float64) * np.asarray(told[name]) for x in (slope, right[name]))
            np.testing.assert_allclose(*parts, rtol=2e-2, atol=1e-5 * abs(float(exact)), err_msg=f"{name} at {tau}")
