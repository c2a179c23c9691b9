"""Stage 3, gathering: light from every emitter at receivers, and along surface paths; rays are cast between jitted steps.

Segments that end at the receivers themselves and are cut by an occluder, or lie in a medium of much contrast, are integrated by
`marched` (random, counted in `marched`); with `occlusion = "drop"` the scattered light of occluded emitters is dropped and
counted (section 5.2, the paper's rule), as it is at all further vertices.
"""

from collections.abc import Callable
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from jaxvol import extinction, ray_casting, sampling
from jaxvol.methods.impulse_response import emitters, light_sources, marched, surface_paths
from jaxvol.methods.impulse_response.light_sources import DELTA, Light, delta_lights
from jaxvol.methods.impulse_response.lookup import Responses
from jaxvol.methods.impulse_response.receivers import Irradiance, Receiver, first_row, like
from jaxvol.types import Medium, Scene

_STREAM = sampling.stream("impulse_response.lights")
_PICK = sampling.stream("impulse_response.light_lookups")
_MARCHED = sampling.stream("impulse_response.marched")
# Segments of the receivers themselves and those marched; lookups and those past the tables' tau; all segments of live paths.
COUNTS = ("segments", "marched", "lookups", "beyond", "traced")


Draw = Callable[[int], tuple[Array, Array, Array, Array]]


class Kit(eqx.Module):
    """Everything that a bake prepares once."""

    scene: Scene
    responses: Responses | None  # None: light is attenuated only
    faces: surface_paths.Faces
    probe_sigma: Float[Array, ""]
    caster: ray_casting.Caster = eqx.field(static=True)
    marching: extinction.MarchingMedium | None = None
    medium_casters: tuple = eqx.field(static=True, default=())
    image: bool = eqx.field(static=True, default=True)
    num_steps: int = eqx.field(static=True, default=1)
    max_bounces: int = eqx.field(static=True, default=8)
    shares: tuple[float, float, float] = eqx.field(static=True, default=(1.0, 0.0, 0.0))
    march_occluded: bool = eqx.field(static=True, default=False)
    contrast: float | None = eqx.field(static=True, default=None)  # above it segments are marched; None = never
    march_all: bool = eqx.field(static=True, default=False)  # the medium's bounds are near everywhere
    legs: int = eqx.field(static=True, default=1)  # scatter points of a marched segment before the tables
    multiple: bool = eqx.field(static=True, default=True)
    open: bool = eqx.field(static=True, default=False)  # all faces in one plane: nothing occludes

    @property
    def tables_end(self) -> bool:
        """Whether the receivers' own segments are all marched: nothing of them is looked up."""
        return self.march_all and (self.march_occluded or self.open)

    @property
    def marches(self) -> bool:
        """Whether any segment may be marched."""
        return self.responses is not None and (self.march_occluded or self.march_all or self.contrast is not None)


class Tally(dict):
    """Counts of `COUNTS`, summed as they come; values stay on the device until read."""

    def count(self, **values: ArrayLike) -> None:
        """Add to some counts."""
        for name, value in values.items():
            self[name] = self.get(name, 0) + value


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


@jax.jit
def _beyond(responses, tau, counted):
    grid = responses.point[0]
    limit = grid.multiple_max
    return jnp.sum(counted & jnp.any(tau > limit, axis=-1)), jnp.sum(counted)


def thickness(kit: Kit, origin, direction, t_max) -> Float[Array, "n 3"] | None:
    """Optical thickness of ways, RGB; None without a medium."""
    medium: Medium | None = kit.scene.medium
    if medium is None:
        return None
    return extinction.optical_thickness(
        medium, origin, direction, t_max, casters=kit.medium_casters, num_steps=kit.num_steps, marching=kit.marching
    )


def _occluded(kit, origin, direction, length):
    if kit.open:
        return np.zeros(origin.shape[0], bool)
    return np.asarray(ray_casting.occluded(kit.caster, origin, direction, length))


def by_marching(kit: Kit, position, normal, light: Light, visible: np.ndarray) -> np.ndarray:
    """Which segments the tables do not fit: all in a bounded medium, occluded ones where asked for, those of much contrast."""
    if kit.march_all:
        return visible | kit.march_occluded
    chosen = np.zeros(visible.shape, bool)
    if kit.march_occluded:
        chosen |= ~visible
    if kit.contrast is not None:
        chosen |= np.asarray(marched.contrast(kit.marching, position, normal, light)) > kit.contrast
    return chosen


