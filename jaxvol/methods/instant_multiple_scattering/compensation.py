"""Bias compensation: the energy that clamping removed, from new path vertices within the clamp distance (4.3, 4.4).

min(1/r^2, b) + max(1/r^2 - b, 0) = 1/r^2. The second part is sampled the other way round: from x a direction by the
phase function or BRDF and a distance t < d = 1/sqrt(b), which makes a vertex x' with weight max(0, 1 - t^2/d^2); its
light is the lights' light (virtual AND primary: a path light-x'-x-eye is clamped like any other, which the paper
forgets) plus the same residual again.
"""

import math
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxvol import lights as primary
from jaxvol import materials, media, phase, ray_casting, sampling
from jaxvol.methods.instant_multiple_scattering import gathering, pairs, receivers
from jaxvol.methods.instant_multiple_scattering.planning import Plan
from jaxvol.methods.instant_multiple_scattering.receivers import Points
from jaxvol.types import Hits, Medium, Scene

_MEAN_WEIGHT = 2.0 / 3.0  # integral of 1 - q^2 over q in (0, 1)
_EVEN = 0.1  # share by which extinction may change within the clamp distance
_CLOSE = 3.0  # clamp distances from a light within which directions are drawn towards it
_INFINITE = 1e28  # squared distance of a light's sampled position from which it counts as infinitely far


