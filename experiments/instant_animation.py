"""A changing plume with light paths that survive between frames: tracing time and flicker (CSV, figure, frames).

retraced: other random numbers every frame; same numbers: retraced with the same ones; reweighted: the paths of frame 0 with
new throughput; reweighted + renewed: a share of them traced anew each frame. Flicker is the mean absolute change between
frames, less that of the converged animation (many paths). Usage: python experiments/instant_animation.py [--frames 8].
"""

import argparse
import time

import numpy as np
from instant_common import figure, out_folder, pictures, plume, square_camera, write_csv

from jaxvol.methods import instant_multiple_scattering as ims
from jaxvol.methods.instant_multiple_scattering import incremental, light_paths, rendering, virtual_lights

STEP = 0.12  # of the plume's time


def picture(scene, camera, plan, vertices, sizes):
    lights = virtual_lights.virtual_lights(scene, vertices, num_paths=plan.num_paths, sizes=sizes)
    sizes.update(virtual_lights.sizes(lights))
    return sum(rendering.render_set(scene, camera, plan, seed=17, lights=lights)[0].values())


def trace(scene, paths, seed):
    return light_paths.trace(scene, None, seed=seed, paths=paths, max_depth=256)[0]


def animate(mode, scenes, camera, plan, *, share):
    """Frames and the CPU seconds that the light paths of each took."""
    frames, seconds, sizes = [], [], {}
    paths = np.arange(plan.num_paths)
    base, source = None, None
    for k, scene in enumerate(scenes):
        start = time.process_time()
        if mode in ("retraced", "same numbers"):
            vertices = trace(scene, paths, 1 + (k if mode == "retraced" else 0))
        elif k == 0:
            vertices = trace(scene, paths, 1)
        else:
            vertices = incremental.reweighted(source, scene, base, seed=1)
            if mode == "reweighted + renewed":
                paths, gone = incremental.renewed(paths, frame=k, share=share, num_paths=plan.num_paths)
                vertices = incremental.replaced(vertices, trace(scene, gone + plan.num_paths, 1), gone)
        base, source = vertices, scene
        seconds.append(time.process_time() - start)
        frames.append(picture(scene, camera, plan, vertices, sizes))
    return np.array(frames), seconds


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--frames", type=int, default=8)
    parser.add_argument("--size", type=int, default=24)
    parser.add_argument("--paths", type=int, default=1024)
    arguments = parser.parse_args()
    scenes = [plume(24, time=STEP * k) for k in range(arguments.frames)]
    camera = square_camera(arguments.size)
    plan = ims.plan(scenes[0], camera, num_paths=arguments.paths, max_lights=None, num_levels=1, jitter=False)
    many = ims.plan(scenes[0], camera, num_paths=16 * arguments.paths, max_lights=None, num_levels=1, jitter=False)
    converged, _ = animate("same numbers", scenes, camera, many, share=0)
    change = np.abs(np.diff(converged, axis=0)).mean()
    rows, kept = [], []
    for mode in ("retraced", "same numbers", "reweighted", "reweighted + renewed"):
        animate(mode, scenes, camera, plan, share=0.125)
        frames, seconds = animate(mode, scenes, camera, plan, share=0.125)
        flicker = np.abs(np.diff(frames, axis=0)).mean() / converged.mean() - change / converged.mean()
        error = np.abs(frames - converged).mean() / converged.mean()
        rows.append([mode, 1e3 * np.median(seconds[1:]), flicker, error, frames[-1].mean() / converged[-1].mean() - 1])
        print(*rows[-1], flush=True)
        kept.append(frames)
    header = ["mode", "ms_paths_per_frame", "flicker", "relative_l1", "bias_of_last_frame"]
    write_csv(out_folder() / "animation.csv", header, rows)
    with figure(out_folder() / "animation.png") as axes:
        for row, frames in zip(rows, kept, strict=True):
            axes.plot(frames.mean(axis=(1, 2)) / converged.mean(axis=(1, 2)), "o-", label=row[0])
        axes.set_xlabel("frame")
        axes.set_ylabel("mean over converged mean")
        axes.legend()
    shape = (arguments.size, arguments.size, 3)
    shown = [frames[k].reshape(shape) for frames in kept for k in (0, arguments.frames // 2, arguments.frames - 1)]
    titles = [f"{row[0]}, frame {k}" for row in rows for k in (0, arguments.frames // 2, arguments.frames - 1)]
    pictures(out_folder() / "animation_frames.png", shown, columns=3, scale=0.7 / np.percentile(converged, 99), titles=titles)


if __name__ == "__main__":
    main()
