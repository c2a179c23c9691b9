"""Light that the medium scatters once to the eye: the layer L V E.

The eye ray is cut into cells (`cells`). Each light then places nodes on it: equi-angular times transmittance for lights
at a point (a sample of an emissive face is one), transmittance alone for lights at infinity. At the nodes: phase
function, light, shadow, transmittance towards the light. For the environment and a peaked phase function a second set of
directions follows the phase function; the two are combined by the balance heuristic.
"""

import math
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from jaxvol import lights, media, phase, segments
from jaxvol.direct import cells as ray_cells
from jaxvol.direct import emitters, patterns, sky_field
from jaxvol.direct.connections import Connections, Context, LightRun, bucket, resolve
from jaxvol.sampling import dot
from jaxvol.types import Rays

_AREA_SET, _SKY_SET, _PHASE_SET, _EMITTER_SET = 3, 4, 5, 6


def scattered_light(
    context: Context, rays: Rays, t_surface: Float[Array, "n"], pixel, sample, seed, *, num_samples: int
) -> Float[Array, "n 3"]:
    """Single scattering along rays up to t_surface (inf: none); `sample` of `num_samples` shifts the nodes."""
    plan, medium = context.plan, context.scene.medium
    n = rays.origin.shape[0]
    if segments.is_box(medium):
        pieces = None
        t0, t1 = _box(medium, rays, t_surface)
    else:
        end = jnp.minimum(rays.t_max, t_surface)
        pieces = segments.segments(medium, rays.origin, rays.direction, end, casters=context.medium_casters)
        t0, t1 = pieces.t[:, 0], pieces.t[:, -1]
    chosen = np.flatnonzero(np.asarray(t0) < np.asarray(t1))
    result = np.zeros((n, 3), np.float32)
    if chosen.size == 0:
        return jnp.asarray(result)
    lanes = np.concatenate([chosen, np.full(min(bucket(chosen.size), max(n, chosen.size)) - chosen.size, chosen[0])])
    origin, direction, t0, t1, pixel, sample = (
        np.asarray(x)[lanes] for x in (rays.origin, rays.direction, t0, t1, pixel, sample)
    )
    borders, region = None, None
    if pieces is not None:
        borders, region = _borders(np.asarray(pieces.t)[lanes], np.asarray(pieces.region)[lanes], plan.num_cells)
    cells = _cut(context.marching, origin, direction, t0, t1, borders, region, num_cells=plan.num_cells)
    total = jnp.zeros(origin.shape, jnp.float32)
    for run in context.lights:
        if run.field is not None:
            sizes = {"num_steps": plan.num_field_steps, "num_samples": num_samples}
            total = total + _from_field(context.marching, run.field, cells, origin, direction, sample, **sizes)
            continue
        for connections in _connections(context, run, cells, origin, direction, pixel, sample, seed, num_samples):
            total = total + resolve(context, run, connections)
    result[chosen] = np.asarray(total)[: chosen.size]
    return jnp.asarray(result)


@jax.jit
def _box(medium, rays, t_surface):
    t0, t1 = media.box_interval(medium.bounds, rays.origin, rays.direction)
    return t0, jnp.minimum(t1, jnp.minimum(rays.t_max, t_surface))


def _borders(t, region, num_cells):
    """Cell borders [M+1, n] that contain every border of the pieces, and the owner [M, n] of each cell; host."""
    extra = t.shape[1]
    uniform = t[:, :1] + np.linspace(0.0, 1.0, max(num_cells + 1 - extra, 2), dtype=np.float32) * (t[:, -1:] - t[:, :1])
    borders = np.sort(np.concatenate([uniform, t], axis=1), axis=1)
    middle = 0.5 * (borders[:, 1:] + borders[:, :-1])
    owner = np.full(middle.shape, -1, np.int32)
    for k in range(region.shape[1]):
        inside = (middle > t[:, k : k + 1]) & (middle < t[:, k + 1 : k + 2])
        owner = np.where(inside, region[:, k : k + 1], owner)
    return np.ascontiguousarray(borders.T), np.ascontiguousarray(owner.T)


@partial(jax.jit, static_argnames="num_cells")
def _cut(marching, origin, direction, t0, t1, borders, region, *, num_cells):
    if borders is None:
        borders = ray_cells.box_borders(marching, t0, t1, num_cells)
    return ray_cells.build(marching, origin, direction, borders, region)


