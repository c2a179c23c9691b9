"""The stages in order for one tile of receivers: gather clamped, then compensate; rays cast between jitted steps.

Results are dictionaries with the keys "surface", "volume" and "multiple": what the light did before its last scattering
at the receiver. Whether the receiver is in the medium or on a surface decides which layers they belong to.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float, UInt
from scipy.spatial import cKDTree

from jaxvol import lights as primary
from jaxvol import media, ray_casting, sampling
from jaxvol.methods.instant_multiple_scattering import (
    compensation,
    gathering,
    maps,
    picking,
    ray_lights,
    receivers,
    virtual_lights,
)
from jaxvol.methods.instant_multiple_scattering.maps import Maps
from jaxvol.methods.instant_multiple_scattering.planning import Plan
from jaxvol.methods.instant_multiple_scattering.ray_lights import RaySet
from jaxvol.methods.instant_multiple_scattering.receivers import Points, Segments
from jaxvol.methods.instant_multiple_scattering.virtual_lights import ORIGIN, LightSet, VirtualLights, blocks
from jaxvol.types import Medium, Scene

_EYE = sampling.stream("instant_multiple_scattering.eye")
_SHARE = sampling.stream("instant_multiple_scattering.share")
_CHAIN = sampling.stream("instant_multiple_scattering.chain")
_RECURRENCE = (0.8566749, 0.7338919, 0.6287067, 0.5385973)  # powers of 1/1.1673040 (Roberts 2018, four dimensions)
_REDUCED = 0.25  # of the clamp distance: a bound 16 times higher

Sums = dict[str, Float[Array, "n 3"]]


class Context(NamedTuple):
    """What all stages of a set of lights share."""

    scene: Scene
    caster: ray_casting.Caster
    lights: LightSet
    mip: Float[Array, "x y z"] | None
    plan: Plan
    seed: ArrayLike  # uint32
    marched: Medium | None  # what pairs march through: the medium, or a coarse copy of it
    maps: Maps | None = None
    rays: RaySet | None = None  # in the place of the lights
    tree: cKDTree | None = None  # of the lights, where maps stand for the geometry around receivers


def zero_sums(n: int) -> Sums:
    """Nothing gathered yet."""
    return {name: jnp.zeros((n, 3), jnp.float32) for name in ("surface", "volume", "multiple")}


_uniforms = jax.jit(sampling.uniforms, static_argnums=1)


def _groups(block: VirtualLights, size: int) -> int:
    return max(1, -(-block.position.shape[0] // size))


def segments_of(
    context: Context,
    origin: Float[Array, "n 3"],
    direction: Float[Array, "n 3"],
    t_end: Float[Array, "n"],
) -> Segments:
    """The part of eye rays inside the medium and before `t_end`, with clamp distance and, in a grid, their table."""
    return segments(context.scene, context.mip, origin, direction, jnp.asarray(t_end), plan=context.plan)


@partial(jax.jit, static_argnames="plan")
def segments(
    scene: Scene,
    mip: Float[Array, "x y z"] | None,
    origin: Float[Array, "n 3"],
    direction: Float[Array, "n 3"],
    t_end: Float[Array, "n"],
    *,
    plan: Plan,
) -> Segments:
    """What `segments_of` gives."""
    medium = scene.medium
    t0, t1 = media.box_interval(medium.bounds, origin, direction)
    t1 = jnp.maximum(jnp.minimum(t1, t_end), t0)
    clamp = None
    if plan.mean_free_paths is not None:
        thickest = jnp.mean(media.sigma_t(medium)) * (1.0 if mip is None else jnp.max(mip))
        clamp = compensation.clamp_distance(
            thickest, mean_free_paths=plan.mean_free_paths, most=compensation.most_clamp(scene, plan.most_clamp)
        )
    found = Segments(origin, direction, t0, t1, clamp)
    if medium.density is None:
        return found
    column = receivers.columns_along(found, medium, num_steps=plan.eye_steps)
    return Segments(origin, direction, t0, t1, clamp, column)


def gather_segments(context: Context, segments: Segments, index: UInt[Array, "n"]) -> Sums:
    """Clamped (or unclamped) light of all virtual lights along eye rays."""
    plan, medium = context.plan, context.scene.medium
    sums = zero_sums(index.shape[0])
    u = _uniforms(context.seed, _EYE, index, 0)
    stratified = plan.sampling == "stratified"
    if context.rays is not None:
        for name in ("volume", "multiple"):
            flights = getattr(context.rays, name)
            if flights is not None:
                options = {"grey": plan.grey, "isotropic": plan.isotropic}
                sums[name] = ray_lights.gather_segments(segments, u[0], u[1], flights, medium, **options)
        return sums
    for number, (name, block) in enumerate(blocks(context.lights)):
        if not plan.costly:
            value = gathering.gather_segments(
                segments,
                u[0],
                block,
                medium,
                grey=plan.grey,
                isotropic=plan.isotropic,
                stratified=stratified,
                num_evaluations=plan.num_evaluations,
            )
        else:
            u_group = _uniforms(context.seed, _EYE, index, 1 + number)[0]
            picks = picking.pick_for_segments(
                segments,
                u[0],
                u_group,
                block,
                medium,
                num_groups=_groups(block, plan.group_size),
                isotropic=plan.isotropic,
                stratified=stratified,
            )
            value = _evaluate_segments(context, segments, picks, name, block)
        sums[ORIGIN[name]] = sums[ORIGIN[name]] + value
    return sums


def _evaluate_segments(context, segments, picks, name, block):
    plan = context.plan
    position = picking.points_of(segments, picks)
    clamps = None
    if context.mip is not None and plan.mean_free_paths is not None:
        clamps = compensation.clamp_at(context.scene, context.mip, position, plan=plan)
    visible, columns = _between(context, picks, position, position, name, block)
    return picking.evaluate_segments(
        segments,
        picks,
        visible,
        columns,
        block,
        context.scene.medium,
        context.marched,
        clamps,
        isotropic=plan.isotropic,
        num_steps=plan.pair_steps,
    )


def _between(context, picks, position, origin, name, block, *, stride=1, offset=0):
    """Visibility of the picked lights from points (None: all), and density columns to them (None: to be marched).

    `origin` is where shadow rays start. The block may hold every `stride`-th light from `offset` on.
    """
    plan = context.plan
    index = None
    if context.maps is not None:
        index = maps.first_rows(context.lights)[name] + picks.light * stride + offset
        position = jnp.broadcast_to(position, (*index.shape, 3))
    visible, columns = None, None
    if context.scene.mesh is not None:
        if plan.shadows == "maps":
            visible = maps.visible(context.maps, index, position)
        else:
            rays = picking.shadow_rays(origin, block, picks)
            visible = jnp.asarray(~ray_casting.occluded(context.caster, *rays))
    if plan.columns == "maps":
        columns = maps.column(context.maps, index, position)
    return visible, columns


def gather_points(context: Context, points: Points, u: Float[Array, "n"], *, stride: int, offset: ArrayLike) -> Sums:
    """Clamped (points.clamp None: unclamped) light of one of `stride` virtual lights, weighted up, at points.

    `offset` says which, 0 ... stride - 1.
    """
    plan, medium = context.plan, context.scene.medium
    sums = zero_sums(u.shape[0])
    for name, block in blocks(context.lights):
        if stride > 1:
            block = virtual_lights.subset(block, offset, stride=stride)
        if not plan.costly:
            value = gathering.gather_points(points, block, medium, grey=plan.grey, isotropic=plan.isotropic)
        else:
            picks = picking.pick_for_points(
                points, u, block, medium, num_groups=_groups(block, plan.group_size), isotropic=plan.isotropic
            )
            origin = receivers.lifted(context.scene, points)
            between = _between(context, picks, points.position, origin, name, block, stride=stride, offset=offset)
            value = picking.evaluate_points(
                points, picks, *between, block, medium, context.marched, isotropic=plan.isotropic, num_steps=plan.pair_steps
            )
        sums[ORIGIN[name]] = sums[ORIGIN[name]] + value
    return sums


def eye_vertices(
    context: Context,
    segments: Segments,
    u: Float[Array, "n"],
    u_kind: Float[Array, "n"],
    index: UInt[Array, "n"],
    *,
    chain: Array,
) -> tuple[Points, Float[Array, "n 3"]]:
    """One point of each eye ray by transmittance, and its weight: what carries the residual there to the eye.

    Near a light in the medium every other point (`u_kind` < 0.5) is chosen towards the light that the chain will use.
    """
    u_light = _chain_uniforms(context.seed, index, jnp.int32(0), jnp.int32(chain))[6:9]
    return _eye_vertices(context.scene, context.mip, segments, u, u_kind, u_light, plan=context.plan)


@partial(jax.jit, static_argnames="plan")
def _eye_vertices(scene, mip, segments, u, u_kind, u_light, *, plan):
    medium = scene.medium
    extinction = media.sigma_t(medium)
    sigma = jnp.mean(extinction)
    light = primary.sample_light(scene, segments.origin, *u_light).position
    near = jnp.all((light > medium.bounds[0]) & (light < medium.bounds[1]), axis=-1)
    t, inverse_pdf = receivers.sample_transmittance_or_light(segments, u, u_kind < 0.5, sigma, light, near)
    position = segments.origin + t[:, None] * segments.direction
    column = receivers.column_at(segments, t)
    throughput = inverse_pdf[:, None] * jnp.exp(-column[:, None] * extinction)
    scattering = jnp.broadcast_to(medium.sigma_s, position.shape)
    clamp = compensation.clamp_at(scene, mip, position, plan=plan)
    points = Points(position, -segments.direction, scattering, clamp)
    if scene.mesh is not None:
        nowhere = jnp.full(t.shape, -1, jnp.int32)
        hit = ray_casting.hits(scene.mesh, position, segments.direction, jnp.full(t.shape, jnp.inf), nowhere)
        surface = receivers.no_surface(scene.mesh, t.shape[0])
        points = Points(position, -segments.direction, scattering, clamp, nowhere >= 0, hit.normal, surface)
    return points, throughput


def compensate(
    context: Context,
    points: Points,
    throughput: Float[Array, "n 3"],
    index: UInt[Array, "n"],
    *,
    chain: ArrayLike,
    lit: bool,
) -> Sums:
    """The residual of clamping at points (section 4.3), through `num_levels` new vertices one after the other.

    `lit`: only the primary lights' share of it, else only the virtual lights': the first is a few rays, the second a sum
    over many lights, and most of the noise is in the first, so that they are sampled apart.
    """
    plan, scene = context.plan, context.scene
    sums = zero_sums(index.shape[0])
    for level in range(plan.num_levels):
        u = _chain_uniforms(context.seed, index, jnp.int32(level), jnp.int32(chain))
        proposal = _propose(scene, points, u, lit=lit)
        s, face = _surface_within(context, points, proposal)
        arguments = (scene, context.mip, points, proposal, throughput, s, face, u)
        if lit:
            sums = _add_primary(context, sums, arguments, first=level == 0)
            if level == plan.num_levels - 1:
                return sums
        points, throughput = _advance(*arguments, plan=plan)
        if not lit:
            found = _gather_at_end(context, points, u[5], chain, level)
            sums = {**sums, "multiple": _add_product(sums["multiple"], throughput, *found.values())}
    return sums


def _add_primary(context, sums, arguments, *, first):
    """The primary lights' share of one level, at vertices of their own: close to the light that was chosen."""
    scene, plan = context.scene, context.plan
    found, throughput, sample, origin = _towards_light(*arguments, plan=plan)
    visible = None
    if scene.mesh is not None:
        short = sample.distance * (1.0 - 1e-4)
        visible = jnp.asarray(~ray_casting.occluded(context.caster, origin, sample.direction, short))
    return _book_direct(scene, sums, found, throughput, sample, visible, jnp.bool_(first), plan=plan)


