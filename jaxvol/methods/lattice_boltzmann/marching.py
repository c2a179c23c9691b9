"""Marching pass (section III-B): light rays through the voxels, leaving behind the fluence that the lattice scatters.

Straight media: from voxel face to voxel face, exact lengths, exact exponentials. Refractive media: Hamilton's equations
of the eikonal in voxel units, dx/dtau = p, dp/dtau = D = grad (n^2/2), by leapfrog (drift, kick, drift; ds = n dtau),
with the energy put back along the gradient so that |p| = n (planar Snell then holds at any step); "smooth" leaves the
energy alone, for gradients that stretch over many voxels; "euler" is the paper's eq. 2-3. Fig. 4 of the paper mixes two
forms (v += delta grad n / n), does not converge, and is not offered.

Deposited is the track, power times length in voxels: the fluence times h^2 [W] of light that comes from the lights. A
voxel scatters scattering * track and absorbs absorption * track, exactly what the ray loses, so that
scattered + absorbed + escaped = sent. Rays are re-packed every `_ROUND` steps, so that dead ones cost nothing.
"""

from collections.abc import Iterator
from functools import partial
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxvol.methods.lattice_boltzmann.lattice import mean_through
from jaxvol.methods.lattice_boltzmann.materials import Materials
from jaxvol.methods.lattice_boltzmann.occupancy import narrowed, to_voxels

Integrator = Literal["leapfrog", "smooth", "euler"]
_ROUND = 16  # steps between re-packings
_BATCH = 1 << 16  # rays at a time
_WEAKEST = 1e-4  # rays that carry less than this share of the start are ended, their rest counted as live


class Marched(NamedTuple):
    """What marching left behind, and its books (W): sent into the grid, still live at the end."""

    track: Float[Array, "C X Y Z"]
    sent: np.ndarray  # [C]
    live: np.ndarray  # [C]
    escaped: np.ndarray  # [C]
    num_steps: int  # ray steps that were computed
    flow: Float[Array, "3 X Y Z"] | None = None  # sum over rays of direction times track, mean of the channels; if asked


class _Straight(NamedTuple):
    voxel: tuple[Int[Array, "n"], Int[Array, "n"], Int[Array, "n"]]
    t_next: tuple[Float[Array, "n"], ...]
    t_step: tuple[Float[Array, "n"], ...]
    step: tuple[Int[Array, "n"], ...]
    t: Float[Array, "n"]
    t_end: Float[Array, "n"]
    power: tuple[Float[Array, "n"], ...]
    start: tuple[Float[Array, "n"], ...]


class _Bent(NamedTuple):
    position: Float[Array, "n 3"]  # voxel units, 0 at the lower faces
    momentum: Float[Array, "n 3"]  # n times the unit direction
    index: Float[Array, "n"]
    power: tuple[Float[Array, "n"], ...]
    start: tuple[Float[Array, "n"], ...]
    inside: Bool[Array, "n"]


def march_straight(
    materials: Materials,
    origin: np.ndarray,
    direction: np.ndarray,
    t_max: np.ndarray,
    power: np.ndarray,
    *,
    with_flow: bool = False,
    blocks: Bool[Array, "X Y Z"] | None = None,
) -> Marched:
    """Through the voxels on straight lines; `power` [n, C] at the origin (what lies outside the grid is vacuum).

    `blocks` (occupancy.py): rays are walked between the first and the last of them only, and leave no track elsewhere.
    """
    grid = materials.grid
    position, direction, t0, t1 = to_voxels(grid, origin, direction, t_max)
    enters = t1 > t0
    t0, t1 = narrowed(blocks, position, direction, t0, t1)
    live = np.flatnonzero(t1 > t0)
    channels = tuple(materials.scattering[c] + materials.absorption[c] for c in range(materials.scattering.shape[0]))
    flat = tuple(x.reshape(-1) for x in channels)
    track = _dark_track(flat, with_flow)
    books = _Books(power.shape[1])
    passing = power[enters & (t1 <= t0)].sum(0, dtype=np.float64)  # through empty blocks only
    books.sent, books.escaped = books.sent + passing, books.escaped + passing
    for first in range(0, len(live), _BATCH):
        chosen = live[first : first + _BATCH]
        rays = _enter(grid.shape, position[chosen], direction[chosen], t0[chosen], t1[chosen], power[chosen])
        books.sent += power[chosen].sum(0, dtype=np.float64)
        track = _run(lambda r, k: _straight_round(flat, grid.shape, _ROUND, r, k), rays, track, books)
    return books.result(track, grid.shape)


