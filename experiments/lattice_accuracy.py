"""The lattice against Monte Carlo in a cube and exact slabs (specification, section 7; test problems T4 and T5).

    python experiments/lattice_accuracy.py [--photons 1000000] [--resolutions 16 32]

Cube: unit cube of optical thickness 16, albedo 0.9; a collimated beam (a square of a quarter of the face) or a point
source at the centre; fluence of the light scattered at least twice, on 8^3 blocks, relative L1. The source of the lattice
is the density of first collisions. Slab: emission density against the integral equation, and reflectance and
transmittance by radiance.
"""

import jax
import jax.numpy as jnp
import numpy as np
from lattice_common import arguments, timed, write_csv
from scipy.special import exp1

from jaxvol.methods import lattice_boltzmann
from jaxvol.methods.lattice_boltzmann import fine_sweeps, preconditioner
from jaxvol.methods.lattice_boltzmann.lattice import coefficients, lattice
from jaxvol.methods.lattice_boltzmann.solver import solve
from jaxvol.types import DirectionalLights, Medium, Rays, Scene

BLOCKS = 8
SIDE = 0.25


def first_collisions(case, tau, count):
    """[N, N, N] power absorbed or scattered at first collisions out of one watt, exact to the quadrature's error."""
    if case == "beam":
        edges = np.linspace(0, 1, count + 1)
        depth = np.exp(-tau * edges[:-1]) - np.exp(-tau * edges[1:])
        covered = np.clip(np.minimum(edges[1:], 0.5 + SIDE / 2) - np.maximum(edges[:-1], 0.5 - SIDE / 2), 0, None) / SIDE
        return covered[:, None, None] * covered[None, :, None] * depth[None, None, :]
    fine = 4 if count <= 16 else 2
    centers = (np.arange(count * fine) + 0.5) / (count * fine) - 0.5
    total = np.zeros((count,) * 3)
    near = 3  # voxels about the source are summed by radial samples instead
    x, y, z = np.meshgrid(centers, centers, centers, indexing="ij", sparse=True)
    r = np.sqrt(x * x + y * y + z * z)
    density = tau * np.exp(-tau * r) / (4 * np.pi * r * r) / (count * fine) ** 3
    total = density.reshape(count, fine, count, fine, count, fine).sum((1, 3, 5))
    low, high = count // 2 - near, count // 2 + near
    rng = np.random.default_rng(0)
    direction = rng.normal(size=(4_000_000, 3)).astype(np.float32)
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    point = 0.5 + direction * rng.exponential(1 / tau, len(direction)).astype(np.float32)[:, None]
    box, _ = np.histogramdd(point, bins=[np.linspace(0, 1, count + 1)] * 3)
    total[low:high, low:high, low:high] = (box / len(direction))[low:high, low:high, low:high]
    return total


