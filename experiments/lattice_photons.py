"""Refraction coupled with scattering against a photon tracer (the paper's reference, section IV-A): sphere of Fig. 6.

    python experiments/lattice_photons.py [--photons 400000] [--resolution 48]

The tracer here is independent of the lattice: photons enter and leave a sphere by Snell's law and Fresnel's reflectance
at the exact surface, fly straight inside (constant index) and are scattered analogously, also with g > 0; it conserves
energy photon by photon. With the smoothed index of the method photons would bend over the filter's width instead.
Compared are the shares absorbed and leaving, and the radial fluence.
"""

import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import trimesh
from lattice_common import arguments, timed, write_csv

from jaxvol.methods import lattice_boltzmann
from jaxvol.types import DirectionalLights, Medium, Mesh, Scene

RADIUS = 0.5
SHELLS = 8


def fresnel(cos_in, n_from, n_to):
    """(reflectance, cosine behind) for unpolarised light; total reflection gives 1."""
    sine = (n_from / n_to) ** 2 * (1 - cos_in**2)
    cos_out = np.sqrt(np.maximum(1 - sine, 0))
    s = (n_from * cos_in - n_to * cos_out) / (n_from * cos_in + n_to * cos_out)
    p = (n_from * cos_out - n_to * cos_in) / (n_from * cos_out + n_to * cos_in)
    return np.where(sine >= 1, 1.0, 0.5 * (s * s + p * p)), cos_out


def turned(direction, g, rng):
    """Directions after scattering by Henyey and Greenstein's phase function."""
    u, phi = rng.random(len(direction)), 2 * np.pi * rng.random(len(direction))
    cosine = 2 * u - 1 if g == 0 else (1 + g * g - ((1 - g * g) / (1 - g + 2 * g * u)) ** 2) / (2 * g)
    helper = np.where(np.abs(direction[:, :1]) < 0.9, np.array([[1.0, 0, 0]]), np.array([[0.0, 1, 0]]))
    s = np.cross(direction, helper)
    s /= np.maximum(np.linalg.norm(s, axis=1, keepdims=True), 1e-20)
    t = np.cross(direction, s)
    sine = np.sqrt(np.maximum(1 - cosine**2, 0))
    return (sine * np.cos(phi))[:, None] * s + (sine * np.sin(phi))[:, None] * t + cosine[:, None] * direction


def photon_tracer(sigma_s, sigma_a, ior, count, *, g=0.0, seed=0):
    """Books of a parallel beam over the sphere's disk, per photon that meets it: shares and collisions per shell."""
    rng = np.random.default_rng(seed)
    sigma_t = sigma_s + sigma_a
    r, phi = RADIUS * np.sqrt(rng.random(count)), 2 * np.pi * rng.random(count)
    x, y = r * np.cos(phi), r * np.sin(phi)
    position = np.stack([x, y, -np.sqrt(RADIUS**2 - r**2)], 1)
    normal = position / RADIUS
    direction = np.tile([0.0, 0, 1], (count, 1))
    cosine = -np.sum(direction * normal, 1)
    reflected, behind = fresnel(cosine, 1.0, ior)
    enters = rng.random(count) >= reflected
    books = {"mirrored": 1 - enters.mean(), "absorbed": 0.0, "left_unscattered": 0.0, "left_scattered": 0.0}
    direction = direction / ior + (cosine / ior - behind)[:, None] * normal
    position, direction = position[enters], direction[enters]
    scattered = np.zeros(len(position), bool)
    shells = np.zeros(SHELLS)
    while len(position):
        b = np.sum(position * direction, 1)
        exit_ = -b + np.sqrt(np.maximum(b * b + RADIUS**2 - np.sum(position**2, 1), 0))
        flight = rng.exponential(1 / sigma_t, len(position))
        collides = flight < exit_
        position = position + direction * np.minimum(flight, exit_)[:, None]
        # at the surface: reflected inside, or gone
        normal = position / np.linalg.norm(position, axis=1, keepdims=True)
        outward = np.clip(np.sum(direction * normal, 1), 1e-9, 1)
        back, _ = fresnel(outward, ior, 1.0)
        leaves = ~collides & (rng.random(len(position)) >= back)
        books["left_unscattered"] += np.sum(leaves & ~scattered) / count
        books["left_scattered"] += np.sum(leaves & scattered) / count
        mirror = direction - 2 * outward[:, None] * normal
        shell = np.minimum((np.linalg.norm(position, axis=1) / RADIUS * SHELLS).astype(int), SHELLS - 1)
        shells += np.bincount(shell[collides], minlength=SHELLS) / count
        absorbed = collides & (rng.random(len(position)) < sigma_a / sigma_t)
        books["absorbed"] += absorbed.sum() / count
        direction = np.where(collides[:, None], turned(direction, g, rng), mirror)
        scattered = scattered | collides
        position = np.where(collides[:, None], position, position * (1 - 1e-9))
        alive = ~leaves & ~absorbed
        position, direction, scattered = position[alive], direction[alive], scattered[alive]
    return books, shells