def _enter(shape, position, direction, t0, t1, power):
    """State of rays at their entry points."""
    at = position + direction * (t0 + 1e-5 * np.minimum(1.0, t1 - t0))[:, None]
    voxel = np.clip(np.floor(at), 0, np.array(shape) - 1)
    step = np.where(direction > 0, 1, -1)
    boundary = voxel + (step > 0)
    t_next = (boundary - position) / direction
    t_step = np.abs(1.0 / direction)
    columns = lambda a, kind: tuple(jnp.asarray(a[:, k], kind) for k in range(3))  # noqa: E731
    amounts = tuple(jnp.asarray(power[:, c], jnp.float32) for c in range(power.shape[1]))
    # distances count from the entry, so that float32 resolves them
    return _Straight(
        columns(voxel, jnp.int32), columns(t_next - t0[:, None], jnp.float32), columns(t_step, jnp.float32),
        columns(step, jnp.int32), jnp.zeros(len(t0), jnp.float32), jnp.asarray(t1 - t0, jnp.float32), amounts, amounts,
    )  # fmt: skip


def march_straight_by(
    materials: Materials, origin: np.ndarray, direction: np.ndarray, t_max: np.ndarray, power: np.ndarray, *, num_steps: int
) -> Iterator[tuple[int, Float[Array, "C X Y Z"]]]:
    """All rays at once, `num_steps` of their steps at a time (Table I's k): (rays still on their way, track so far)."""
    grid = materials.grid
    position, direction, t0, t1 = to_voxels(grid, origin, direction, t_max)
    live = t1 > t0
    flat = tuple((s + a).reshape(-1) for s, a in zip(materials.scattering, materials.absorption, strict=True))
    rays = _enter(grid.shape, position[live], direction[live], t0[live], t1[live], power[live])

    def advance(rays, track):
        return _straight_round(flat, grid.shape, num_steps, rays, track)

    for count, track in _rounds(advance, rays, _dark_track(flat, False), _Books(power.shape[1]), max_rounds=100_000):
        # a copy: the next round takes the arrays over
        yield count, jnp.stack(track).reshape((len(track), *grid.shape))


@partial(jax.jit, static_argnames=("shape", "num_steps"), donate_argnums=(4,))
def _straight_round(extinction, shape, num_steps, rays, track):
    def body(_, carry):
        rays, track = carry
        x, y, z = rays.voxel
        at = (x * shape[1] + y) * shape[2] + z
        nearest = jnp.minimum(jnp.minimum(rays.t_next[0], rays.t_next[1]), rays.t_next[2])
        stop = jnp.minimum(nearest, rays.t_end)
        length = jnp.maximum(stop - rays.t, 0.0)
        # 0 of padding
        heading = tuple(
            jnp.where(t > 0, s / jnp.where(t > 0, t, 1.0), 0.0) for s, t in zip(rays.step, rays.t_step, strict=True)
        )
        power, track = _absorb(extinction, track, rays.power, at, length, heading)
        crossed = nearest < rays.t_end
        moves = [(rays.t_next[a] <= nearest) & crossed for a in range(3)]
        voxel, t_next, outside = [], [], ~crossed
        for a in range(3):
            index = rays.voxel[a] + jnp.where(moves[a], rays.step[a], 0)
            outside = outside | (index < 0) | (index >= shape[a])
            voxel.append(jnp.clip(index, 0, shape[a] - 1))
            t_next.append(jnp.where(moves[a], rays.t_next[a] + rays.t_step[a], rays.t_next[a]))
        t = jnp.where(outside, rays.t_end, jnp.maximum(stop, rays.t))
        return rays._replace(voxel=tuple(voxel), t_next=tuple(t_next), t=t, power=power), track

    rays, track = lax.fori_loop(0, num_steps, body, (rays, track))
    return rays, track, rays.t < rays.t_end


