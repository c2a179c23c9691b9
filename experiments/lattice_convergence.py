"""Steps, applications and time against albedo (Fig. 13), blocks against the global lattice (Fig. 9), Table I, and speed.

    python experiments/lattice_convergence.py [--size 64] [--albedos 0.5 0.9 0.99 0.999] [--cloud FILE.npz] [--parts all]

Fig. 13: a cube of optical thickness 16 under a beam: the paper's plain steps with its sparse-probe stop, source
iteration and (preconditioned) conjugate gradients on sweeps. Parts: solve, plain, blocks, table1, speed.
"""

from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
from jax import lax
from lattice_common import arguments, timed, write_csv

from jaxvol.methods.lattice_boltzmann import preconditioner, stepping
from jaxvol.methods.lattice_boltzmann.lattice import coefficients, lattice
from jaxvol.methods.lattice_boltzmann.solver import solve

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
    """Table I: a ray history buffer of k steps interleaves marching and diffusion; the steady state is the same for all k."""
    lat, source, albedo, x = lattice("paper"), beam(size), 0.9, TAU / size
    co = coefficients(lat, jnp.float32(albedo * x), jnp.float32((1 - albedo) * x))
    deposit = albedo * source
    exact = _solve(jnp.float32(x), jnp.float32(albedo), source, "paper", True).phi
    advance = jax.jit(stepping.steps, static_argnums=(0, 4))
    none, rows = jnp.zeros_like(deposit), []
    for k in (2, 4, 8, 16, 32):
        # light enters k layers, the lattice takes k steps, the next k layers follow; what was deposited goes on shining
        state, shining = stepping.start(lat, source.shape), none
        for first in range(0, size, k):
            layer = (jnp.arange(size) >= first) & (jnp.arange(size) < first + k)
            shining = shining + jnp.where(layer, deposit, 0.0)
            state = advance(lat, co, shining, state, k // 2)
        steps_taken = size
        while True:
            phi = stepping.phi_of(lat, co, deposit, state)
            error = float(jnp.linalg.norm(phi - exact) / jnp.linalg.norm(exact))
            if error < 1e-3 or steps_taken > 1000:
                break
            state = advance(lat, co, deposit, state, 5)
            steps_taken += 10
        with timed() as spent:
            jax.block_until_ready(advance(lat, co, deposit, state, 5))
        rows.append({"k": k, "steps_to_1e-3": steps_taken, "error": error, "cpu_s": spent.cpu / 10 * steps_taken})
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
