"""Connections from points to one light at a time, and what is left of them after shadows and the medium.

A scene's lights are visited one by one: a `LightRun` is a scene with a single light and how often it is sampled.
"""

from dataclasses import dataclass
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxvol import extinction, materials, media, ray_casting, segments
from jaxvol.direct.emitters import Emitters, emitters
from jaxvol.direct.light_columns import LightColumns, light_columns
from jaxvol.direct.light_columns import optical_thickness as from_columns
from jaxvol.direct.sky_field import SkyField, sky_field
from jaxvol.direct.sky_sampling import cosine_weight, guided, phase_weight
from jaxvol.types import EnvironmentLight, Rays, Scene

_NEAR = 1.0 - 1e-4  # shadow rays stop short of a light that is itself a surface
_FIELDS = {
    "point": "point_lights",
    "spot": "spot_lights",
    "directional": "directional_lights",
    "area": "area_lights",
    "environment": "environment",
}
DELTA = ("point", "spot", "directional")


class Connections(eqx.Module):
    """K ways from each of n points towards a light. `value` is what arrives without shadows and medium."""

    origin: Float[Array, "K n 3"]
    direction: Float[Array, "K n 3"]  # unit, towards the light
    distance: Float[Array, "K n"]  # to the light, inf for infinite ones
    value: Float[Array, "K n 3"]


@dataclass(frozen=True)
class LightRun:
    """One light, alone in its scene (all emissive faces count as one)."""

    kind: str
    scene: Scene
    emitters: Emitters | None = None  # of the kind "area" when there are few faces
    guide: EnvironmentLight | None = None  # of the kind "environment": draws directions at points of the medium,
    surface_guide: EnvironmentLight | None = None  # on surfaces
    field: SkyField | None = None  # of the kind "environment" where the plan asks for it
    columns: LightColumns | None = None  # of the kind "directional" when the medium is one box with a grid


@dataclass(frozen=True)
class Context:
    """What the host loop keeps at hand: casters, tables, lights, the plan."""

    scene: Scene
    plan: Any
    caster: ray_casting.Caster
    medium_casters: tuple[ray_casting.Caster, ...]
    marching: extinction.MarchingMedium | None
    lights: tuple[LightRun, ...]


def light_runs(
    scene: Scene, marching: extinction.MarchingMedium | None, plan: Any, view: Rays, caster: ray_casting.Caster
) -> tuple[LightRun, ...]:
    """Every light of the scene by itself, with tables for the picture that `view` has a few rays of; eager."""
    gridded = marching is not None and segments.is_box(scene.medium) and scene.medium.density is not None
    runs = []
    bare = Scene(mesh=scene.mesh)
    for kind, field in _FIELDS.items():
        lights = getattr(scene, field)
        if lights is None:
            continue
        if kind in DELTA:
            count = jax.tree.leaves(lights)[0].shape[0]
            alone = [jax.tree.map(lambda x, i=i: x[i : i + 1], lights) for i in range(count)]
        else:
            alone = [lights]
        for light in alone:
            faces = emitters(scene) if kind == "area" else None
            columns = light_columns(marching, light.direction[0]) if kind == "directional" and gridded else None
            sky = {}
            if kind == "environment":
                sky = _sky_tables(scene, marching, plan, view, caster)
            runs.append(LightRun(kind, _with(bare, field, light), emitters=faces, columns=columns, **sky))
    return tuple(runs)


def _sky_tables(scene, marching, plan, view, caster):
    """Samplers of the environment for the directions and the surfaces that the picture shows, and the field."""
    sky, found = scene.environment, {}
    if plan.volume:
        found["guide"] = guided(sky, partial(phase_weight, marching.regions, view.direction))
    if plan.surface:
        t, face = ray_casting.intersect(caster, view.origin, view.direction, view.t_max)
        hits = ray_casting.hits(scene.mesh, view.origin, view.direction, t, face)
        normal = np.asarray(materials.facing_normal(hits.normal, view.direction))
        normal = np.where(np.asarray(hits.valid)[:, None], normal, 0.0)
        found["surface_guide"] = guided(sky, partial(cosine_weight, jnp.asarray(normal)))
    if plan.num_sky_directions:
        found["field"] = sky_field(
            scene,
            marching,
            found["guide"],
            np.asarray(view.origin)[0],
            num_directions=plan.num_sky_directions,
            caster=caster,
        )
    return found


