"""One frame: the stages in order. A host loop, because rays are cast and lists are made between jitted stages."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from jaxvol import ray_casting
from jaxvol.common_stages import CommonStages
from jaxvol.layers import zeros
from jaxvol.methods.deep_screen_space import (
    bounce,
    framebuffer,
    lighting,
    reconstruction,
    splatting,
    surfels,
    tile_lists,
    transport,
)
from jaxvol.methods.deep_screen_space.camera_rays import ActiveRays, map_rays, transmittance_of
from jaxvol.methods.deep_screen_space.lighting import LitSurfels
from jaxvol.methods.deep_screen_space.planning import BOUNCE_LAYER, LAYER, Plan, coarse_size, group_size
from jaxvol.methods.deep_screen_space.surfels import Surfels
from jaxvol.types import Camera, Estimate, Layers, Scene


def make_surfels(scene: Scene, camera: Camera, plan: Plan) -> tuple[Surfels, int]:
    """Stage 1: the surfels, and the number of those that found no slot."""
    eye = np.asarray(camera.world_from_camera)[:3, 3]
    triangles = surfels.subdivide(
        scene.mesh.vertices, scene.mesh.faces, eye, num_surfels=plan.num_surfels, pattern=plan.pattern
    )
    spare = coarse_size(len(triangles.face)) - len(triangles.face)
    padded = jax.tree.map(lambda a: np.concatenate([a, np.zeros((spare, *a.shape[1:]), a.dtype)]), triangles)
    capacity = coarse_size(int(triangles.count.sum()))
    cloud, lost = surfels.tessellate(padded, capacity=capacity, pattern=plan.pattern)
    return cloud, int(lost)


def light_surfels(
    scene: Scene, cloud: Surfels, plan: Plan, common: CommonStages, *, seed: int
) -> tuple[LitSurfels, LitSurfels | None]:
    """Stage 2: lit Lambertian entries, and glossy ones or None."""
    return lighting.illuminate(
        scene,
        cloud,
        common.caster,
        _transmittance(common, num_steps=plan.light_steps),
        seed=seed,
        choices=plan.light_choices,
        scale=float(ray_casting.scene_scale(scene.mesh)),
    )


def bounce_light(scene: Scene, lit: LitSurfels, cloud: Surfels, plan: Plan, common: CommonStages, *, seed: int) -> LitSurfels:
    """Lambertian entries with what the surfels `lit` send to all others (a second bounce)."""
    return bounce.illuminate(
        padded_surfels(lit, plan),
        cloud,
        scene.mesh,
        common.caster,
        _transmittance(common, num_steps=plan.light_steps),
        seed=seed,
        num_connections=plan.second_bounce,
    )


def _transmittance(common, *, num_steps):
    return transmittance_of(common.scene.medium, common.medium_casters, num_steps=num_steps, marching=common.marching)


def build_transport(scene: Scene, active: ActiveRays, lit: LitSurfels, plan: Plan, common: CommonStages, *, seed: int):
    """Stage 5: (table, cell of every sample), or (None, None) without transport."""
    if plan.transport == "none":
        return None, None
    cells = transport.locate(
        active.origin,
        active.direction,
        active.map.distance,
        active.map.weight,
        active.num_rays,
        jnp.uint32(seed),
        resolution=plan.table_resolution,
    )
    table = transport.build_table(
        lit,
        cells,
        common.caster,
        _transmittance(common, num_steps=plan.transport_steps),
        seed=seed,
        cluster_size=plan.cluster_size,
        resolution=plan.table_resolution,
        grey=active.map.weight.shape[0] == 1,
        scale=float(ray_casting.scene_scale(scene.mesh)),
    )
    return table, cells.index


def splat_levels(
    scene: Scene, active: ActiveRays, lit: LitSurfels, table, cells, plan: Plan, *, width: int, seed: int, done: Callable
) -> tuple[list, dict]:
    """Stages 4, 6 and 7: per level the tiles' sums, without weights that are constant along rays, and their slots; counts."""
    counts, images = {}, []
    first = splatting.first_radius(lit.area, lit.radiance, plan.epsilon * mean_radiance(lit), radius=plan.radius)
    capacity, num = active.direction.shape[0], active.num_rays
    x, y = active.pixel[:num] % width, active.pixel[:num] // width
    for level in range(plan.num_levels):
        stride = plan.strides[level]
        size = framebuffer.tile_size(capacity, level)
        members = group_size(level, plan.cluster_size)
        num_tiles = capacity // size + 4**level
        tiles = framebuffer.make_tiles(
            x, y, level=level, seed=seed, size=size, num_tiles=num_tiles, num_rays=capacity, stride=stride
        )
        phase = np.concatenate([tiles.phase, np.zeros(capacity - num, np.int32)])
        rays = splatting.level_rays(
            active.direction,
            active.map.distance,
            active.map.weight,
            cells,
            active.g,
            tiles.ray,
            tiles.sub_buffer,
            phase,
            stride=stride,
        )
        order = framebuffer.surfel_order(lit.area.shape[0], level=level, seed=seed)
        senders = splatting.level_surfels(
            lit,
            first,
            active.origin,
            order,
            level=level,
            num_levels=plan.num_levels,
            tail=plan.tail,
            group_size=members,
            cluster_size=plan.cluster_size,
        )
        done("tiles", (rays, senders))
        batch = max(8, 4096 // size)
        pairs = _pairs(rays, tiles, senders, level >= plan.dense_from, capacity, order.shape[1] // members)
        tile, group, num_pairs = tile_lists.pad_list(*pairs, batch=batch)
        done("lists", None)
        image = splatting.splat(
            rays,
            senders,
            tile,
            group,
            num_pairs,
            table,
            scene.medium.g,
            scene.medium.phase,
            phase=plan.phase,
            batch=batch,
            glossy=lit.lobe_direction is not None,
        )
        done(f"splat {level}", image)
        counts[f"pairs_{level}"] = num_pairs * size * members * (plan.num_intervals // stride)
        images.append((image * stride, tiles.slot))
    return images, counts


def _pairs(rays, tiles, senders, all_of_them, capacity, groups_each):
    if all_of_them:
        return tile_lists.dense(tiles.sub_buffer, (tiles.ray < capacity).any(axis=1), groups_each=groups_each)
    bounds = tile_lists.tile_bounds(rays, tiles.ray, capacity)
    kept = tile_lists.reachable(bounds, tiles.sub_buffer, senders, groups_each=groups_each)
    return tile_lists.listed(kept, tiles.sub_buffer)


def mean_radiance(lit: LitSurfels) -> float:
    """Area-weighted mean over the lit entries of the brightest channel: the unit of epsilon. 0 when none is lit."""
    area = np.asarray(lit.area)
    return float(np.sum(area * np.asarray(lit.radiance).max(axis=-1)) / max(float(np.sum(area)), 1e-30))


def padded_surfels(lit: LitSurfels, plan: Plan) -> LitSurfels:
    """In the order of strata, padded to whole sub-buffers and clusters."""
    unit = max(4 ** (plan.num_levels - 1), plan.cluster_size)
    return lighting.order_for_strata(lit, capacity=-(-lit.area.shape[0] // unit) * unit)


def _nothing(name, value):
    """Stages report to nobody: let them run on."""


def render(
    scene: Scene,
    camera: Camera,
    plan: Plan,
    *,
    seed: int = 0,
    on_stage: Callable[[str], None] | None = None,
    common: CommonStages | None = None,
) -> Estimate:
    """The layer `volume_from_surface` of one frame, [H, W, 3]; `on_stage(name)` is called after each part of a stage,
    `common` holds what other methods have computed already. With a second bounce also its share of `volume_from_multiple`.

    Diagnostics: pairs evaluated by level, lit entries, active pixels; `overflow` counts surfels without a slot and rays
    with too many boundaries (0 in a healthy frame).
    """

    def report(name, value):
        jax.block_until_ready(value)
        on_stage(name)

    done = _nothing if on_stage is None else report
    shape = (camera.height, camera.width)
    names = (LAYER, BOUNCE_LAYER) if plan.second_bounce else (LAYER,)
    nothing = Estimate(mean=zeros(names, shape), diagnostics={"overflow": jnp.int32(0)})
    if not plan.active:
        return nothing
    common = CommonStages(scene, camera) if common is None else common
    cloud, lost = make_surfels(scene, camera, plan)
    lambert, glossy = light_surfels(scene, cloud, plan, common, seed=seed)
    done("surfels", None)
    entries = {LAYER: _lit_ones(lambert, glossy)}
    if not entries[LAYER]:
        return nothing
    if plan.second_bounce:
        again = bounce_light(scene, lambert, cloud, plan, common, seed=seed) if lambert.area.shape[0] else None
        entries[BOUNCE_LAYER] = _lit_ones(again)
        done("bounce", None)
    active = map_rays(scene, camera, plan, common, seed=seed)
    done("map", None)
    if active is None:
        return nothing
    diagnostics = {
        "overflow": jnp.int32(lost + active.num_overflows),
        "active_pixels": jnp.int32(active.num_rays),
        "surfels": jnp.int32(sum(lit.area.shape[0] for lit in entries[LAYER])),
    }
    images = {}
    for name, senders in entries.items():
        images[name], counts = _image(scene, camera, active, senders, plan, common, seed=seed, done=done)
        for key, count in counts.items():
            diagnostics[key] = diagnostics.get(key, 0) + count
    return Estimate(mean=Layers(**images), diagnostics=diagnostics)


def _lit_ones(*entries):
    return [lit for lit in entries if lit is not None and lit.area.shape[0] > 0]


def _image(scene, camera, active, entries, plan, common, *, seed, done):
    """Stages 4 to 8: what all `entries` send through the samples, [H, W, 3], and the pairs evaluated by level."""
    shape = (camera.height, camera.width)
    num_pixels = camera.height * camera.width
    target = active.pixel[: active.num_rays]
    levels = [jnp.zeros((num_pixels, 3), jnp.float32)] * plan.num_levels
    evaluated = {}
    for lit in entries:
        lit = padded_surfels(lit, plan)
        done("order", None)
        table, cells = build_transport(scene, active, lit, plan, common, seed=seed)
        done("table", None)
        images, counts = splat_levels(scene, active, lit, table, cells, plan, width=camera.width, seed=seed, done=done)
        for level, (tiles, slot) in enumerate(images):
            levels[level] = levels[level] + reconstruction.unshuffle(tiles, slot, target, num_pixels=num_pixels)
        done("unshuffle", levels)
        for name, count in counts.items():
            evaluated[name] = evaluated.get(name, 0) + jnp.asarray(count, jnp.float32)
    image = _compose(levels, active.map, target, shape, plan)
    done("blur", image)
    return image, evaluated


def _compose(levels, mapped, target, shape, plan):
    """The weights that are constant along rays, then the reconstruction."""
    num = len(target)
    opacity = np.zeros(shape[0] * shape[1], np.float32)
    opacity[target] = np.asarray(mapped.one_minus_transmittance).mean(axis=0)[:num]
    factor = np.ones((shape[0] * shape[1], 3), np.float32)
    if mapped.weight.shape[0] == 1:
        factor[target] = np.asarray(mapped.weight)[0, :, :num].T
    images = tuple((level * factor).reshape(*shape, 3) for level in levels)
    return reconstruction.reconstruct(images, opacity.reshape(shape), mode=plan.blur)