@jax.jit
def _add_product(total, throughput, *parts):
    return total + throughput * sum(parts)


def _gather_at_end(context, points, u, chain, level):
    """Light of a random share of the virtual lights at new vertices; the last ones may be clamped less."""
    plan = context.plan
    if level == plan.num_levels - 1 and plan.end != "clamped":
        points = receivers.with_clamp(points, None if plan.end == "unclamped" else _REDUCED * points.clamp)
    offset = _share(context.seed, chain, level, stride=plan.light_stride)
    return gather_points(context, points, u, stride=plan.light_stride, offset=offset)


@partial(jax.jit, static_argnames="stride")
def _share(seed, chain, level, *, stride):
    """Which of `stride` shares of the lights a new vertex gathers from."""
    mixed = jnp.asarray(seed, jnp.uint32) ^ jnp.uint32(_SHARE)
    hashed = sampling.pcg4d(jnp.asarray(chain, jnp.uint32), jnp.asarray(level, jnp.uint32), jnp.uint32(0), mixed)[0]
    return (hashed % jnp.uint32(stride)).astype(jnp.int32)


@jax.jit
def _chain_uniforms(seed, index, level, chain):
    """Twelve uniforms of a level: those of direction and distance go on from chain to chain by an additive recurrence."""
    own = sum((sampling.uniforms(seed, _CHAIN, index, 4 * level + i + 64 * chain) for i in range(3)), ())
    first = sum((sampling.uniforms(seed, _CHAIN, index, 4 * level + i) for i in range(3)), ())
    spread = dict(zip((0, 1, 9, 3), _RECURRENCE, strict=True))
    return tuple(gathering.shifted(first[i], spread[i] * chain) if i in spread else own[i] for i in range(12))


