"""Direct light without noise to speak of: one reflection or one scattering event between light and eye.

Stages: `first_hit` (surfaces, emission, transmittance to the eye), `surface` (L S E), `cells` and `single_scattering`
(L V E), each light in turn through `connections` (shadows, transmittance towards the light).

Light from the environment through a grid comes from a field swept once per picture (`sky_field`) where eye and surfaces
are outside the medium's box, its voxels are optically thin and its phase function is not too peaked; elsewhere every
node marches (`num_sky_directions=0` asks for that). Directions are drawn by tables made for the picture (`sky_sampling`).

Point, spot and directional lights: positions inside the pixel and nodes on the eye ray are midpoint rules, the same for
every seed; the error is that of the rules (edges, density changes within a cell). Emissive faces and the environment:
low-discrepancy sets, shifted per pixel by a hash of the seed; unbiased but for transmittance, which is marched with one
step per voxel or finer from the eye and per two voxels towards lights (second order; finer in small grids). The field
is the same for every seed; its error is that of a few hundred directions and of the voxel. Equi-angular steps: Kulla
and Fajardo 2012, "Importance Sampling Techniques for Path Tracing in Participating Media"; transmittance-warped steps:
the same integral inverted numerically.

Cannot: refraction (refused), more than one scattering event.
"""

from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxvol import camera as cameras
from jaxvol import first_hit, ray_casting
from jaxvol.common_stages import CommonStages
from jaxvol.direct import patterns
from jaxvol.direct.connections import Context, context
from jaxvol.direct.planning import Plan, claims, plan
from jaxvol.direct.single_scattering import scattered_light
from jaxvol.direct.surface import surface_light
from jaxvol.types import Camera, Estimate, Layers, Rays, Scene

__all__ = ["Plan", "claims", "plan", "radiance", "render"]

_VIEW = 192  # rays that stand for the picture where tables are made for it
_NAMES = ("emission", "surface_from_light", "volume_from_light")


def radiance(scene: Scene, rays: Rays, plan: Plan, *, seed: int = 0, caster: ray_casting.Caster = None) -> Layers:
    """The three layers along given rays `[n]`, each estimated with as many shifted node sets as a pixel has samples."""

    def make_rays(item, sample):
        return jax.tree.map(lambda x: jnp.asarray(x)[item], rays)

    some = np.linspace(0, rays.t_max.shape[0] - 1, min(_VIEW, rays.t_max.shape[0])).astype(int)
    view = jax.tree.map(lambda x: jnp.asarray(x)[some], rays)
    return _average(context(scene, plan, view, caster=caster), make_rays, rays.t_max.shape[0], seed, None, None)


def render(
    scene: Scene,
    camera: Camera,
    plan: Plan,
    *,
    seed: int = 0,
    caster: ray_casting.Caster = None,
    progress: Callable[[float, float], None] | None = None,
    on_stage: Callable[[str], None] | None = None,
    common: CommonStages | None = None,
) -> Estimate:
    """The three layers of a picture, each pixel averaged over its square; no variance. `auxiliary` is filled."""
    common = CommonStages(scene, camera) if common is None else common
    kit = context(scene, plan, _some_rays(camera), caster=caster, marching=common.marching)
    if on_stage is not None:
        on_stage("tables")

    def make_rays(item, sample):
        lattice = patterns.pixel_lattice(int(sample[-1]) + 1)[sample]
        return _pixel_rays(camera, jnp.asarray(item), jnp.asarray(lattice, jnp.float32))

    layers = _average(kit, make_rays, camera.height * camera.width, seed, progress, on_stage)
    layers = jax.tree.map(lambda x: x.reshape(camera.height, camera.width, 3), layers)
    guides = first_hit.auxiliary(scene, camera, caster=caster, num_steps=plan.num_cells, common=common)
    if on_stage is not None:
        on_stage("auxiliary")
    return Estimate(mean=layers, auxiliary=guides)


@jax.jit
def _some_rays(camera):
    """Rays all over the picture, 16 across and 12 down."""
    x, y = jnp.meshgrid((jnp.arange(16) + 0.5) / 16 * camera.width, (jnp.arange(12) + 0.5) / 12 * camera.height)
    return cameras.generate_rays(camera, jnp.stack([x.reshape(-1), y.reshape(-1)], axis=-1))


@jax.jit
def _pixel_rays(camera, pixel, lattice):
    row = pixel // camera.width
    return cameras.generate_rays(camera, jnp.stack([pixel - row * camera.width, row], axis=-1) + lattice)


def _average(kit: Context, make_rays, num_items: int, seed: int, progress, on_stage) -> Layers:
    """Both passes over all items (pixels or rays), chunk by chunk, the samples of an item averaged."""
    plan = kit.plan
    found = dict.fromkeys(_NAMES)
    passes = []
    if plan.emission or plan.surface:
        passes.append(("surfaces", _surface_pass, plan.samples_per_pixel))
    if plan.volume:
        passes.append(("single_scattering", _volume_pass, plan.volume_samples_per_pixel))
    work = sum(samples for _, _, samples in passes) * num_items
    done = 0
    for stage, function, samples in passes:
        count = min(max(1, plan.rays_per_chunk // samples), num_items)
        parts: dict[str, list] = {}
        for first in range(0, num_items, count):
            # The last chunk is filled up with the last item, so that all share one compilation.
            item = np.minimum(np.repeat(np.arange(first, first + count), samples), num_items - 1)
            sample = np.tile(np.arange(samples), count)
            for name, value in function(kit, make_rays(item, sample), item, sample, jnp.uint32(seed)).items():
                mean = np.asarray(_mean_over_samples(value, samples=samples))
                parts.setdefault(name, []).append(mean[: num_items - first])
            done += min(count, num_items - first) * samples
            if progress is not None:
                progress(done, work)
        found |= {name: jnp.asarray(np.concatenate(chunks)) for name, chunks in parts.items()}
        if on_stage is not None:
            on_stage(stage)
    zero = jnp.zeros((num_items, 3), jnp.float32)
    return Layers(**{name: zero if value is None else value for name, value in found.items()})


@partial(jax.jit, static_argnames="samples")
def _mean_over_samples(value, *, samples):
    return jnp.mean(value.reshape(-1, samples, 3), axis=1)


def _surface_pass(kit: Context, rays: Rays, item, sample, seed) -> dict[str, Float[Array, "n 3"]]:
    """Emission and surface light of one chunk."""
    scene, plan = kit.scene, kit.plan
    hits = first_hit.first_hits(scene, rays, kit.caster)
    through = first_hit.transmittance(
        scene, rays, hits, casters=kit.medium_casters, num_steps=plan.num_cells, marching=kit.marching
    )
    found = {}
    if plan.emission:
        found["emission"] = first_hit.emission(scene, rays, hits, through)
    if plan.surface:
        pixel = jnp.asarray(item, jnp.uint32)
        found["surface_from_light"] = surface_light(kit, rays, hits, through, pixel, jnp.asarray(sample), seed)
    return found


def _volume_pass(kit: Context, rays: Rays, item, sample, seed) -> dict[str, Float[Array, "n 3"]]:
    """Single scattering of one chunk."""
    t, _ = ray_casting.intersect(kit.caster, rays.origin, rays.direction, rays.t_max)
    pixel = np.asarray(item, np.uint32)
    samples = kit.plan.volume_samples_per_pixel
    value = scattered_light(kit, rays, jnp.asarray(t), pixel, sample, seed, num_samples=samples)
    return {"volume_from_light": value}
