"""From lights to fluence per voxel: voxelise, march, solve the lattice, keep the layers apart."""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float

from jaxvol import slopes
from jaxvol.methods.lattice_boltzmann import anisotropy, fine_sweeps, fresnel, light_rays, marching, occupancy, preconditioner
from jaxvol.methods.lattice_boltzmann import materials as material_pass
from jaxvol.methods.lattice_boltzmann.lattice import coefficients, lattice, mean_through, shift
from jaxvol.methods.lattice_boltzmann.materials import Materials
from jaxvol.methods.lattice_boltzmann.planning import Plan
from jaxvol.methods.lattice_boltzmann.refraction import body_entry
from jaxvol.methods.lattice_boltzmann.solver import solve
from jaxvol.methods.lattice_boltzmann.sweeps import transport
from jaxvol.types import Scene

_EARLY = 0.1  # relative residual of the lattice before its last correction, whose defect holds what is left


class Unscattered(NamedTuple):
    """Marched light that was scattered not even forwards, for the exact first order (view.py)."""

    track: Float[Array, "C X Y Z"]
    direction: Float[Array, "3 X Y Z"]  # mean of the directions, shorter than 1 where they differ


class Illumination(NamedTuple):
    """Fluence times h^2 [W] per voxel and channel of light that arrives straight from lights, from surfaces, scattered."""

    materials: Materials
    spectrum: np.ndarray  # [3], colour of the one channel; ones with three
    from_light: Float[Array, "C X Y Z"]
    from_surface: Float[Array, "C X Y Z"] | None
    from_volume: Float[Array, "C X Y Z"]  # scattered once, straight from the lights before
    scattered: Float[Array, "C X Y Z"]  # scattered at all, in the medium
    blocks: Bool[Array, "BX BY BZ"] | None  # filled ones (occupancy.py); None where all are walked
    unit: float  # W: a power of two near what the lights send; numbers over it neither overflow nor vanish when squared
    diagnostics: dict[str, Array]
    unscattered: Unscattered | None = None  # of from_light; None when scattering is isotropic
    surface_unscattered: Unscattered | None = None  # of from_surface
    flux: Float[Array, "C 3 X Y Z"] | None = None  # of scattered, times 3 lambda_1: what the first moment adds to emission


def illuminate(scene: Scene, plan: Plan, *, seed: int = 0, on_stage=None) -> Illumination:
    """Everything that does not depend on the camera. Diagnostics: books of the marching, applications, residual, converged."""
    report = (lambda name: None) if on_stage is None else on_stage
    grid = material_pass.make_grid(scene.medium, resolution=plan.resolution, margin=plan.margin)
    materials = material_pass.build(
        scene.medium, grid, num_channels=plan.num_channels, filter_width=plan.filter_width, degree=plan.degree
    )
    if plan.walls:
        materials = material_pass.with_surfaces(materials, scene.mesh, num_channels=plan.num_channels)
    blocks = None if plan.refract else occupancy.filled_blocks(materials)
    report("voxelize")
    low = np.asarray(grid.lower, float)
    high = low + float(grid.voxel) * np.array(grid.shape)
    rays = light_rays.from_lights(scene, low, high, float(grid.voxel), rays_per_voxel=plan.rays_per_voxel, seed=seed)
    if plan.refract:
        rays = enter_body(scene, rays)
    bounced = None
    if plan.num_surface_rays:
        bounced = light_rays.reflected(scene, low, high, count=plan.num_surface_rays, seed=seed)
        if plan.refract:
            bounced = enter_body(scene, bounced)
    unit = _unit(rays.power if bounced is None else np.concatenate([rays.power, bounced.power]))
    power, spectrum = _channels(rays.power / unit, plan.num_channels)
    marched = march(materials, plan, rays, power, seed, blocks)
    track, books = marched.track, [marched]
    from_surface = None
    if bounced is not None:
        power = bounced.power / unit
        power = power if plan.num_channels == 3 else (power @ spectrum / (spectrum @ spectrum))[:, None]
        second = march(materials, plan, bounced, power, seed, blocks)
        from_surface = second.track
        books.append(second)
    report("march")
    whole = track if from_surface is None else track + from_surface
    deposit = materials.scattering * whole
    first = materials.scattering * track
    wall, reflectances = _walls(materials, plan)
    flux, directional = None, plan.degree > 0
    if plan.solve and directional:
        flow = sum(b.flow for b in books)
        results = [_directional(materials, c, whole, flow, plan) for c in range(plan.num_channels)]
        scattered, flux, applications, residual, converged = _stacked(results)
        from_volume = jnp.zeros_like(scattered)  # orders are not split
    elif plan.solve:
        sigmas = [(materials.scattering[c], materials.absorption[c]) for c in range(plan.num_channels)]
        if plan.homogeneous:
            sigmas = [(s[0, 0, 0], a[0, 0, 0]) for s, a in sigmas]
        results = [_channel(*sigmas[c], deposit[c], first[c], wall, reflectances[c], plan) for c in range(plan.num_channels)]
        from_volume, scattered, applications, residual, converged = _stacked(results)
        if materials.solid is not None:  # what walls gather is no fluence; near them the medium's is held
            from_volume, scattered = (jax.vmap(_fill, (0, None))(x, materials.solid) for x in (from_volume, scattered))
    else:
        from_volume = scattered = jnp.zeros_like(track)
        applications, residual, converged = jnp.zeros(1, jnp.int32), jnp.zeros(1), jnp.ones(1, bool)
    jax.block_until_ready(scattered)
    report("solve")
    diagnostics = {
        "num_applications": applications,
        "residual": residual,
        "converged": jnp.all(converged),
        "sent": jnp.asarray(unit * sum(b.sent for b in books), jnp.float32),
        "escaped_unscattered": jnp.asarray(unit * sum(b.escaped for b in books), jnp.float32),
        "live": jnp.asarray(unit * sum(b.live for b in books), jnp.float32),
        "num_ray_steps": jnp.asarray(sum(b.num_steps for b in books), jnp.float32),
    }
    track, from_surface, from_volume, scattered, flux = (
        None if x is None else unit * x for x in (track, from_surface, from_volume, scattered, flux)
    )
    forward = [None if b.unscattered is None else b.unscattered._replace(track=unit * b.unscattered.track) for b in books]
    return Illumination(
        materials, spectrum, track, from_surface, from_volume, scattered, blocks, unit, diagnostics, *forward,
        *[None] * (2 - len(books)), flux,
    )  # fmt: skip