def _with(scene, field, value):
    return eqx.tree_at(lambda s: getattr(s, field), scene, value, is_leaf=lambda x: x is None)


def context(
    scene: Scene,
    plan: Any,
    view: Rays,
    *,
    caster: ray_casting.Caster = None,
    marching: extinction.MarchingMedium | None = None,
) -> Context:
    """Casters and tables for a scene and a few rays of the picture; eager. What is already there may be given."""
    caster = ray_casting.caster_for(scene.mesh) if caster is None else caster
    if marching is None and scene.medium is not None:
        marching = extinction.marching_medium(scene.medium)
    return Context(
        scene=scene,
        plan=plan,
        caster=caster,
        medium_casters=segments.medium_casters(scene.medium),
        marching=marching,
        lights=light_runs(scene, marching, plan, view, caster),
    )


@jax.jit
def _sum(value):
    return jnp.sum(value, axis=0)


@jax.jit
def _attenuate_and_sum(value, lit, depth):
    seen = value if lit is None else jnp.where(lit[..., None], value, 0.0)
    return jnp.sum(seen * jnp.exp(-depth.reshape(value.shape)), axis=0)


@jax.jit
def _carries_light(value):
    return jnp.max(value, axis=-1) > 0


@jax.jit
def _mask_and_sum(value, lit):
    return jnp.sum(jnp.where(lit[..., None], value, 0.0), axis=0)


@jax.jit
def _attenuate_by_columns(value, lit, columns, medium, origin):
    return _attenuate_and_sum(value, lit, from_columns(columns, medium, origin))


def resolve(context: Context, run: LightRun, connections: Connections) -> Float[Array, "n 3"]:
    """What arrives over all K connections of each point: shadows cast, the medium's transmittance multiplied in."""
    value = connections.value
    lit = None
    if context.caster is not None:
        active = np.asarray(_carries_light(value))
        distance = np.asarray(connections.distance) * np.float32(_NEAR)
        blocked = ray_casting.occluded(
            context.caster, connections.origin, connections.direction, np.where(active, distance, np.float32(-1.0))
        )
        lit = active & ~np.asarray(blocked)
    if context.marching is None:
        return _sum(value) if lit is None else _mask_and_sum(value, lit)
    rays = [x.reshape(-1, *x.shape[2:]) for x in (connections.origin, connections.direction, connections.distance)]
    if run.columns is not None:
        return _attenuate_by_columns(value, lit, run.columns, context.marching.regions[0], rays[0])
    if segments.is_box(context.scene.medium) and context.scene.medium.density is None:
        return _attenuate_and_sum(value, lit, _depth(context, *rays))
    # Marching is dear: only connections that still carry light and meet the medium, padded to few different sizes.
    lit = np.asarray(_carries_light(value)) if lit is None else lit
    chosen = np.flatnonzero(lit.reshape(-1) & np.asarray(_meets_medium(context.marching, *rays)))
    result = np.where(lit[..., None], np.asarray(value), np.float32(0.0)).reshape(-1, 3)
    if chosen.size:
        padded = np.concatenate([chosen, np.full(bucket(chosen.size) - chosen.size, chosen[0])])
        depth = _depth(context, *(np.asarray(x)[padded] for x in rays))
        result[chosen] *= np.exp(-np.asarray(depth)[: chosen.size])
    return jnp.asarray(result.reshape(value.shape).sum(axis=0))


@jax.jit
def _meets_medium(marching, origin, direction, distance):
    """Whether a ray meets the box of any region before it ends."""
    met = jnp.zeros(distance.shape, bool)
    for medium in marching.regions:
        t0, t1 = media.box_interval(medium.bounds, origin, direction)
        met = met | (t0 < jnp.minimum(t1, distance))
    return met


def _depth(context, origin, direction, distance):
    return extinction.optical_thickness(
        context.scene.medium,
        origin,
        direction,
        distance,
        casters=context.medium_casters,
        num_steps=context.plan.num_light_steps,
        marching=context.marching,
    )


def bucket(count: int) -> int:
    """The next of the sizes 256, 320, 384, 448, 512, 640, ...: at most a quarter more, few compilations."""
    power = 256
    while power * 2 <= count:
        power *= 2
    step = power // 4
    return max(256, -(-count // step) * step)
