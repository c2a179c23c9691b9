"""The translucent bunny against the path tracer: error per layer and resolution, time, and time at equal error.

    python experiments/lattice_bunny.py [--samples 64] [--resolutions 32 64] [--size 64]

The reference is kept in the results folder and used again when its settings match.
"""

import jax
import numpy as np
from lattice_common import HERE, arguments, pictures, timed, volume_image, write_csv

from jaxvol import image
from jaxvol.methods import lattice_boltzmann, path_tracing
from jaxvol.scene import load_scene

LAYERS = ("volume_from_light", "volume_from_volume", "volume_from_multiple")


def reference(file, chosen):
    """(mean and variance of the three layers [3, H, W, 3], CPU seconds) of the path tracer."""
    path = chosen.out / f"bunny_reference_{chosen.size}_{chosen.samples}.npz"
    if not path.exists():
        plan = path_tracing.plan(file.scene, file.camera)
        path_tracing.render(file.scene, file.camera, plan, seed=9, samples=2)  # compile
        with timed() as spent:
            found = path_tracing.render(file.scene, file.camera, plan, seed=1, samples=chosen.samples)
        mean, variance = (np.stack([np.asarray(getattr(x, name)) for name in LAYERS]) for x in (found.mean, found.variance))
        np.savez(path, mean=mean, variance=variance, cpu=spent.cpu)
    stored = np.load(path)
    return stored["mean"], stored["variance"], float(stored["cpu"])


def main():
    chosen = arguments(__doc__, samples=64, size=64, resolutions=[32, 64], block=2)
    overrides = [f"camera.width={chosen.size}", f"camera.height={chosen.size}"]
    file = load_scene(HERE / "lattice_bunny.toml", overrides=overrides)
    mean, variance, pt_cpu = reference(file, chosen)
    total, total_variance = mean.sum(0), variance.sum(0)
    rows, images, titles = [], [total], [f"path tracer, {chosen.samples} samples, {pt_cpu:.0f} CPU s"]
    for resolution in chosen.resolutions:
        plan = lattice_boltzmann.plan(file.scene, file.camera, resolution=resolution)
        lattice_boltzmann.render(file.scene, file.camera, plan, seed=0)  # compile
        with timed() as spent:
            found = jax.block_until_ready(lattice_boltzmann.render(file.scene, file.camera, plan, seed=0))
        picture = volume_image(found.mean)
        row = {
            "resolution": resolution,
            "cpu_s": spent.cpu,
            "wall_s": spent.wall,
            "applications": str(np.asarray(found.diagnostics["num_applications"])),
            "relative_l1": image.relative_l1(picture, total, block=chosen.block),
            "bias": image.bias(picture, total),
            "reference_noise": image.reference_noise(total, total_variance, block=chosen.block),
        }
        relmse = image.relmse(picture, total, variance=total_variance)
        # the path tracer's relMSE falls as 1 / samples
        pt_relmse = float(np.mean(total_variance / (total**2 + 0.01 * np.mean(total) ** 2)))
        row |= {
            "relmse": relmse,
            "pt_relmse": pt_relmse,
            "pt_cpu_s": pt_cpu,
            "pt_cpu_at_equal_relmse": pt_cpu * pt_relmse / relmse,
        }
        for k, name in enumerate(LAYERS):
            row[f"l1_{name}"] = image.relative_l1(np.asarray(getattr(found.mean, name)), mean[k], block=chosen.block)
        rows.append(row)
        images.append(picture)
        titles.append(f"lattice {resolution}, {spent.cpu:.1f} CPU s, error {100 * row['relative_l1']:.1f} %")
    write_csv(chosen.out / "bunny.csv", rows)
    pictures(chosen.out / "bunny.png", images, titles)


if __name__ == "__main__":
    main()
