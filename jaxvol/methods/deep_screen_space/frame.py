"""One frame: the stages in order. A host loop, because rays are cast and lists are made between jitted stages."""

from functools import partial
from time import process_time

import jax
import jax.numpy as jnp
import numpy as np

from jaxvol import camera as cameras
from jaxvol import interval_map as intervals
from jaxvol import media, ray_casting, sampling
from jaxvol.interval_map import IntervalMap
from jaxvol.layers import zeros
from jaxvol.methods.deep_screen_space import framebuffer, lighting, reconstruction, splatting, surfels, tile_lists, transport
from jaxvol.methods.deep_screen_space.lighting import LitSurfels
from jaxvol.methods.deep_screen_space.planning import LAYER, Plan, coarse_size, group_size
from jaxvol.types import Camera, Estimate, Layers, Scene

_STREAM = sampling.stream("deep_screen_space.frame")
_VISIBLE = 1e-7  # rays with less opacity than this show no medium


class Clock:
    """CPU seconds by stage."""

    def __init__(self):
        self.stages: dict[str, float] = {}

    def __call__(self, name, function, *args, **kwargs):
        """Run a stage and wait for it."""
        start = process_time()
        result = jax.block_until_ready(function(*args, **kwargs))
        self.stages[name] = self.stages.get(name, 0.0) + process_time() - start
        return result


class ActiveRays:
    """The camera rays that show medium, in Morton order of their pixels, in arrays of a coarse capacity."""

    def __init__(self, origin, direction, mapped: IntervalMap, pixel, num_rays: int):
        self.origin, self.direction, self.map, self.pixel, self.num_rays = origin, direction, mapped, pixel, num_rays


def light_surfels(scene: Scene, camera: Camera, plan: Plan, caster, *, seed: int) -> tuple[LitSurfels, LitSurfels | None, int]:
    """Stages 1 and 2: lit Lambertian entries, glossy ones or None, and the number of surfels that found no slot."""
    eye = np.asarray(camera.world_from_camera)[:3, 3]
    triangles = surfels.subdivide(
        scene.mesh.vertices, scene.mesh.faces, eye, num_surfels=plan.num_surfels, pattern=plan.pattern
    )
    spare = coarse_size(len(triangles.face)) - len(triangles.face)
    padded = jax.tree.map(lambda a: np.concatenate([a, np.zeros((spare, *a.shape[1:]), a.dtype)]), triangles)
    capacity = coarse_size(int(triangles.count.sum()))
    cloud, lost = surfels.tessellate(padded, capacity=capacity, pattern=plan.pattern)
    scale = max(1.0, float(np.abs(np.asarray(scene.mesh.vertices)).max()))
    lambert, glossy = lighting.illuminate(
        scene, cloud, caster, seed=seed, choices=plan.light_choices, num_steps=plan.light_steps, scale=scale
    )
    return lambert, glossy, int(lost)