def sample_distance(u: Float[Array, "*n"], d: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """t in (0, d) with pdf 1.5 (1 - t^2/d^2) / d: the compensation weight itself, which then cancels."""
    return 2.0 * d * jnp.sin(jnp.arcsin(u) * (1.0 / 3.0))


def sample_distance_pdf(t: Float[Array, "*n"], d: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """1.5 (1 - t^2/d^2) / d inside (0, d), else 0."""
    q = t / d
    return jnp.where((t >= 0) & (t <= d), 1.5 * (1.0 - q * q) / d, 0.0)


def distance_cdf(t: Float[Array, "*n"], d: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """Integral of `sample_distance_pdf` from 0 to t."""
    q = jnp.clip(t / d, 0.0, 1.0)
    return q * (1.5 - 0.5 * q * q)


def weight(t: Float[Array, "*n"], d: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """max(0, (G - b) / G) = max(0, 1 - t^2/d^2)."""
    q = t / d
    return jnp.maximum(1.0 - q * q, 0.0)


def sample_distance_exponential(u: Float[Array, "*n"], d: Float[Array, "*n"], sigma: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """The paper's t = -log(1 - u (1 - exp(-sigma d))) / sigma, in forms that hold for sigma -> 0."""
    return sampling.sample_truncated_exponential(u, sigma, d)


def sample_distance_exponential_pdf(
    t: Float[Array, "*n"], d: Float[Array, "*n"], sigma: Float[Array, "*n"]
) -> Float[Array, "*n"]:
    """sigma exp(-sigma t) / (1 - exp(-sigma d))."""
    return sampling.sample_truncated_exponential_pdf(t, sigma, d)


class Proposal(NamedTuple):
    """Where the residual of each point looks for a new vertex."""

    origin: Float[Array, "n 3"]  # off the surface where the point is on one
    direction: Float[Array, "n 3"]  # away from the point
    gain: Float[Array, "n 3"]  # f_hat / p(direction): sigma_s in the medium, f_r cos / p on a surface


def propose(scene: Scene, points: Points, u1: Float[Array, "n"], u2: Float[Array, "n"], u3: Float[Array, "n"]) -> Proposal:
    """A direction for the residual of each point, by the phase function or the BRDF."""
    backwards = -points.outgoing
    direction, gain, origin = backwards, points.scattering, points.position
    if scene.medium is not None:
        arriving, _ = phase.sample(scene.medium, points.outgoing, u1, u2)
        direction = -arriving
    if points.on_surface is not None:
        surface = points.surface
        leaving = materials.sample(surface, points.normal, backwards, u1, u2, u3)
        pdf = materials.sample_pdf(surface, points.normal, backwards, leaving)
        value = materials.evaluate(surface, points.normal, backwards, leaving)
        cosine = jnp.abs(sampling.dot(points.normal, leaving))
        reflected = value * (cosine / jnp.maximum(pdf, 1e-20))[:, None]
        on = points.on_surface[:, None]
        direction = jnp.where(on, leaving, direction)
        gain = jnp.where(on, reflected, gain)
        scale = ray_casting.scene_scale(scene.mesh)
        origin = jnp.where(on, ray_casting.offset_origin(points.position, points.normal, direction, scale=scale), origin)
    return Proposal(origin, direction, gain)


def propose_near_light(
    scene: Scene, points: Points, proposal: Proposal, target: Float[Array, "n 3"], u: tuple[Float[Array, "n"], ...]
) -> Proposal:
    """The same proposals, half of them turned towards the light at `target` where a point in the medium is close to it.

    Light along a ray that passes the light at an angle theta from the point is about 1/sin(theta): directions of pdf
    1/(2 pi^2 sin(theta)) take that out, mixed with those of the phase function (one-sample MIS).
    """
    delta = target - points.position
    r2 = jnp.maximum(sampling.dot(delta, delta), pairs.least_distance2(points.clamp))
    close = r2 < (_CLOSE * _CLOSE) * points.clamp * points.clamp
    if points.on_surface is not None:
        close = close & ~points.on_surface
    axis = jnp.where(close[:, None], delta, jnp.float32([0.0, 0.0, 1.0]))
    axis = axis / jnp.sqrt(jnp.where(close, r2, 1.0))[:, None]
    theta, phi = math.pi * u[0], (2.0 * math.pi) * u[1]
    ring = jnp.sin(theta)
    local = jnp.stack([ring * jnp.cos(phi), ring * jnp.sin(phi), jnp.cos(theta)], axis=-1)
    turned = sampling.to_world(local, axis)
    direction = jnp.where((close & (u[2] < 0.5))[:, None], turned, proposal.direction)
    cosine = sampling.dot(direction, axis)
    sine = jnp.sqrt(jnp.maximum((1.0 - cosine) * (1.0 + cosine), 1e-12))
    f = phase.evaluate(scene.medium, -sampling.dot(direction, points.outgoing))
    mixed = 0.5 * f + 0.5 / (2.0 * math.pi * math.pi * sine)
    gain = jnp.where(close[:, None], points.scattering * (f / mixed)[:, None], proposal.gain)
    return Proposal(proposal.origin, direction, gain)


class Step(NamedTuple):
    """How the residual of each point goes on: what its ray meets, and where it will stop."""

    s: Float[Array, "n"]  # distance of the surface met within the clamp distance; 0 where none is
    meets: Bool[Array, "n"]
    face: Int[Array, "n"]
    to_surface: Float[Array, "n"]  # probability that the surface becomes the vertex
    on_surface: Bool[Array, "n"]  # it does


def choose_kind(scene: Scene, points: Points, s: Float[Array, "n"], face: Int[Array, "n"], u: Float[Array, "n"]) -> Step:
    """Surface or medium: (s, face) is the surface that the ray meets within the clamp distance (inf, -1: none).

    It becomes the vertex with probability 1 - F(s)/2, else one in the medium before it.
    """
    meets = jnp.asarray(face) >= 0
    to_surface = jnp.where(meets, 1.0, 0.0)
    if scene.medium is not None:
        to_surface = jnp.where(meets, 1.0 - 0.5 * distance_cdf(jnp.asarray(s), points.clamp), 0.0)
    return Step(jnp.where(meets, jnp.asarray(s), 0.0), meets, jnp.asarray(face), to_surface, u < to_surface)


def distance_onwards(
    points: Points, step: Step, u: Float[Array, "n"], sigma: Float[Array, "n"], *, distance: str
) -> tuple[Float[Array, "n"], Float[Array, "n"]]:
    """A distance in the medium, by the weight or as the paper does (`sigma`: local mean extinction), and weight / pdf."""
    d = points.clamp
    limit = jnp.where(step.meets, step.s, d)
    if distance == "weight":
        reach = distance_cdf(limit, d)
        return sample_distance(u * reach, d), reach * (_MEAN_WEIGHT * d)
    t = sample_distance_exponential(u, limit, sigma)
    return t, weight(t, d) / jnp.maximum(sample_distance_exponential_pdf(t, limit, sigma), 1e-30)


def distance_to_light(
    points: Points, proposal: Proposal, step: Step, u: Float[Array, "n"], target: Float[Array, "n 3"]
) -> tuple[Float[Array, "n"], Float[Array, "n"]]:
    """A distance in the medium, equi-angular as seen from the light at `target`, and weight / pdf.

    Without it 1/r^2 to a light in the medium has infinite variance. Towards infinite lights by the weight.
    """
    d = points.clamp
    limit = jnp.where(step.meets, step.s, d)
    far = sampling.dot(target, target) > _INFINITE
    near = jnp.where(far[:, None], proposal.origin + d[:, None] * proposal.direction, target)
    zero = jnp.zeros_like(limit)
    t, pdf = sampling.sample_equiangular(u, proposal.origin, proposal.direction, zero, limit, near)
    reach = distance_cdf(limit, d)
    t = jnp.where(far, sample_distance(u * reach, d), t)
    return t, jnp.where(far, reach * (_MEAN_WEIGHT * d), weight(t, d) / jnp.maximum(pdf, 1e-30))


def new_vertices(
    scene: Scene,
    points: Points,
    proposal: Proposal,
    step: Step,
    t: Float[Array, "n"],
    factor: Float[Array, "n"],
    sigma: Float[Array, "n"],
    even: Bool[Array, "n"],
    *,
    transmittance: str,
    num_steps: int,
) -> tuple[Points, Float[Array, "n 3"]]:
    """The new vertices x' and what carries their light to the points: gain tau(x, x') max(0, 1 - t^2/d^2) / p(t).

    (t, factor) is the distance in the medium and its weight / pdf. `sigma` is the local mean extinction that with
    transmittance="local" takes the place of the true one (biased), with "detected" only where it hardly changes.
    """
    medium = scene.medium
    factor = factor / jnp.maximum(1.0 - step.to_surface, 1e-6)
    t = jnp.where(step.on_surface, step.s, t)
    factor = jnp.where(step.on_surface, weight(t, points.clamp) / jnp.maximum(step.to_surface, 1e-6), factor)
    position = proposal.origin + t[:, None] * proposal.direction
    throughput = proposal.gain * factor[:, None]
    scattering = jnp.zeros_like(throughput)
    if medium is not None:
        scattering = media.density(medium, position)[:, None] * medium.sigma_s
        local = (sigma * t)[:, None] * _relative(medium)
        depth = local
        if transmittance != "local":
            column = receivers.column_between(medium, proposal.origin, position, num_steps=num_steps)
            depth = column[:, None] * media.sigma_t(medium)
        if transmittance == "detected":
            depth = jnp.where(even[:, None], local, depth)
        throughput = throughput * jnp.exp(-depth)
    outgoing = -proposal.direction
    if points.on_surface is None:
        return Points(position, outgoing, scattering, points.clamp), throughput
    distance = jnp.where(step.meets, step.s, jnp.inf)
    hit: Hits = ray_casting.hits(scene.mesh, proposal.origin, proposal.direction, distance, step.face)
    on = step.on_surface[:, None]
    found = Points(
        jnp.where(on, hit.position, position),
        outgoing,
        jnp.where(on, 0.0, scattering),
        points.clamp,
        step.on_surface,
        hit.normal,
        materials.surface_at(scene.mesh, step.face),
    )
    return found, throughput


def _relative(medium):
    """Extinction of the channels relative to their mean."""
    extinction = media.sigma_t(medium)
    return extinction / jnp.maximum(jnp.mean(extinction), 1e-30)


def sample_primary(
    scene: Scene, points: Points, u1: Float[Array, "n"], u2: Float[Array, "n"], u3: Float[Array, "n"]
) -> tuple[primary.LightSample, Float[Array, "n 3"]]:
    """One direction towards a primary light for each point, and the origin of its shadow ray."""
    found = primary.sample_light(scene, points.position, u1, u2, u3)
    origin = points.position
    if points.on_surface is not None:
        lifted = ray_casting.offset_origin(
            points.position, points.normal, found.direction, scale=ray_casting.scene_scale(scene.mesh)
        )
        origin = jnp.where(points.on_surface[:, None], lifted, origin)
    return found, origin


def direct_light(
    scene: Scene,
    points: Points,
    sample: primary.LightSample,
    visible: Bool[Array, "n"] | None,
    *,
    isotropic: bool,
    num_steps: int,
) -> Float[Array, "n 3"]:
    """Light of the primary lights scattered at the points towards `outgoing`: one sample each, f tau V L / p."""
    towards = tuple(-x for x in pairs.components(sample.direction))
    received = jnp.stack(gathering.scattered(points, towards, scene.medium, isotropic=isotropic), axis=-1)
    value = received * sample.radiance / jnp.maximum(sample.pdf, 1e-30)[:, None]
    if visible is not None:
        value = jnp.where(visible[:, None], value, 0.0)
    if scene.medium is not None:
        end = _end(scene.medium, points.position, sample)
        column = receivers.column_between(scene.medium, points.position, end, num_steps=num_steps)
        value = value * jnp.exp(-column[:, None] * media.sigma_t(scene.medium))
    return value


def _end(medium, position, sample):
    """The light's position, or for an infinite one a point that is surely outside the medium."""
    low, high = medium.bounds
    beyond = jnp.linalg.norm(high - low) + jnp.linalg.norm(position - low, axis=-1)
    far = jnp.where(jnp.isfinite(sample.distance), sample.distance, beyond)
    return position + far[:, None] * sample.direction


def local_sigma(medium: Medium | None, mip: Float[Array, "x y z"] | None, position: Float[Array, "n 3"]) -> Float[Array, "n"]:
    """Mean extinction around points: of the channels, times the density of a coarse grid (the paper's average)."""
    if medium is None:
        return jnp.zeros(position.shape[:-1], jnp.float32)
    sigma = jnp.mean(media.sigma_t(medium))
    if mip is None:
        return jnp.broadcast_to(sigma, position.shape[:-1])
    shape = jnp.asarray(mip.shape)
    cell = media.voxel_coordinates(medium.bounds, mip.shape, position)
    cell = jnp.clip(cell.astype(jnp.int32), 0, shape - 1)
    flat = (cell[..., 0] * mip.shape[1] + cell[..., 1]) * mip.shape[2] + cell[..., 2]
    return sigma * mip.reshape(-1)[flat]


def is_even(
    medium: Medium | None, mip: Float[Array, "x y z"] | None, position: Float[Array, "n 3"], clamp: Float[Array, "n"]
) -> Bool[Array, "n"]:
    """Whether extinction changes by less than a tenth within the clamp distance: |grad sigma_t| d < 0.1 sigma_t (4.4)."""
    if medium is None or mip is None:
        return jnp.ones(position.shape[:-1], bool)
    cell = (medium.bounds[1] - medium.bounds[0]) / jnp.asarray(mip.shape, jnp.float32)
    here = local_sigma(medium, mip, position)
    squared = jnp.zeros_like(here)
    for axis in range(3):
        aside = cell[axis] * jnp.eye(3, dtype=jnp.float32)[axis]
        slope = (local_sigma(medium, mip, position + aside) - local_sigma(medium, mip, position - aside)) / (2.0 * cell[axis])
        squared = squared + slope * slope
    return jnp.sqrt(squared) * clamp < _EVEN * here


def block_means(density: Float[Array, "X Y Z"], *, block: int) -> np.ndarray:
    """Mean density of blocks of voxels, at least `block` wide; eager."""
    grid = np.asarray(density, np.float64)
    for axis, count in enumerate([max(n // block, 1) for n in grid.shape]):
        parts = np.array_split(grid, count, axis=axis)
        grid = np.stack([part.mean(axis=axis) for part in parts], axis=axis)
    return grid.astype(np.float32)


def coarse_density(density: Float[Array, "X Y Z"], *, block: int) -> np.ndarray:
    """Mean density of blocks of voxels, smoothed over the neighbours; eager. Its cells are `block` voxels wide (at least)."""
    padded = np.pad(block_means(density, block=block), 1, mode="edge")
    for axis in range(3):
        n = padded.shape[axis]
        low, mid, high = (np.take(padded, range(k, n - 2 + k), axis=axis) for k in range(3))
        padded = 0.25 * low + 0.5 * mid + 0.25 * high
    return padded.astype(np.float32)


def clamp_distance(sigma: Float[Array, "*n"], *, mean_free_paths: float, most: float) -> Float[Array, "*n"]:
    """d = mean_free_paths / sigma, at most `most` (a length)."""
    return jnp.minimum(mean_free_paths / jnp.maximum(sigma, 1e-12), most)


def most_clamp(scene: Scene, share: float) -> Float[Array, ""]:
    """`share` of the longest side of all there is, a length; traced, so that scenes of all sizes share programs."""
    corners = [] if scene.medium is None else [scene.medium.bounds]
    if scene.mesh is not None and scene.mesh.vertices.shape[0]:
        corners.append(scene.mesh.vertices)
    if not corners:
        return jnp.float32(share)
    low, high = jnp.min(jnp.concatenate(corners), axis=0), jnp.max(jnp.concatenate(corners), axis=0)
    return share * jnp.max(high - low)


@partial(jax.jit, static_argnames="plan")
def clamp_at(scene: Scene, mip: Float[Array, "x y z"] | None, position: Float[Array, "*n 3"], *, plan: Plan):
    """Clamp distance at points: a function of the receiver alone, one for all channels, so that the split is exact."""
    sigma = local_sigma(scene.medium, mip, position)
    return clamp_distance(sigma, mean_free_paths=plan.mean_free_paths, most=most_clamp(scene, plan.most_clamp))
