"""Warm run time, by stage, of an RGB picture of the translucent bunny: 128 voxels, 512x512, default lattice; and each saving.

    python experiments/lattice_speed.py [--resolution 128] [--size 512] [--savings 1]

Savings, at half the resolution: one channel for grey media, dead rays packed away, no lattice where nothing scatters, a
cloud in a box of its size against the same in one of 27 times the volume, and empty blocks between the clouds of the shared
LES field (3 % of its voxels are filled), which rays jump over.
"""

import os
import time
from dataclasses import replace
from unittest import mock

import equinox as eqx
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
from lattice_common import HERE, arguments, timed, write_csv

from jaxvol import camera as cameras
from jaxvol import media
from jaxvol.methods import lattice_boltzmann
from jaxvol.methods.lattice_boltzmann import occupancy
from jaxvol.scene import load_scene
from jaxvol.types import Camera, DirectionalLights, Medium, Scene

JUMPED, WALKED = "LES field, empty blocks jumped over", "LES field, all voxels walked"


def run(scene, camera, plan, label):
    """One warm rendering: seconds by stage, CPU and wall."""
    lattice_boltzmann.render(scene, camera, plan, seed=0)
    stages, last = {}, [time.process_time(), time.perf_counter()]

    def on_stage(name):
        now = [time.process_time(), time.perf_counter()]
        stages[name] = (now[0] - last[0], now[1] - last[1])
        last[:] = now

    with timed() as spent:
        found = jax.block_until_ready(lattice_boltzmann.render(scene, camera, plan, seed=0, on_stage=on_stage))
    row = {"case": label, "channels": plan.num_channels, "cpu_s": spent.cpu, "wall_s": spent.wall, "load": os.getloadavg()[0]}
    row |= {f"{name}_cpu_s": stages[name][0] for name in ("voxelize", "march", "solve", "view")}
    row["ray_steps"] = float(found.diagnostics["num_ray_steps"])
    row["applications"] = str(np.asarray(found.diagnostics["num_applications"]))
    return row


def cloud(count, margin):
    """A round cloud in `count` voxels of size 0.16, `margin` empty voxels all around."""
    axis = (np.arange(count + 2 * margin) + 0.5 - margin) / count - 0.5
    x, y, z = np.meshgrid(axis, axis, axis, indexing="ij")
    density = np.clip(4.0 - 8.0 * np.sqrt(x * x + y * y + z * z), 0.0, 1.0).astype(np.float32)
    half = 0.08 * (1 + 2 * margin / count)
    bounds = jnp.asarray([[-half] * 3, [half] * 3]) + jnp.asarray([0.0, 0.1, 0.0])
    sigma = jnp.full(3, 90.0), jnp.full(3, 1.5)
    return Medium(bounds, *sigma, jnp.float32(0), density=jnp.asarray(density), majorants=media.majorants(jnp.asarray(density)))


def field_of_clouds(path):
    """The LES field, its densest voxel of thickness 0.5, in a box of longest side 1; under a sun."""
    density = np.load(path)["density"].astype(np.float32)
    count = np.array(density.shape)
    half = 0.5 * count / count.max()
    bounds = jnp.asarray(np.stack([-half, half]), jnp.float32)
    sigma = jnp.full(3, 0.5 * count.max() / density.max())
    grid = jnp.asarray(density)
    medium = Medium(bounds, sigma, 0.001 * sigma, jnp.float32(0), density=grid, majorants=media.majorants(grid))
    return Scene(medium=medium, directional_lights=DirectionalLights(jnp.asarray([[0.4, 0.3, -0.87]]), jnp.ones((1, 3))))


def above(size):
    pose = cameras.look_at([0.0, -1.5, 1.1], [0.0, 0.0, 0.0], [0, 0, 1])
    return Camera(jnp.asarray(pose), jnp.float32(0.6), size, size)


def overview(size):
    pose = cameras.look_at([0.0, 0.1, 0.6], [0.0, 0.1, 0.0], [0, 1, 0])
    return Camera(jnp.asarray(pose), jnp.float32(0.4), size, size)