def _dark_track(extinction, with_flow):
    """One field per channel, and three for the flow."""
    return tuple(jnp.zeros_like(extinction[0]) for _ in range(len(extinction) + (3 if with_flow else 0)))


def _absorb(extinction, track, power, at, length, heading):
    """One step of attenuation and deposit in every channel; exact for constant extinction. Fields left over: the flow."""
    new_power, new_track, total = [], [], 0.0
    for sigma, field, amount in zip(extinction, track, power, strict=False):
        thickness = sigma[at] * length
        deposited = amount * mean_through(thickness) * length
        new_track.append(field.at[at].add(deposited))
        new_power.append(amount + amount * jnp.expm1(-thickness))
        total = total + deposited * (1.0 / len(extinction))
    for field, component in zip(track[len(extinction) :], heading, strict=False):
        new_track.append(field.at[at].add(total * component))
    return tuple(new_power), tuple(new_track)


class _Books:
    """Sums over rays, kept on the host in float64."""

    def __init__(self, num_channels):
        self.sent, self.live, self.escaped = (np.zeros(num_channels) for _ in range(3))
        self.num_steps = 0

    def result(self, track, shape):
        fields = jnp.stack(track).reshape((len(track), *shape))
        num = len(self.sent)
        return Marched(
            fields[:num], self.sent, self.live, self.escaped, self.num_steps, fields[num:] if len(track) > num else None
        )


def _run(advance, rays, track, books):
    """Rounds of steps until no ray is left, packing the living ones between rounds."""
    for _, found in _rounds(advance, rays, track, books):  # noqa: B007
        pass
    return found


def _rounds(advance, rays, track, books, max_rounds=800):
    """(rays still on their way, track so far) after each round."""
    for _ in range(max_rounds):
        count = _bucket(len(rays.power[0]))
        rays = jax.tree.map(lambda x, n=count: _pad(x, n), rays)
        rays, track, moving = advance(rays, track)
        books.num_steps += count * _ROUND
        power = np.stack([np.asarray(p) for p in rays.power], 1)
        start = np.stack([np.asarray(p) for p in rays.start], 1)
        moving = np.asarray(moving)
        strong = (power > _WEAKEST * start).any(1)
        books.escaped += power[~moving].sum(0, dtype=np.float64)
        books.live += power[moving & ~strong].sum(0, dtype=np.float64)
        kept = np.flatnonzero(moving & strong)
        yield len(kept), track
        if len(kept) == 0:
            return
        rays = jax.tree.map(lambda x, k=kept: np.asarray(x)[k], rays)
    books.live += np.stack([np.asarray(p) for p in rays.power], 1).sum(0, dtype=np.float64)


def _bucket(count):
    """Few array sizes, so that rounds share compilations; a few small ones cost more to compile than their padding to march."""
    size = 1024
    while size < count:
        size *= 4 if size < 16384 else 2
    return size


def _pad(array, count):
    """Padding rays carry no power and have no way to go."""
    array = np.asarray(array)
    return jnp.asarray(np.concatenate([array, np.zeros((count - len(array), *array.shape[1:]), array.dtype)]))


def corner_table(*fields: Float[Array, "X Y Z"]) -> Float[Array, "voxels F"]:
    """Fields side by side, so that one row gather serves them all."""
    return jnp.stack([f.reshape(-1) for f in fields], axis=1)