def march(kit: Kit, receiver: Receiver, position, kind: str, index, light: Light, chosen: np.ndarray, draw: Draw):
    """(once, more often) of the chosen segments by one random walk of `kit.legs` scatter points each, zeros elsewhere.

    `draw(i)` gives the i-th four random numbers of every segment.
    """
    rows = np.flatnonzero(chosen)
    count, num = rows.size, chosen.shape[0]
    if count == 0:
        zero = jnp.zeros(jax.eval_shape(receiver.straight, light.direction, light.strength).shape, jnp.float32)
        return zero, zero
    lanes = max(num // 8, 1) if count <= num // 8 else num  # two sizes, so two compilations
    rows = np.concatenate([rows, np.full(lanes - count, rows[0])])
    take = partial(jax.tree.map, lambda x: x[rows] if jnp.shape(x)[:1] == (num,) else x)
    part, position, index, seen = take((receiver, position, index, light))
    medium, steps = kit.marching.regions[0], kit.num_steps
    where = marched.place(kit.marching, position, part.normal, seen, take(draw(0)), num_steps=steps)
    start = surface_paths.lifted(position, part.normal, kit.faces.scale)
    reached = ~_occluded(kit, start, where.direction, where.distance)
    weight = marched.throughput(medium, where, jnp.asarray(reached))
    points, outward, once, more = position + where.distance[:, None] * where.direction, where.direction, None, 0.0
    for leg in range(1, kit.legs + 1):
        again = light_sources.see_again(kit.scene, position, kind, index, seen, points)
        lit = jnp.asarray(~_occluded(kit, *light_sources.shadow_ray(kit.faces.scale, points, None, again)))
        far = thickness(kit, points, again.direction, again.distance)
        radiance = weight * marched.scattered_once(medium, outward, again, lit, far)
        once, more = (radiance, more) if once is None else (once, more + radiance)
        if not kit.multiple:
            break
        if leg == kit.legs:
            around = marched.surroundings(medium, where, part.normal, points - position)
            arguments = (medium, kit.responses, outward, again, lit, far, part.normal, *around)
            more = more + weight * marched.scattered_more(*arguments, image=kit.image)
        else:
            outward, distance, factor = marched.onward(kit.marching, points, outward, again, take(draw(leg)), num_steps=steps)
            open_way = ~_occluded(kit, points, outward, distance)
            weight = weight * factor * jnp.asarray(open_way)[:, None]
            points = points + distance[:, None] * outward
    found = _to_receiver(part, where.direction, once, jnp.zeros_like(once) if not kit.multiple else more)
    return tuple(_scatter(value, rows[:count], num) for value in found)


@jax.jit
def _to_receiver(receiver, direction, once, more):
    return receiver.straight(direction, once), receiver.straight(direction, more)


def _scatter(value, rows, num):
    whole = np.zeros((num, *value.shape[1:]), np.float32)
    whole[rows] = np.asarray(value)[: rows.size]
    return jnp.asarray(whole)


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
    light = light_sources.see(kit.scene, position, kind, index, u)
    visible = ~_occluded(kit, *light_sources.shadow_ray(kit.faces.scale, position, receiver.normal, light))
    by_march = own and kit.marches
    chosen = by_marching(kit, position, receiver.normal, light, visible) if by_march else None
    direct = once = more = lost = None
    responses = None if own and kit.tables_end else kit.responses
    if smooth:
        tau = thickness(kit, position, light.direction, light.distance)
        direct, once, more = _arrivals(responses, receiver, light, jnp.asarray(visible), tau, pick, image=kit.image)
        if responses is not None:
            by_table = visible if chosen is None else visible & ~chosen
            dropped = ~visible if chosen is None else ~visible & ~chosen
            once, more, lost = _split(once, more, jnp.asarray(by_table), jnp.asarray(dropped))
            beyond, lookups = _beyond(responses, tau, jnp.asarray(by_table))
            tally.count(beyond=beyond, lookups=lookups)
        else:
            lost = jnp.zeros_like(direct)
        if own and kit.responses is not None:
            tally.count(segments=visible.size, marched=0 if chosen is None else int(chosen.sum()))
    if chosen is not None and draw is not None:
        found = march(kit, receiver, position, kind, index, light, chosen, draw)
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
    shape = jax.eval_shape(receiver.straight, receiver.normal, receiver.normal).shape
    total = [jnp.zeros(shape, jnp.float32)] * 4
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
    shape = jax.eval_shape(receiver.straight, receiver.normal, receiver.normal).shape
    total = [jnp.zeros(shape, jnp.float32)] * 4
    own = depth == 0
    counts = {kind: sum(k == kind for k, _ in delta_lights(kit.scene)) for kind in DELTA}
    kinds = [kind for kind, count in counts.items() if count and (not own or kit.marches)]
    kinds += ["area"] if kit.scene.area_lights is not None else []
    kinds += ["environment"] if kit.scene.environment is not None else []
    for number, kind in enumerate(kinds):
        count = counts.get(kind, 1)
        u, pick, index = _numbers(seed, item, sample, 8 * depth + number, count)
        draw = partial(_marching_numbers, seed, item, sample, number) if own and kit.marches else None
        smooth = not (own and kind in DELTA)
        found = light_from(kit, receiver, position, kind, index, u, own=own, tally=tally, draw=draw, pick=pick, smooth=smooth)
        total = _add(total, found, count)
    return tuple(total)


@jax.jit
def _add(total, found, count):
    return [a + count * b for a, b in zip(total, found, strict=True)]


@jax.jit
def _numbers(seed, item, sample, dimension, count):
    """Random numbers of one light choice, of its lookup, and the index chosen among `count`."""
    u = sampling.uniforms(seed, _STREAM, item, dimension, sample)
    pick = sampling.uniforms(seed, _PICK, item, dimension, sample)[:2]
    return u, pick, jnp.minimum((u[3] * count).astype(jnp.int32), count - 1)


@jax.jit
def _marching_numbers(seed, item, sample, number, leg):
    """Four random numbers of one leg of one segment; `number` tells the kinds of emitters apart."""
    return sampling.uniforms(seed, _MARCHED, item, 8 * leg + number, sample)


def _step(kit, receiver, position, item, sample, seed, depth, tally):
    """The next vertex: (what the receiver makes of a unit of its irradiance, unscattered and scattered, position, normal)."""
    normal, mesh = receiver.normal, kit.scene.mesh
    arguments = (item, sample, seed, jnp.int32(depth), kit.probe_sigma)
    proposal = surface_paths.propose(mesh, kit.faces, position, normal, *arguments, shares=kit.shares)
    t, face = ray_casting.intersect(kit.caster, proposal.origin, proposal.direction, proposal.t_max)
    t, face = jnp.asarray(t), jnp.asarray(face)
    arrival = surface_paths.arrive(mesh, kit.faces, position, normal, proposal, t, face, kit.probe_sigma)
    visible = plumb = np.ones(item.shape, bool)
    if kit.shares[0] < 1:  # otherwise the ray itself is the proof
        visible = ~_occluded(kit, *arrival.between)
        plumb = ~_occluded(kit, *arrival.plumb)
    tau = thickness(kit, position, arrival.direction, arrival.distance)
    chosen = response = None
    responses = None if depth == 1 and kit.tables_end else kit.responses
    if depth == 1 and kit.marches:
        light = Light(arrival.direction, arrival.distance, jnp.ones_like(position), arrival.normal)
        sight = visible | np.asarray(proposal.technique == 0)
        chosen = by_marching(kit, position, normal, light, sight) & np.asarray(arrival.valid)
        draw = partial(_marching_numbers, seed, item, sample, 7)
        once, more = march(kit, receiver, position, "area", jnp.zeros_like(item), light, chosen, draw)
        response = once + more
        tally.count(segments=chosen.size, marched=int(chosen.sum()))
    if responses is not None:
        by_table = np.asarray(arrival.valid) & visible
        beyond, lookups = _beyond(responses, tau, jnp.asarray(by_table))
        tally.count(beyond=beyond, lookups=lookups)
    plain, scattered = surface_paths.transport(
        mesh,
        kit.faces,
        responses,
        receiver,
        proposal,
        arrival,
        jnp.asarray(visible),
        jnp.asarray(plumb),
        tau,
        kit.probe_sigma,
        None if chosen is None else jnp.asarray(chosen),
        response,
        shares=kit.shares,
        image=kit.image,
    )
    return plain, scattered, arrival.position, arrival.normal


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
    kinds += len({kind for kind, _ in delta_lights(kit.scene)})
    first_step = rest = None
    for depth in range(1, kit.max_bounces + 1):
        *step, position, normal = _step(kit, receiver, position, item, sample, seed, depth, tally)
        if depth == 1:
            first_step, rest = step, jnp.ones_like(position)
        else:
            rest = rest * (step[0] + step[1])
        if depth > 2:
            rest = _survive(first_step, rest, item, sample, seed, jnp.int32(depth))
        receiver = Irradiance(normal)
        found = sampled_arrivals(kit, receiver, position, item, sample, seed, depth, tally=tally)
        first, several = _collect(first_step, rest, found, split=depth == 1)
        if depth == 1:
            layers["surface_from_surface"] = first
        layers["surface_from_multiple"] = layers["surface_from_multiple"] + several
        alive = int(_count_alive(first_step, rest))
        tally.count(traced=(1 + kinds) * alive)
        if alive == 0:
            break
    return layers


@jax.jit
def _count_alive(first_step, rest):
    return jnp.sum(jnp.any((rest != 0) & (first_row(first_step[0] + first_step[1]) != 0), axis=-1))


@partial(jax.jit, static_argnames="split")
def _collect(first_step, rest, found, *, split: bool):
    """Light of one vertex at the receiver: (unscattered from one surface where `split`, else None; the rest)."""
    plain, scattered = first_step
    direct, more = rest * found[0], rest * (found[1] + found[2])
    if not split:
        return None, (plain + scattered) * like(direct + more, plain)
    return plain * like(direct, plain), scattered * like(direct + more, plain) + plain * like(more, plain)


@jax.jit
def _survive(first_step, rest, item, sample, seed, depth):
    """Russian roulette from the third vertex on; paths that lost end with weight 0."""
    u = sampling.uniforms(seed, _STREAM, item, 1000 + depth, sample)[0]
    chance = jnp.clip(jnp.max(jnp.abs(first_row(first_step[0] + first_step[1]) * rest), axis=-1), 0.1, 1.0)
    return rest * jnp.where(u < chance, 1 / chance, 0.0)[:, None]
