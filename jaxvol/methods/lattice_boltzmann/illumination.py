"""From lights to fluence per voxel: voxelise, march, solve the lattice, keep the layers apart."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxvol.methods.lattice_boltzmann import fine_sweeps, fresnel, light_rays, marching, preconditioner
from jaxvol.methods.lattice_boltzmann import materials as material_pass
from jaxvol.methods.lattice_boltzmann.lattice import coefficients, lattice
from jaxvol.methods.lattice_boltzmann.materials import Materials
from jaxvol.methods.lattice_boltzmann.planning import Plan
from jaxvol.methods.lattice_boltzmann.refraction import body_entry
from jaxvol.methods.lattice_boltzmann.solver import solve
from jaxvol.methods.lattice_boltzmann.sweeps import transport
from jaxvol.types import Scene


class Illumination(NamedTuple):
    """Fluence times h^2 [W] per voxel and channel of light that arrives straight from lights, from surfaces, scattered."""

    materials: Materials
    spectrum: np.ndarray  # [3], colour of the one channel; ones with three
    from_light: Float[Array, "C X Y Z"]
    from_surface: Float[Array, "C X Y Z"] | None
    from_volume: Float[Array, "C X Y Z"]  # scattered once, straight from the lights before
    scattered: Float[Array, "C X Y Z"]  # scattered at all, in the medium
    diagnostics: dict[str, Array]


def illuminate(scene: Scene, plan: Plan, *, seed: int = 0, on_stage=None) -> Illumination:
    """Everything that does not depend on the camera. Diagnostics: books of the marching, applications, residual, converged."""
    report = (lambda name: None) if on_stage is None else on_stage
    grid = material_pass.make_grid(scene.medium, resolution=plan.resolution, margin=plan.margin)
    materials = material_pass.build(scene.medium, grid, num_channels=plan.num_channels, filter_width=plan.filter_width)
    report("voxelize")
    low = np.asarray(grid.lower, float)
    high = low + float(grid.voxel) * np.array(grid.shape)
    rays = light_rays.from_lights(scene, low, high, float(grid.voxel), rays_per_voxel=plan.rays_per_voxel, seed=seed)
    if plan.refract:
        rays = enter_body(scene, rays)
    power, spectrum = _channels(rays.power, plan.num_channels)
    marched = march(materials, plan, rays, power, seed)
    track, books = marched.track, [marched]
    from_surface = None
    if plan.num_surface_rays:
        bounced = light_rays.reflected(scene, low, high, count=plan.num_surface_rays, seed=seed)
        if plan.refract:
            bounced = enter_body(scene, bounced)
        surface_power = bounced.power if plan.num_channels == 3 else (bounced.power @ spectrum / (spectrum @ spectrum))[:, None]
        second = march(materials, plan, bounced, surface_power, seed)
        from_surface = second.track
        books.append(second)
    report("march")
    whole = track if from_surface is None else track + from_surface
    deposit = materials.scattering * whole
    first = materials.scattering * track
    wall = None
    if plan.internal_reflectance > 0:
        wall = ~(
            materials.body if materials.body is not None else jnp.any(materials.scattering + materials.absorption > 0, axis=0)
        )
    if plan.solve:
        results = [
            _channel(materials.scattering[c], materials.absorption[c], deposit[c], first[c], wall, plan)
            for c in range(plan.num_channels)
        ]
        from_volume, scattered, applications, residual, converged = (jnp.stack(x) for x in zip(*results, strict=True))
    else:
        from_volume = scattered = jnp.zeros_like(track)
        applications, residual, converged = jnp.zeros(1, jnp.int32), jnp.zeros(1), jnp.ones(1, bool)
    jax.block_until_ready(scattered)
    report("solve")
    diagnostics = {
        "num_applications": applications,
        "residual": residual,
        "converged": jnp.all(converged),
        "sent": jnp.asarray(sum(b.sent for b in books), jnp.float32),
        "escaped_unscattered": jnp.asarray(sum(b.escaped for b in books), jnp.float32),
        "live": jnp.asarray(sum(b.live for b in books), jnp.float32),
        "num_ray_steps": jnp.asarray(sum(b.num_steps for b in books), jnp.float32),
    }
    return Illumination(materials, spectrum, track, from_surface, from_volume, scattered, diagnostics)


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


def march(materials: Materials, plan: Plan, rays: light_rays.LightRays, power: np.ndarray, seed: int) -> marching.Marched:
    """Straight or bent, as planned."""
    if plan.refract:
        return marching.march_bent(
            materials, rays.origin, rays.direction, rays.t_max, power,
            step=plan.march_step, integrator=plan.integrator, seed=seed,
        )  # fmt: skip
    return marching.march_straight(materials, rays.origin, rays.direction, rays.t_max, power)


def _channels(power, num_channels):
    """Power per channel; the spectrum that a single channel stands for."""
    if num_channels == 3:
        return power, np.ones(3)
    total = power.sum(0, dtype=np.float64)
    mean = total.mean()
    spectrum = total / mean if mean > 0 else np.ones(3)
    return power.mean(1, keepdims=True), spectrum


def _channel(scattering, absorption, deposit, first, wall, plan):
    """(fluence of light scattered once, scattered at all, applications, residual, converged) of one channel."""
    if wall is not None:
        deposit, first = (jnp.where(wall, 0.0, x) for x in (deposit, first))
    if not plan.corrections:
        answer = solve_channel(scattering, absorption, deposit, wall, plan.internal_reflectance, plan.tolerance, plan=plan)
        from_volume = (
            answer.phi_first if not plan.num_surface_rays else lattice_transport(scattering, absorption, first, wall, plan=plan)
        )
        return from_volume, answer.phi, answer.num_applications, answer.residual, answer.converged
    extinction = scattering + absorption
    phi = jnp.zeros_like(deposit)
    applications, residual, converged = jnp.zeros((), jnp.int32), jnp.zeros(()), jnp.asarray(True)
    once = None
    for _ in range(1 + plan.corrections):
        arriving = fine_transport(extinction, scattering * phi + deposit, kind=plan.probability_map)
        once = arriving if once is None else once
        defect = arriving - phi
        # an error of the correction weighs as much less as the defect is smaller than the light itself
        share = jnp.sqrt(jnp.sum(defect * defect) / jnp.maximum(jnp.sum(arriving * arriving), 1e-30))
        tolerance = jnp.minimum(plan.tolerance / jnp.maximum(share, 1e-6), 0.1)
        answer = solve_channel(scattering, absorption, scattering * defect, None, 0.0, tolerance, plan=plan)
        phi = phi + defect + answer.phi
        applications = applications + answer.num_applications
        residual = jnp.maximum(residual, share * answer.residual)
        converged = converged & answer.converged
    from_volume = fine_transport(extinction, first, kind=plan.probability_map) if plan.num_surface_rays else once
    return from_volume, phi, applications, residual, converged


def _solve_channel(scattering, absorption, deposit, wall, reflectance, tolerance, *, plan):
    directions = lattice(plan.lattice)
    co = coefficients(directions, scattering, absorption, kind=plan.probability_map, wall=wall, wall_reflectance=reflectance)
    levels = preconditioner.build(deposit.shape, scattering + absorption, absorption) if plan.preconditioned else None
    return solve(directions, co, deposit, tolerance=tolerance, max_steps=plan.max_applications, levels=levels)


def _lattice_transport(scattering, absorption, source, wall, *, plan):
    directions = lattice(plan.lattice)
    co = coefficients(directions, scattering, absorption, kind=plan.probability_map, wall=wall)
    return transport(directions, co, source)


solve_channel = jax.jit(_solve_channel, static_argnames="plan")
lattice_transport = jax.jit(_lattice_transport, static_argnames="plan")
fine_transport = jax.jit(fine_sweeps.transport, static_argnames="kind")
