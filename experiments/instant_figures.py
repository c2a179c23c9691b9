"""The figures of Engelhardt et al. 2010 with our estimator: pictures (PNG) and what they show in numbers (CSV).

fig1: smoke: reference, unclamped, clamped, energy loss, compensated. fig4: sub-sampling strategies at equal cost, and one
and two compensation steps. fig5: leaking without visibility of new vertices. fig6: street canyon in fog, time per frame.
fig7: number of lights against error, difference images. Usage: python experiments/instant_figures.py fig1 [--size 48].
"""

import argparse
import time
from pathlib import Path

import jax.numpy as jnp
import numpy as np
from instant_common import (
    box,
    cube,
    figure,
    floats,
    mesh_of,
    out_folder,
    pictures,
    plume,
    square_camera,
    write_csv,
)

from jaxvol import camera as pinhole
from jaxvol import direct, layers
from jaxvol import image as metrics
from jaxvol.methods import instant_multiple_scattering as ims
from jaxvol.methods import path_tracing
from jaxvol.methods.instant_multiple_scattering import rendering
from jaxvol.types import Camera, Medium, PointLights, Scene


def total(images):
    """Sum of the six layers."""
    return sum(images[name] for name in rendering.NAMES)


def reference_of(scene, camera, samples):
    """Multiple scattering by the path tracer: (picture, everything, variance)."""
    found = path_tracing.render(scene, camera, path_tracing.plan(scene, camera), seed=5, samples=samples)
    picture = np.asarray(sum(getattr(found.mean, name) for name in rendering.NAMES))
    variance = np.asarray(sum(getattr(found.variance, name) for name in rendering.NAMES))
    return picture, np.asarray(layers.total(found.mean)), variance


def timed(scene, camera, *, seed=3, sets=1, **options):
    """Mean picture of some sets of lights, CPU seconds of one (the first call not counted) and its counts."""
    plan = ims.plan(scene, camera, **options)
    sizes = {}
    rendering.render_set(scene, camera, plan, seed=seed, sizes=sizes)
    start = time.process_time()
    found = [rendering.render_set(scene, camera, plan, seed=seed + k, sizes=sizes) for k in range(sets)]
    seconds = (time.process_time() - start) / sets
    picture = sum(total(images) for images, _ in found) / sets
    return picture.reshape(camera.height, camera.width, 3), seconds, found[0][1]


def fig1(size, samples):
    scene, camera = plume(), square_camera(size)
    reference, everything, variance = reference_of(scene, camera, samples)
    modes = {
        "unclamped": {"mean_free_paths": None},
        "clamped": {"num_levels": 0},
        "clamped + compensation": {"num_levels": 3},
    }
    settings = {"num_paths": 32768, "max_lights": 4096}
    found = {name: timed(scene, camera, **settings, **options) for name, options in modes.items()}
    loss = np.maximum(found["clamped + compensation"][0] - found["clamped"][0], 0)
    shown = [everything, reference, *(found[name][0] for name in modes), loss]
    titles = ["path tracer, all layers", "path tracer, multiple scattering", *modes, "energy loss of clamping"]
    pictures(out_folder() / "fig1.png", shown, columns=3, scale=0.7 / np.percentile(reference, 99), titles=titles)
    noise = metrics.reference_noise(reference, variance)
    rows = [
        [name, seconds, metrics.relmse(picture, reference, variance=variance), metrics.bias(picture, reference), noise]
        for name, (picture, seconds, _) in found.items()
    ]
    write_csv(out_folder() / "fig1.csv", ["mode", "cpu_s", "relmse", "bias", "reference_noise"], rows)
    return rows


