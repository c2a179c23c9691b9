"""Steps, applications and time against albedo (Fig. 13), blocks against the global lattice (Fig. 9), Table I, and speed.

    python experiments/lattice_convergence.py [--size 64] [--albedos 0.5 0.9 0.99 0.999] [--cloud FILE.npz] [--parts all]

Fig. 13: a cube of optical thickness 16 under a beam: the paper's plain steps with its sparse-probe stop, source
iteration and (preconditioned) conjugate gradients on sweeps. Parts: solve, plain, blocks, table1, speed, picture (whole
pictures at 1024 x 1024 against albedo, with the plain steps and with ours).
"""

import time
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
from jax import lax
from lattice_common import arguments, timed, write_csv

from jaxvol import camera as cameras
from jaxvol.methods import lattice_boltzmann
from jaxvol.methods.lattice_boltzmann import marching, preconditioner, stepping
from jaxvol.methods.lattice_boltzmann.lattice import coefficients, lattice
from jaxvol.methods.lattice_boltzmann.materials import Grid, Materials
from jaxvol.methods.lattice_boltzmann.solver import solve
from jaxvol.types import Camera, DirectionalLights, Medium, Scene

TAU = 16.0


def beam(count):
    """[N, N, N] first collisions of a beam over a quarter of the face's width."""
    z = np.arange(count) * TAU / count
    source = np.zeros((count,) * 3, np.float32)
    middle = slice(3 * count // 8, 5 * count // 8)
    source[middle, middle, :] = np.exp(-z) - np.exp(-z - TAU / count)
    return jnp.asarray(source)


def cloud(path):
    """(sigma_t h, first collisions) of a cloud whose densest voxel has thickness 1, lit along y."""
    density = np.load(path)["density"].astype(np.float32)
    thickness = jnp.asarray(density / density.max())
    return thickness, thickness * jnp.exp(thickness - jnp.cumsum(thickness, axis=1))


@partial(jax.jit, static_argnames=("name", "preconditioned"))
def _solve(extinction, albedo, source, name, preconditioned):
    lat = lattice(name)
    co = coefficients(lat, albedo * extinction, (1 - albedo) * extinction)
    levels = preconditioner.build(source.shape, extinction, (1 - albedo) * extinction) if preconditioned else None
    return solve(lat, co, albedo * source, levels=levels, max_steps=500)


@partial(jax.jit, static_argnames="name")
def _plain(extinction, albedo, source, name):
    lat = lattice(name)
    co = coefficients(lat, albedo * extinction, (1 - albedo) * extinction)
    found = stepping.iterate(lat, co, albedo * source)
    return found.phi, found.num_steps, found.change


def solves(media, albedos):
    """Applications and CPU seconds of the sweep solvers."""
    rows = []
    for label, (extinction, source) in media.items():
        for name in ("paper", "26"):
            for preconditioned in (False, True):
                _solve(extinction, jnp.float32(0.5), source, name, preconditioned).phi.block_until_ready()
                for albedo in albedos:
                    with timed() as spent:
                        found = jax.block_until_ready(_solve(extinction, jnp.float32(albedo), source, name, preconditioned))
                    rows.append({
                        "medium": label, "lattice": name, "solver": "PCG" if preconditioned else "CG", "albedo": albedo,
                        "applications": int(found.num_applications), "residual": float(found.residual),
                        "cpu_s": spent.cpu, "wall_s": spent.wall,
                    })  # fmt: skip
    return rows


def plain(size, albedos):
    """The paper's iteration: steps, CPU seconds, distance from the converged state."""
    rows, extinction, source = [], jnp.float32(TAU / size), beam(size)
    _plain(extinction, jnp.float32(0.1), source, "paper")[0].block_until_ready()
    for albedo in albedos:
        exact = _solve(extinction, jnp.float32(albedo), source, "paper", True).phi
        with timed() as spent:
            phi, steps, _ = jax.block_until_ready(_plain(extinction, jnp.float32(albedo), source, "paper"))
        error = float(jnp.linalg.norm(phi - exact) / jnp.linalg.norm(exact))
        rows.append({"medium": "cube", "lattice": "paper", "solver": "plain", "albedo": albedo, "applications": int(steps),
                     "residual": error, "cpu_s": spent.cpu, "wall_s": spent.wall})  # fmt: skip
    return rows


def picture(size, albedos, pixels=1024):
    """CPU seconds of a whole picture of the cube by stage, grey, one sample a pixel: plain steps, and sweeps with PCG."""
    rows = []
    pose = cameras.look_at([1.3, 1.2, 2.0], [0.0, 0.0, 0.0], [0, 1, 0])
    camera = Camera(jnp.asarray(pose), jnp.float32(0.6), pixels, pixels)
    beam_light = DirectionalLights(jnp.asarray([[-0.527, -0.738, -0.422]]), jnp.full((1, 3), np.pi))
    for lattice_name in ("paper", "26"):
        for albedo in albedos:
            bounds = jnp.asarray([[-0.5] * 3, [0.5] * 3])
            medium = Medium(bounds, jnp.full(3, TAU * albedo), jnp.full(3, TAU * (1 - albedo)), jnp.float32(0))
            scene = Scene(medium=medium, directional_lights=beam_light)
            plan = lattice_boltzmann.plan(scene, camera, resolution=size, lattice=lattice_name, samples_per_pixel=1)
            if albedo == albedos[0]:  # compile
                lattice_boltzmann.render(scene, camera, plan)
            stages, last = {}, [time.process_time()]

            def on_stage(name, stages=stages, last=last):
                now = time.process_time()
                stages[name], last[0] = now - last[0], now

            found = lattice_boltzmann.render(scene, camera, plan, on_stage=on_stage)
            rest = stages["voxelize"] + stages["march"] + stages["view"]
            row = {
                "pixels": pixels,
                "voxels": size,
                "albedo": albedo,
                "march_cpu_s": stages["march"],
                "view_cpu_s": stages["view"],
            }
            how = {"lattice": lattice_name, "solver": "sweeps, PCG" + (", corrected" if plan.corrections else "")}
            rows.append(row | how | {"steps": int(found.diagnostics["num_applications"][0]), "solve_cpu_s": stages["solve"],
                                     "picture_cpu_s": rest + stages["solve"]})  # fmt: skip
            if lattice_name == "paper":
                light = lattice_boltzmann.illuminate(scene, plan)
                deposit = light.materials.scattering[0] * light.from_light[0] / jnp.float32(albedo)
                extinction = light.materials.scattering[0] + light.materials.absorption[0]
                jax.block_until_ready(_plain(extinction, jnp.float32(albedo), deposit, "paper"))  # warm
                with timed() as spent:
                    _, steps, _ = jax.block_until_ready(_plain(extinction, jnp.float32(albedo), deposit, "paper"))
                rows.append(row | {"lattice": "paper", "solver": "plain steps", "steps": int(steps), "solve_cpu_s": spent.cpu,
                                   "picture_cpu_s": rest + spent.cpu})  # fmt: skip
    return rows


def blocks(size=32):
    """Fig. 9: 4^3 blocks with frozen interfaces reach the same state, in fewer exchanges and more work."""
    rows, lat, source = [], lattice("paper"), beam(size)
    run = jax.jit(stepping.iterate_blocks, static_argnums=0, static_argnames=("num_exchanges", "inner"))
    for albedo in (0.5, 0.9):
        x = TAU / size
        co = coefficients(lat, jnp.float32(albedo * x), jnp.float32((1 - albedo) * x))
        exact = _solve(jnp.float32(x), jnp.float32(albedo), source, "paper", True).phi
        for inner in (0, 1, 3, 7):
            for exchanges in (10, 20, 40, 80, 160):
                found = run(lat, co, albedo * source, num_exchanges=exchanges, inner=inner)
                error = float(jnp.linalg.norm(found.phi - exact) / jnp.linalg.norm(exact))
                rows.append(
                    {
                        "albedo": albedo,
                        "inner_steps": inner,
                        "exchanges": exchanges,
                        "steps": exchanges * (inner + 1),
                        "error": error,
                    }
                )
    return rows


def table1(size=32):
    """Table I: march k ray steps, then the lattice k steps, and so on; the steady state is the same for all k."""
    lat, albedo, x = lattice("paper"), 0.9, TAU / size
    shape = (size,) * 3
    scattering, absorption = jnp.full((1, *shape), albedo * x), jnp.full((1, *shape), (1 - albedo) * x)
    materials = Materials(Grid(jnp.zeros(3), jnp.float32(1.0), shape), scattering, absorption, None, None, None)
    co = coefficients(lat, scattering[0], absorption[0])
    across = size * (0.375 + 0.25 * (np.stack(np.meshgrid(np.arange(64), np.arange(64)), -1).reshape(-1, 2) + 0.5) / 64)
    origin = np.concatenate([across, np.full((len(across), 1), -1.0)], axis=1)
    rays = (
        origin,
        np.tile([0.0, 0, 1], (len(origin), 1)),
        np.full(len(origin), np.inf),
        np.full((len(origin), 1), 1 / len(origin)),
    )
    whole = scattering[0] * marching.march_straight(materials, *rays).track[0]
    exact = _solve(jnp.float32(x), jnp.float32(albedo), whole / albedo, "paper", True).phi
    rows = []

    def run(k):
        deposits = (scattering[0] * track[0] for _, track in marching.march_straight_by(materials, *rays, num_steps=k))
        return jax.block_until_ready(stepping.interleave(lat, co, deposits, pairs_per_deposit=max(k // 2, 1)))

    for k in (2, 4, 8, 16, 32):
        run(k)
        with timed() as spent:
            found = run(k)
        error = float(jnp.linalg.norm(found.phi - exact) / jnp.linalg.norm(exact))
        rows.append(
            {"k": k, "steps": int(found.num_steps), "error": error, "cpu_s": spent.cpu, "converged": bool(found.converged)}
        )
    return rows


def speed(size):
    """A plain six-direction step against an in-loop elementwise pass over the same arrays; ns per voxel, best of four."""
    lat, source = lattice("paper"), beam(size)
    extinction = jnp.full(source.shape, TAU / size)
    co = coefficients(lat, 0.9 * extinction, 0.1 * extinction)
    state = stepping.start(lat, source.shape)
    advance = jax.jit(stepping.steps, static_argnums=(0, 4))

    @partial(jax.jit, static_argnums=3)
    def elementwise(fields, a, b, count):
        return lax.fori_loop(0, count, lambda _, f: tuple(a * x + b for x in f), fields)

    fields = tuple(jnp.zeros(source.shape) for _ in range(6))
    runs = {
        "lattice step": lambda: advance(lat, co, source, state, 10),
        "elementwise pass": lambda: elementwise(fields, extinction, source, 20),
    }
    best = {}
    for label, run in runs.items():
        jax.block_until_ready(run())
        times = []
        for _ in range(4):
            with timed() as spent:
                jax.block_until_ready(run())
            times.append(spent.cpu / 20 / source.size * 1e9)
        best[label] = min(times)
    share = best["elementwise pass"] / best["lattice step"]
    return [{"size": size, "lattice_step_ns": best["lattice step"], "elementwise_ns": best["elementwise pass"], "share": share}]


def main():
    chosen = arguments(__doc__, size=64, albedos=[0.5, 0.9, 0.99, 0.999], cloud="", parts="all")
    wanted = lambda part: chosen.parts == "all" or part in chosen.parts.split(",")  # noqa: E731
    if wanted("speed"):
        write_csv(chosen.out / "step_speed.csv", speed(64) + speed(128))
    if wanted("picture"):
        found = picture(chosen.size, chosen.albedos)
        write_csv(chosen.out / "figure13_pictures.csv", found)
        fig, axes = plt.subplots(1, 2, figsize=(8.4, 3.4), constrained_layout=True)
        for label in sorted({(r["lattice"], r["solver"]) for r in found}):
            mine = [r for r in found if (r["lattice"], r["solver"]) == label]
            for axis, key in zip(axes, ("steps", "picture_cpu_s"), strict=True):
                axis.loglog([1 - r["albedo"] for r in mine], [r[key] for r in mine], "o-", label=" ".join(label))
        axes[0].set(xlabel="1 - albedo", ylabel="steps or applications")
        axes[1].set(xlabel="1 - albedo", ylabel="CPU seconds of a 1024 x 1024 picture")
        axes[0].legend(fontsize=7)
        fig.savefig(chosen.out / "figure13_pictures.png", dpi=110)
    if wanted("table1"):
        write_csv(chosen.out / "table1.csv", table1())
    if wanted("blocks"):
        found = blocks()
        write_csv(chosen.out / "figure9.csv", found)
        fig, axes = plt.subplots(1, 2, figsize=(8, 3.2), constrained_layout=True)
        for axis, albedo in zip(axes, (0.5, 0.9), strict=True):
            for inner in (0, 1, 3, 7):
                mine = [r for r in found if r["albedo"] == albedo and r["inner_steps"] == inner]
                label = "global" if inner == 0 else f"4^3 blocks, {inner} frozen steps"
                axis.loglog([r["exchanges"] for r in mine], [r["error"] for r in mine], "o-", label=label)
            axis.set(xlabel="exchanges", ylabel="error against the fixed point", title=f"albedo {albedo}")
        axes[0].legend(fontsize=7)
        fig.savefig(chosen.out / "figure9.png", dpi=110)
    if not (wanted("solve") or wanted("plain")):
        return
    media = {"cube": (jnp.float32(TAU / chosen.size), beam(chosen.size))}
    if chosen.cloud:
        media[Path(chosen.cloud).stem] = cloud(chosen.cloud)
    rows = solves(media, chosen.albedos) + (plain(chosen.size, chosen.albedos) if wanted("plain") else [])
    write_csv(chosen.out / f"figure13_{chosen.size}.csv", rows)
    fig, axes = plt.subplots(1, 2, figsize=(8.4, 3.4), constrained_layout=True)
    for label in sorted({(r["medium"], r["lattice"], r["solver"]) for r in rows}):
        mine = [r for r in rows if (r["medium"], r["lattice"], r["solver"]) == label]
        for axis, key in zip(axes, ("applications", "cpu_s"), strict=True):
            axis.loglog([1 - r["albedo"] for r in mine], [r[key] for r in mine], "o-", label=" ".join(label))
    axes[0].set(xlabel="1 - albedo", ylabel="steps or applications")
    axes[1].set(xlabel="1 - albedo", ylabel="CPU seconds, one channel")
    axes[0].legend(fontsize=6)
    fig.savefig(chosen.out / f"figure13_{chosen.size}.png", dpi=110)


if __name__ == "__main__":
    main()
