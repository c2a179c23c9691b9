"""Pictures of refractive bodies against a path tracer with Snell's law at mesh normals (figures 6, 7 and 8 of the paper).

    python experiments/lattice_reference.py [--figures 6 7 8] [--size 48] [--samples 128] [--resolution 64] [--block 6]

The tracer here is independent of the lattice (the paper's reference, section IV-A, seen from the eye): at a face of the mesh
a path is reflected or refracted by Fresnel's probabilities, inside it flies straight and is scattered analogously, until it
leaves for the environment. One of three channels guides a path, all three are weighted (balance heuristic). In an
environment of radiance 1 and without absorption every pixel is 1: `furnace` in the table, the energy's books. Compared are
light that was scattered (the volume layers) and all of it: relative L1 over blocks, with the reference's noise beside it.
"""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import trimesh
from lattice_common import arguments, pictures, timed, volume_image, write_csv
from lattice_figures import body, camera, solid

from jaxvol import camera as cameras
from jaxvol import image, lights, ray_casting
from jaxvol.layers import total
from jaxvol.methods import lattice_boltzmann
from jaxvol.types import Scene

_MOST_EVENTS = 2000


def softbox(height=64):
    """A sky of radiance 0.2 with a wide lamp, 2 cos^2 about (0.6, 0.6, 0.5): small lamps make the reference noisy."""
    theta = (np.arange(height)[:, None] + 0.5) / height * np.pi
    phi = (np.arange(2 * height)[None] + 0.5) / height * np.pi
    direction = np.stack([np.sin(theta) * np.sin(phi), np.cos(theta) + 0 * phi, -np.sin(theta) * np.cos(phi)], -1)
    axis = np.array([0.6, 0.6, 0.5]) / np.linalg.norm([0.6, 0.6, 0.5])
    lamp = 2.0 * np.clip(direction @ axis, 0, 1) ** 2
    return lights.environment_light(0.2 + lamp[..., None] * np.array([1.0, 0.95, 0.85]))


def fresnel(cosine, ratio):
    """(reflectance, cosine behind) for light that arrives where the index rises by 1 / ratio; 1 when totally reflected."""
    sine = ratio**2 * (1 - cosine**2)
    behind = np.sqrt(np.maximum(1 - sine, 0))
    s = (ratio * cosine - behind) / (ratio * cosine + behind)
    p = (cosine - ratio * behind) / (cosine + ratio * behind)
    return np.where(sine >= 1, 1.0, 0.5 * (s * s + p * p)), behind


