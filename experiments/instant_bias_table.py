"""Bias and spread of every mode of clamping and compensation on a problem with an exact answer (CSV and a figure).

Infinite medium, sigma_t 1, albedo .9, g 0, point light of power 1 at distance 1 from the middle of a ray of length 6; light
that scattered at least twice. Exact: 2.27358e-3 from the Fourier solution, here again from Case's solution by quadrature.
The column "paired" is the difference from 4 steps with the same lights, which takes the lights' own noise out. With --scene
plume or room the approximation modes there, as paired differences of the picture's mean from the default.
Usage: python experiments/instant_bias_table.py [--sets 512] [--only MODE ...] [--scene infinite|plume|room].
"""

import argparse
import time

import jax.numpy as jnp
import numpy as np
from instant_common import SCENES, figure, infinite, out_folder, square_camera, write_csv
from scipy import integrate

from jaxvol.methods import instant_multiple_scattering as ims
from jaxvol.methods.instant_multiple_scattering.rendering import gather_rays, make_context, render_set
from jaxvol.methods.instant_multiple_scattering.virtual_lights import sizes as sizes_of

LANES, PATHS = 64, 32
REFERENCE = "4 steps, clamped end"
MODES = {
    "unclamped": {"mean_free_paths": None},
    "clamped only": {"num_levels": 0},
    "1 step, unclamped end": {"num_levels": 1, "end": "unclamped"},
    "1 step, no direct light at the vertex (the paper)": {"num_levels": 1, "end": "unclamped", "direct_at_vertex": False},
    "1 step, reduced clamping": {"num_levels": 1, "end": "reduced"},
    "2 steps, unclamped end": {"num_levels": 2, "end": "unclamped"},
    "2 steps, exponential distance, unclamped end": {"num_levels": 2, "end": "unclamped", "distance": "exponential"},
    "2 steps, clamped end": {"num_levels": 2},
    "3 steps, clamped end (default)": {},
    "4 steps, clamped end": {"num_levels": 4},
    "3 steps, local transmittance": {"transmittance": "local"},
    "3 steps, stratified points": {"sampling": "stratified"},
}


def scattered_fluence(r, *, c=0.9):
    """Fluence of a source of power 1 at distance r less the unscattered part (Case, de Hoffmann and Placzek 1953)."""
    k = 0.5254295127
    diffusive = 2 * k * k * (1 - k * k) / (c * (k * k + c - 1)) * np.exp(-k * r)

    def transient(m):
        shape = (1 - c * m * np.arctanh(m)) ** 2 + (c * np.pi * m / 2) ** 2
        return np.exp(-r / m) / (m * m * shape)

    return (diffusive + integrate.quad(transient, 0, 1, limit=400)[0] - np.exp(-r) / r) / (4 * np.pi * r)


def exact_radiance():
    """Integral of sigma_s phi / (4 pi) exp(-s) along the ray from s = 0 to 6, closest to the source at s = 3."""
    return integrate.quad(lambda s: 0.9 * scattered_fluence(np.hypot(1, s - 3)) / (4 * np.pi) * np.exp(-s), 0, 6)[0]


def run(options, sets):
    """One value per set of lights: the mean of the lanes, and the spread of single lanes."""
    scene = infinite()
    plan = ims.plan(scene, square_camera(8), num_paths=PATHS, light_stride=1, jitter=False, **options)
    origin = jnp.tile(jnp.float32([[-3.0, 0.0, 0.0]]), (LANES, 1))
    direction = jnp.tile(jnp.float32([[1.0, 0.0, 0.0]]), (LANES, 1))
    face = jnp.full(LANES, -1, jnp.int32)
    # The ray ends after 6 mean free paths; what lies beyond contributes nothing to the exact value either.
    end = jnp.full(LANES, 6.0, jnp.float32)
    index = jnp.arange(LANES, dtype=jnp.uint32)
    values, sizes = [], {}
    for k in range(sets):
        context, _ = make_context(scene, plan, seed=7 + k, sizes=sizes)
        sizes.update(sizes_of(context.lights))
        found = gather_rays(context, origin, direction, end, face, index)
        values.append(np.asarray(found["volume_from_volume"] + found["volume_from_multiple"])[:, 0])
    return np.array(values, np.float64)


