"""Time to equal error in a dense, bright medium: the lattice, our path tracer and Mitsuba's volpath.

    python experiments/lattice_equal_time.py [--size 64] [--samples 64] [--resolutions 16 32 64] [--pixel-samples 4 9]

A cube of optical thickness 16 and albedo 0.99 in a slanted parallel beam. The reference is our path tracer with many
samples at `size`; the lattice's relMSE against it is taken with the reference's own variance removed, so that what is left
is the lattice's bias. A path tracer's relMSE falls as 1 / samples: its time to the same relMSE follows from its variance
and its time per sample, both measured here; at another picture size it grows with the number of pixels, and the lattice is
timed there. Times: CPU seconds, warm; Mitsuba by its fastest variant that runs here. `load` says what else ran.
"""

import itertools
import os
import tempfile
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
from lattice_common import arguments, pictures, timed, volume_image, write_csv
from peer_mitsuba import choose_variant, relmse_of_noise

from jaxvol import camera as cameras
from jaxvol import image, mitsuba_export
from jaxvol.methods import lattice_boltzmann, path_tracing
from jaxvol.types import Camera, DirectionalLights, Medium, Scene

TAU, ALBEDO = 16.0, 0.99


def cube():
    """The scene."""
    medium = Medium(
        jnp.asarray([[-0.5] * 3, [0.5] * 3]), jnp.full(3, TAU * ALBEDO), jnp.full(3, TAU * (1 - ALBEDO)), jnp.float32(0)
    )
    beam = np.array([-0.5, -0.7, -0.4])
    sun = DirectionalLights(jnp.asarray([beam / np.linalg.norm(beam)], jnp.float32), jnp.full((1, 3), np.pi))
    return Scene(medium=medium, directional_lights=sun)


def view(size):
    pose = cameras.look_at([1.3, 1.2, 2.0], [0.0, 0.0, 0.0], [0, 1, 0])
    return Camera(jnp.asarray(pose), jnp.float32(0.6), size, size)


def path_traced(scene, chosen):
    """(mean, variance, CPU seconds) of the reference, kept in the results folder in batches."""
    camera = view(chosen.size)
    plan = path_tracing.plan(scene, camera)
    path_tracing.render(scene, camera, plan, seed=99, samples=4)
    means, cpu = [], 0.0
    for batch in range(chosen.batches):
        with timed() as spent:
            found = path_tracing.render(scene, camera, plan, seed=batch, samples=chosen.samples)
        means.append(volume_image(found.mean).astype(np.float64))
        cpu += spent.cpu
        print(f"path tracer: batch {batch + 1} of {chosen.batches}, {spent.cpu:.1f} CPU s", flush=True)
    means = np.stack(means)
    return means.mean(0), means.var(0, ddof=1).mean(-1, keepdims=True) / len(means) * np.ones(3), cpu


def mitsuba_time(scene, chosen):
    """(variance of one sample, CPU seconds a sample, variant) of Mitsuba's volpath at `size`."""
    variant = choose_variant()
    import mitsuba

    mitsuba.set_variant(variant)
    with tempfile.TemporaryDirectory() as folder:
        described = mitsuba_export.to_mitsuba_dict(scene, view(chosen.size), Path(folder), integrator="volpath", scale=20.0)
        loaded = mitsuba.load_dict(described)
        integrator = mitsuba.load_dict({"type": "volpath", "max_depth": -1})
        draw = lambda seed: np.array(mitsuba.render(loaded, integrator=integrator, seed=seed, spp=chosen.samples), float)  # noqa: E731
        draw(1000)
        with timed() as spent:
            batches = np.stack([draw(seed) for seed in range(chosen.batches)])
    return batches.mean(0), batches.var(0, ddof=1) * chosen.samples, spent.cpu / chosen.samples / chosen.batches, variant


def main():
    chosen = arguments(__doc__, size=64, samples=64, batches=8, resolutions=[16, 32, 64], sizes=[64, 256], pixel_samples=[4, 9])
    scene = cube()
    mean, variance, cpu = path_traced(scene, chosen)
    total = chosen.samples * chosen.batches
    reference_relmse = relmse_of_noise(variance, mean)
    per_sample = cpu / total
    peer_mean, peer_variance, peer_per_sample, variant = mitsuba_time(scene, chosen)
    # relMSE times seconds: the constant of a path tracer
    ours = reference_relmse * cpu
    peer = relmse_of_noise(peer_variance, mean) * peer_per_sample
    print(f"path tracer {per_sample:.3f} s a sample, Mitsuba {variant} {peer_per_sample:.3f}; power ratio "
          f"{mean.mean() / peer_mean.mean():.4f}; relMSE x s: ours {ours:.3g}, Mitsuba's {peer:.3g}")  # fmt: skip
    rows, images, titles = [], [mean], [f"path tracer, {total} samples, {cpu:.0f} CPU s"]
    for resolution, pixel_samples in itertools.product(chosen.resolutions, chosen.pixel_samples):
        options = {"resolution": resolution, "samples_per_pixel": pixel_samples}
        plan = lattice_boltzmann.plan(scene, view(chosen.size), **options)
        picture = volume_image(lattice_boltzmann.render(scene, view(chosen.size), plan).mean)
        relmse = image.relmse(picture, mean, variance=variance)
        images.append(picture)
        titles.append(f"lattice {resolution}, {pixel_samples} samples: relMSE {relmse:.2g}")
        for size in chosen.sizes:
            camera = view(size)
            lattice_boltzmann.render(scene, camera, plan)
            with timed() as spent:
                jax.block_until_ready(lattice_boltzmann.render(scene, camera, plan).mean)
            share = (size / chosen.size) ** 2
            slow, peer_s = share * ours / relmse, share * peer / relmse
            rows.append(options | {
                "size": size, "relmse": relmse, "bias": image.bias(picture, mean),
                "relative_l1": image.relative_l1(picture, mean, block=2), "reference_relmse": reference_relmse,
                "cpu_s": spent.cpu, "path_tracer_s": slow, "mitsuba_s": peer_s, "mitsuba_variant": variant,
                "times_faster": slow / spent.cpu, "times_faster_than_mitsuba": peer_s / spent.cpu, "load": os.getloadavg()[0],
            })  # fmt: skip
    write_csv(chosen.out / "equal_time.csv", rows)
    pictures(chosen.out / "equal_time_pictures.png", images, titles, columns=4)
    fig, axis = plt.subplots(figsize=(5, 3.4), constrained_layout=True)
    for size in chosen.sizes:
        mine = [r for r in rows if r["size"] == size and r["samples_per_pixel"] == chosen.pixel_samples[-1]]
        errors = [r["relmse"] for r in mine]
        (line,) = axis.loglog([r["cpu_s"] for r in mine], errors, "o-", label=f"lattice, {size}^2")
        for key, style, label in (("path_tracer_s", "--", "path tracer"), ("mitsuba_s", ":", "Mitsuba")):
            axis.loglog([r[key] for r in mine], errors, style, color=line.get_color(), label=f"{label}, {size}^2")
    axis.set(xlabel="CPU seconds", ylabel="relMSE", title=f"cube, tau {TAU:g}, albedo {ALBEDO:g}")
    axis.legend(fontsize=7)
    fig.savefig(chosen.out / "equal_time.png", dpi=110)


if __name__ == "__main__":
    main()
