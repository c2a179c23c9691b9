"""Stage 3, gathering: light from every emitter at receivers, and along surface paths; rays are cast between jitted steps.

Segments that end at the receivers themselves and are cut by an occluder, or lie in a medium of much contrast, are integrated by
`walks` (random, counted in `marched`); with `occlusion = "drop"` the scattered light of occluded emitters is dropped and
counted (section 5.2, the paper's rule), as it is at all further vertices.
"""

from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike

from jaxvol import sampling, slopes
from jaxvol.methods.impulse_response import emitters, final_gather, light_sources, steps, walks
from jaxvol.methods.impulse_response.kit import Kit, Tally, occluded, thickness
from jaxvol.methods.impulse_response.light_sources import DELTA, delta_lights
from jaxvol.methods.impulse_response.receivers import Irradiance, Receiver, first_row, like, nothing
from jaxvol.methods.impulse_response.walks import Draw

_STREAM = sampling.stream("impulse_response.lights")
_PICK = sampling.stream("impulse_response.light_lookups")


@partial(jax.jit, static_argnames="image")
def _arrivals(responses, receiver, light, visible, tau, pick, *, image):
    """What a receiver makes of one emitter's light: attenuated; and scattered once and more often, visible or not."""
    strength = jnp.where(visible[:, None], light.strength, 0.0)
    if not light.infinite:
        strength = strength / (light.distance * light.distance)[:, None]
    if light.normal is not None:
        strength = strength * jnp.maximum(-sampling.dot(light.normal, light.direction), 0.0)[:, None]
    if tau is not None:
        strength = strength * jnp.exp(-tau)
    direct = receiver.straight(light.direction, strength)
    if responses is None:
        return direct, jnp.zeros_like(direct), jnp.zeros_like(direct)
    if light.normal is not None:
        once, more = emitters.patch_arrivals(
            responses, receiver, light.direction, light.distance, light.normal, tau, image=image, pick=pick
        )
    elif light.infinite:
        once, more = emitters.directional_arrivals(responses, receiver, light.direction, tau, image=image, pick=pick)
    else:
        once, more = emitters.point_arrivals(responses, receiver, light.direction, light.distance, tau, image=image, pick=pick)
    weight = like(light.strength, once)
    return direct, once * weight, more * weight


def light_from(
    kit: Kit,
    receiver: Receiver,
    position,
    kind: str,
    index,
    u,
    *,
    own: bool,
    tally: Tally,
    draw: Draw | None = None,
    pick=None,
    smooth: bool = True,
) -> tuple[Array, Array, Array, Array]:
    """Light of one emitter of a kind at each receiver: attenuated, once, more often, once but occluded and dropped.

    `pick` chooses single nodes of the tables. `own`: the receivers are those of the bake, whose segments may be marched: by
    the random numbers `draw`, or left out where None. `smooth` False leaves out what `draw` None gives: the two add up.
    """
    light = light_sources.see(kit.scene, position, receiver.normal, kind, index, u, scatters=kit.responses is not None)
    visible = ~occluded(kit, *light_sources.shadow_ray(kit.faces.scale, position, receiver.normal, light))
    by_march = own and kit.marches
    chosen = walks.by_marching(kit, position, receiver.normal, light, visible) if by_march else None
    direct = once = more = lost = None
    responses = None if own and kit.tables_end else kit.responses
    if smooth:
        tau = thickness(kit, position, light.direction, light.distance)
        direct, once, more = _arrivals(responses, receiver, light, jnp.asarray(visible), tau, pick, image=kit.image)
        if responses is not None:
            by_table = visible if chosen is None else visible & ~chosen
            dropped = ~visible if chosen is None else ~visible & ~chosen
            once, more, lost = _split(once, more, jnp.asarray(by_table), jnp.asarray(dropped))
            beyond, lookups = steps.beyond(responses, tau, jnp.asarray(by_table))
            tally.count(beyond=beyond, lookups=lookups)
        else:
            lost = jnp.zeros_like(direct)
        if own and kit.responses is not None:
            tally.count(segments=visible.size, marched=0 if chosen is None else int(chosen.sum()))
    if chosen is not None and draw is not None:
        found = walks.march(kit, receiver, position, kind, index, light, chosen, draw)
        if not smooth:
            return jnp.zeros_like(found[0]), *found, jnp.zeros_like(found[0])
        once, more = once + found[0], more + found[1]
    return direct, once, more, lost


@jax.jit
def _split(once, more, by_table, dropped):
    shape = by_table.shape + (1,) * (once.ndim - 1)
    by_table, dropped = by_table.reshape(shape), dropped.reshape(shape)
    return jnp.where(by_table, once, 0.0), jnp.where(by_table, more, 0.0), jnp.where(dropped, once, 0.0)


def delta_arrivals(kit: Kit, receiver: Receiver, position: ArrayLike, tally: Tally) -> tuple[Array, Array, Array, Array]:
    """Light of all point, spot and directional lights at the receivers, but for marched segments: no noise. As `light_from`."""
    total = [nothing(receiver)] * 4
    unused = (jnp.zeros(position.shape[0], jnp.float32),) * 4
    for kind, i in delta_lights(kit.scene):
        index = jnp.full(position.shape[0], i, jnp.int32)
        found = light_from(kit, receiver, position, kind, index, unused, own=True, tally=tally)
        total = [a + b for a, b in zip(total, found, strict=True)]
    return tuple(total)


