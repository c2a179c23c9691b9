"""Light that one surface reflects to the eye: the layer L S E at first hits.

Point, spot and directional lights are exact. Emissive faces and the environment are sampled by low-discrepancy sets
towards the light and, where a lobe is narrow or the sky is wide, along the BSDF; both are combined by the balance
heuristic (Veach and Guibas 1995).
"""

from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxvol import lights, materials, ray_casting
from jaxvol.direct import emitters, patterns
from jaxvol.direct.connections import DELTA, Connections, Context, LightRun, resolve
from jaxvol.sampling import dot
from jaxvol.types import Hits, Rays

_LIGHT_SET, _BSDF_SET = 1, 2


def surface_light(
    context: Context, rays: Rays, hits: Hits, through: Float[Array, "n 3"] | None, pixel, sample, seed
) -> Float[Array, "n 3"]:
    """Reflected radiance at the hits, times the transmittance `through` to the eye."""
    plan = context.plan
    total = jnp.zeros(rays.direction.shape, jnp.float32)
    for run in context.lights:
        num_light = num_light_samples(plan, run)
        num_bsdf = 0 if run.kind in DELTA else plan.num_bsdf_samples
        sizes = {"num_light": num_light, "num_bsdf": num_bsdf, "kind": run.kind}
        if num_light:
            towards = connect(run.scene, run.emitters, run.surface_guide, rays.direction, hits, pixel, sample, seed, **sizes)
            total = total + resolve(context, run, towards)
        if num_bsdf and run.kind == "environment":
            along = connect_along_bsdf(run.scene, run.surface_guide, rays.direction, hits, pixel, sample, seed, **sizes)
            total = total + resolve(context, run, along)
        elif num_bsdf:
            total = total + _area_along_bsdf(context, run, rays.direction, hits, pixel, sample, seed, sizes)
    return total if through is None else total * through


def num_light_samples(plan, run: LightRun) -> int:
    """Samples of one light at each first hit."""
    if run.kind in DELTA:
        return 1
    return plan.num_area_samples if run.kind == "area" else plan.num_environment_samples


def _common(scene, incoming, hits):
    surface = materials.surface_at(scene.mesh, hits.face)
    scale = ray_casting.scene_scale(scene.mesh)

    def offset(direction):
        return ray_casting.offset_origin(hits.position, hits.normal, direction, scale=scale)

    return surface, materials.facing_normal(hits.normal, incoming), offset


def _reflected(surface, incoming, hits, normal, direction):
    """BSDF times cosine, 0 off the surface."""
    cosine = jnp.maximum(dot(normal, direction), 0.0)
    value = materials.evaluate(surface, hits.normal, incoming, direction) * cosine[..., None]
    return jnp.where(hits.valid[..., None], value, 0.0)


@partial(jax.jit, static_argnames=("kind", "num_light", "num_bsdf"))
def connect(
    scene, faces, guide, incoming, hits, pixel, sample, seed, *, kind: str, num_light: int, num_bsdf: int
) -> Connections:
    """Connections from hits towards the scene's one light, the estimator's weights and BSDF multiplied in."""
    surface, normal, offset = _common(scene, incoming, hits)

    def one(k):
        index = (sample * num_light + k).astype(jnp.uint32)
        if faces is not None:
            light = emitters.sample(faces, hits.position, *patterns.shifted(seed, pixel, index, _LIGHT_SET, 2))
        elif kind == "environment":
            u1, u2 = patterns.shifted(seed, pixel, index, _LIGHT_SET, 2)
            light = _sample_sky(scene.environment, guide, u1, u2)
        else:
            light = lights.sample_light(scene, hits.position, *patterns.shifted(seed, pixel, index, _LIGHT_SET, 3))
        weight = 1.0 / (num_light * jnp.where(light.pdf > 0, light.pdf, 1.0))
        if num_bsdf:
            other = materials.sample_pdf(surface, hits.normal, incoming, light.direction)
            weight = weight / (1.0 + num_bsdf / num_light * other / jnp.where(light.pdf > 0, light.pdf, 1.0))
        weight = jnp.where(light.pdf > 0, weight, 0.0)
        value = _reflected(surface, incoming, hits, normal, light.direction) * light.radiance * weight[:, None]
        return (*_aim(offset(light.direction), light), value)

    return Connections(*_each(one, num_light))


def _each(one, number):
    """one(k) for k = 0 .. number - 1, stacked; one copy of its code (a copy for each k took seconds to compile)."""
    return jax.vmap(one)(jnp.arange(number, dtype=jnp.int32))