def main():
    chosen = arguments(__doc__, resolution=128, size=512, samples=1, savings=1)
    overrides = [f"camera.width={chosen.size}", f"camera.height={chosen.size}"]
    file = load_scene(HERE / "lattice_bunny.toml", overrides=overrides)
    options = {"samples_per_pixel": chosen.samples}
    rows = [
        run(
            file.scene,
            file.camera,
            lattice_boltzmann.plan(file.scene, file.camera, resolution=chosen.resolution, **options),
            "RGB",
        )
    ]
    write_csv(chosen.out / "speed.csv", rows)
    if chosen.savings:
        half = chosen.resolution // 2
        grey = eqx.tree_at(
            lambda s: (s.medium.sigma_s, s.medium.sigma_a, s.environment), file.scene,
            (jnp.full(3, 90.0), jnp.full(3, 1.5), None), is_leaf=lambda x: x is None,
        )  # fmt: skip
        clear = eqx.tree_at(lambda s: (s.medium.sigma_s, s.medium.sigma_a), grey, (jnp.zeros(3), jnp.full(3, 0.5)))
        dense = eqx.tree_at(lambda s: (s.medium.sigma_s, s.medium.sigma_a), grey, (jnp.full(3, 400.0), jnp.full(3, 4.0)))
        for label, scene in (("grey", grey), ("nothing scatters", clear), ("four times denser: rays die early", dense)):
            plan = lattice_boltzmann.plan(scene, file.camera, resolution=half, **options)
            rows.append(run(scene, file.camera, plan, label))
        for label, margin in (("cloud in a tight box", 0), ("the same cloud, 26/27 of the box empty", half)):
            scene = replace(grey, medium=cloud(half, margin))
            plan = lattice_boltzmann.plan(scene, overview(chosen.size), resolution=half, **options)
            rows.append(run(scene, overview(chosen.size), plan, label))
        clouds = HERE.parent.parent / "shared" / "data" / "volumes" / "les_rico_122x106x39.npz"
        if clouds.is_file():
            scene = field_of_clouds(clouds)
            plan = lattice_boltzmann.plan(scene, above(chosen.size), resolution=122, **options)
            rows.append(run(scene, above(chosen.size), plan, JUMPED))
            with mock.patch.object(occupancy, "filled_blocks", lambda materials: None):
                rows.append(run(scene, above(chosen.size), plan, WALKED))
        plan = lattice_boltzmann.plan(grey, file.camera, resolution=half, specialize="structure", **options)
        rows.append(run(grey, file.camera, plan, "grey, solved as three channels"))
        write_csv(chosen.out / "speed.csv", rows)
        show_gains(chosen.out, {row["case"]: row for row in rows})


def show_gains(folder, found):
    """What each saving saves: seconds (or ray steps) without and with it."""
    pairs = (
        ("one channel for grey media: solve, CPU s", "solve_cpu_s", "grey, solved as three channels", "grey"),
        ("no lattice where nothing scatters: solve, CPU s", "solve_cpu_s", "grey", "nothing scatters"),
        ("26/27 of a box empty: picture, CPU s", "cpu_s", "the same cloud, 26/27 of the box empty", "cloud in a tight box"),
        ("rays that die early: ray steps", "ray_steps", "nothing scatters", "four times denser: rays die early"),
        ("view rays that die early: view, CPU s", "view_cpu_s", "nothing scatters", "four times denser: rays die early"),
    )  # fmt: skip
    if JUMPED in found:
        pairs += tuple((f"empty blocks of the LES field: {what}", key, WALKED, JUMPED) for what, key in (
            ("ray steps", "ray_steps"), ("march, CPU s", "march_cpu_s"), ("view, CPU s", "view_cpu_s"),
        ))  # fmt: skip
    gains = [
        {"saving": label, "without": found[a][key], "with": found[b][key], "ratio": found[a][key] / max(found[b][key], 1e-4)}
        for label, key, a, b in pairs
    ]
    write_csv(folder / "gains.csv", gains)
    fig, axis = plt.subplots(figsize=(7.5, 3.4), constrained_layout=True)
    shares = [g["with"] / max(g["without"], 1e-9) for g in gains]
    bars = axis.barh([g["saving"] for g in gains], shares)
    axis.bar_label(bars, [f"{g['without']:.3g} -> {g['with']:.3g}" for g in gains], padding=3, fontsize=7)
    axis.set(xlabel="with / without (empty border: without / with it)", xlim=(0, 1.4))
    axis.tick_params(labelsize=7)
    axis.invert_yaxis()
    fig.savefig(folder / "gains.png", dpi=110)


if __name__ == "__main__":
    main()