def _connections(context: Context, run: LightRun, cells, origin, direction, pixel, sample, seed, num_samples):
    """The sets of connections that one light wants, one after the other."""
    plan = context.plan
    data = (context.marching, run.scene, cells, origin, direction, pixel, sample, seed)
    if run.kind in ("point", "spot"):
        yield _to_point(*data, 0, kind=run.kind, num_steps=plan.num_steps, num_points=1, num_samples=num_samples)
    elif run.kind == "directional":
        yield _to_sky(*data, None, num_steps=plan.num_steps, num_samples=num_samples, num_phase=0, directional=True)
    elif run.emitters is not None:
        yield _to_emitters(*data, run.emitters, num_steps=plan.num_emitter_steps, num_samples=num_samples)
    elif run.kind == "area":
        for k in range(plan.num_area_points):
            sizes = {"num_steps": plan.num_area_steps, "num_points": plan.num_area_points, "num_samples": num_samples}
            yield _to_point(*data, k, kind="area", **sizes)
    else:
        sizes = {"num_samples": num_samples, "num_phase": plan.num_phase_steps}
        if plan.num_environment_steps:
            yield _to_sky(*data, run.guide, num_steps=plan.num_environment_steps, directional=False, **sizes)
        if plan.num_phase_steps:
            yield _along_phase(*data, run.guide, num_steps=plan.num_environment_steps, **sizes)


def _phase(marching, region, cos_theta):
    """Phase function of the region that owns each node."""
    values = [phase.evaluate(m, cos_theta) for m in marching.regions]
    result = values[0]
    for r, value in enumerate(values[1:], start=1):
        result = jnp.where(region == r, value, result)
    return result


def _finish(marching, nodes, eye, light, extra, points):
    """Connections from nodes: weight times phase times light over its density."""
    cosine = dot(light.direction, eye)  # the light travels along -direction, then along -eye
    factor = _phase(marching, nodes.region, cosine) * extra
    return Connections(points, light.direction, light.distance, nodes.weight * light.radiance * factor[..., None])


@partial(jax.jit, static_argnames=("kind", "num_steps", "num_points"))
def _to_point(
    marching, scene, cells, origin, direction, pixel, sample, seed, k, *, kind, num_steps, num_points, num_samples
) -> Connections:
    """Towards a point light, a spot light, or point k of num_points on the emissive faces."""
    ones = jnp.ones(origin.shape[0], jnp.float32)
    if kind == "area":
        index = (k * num_samples + sample).astype(jnp.uint32)
        u1, u2, u3, shift = patterns.shifted(seed, pixel, index, _AREA_SET, 4)
    else:
        u1 = u2 = u3 = 0.5 * ones
        shift = patterns.step_shift(sample, num_samples)
    source = lights.sample_light(scene, origin, u1, u2, u3).position
    source = jnp.broadcast_to(source, origin.shape)
    interval = None
    if kind == "spot":
        interval = cone_interval(scene.spot_lights, origin, direction)
    u = (jnp.arange(num_steps, dtype=jnp.float32)[:, None] + shift) / num_steps
    nodes = ray_cells.place(marching, cells, u, origin=origin, direction=direction, point=source, interval=interval)
    points = origin + nodes.t[..., None] * direction
    u1, u2, u3 = (jnp.broadcast_to(x, nodes.t.shape) for x in (u1, u2, u3))
    light = lights.sample_light(scene, points, u1, u2, u3)
    weight = jnp.where(light.pdf > 0, 1.0 / (num_points * jnp.where(light.pdf > 0, light.pdf, 1.0)), 0.0)
    return _finish(marching, nodes, direction, light, weight, points)


def cone_interval(
    spots, origin: Float[Array, "n 3"], direction: Float[Array, "n 3"]
) -> tuple[Float[Array, "n"], Float[Array, "n"]]:
    """The part of each ray inside the (slightly widened) cone of the one spot light; all of it for cones beyond 80 degrees."""
    half = spots.cutoff[0] * 1.02 + 1e-3
    cos2 = jnp.cos(half) * jnp.cos(half)
    axis = spots.direction[0]
    from_apex = origin - spots.position[0]
    along, height = dot(direction, axis), dot(from_apex, axis)
    a = along * along - cos2
    b = along * height - cos2 * dot(from_apex, direction)
    c = height * height - cos2 * dot(from_apex, from_apex)
    root = jnp.sqrt(jnp.maximum(b * b - a * c, 0.0))
    safe = jnp.where(jnp.abs(a) > 1e-7, a, 1.0)
    first, second = (-b - root) / safe, (-b + root) / safe
    low, high = jnp.minimum(first, second), jnp.maximum(first, second)
    infinite = jnp.full_like(low, 3e37)
    # Ends of the ray inside the double cone (a > 0): the half that the axis points to. Else: between the roots, or nothing.
    begin = jnp.where(a > 0, jnp.where(along > 0, high, -infinite), low)
    end = jnp.where(a > 0, jnp.where(along > 0, infinite, low), high)
    inside = (b * b > a * c) & (height + 0.5 * (low + high) * along > 0)
    empty = (a < 0) & ~inside
    begin, end = jnp.where(empty, 0.0, begin), jnp.where(empty, 0.0, end)
    everything = (half > math.radians(80.0)) | (jnp.abs(a) <= 1e-7)
    return jnp.where(everything, -infinite, begin), jnp.where(everything, infinite, end)


