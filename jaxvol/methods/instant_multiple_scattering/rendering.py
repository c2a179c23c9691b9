"""Eye rays in, layers out: sets of lights, tiles of pixels, averages and variances over the sets."""

import dataclasses
from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, UInt

from jaxvol import camera as pinhole
from jaxvol import layers, materials, media, ray_casting, sampling
from jaxvol.common_stages import CommonStages
from jaxvol.methods.instant_multiple_scattering import (
    compensation,
    eye_rays,
    gathering,
    light_paths,
    maps,
    ray_lights,
    selection,
    stages,
    upsampling,
    virtual_lights,
)
from jaxvol.methods.instant_multiple_scattering.planning import Plan
from jaxvol.methods.instant_multiple_scattering.receivers import Points
from jaxvol.methods.instant_multiple_scattering.stages import Context
from jaxvol.methods.instant_multiple_scattering.virtual_lights import LightSet
from jaxvol.types import Camera, Estimate, Scene

_PIXEL = sampling.stream("instant_multiple_scattering.pixel")
_TRACED = "traced."  # before the names of lights from which some were chosen
_BAND = 1 << 16  # pixels that are reconstructed at once
_TERMS = ("surface", "volume", "multiple")
NAMES = tuple(f"{last}_from_{before}" for last in ("surface", "volume") for before in _TERMS)


def trace_lights(
    scene: Scene, caster: ray_casting.Caster, plan: Plan, *, seed: int, sizes: dict[str, int] | None = None
) -> tuple[LightSet, dict[str, int]]:
    """One set of virtual lights and the counts of its paths; for `sizes` see `virtual_lights`."""
    vertices, counts = light_paths.trace(scene, caster, seed=seed, paths=np.arange(plan.num_paths), max_depth=plan.max_depth)
    found = virtual_lights.virtual_lights(scene, vertices, num_paths=plan.num_paths, sizes=sizes)
    return found, {**counts, "num_lights": len(vertices.path)}


def make_context(
    scene: Scene, plan: Plan, *, seed: int, lights: LightSet | None = None, sizes: dict[str, int] | None = None
) -> tuple[Context, dict[str, int]]:
    """Trace a set of lights (or take the one given) and prepare what the gathering stages share."""
    caster = ray_casting.caster_for(scene.mesh, kind=plan.caster)
    counts: dict[str, int] = {}
    if plan.lights == "rays":
        paths = np.arange(plan.num_paths)
        vertices, counts = light_paths.trace(scene, caster, seed=seed, paths=paths, max_depth=plan.max_depth)
        flights = ray_lights.ray_lights(scene, vertices, num_paths=plan.num_paths, seed=seed, sizes=sizes)
        context = Context(scene, caster, LightSet(), None, plan, seed, scene.medium, rays=flights)
        return context, {**counts, "num_lights": len(vertices.path)}
    if lights is None:
        lights, counts = trace_lights(scene, caster, plan, seed=seed, sizes=sizes)
    medium = marched = scene.medium
    mip = None
    if medium is not None and medium.density is not None:
        mip = jnp.asarray(compensation.coarse_density(medium.density, block=plan.mip_block))
        if plan.columns == "mip":
            marched = dataclasses.replace(medium, density=jnp.asarray(compensation.block_means(medium.density, block=2)))
    context = Context(scene, caster, lights, mip, plan, seed, marched)
    depth = "maps" in (plan.shadows, plan.visibility)
    if virtual_lights.num_lights(lights) and (depth or plan.columns == "maps"):
        found = maps.build(
            scene, caster, lights, size=plan.map_size, num_steps=plan.map_steps, depth=depth, columns=plan.columns == "maps"
        )
        tree = maps.make_tree(found) if plan.visibility == "maps" else None
        context = context._replace(maps=found, tree=tree)
    return context, counts


def select_lights(
    scene: Scene,
    camera: Camera,
    plan: Plan,
    *,
    seed: int,
    lights: LightSet | None = None,
    sizes: dict[str, int] | None = None,
) -> tuple[LightSet, dict[str, int]]:
    """Trace a set of lights (or take the one given) and keep about `plan.max_lights`, those that the picture sees most.

    Counts "num_traced" lights before the choice. Updates `sizes` with those of the whole set.
    """
    caster = ray_casting.caster_for(scene.mesh, kind=plan.caster)
    counts: dict[str, int] = {}
    if lights is None:
        before = None if sizes is None else {name[len(_TRACED) :]: n for name, n in sizes.items() if name.startswith(_TRACED)}
        lights, counts = trace_lights(scene, caster, plan, seed=seed, sizes=before)
        counts["num_traced"] = counts["num_lights"]
        if sizes is not None:
            sizes.update({_TRACED + name: n for name, n in virtual_lights.sizes(lights).items()})
    found = selection.select(scene, caster, camera, lights, plan, seed=seed, sizes=sizes)
    return found, {**counts, "num_lights": virtual_lights.num_lights(found)}