def interpolate(
    table: Float[Array, "voxels F"], shape: tuple[int, int, int], position: Float[Array, "n 3"], *, beyond: float = 0.0
) -> Float[Array, "n F"]:
    """Trilinear lookup between voxel centres; position in voxel units.

    Outside the outer centres the field goes on linearly for `beyond` voxels, then it is held constant.
    """
    last = jnp.asarray(shape, jnp.float32) - 1.0
    at = jnp.clip(position - 0.5, -beyond, last + beyond)
    low = jnp.clip(at.astype(jnp.int32), 0, jnp.maximum(jnp.asarray(shape, jnp.int32) - 2, 0))
    high = jnp.minimum(low + 1, jnp.asarray(shape, jnp.int32) - 1)
    fx, fy, fz = ((at - low)[:, a, None] for a in range(3))

    def row(ix, iy):
        base = (ix * shape[1] + iy) * shape[2]
        return table[base + low[:, 2]] * (1.0 - fz) + table[base + high[:, 2]] * fz

    near = row(low[:, 0], low[:, 1]) * (1.0 - fy) + row(low[:, 0], high[:, 1]) * fy
    far = row(high[:, 0], low[:, 1]) * (1.0 - fy) + row(high[:, 0], high[:, 1]) * fy
    return near * (1.0 - fx) + far * fx


def leapfrog_step(
    lookup,
    position: Float[Array, "n 3"],
    momentum: Float[Array, "n 3"],
    index: Float[Array, "n"],
    step: float,
    *,
    project: bool = True,
) -> tuple[Float[Array, "n 3"], Float[Array, "n 3"], Float[Array, "n"], Float[Array, "n 3"]]:
    """Drift, kick, drift over the arc length `step`; returns position, momentum, index there, and the midpoint.

    `lookup(x)` gives [n, 4]: D = grad (n^2/2) and n. The step in tau uses the index of the previous midpoint, which saves
    a lookup. Momentum keeps its part across D; its part along D is set by the energy |p| = n, where that is possible (not
    when grazing); without a gradient p is rescaled. That makes planar steps exact at any step size; where the index varies
    smoothly on the scale of many steps plain leapfrog (`project=False`) is the better one (fish-eye at 0.05: 4e-5, 1e-3).
    """
    half = (0.5 * step / index)[:, None]
    middle = position + half * momentum
    found = lookup(middle)
    gradient, n = found[:, :3], found[:, 3]
    squared = jnp.sum(gradient * gradient, axis=1)
    if not project:
        momentum = momentum + 2.0 * half * gradient
        return middle + half * momentum, momentum, n, middle
    bends = squared > 1e-14
    unit = gradient * lax.rsqrt(jnp.where(bends, squared, 1.0))[:, None]
    # |p|^2 = n^2 at the end of the step, with n^2 extrapolated along D from the midpoint: then halfway through the kick
    # (p.e)^2 = n^2 + kick^2 - |p across e|^2
    along = jnp.sum(momentum * unit, axis=1)
    across = momentum - along[:, None] * unit
    kick = jnp.sqrt(squared) * half[:, 0]
    target = n * n + kick * kick - jnp.sum(across * across, axis=1)
    possible = bends & (target > 0)
    halfway = along + kick
    fixed = jnp.where(halfway < 0, -1.0, 1.0) * jnp.sqrt(jnp.where(possible, target, 1.0))
    projected = across + (fixed + kick)[:, None] * unit
    plain = momentum + 2.0 * half * gradient
    plain = jnp.where(bends[:, None], plain, momentum * (n * lax.rsqrt(jnp.sum(momentum * momentum, axis=1)))[:, None])
    momentum = jnp.where(possible[:, None], projected, plain)
    return middle + half * momentum, momentum, n, middle


def euler_step(lookup, position, momentum, index, step):
    """The paper's eq. 2-3, x += delta v / n and v += delta grad n, first order."""
    found = lookup(position)
    n = found[:, 3]
    middle = position + (0.5 * step / n)[:, None] * momentum
    moved = position + (step / n)[:, None] * momentum
    return moved, momentum + (step / n)[:, None] * found[:, :3], n, middle


STEPS = {"leapfrog": leapfrog_step, "smooth": partial(leapfrog_step, project=False), "euler": euler_step}


