"""Stage 3, one step of a surface path: to the next vertex, rays cast between jitted parts."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from jaxvol import ray_casting, sampling
from jaxvol.methods.impulse_response import surface_paths, walks
from jaxvol.methods.impulse_response.kit import Kit, Tally, occluded, thickness
from jaxvol.methods.impulse_response.light_sources import Light
from jaxvol.methods.impulse_response.receivers import Receiver

_MARCHED = sampling.stream("impulse_response.marched")


def step(kit: Kit, receiver: Receiver, position, item, sample, seed, depth: int, tally: Tally):
    """The next vertex: (what the receiver makes of a unit of its irradiance, unscattered and scattered, position, normal)."""
    normal, mesh = receiver.normal, kit.scene.mesh
    arguments = (item, sample, seed, jnp.int32(depth), kit.probe_sigma)
    proposal = surface_paths.propose(mesh, kit.faces, position, normal, *arguments, shares=kit.shares)
    t, face = ray_casting.intersect(kit.caster, proposal.origin, proposal.direction, proposal.t_max)
    t, face = jnp.asarray(t), jnp.asarray(face)
    arrival = surface_paths.arrive(mesh, kit.faces, position, normal, proposal, t, face)
    visible = plumb = np.ones(item.shape, bool)
    if kit.shares[0] < 1:  # otherwise the ray itself is the proof
        visible = ~occluded(kit, *arrival.between)
        plumb = ~occluded(kit, *arrival.plumb)
    tau = thickness(kit, position, arrival.direction, arrival.distance)
    chosen = response = None
    responses = None if depth == 1 and kit.tables_end else kit.responses
    if depth == 1 and kit.marches and not kit.walks_surfaces:
        light = Light(arrival.direction, arrival.distance, jnp.ones_like(position), arrival.normal)
        sight = visible | np.asarray(proposal.technique == 0)
        chosen = walks.by_marching(kit, position, normal, light, sight) & np.asarray(arrival.valid)
        draw = partial(marching_numbers, seed, item, sample, 7)
        once, more = walks.march(kit, receiver, position, "area", jnp.zeros_like(item), light, chosen, draw)
        response = once + more
        tally.count(segments=chosen.size, marched=int(chosen.sum()))
    if responses is not None:
        by_table = np.asarray(arrival.valid) & visible
        past, lookups = beyond(responses, tau, jnp.asarray(by_table))
        tally.count(beyond=past, lookups=lookups)
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


@jax.jit
def beyond(responses, tau, counted):
    """How many lookups lie past the tables' largest optical thickness, and how many there are."""
    grid = responses.point[0]
    limit = grid.multiple_max
    return jnp.sum(counted & jnp.any(tau > limit, axis=-1)), jnp.sum(counted)


@jax.jit
def marching_numbers(seed, item, sample, number, leg):
    """Four random numbers of one leg of one segment; `number` tells the kinds of emitters apart."""
    return sampling.uniforms(seed, _MARCHED, item, 8 * leg + number, sample)