def gather_rays(
    context: Context,
    origin: Float[Array, "n 3"],
    direction: Float[Array, "n 3"],
    t: Float[Array, "n"],
    face: Array,
    index: UInt[Array, "n"],
) -> dict[str, Float[Array, "n 3"]]:
    """The six layers along eye rays whose first hits (t, face) are given; `index` numbers them for random numbers."""
    plan = context.plan
    result = dict.fromkeys(NAMES, jnp.zeros(origin.shape, jnp.float32))
    if plan.volume:
        result |= _named("volume", _volume(context, origin, direction, t, index))
    if plan.surface:
        result |= _named("surface", _surface(context, origin, direction, t, face, index))
    return result


def _named(last, sums):
    return {f"{last}_from_{term}": sums[term] for term in _TERMS}


def _chains(context, points_for, index):
    """Mean residual over the chains; points_for(chain, number, first) gives points and throughput of one of `number`."""
    plan = context.plan
    total = stages.zero_sums(index.shape[0])
    if plan.num_levels == 0:
        return total
    kinds = [(plan.num_chains, False, 0)]
    if plan.direct_at_vertex:
        kinds.append((plan.num_direct, True, plan.num_chains))
    for number, lit, first in kinds:

        def add_chain(chain, total, number=number, lit=lit, first=first):
            points, throughput = points_for(chain, number, first)
            found = stages.compensate(context, points, throughput, index, chain=first + chain, lit=lit)
            return _plus(total, found, 1.0 / number)

        if context.scene.mesh is None:
            total = lax.fori_loop(0, number, add_chain, total)
        else:  # rays are cast between jitted steps
            for chain in range(number):
                total = add_chain(chain, total)
    return total


@jax.jit
def _plus(sums, others, scale):
    """Light so far, and a share of more."""
    return {name: sums[name] + others[name] * scale for name in sums}


def _volume(context, origin, direction, t, index):
    if context.scene.mesh is not None:
        return _volume_in_steps(context, origin, direction, t, index)
    inputs = context._replace(plan=None, seed=jnp.uint32(context.seed))
    return _volume_at_once(inputs, origin, direction, t, index, plan=context.plan)


@partial(jax.jit, static_argnames="plan")
def _volume_at_once(context, origin, direction, t, index, *, plan):
    """Without surfaces nothing is cast, so that all of it is one program."""
    return _volume_in_steps(context._replace(plan=plan), origin, direction, t, index)


def _volume_in_steps(context, origin, direction, t, index):
    segments = stages.segments_of(context, origin, direction, t)
    gathered = stages.gather_segments(context, segments, index)

    def eye(chain, number, first):
        along, kind = _eye_uniforms(context.seed, index, chain / number, 0.5 * chain)
        return stages.eye_vertices(context, segments, along, kind, index, chain=first + chain)

    return _plus(gathered, _chains(context, eye, index), 1.0)


@jax.jit
def _eye_uniforms(seed, index, *shifts):
    u = sampling.uniforms(seed, _PIXEL, index, 2)
    return tuple(gathering.shifted(x, shift) for x, shift in zip(u, shifts, strict=False))


def _surface(context, origin, direction, t, face, index):
    points, tau, u = _reflecting(context.scene, context.mip, origin, direction, t, face, index, context.seed, plan=context.plan)
    gathered = stages.gather_points(context, points, u, stride=1, offset=0)
    residual = _chains(context, lambda *_: (points, tau), index + jnp.uint32(0x40000000))
    return _plus(residual, gathered, tau)


@partial(jax.jit, static_argnames="plan")
def _reflecting(scene, mip, origin, direction, t, face, index, seed, *, plan):
    """Points where eye rays meet surfaces, the transmittance to them (0: none met), and a uniform."""
    hit = ray_casting.hits(scene.mesh, origin, direction, t, face)
    tau = jnp.ones(origin.shape, jnp.float32)
    if scene.medium is not None:
        segments = stages.segments(scene, mip, origin, direction, jnp.where(hit.valid, hit.t, 0.0), plan=plan)
        column = segments.t1 - segments.t0 if segments.column is None else segments.column[-1]
        tau = jnp.exp(-column[:, None] * media.sigma_t(scene.medium))
    tau = jnp.where(hit.valid[:, None], tau, 0.0)
    clamp = None if plan.mean_free_paths is None else compensation.clamp_at(scene, mip, hit.position, plan=plan)
    nothing = jnp.zeros(origin.shape, jnp.float32)
    surface = materials.surface_at(scene.mesh, face)
    points = Points(hit.position, -direction, nothing, clamp, hit.valid, hit.normal, surface)
    return points, tau, sampling.uniforms(seed, _PIXEL, index, 3)[0]


