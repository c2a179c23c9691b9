"""The lattice stepped in time, as the paper does it (section III-C), to its steady state; kept as proof and for timing.

The state is what leaves each voxel, one array per direction with a ghost plane at both ends of x. A step runs over
planes of x inside one loop, so that its working set stays in the cache, and writes into a second set of arrays
(measured at 128^3: 10.5 ns per voxel for six directions, one padded shift per direction 21, a stacked array 94).

A steady source with stepping, x <- A x + b, and one impulse whose arrivals are added up give the same sums, and by
linearity the time of a deposit is irrelevant: `interleave` marches and diffuses in turn (the paper's ray history buffer of
k steps, Table I), which changes the schedule and never the result. `iterate_blocks` is its 4^3-block variant: `inner`
steps with frozen inflow between exchanges, the same fixed point.
"""

from collections.abc import Iterable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxvol.methods.lattice_boltzmann.lattice import Coefficients, Lattice, link_class, link_length, shift
from jaxvol.methods.lattice_boltzmann.sweeps import move_plane

Outgoing = tuple[Float[Array, "X+2 Y Z"], ...]


class Stepped(NamedTuple):
    """A state of the plain iteration."""

    outgoing: Outgoing
    phi: Float[Array, "X Y Z"]  # fluence * h^2 [W] of the scattered light
    num_steps: Int[Array, ""]
    change: Float[Array, ""]  # relative change at the probes over the last checking interval
    converged: Bool[Array, ""]


class _Tables(NamedTuple):
    passing: dict
    emit: dict  # w_i / l_i * gather_i
    collect: dict  # k gather_i / (1 - k Gamma)
    deposit: Float[Array, "X Y Z"]  # b / (1 - k Gamma)


def _tables(lattice: Lattice, coefficients: Coefficients, deposit) -> _Tables:
    full = lambda value: jnp.broadcast_to(value, deposit.shape)  # noqa: E731
    multiple = 1.0 / (1.0 - coefficients.scattering * coefficients.own)
    passing, emit, collect = {}, {}, {}
    for index, (cls, weight) in enumerate(lattice.class_weights):
        gather = coefficients.gather[index]
        derived = 2.0 / link_length(cls) * gather - 1.0
        passing[cls] = full(derived if coefficients.passing is None else coefficients.passing[index])
        emit[cls] = full(weight / link_length(cls) * gather)
        collect[cls] = full(coefficients.scattering * gather * multiple)
    return _Tables(passing, emit, collect, deposit * multiple)


def start(lattice: Lattice, shape: tuple[int, int, int]) -> Outgoing:
    """The dark state."""
    return tuple(jnp.zeros((shape[0] + 2, *shape[1:]), jnp.float32) for _ in lattice.directions)


def _step(lattice: Lattice, tables: _Tables, old: Outgoing, new: Outgoing) -> Outgoing:
    classes = [link_class(c) for c in lattice.directions]

    def plane(k, new):
        at = lambda array: lax.dynamic_index_in_dim(array, k, 0, keepdims=False)  # noqa: E731
        arrivals = []
        for g, (x, y, z) in zip(old, lattice.directions, strict=True):
            arrivals.append(move_plane(lax.dynamic_index_in_dim(g, k + 1 - x, 0, keepdims=False), y, z))
        sums = dict.fromkeys(lattice.classes, 0.0)
        for f, cls in zip(arrivals, classes, strict=True):
            sums[cls] = sums[cls] + f
        source = at(tables.deposit) + sum(at(tables.collect[cls]) * sums[cls] for cls in lattice.classes)
        leaving = [
            at(tables.passing[cls]) * f + at(tables.emit[cls]) * source for f, cls in zip(arrivals, classes, strict=True)
        ]
        return tuple(lax.dynamic_update_slice(n, g[None], (k + 1, 0, 0)) for n, g in zip(new, leaving, strict=True))

    return lax.fori_loop(0, tables.deposit.shape[0], plane, new)


def steps(
    lattice: Lattice, coefficients: Coefficients, deposit: Float[Array, "X Y Z"], outgoing: Outgoing, num_pairs: int
) -> Outgoing:
    """2 * num_pairs steps of f_i(r + c_i) <- passing f_i + w_i beta_i s from the state `outgoing` (eq. 4)."""
    tables = _tables(lattice, coefficients, deposit)

    def pair(_, states):
        first, second = states
        second = _step(lattice, tables, first, second)
        return _step(lattice, tables, second, first), second

    spare = tuple(jnp.zeros_like(g) for g in outgoing)
    return lax.fori_loop(0, num_pairs, pair, (outgoing, spare))[0]


def arrivals(lattice: Lattice, outgoing: Outgoing) -> tuple[Float[Array, "X Y Z"], ...]:
    """f_i(r) = g_i(r - c_i), zero from outside."""
    return tuple(shift(g[1:-1], c) for g, c in zip(outgoing, lattice.directions, strict=True))


def phi_of(
    lattice: Lattice, coefficients: Coefficients, deposit: Float[Array, "X Y Z"], outgoing: Outgoing
) -> Float[Array, "X Y Z"]:
    """phi = (sum_i gather_i f_i + Gamma b) / (1 - k Gamma) of a state."""
    gathered = coefficients.own * deposit
    for f, c in zip(arrivals(lattice, outgoing), lattice.directions, strict=True):
        gathered = gathered + coefficients.gather[lattice.classes.index(link_class(c))] * f
    return gathered / (1.0 - coefficients.scattering * coefficients.own)


