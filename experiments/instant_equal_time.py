"""Equal-time comparison with Mitsuba 3's volpath: CPU seconds against relMSE (CSV and a figure).

Both render the whole picture (single scattering included, ours by quadrature along one eye ray a pixel), on one core.
relMSE against a reference R with its own noise removed: mean((I - A)(I - B) / (R^2 + 0.01 mean(R)^2)) with two
independent halves A, B of the reference. Needs mitsuba (extra "peer") and, for llvm_ad_rgb, DRJIT_LIBLLVM_PATH.
"times_sooner" is the time that Mitsuba takes to the same relMSE (its own falls as 1 / time) over ours.
Usage: taskset -c 0 python experiments/instant_equal_time.py cube|cube_g|plume [--size 64] [--variant llvm_ad_rgb].
"""

import argparse
import os
import time
from functools import partial

os.environ.setdefault("XLA_FLAGS", "--xla_cpu_multi_thread_eigen=false")

import jax
import jax.numpy as jnp
import numpy as np
from instant_common import SCENES, figure, out_folder, pictures, square_camera, write_csv

from jaxvol import lights as primary
from jaxvol import media
from jaxvol.methods import instant_multiple_scattering as ims
from jaxvol.methods.instant_multiple_scattering import compensation, eye_rays, receivers, rendering
from jaxvol.methods.instant_multiple_scattering.receivers import Points

NODES = 20  # points per eye ray for single scattering
SPP = (16, 64, 256)
OURS = {  # options, and numbers of light paths
    "every light": ({"max_lights": None}, (1024, 4096)),
    "virtual ray lights": ({"lights": "rays"}, (1024, 2048)),
    "chosen lights": ({"max_lights": 1024}, (4096, 16384)),
    "more chosen lights": ({"max_lights": 2048, "num_direct": 8}, (16384, 32768)),
    "low resolution, every light": ({"upsample": 4, "max_lights": None, "num_direct": 16}, (4096, 16384)),
    "low resolution, chosen lights": ({"upsample": 4, "max_lights": 4096, "num_direct": 32}, (16384, 32768)),
}


def mitsuba_scene(scene, size):
    """The same medium, light and camera for Mitsuba; the medium fills a box without a surface."""
    import mitsuba as mi

    bounds = np.asarray(scene.medium.bounds)
    sigma_t = float(media.sigma_t(scene.medium)[0])
    albedo = float(scene.medium.sigma_s[0]) / sigma_t
    phase = {"type": "hg", "g": float(scene.medium.g)}
    to_world = mi.ScalarTransform4f().translate(list(map(float, bounds[0]))).scale(list(map(float, bounds[1] - bounds[0])))
    if scene.medium.density is None:
        medium = {"type": "homogeneous", "albedo": albedo, "sigma_t": sigma_t, "phase": phase}
    else:
        grid = np.ascontiguousarray(np.transpose(np.asarray(scene.medium.density), (2, 1, 0)))[..., None]
        volume = {"type": "gridvolume", "grid": mi.VolumeGrid(grid), "to_world": to_world, "wrap_mode": "clamp"}
        medium = {"type": "heterogeneous", "albedo": albedo, "sigma_t": volume, "scale": sigma_t, "phase": phase}
    center, half = 0.5 * (bounds[0] + bounds[1]), 0.5 * (bounds[1] - bounds[0])
    cube = mi.ScalarTransform4f().translate(list(map(float, center))).scale(list(map(float, half)))
    return mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "volpath", "max_depth": 1000, "rr_depth": 50, "hide_emitters": True},
            "sensor": {
                "type": "perspective",
                "fov": float(np.degrees(0.6)),
                "fov_axis": "y",
                "to_world": mi.ScalarTransform4f().look_at(origin=[0, 0, 4], target=[0, 0, 0], up=[0, 1, 0]),
                "film": {"type": "hdrfilm", "width": size, "height": size, "rfilter": {"type": "box"}, "pixel_format": "rgb"},
                "sampler": {"type": "independent"},
            },
            "light": {
                "type": "point",
                "position": list(map(float, scene.point_lights.position[0])),
                "intensity": {"type": "rgb", "value": list(map(float, scene.point_lights.intensity[0]))},
            },
            "box": {"type": "cube", "to_world": cube, "bsdf": {"type": "null"}, "interior": medium},
        }
    )


