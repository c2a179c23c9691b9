"""Light marched through refractive media, then multiply scattered on a lattice: the volume layers, fast where media are dense.

Bernabei, Hakke Patil, Banterle, Di Benedetto, Ganovelli, Pattanaik, Scopigno 2012, "A Parallel Architecture for
Interactive Rendering of Scattering and Refraction Effects". Stages, and where the paper has them:
`materials` (init, III-A) fills voxels from meshes and grids and smooths the refractive index; `light_rays` (III-A) starts
rays at the lights; `marching` (III-B) takes them along the eikonal and deposits what is scattered; `lattice`, `sweeps`,
`solver` (diffusion, III-C) find the steady state, eliminating the directions: a handful of transport sweeps with
preconditioned conjugate gradients instead of hundreds of lattice steps (`stepping` keeps those, the 4^3 blocks and Table
I's interleaving); `anisotropy` a Theta that depends on direction; `view` (III-D) marches eye rays and gathers.

It cannot: keep sharp features below a voxel; scatter light back from surfaces into the medium (V S V) except from opaque
meshes inside refractive bodies, as voxels; split orders of anisotropic scattering; cast caustics on surfaces outside.
"""

from dataclasses import replace

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from jaxvol import camera as cameras
from jaxvol import extinction, ray_casting, segments
from jaxvol.layers import from_items
from jaxvol.methods.lattice_boltzmann.illumination import Illumination, illuminate
from jaxvol.methods.lattice_boltzmann.materials import cropped
from jaxvol.methods.lattice_boltzmann.planning import Plan, claims, plan, surfaces_are_lit
from jaxvol.methods.lattice_boltzmann.refraction import radiance_bent
from jaxvol.methods.lattice_boltzmann.view import Source, emission_table, gather_straight
from jaxvol.types import Camera, Estimate, Layers, Rays, Scene

__all__ = ["Illumination", "Plan", "claims", "illuminate", "plan", "radiance", "render"]

_ROWS = 1 << 18  # eye rays at a time


def radiance(scene: Scene, rays: Rays, plan: Plan, light: Illumination, *, seed: int = 0) -> dict[str, np.ndarray]:
    """Layers and sums by name along given rays [n], each [n, 3], from the result of `illuminate`."""
    origin, direction, t_max = (np.array(x, np.float32) for x in (rays.origin, rays.direction, rays.t_max))
    names, sources = _sources(plan, light)
    grid = light.materials.grid
    table, layout = emission_table(grid, *sources, unit=light.unit)
    if plan.refract:
        volume, rest = radiance_bent(scene, plan, light.materials, table, layout, origin, direction, t_max, seed=seed)
    else:
        if scene.mesh is not None:
            t_max = np.minimum(t_max, ray_casting.intersect(ray_casting.caster_for(scene.mesh), origin, direction, t_max)[0])
        volume, _ = gather_straight(
            scene.medium, extinction.marching_medium(scene.medium), segments.medium_casters(scene.medium), grid, table,
            layout, origin, direction, t_max, step=plan.view_step, degree=plan.degree, blocks=light.blocks,
        )  # fmt: skip
        rest = {}
    return {name: volume[:, k] * (light.unit * light.spectrum) for k, name in enumerate(names)} | rest


def _sources(plan, light):
    """What is gathered: (layer names, their sources)."""
    items = {}
    if plan.split_orders:
        items["volume_from_light"] = Source(light.from_light)
        items["volume_from_volume"] = Source(light.from_volume)
        items["volume_from_multiple"] = Source(light.scattered - light.from_volume)
        from_surface = Source(light.from_surface)
    elif plan.first_order:
        name = "volume_from_light+volume_from_volume+volume_from_multiple"
        items[name] = Source(light.scattered, light.flux, light.from_light, *light.unscattered)
        if light.from_surface is not None:
            from_surface = Source(None, None, light.from_surface, *light.surface_unscattered)
    else:
        items["volume_from_light+volume_from_volume+volume_from_multiple"] = Source(light.from_light + light.scattered)
        from_surface = Source(light.from_surface)
    if light.from_surface is not None:
        items["volume_from_surface"] = from_surface
    return list(items), list(items.values())


def render(scene: Scene, camera: Camera, plan: Plan, *, seed: int = 0, on_stage=None) -> Estimate:
    """The picture's volume layers, deterministic but for jitter; `diagnostics` tells whether the lattice converged."""
    scene = replace(scene, medium=cropped(scene.medium))
    light = illuminate(scene, plan, seed=seed, on_stage=on_stage)
    side = int(np.ceil(np.sqrt(plan.samples_per_pixel)))
    while plan.samples_per_pixel % side:
        side -= 1
    rows, columns = side, plan.samples_per_pixel // side
    offsets = [((i + 0.5) / columns - 0.5, (j + 0.5) / rows - 0.5) for j in range(rows) for i in range(columns)]
    offsets = np.array(offsets, np.float32)[:, None]
    centers = np.asarray(cameras.pixel_centers(camera))
    sums: dict[str, np.ndarray] = {}
    num_pixels = max(_ROWS // len(offsets), 1)
    for first in range(0, len(centers), num_pixels):
        part = slice(first, first + num_pixels)
        rays = cameras.generate_rays(camera, jnp.asarray((centers[part] + offsets).reshape(-1, 2)))
        for name, value in radiance(scene, rays, plan, light, seed=seed).items():
            pixels = sums.setdefault(name, np.zeros((len(centers), 3), np.float32))
            pixels[part] = value.reshape(len(offsets), -1, 3).mean(0)
    if on_stage is not None:
        on_stage("view")
    images = {name: jnp.asarray(value.reshape(camera.height, camera.width, 3)) for name, value in sums.items()}
    mean = from_items(images)
    if not surfaces_are_lit(scene):
        mean = _without_surfaces(mean)
    return Estimate(mean=mean, diagnostics=light.diagnostics)


def _without_surfaces(layers: Layers) -> Layers:
    """Light from surfaces is exactly zero where none are lit."""
    some = next(iter([x for x in (layers.volume_from_light, *layers.sums.values()) if x is not None]))
    return eqx.tree_at(lambda x: x.volume_from_surface, layers, jnp.zeros_like(some), is_leaf=lambda x: x is None)
