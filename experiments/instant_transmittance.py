"""Transmittance to virtual lights through a grid: marching, marching a coarse copy, octahedral maps (CSV and a figure).

Time per pair, rms error of the transmittance against 256 steps, cost of building maps, and the number of receivers per
light from which maps pay; then the time per (pixel, light) pair of the whole gather along eye rays (limit 60 ns), and
shadows by maps against rays. Usage: taskset -c 0 python experiments/instant_transmittance.py [--grids 32 64].
"""

import argparse
import os
import time

os.environ.setdefault("XLA_FLAGS", "--xla_cpu_multi_thread_eigen=false")

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from instant_common import figure, fogged_room, out_folder, plume, square_camera, write_csv

from jaxvol import media, ray_casting
from jaxvol.methods import instant_multiple_scattering as ims
from jaxvol.methods.instant_multiple_scattering import (
    compensation,
    eye_rays,
    maps,
    receivers,
    rendering,
    stages,
    virtual_lights,
)

RECEIVERS = 256
PLUME = {
    "march": {"columns": "march"},
    "march, 8 steps": {"columns": "march", "pair_steps": 8},
    "march, 8 steps, 1 of 20 lights": {"columns": "march", "pair_steps": 8, "group_size": 20},
    "coarse copy": {"columns": "mip"},
    "maps (without building)": {"columns": "maps"},
}


def timed(function, *, repeats=3):
    """Result and least CPU seconds."""
    result = jax.block_until_ready(function())
    least = np.inf
    for _ in range(repeats):
        start = time.process_time()
        jax.block_until_ready(function())
        least = min(least, time.process_time() - start)
    return result, least


march = jax.jit(receivers.column_between, static_argnames="num_steps")


def pair_rows(n, lights):
    """Rows (grid, way, ns per pair, rms error, build ns per light)."""
    scene = plume(n)
    medium = scene.medium
    sigma = float(media.sigma_t(medium)[0])
    position = lights.volume_first.position
    number = position.shape[0]
    rng = np.random.default_rng(0)
    points = jnp.asarray(rng.uniform(-1, 1, (RECEIVERS, 3)), jnp.float32)
    index = jnp.tile(jnp.arange(number, dtype=jnp.int32)[:, None], (1, RECEIVERS))
    a, b = jnp.broadcast_to(points, (number, RECEIVERS, 3)), jnp.broadcast_to(position[:, None], (number, RECEIVERS, 3))
    exact = np.exp(-sigma * np.asarray(march(medium, a, b, num_steps=256), np.float64))
    coarse = dataclasses.replace(medium, density=jnp.asarray(compensation.block_means(medium.density, block=2)))
    only = virtual_lights.LightSet(volume_first=lights.volume_first)
    ways = {f"march, {k} steps": (lambda k=k: march(medium, a, b, num_steps=k), 0.0) for k in (8, 16, 32)}
    ways |= {f"coarse copy, {k} steps": (lambda k=k: march(coarse, a, b, num_steps=k), 0.0) for k in (8, 16)}
    for size, steps in ((16, 16), (32, 16), (64, 16), (128, 16)):
        options = {"size": size, "num_steps": steps, "depth": False, "columns": True}
        if number * size * size * steps > 1 << 27:
            few = jax.tree.map(lambda x: x[:64], only)
            built, seconds = timed(lambda f=few, o=options: maps.build(scene, None, f, **o), repeats=1)
            which, shown, count = index[:64], a[:64], 64
        else:
            built, seconds = timed(lambda o=options: maps.build(scene, None, only, **o), repeats=1)
            which, shown, count = index, a, number
        ways[f"map of {size}^2 x {steps}"] = (
            lambda m=built, w=which, s=shown: maps.column(m, w, s),
            1e9 * seconds / count,
        )
    rows = []
    for name, (function, build) in ways.items():
        found, seconds = timed(function)
        error = np.exp(-sigma * np.asarray(found, np.float64)) - exact[: found.shape[0]]
        rows.append([n, name, 1e9 * seconds / found.size, float(np.sqrt(np.mean(error**2))), build])
        print(*rows[-1], flush=True)
    return rows


def gather_rows(scene, name, options_of):
    """Rows (scene, options, ns per pixel and light of a whole gather, mean radiance)."""
    camera = square_camera(64)
    rows = []
    lights = None
    for label, options in options_of.items():
        plan = ims.plan(scene, camera, num_paths=512, tile=4096, **options)
        if lights is None:
            lights, _ = rendering.trace_lights(scene, ray_casting.caster_for(scene.mesh, kind=plan.caster), plan, seed=3)
        context, _ = rendering.make_context(scene, plan, seed=3, lights=lights)
        rays, _ = eye_rays.through_pixels(context, camera, jnp.arange(4096, dtype=jnp.uint32))
        segments = stages.segments_of(context, *rays[:3])
        found, seconds = timed(lambda c=context, s=segments, r=rays: stages.gather_segments(c, s, r[4]))
        pairs = 4096 * virtual_lights.num_lights(lights)
        rows.append([name, label, 1e9 * seconds / pairs, float(np.mean([np.mean(x) for x in found.values()]))])
        print(*rows[-1], flush=True)
    return rows


def gathers():
    """Whole gathers along eye rays (CSV)."""
    whole = gather_rows(plume(32), "plume", PLUME)
    whole += gather_rows(fogged_room(), "room", {way: {"shadows": way, "map_size": 32} for way in ("rays", "maps")})
    write_csv(out_folder() / "transmittance_gather.csv", ["scene", "way", "ns_per_pixel_and_light", "mean"], whole)


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--grids", type=int, nargs="+", default=[32, 64])
    parser.add_argument("--gather-only", action="store_true")
    arguments = parser.parse_args()
    scene = plume(32)
    plan = ims.plan(scene, square_camera(8), num_paths=512)
    lights, _ = rendering.trace_lights(scene, None, plan, seed=3)
    gathers()
    if arguments.gather_only:
        return
    rows = [row for n in arguments.grids for row in pair_rows(n, lights)]
    marched = {n: next(r[2] for r in rows if r[0] == n and r[1] == "march, 16 steps") for n in arguments.grids}
    rows = [[*r, r[4] / (marched[r[0]] - r[2]) if r[4] and marched[r[0]] > r[2] else ""] for r in rows]
    header = ["grid", "way", "ns_per_pair", "rms_error", "build_ns_per_light", "receivers_per_light_to_pay"]
    write_csv(out_folder() / "transmittance.csv", header, rows)
    with figure(out_folder() / "transmittance.png", size=(7, 4)) as axes:
        for n, marker in zip(arguments.grids, "os^v", strict=False):
            mine = [r for r in rows if r[0] == n]
            axes.loglog([r[2] for r in mine], [r[3] for r in mine], marker, label=f"grid {n}^3")
            for r in mine:
                axes.annotate(r[1], (r[2], r[3]), fontsize=6)
        axes.set_xlabel("ns per pair (maps: without building)")
        axes.set_ylabel("rms error of the transmittance")
        axes.legend()


if __name__ == "__main__":
    main()