@partial(jax.jit, static_argnames="lit")
def _propose(scene, points, u, *, lit):
    proposal = compensation.propose(scene, points, u[0], u[1], u[2])
    if not lit or scene.medium is None:
        return proposal
    target = primary.sample_light(scene, points.position, u[6], u[7], u[8]).position
    return compensation.propose_near_light(scene, points, proposal, target, (u[0], u[1], u[10]))


@partial(jax.jit, static_argnames="plan")
def _advance(scene, mip, points, proposal, throughput, s, face, u, *, plan):
    """New vertices with their clamp distance, and the throughput to them."""
    sigma = compensation.local_sigma(scene.medium, mip, points.position)
    step = compensation.choose_kind(scene, points, s, face, u[4])
    t, factor = compensation.distance_onwards(points, step, u[3], sigma, distance=plan.distance)
    even = compensation.is_even(scene.medium, mip, points.position, points.clamp)
    found, gain = compensation.new_vertices(
        scene, points, proposal, step, t, factor, sigma, even, transmittance=plan.transmittance, num_steps=_steps_within(plan)
    )
    found = receivers.with_clamp(found, compensation.clamp_at(scene, mip, found.position, plan=plan))
    return found, throughput * gain


@partial(jax.jit, static_argnames="plan")
def _towards_light(scene, mip, points, proposal, throughput, s, face, u, *, plan):
    """Vertices for the light of the primary lights, the throughput to them, the light and the shadow ray's origin."""
    sigma = compensation.local_sigma(scene.medium, mip, points.position)
    step = compensation.choose_kind(scene, points, s, face, u[4])
    target = primary.sample_light(scene, points.position, u[6], u[7], u[8]).position
    t, factor = compensation.distance_to_light(points, proposal, step, u[9], target)
    even = compensation.is_even(scene.medium, mip, points.position, points.clamp)
    found, gain = compensation.new_vertices(
        scene, points, proposal, step, t, factor, sigma, even, transmittance=plan.transmittance, num_steps=_steps_within(plan)
    )
    # The same numbers lead to the same point of the same light.
    sample, origin = compensation.sample_primary(scene, found, u[6], u[7], u[8])
    return found, throughput * gain, sample, origin