def _sky_nodes(marching, cells, pixel, sample, seed, num_steps, num_samples, which, brightness=None):
    """Nodes by transmittance and a direction set over them: together a low-discrepancy set over (t, direction)."""
    shift = patterns.step_shift(sample, num_samples)
    steps = jnp.arange(num_steps, dtype=jnp.int32)[:, None]
    u = (steps.astype(jnp.float32) + shift) / num_steps
    nodes = ray_cells.place(marching, cells, u, brightness=brightness)
    index = (steps * num_samples + sample).astype(jnp.uint32)  # in the order of the quantiles of t
    u1, u2 = patterns.shifted(seed, jnp.broadcast_to(pixel, index.shape), index, which, 2)
    return nodes, u1, u2


@partial(jax.jit, static_argnames="num_steps")
def _to_emitters(
    marching, scene, cells, origin, direction, pixel, sample, seed, light, *, num_steps, num_samples
) -> Connections:
    """Towards a few emissive faces, by the solid angle they have at each node, a new direction at each node."""
    middle = 0.5 * (cells.t[1:] + cells.t[:-1])
    known = sum(emitters.brightness(light, origin + middle[..., None] * direction))
    # A cell behind the faces may reach in front of them: no cell is ruled out.
    known = known + 1e-3 * lax.stop_gradient(jnp.max(known, axis=0)) + 1e-30
    nodes, u1, u2 = _sky_nodes(marching, cells, pixel, sample, seed, num_steps, num_samples, _EMITTER_SET, known)
    points = origin + nodes.t[..., None] * direction
    found = emitters.sample(light, points, u1, u2)
    weight = jnp.where(found.pdf > 0, 1.0 / jnp.where(found.pdf > 0, found.pdf, 1.0), 0.0)
    return _finish(marching, nodes, direction, found, weight, points)


@partial(jax.jit, static_argnames=("num_steps", "num_phase", "directional"))
def _to_sky(
    marching, scene, cells, origin, direction, pixel, sample, seed, guide, *, num_steps, num_samples, num_phase, directional
) -> Connections:
    """Towards a directional light, or in directions drawn from the environment, a new one at each node."""
    nodes, u1, u2 = _sky_nodes(marching, cells, pixel, sample, seed, num_steps, num_samples, _SKY_SET)
    points = origin + nodes.t[..., None] * direction
    if directional:
        light = lights.sample_light(scene, points, u1, u2, u2)
        return _finish(marching, nodes, direction, light, 1.0, points)
    towards, pdf = lights.sample_environment(guide, u1, u2)
    towards_eye = _phase(marching, nodes.region, dot(towards, direction))
    weight = towards_eye * num_steps / (num_steps * pdf + num_phase * towards_eye)
    return _to_infinity(nodes, points, towards, lights.environment_radiance(scene.environment, towards) * weight[..., None])


def _to_infinity(nodes, points, towards, light):
    return Connections(points, towards, jnp.full(nodes.t.shape, jnp.inf, jnp.float32), nodes.weight * light)


@partial(jax.jit, static_argnames="num_steps")
def _from_field(marching, field, cells, origin, direction, sample, *, num_steps, num_samples):
    """Light from the environment, looked up at nodes by transmittance."""
    shift = patterns.step_shift(sample, num_samples)
    u = (jnp.arange(num_steps, dtype=jnp.float32)[:, None] + shift) / num_steps
    nodes = ray_cells.place(marching, cells, u)
    points = origin + nodes.t[..., None] * direction
    return jnp.sum(nodes.weight * sky_field.scattered_radiance(field, points), axis=0)


@partial(jax.jit, static_argnames=("num_steps", "num_phase"))
def _along_phase(
    marching, scene, cells, origin, direction, pixel, sample, seed, guide, *, num_steps, num_samples, num_phase
) -> Connections:
    """Towards the environment in directions drawn from the phase function (which is reciprocal)."""
    nodes, u1, u2 = _sky_nodes(marching, cells, pixel, sample, seed, num_phase, num_samples, _PHASE_SET)
    eye = jnp.broadcast_to(direction, (*nodes.t.shape, 3))
    towards, _ = phase.sample(marching.regions[0], eye, u1, u2)
    for r, medium in enumerate(marching.regions[1:], start=1):
        other, _ = phase.sample(medium, eye, u1, u2)
        towards = jnp.where((nodes.region == r)[..., None], other, towards)
    pdf = _phase(marching, nodes.region, dot(towards, eye))
    sky = lights.sample_environment_pdf(guide, towards)
    weight = jnp.where(pdf > 0, pdf * num_phase / (num_phase * pdf + num_steps * sky), 0.0)
    radiance = lights.environment_radiance(scene.environment, towards)
    return _to_infinity(nodes, origin + nodes.t[..., None] * direction, towards, radiance * weight[..., None])