def _sample_sky(environment, guide, u1, u2):
    """A direction drawn by the guide's table, with the environment's radiance."""
    direction, pdf = lights.sample_environment(guide, u1, u2)
    radiance = lights.environment_radiance(environment, direction)
    infinite = jnp.full(pdf.shape, jnp.inf, jnp.float32)
    return lights.LightSample(direction, infinite, radiance, pdf, jnp.zeros(pdf.shape, bool), 1e30 * direction)


def _aim(origin, light):
    """Origin, direction and distance from the offset origin: on a large mesh the offset exceeds the shadow ray's margin."""
    delta = light.position - origin
    distance = jnp.sqrt(jnp.maximum(dot(delta, delta), 1e-30))
    finite = jnp.isfinite(light.distance)
    direction = jnp.where(finite[:, None], delta / distance[:, None], light.direction)
    return origin, direction, jnp.where(finite, distance, jnp.inf)


def _bsdf_directions(surface, incoming, hits, pixel, sample, seed, k, num_bsdf):
    index = (sample * num_bsdf + k).astype(jnp.uint32)
    u1, u2, u3 = patterns.shifted(seed, pixel, index, _BSDF_SET, 3)
    direction = materials.sample(surface, hits.normal, incoming, u1, u2, u3)
    return direction, materials.sample_pdf(surface, hits.normal, incoming, direction)


@partial(jax.jit, static_argnames=("kind", "num_light", "num_bsdf"))
def connect_along_bsdf(
    scene, guide, incoming, hits, pixel, sample, seed, *, kind: str, num_light: int, num_bsdf: int
) -> Connections:
    """Connections to the environment in directions sampled from the BSDF."""
    surface, normal, offset = _common(scene, incoming, hits)

    def one(k):
        direction, pdf = _bsdf_directions(surface, incoming, hits, pixel, sample, seed, k, num_bsdf)
        other = lights.sample_environment_pdf(guide, direction)
        weight = jnp.where(pdf > 0, 1.0 / (num_bsdf * pdf + num_light * other), 0.0)
        radiance = lights.environment_radiance(scene.environment, direction)
        value = _reflected(surface, incoming, hits, normal, direction) * radiance * weight[:, None]
        return offset(direction), direction, jnp.full(pdf.shape, jnp.inf, jnp.float32), value

    return Connections(*_each(one, num_bsdf))


@partial(jax.jit, static_argnames=("num_bsdf",))
def _casts_along_bsdf(scene, incoming, hits, pixel, sample, seed, *, num_bsdf):
    surface, _, offset = _common(scene, incoming, hits)

    def one(k):
        direction, pdf = _bsdf_directions(surface, incoming, hits, pixel, sample, seed, k, num_bsdf)
        return offset(direction), direction, pdf

    return _each(one, num_bsdf)


@partial(jax.jit, static_argnames=("num_light", "num_bsdf"))
def _weigh_emitters(scene, faces, incoming, hits, origin, direction, pdf, t, face, *, num_light, num_bsdf):
    surface, normal, _ = _common(scene, incoming, hits)
    seen = ray_casting.hits(scene.mesh, origin, direction, t, face)
    if faces is None:
        other = lights.sample_light_pdf(scene, origin, direction, face, t, seen.normal)
    else:
        other = emitters.sample_pdf(faces, origin, direction, face, t)
    weight = jnp.where((pdf > 0) & seen.valid, 1.0 / (num_bsdf * pdf + num_light * other), 0.0)
    radiance = lights.emitted_radiance(scene.mesh, face, seen.normal, direction)
    value = jax.vmap(lambda d: _reflected(surface, incoming, hits, normal, d))(direction)
    # The nearest hit is the emitter: the shadow test in `resolve` stops short of it.
    distance = jnp.where(seen.valid, t, 0.0)
    return Connections(origin, direction, distance, value * radiance * weight[..., None])


def _area_along_bsdf(context: Context, run: LightRun, incoming, hits, pixel, sample, seed, sizes) -> Float[Array, "n 3"]:
    """Emissive faces met in directions sampled from the BSDF."""
    num_light, num_bsdf = sizes["num_light"], sizes["num_bsdf"]
    origin, direction, pdf = _casts_along_bsdf(run.scene, incoming, hits, pixel, sample, seed, num_bsdf=num_bsdf)
    t, face = ray_casting.intersect(context.caster, origin, direction, jnp.where(hits.valid, jnp.inf, -1.0))
    counts = {"num_light": num_light, "num_bsdf": num_bsdf}
    return resolve(
        context, run, _weigh_emitters(run.scene, run.emitters, incoming, hits, origin, direction, pdf, t, face, **counts)
    )
