"""How fast is the bake: segments a second, what the medium costs at equal noise, lookups, and baking by path tracing.

    python experiments/bench_bake.py [segments overhead lookups path_tracing] [--size 96] [--share 16] [--out DIR]

Writes bench_bake_<part>.csv. Times are CPU seconds of this process, warm. Targets: 1 M segments per CPU-second of a
surface-only bake, 4 % overhead of the medium at equal noise, 20 ns a lookup, a hundredth of the time of baking by path tracing
at equal error. A segment is a path's or a shadow ray, with all that belongs to it. Equal noise: the product of time and
relative variance.
"""

import argparse
import csv
import time
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from bake_open_plane import scene as open_plane

from jaxvol import image, layers, tables
from jaxvol.methods import impulse_response, path_tracing
from jaxvol.methods.impulse_response import baking, estimate, lightmap, lookup
from jaxvol.scene import load_scene

SCENES = Path(__file__).resolve().parent / "scenes"
MEDIA = {"surface-only": "surface", "attenuated": "attenuated", "single": "single", "all bounces": "multiple"}


def timed(run):
    """(CPU seconds, wall seconds, result) of the second call."""
    run()
    cpu, wall = time.process_time(), time.perf_counter()
    result = run()
    return time.process_time() - cpu, time.perf_counter() - wall, result


def receivers(name, size):
    """A scene and the texels of its lightmap."""
    scene = load_scene(SCENES / f"{name}.toml").scene
    what = lightmap.unwrap(scene.mesh, resolution=size)
    return scene, what.receiver, what.normal


def baked(scene, points, normals, samples, *, share=1, **options):
    """One bake with everything repeated that a user repeats but reading files: plan, tables, casters, cache."""
    plan = impulse_response.plan(scene, None, **options)
    kit = impulse_response.prepare(scene, plan)
    return baking.bake(kit, plan, points, normals, name="bench", samples=samples, share=share)


def spread(found):
    """Mean relative variance of the lightmap's irradiance."""
    mean, variance = baking.total(found).mean(axis=-1), found.variance.mean(axis=-1)
    return float(np.mean(variance / (mean * mean + 0.01 * mean.mean() ** 2)))


def segments(size, share):
    """Segments per CPU-second by scene and mode."""
    for name in ("cornell_fog", "street_canyon"):
        scene, points, normals = receivers(name, size)
        for mode, scattering in MEDIA.items():
            plan = impulse_response.plan(scene, None, scattering=scattering)
            kit = impulse_response.prepare(scene, plan)
            run = partial(estimate.bake, kit, points, normals, plan, samples=16, seed=0)
            cpu, wall, found = timed(run)
            count = float(found.diagnostics["segments"])
            yield {"scene": name, "mode": mode, "million_per_cpu_second": count / cpu / 1e6, "cpu": cpu, "wall": wall}


def overhead(size, share):
    """Time to equal noise of the lightmap over a surface-only bake that shares nothing, at two qualities."""
    for name in ("cornell_fog", "street_canyon"):
        scene, points, normals = receivers(name, size)
        for quality, samples in (("low", 8), ("high", 64)):
            base = None
            for mode, sharing, options in (
                ("surface-only", 1, {"scattering": "surface"}),
                ("attenuated", 1, {"scattering": "attenuated"}),
                ("all bounces", 1, {}),
                ("all bounces, tables alone", 1, {"occlusion": "drop", "bounded": None}),
                ("surface-only, shared", share, {"scattering": "surface"}),
                ("all bounces, shared", share, {}),
                ("all bounces, tables alone, shared", share, {"occlusion": "drop", "bounded": None}),
            ):
                cpu, _, found = timed(partial(baked, scene, points, normals, samples, share=sharing, **options))
                noise = spread(found)
                base = (cpu, noise) if base is None else base
                yield {
                    "scene": name,
                    "quality": quality,
                    "mode": mode,
                    "share": sharing,
                    "cpu": cpu,
                    "relative_variance": noise,
                    "time_over_surface_only": cpu / base[0] - 1,
                    "time_to_equal_noise_over_surface_only": cpu * noise / (base[0] * base[1]) - 1,
                }


def lookups(size, share):
    """Nanoseconds of one lookup, everything that precedes the shading: single and multiple scattering are one band set each."""
    num = 1 << 16
    medium = open_plane(0.9, 0.0, 0.0).medium
    responses = lookup.prepare(tables.default_file().lookups(), medium, grey=True, multiple=True)
    rng = np.random.default_rng(0)
    draw = lambda low, high: jnp.asarray(rng.uniform(low, high, num), jnp.float32)  # noqa: E731
    tau, cosine, pick = draw(0, 8), draw(-1, 1), (draw(0, 1), draw(0, 1))
    one = lambda x: jnp.broadcast_to(x[:, None], (num, 3))  # noqa: E731

    @partial(jax.jit, static_argnames=("kind", "random"))
    def fetch(responses, tau, cosine, pick, *, kind, random):
        chosen = pick if random else None
        if kind == "directional":
            return lookup.directional_source(responses.directional, responses.albedo, one(tau), pick=chosen)
        facing = one(cosine) if kind == "area" else None
        grids = getattr(responses, kind)
        return lookup.compact_source(grids, responses.albedo, one(tau), one(tau + 0.1), facing, pick=chosen)

    for kind in ("point", "directional", "area"):
        for random in (False, True):
            run = partial(fetch, responses, tau, cosine, pick, kind=kind, random=random)
            cpu, _, _ = timed(lambda run=run: [jax.block_until_ready(run()) for _ in range(20)])
            ns = cpu / 20 / num * 1e9
            how = "one node" if random else "interpolated"
            yield {"emitter": kind, "how": how, "ns": ns, "band_sets": 2, "ns_per_band_set": ns / 2}


