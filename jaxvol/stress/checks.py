"""What must hold for every method in every scene, and how a breach is worded."""

from typing import Any

import jax
import numpy as np

from jaxvol import rendering
from jaxvol.layers import items, total
from jaxvol.scene import make_scene
from jaxvol.stress import gradients, scenes
from jaxvol.types import Layers

# Small enough to be fast, large enough to run every stage.
OPTIONS: dict[str, dict[str, Any]] = {
    "path_tracing": {"samples": 2, "num_lanes": 256, "max_scatterings": 64},
    "direct": {"samples_per_pixel": 2, "volume_samples_per_pixel": 1, "num_sky_directions": 16},
    "deep_screen_space": {
        "num_surfels": 64, "num_levels": 2, "num_intervals": 4, "num_steps": 16, "table_resolution": 4, "light_steps": 8,
    },
    "instant_multiple_scattering": {
        "num_paths": 8, "max_depth": 4, "num_levels": 1, "num_chains": 1, "num_direct": 1, "tile": 64, "eye_steps": 16,
    },
    "impulse_response": {"samples": 1, "max_bounces": 2, "num_lanes": 64},
    "lattice_boltzmann": {"resolution": scenes.PARTS, "surface_rays": 256, "samples_per_pixel": 1, "max_applications": 60},
}  # fmt: skip
METHODS = (*OPTIONS, "auto")
SAME = 2e-3  # relative L1 between pictures that may differ by rounding only
POWER = 4.0  # of light; a power of two, so that rounding stays the same
UNIT = 2.0**17  # of length, or its inverse
DARK = float(np.sqrt(np.finfo(np.float32).tiny))  # 1.1e-19 of the light: products of two such numbers underflow
FURNACE = 0.02  # above 1 by which a picture in a furnace may lie, beyond three standard errors
FAR_TOO_BRIGHT = 1.5
BATCHES = 4
LEAST_P = 1e-6  # of Welch's test of a turned scene


class Refused(Exception):
    """The method says that it cannot do this scene."""


def render(config: scenes.Config, method: str, *, seed: int = 0) -> Layers:
    """The method's layers with the options of the stress test. Raises Refused where the scene or the plan is refused."""
    try:
        if method == "auto":
            file = make_scene(config | {"render": {**OPTIONS, "method": method, "allow_partial": True, "seed": seed}})
            rendering.assign(file, automatic=True)
        else:
            file = make_scene(config | {"render": {method: OPTIONS[method], "seed": seed}})
            module = rendering.load_method(method)
            module.plan(file.scene, file.camera, **rendering.method_arguments(module, method, file)[0])
    except ValueError as error:
        raise Refused(str(error)) from error
    return rendering.render_scene(file, method=method).estimate.mean


def picture(layers: Layers) -> np.ndarray:
    """The sum of all layers in float64."""
    return np.asarray(total(layers), np.float64)


def sound(layers: Layers) -> str | None:
    """Finite and not negative, every layer; None where all is well."""
    for name, image in items(layers):
        values = np.asarray(image)
        if not np.isfinite(values).all():
            return f"{name}: {np.count_nonzero(~np.isfinite(values))} of {values.size} values are not finite"
        if values.min() < 0:
            return f"{name}: least value {values.min():.3g}, largest {values.max():.3g}"
    return None


def differs(a: np.ndarray, b: np.ndarray, *, dark: float = 0.0) -> str | None:
    """Whether two pictures differ by more than rounding; None where they do not, or where both are nowhere above `dark`."""
    if max(a.max(), b.max()) <= dark:
        return None
    scale = max(np.abs(a).sum(), np.abs(b).sum())
    difference = np.abs(a - b).sum() / scale if scale > 0 else 0.0
    return None if difference <= SAME else f"relative difference {difference:.3g}"


def linear(config: scenes.Config, method: str, base: np.ndarray) -> str | None:
    """Four times the light is four times the picture, with the same random numbers."""
    found = differs(picture(render(scenes.with_light(config, POWER), method)) / POWER, base)
    return found and f"light x {POWER:g}: {found}"


def unit_free(config: scenes.Config, method: str, base: np.ndarray, *, factor: float) -> str | None:
    """Other units of length give the same picture, with the same random numbers.

    Pictures darker than the square root of float32's smallest normal number, relative to the scene's light, are black:
    they are products of factors that have a unit (a flux and an inverse area), and underflow in one unit but not in another.
    """
    found = differs(picture(render(scenes.in_units(config, factor), method)), base, dark=DARK * brightest(config))
    return found and f"lengths x {factor:.3g}: {found}"


def turns(config: scenes.Config, method: str) -> str | None:
    """A turned and shifted scene gives the same mean of the picture, by Welch's test over seeds."""
    from scipy import stats

    other = scenes.turned(config, np.array([0.5, -0.25, 0.125]))
    means = [[picture(render(c, method, seed=s)).mean() for s in range(1, BATCHES + 1)] for c in (config, other)]
    a, b = np.asarray(means)
    if np.abs(a.mean() - b.mean()) <= 0.02 * max(a.mean(), b.mean(), 1e-30):
        return None
    if a.std() + b.std() <= 1e-4 * max(a.mean(), b.mean()):  # deterministic: rules of quadrature that a turn may change
        ratio = a.mean() / b.mean() if b.mean() > 0 else np.inf
        return None if 0.8 < ratio < 1.25 else f"turned: mean {a.mean():.4g}, {b.mean():.4g}"
    p = stats.ttest_ind(np.log(np.maximum(a, 1e-30)), np.log(np.maximum(b, 1e-30)), equal_var=False).pvalue
    return None if not p < LEAST_P else f"turned: mean {a.mean():.4g}, {b.mean():.4g}, p {p:.1e}"


def furnace(config: scenes.Config, method: str) -> str | None:
    """Under a sky of radiance 1 no picture is brighter than 1 on average: energy is never created."""
    means = [picture(render(config, method, seed=seed)).mean() for seed in range(1, BATCHES + 1)]
    limit = 1 + FURNACE + 3 * np.std(means, ddof=1) / np.sqrt(BATCHES)
    if np.mean(means) <= limit and np.min(means) <= FAR_TOO_BRIGHT:  # noise may be large, but not always upwards
        return None
    return f"furnace: means of batches {np.min(means):.4g} to {np.max(means):.4g}, their mean {np.mean(means):.4g}"


def size(config: scenes.Config) -> float:
    """How far the camera stands from what it looks at: the scene's unit of length, about."""
    return float(np.linalg.norm(np.subtract(config["camera"]["origin"], config["camera"]["target"])))


def brightest(config: scenes.Config) -> float:
    """The largest radiance or irradiance of any light; of a point's intensity at the distance `size`."""
    found = [np.max(shape.get("emission", 0.0)) for shape in config["shapes"]]
    for light in config["lights"]:
        found.append(np.max(light["intensity"]) / size(config) ** 2 if "intensity" in light else 0.0)
        found += [np.max(light[key]) for key in ("irradiance", "radiance") if key in light]
    return float(max(found, default=0.0))


def clear_caches() -> None:
    """Forget compiled programs: hundreds of shapes would fill the memory."""
    jax.clear_caches()
    gradients.clear_caches()
