"""Figs. 6 and 7: jitter against banding, four depths of the interval map; errors of the map and of its 8-bit encoding.

    python experiments/deep_screen_space_intervals.py [key=value ...]

Writes out/deep_screen_space/intervals.csv, encoding.csv, jitter.png (Fig. 6), depths.png (Fig. 7), intervals.png.
Error: light of the same senders without transport, against a map of 512 intervals (exact weights).
"""

import jax
import jax.numpy as jnp
import numpy as np
from deep_screen_space_common import PAPER, blocks_with_medium, config, layer, load, out, pictures, plt, write_csv

from jaxvol import camera as cameras
from jaxvol import interval_map as intervals
from jaxvol.methods.deep_screen_space import encoding


def rays_of(camera, pixels):
    """Origins, directions, and the whole length, of flat pixels."""
    rays = cameras.generate_rays(camera, cameras.pixel_centers(camera)[pixels])
    num = len(pixels)
    return rays.origin, rays.direction, jnp.zeros(num), jnp.full(num, 100.0)


@jax.jit
def received(distance, weight, origin, direction, senders):
    """Sum over samples and senders of cos/d^2, isotropic; [R]."""
    points = origin + distance[..., None] * direction
    delta = points[:, :, None] - senders
    squared = jnp.sum(delta * delta, axis=-1) + 1e-3
    away = -senders / jnp.linalg.norm(senders, axis=-1, keepdims=True)
    cosine = jnp.maximum(jnp.sum(delta * away, axis=-1), 0.0) / jnp.sqrt(squared)
    light = jnp.sum(cosine / squared, axis=-1)
    return jnp.sum(light * jnp.broadcast_to(weight[:, 0], light.shape), axis=0)


def map_errors(problem, rays, settings):
    """Rows over N and K: exact midpoint, exact jittered, the paper's."""
    rng = np.random.default_rng(0)
    senders = rng.normal(size=(64, 3))
    senders = jnp.asarray(1.3 * senders / np.abs(senders).max(axis=1, keepdims=True), jnp.float32)
    medium, num = problem.medium, rays[0].shape[0]
    u = jnp.asarray(rng.random(num), jnp.float32)
    value = lambda m: np.asarray(received(m.distance, m.weight, rays[0], rays[1], senders))  # noqa: E731
    truth = value(intervals.interval_map(medium, *rays, num_intervals=512, num_steps=512, grey=True))
    rows = []
    for k in settings["steps"]:
        for n in settings["intervals"] if k == 200 else [16]:
            for name, found in {
                "exact, midpoint": intervals.interval_map(medium, *rays, num_intervals=n, num_steps=k, grey=True),
                "exact, jittered": intervals.interval_map(
                    medium, *rays, num_intervals=n, num_steps=k, grey=True, position="jittered", u=u
                ),
                "paper": intervals.paper_interval_map(medium, *rays, num_intervals=n, num_steps=k),
            }.items():
                error = value(found) - truth
                rows.append([name, n, k, float(np.abs(error).sum() / truth.sum()), float(error.sum() / truth.sum())])
    return rows


def encoding_errors(problem, rays):
    """Rows: the paper's step of 1/200 of the view, a step of the ray's span/255; largest and mean error, saturated rays."""
    found = intervals.interval_map(problem.medium, *rays, num_intervals=15, num_steps=200, grey=True)
    d = np.asarray(found.distance)
    span = d[-1] - d[0]
    rows = []
    for name, origin, step in (
        ("paper: camera, far/200", np.zeros_like(span), np.full_like(span, d.max() / 200)),
        ("paper: camera, far/1000", np.zeros_like(span), np.full_like(span, d.max() / 1000)),
        ("per ray: entry, span/255", d[0], np.maximum(span / 255, 1e-6)),
    ):
        decoded = np.asarray(encoding.decode_distances(encoding.encode_distances(d, origin, step), origin, step))
        error = np.abs(decoded - d)
        rows.append([name, float(error.max()), float(error.mean()), float((error.max(axis=0) > 0.51 * step + 1e-5).mean())])
    return rows


def depth_pictures(problem, camera):
    """Depth of four of sixteen samples at every pixel."""
    rays = rays_of(camera, np.arange(camera.height * camera.width))
    found = intervals.interval_map(problem.medium, *rays, num_intervals=16, num_steps=200, grey=True)
    shown = np.asarray(found.one_minus_transmittance)[0] > 1e-3
    d = np.where(shown, np.asarray(found.distance), np.nan)
    low, high = np.nanmin(d), np.nanmax(d)
    return [np.nan_to_num((d[i] - low) / (high - low)).reshape(camera.height, camera.width) for i in (0, 5, 10, 15)]


def jitter_pictures(problem, camera):
    """Banding of few samples and long steps, and the noise that takes its place; nothing blurred, so that both are seen."""
    bare = {"blur": "none", "radius": "quadratic", "tail": True, "epsilon": 0.03, "num_surfels": 2048}
    coarse = PAPER | bare | {"num_steps": 24, "num_intervals": 5, "strides": (1,) * 6}
    images = [layer(problem, camera, **(coarse | {"position": position})) for position in ("far", "jittered")]
    exact = layer(problem, camera, **bare, transport="none", strides=(1,) * 6)
    pictures("jitter.png", [[*images, exact]], titles=["paper, 5 samples", "jittered", "exact, 16 samples"])


def main():
    """All four."""
    settings = config()
    problem, camera = load(settings["scene"], width=settings["width"], height=settings["height"])
    pixels = blocks_with_medium(problem, camera, size=1, num=settings["rays"]).reshape(-1)
    rays = rays_of(camera, pixels)
    rows = map_errors(problem, rays, settings)
    write_csv("intervals.csv", ["map", "intervals", "steps", "relative_l1", "bias"], rows)
    write_csv("encoding.csv", ["encoding", "max_error", "mean_error", "saturated_rays"], encoding_errors(problem, rays))
    fig, axes = plt.subplots(figsize=(5.0, 3.6), constrained_layout=True)
    for name in dict.fromkeys(r[0] for r in rows):
        axes.loglog(*zip(*[(r[1], r[3]) for r in rows if r[0] == name and r[2] == 200], strict=True), marker="o", label=name)
    axes.set_xticks(settings["intervals"], settings["intervals"])
    axes.minorticks_off()
    axes.set_xlabel("intervals")
    axes.set_ylabel("relative L1")
    axes.legend()
    fig.savefig(out("intervals.png"), dpi=110)
    plt.close(fig)
    fig, axes = plt.subplots(1, 4, figsize=(12.0, 2.6), constrained_layout=True)
    for axis, image, i in zip(axes, depth_pictures(problem, camera), (1, 6, 11, 16), strict=True):
        axis.imshow(image, cmap="gray")
        axis.set_title(f"depth of sample {i} of 16", fontsize=8)
        axis.set_axis_off()
    fig.savefig(out("depths.png"), dpi=110)
    plt.close(fig)
    jitter_pictures(problem, camera)


if __name__ == "__main__":
    main()