def escaping(lattice: Lattice, outgoing: Outgoing) -> Float[Array, ""]:
    """Power that leaves the grid per step."""
    total = jnp.zeros(())
    for g, f in zip(outgoing, arrivals(lattice, outgoing), strict=True):
        total = total + (jnp.sum(g) - jnp.sum(f))
    return total


def iterate(
    lattice: Lattice,
    coefficients: Coefficients,
    deposit: Float[Array, "X Y Z"],
    *,
    threshold: float = 1e-4,
    max_steps: int = 5000,
    check_every: int = 10,
    probe_stride: int = 4,
    state: Outgoing | None = None,
) -> Stepped:
    """Step from `state` until the fluence at sparse probes changes by less than `threshold` between checks (the paper's stop).

    The stop is optimistic: a change of 1e-4 leaves an error of 1e-4 (albedo 0.5) to 4e-4 (0.999).
    """

    def probe(outgoing):
        middle = probe_stride // 2
        return phi_of(lattice, coefficients, deposit, outgoing)[
            middle::probe_stride, middle::probe_stride, middle::probe_stride
        ]

    def unfinished(carry):
        _, _, num_steps, change = carry
        return (change > threshold) & (num_steps < max_steps)

    def advance(carry):
        outgoing, before, num_steps, _ = carry
        outgoing = steps(lattice, coefficients, deposit, outgoing, check_every // 2)
        now = probe(outgoing)
        change = jnp.sqrt(jnp.sum((now - before) ** 2) / jnp.maximum(jnp.sum(now * now), 1e-30))
        return outgoing, now, num_steps + 2 * (check_every // 2), change

    dark = start(lattice, deposit.shape) if state is None else state
    carry = (dark, jnp.zeros_like(probe(dark)), jnp.zeros((), jnp.int32), jnp.full((), jnp.inf))
    outgoing, _, num_steps, change = lax.while_loop(unfinished, advance, carry)
    phi = phi_of(lattice, coefficients, deposit, outgoing)
    return Stepped(outgoing, phi, num_steps, change, change <= threshold)


def interleave(
    lattice: Lattice,
    coefficients: Coefficients,
    deposits: Iterable[Float[Array, "X Y Z"]],
    *,
    pairs_per_deposit: int = 1,
    threshold: float = 1e-4,
    max_steps: int = 5000,
) -> Stepped:
    """Table I's schedule: after each round of ray steps 2 * `pairs_per_deposit` steps of the lattice, then `iterate`.

    `deposits` are what the rays have left behind so far, from `marching.march_straight_by`; what was deposited goes on
    shining, as a steady source. Host loop over the rounds. The steps of the rounds are counted.
    """
    state, taken, deposit = None, 0, None
    for deposit in deposits:
        state = start(lattice, deposit.shape) if state is None else state
        state = _steps(lattice, coefficients, deposit, state, pairs_per_deposit)
        taken += 2 * pairs_per_deposit
    if state is None:
        raise ValueError("deposits must hold at least one round of marching")
    found = _iterate(lattice, coefficients, deposit, threshold=threshold, max_steps=max_steps, state=state)
    return found._replace(num_steps=found.num_steps + taken)


_steps = jax.jit(steps, static_argnums=(0, 4))
_iterate = jax.jit(iterate, static_argnums=0, static_argnames=("threshold", "max_steps"))


def iterate_blocks(
    lattice: Lattice,
    coefficients: Coefficients,
    deposit: Float[Array, "X Y Z"],
    *,
    num_exchanges: int,
    inner: int,
    block: int = 4,
) -> Stepped:
    """The paper's blocks: `inner` steps inside blocks of block^3 voxels with frozen inflow, then an exchange of interfaces."""
    tables = _tables(lattice, coefficients, deposit)
    classes = [link_class(c) for c in lattice.directions]
    entries = [_enters_block(deposit.shape, c, block) for c in lattice.directions]

    def one_step(f):
        sums = dict.fromkeys(lattice.classes, 0.0)
        for value, cls in zip(f, classes, strict=True):
            sums[cls] = sums[cls] + value
        source = tables.deposit + sum(tables.collect[cls] * sums[cls] for cls in lattice.classes)
        leaving = [tables.passing[cls] * v + tables.emit[cls] * source for v, cls in zip(f, classes, strict=True)]
        return [shift(g, c) for g, c in zip(leaving, lattice.directions, strict=True)]

    def inside(_, f):
        moved = one_step(f)
        return tuple(jnp.where(entry, old, new) for entry, old, new in zip(entries, f, moved, strict=True))

    def exchange(_, f):
        f = lax.fori_loop(0, inner, inside, f)
        return tuple(one_step(f))

    f = lax.fori_loop(0, num_exchanges, exchange, tuple(jnp.zeros_like(deposit) for _ in lattice.directions))
    gathered = coefficients.own * deposit
    for value, cls in zip(f, classes, strict=True):
        gathered = gathered + coefficients.gather[lattice.classes.index(cls)] * value
    phi = gathered / (1.0 - coefficients.scattering * coefficients.own)
    count = jnp.asarray(num_exchanges * (inner + 1), jnp.int32)
    return Stepped((), phi, count, jnp.full((), jnp.nan), jnp.asarray(False))


def _enters_block(shape, direction, block):
    """True where a link along `direction` arrives from another block (or from outside)."""
    entry = jnp.zeros(shape, bool)
    for axis, component in enumerate(direction):
        if component:
            index = jnp.arange(shape[axis]) % block
            first = index == (0 if component > 0 else block - 1)
            entry = entry | first.reshape([-1 if a == axis else 1 for a in range(3)])
    return entry