def map_rays(scene: Scene, camera: Camera, plan: Plan, caster, *, seed: int) -> ActiveRays | None:
    """Stage 3: the interval map of the rays that show medium; None when none does."""
    medium = scene.medium
    rays = cameras.generate_rays(camera, cameras.pixel_centers(camera))
    enter, leave = (np.asarray(t) for t in media.box_interval(medium.bounds, rays.origin, rays.direction))
    pixel = np.flatnonzero(leave > enter)
    if pixel.size == 0:
        return None
    pixel = pixel[np.argsort(framebuffer.morton(pixel % camera.width, pixel // camera.width), kind="stable")]
    direction = np.asarray(rays.direction)[pixel]
    origin = np.asarray(rays.origin[0])
    depth, _ = ray_casting.intersect(caster, origin, direction, np.inf)
    capacity = coarse_size(pixel.size)
    pad = lambda a: np.concatenate([a, np.repeat(a[-1:], capacity - len(a), axis=0)])  # noqa: E731
    u, u_step = _jitter(jnp.uint32(seed), jnp.asarray(pad(pixel)))
    function = intervals.interval_map if plan.weights == "exact" else intervals.paper_interval_map
    options = {} if plan.weights == "paper" else {"position": plan.position, "grey": plan.grey}
    jittered = plan.position == "jittered"
    mapped = function(
        medium,
        jnp.broadcast_to(origin, (capacity, 3)),
        pad(direction),
        jnp.zeros(capacity, jnp.float32),
        pad(np.asarray(depth)),
        num_intervals=plan.num_intervals,
        num_steps=plan.num_steps,
        u=u if jittered else None,
        u_step=u_step if jittered else None,
        **options,
    )
    opaque = np.asarray(mapped.one_minus_transmittance).max(axis=0)[: pixel.size]
    shown = np.flatnonzero(opaque > _VISIBLE)
    if shown.size == 0:
        return None
    keep = np.concatenate([shown, np.full(coarse_size(shown.size) - shown.size, shown[-1])])
    mapped = jax.tree.map(lambda a: np.take(np.asarray(a), keep, axis=-1), mapped)
    return ActiveRays(origin, direction[keep], mapped, pixel[keep], shown.size)


@jax.jit
def _jitter(seed, pixel):
    u1, u2, _, _ = sampling.uniforms(seed, _STREAM, pixel, 0)
    return u1, u2


def build_transport(scene: Scene, active: ActiveRays, lit: LitSurfels, plan: Plan, caster, *, seed: int):
    """Stage 5: (table, cell of every sample), or (None, None) without transport."""
    if plan.transport == "none":
        return None, None
    cells = transport.locate(
        active.origin,
        active.direction,
        active.map.distance,
        active.num_rays,
        jnp.uint32(seed),
        resolution=plan.table_resolution,
    )
    through = partial(_grey_transmittance, scene.medium, num_steps=8)
    table = transport.build_table(
        lit, cells, caster, through, seed=seed, cluster_size=plan.cluster_size, resolution=plan.table_resolution
    )
    return table, cells.index


@partial(jax.jit, static_argnames=("num_steps",))
def _grey_transmittance(medium, origin, direction, distance, *, num_steps):
    return lighting.extinction(medium, origin, direction, distance, num_steps=num_steps)[:, 0]


def splat_levels(scene: Scene, active: ActiveRays, lit: LitSurfels, table, cells, plan: Plan, *, seed: int, clock: Clock):
    """Stages 4, 6, 7: the image of every level, [H*W, 3] per level without its rays' weight, and counts."""
    counts = {}
    images = []
    first = splatting.first_radius(lit.area, lit.radiance, plan.epsilon * mean_radiance(lit), radius=plan.radius)
    capacity = active.direction.shape[0]
    for level in range(plan.num_levels):
        size = framebuffer.tile_size(capacity, level)
        members = group_size(level, plan.cluster_size)
        tiles = clock(
            "tiles",
            framebuffer.make_tiles,
            active.x,
            active.y,
            level=level,
            seed=seed,
            size=size,
            num_tiles=capacity // size + 4**level,
            num_rays=capacity,
            stride=plan.strides[level],
        )
        phase = np.concatenate([tiles.phase, np.zeros(capacity - active.num_rays, np.int32)])
        rays = clock(
            "tiles",
            splatting.level_rays,
            active.direction,
            active.map.distance,
            active.map.weight,
            cells,
            tiles.ray,
            tiles.sub_buffer,
            phase,
            stride=plan.strides[level],
        )
        order = framebuffer.surfel_order(lit.area.shape[0], level=level, seed=seed)
        level_surfels = clock(
            "tiles",
            splatting.level_surfels,
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
        groups_each = order.shape[1] // members
        batch = max(8, 4096 // size)
        tile, group = clock("lists", _pairs, rays, tiles, level_surfels, plan, level, capacity, groups_each)
        tile, group, num = tile_lists.pad_list(tile, group, batch=batch)
        image = clock(
            f"splat {level}",
            splatting.splat,
            rays,
            level_surfels,
            tile,
            group,
            num,
            table,
            scene.medium.g,
            scene.medium.phase,
            phase=plan.phase,
            batch=batch,
            glossy=lit.lobe_direction is not None,
        )
        counts[f"pairs_{level}"] = num * size * members * (plan.num_intervals // plan.strides[level])
        images.append((image * plan.strides[level], tiles.slot))
    return images, counts


def _pairs(rays, tiles, level_surfels, plan, level, capacity, groups_each):
    if level >= plan.dense_from:
        return tile_lists.dense(tiles.sub_buffer, (tiles.ray < capacity).any(axis=1), groups_each=groups_each)
    bounds = tile_lists.tile_bounds(rays, tiles.ray, capacity)
    kept = tile_lists.reachable(bounds, tiles.sub_buffer, level_surfels, groups_each=groups_each)
    return tile_lists.listed(kept, tiles.sub_buffer)


def mean_radiance(lit: LitSurfels) -> float:
    """Area-weighted mean over the lit entries of the brightest channel: the unit of epsilon. 0 when none is lit."""
    area = np.asarray(lit.area)
    return float(np.sum(area * np.asarray(lit.radiance).max(axis=-1)) / max(float(np.sum(area)), 1e-30))


def padded_surfels(lit: LitSurfels, plan: Plan) -> LitSurfels:
    """In the order of strata, padded to whole sub-buffers and clusters."""
    unit = max(4 ** (plan.num_levels - 1), plan.cluster_size)
    capacity = -(-lit.area.shape[0] // unit) * unit
    return lighting.order_for_strata(lit, capacity=capacity, cluster_size=plan.cluster_size)[0]


def render(scene: Scene, camera: Camera, plan: Plan, *, seed: int = 0, clock: Clock | None = None) -> Estimate:
    """The layer `volume_from_surface` of one frame, [H, W, 3]; `clock` collects CPU seconds by stage.

    Diagnostics: pairs evaluated by level, lit surfels, active pixels, `overflow` (surfels without a slot; 0).
    """
    clock = Clock() if clock is None else clock
    shape = (camera.height, camera.width)
    nothing = Estimate(mean=zeros((LAYER,), shape), diagnostics={"overflow": jnp.int32(0)})
    if not plan.active:
        return nothing
    caster = ray_casting.caster_for(scene.mesh)
    lambert, glossy, lost = clock("surfels", light_surfels, scene, camera, plan, caster, seed=seed)
    active = clock("map", map_rays, scene, camera, plan, caster, seed=seed)
    entries = [lit for lit in (lambert, glossy) if lit is not None and lit.area.shape[0] > 0]
    if active is None or not entries:
        return nothing
    active.x, active.y = active.pixel[: active.num_rays] % camera.width, active.pixel[: active.num_rays] // camera.width
    num_pixels = camera.height * camera.width
    target = np.where(np.arange(len(active.pixel)) < active.num_rays, active.pixel, num_pixels)[: active.num_rays]
    levels = [jnp.zeros((num_pixels, 3), jnp.float32)] * plan.num_levels
    diagnostics = {"overflow": jnp.int32(lost), "active_pixels": jnp.int32(active.num_rays)}
    for lit in entries:
        lit = clock("order", padded_surfels, lit, plan)
        table, cells = clock("table", build_transport, scene, active, lit, plan, caster, seed=seed)
        images, counts = splat_levels(scene, active, lit, table, cells, plan, seed=seed, clock=clock)
        for level, (tiles, slot) in enumerate(images):
            image = clock("unshuffle", reconstruction.unshuffle, tiles, slot, target, num_pixels=num_pixels)
            levels[level] = levels[level] + image
        for name, count in counts.items():
            diagnostics[name] = diagnostics.get(name, 0) + jnp.asarray(count, jnp.float32)
    diagnostics["surfels"] = jnp.int32(sum(lit.area.shape[0] for lit in entries))
    image = clock("blur", _compose, levels, active.map, target, shape, plan)
    return Estimate(mean=Layers(**{LAYER: image}), diagnostics=diagnostics)


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