def fig4(size, samples):
    scene, camera = cube(), square_camera(size)
    strategies = {f"vertices: {v}, lights: 1/{v}": {"num_chains": v, "light_stride": v} for v in (1, 4, 16)}
    steps = {
        "unclamped": {"mean_free_paths": None},
        "clamped": {"num_levels": 0},
        "1 step, unclamped end": {"num_levels": 1, "end": "unclamped"},
        "2 steps, unclamped end": {"num_levels": 2, "end": "unclamped"},
    }
    rows, shown, titles = [], [], []
    for name, options in {**{k: {"num_levels": 2, **v} for k, v in strategies.items()}, **steps}.items():
        plan = ims.plan(scene, camera, num_paths=256, jitter=False, **options)
        lights, _ = rendering.trace_lights(scene, None, plan, seed=3)
        # The same virtual lights, other random numbers at the receivers: the noise of the strategy alone.
        runs = []
        rendering.render_set(scene, camera, plan, seed=90, lights=lights)
        start = time.process_time()
        for k in range(6):
            runs.append(total(rendering.render_set(scene, camera, plan, seed=100 + k, lights=lights)[0]))
        seconds = (time.process_time() - start) / 6
        runs = np.array(runs)
        noise = np.sqrt(np.mean(runs.var(axis=0, ddof=1)) / np.mean(runs.mean(axis=0) ** 2))
        rows.append([name, seconds, noise, runs.max() / runs.mean(), runs.mean()])
        shown.append(runs[0].reshape(size, size, 3))
        titles.append(name)
    scale = 0.7 / np.percentile(shown[0], 99)
    pictures(out_folder() / "fig4.png", shown, columns=4, scale=scale, titles=titles)
    write_csv(out_folder() / "fig4.csv", ["mode", "cpu_s", "noise", "max_over_mean", "mean"], rows)
    return rows


def leak_scene():
    """Bright fog on the left of a thin wall, dark fog on the right."""
    walls = [
        box((-0.02, -1, -1), (0.02, 1, 1), (0.8, 0.8, 0.8)),
        box((0.0, -1.02, -1), (1.02, -1, 1), (0.8, 0.8, 0.8)),
        box((0.0, 1, -1), (1.02, 1.02, 1), (0.8, 0.8, 0.8)),
        box((0.0, -1, -1.02), (1.02, 1, -1), (0.8, 0.8, 0.8)),
        box((1.0, -1, -1), (1.02, 1, 1), (0.8, 0.8, 0.8)),
    ]
    medium = Medium(
        bounds=floats([-1.1] * 3, [1.1] * 3), sigma_s=floats(2.4, 2.4, 2.4), sigma_a=floats(0.1, 0.1, 0.1), g=jnp.float32(0.0)
    )
    lights = PointLights(position=floats([-0.6, 0.2, 0.2]), intensity=floats([1.0] * 3))
    return Scene(mesh=mesh_of(walls), medium=medium, point_lights=lights)


