"""Camera rays per second and core against a mesh (default: the Stanford bunny), and the seconds to build a BVH.

    python experiments/bench_casting.py [MESH.ply] [--side 1024]

Prints rays per CPU second of Embree on one thread (target 3 M/s), the share that hits, and the CPU seconds to build the
tree of about 80,000 triangles (target 2 s): the mesh with its triangles cut in four until it has so many.
"""

import argparse
import math
import time
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import trimesh

from jaxvol import ray_casting
from jaxvol.camera import generate_rays, look_at, pixel_centers
from jaxvol.ray_casting import bvh
from jaxvol.types import Camera, Mesh

BUNNY = Path(__file__).resolve().parents[2] / "shared/data/meshes/stanford_bunny_16k_closed.ply"
ENOUGH = 80_000  # triangles


def camera_rays(bounds, side):
    """All rays of a square camera whose picture the mesh about fills, as numpy."""
    centre, radius = bounds.mean(axis=0), 0.5 * float(np.linalg.norm(bounds[1] - bounds[0]))
    eye = centre + np.array([0.0, 0.2, 1.0]) * 2.5 * radius
    camera = Camera(look_at(eye, centre, [0, 1, 0]), jnp.float32(2 * math.atan(0.6 / 2.5)), height=side, width=side)
    rays = generate_rays(camera, pixel_centers(camera))
    return np.array(rays.origin), np.array(rays.direction)


def cpu_seconds(function, repeats=7):
    """The least of several."""
    found = []
    for _ in range(repeats):
        start = time.process_time()
        function()
        found.append(time.process_time() - start)
    return min(found)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("mesh", type=Path, nargs="?", default=BUNNY)
    parser.add_argument("--side", type=int, default=1024)
    arguments = parser.parse_args()
    shape = trimesh.load(arguments.mesh, process=False)
    faces = jnp.asarray(shape.faces, jnp.int32)
    mesh = Mesh(jnp.asarray(shape.vertices, jnp.float32), faces, jnp.ones((len(faces), 3)))
    caster = ray_casting.make_caster(mesh, kind="embree", num_threads=1)
    origin, direction = camera_rays(np.asarray(shape.bounds), arguments.side)
    t_max = np.full(len(origin), np.inf, np.float32)
    hits = np.isfinite(ray_casting.intersect(caster, origin, direction, t_max)[0]).mean()
    nearest = len(origin) / cpu_seconds(lambda: ray_casting.intersect(caster, origin, direction, t_max))
    shadow = len(origin) / cpu_seconds(lambda: ray_casting.occluded(caster, origin, direction, t_max))
    print(f"{arguments.mesh.name}: {len(faces)} triangles, {len(origin)} camera rays, {hits:.0%} hit")
    print(f"nearest hit {nearest / 1e6:.2f} M rays per CPU second, occlusion {shadow / 1e6:.2f} M")
    while len(shape.faces) < ENOUGH:
        shape = shape.subdivide()
    triangles = np.asarray(shape.triangles, np.float32)
    print(f"BVH of {len(triangles)} triangles: {cpu_seconds(lambda: bvh.build(triangles), 3):.2f} CPU seconds")


if __name__ == "__main__":
    main()