def _unit(power):
    """A power of two about the sum of all rays; 1 in the dark."""
    total = float(power.max(axis=1, initial=0.0).sum(dtype=np.float64))
    return 2.0 ** round(np.log2(total)) if total > 0 else 1.0


def _walls(materials, plan):
    """(voxels that reflect diffusely or None, reflectance per channel): the body's surface, and opaque meshes."""
    num = plan.num_channels
    wall, reflectances = None, [plan.internal_reflectance] * num
    if plan.internal_reflectance > 0:
        filled = materials.body
        wall = ~(jnp.any(materials.scattering + materials.absorption > 0, axis=0) if filled is None else filled)
    if materials.solid is not None:
        reflectances = [jnp.where(materials.solid, materials.solid_albedo[c], reflectances[c]) for c in range(num)]
        wall = materials.solid if wall is None else wall | materials.solid
    return wall, reflectances


@jax.jit
def _stacked(results):
    """The channels' results, each a tuple, as a tuple of stacks."""
    return tuple(jnp.stack(x) for x in zip(*results, strict=True))


@jax.jit
def _fill(field, solid):
    """The mean over the neighbours that are not solid, in solid voxels; 0 where there are none."""
    weight = jnp.where(solid, 0.0, 1.0)
    total, count = jnp.zeros_like(field), jnp.zeros_like(field)
    for c in lattice("26").directions:
        total, count = total + shift(weight * field, c), count + shift(weight, c)
    return jnp.where(solid, total / jnp.maximum(count, 1.0), field)


def _directional(materials, channel, whole, flow, plan):
    """(fluence, flux times 3 lambda_1, applications, residual, converged) with a Theta that depends on direction."""
    scattering, absorption, g = materials.scattering[channel], materials.absorption[channel], materials.asymmetry
    sources, strength = first_sources(scattering, whole, flow, g, channel, plan=plan)
    if not plan.corrections:
        found = solve_directional(scattering, absorption, g, sources, plan.tolerance, plan=plan)
    else:

        def arrive(moments):
            emitted = strength * moments + sources
            return fine_moments(scattering + absorption, emitted, degree=plan.degree, kind=plan.probability_map)

        def answer(defect, tolerance):
            found = solve_directional(scattering, absorption, g, strength * defect, tolerance, plan=plan)
            return found.moments, found

        moments, applications, residual, converged = _corrected(
            arrive(jnp.zeros_like(sources)), arrive, answer, scattering, plan
        )
        found = anisotropy.Moments(moments, applications, residual, converged)
    fluence, flux = _fluence_and_flux(found.moments, g, degree=plan.degree)
    return fluence, flux, found.num_applications, found.residual, found.converged


@partial(jax.jit, static_argnames="degree")
def _fluence_and_flux(moments, g, *, degree):
    """(fluence, flux times 3 lambda_1) of moments, which carry sqrt(3)."""
    return jnp.maximum(moments[0], 0.0), 3.0**0.5 * anisotropy.eigenvalues(g, degree)[1] * moments[1:4]