def _steps_within(plan):
    """Steps of a march that is no longer than the clamp distance."""
    return max(4, plan.pair_steps // 4)


@partial(jax.jit, static_argnames="plan")
def _book_direct(scene, sums, points, throughput, sample, visible, first, *, plan):
    """Add the primary light at new vertices: by what the first vertex is, later ones to "multiple"."""
    steps = max(plan.pair_steps, plan.eye_steps)
    value = compensation.direct_light(scene, points, sample, visible, isotropic=plan.isotropic, num_steps=steps)
    value = throughput * value
    on = jnp.zeros((1, 1), bool) if points.on_surface is None else points.on_surface[:, None]
    return {
        "surface": sums["surface"] + jnp.where(first & on, value, 0.0),
        "volume": sums["volume"] + jnp.where(first & ~on, value, 0.0),
        "multiple": sums["multiple"] + jnp.where(first, 0.0, value),
    }


def _surface_within(context, points, proposal):
    """The nearest surface within the clamp distance along the proposed directions; nothing with visibility="none"."""
    n = points.position.shape[0]
    if context.scene.mesh is None or context.plan.visibility == "none":
        return jnp.full(n, jnp.inf, jnp.float32), jnp.full(n, -1, jnp.int32)
    if context.plan.visibility == "maps":
        index = maps.nearest_lights(context.tree, points.position)
        rays = (proposal.origin, proposal.direction, points.clamp)
        return maps.surface_within(context.maps, context.scene.mesh, index, *rays)
    return ray_casting.intersect(context.caster, proposal.origin, proposal.direction, points.clamp)