def path_traced(size, share):
    """Time to equal error of irradiance: baking by path tracing over our bake, both against one more path-traced reference."""
    flat = np.concatenate([grid_on_plane(size), np.zeros((size * size, 1))], axis=1).astype(np.float32)
    up = np.tile(np.float32([0, 0, 1]), (len(flat), 1))
    emitters_only = {"max_bounces": 0}
    cases = {
        "open plane, albedo 0.5": ((open_plane(0.5, 0.0, 0.0), flat, up), 1, 4096, 1, emitters_only),
        "open plane, albedo 0.9": ((open_plane(0.9, 0.0, 0.0), flat, up), 1, 4096, 1, emitters_only),
        "open plane, albedo 0.9, reflecting": ((open_plane(0.9, 0.0, 0.5), flat, up), 64, 4096, share, {}),
        "cornell_fog": (receivers("cornell_fog", size), 32, 2048, share, {}),
        "street_canyon": (receivers("street_canyon", size), 32, 2048, share, {}),
    }
    for name, ((scene, points, normals), paths, samples, sharing, options) in cases.items():
        cpu, _, found = timed(partial(baked, scene, points, normals, paths, share=sharing, **options))
        some = np.sort(np.random.default_rng(0).permutation(len(points))[:1024])  # path traced at some of the texels
        trace = partial(path_tracing.irradiance, scene, points[some] + 1e-4 * normals[some], normals[some])
        trace(samples=16)
        start = time.process_time()
        reference = trace(samples=samples)
        traced = (time.process_time() - start) * len(points) / len(some)
        truth = np.asarray(layers.total(reference.mean)).mean(axis=-1)
        variance = np.asarray(next(iter(reference.variance.sums.values()))).mean(axis=-1)
        ours = baking.total(found)[some].mean(axis=-1)
        scale = truth * truth + 0.01 * truth.mean() ** 2
        own = (np.square(ours - truth) - variance) / scale  # of every receiver; the reference's noise taken off
        error = float(own.mean() + 2 * own.std() / np.sqrt(own.size))  # not more than this: it may be small beside the noise
        noise = float(np.mean(variance / scale))
        own_l1 = image.relative_l1(ours[:, None], truth[:, None])
        noise_l1 = float(np.sqrt(variance).sum() * np.sqrt(2 / np.pi) / truth.sum())
        left_l1 = np.sqrt(max(own_l1**2 - noise_l1**2, (0.2 * own_l1) ** 2))
        yield {
            "scene": name,
            "texels": len(points),
            "bake_cpu": cpu,
            "bake_relmse_at_most": error,
            "bake_relative_l1": own_l1,
            "path_tracing_cpu": traced,
            "path_tracing_relmse": noise,
            "path_tracing_relative_l1": noise_l1,
            "path_tracing_us_per_path": traced / samples / len(points) * 1e6,
            "times_faster_at_equal_relmse_at_least": traced * noise / (cpu * error),
            "times_faster_at_equal_l1": traced * noise_l1**2 / (cpu * left_l1**2),
        }


def grid_on_plane(size):
    """Places [size^2, 2] around the foot of the light."""
    return np.stack(np.meshgrid(*[np.linspace(-3, 3, size)] * 2, indexing="ij"), axis=-1).reshape(-1, 2)


PARTS = {"segments": segments, "overhead": overhead, "lookups": lookups, "path_tracing": path_traced}


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("parts", nargs="*", default=list(PARTS), metavar="PART")
    parser.add_argument("--size", type=int, default=96, help="texels along the lightmap's side")
    parser.add_argument("--share", type=int, default=16, help="texels that share a place of scattered light")
    parser.add_argument("--out", type=Path, default=Path("out"))
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    for part in arguments.parts:
        rows = []
        for row in PARTS[part](arguments.size, arguments.share):
            rows.append(row)
            print(", ".join(f"{k} {v:.4g}" if isinstance(v, float) else f"{k} {v}" for k, v in row.items()), flush=True)
        with open(arguments.out / f"bench_bake_{part}.csv", "w", newline="") as file:
            table = csv.DictWriter(file, fieldnames=list(rows[0]))
            table.writeheader()
            table.writerows(rows)


if __name__ == "__main__":
    main()