def fig5(size, samples):
    scene, camera = leak_scene(), square_camera(size)
    reference, _, variance = reference_of(scene, camera, samples)
    modes = {"rays": {}, "maps": {"visibility": "maps", "shadows": "maps"}, "none": {"visibility": "none"}}
    settings = {"num_paths": 65536, "max_lights": 4096, "sets": 8}  # many paths: few of them reach the dark side
    found = {name: timed(scene, camera, **settings, **options) for name, options in modes.items()}
    dark = np.zeros((size, size), bool)
    dark[size // 4 : 3 * size // 4, size // 2 + 1 : size // 2 + max(2, size // 6)] = True
    rows = []
    for name, (picture, seconds, _) in found.items():
        leak = picture[dark].mean() / reference[dark].mean() - 1
        rows.append([name, seconds, metrics.bias(picture, reference), leak, metrics.reference_noise(reference, variance)])
    header = ["visibility", "cpu_s", "bias", "bias_beside_the_wall", "reference_noise"]
    write_csv(out_folder() / "fig5.csv", header, rows)
    shown = [reference, *(found[name][0] for name in modes), 5 * np.abs(found["none"][0] - found["rays"][0])]
    titles = ["path tracer", "rays to new vertices", "depth maps of lights", "no visibility test", "5 x |none - rays|"]
    pictures(out_folder() / "fig5.png", shown, columns=5, scale=0.7 / np.percentile(reference, 98), titles=titles)
    return rows


def fig6(size, samples):
    from jaxvol import meshes

    path = Path(__file__).resolve().parents[1] / "../shared/data/meshes/sionna_simple_street_canyon.glb"
    if not path.exists():
        raise SystemExit(f"{path} is absent: this figure needs the shared meshes")
    plain = {"reflectance": (0.5, 0.5, 0.5), "emission": None, "specular": None, "exponent": None}
    mesh, _ = meshes.build_mesh([("street", meshes.load(path.name, base=path.parent), plain)])
    vertices = np.asarray(mesh.vertices)
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    medium = Medium(
        bounds=jnp.asarray(np.stack([low - 1, high + [1, 1, 20]]), jnp.float32),
        sigma_s=floats(0.008, 0.008, 0.008),
        sigma_a=floats(0.0004, 0.0004, 0.0004),
        g=jnp.float32(0.3),
    )
    lamps = PointLights(position=floats([-40, 0, 12], [0, 0, 12], [40, 0, 12]), intensity=floats(*[[300.0] * 3] * 3))
    scene = Scene(mesh=mesh, medium=medium, point_lights=lamps)
    camera = Camera(
        world_from_camera=pinhole.look_at([-80, 2, 8], [0, 0, 10], [0, 0, 1]),
        fov_y=jnp.float32(0.9),
        height=size * 9 // 16,
        width=size,
    )
    rows, shown = [], []
    once = np.asarray(layers.total(direct.render(scene, camera, direct.plan(scene, camera)).mean))
    # A mean free path is as long as the street: clamped at a tenth of it, little is left to compensate, and little noise.
    settings = {"num_paths": 6000, "max_lights": 1300, "mean_free_paths": 0.1, "num_levels": 1, "group_size": 8}
    for name, options in {"full resolution": {}, "1/64 of the pixels": {"upsample": 8, "jitter": False}}.items():
        picture, seconds, counts = timed(scene, camera, **settings, **options)
        evaluated = counts.get("num_evaluated", camera.height * camera.width)
        rows.append([name, counts["num_lights"], seconds, evaluated, evaluated / (camera.height * camera.width)])
        shown += [picture, picture + once]
    write_csv(out_folder() / "fig6.csv", ["mode", "num_lights", "cpu_s_per_frame", "evaluated", "share"], rows)
    scale = 0.7 / np.percentile(shown[1], 95)
    titles = [name for r in rows for name in (f"{r[0]}: virtual lights", "and light scattered once")]
    pictures(out_folder() / "fig6.png", shown, columns=2, scale=scale, titles=titles)
    return rows


def fig7(size, samples):
    rows, shown, titles, scales = [], [], [], []
    for name, scene in {"plume": plume(), "cube": cube()}.items():
        camera = square_camera(size)
        reference, _, variance = reference_of(scene, camera, samples)
        scale = 0.7 / np.percentile(reference, 99)
        for number in (256, 1024, 4096):  # kept of those of many paths
            picture, seconds, counts = timed(scene, camera, num_paths=16384, max_lights=number)
            error = metrics.relmse(picture, reference, variance=variance)
            noise = metrics.reference_noise(reference, variance)
            label = f"{name}, chosen of 16,384 paths"
            rows.append([label, counts["num_lights"], seconds, error, metrics.bias(picture, reference), noise])
        for number in (64, 256, 1024, 4096):
            picture, seconds, counts = timed(scene, camera, num_paths=number, max_lights=None)
            error = metrics.relmse(picture, reference, variance=variance)
            rows.append([name, counts["num_lights"], seconds, error, metrics.bias(picture, reference), noise])
            difference = 2 * (picture - reference)
            gap = np.stack(
                [np.maximum(difference, 0).mean(-1), np.maximum(-difference, 0).mean(-1), 0 * difference[..., 0]], -1
            )
            shown += [picture, gap]
            titles += [f"{name}, {counts['num_lights']} lights", "2 x difference (green: too dark)"]
            scales += [scale, scale]
    pictures(out_folder() / "fig7.png", shown, columns=4, scale=scales, titles=titles)
    write_csv(out_folder() / "fig7.csv", ["scene", "num_lights", "cpu_s", "relmse", "bias", "reference_noise"], rows)
    with figure(out_folder() / "fig7_error.png") as axes:
        for name in dict.fromkeys(r[0] for r in rows):
            axes.loglog([r[1] for r in rows if r[0] == name], [r[3] for r in rows if r[0] == name], "o-", label=name)
        axes.set_xlabel("virtual lights")
        axes.set_ylabel("relMSE")
        axes.legend()
    return rows


FIGURES = {"fig1": fig1, "fig4": fig4, "fig5": fig5, "fig6": fig6, "fig7": fig7}


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("figure", choices=list(FIGURES))
    parser.add_argument("--size", type=int, default=48)
    parser.add_argument("--samples", type=int, default=2048, help="of the reference")
    arguments = parser.parse_args()
    for row in FIGURES[arguments.figure](arguments.size, arguments.samples):
        print(*(f"{x:.4g}" if isinstance(x, float) else x for x in row))


if __name__ == "__main__":
    main()