def lattice_books(sigma_s, sigma_a, ior, resolution, *, g=0.0):
    """The same from the lattice; power per watt that meets the sphere's disk."""
    ball = trimesh.creation.icosphere(subdivisions=5, radius=RADIUS)
    faces = jnp.asarray(np.asarray(ball.faces, np.int32))
    boundary = Mesh(jnp.asarray(ball.vertices, jnp.float32), faces, jnp.zeros((len(faces), 3)))
    bounds = jnp.asarray([[-RADIUS] * 3, [RADIUS] * 3], jnp.float32)
    medium = Medium(bounds, jnp.full(3, sigma_s), jnp.full(3, sigma_a), jnp.float32(g), ior=jnp.float32(ior), boundary=boundary)
    scene = Scene(medium=medium, directional_lights=DirectionalLights(jnp.asarray([[0.0, 0, 1]]), jnp.ones((1, 3))))
    plan = lattice_boltzmann.plan(scene, None, resolution=resolution)
    light = lattice_boltzmann.illuminate(scene, plan)
    area = np.pi * RADIUS**2
    track = np.asarray((light.from_light + light.scattered)[0], float)
    each = np.asarray(light.materials.absorption[0], float) * track / area
    grid = light.materials.grid
    axes = [np.asarray(grid.lower)[a] + (np.arange(grid.shape[a]) + 0.5) * float(grid.voxel) for a in range(3)]
    x, y, z = np.meshgrid(*axes, indexing="ij")
    shell = (np.sqrt(x * x + y * y + z * z) / RADIUS * SHELLS).astype(int)
    rate = (sigma_s + sigma_a) / sigma_a * each  # of collisions; the lattice's own are those of the reduced sigma
    shells = np.bincount(np.minimum(shell, SHELLS).ravel(), rate.ravel(), minlength=SHELLS + 1)
    shells[SHELLS - 1] += shells[SHELLS]
    return each.sum(), shells[:SHELLS]


def main():
    chosen = arguments(__doc__, photons=400_000, resolution=48)
    rows, curves = [], []
    cases = ((8.0, 0.9, 1.001, 0.0), (8.0, 0.9, 1.3, 0.0), (8.0, 0.9, 1.5, 0.0), (16.0, 0.98, 1.5, 0.0), (16.0, 0.95, 1.3, 0.6))
    for sigma_t, albedo, ior, g in cases:
        sigma_s, sigma_a = sigma_t * albedo, sigma_t * (1 - albedo)
        with timed() as mc:
            books, exact = photon_tracer(sigma_s, sigma_a, ior, chosen.photons, g=g)
        with timed() as ours:
            absorbed, shells = lattice_books(sigma_s, sigma_a, ior, chosen.resolution, g=g)
        rows.append({
            "sigma_t": sigma_t, "albedo": albedo, "ior": ior, "g": g, **books, "photon_sum": sum(books.values()),
            "lattice_absorbed": absorbed, "absorbed_error": absorbed / books["absorbed"] - 1,
            "shell_l1": float(np.abs(shells - exact).sum() / exact.sum()), "mc_cpu_s": mc.cpu, "lattice_cpu_s": ours.cpu,
        })  # fmt: skip
        curves.append((f"{sigma_t:g}, {albedo:g}, n = {ior:.3g}, g = {g:g}", exact, shells))
    write_csv(chosen.out / "photons.csv", rows)
    volume = np.diff((np.arange(SHELLS + 1) / SHELLS) ** 3)
    fig, axis = plt.subplots(figsize=(5.5, 3.6), constrained_layout=True)
    for label, exact, shells in curves:
        (line,) = axis.plot((np.arange(SHELLS) + 0.5) / SHELLS, exact / volume, label=f"sigma_t, albedo {label}")
        axis.plot((np.arange(SHELLS) + 0.5) / SHELLS, shells / volume, "o", color=line.get_color())
    axis.set(xlabel="radius / R", ylabel="collisions per volume", title="photons (lines), lattice (dots)")
    axis.legend(fontsize=7)
    fig.savefig(chosen.out / "photons.png", dpi=110)


if __name__ == "__main__":
    main()
