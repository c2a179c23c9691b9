"""Fig. 1: a short sequence in which light, camera, mesh and medium all move; nothing is kept between frames.

    python experiments/animate_deep_screen_space.py [key=value ...]

Writes out/deep_screen_space/animation.gif, animation_frames.png and animation.csv (CPU and wall seconds per frame).
"""

import time

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from deep_screen_space_common import config, load, method, out, pictures, write_csv
from PIL import Image

from jaxvol import camera as cameras
from jaxvol.image import choose_exposure, tone_map


def moved(problem, camera, phase):
    """Scene and camera at a phase in [0, 1): lamp on a circle, walls breathing, column of smoke swaying, camera swaying."""
    turn = 2.0 * np.pi * phase
    lamp = jnp.array([[0.6 * np.cos(turn), 0.8, 0.5 * np.sin(turn)]], jnp.float32)
    vertices = problem.mesh.vertices
    wave = 0.12 * np.sin(turn) * jnp.sin(3.0 * vertices[:, 1]) * (vertices[:, 2] < 0.0)
    vertices = vertices.at[:, 2].add(wave)
    density = problem.medium.density
    x, height = (jnp.arange(n) for n in density.shape[:2])
    sway = jnp.round(0.12 * x.size * jnp.sin(turn + 6.0 * height / height.size) * height / height.size).astype(jnp.int32)
    density = density[jnp.clip(x[:, None] - sway, 0, x.size - 1), height[None]]  # the column bends, more the higher
    eye = [1.1 * np.sin(turn), 0.25 * np.cos(turn), 4.1]
    scene = eqx.tree_at(
        lambda s: (s.point_lights.position, s.mesh.vertices, s.medium.density, s.medium.majorants),
        problem,
        (lamp, vertices, density, None),
    )
    return scene, eqx.tree_at(lambda c: c.world_from_camera, camera, cameras.look_at(eye, [0, 0, 0], [0, 1, 0]))


def main():
    """The sequence."""
    settings = config()
    problem, camera = load("deep_cloud_room", width=settings["width"], height=settings["height"])
    images, rows = [], []
    for index in range(settings["frames"]):
        scene, view = moved(problem, camera, index / settings["frames"])
        cpu, wall = time.process_time(), time.perf_counter()
        plan = method.plan(scene, view, num_surfels=settings["surfels"])
        images.append(np.asarray(method.render(scene, view, plan, seed=index).mean.volume_from_surface))
        rows.append([index, time.process_time() - cpu, time.perf_counter() - wall])
    write_csv("animation.csv", ["frame", "cpu_s", "wall_s"], rows)
    exposure = choose_exposure(np.stack(images).reshape(-1, camera.width, 3).astype(np.float64))
    frames = [Image.fromarray(tone_map(i.astype(np.float64), exposure=exposure)) for i in images]
    frames[0].save(out("animation.gif"), save_all=True, append_images=frames[1:], duration=80, loop=0)
    picked = images[:: max(len(images) // 4, 1)][:4]
    pictures("animation_frames.png", [picked], titles=[f"frame {i * max(len(images) // 4, 1)}" for i in range(len(picked))])


if __name__ == "__main__":
    main()