@partial(jax.jit, static_argnames="plan")
def single_scattering(scene, camera, index, seed, *, plan):
    """Light scattered once: Gauss-Legendre quadrature along one jittered eye ray per pixel."""
    context = rendering.Context(scene, None, None, None, plan, seed, scene.medium)
    xy = jnp.stack([index % camera.width, index // camera.width], axis=-1).astype(jnp.float32)
    xy, coverage = eye_rays.choose_in_pixel(scene, camera, xy, index, seed)
    origin, direction, _, _, _ = eye_rays.cast(context, camera, xy, index)
    t0, t1 = media.box_interval(scene.medium.bounds, origin, direction)
    nodes, weights = np.polynomial.legendre.leggauss(NODES)
    steps = max(plan.eye_steps, 1)
    u = jnp.full(index.shape, 0.5, jnp.float32)

    def body(total, node):
        x, w = node
        t = t0 + (t1 - t0) * (0.5 + 0.5 * x)
        position = origin + t[:, None] * direction
        density = media.density(scene.medium, position)
        points = Points(position, -direction, density[:, None] * scene.medium.sigma_s, None)
        sample = primary.sample_light(scene, position, u, u, u)
        value = compensation.direct_light(scene, points, sample, None, isotropic=plan.isotropic, num_steps=steps)
        before = receivers.column_between(scene.medium, origin + t0[:, None] * direction, position, num_steps=steps)
        tau = jnp.exp(-before[:, None] * media.sigma_t(scene.medium))
        return total + tau * value * (0.5 * w * (t1 - t0))[:, None], None

    zero = jnp.zeros(origin.shape, jnp.float32)
    total, _ = jax.lax.scan(body, zero, (jnp.float32(nodes), jnp.float32(weights)))
    return jnp.where((t1 > t0)[:, None], total * coverage[:, None], 0.0)


def ours(scene, camera, plan, seed):
    """The whole picture of one set of lights, and the CPU seconds that it took."""
    start = time.process_time()
    images, counts = rendering.render_set(scene, camera, plan, seed=seed, sizes=SIZES.setdefault(plan, {}))
    total = sum(images.values())
    index = jnp.arange(len(total), dtype=jnp.uint32)
    total = total + np.asarray(single_scattering(scene, camera, index, jnp.uint32(seed), plan=plan))
    return total, time.process_time() - start, counts


SIZES: dict = {}


def relmse(image, a, b):
    """Unbiased for the noise of the reference: a and b are its independent halves."""
    reference = 0.5 * (a + b)
    return float(np.mean((image - a) * (image - b) / (reference**2 + 0.01 * reference.mean() ** 2)))


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scene", choices=list(SCENES))
    parser.add_argument("--size", type=int, default=64)
    parser.add_argument("--variant", default="llvm_ad_rgb")
    parser.add_argument("--reference", type=int, default=4096)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--levels", type=int, default=3)
    parser.add_argument("--only", nargs="*", help="labels of our variants")
    parser.add_argument("--mean-free-paths", type=float, default=0.35)
    arguments = parser.parse_args()
    import drjit
    import mitsuba as mi

    mi.set_variant(arguments.variant)
    drjit.set_thread_count(1)
    scene, camera = SCENES[arguments.scene](), square_camera(arguments.size)
    theirs = mitsuba_scene(scene, arguments.size)

    def render(spp, seed):
        start = time.process_time()
        image = np.array(mi.render(theirs, spp=spp, seed=seed)).reshape(-1, 3)
        return image, time.process_time() - start

    halves = [np.mean([render(256, 1000 + 100 * h + k)[0] for k in range(arguments.reference // 512)], axis=0) for h in (0, 1)]
    rows, kept = [], [0.5 * (halves[0] + halves[1])]
    for spp in SPP:
        render(spp, 1)
        results = [render(spp, 10 + k) for k in range(arguments.repeats)]
        errors = [relmse(image, *halves) for image, _ in results]
        rows.append(
            [
                "mitsuba volpath",
                spp,
                min(s for _, s in results),
                np.mean(errors),
                results[0][0].mean() / kept[0].mean() - 1,
            ]
        )
        print(*rows[-1], flush=True)
    equal = np.mean([r[2] * r[3] for r in rows])  # CPU seconds that Mitsuba takes to relMSE 1: noise falls as 1 / time
    rows = [[*r, equal / (r[2] * r[3])] for r in rows]
    for label, (options, numbers) in OURS.items():
        if arguments.only and label not in arguments.only:
            continue
        if "lights" in options and scene.medium.density is not None:
            continue
        for number in numbers:
            plan = ims.plan(
                scene,
                camera,
                num_paths=number,
                num_levels=arguments.levels,
                mean_free_paths=arguments.mean_free_paths,
                tile=4096,
                **options,
            )
            ours(scene, camera, plan, 1)
            results = [ours(scene, camera, plan, 10 + k) for k in range(arguments.repeats)]
            errors = [relmse(image, *halves) for image, _, _ in results]
            seconds = min(s for _, s, _ in results)
            bias = np.mean([i.mean() for i, _, _ in results]) / kept[0].mean() - 1
            rows.append([label, number, seconds, np.mean(errors), bias, equal / (seconds * np.mean(errors))])
            print(*rows[-1], results[-1][2], flush=True)
        kept.append(results[0][0])
    folder = out_folder()
    write_csv(
        folder / f"equal_time_{arguments.scene}.csv", ["method", "samples", "cpu_s", "relmse", "bias", "times_sooner"], rows
    )
    with figure(folder / f"equal_time_{arguments.scene}.png") as axes:
        for label in dict.fromkeys(r[0] for r in rows):
            axes.loglog([r[2] for r in rows if r[0] == label], [r[3] for r in rows if r[0] == label], "o-", label=label)
        axes.set_xlabel("CPU seconds, one core")
        axes.set_ylabel("relMSE")
        axes.legend()
        axes.set_title(f"{arguments.scene}, {arguments.size}^2")
    shape = (arguments.size, arguments.size, 3)
    scale = 0.7 / np.percentile(kept[0], 99)
    names = ["reference", *dict.fromkeys(r[0] for r in rows[len(SPP) :])]
    pictures(
        folder / f"equal_time_{arguments.scene}_pictures.png",
        [k.reshape(shape) for k in kept],
        columns=3,
        scale=scale,
        titles=names,
    )


if __name__ == "__main__":
    main()