def _corrected(defect, arrive, answer, scattering, plan):
    """(light, applications, residual, converged) of light = arrive(light); the lattice answers defects, the first is arrive(0).

    `arrive` is transport along many directions. The lattice lets less light pass between thick voxels and answers too
    much: each answer is taken as many times as leaves the smallest defect of what is scattered, the last as often as that
    before it.
    """
    light, applications, share = jnp.zeros_like(defect), jnp.zeros((), jnp.int32), 1.0
    for turn in range(1 + plan.corrections):
        if turn:
            light, defect, share = _measured(light, defect, arrive(light), step, scattering)
        last = turn == plan.corrections
        relative, tolerance = _wanted(defect, light, plan.tolerance, last=last)
        found, solution = answer(defect, tolerance)
        light, step = _corrected_once(light, defect, found, share if last else np.float32(1.0))
        applications = applications + solution.num_applications
    return light, applications, relative * solution.residual, solution.converged


@jax.jit
def _measured(light, before, arriving, step, scattering):
    """(light, defect, share): with the share of the last `step` that leaves the smallest defect of what is scattered."""
    image = before - (arriving - light)  # what one `step` takes off
    share = _ratio(jnp.sum(scattering * before * image), jnp.sum(scattering * image * image))
    share = lax.stop_gradient(share)  # how fast defects fall is no part of the answer
    return light + (share - 1.0) * step, before - share * image, share


def _ratio(a, b):
    return jnp.where(b > 0, a / jnp.where(b > 0, b, 1.0), 1.0)


@partial(jax.jit, static_argnames="last")
def _wanted(defect, light, tolerance, *, last):
    """(share of the defect in the light that arrives, relative residual that its solve should reach)."""
    defect, light = lax.stop_gradient((defect, light))
    arriving = light + defect
    # an error of the correction weighs as much less as the defect is smaller than the light itself
    share = jnp.sqrt(jnp.sum(defect * defect) / jnp.maximum(jnp.sum(arriving * arriving), 1e-30))
    tolerance = jnp.minimum(tolerance / jnp.maximum(share, 1e-6), 0.1)
    # before the last one: what is left is part of the next defect
    return share, tolerance if last else jnp.maximum(tolerance, _EARLY)


@jax.jit
def _corrected_once(light, defect, found, share):
    """(light, step) with the defect and what the lattice `found` for it, that often."""
    step = defect + found
    return light + share * step, step


def _first_sources(scattering, whole, flow, g, channel, *, plan):
    """(moments of what the marched light scatters first, k lambda_l of each moment)."""
    mean = jnp.maximum(jnp.mean(whole, axis=0), 1e-20)
    scale = anisotropy.eigenvalues(g, plan.degree)
    strength = jnp.stack([scattering * scale[l] for l in anisotropy.orders(plan.degree)])
    sources = anisotropy.first_collisions(scattering, whole[channel], flow * (whole[channel] / mean), g, plan.degree)
    return sources, strength


def _solve_directional(scattering, absorption, g, sources, tolerance, *, plan):
    return anisotropy.solve(
        lattice(plan.lattice), scattering, absorption, g, sources, degree=plan.degree, kind=plan.probability_map,
        tolerance=tolerance, max_steps=plan.max_applications,
    )  # fmt: skip


def enter_body(scene: Scene, rays: light_rays.LightRays) -> light_rays.LightRays:
    """The rays that meet the body, less Fresnel's reflection at its surface; rays that start inside stay as they are.

    Rays that only pass through the smoothed index around the body are left out: they would make it larger.
    """
    t, normal = body_entry(scene, rays.origin, rays.direction, rays.t_max)
    cosine = np.sum(normal * rays.direction, axis=1)
    index = scene.medium.ior
    mirror = 0.0 if index is None else np.asarray(fresnel.reflectance(jnp.abs(cosine), float(np.max(np.asarray(index)))))
    passed = np.where(cosine > 0, 1.0, 1.0 - mirror)
    kept = np.isfinite(t)
    power = (rays.power * passed[:, None]).astype(np.float32)
    return light_rays.LightRays(rays.origin[kept], rays.direction[kept], power[kept], rays.t_max[kept])


class _Light(NamedTuple):
    """What one set of rays left behind: like `marching.Marched`, with the light that was not scattered at all."""

    track: Float[Array, "C X Y Z"]
    sent: np.ndarray
    live: np.ndarray
    escaped: np.ndarray
    num_steps: int
    flow: Float[Array, "3 X Y Z"] | None
    unscattered: Unscattered | None