APPROXIMATIONS = {
    "plume": {
        "clamped only": {"num_levels": 0},
        "2 steps": {"num_levels": 2},
        "local transmittance": {"transmittance": "local"},
        "local transmittance where the gradient is small": {"transmittance": "detected"},
        "maps of columns, 32^2": {"columns": "maps"},
        "marching a coarse copy": {"columns": "mip"},
        "no direct light at the vertex (the paper)": {"direct_at_vertex": False},
    },
    "room": {
        "clamped only": {"num_levels": 0},
        "no visibility of new vertices": {"visibility": "none"},
        "depth maps for new vertices, 32^2": {"visibility": "maps"},
        "depth maps for shadows too, 32^2": {"visibility": "maps", "shadows": "maps"},
        "no direct light at the vertex (the paper)": {"direct_at_vertex": False},
    },
}


def approximations(name, sets):
    """Paired differences of every mode's picture mean from the default's, in shares of it, with standard errors."""
    scene, camera = SCENES[name](), square_camera(12)
    means = {}
    for mode, options in {"default": {}, **APPROXIMATIONS[name]}.items():
        plan = ims.plan(scene, camera, num_paths=256, tile=144, **options)
        sizes = {}
        totals = [sum(render_set(scene, camera, plan, seed=50 + k, sizes=sizes)[0].values()) for k in range(sets)]
        means[mode] = np.array([t.mean(dtype=np.float64) for t in totals])
    rows = []
    for mode in APPROXIMATIONS[name]:
        difference = means[mode] - means["default"]
        scale = means["default"].mean()
        rows.append([mode, difference.mean() / scale, difference.std(ddof=1) / np.sqrt(sets) / scale])
        print(f"{name} {mode:45s} {rows[-1][1]:+.4f} +- {rows[-1][2]:.4f}", flush=True)
    write_csv(out_folder() / f"bias_table_{name}.csv", ["mode", "difference", "se"], rows)
    with figure(out_folder() / f"bias_table_{name}.png", size=(7, 2.5)) as axes:
        axes.barh([r[0] for r in rows], [100 * r[1] for r in rows], xerr=[100 * r[2] for r in rows])
        axes.set_xlabel(f"{name}: difference of the mean from the default, %")


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--sets", type=int, default=512)
    parser.add_argument("--only", nargs="*", default=list(MODES))
    parser.add_argument("--scene", choices=["infinite", *APPROXIMATIONS], default="infinite")
    arguments = parser.parse_args()
    if arguments.scene != "infinite":
        approximations(arguments.scene, arguments.sets)
        return
    exact = exact_radiance()
    print(f"exact {exact:.6g}")
    rows = []
    base = run(MODES[REFERENCE], arguments.sets).mean(axis=1)
    for name in arguments.only:
        start = time.process_time()
        values = run(MODES[name], arguments.sets)
        means = values.mean(axis=1)
        error = means.std(ddof=1) / np.sqrt(len(means))
        paired = (means - base) / exact
        rows.append(
            [
                name,
                means.mean() / exact - 1,
                error / exact,
                paired.mean(),
                paired.std(ddof=1) / np.sqrt(len(means)),
                values.std() / exact,
                time.process_time() - start,
            ]
        )
        print(
            f"{name:52s} bias {rows[-1][1]:+.4f} +- {rows[-1][2]:.4f}  paired {rows[-1][3]:+.4f} +- {rows[-1][4]:.4f}  "
            f"std of a set {rows[-1][5]:.3f}  cpu {rows[-1][6]:.1f} s",
            flush=True,
        )
        header = ["mode", "bias", "se", "paired", "paired_se", "std_per_set", "cpu_s"]
        write_csv(out_folder() / "bias_table.csv", header, rows)
    with figure(out_folder() / "bias_table.png", size=(8, 4)) as axes:
        y = np.arange(len(rows))[::-1]
        axes.errorbar([100 * r[1] for r in rows], y, xerr=[100 * r[2] for r in rows], fmt="o", label="against the exact value")
        axes.errorbar(
            [100 * r[3] for r in rows], y - 0.25, xerr=[100 * r[4] for r in rows], fmt="s", label="paired with 4 steps"
        )
        axes.legend(fontsize=7)
        axes.axvline(0, color="k", lw=0.5)
        axes.set_yticks(y, [r[0] for r in rows], fontsize=7)
        axes.set_xlabel("bias of the mean, % (bars: one standard error)")


if __name__ == "__main__":
    main()
