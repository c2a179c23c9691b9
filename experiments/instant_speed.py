"""Nanoseconds per (pixel, light) pair and milliseconds per 1,000 light paths (CSV).

Pairs: the gather along the eye rays of 64 x 64 pixels and all that belongs to it, over pixels times lights: homogeneous
(limit 10 ns) isotropic and Henyey-Greenstein, and a heterogeneous plume (limit 60 ns) with every light marched to (which
the limit is not for), one in twenty, and by maps. Paths: 1,000 through a 32^3 grid with all their lights (limit 20 ms).
Least CPU seconds of some repeats, one core. Usage: taskset -c 0 python experiments/instant_speed.py.
"""

import os
import time

os.environ.setdefault("XLA_FLAGS", "--xla_cpu_multi_thread_eigen=false")

import jax
import jax.numpy as jnp
import numpy as np
from instant_common import cube, out_folder, plume, square_camera, write_csv

from jaxvol.methods import instant_multiple_scattering as ims
from jaxvol.methods.instant_multiple_scattering import eye_rays, light_paths, rendering, stages, virtual_lights

SIZE = 64
PAIRS = {  # scene, options, light paths, limit in ns
    "homogeneous, g 0": (cube, {}, 2048, 10),
    "homogeneous, g 0.7": (lambda: cube(0.7), {}, 2048, 10),
    "plume 32^3, columns as planned": (plume, {}, 512, 60),
    "plume 32^3, one light in 20 marched to": (plume, {"columns": "march"}, 512, 60),
    "plume 32^3, maps of columns": (plume, {"columns": "maps"}, 512, 60),
}


def least_seconds(function, *, repeats):
    """Least CPU seconds of a few calls, the first not counted."""
    jax.block_until_ready(function())
    seconds = []
    for _ in range(repeats):
        start = time.process_time()
        jax.block_until_ready(function())
        seconds.append(time.process_time() - start)
    return min(seconds)


def nanoseconds_a_pair(scene, options, num_paths):
    """Of a whole gather along eye rays, in one program, and the number of lights."""
    camera = square_camera(SIZE)
    plan = ims.plan(scene, camera, num_paths=num_paths, tile=SIZE * SIZE, **options)
    context, _ = rendering.make_context(scene, plan, seed=3)
    rays, _ = eye_rays.through_pixels(context, camera, jnp.arange(SIZE * SIZE, dtype=jnp.uint32))

    def gather():
        segments = stages.segments_of(context, *rays[:3])
        return stages.gather_segments(context, segments, rays[4])

    number = virtual_lights.num_lights(context.lights)
    return 1e9 * least_seconds(gather, repeats=7) / (SIZE * SIZE * number), number


def milliseconds_of_paths(num_paths):
    """Tracing through a 32^3 grid, lights included."""
    scene = plume(32)
    plan = ims.plan(scene, square_camera(SIZE), num_paths=num_paths)
    lights, counts = rendering.trace_lights(scene, None, plan, seed=3)
    sizes = virtual_lights.sizes(lights)
    vertices = lambda: rendering.trace_lights(scene, None, plan, seed=3, sizes=sizes)[0]  # noqa: E731
    bare = lambda: light_paths.trace(scene, None, seed=3, paths=np.arange(num_paths), max_depth=256)[0].position  # noqa: E731
    return [1e3 * least_seconds(f, repeats=9) for f in (vertices, bare)], counts["num_lights"]


def main():
    rows = []
    for name, (make, options, num_paths, limit) in PAIRS.items():
        found, number = nanoseconds_a_pair(make(), options, num_paths)
        rows.append([f"pair, {name}", found, "ns", limit, number])
        print(*rows[-1], flush=True)
    (seconds, bare), number = milliseconds_of_paths(1000)
    rows += [["1,000 paths on a 32^3 grid, with lights", seconds, "ms", 20, number]]
    rows += [["1,000 paths on a 32^3 grid, vertices alone", bare, "ms", 20, number]]
    print(*rows[-2], flush=True)
    print(*rows[-1], flush=True)
    write_csv(out_folder() / "speed.csv", ["what", "value", "unit", "limit", "num_lights"], rows)


if __name__ == "__main__":
    main()