def march(
    materials: Materials,
    plan: Plan,
    rays: light_rays.LightRays,
    power: np.ndarray,
    seed: int,
    blocks: Bool[Array, "X Y Z"] | None,
) -> _Light:
    """Straight or bent, as planned; with anisotropic scattering every channel twice, with and without the forward part."""
    if plan.first_order:
        materials, power = material_pass.twice(materials, degree=plan.degree), np.concatenate([power, power], axis=1)
    if plan.refract:
        found = marching.march_bent(
            materials, rays.origin, rays.direction, rays.t_max, power,
            step=plan.march_step, integrator=plan.integrator, seed=seed, with_flow=plan.first_order,
        )  # fmt: skip
    else:
        found = marching.march_straight(
            materials, rays.origin, rays.direction, rays.t_max, power, with_flow=plan.first_order, blocks=blocks
        )
    num = plan.num_channels
    books = [x[:num] for x in (found.sent, found.live, found.escaped)]
    if not plan.first_order:
        return _Light(found.track, *books, found.num_steps, None, None)
    part, flow, unscattered = _with_and_without(found.track, found.flow, materials.scattering, materials.absorption)
    return _Light(part, *books, found.num_steps, flow, unscattered)


@jax.jit
def _with_and_without(track, flow, scattering, absorption):
    """(track, its flow, light that was not scattered at all) of channels marched with the forward part and again without."""
    num = track.shape[0] // 2
    direction = slopes.ratio(flow, jnp.mean(track, axis=0))
    part, whole = track[:num], track[num:]
    whole = whole * _beside_denser(scattering[num:] + absorption[num:])
    return part, direction * jnp.mean(part, axis=0), Unscattered(whole, direction)


def _beside_denser(extinction):
    """Track in voxels as dense as their densest neighbour, over track in them as they are.

    Unscattered light ends in a thin layer of dense voxels. Where a voxel is filled in part, or thinner, its track is larger
    by as much, and interpolated into its neighbour it would make light.
    """
    densest = lax.reduce_window(extinction, 0.0, lax.max, (1, 3, 3, 3), (1, 1, 1, 1), "SAME")
    return mean_through(densest) / mean_through(extinction)


def _channels(power, num_channels):
    """Power per channel; the spectrum that a single channel stands for."""
    if num_channels == 3:
        return power, np.ones(3)
    total = power.sum(0, dtype=np.float64)
    mean = total.mean()
    spectrum = total / mean if mean > 0 else np.ones(3)
    return power.mean(1, keepdims=True), spectrum


def _channel(scattering, absorption, deposit, first, wall, reflectance, plan):
    """(fluence of light scattered once, scattered at all, applications, residual, converged) of one channel."""
    if wall is not None:
        deposit, first = (jnp.where(wall, 0.0, x) for x in (deposit, first))
    if not plan.corrections:
        answer = solve_channel(scattering, absorption, deposit, wall, reflectance, plan.tolerance, plan=plan)
        from_volume = (
            answer.phi_first if not plan.num_surface_rays else lattice_transport(scattering, absorption, first, wall, plan=plan)
        )
        return from_volume, answer.phi, answer.num_applications, answer.residual, answer.converged
    extinction = scattering + absorption

    def arrive(phi):
        return fine_transport(extinction, scattering * phi + deposit, kind=plan.probability_map)

    def answer(defect, tolerance):
        found = solve_channel(scattering, absorption, scattering * defect, None, 0.0, tolerance, plan=plan)
        return found.phi, found

    once = arrive(jnp.zeros_like(deposit))
    phi, applications, residual, converged = _corrected(once, arrive, answer, scattering, plan)
    from_volume = fine_transport(extinction, first, kind=plan.probability_map) if plan.num_surface_rays else once
    return from_volume, phi, applications, residual, converged


def _solve_channel(scattering, absorption, deposit, wall, reflectance, tolerance, *, plan):
    directions = lattice(plan.lattice)
    co = coefficients(directions, scattering, absorption, kind=plan.probability_map, wall=wall, wall_reflectance=reflectance)
    levels = (
        preconditioner.build(deposit.shape, scattering + absorption, absorption, kind=plan.probability_map)
        if plan.preconditioned
        else None
    )
    return solve(directions, co, deposit, tolerance=tolerance, max_steps=plan.max_applications, levels=levels)


def _lattice_transport(scattering, absorption, source, wall, *, plan):
    directions = lattice(plan.lattice)
    co = coefficients(directions, scattering, absorption, kind=plan.probability_map, wall=wall)
    return transport(directions, co, source)


first_sources = jax.jit(_first_sources, static_argnames="plan")
solve_directional = jax.jit(_solve_directional, static_argnames="plan")
solve_channel = jax.jit(_solve_channel, static_argnames="plan")
lattice_transport = jax.jit(_lattice_transport, static_argnames="plan")
fine_transport = jax.jit(fine_sweeps.transport, static_argnames="kind")
fine_moments = jax.jit(fine_sweeps.moments, static_argnames=("degree", "kind"))