def enters(solid: Bool[Array, "X Y Z"], before: Float[Array, "n 3"], after: Float[Array, "n 3"]) -> Bool[Array, "n"]:
    """Whether a step ends in a solid voxel and did not begin in one (rays leave the surfaces on which they start)."""

    def at(position):
        voxel = jnp.clip(position.astype(jnp.int32), 0, jnp.asarray(solid.shape, jnp.int32) - 1)
        return solid[voxel[:, 0], voxel[:, 1], voxel[:, 2]]

    return at(after) & ~at(before)


def bent_table(materials: Materials) -> Float[Array, "voxels 4"]:
    """D and n for `interpolate`."""
    return corner_table(*materials.gradient, materials.ior)


def march_bent(
    materials: Materials,
    origin: np.ndarray,
    direction: np.ndarray,
    t_max: np.ndarray,
    power: np.ndarray,
    *,
    step: float = 0.5,
    integrator: Integrator = "leapfrog",
    seed: int = 0,
    with_flow: bool = False,
) -> Marched:
    """Along bent rays, `step` in voxels; the first step of each ray is shortened at random, so that deposits do not beat.

    Rays that an opaque surface cuts before they enter the grid are ended, and those that enter a voxel of `materials.solid`.
    """
    grid = materials.grid
    position, direction, t0, t1 = to_voxels(grid, origin, direction, t_max)
    live = np.flatnonzero(t1 > t0)
    jitter = np.random.default_rng(seed).random(len(t0)) * step
    channels = materials.scattering.shape[0]
    flat = tuple((materials.scattering[c] + materials.absorption[c]).reshape(-1) for c in range(channels))
    track = _dark_track(flat, with_flow)
    table, books = bent_table(materials), _Books(power.shape[1])
    solid = materials.solid
    for first in range(0, len(live), _BATCH):
        k = live[first : first + _BATCH]
        amounts = tuple(jnp.asarray(power[k, c], jnp.float32) for c in range(channels))
        start = position[k] + direction[k] * (t0[k] + 1e-4 + np.minimum(jitter[k], 0.5 * (t1 - t0)[k]))[:, None]
        ones = jnp.ones(len(k), jnp.float32)
        rays = _Bent(jnp.asarray(start, jnp.float32), jnp.asarray(direction[k], jnp.float32), ones, amounts, amounts, ones > 0)
        books.sent += power[k].sum(0, dtype=np.float64)
        track = _run(lambda r, tr: _bent_round(flat, table, grid.shape, step, integrator, solid, r, tr), rays, track, books)
    return books.result(track, grid.shape)


@partial(jax.jit, static_argnames=("shape", "integrator"), donate_argnums=(7,))
def _bent_round(extinction, table, shape, step, integrator, solid, rays, track):
    advance = STEPS[integrator]
    upper = jnp.asarray(shape, jnp.float32)

    def body(_, carry):
        rays, track = carry
        index = jnp.maximum(rays.index, 1.0)
        position, momentum, n, middle = advance(
            lambda x: interpolate(table, shape, x), rays.position, rays.momentum, index, step
        )
        voxel = jnp.clip(middle.astype(jnp.int32), 0, jnp.asarray(shape, jnp.int32) - 1)
        at = (voxel[:, 0] * shape[1] + voxel[:, 1]) * shape[2] + voxel[:, 2]
        size = lax.rsqrt(jnp.maximum(jnp.sum(momentum * momentum, axis=1), 1e-20))
        heading = tuple(jnp.where(rays.inside, momentum[:, a] * size, 0.0) for a in range(3))
        power, track = _absorb(extinction, track, rays.power, at, jnp.where(rays.inside, step, 0.0), heading)
        inside = rays.inside & jnp.all((position > 0) & (position < upper), axis=1)
        if solid is not None:
            inside = inside & ~enters(solid, rays.position, position)
        keep = rays.inside[:, None]
        return rays._replace(
            position=jnp.where(keep, position, rays.position),
            momentum=jnp.where(keep, momentum, rays.momentum),
            index=jnp.where(rays.inside, n, rays.index),
            power=power,
            inside=inside,
        ), track

    rays, track = lax.fori_loop(0, _ROUND, body, (rays, track))
    return rays, track, rays.inside