def render_set(
    scene: Scene,
    camera: Camera,
    plan: Plan,
    *,
    seed: int,
    lights: LightSet | None = None,
    sizes: dict[str, int] | None = None,
    edges: Bool[np.ndarray, "HW"] | None = None,
) -> tuple[dict[str, Float[np.ndarray, "HW 3"]], dict[str, int]]:
    """All pixels lit by one set of virtual lights: layers by name (numpy), and counts. Updates `sizes`.

    `edges`: pixels that get `plan.edge_rays` eye rays, the others get one.
    """
    number = camera.height * camera.width
    result = {name: np.zeros((number, 3), np.float32) for name in NAMES}
    if not (plan.volume or plan.surface):
        return result, {"num_truncated": 0, "num_lights": 0}
    traced: dict[str, int] = {}
    if plan.max_lights is not None:
        lights, traced = select_lights(scene, camera, plan, seed=seed, lights=lights, sizes=sizes)
    context, counts = make_context(scene, plan, seed=seed, lights=lights, sizes=sizes)
    counts = {**counts, **traced}
    if sizes is not None:
        found = virtual_lights.sizes(context.lights) if context.rays is None else ray_lights.sizes(context.rays)
        sizes.update(found)
    if plan.upsample == 1:
        _evaluate(context, camera, np.arange(number, dtype=np.uint32), result, edges)
        return result, counts
    return _from_low_resolution(context, camera, result, counts)


def _computed(plan):
    """Names of the layers that are not zero in every pixel."""
    return tuple(name for name in NAMES if (plan.volume if name.startswith("volume") else plan.surface))


def _evaluate(context, camera, index, result, edges=None):
    """All layers at the pixels `index`, tile by tile, into `result`."""
    names = _computed(context.plan)
    pixel, ray, share = eye_rays.lanes(index, edges, context.plan.edge_rays)
    for name in names:
        result[name][index] = 0.0
    size = min(context.plan.tile, virtual_lights.capacity(len(pixel)))
    for begin in range(0, len(pixel), size):
        part = np.minimum(np.arange(begin, begin + size), len(pixel) - 1)
        others = None if edges is None else jnp.asarray(ray[part])
        rays, weight = eye_rays.through_pixels(context, camera, jnp.asarray(pixel[part]), ray=others)
        values = gather_rays(context, *rays)
        real = slice(None, len(pixel) - begin)
        weight = (weight * share[part, None])[real]
        for name in names:
            np.add.at(result[name], pixel[part][real], np.asarray(values[name])[real] * weight)