def trace(scene, origin, direction, radiance, rng):
    """[n, 3] radiance of paths from the eye, and whether each was scattered."""
    medium = scene.medium
    sigma_s, sigma_t = np.asarray(medium.sigma_s, float), np.asarray(medium.sigma_s + medium.sigma_a, float)
    ior = float(medium.ior)
    caster = ray_casting.caster_for(medium.boundary)
    vertices, faces = np.asarray(medium.boundary.vertices, float), np.asarray(medium.boundary.faces)
    corners = vertices[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    n = len(origin)
    result, was_scattered = np.zeros((n, 3)), np.zeros(n, bool)
    path, x, w = np.arange(n), origin.astype(float), direction.astype(float)
    inside, scattered = np.zeros(n, bool), np.zeros(n, bool)
    weight, pdf = np.ones((n, 3)), np.ones((n, 3))
    guide = rng.integers(0, 3, n)
    for _ in range(_MOST_EVENTS):
        t, face = ray_casting.intersect(caster, x.astype(np.float32), w.astype(np.float32), np.full(len(x), np.inf, np.float32))
        t, face = np.array(t, float), np.array(face)
        missed = face < 0
        flight = np.where(inside, rng.exponential(1.0, len(x)) / sigma_t[guide], np.inf)
        collides = inside & (flight < t) & ~missed
        gone = missed  # to the sky; a path that slips out through an edge is lost with it
        if gone.any():
            share = weight[gone] / np.mean(pdf[gone], axis=1, keepdims=True)
            result[path[gone]] = share * radiance(w[gone]) * ~inside[gone][:, None]
            was_scattered[path[gone]] = scattered[gone]
        length = np.where(collides, flight, t)
        through = np.where(inside[:, None], np.exp(-sigma_t * np.where(missed, 0, length)[:, None]), 1.0)
        weight, pdf = weight * through, pdf * through
        weight = np.where(collides[:, None], weight * sigma_s, weight)
        pdf = np.where(collides[:, None], pdf * sigma_t, pdf)
        x = x + np.where(missed, 0, length)[:, None] * w
        # scattering
        z, phi = rng.uniform(-1, 1, len(x)), rng.uniform(0, 2 * np.pi, len(x))
        r = np.sqrt(1 - z * z)
        isotropic = np.stack([r * np.cos(phi), r * np.sin(phi), z], 1)
        # the surface
        normal = normals[np.maximum(face, 0)]
        facing = np.where(np.sum(normal * w, 1, keepdims=True) > 0, -normal, normal)
        cosine = -np.sum(facing * w, 1)
        ratio = np.where(inside, ior, 1 / ior)
        mirror, behind = fresnel(cosine, ratio)
        back = rng.random(len(x)) < mirror
        reflected = w + 2 * cosine[:, None] * facing
        refracted = ratio[:, None] * w + (ratio * cosine - behind)[:, None] * facing
        at_surface = ~collides & ~missed
        passes = at_surface & ~back
        w = np.where(collides[:, None], isotropic, np.where(back[:, None], reflected, refracted))
        x = np.where(at_surface[:, None], x + np.where(passes, -1.0, 1.0)[:, None] * 1e-5 * facing, x)
        inside = inside ^ passes
        scattered = scattered | collides
        # rescale, so that neither weight nor pdf underflows; end dark paths at random
        scale = np.mean(pdf, axis=1, keepdims=True)
        weight, pdf = weight / scale, pdf / scale
        size = weight.max(1)
        survives = (size > 0.05) | (rng.random(len(x)) < size / 0.05)
        weight = np.where(((size <= 0.05) & survives)[:, None], weight * (0.05 / np.maximum(size, 1e-30))[:, None], weight)
        kept = ~gone & survives
        path, x, w, inside, scattered, weight, pdf, guide = (
            a[kept] for a in (path, x, w, inside, scattered, weight, pdf, guide)
        )
        if len(path) == 0:
            break
    return result, was_scattered


def reference(scene, view, samples, seed=0, *, sky=None):
    """(scattered light, all light, variance of the first) of the picture."""
    rng = np.random.default_rng(seed)
    look = jax.jit(lambda w: lights.environment_radiance(scene.environment, w))

    def radiance(w):
        if sky is not None:
            return sky
        padded = np.zeros((1 << int(len(w) - 1).bit_length(), 3), np.float32)
        padded[:, 1] = 1.0
        padded[: len(w)] = w
        return np.asarray(look(padded), float)[: len(w)]

    centers = np.asarray(cameras.pixel_centers(view))
    shape = (view.height, view.width, 3)
    sums = np.zeros((3, *shape))
    for _ in range(samples):
        rays = cameras.generate_rays(view, jnp.asarray(centers + rng.random(centers.shape) - 0.5, jnp.float32))
        value, scattered = trace(scene, np.asarray(rays.origin), np.asarray(rays.direction), radiance, rng)
        one = np.where(scattered[:, None], value, 0).reshape(shape)
        sums += np.stack([one, value.reshape(shape), one**2])
    mean = sums[0] / samples
    return mean, sums[1] / samples, np.maximum(sums[2] / samples - mean**2, 0) / samples


def cases(figure):
    """(title, medium) of a figure."""
    if figure == 6:
        ball = trimesh.creation.icosphere(subdivisions=4, radius=0.5)
        for sigma in (4.0, 16.0, 48.0):
            for albedo in (0.8, 0.98):
                yield f"sigma_t {sigma:g}, albedo {albedo:g}", body(ball, sigma * albedo, sigma * (1 - albedo), ior=1.3)
    elif figure == 7:
        for name in ("bunny", "cow"):
            yield name, body(solid(name), [24.0, 18.0, 12.0], [0.2, 0.5, 1.2], ior=1.3)
    else:
        for scale in (0.25, 1.0):
            sigma = scale * np.array([24.0, 22.0, 18.0])
            yield f"bunny, scattering times {scale:g}", body(solid("bunny"), sigma, [0.1, 0.2, 0.5], ior=1.2)


def main():
    chosen = arguments(__doc__, figures=[6, 7, 8], size=48, samples=128, resolution=64, block=6)
    view = camera(chosen.size)
    for figure in chosen.figures:
        rows, images, titles = [], [], []
        for title, medium in cases(figure):
            scene = Scene(medium=medium, environment=softbox())
            with timed() as slow:
                mean, whole, variance = reference(scene, view, chosen.samples)
            plan = lattice_boltzmann.plan(scene, view, resolution=chosen.resolution, samples_per_pixel=4)
            with timed() as fast:
                found = lattice_boltzmann.render(scene, view, plan)
            ours, all_ours = volume_image(found.mean), np.asarray(total(found.mean))
            clear = replace(medium, sigma_a=jnp.zeros(3))
            white = reference(Scene(medium=clear, environment=scene.environment), camera(16), 16, sky=np.ones(3))[1].mean()
            single = np.asarray(found.mean.volume_from_light)
            rows.append({
                "figure": figure, "case": title, "relative_l1": image.relative_l1(ours, mean, block=chosen.block),
                "bias": image.bias(ours, mean), "reference_noise": image.reference_noise(mean, variance, block=chosen.block),
                "relative_l1_all_light": image.relative_l1(all_ours, whole, block=chosen.block),
                "single_share": float(single.sum() / ours.sum()), "furnace": float(white), "reference_cpu_s": slow.cpu,
                "lattice_cpu_s_cold": fast.cpu, "converged": bool(found.diagnostics["converged"]),
            })  # fmt: skip
            print(rows[-1], flush=True)
            images += [whole, all_ours] + ([single] if figure == 8 else [])
            titles += [f"{title}: reference", f"lattice, {100 * rows[-1]['relative_l1']:.1f} %"]
            titles += ["lattice, scattered once"] if figure == 8 else []
        write_csv(chosen.out / f"reference_figure{figure}.csv", rows)
        pictures(chosen.out / f"reference_figure{figure}.png", images, titles, columns=3 if figure == 8 else 4)


if __name__ == "__main__":
    main()