def sampled_arrivals(kit: Kit, receiver: Receiver, position, item, sample, seed, depth: int, *, tally: Tally):
    """One random emitter of each kind at each receiver, as `light_from`, summed.

    At depth 0 delta lights send what is marched only: `delta_arrivals` has the rest.
    """
    total = [nothing(receiver)] * 4
    own = depth == 0
    delta = {kind for kind, _ in delta_lights(kit.scene)}
    kinds = [kind for kind in DELTA if kind in delta and (not own or kit.marches)]
    kinds += ["area"] if kit.scene.area_lights is not None else []
    kinds += ["environment"] if kit.scene.environment is not None else []
    for number, kind in enumerate(kinds):
        u, pick = _numbers(seed, item, sample, 8 * depth + number)
        index, weight = jnp.zeros_like(item), jnp.ones(item.shape, jnp.float32)
        if kind in delta:  # scattered light of own segments falls off as 1/d, light of further vertices as 1/d^2
            index, weight = light_sources.choose(kit.scene, position, kind, u[3], falloff=1 if own else 2)
        draw = partial(steps.marching_numbers, seed, item, sample, number) if own and kit.marches else None
        smooth = not (own and kind in DELTA)
        found = light_from(kit, receiver, position, kind, index, u, own=own, tally=tally, draw=draw, pick=pick, smooth=smooth)
        total = _add(total, found, weight)
    return tuple(total)


@jax.jit
def _add(total, found, weight):
    return [a + weight.reshape(weight.shape + (1,) * (b.ndim - 1)) * b for a, b in zip(total, found, strict=True)]


@jax.jit
def _numbers(seed, item, sample, dimension):
    """Random numbers of one light choice and of its lookup."""
    u = sampling.uniforms(seed, _STREAM, item, dimension, sample)
    return u, sampling.uniforms(seed, _PICK, item, dimension, sample)[:2]


def path_arrivals(kit: Kit, receiver: Receiver, position, item, sample, seed, tally: Tally) -> dict[str, Array]:
    """One path from each receiver: what it makes of light, by layer, without `delta_arrivals`.

    Keys as the layers of the light that the receiver reflects, and `occluded`, the scattered light that was dropped.
    """
    direct, once, more, lost = sampled_arrivals(kit, receiver, position, item, sample, seed, 0, tally=tally)
    layers = {
        "surface_from_light": direct,
        "surface_from_surface": jnp.zeros_like(direct),
        "surface_from_volume": once,
        "surface_from_multiple": more,
        "occluded": lost,
    }
    kinds = (kit.scene.area_lights is not None) + (kit.scene.environment is not None)
    tally.count(traced=kinds * item.size)
    if kit.max_bounces > 0:
        bounced = final_gather.bounced if kit.cache is not None else _walked
        first, several = bounced(kit, receiver, position, item, sample, seed, tally)
        layers["surface_from_surface"] = first
        layers["surface_from_multiple"] = layers["surface_from_multiple"] + several
    return layers


def _walked(kit: Kit, receiver: Receiver, position, item, sample, seed, tally: Tally) -> tuple[Array, Array]:
    """Light of further surfaces by walking on: (unscattered from one surface, the rest)."""
    kinds = (kit.scene.area_lights is not None) + (kit.scene.environment is not None)
    kinds += len({kind for kind, _ in delta_lights(kit.scene)})
    first_step = rest = only = more = None
    for depth in range(1, kit.max_bounces + 1):
        *moved, position, normal = steps.step(kit, receiver, position, item, sample, seed, depth, tally)
        if depth == 1:
            first_step, rest = moved, jnp.ones_like(position)
        else:
            rest = rest * (moved[0] + moved[1])
        if depth > 2:
            rest = _survive(first_step, rest, item, sample, seed, jnp.int32(depth))
        receiver = Irradiance(normal)
        found = sampled_arrivals(kit, receiver, position, item, sample, seed, depth, tally=tally)
        first, several = final_gather.collect(first_step, rest, found[0], found[1] + found[2], split=depth == 1)
        only, more = (first, several) if depth == 1 else (only, more + several)
        alive = int(_count_alive(first_step, rest))
        tally.count(traced=(1 + kinds) * alive)
        if alive == 0:
            break
    return only, more


@jax.jit
def _count_alive(first_step, rest):
    return jnp.sum(jnp.any((rest != 0) & (first_row(first_step[0] + first_step[1]) != 0), axis=-1))


@jax.jit
def _survive(first_step, rest, item, sample, seed, depth):
    """Russian roulette from the third vertex on; paths that lost end with weight 0."""
    u = sampling.uniforms(seed, _STREAM, item, 1000 + depth, sample)[0]
    chance = jnp.clip(slopes.largest(jnp.abs(first_row(first_step[0] + first_step[1]) * rest)), 0.1, 1.0)
    return rest * jnp.where(u < chance, 1 / chance, 0.0)[:, None]