def monte_carlo(case, tau, albedo, photons, seed=0):
    """[8, 8, 8] collisions of photons that were scattered before, per photon: tau times their fluence, by analogue walks."""
    rng = np.random.default_rng(seed)
    counts = np.zeros(BLOCKS**3)
    for _ in range(max(photons // 250_000, 1)):
        n = min(photons, 250_000)
        if case == "beam":
            position = np.stack([0.5 + SIDE * (rng.random(n) - 0.5), 0.5 + SIDE * (rng.random(n) - 0.5), np.zeros(n)], 1)
            direction = np.tile([0.0, 0.0, 1.0], (n, 1))
        else:
            position, direction = np.full((n, 3), 0.5), _isotropic(rng, n)
        first = True
        while len(position):
            position = position + direction * rng.exponential(1 / tau, len(position))[:, None]
            position = position[np.all((position > 0) & (position < 1), axis=1)]
            if not first:
                cell = (position * BLOCKS).astype(int)
                counts += np.bincount((cell[:, 0] * BLOCKS + cell[:, 1]) * BLOCKS + cell[:, 2], minlength=BLOCKS**3)
            position = position[rng.random(len(position)) < albedo]
            direction, first = _isotropic(rng, len(position)), False
    return (counts / (max(photons // 250_000, 1) * min(photons, 250_000))).reshape((BLOCKS,) * 3)


def _isotropic(rng, n):
    z, phi = rng.uniform(-1, 1, n), rng.uniform(0, 2 * np.pi, n)
    r = np.sqrt(1 - z * z)
    return np.stack([r * np.cos(phi), r * np.sin(phi), z], 1)


def collisions(name, corrections, tau, albedo, source):
    """[8, 8, 8] tau * fluence of scattered light from the lattice."""
    count = source.shape[0]
    h = tau / count
    deposit = jnp.asarray(albedo * source, jnp.float32)
    lat = lattice(name)

    @jax.jit
    def solution(deposit):
        co = coefficients(lat, jnp.float32(albedo * h), jnp.float32((1 - albedo) * h))
        levels = preconditioner.build(deposit.shape, jnp.float32(h), jnp.float32((1 - albedo) * h))
        return solve(lat, co, deposit, levels=levels).phi

    fine = jax.jit(fine_sweeps.transport)
    if not corrections:
        phi = solution(deposit)
    else:
        phi = jnp.zeros_like(deposit)
        for _ in range(1 + corrections):
            defect = fine(jnp.full(deposit.shape, h, jnp.float32), albedo * h * phi + deposit) - phi
            phi = phi + defect + solution(albedo * h * defect)
    k = count // BLOCKS
    return h * np.asarray(phi, float).reshape(BLOCKS, k, BLOCKS, k, BLOCKS, k).sum((1, 3, 5))


def slab_emission(tau=16.0, albedo=0.9, count=32, *, forms=(("paper", 0), ("26", 0), ("26", 2))):
    """Relative L1 of the scattered fluence through a slab, collimated light, against the integral equation in float64."""
    fine = 1600
    z = (np.arange(fine) + 0.5) * tau / fine
    h = tau / fine
    kernel = 0.5 * h * exp1(np.maximum(np.abs(z[:, None] - z[None, :]), 1e-12))
    half = h / 2
    np.fill_diagonal(kernel, 1 - (np.exp(-half) - half * exp1(half)))  # the exact integral of E1 / 2 over the own cell
    exact = np.linalg.solve(np.eye(fine) - albedo * kernel, albedo * np.exp(-z))
    width = 48.0
    medium = Medium(
        jnp.asarray([[0, 0, 0], [width, width, tau]], jnp.float32), jnp.full(3, albedo), jnp.full(3, 1 - albedo), jnp.float32(0)
    )
    sun = DirectionalLights(jnp.asarray([[0.0, 0, 1]]), jnp.ones((1, 3)))
    scene = Scene(medium=medium, directional_lights=sun)
    rows = []
    for name, corrections in forms:
        plan = lattice_boltzmann.plan(
            scene, None, lattice=name, corrections=corrections, resolution=round(width / tau * count), rays_per_voxel=1.0
        )
        light = lattice_boltzmann.illuminate(scene, plan)
        fluence = np.asarray(light.scattered + light.from_light)[0] / float(light.materials.grid.voxel) ** 2
        middle = fluence.shape[0] // 2
        emission = albedo * fluence[middle, middle]
        expected = exact.reshape(count, -1).mean(1)
        error = float(np.abs(emission - expected).sum() / expected.sum())
        rows.append({"case": "slab emission", "lattice": name, "corrections": corrections, "resolution": count, "error": error})
    return rows


def slab_radiance():
    """R and T of slabs (T4), by the hemisphere's radiance at the middle of a wide slab."""
    rows = []
    for tau, mu0, reflectance, transmittance, count, width in (
        (1.0, 1.0, 0.341329, 0.658671, 8, 12.0),
        (2.0, 1.0, 0.517515, 0.482485, 8, 20.0),
        (8.0, 1.0, 0.821804, 0.178196, 16, 48.0),
        (1.0, 0.5, 0.498376, 0.501624, 8, 12.0),
    ):
        medium = Medium(jnp.asarray([[0, 0, 0], [width, width, tau]], jnp.float32), jnp.ones(3), jnp.zeros(3), jnp.float32(0))
        sun = DirectionalLights(jnp.asarray([[np.sqrt(1 - mu0**2), 0.0, mu0]], jnp.float32), jnp.full((1, 3), 1 / mu0))
        scene = Scene(medium=medium, directional_lights=sun)
        for corrections in (0, 2):
            plan = lattice_boltzmann.plan(
                scene, None, corrections=corrections, resolution=round(width * count / tau), rays_per_voxel=1.0, view_step=0.25
            )
            light = lattice_boltzmann.illuminate(scene, plan)
            up, down = (exitance(scene, plan, light, tau, width, side) for side in (0, 1))
            down += np.exp(-tau / mu0)
            rows.append({
                "case": f"slab tau {tau:g} mu0 {mu0:g}", "corrections": corrections, "resolution": count,
                "R": up, "R_error": up / reflectance - 1, "T": down, "T_error": down / transmittance - 1,
            })  # fmt: skip
    return rows


def exitance(scene, plan, light, tau, width, side):
    """Irradiance that leaves the middle of a slab's face, by quadrature over the hemisphere of radiance."""
    nodes, weights = np.polynomial.legendre.leggauss(12)
    mu, phi = 0.5 * (nodes + 1), (np.arange(8) + 0.5) / 8 * 2 * np.pi
    mu, phi = (a.ravel() for a in np.meshgrid(mu, phi, indexing="ij"))
    weight = np.repeat(0.5 * weights, 8) * mu * 2 * np.pi / 8
    r = np.sqrt(1 - mu * mu)
    direction = np.stack([r * np.cos(phi), r * np.sin(phi), mu if side == 0 else -mu], 1)
    origin = np.array([width / 2, width / 2, 0.0 if side == 0 else tau]) - 1e-3 * direction
    rays = Rays(*(jnp.asarray(x, jnp.float32) for x in (origin, direction, np.full(len(mu), np.inf))))
    found = lattice_boltzmann.radiance(scene, rays, plan, light)
    return float(sum((v[:, 0] * weight).sum() for v in found.values()))


def main():
    chosen = arguments(__doc__, photons=1_000_000, resolutions=[16, 32])
    rows = []
    for case, tau, albedo in (("beam", 16.0, 0.9), ("point", 16.0, 0.9)):
        with timed() as spent:
            exact = monte_carlo(case, tau, albedo, chosen.photons)
        print(f"{case}: Monte Carlo {spent.cpu:.0f} CPU s", flush=True)
        noise = float(np.sqrt(exact * chosen.photons).sum() / (exact * chosen.photons).sum())
        for count in chosen.resolutions:
            source = first_collisions(case, tau, count)
            for name, corrections in (("paper", 0), ("18", 0), ("26", 0), ("26", 2)):
                found = collisions(name, corrections, tau, albedo, source)
                error = float(np.abs(found - exact).sum() / exact.sum())
                rows.append({
                    "case": f"{case} {tau:g} {albedo:g}", "lattice": name, "corrections": corrections, "resolution": count,
                    "error": error, "total": float(found.sum() / exact.sum() - 1), "reference_noise": noise,
                })  # fmt: skip
    write_csv(chosen.out / "accuracy_cube.csv", rows)
    write_csv(chosen.out / "accuracy_slab_emission.csv", slab_emission())
    write_csv(chosen.out / "accuracy_slab.csv", slab_radiance())


if __name__ == "__main__":
    main()