def _from_low_resolution(context, camera, result, counts):
    """Every upsample-th pixel each way, bilateral reconstruction, and the pixels where no neighbour resembles."""
    plan = context.plan
    factor, number = plan.upsample, camera.height * camera.width
    rows, columns = -(-camera.height // factor), -(-camera.width // factor)
    rays = eye_rays.block_rays(context, camera, rows, columns, factor=factor)
    shape = (rows * columns, 3)
    names = _computed(plan)
    coarse = {name: np.zeros(shape, np.float32) for name in names}
    for begin in range(0, shape[0], plan.tile):
        part = tuple(x[begin : begin + plan.tile] for x in rays)
        values = gather_rays(context, *part)
        for name in names:
            coarse[name][begin : begin + plan.tile] = np.asarray(values[name])
    steps = max(plan.eye_steps // 2, 1)
    low_guides = upsampling.guides(context.scene, *rays[:4], num_steps=steps)
    size = min(number, _BAND)
    refused = []
    for begin in range(0, number, size):
        count = min(size, number - begin)
        pixels = jnp.minimum(jnp.arange(begin, begin + size, dtype=jnp.int32), number - 1)
        centers, _ = eye_rays.through_pixels(_without_jitter(context), camera, pixels.astype(jnp.uint32))
        guides = upsampling.guides(context.scene, *centers[:4], num_steps=steps)
        guides = _with_mean_source(context, camera, guides, pixels.astype(jnp.uint32))
        options = {"height": camera.height, "width": camera.width, "factor": factor, "pixels": pixels}
        built, weight = upsampling.reconstruct(coarse, low_guides, guides, **options)
        for name in names:
            result[name][begin : begin + count] = np.asarray(built[name])[:count]
        seen = np.asarray(jnp.any(guides.source > 0, axis=-1) | guides.hits)
        refused.append(begin + np.flatnonzero(((np.asarray(weight) < plan.refine_below) & seen)[:count]))
    again = np.concatenate(refused).astype(np.uint32)
    if len(again):
        _evaluate(context, camera, again, result)
    return result, {**counts, "num_refined": len(again), "num_evaluated": len(again) + shape[0]}


def _with_mean_source(context, camera, guides, pixels):
    """The factor that puts transmittance back, averaged over the pixel when pixels are jittered and nothing occludes."""
    if not context.plan.jitter or context.scene.mesh is not None:
        return guides
    steps = max(context.plan.eye_steps // 2, 1)
    source = _mean_source(context.scene, camera, pixels, num_steps=steps)
    return dataclasses.replace(guides, source=source)


@partial(jax.jit, static_argnames="num_steps")
def _mean_source(scene, camera, index, *, num_steps):
    """1 - exp(-tau), averaged over strata of the pixels."""
    strata = eye_rays.STRATA if scene.medium.density is None else eye_rays.STRATA // 2
    corner = jnp.stack([index % camera.width, index // camera.width], axis=-1).astype(jnp.float32)
    t = jnp.full(index.shape, jnp.inf, jnp.float32)
    face = jnp.full(index.shape, -1, jnp.int32)

    def body(k, total):
        inside = (jnp.stack([k % strata, k // strata]).astype(jnp.float32) + 0.5) / strata
        rays = pinhole.generate_rays(camera, corner + inside)
        return total + upsampling.guides(scene, rays.origin, rays.direction, t, face, num_steps=num_steps).source

    return lax.fori_loop(0, strata * strata, body, jnp.zeros((*index.shape, 3), jnp.float32)) / (strata * strata)


def _without_jitter(context):
    return context._replace(plan=dataclasses.replace(context.plan, jitter=False))


def render(
    scene: Scene,
    camera: Camera,
    plan: Plan,
    *,
    seed: int = 0,
    on_progress: Callable[[float], None] | None = None,
    common: CommonStages | None = None,
) -> Estimate:
    """The six layers, the mean over `plan.num_sets` independent sets of lights, and its variance when there are several.

    `common` holds what other methods have computed already. Diagnostics: "num_truncated" light paths that were cut at
    max_depth, "num_lights" virtual lights of all sets; with upsampling "num_evaluated" and "num_refined" pixels.
    """
    counts: dict[str, int] = {}
    sizes: dict[str, int] | None = {} if plan.num_sets > 1 else None
    names = _computed(plan)
    mean: dict[str, np.ndarray] = {}
    single = dataclasses.replace(plan, num_sets=1)  # sets share their programs with a picture of one
    squares = {name: np.float32(0.0) for name in names}  # summed squared deviations from the mean (Welford 1962)
    edges = None
    if names and plan.edge_rays > 1:
        edges = (CommonStages(scene, camera) if common is None else common).edge_pixels
    for k in range(plan.num_sets):
        images, found = render_set(scene, camera, single, seed=(seed * 65537 + k) & 0x7FFFFFFF, sizes=sizes, edges=edges)
        counts = {name: counts.get(name, 0) + value for name, value in found.items()}
        for name in names:
            before = mean.get(name, np.float32(0.0))
            mean[name] = images[name] if k == 0 else before + (images[name] - before) / (k + 1)
            if k > 0:
                squares[name] = squares[name] + (images[name] - before) * (images[name] - mean[name])
        if on_progress is not None:
            on_progress((k + 1) / plan.num_sets)
    number = plan.num_sets
    shape = (camera.height, camera.width, 3)
    black = dict.fromkeys(NAMES, jnp.zeros(shape, jnp.float32))  # one array for all layers that are zero
    variance = None
    if number > 1:
        scale = 1.0 / (number * (number - 1))
        found = {name: jnp.asarray((squares[name] * scale).reshape(shape)) for name in names}
        variance = layers.from_items(black | found)
    return Estimate(
        mean=layers.from_items(black | {name: jnp.asarray(mean[name].reshape(shape)) for name in names}),
        variance=variance,
        num_samples=jnp.float32(number) if number > 1 else None,
        diagnostics={name: jnp.asarray(value) for name, value in counts.items()},
    )
