"""Theta that depends on direction: anisotropic scattering between the lattice's links (section III-C, eq. 5, generalised).

The paper's Theta sends scattered light evenly into all links. Here Theta_ij = passing_i delta_ij + w_i beta_i k l_j beta_j
sum_l (2l + 1) lambda_l P_l(u_i . u_j), the phase function by its Legendre moments up to `degree`. What is sharper goes
straight on (delta-M, Wiscombe 1977): f = g^(degree + 1) for g > 0, sigma_s (1 - f), lambda_l = (g^l - f) / (1 - f). The
26 links integrate products of such moments exactly up to degree 3, so that columns sum to 1 - absorbed and the mean cosine
is exact. Directions are eliminated as in sweeps.py; the state is (degree + 1)^2 moments of the fluence per voxel:

    M = B (k Lambda M + S),  preconditioned BiCGStab (B between odd moments is not definite), lineax.

The first collisions of the marched light enter by its flow (mean direction times fluence): exact for one direction per
voxel; for several its moments are taken as those of Henyey and Greenstein about the mean direction.
"""

import math
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxvol import slopes
from jaxvol.methods.lattice_boltzmann import preconditioner
from jaxvol.methods.lattice_boltzmann.krylov import BiconjugateGradients
from jaxvol.methods.lattice_boltzmann.lattice import Lattice, ProbabilityMap, beta_gamma, link_class, link_length
from jaxvol.methods.lattice_boltzmann.materials import forward_part
from jaxvol.methods.lattice_boltzmann.sweeps import both_senses, move_plane, one_grid

_DARK = 1e-18  # of the light that is marched, which is about 1; its square is a normal number


class Moments(NamedTuple):
    """Moments of the scattered light, fluence * h^2 [W]: Y_0 = 1, then sqrt(3) (x, y, z), ...; how the solve went."""

    moments: Float[Array, "n X Y Z"]
    num_applications: Int[Array, ""]
    residual: Float[Array, ""]
    converged: Bool[Array, ""]


def basis(x, y, z, degree: int) -> list:
    """Real spherical harmonics of unit vectors (numpy or jax), l <= degree <= 3; sum over one l of Y Y' = (2l + 1) P_l."""
    found = [0.0 * x + 1.0]
    if degree >= 1:
        found += [math.sqrt(3.0) * c for c in (x, y, z)]
    if degree >= 2:
        a, b = math.sqrt(15.0), 0.5 * math.sqrt(5.0)
        found += [a * x * y, a * y * z, a * z * x, b * (3.0 * z * z - 1.0), 0.5 * a * (x * x - y * y)]
    if degree >= 3:
        a, b, c, d = math.sqrt(35.0 / 8.0), math.sqrt(105.0), math.sqrt(21.0 / 8.0), 0.5 * math.sqrt(7.0)
        found += [
            a * y * (3.0 * x * x - y * y), a * x * (x * x - 3.0 * y * y), b * x * y * z, 0.5 * b * z * (x * x - y * y),
            c * y * (5.0 * z * z - 1.0), c * x * (5.0 * z * z - 1.0), d * z * (5.0 * z * z - 3.0),
        ]  # fmt: skip
    return found


def orders(degree: int) -> tuple[int, ...]:
    """l of each moment."""
    return tuple(l for l in range(degree + 1) for _ in range(2 * l + 1))


def eigenvalues(g: Float[Array, "..."], degree: int) -> list[Float[Array, "..."]]:
    """lambda_l, l = 0..degree, of Henyey-Greenstein with its `forward_part` taken out."""
    powers = [jnp.ones_like(g)]
    for _ in range(degree):
        powers.append(powers[-1] * g)
    f = forward_part(g, degree)
    return [(p - f) / (1.0 - f) for p in powers]


def theta(lattice: Lattice, scattering: float, absorption: float, g: float, degree: int) -> np.ndarray:
    """Theta_ij [q, q] for sources that leave at once (no source inside the voxel is scattered again), Pade map."""
    lengths, unit = lattice.lengths, np.array(lattice.directions) / lattice.lengths[:, None]
    beta = 1.0 / (1.0 + 0.5 * (scattering + absorption) * lengths)
    y = np.array(basis(*unit.T, degree))
    scale = np.array([float(eigenvalues(jnp.float32(g), degree)[l]) for l in orders(degree)])
    phase = (y.T * scale) @ y
    return np.diag(1.0 - (scattering + absorption) * lengths * beta) + np.outer(
        lattice.weights * beta, scattering * lengths * beta
    ) * phase  # fmt: skip


def transport(
    lattice: Lattice,
    extinction: Float[Array, "X Y Z"],
    sources: Float[Array, "n X Y Z"],
    *,
    degree: int,
    kind: ProbabilityMap = "pade",
    own: bool = True,
) -> Float[Array, "n X Y Z"]:
    """B: moments of the light that sources with these moments [W per voxel] make without any further scattering.

    Without `own` the fluence that a voxel's source makes in itself is left out.
    """
    total = jnp.zeros_like(sources)
    for axis in range(3):
        along = (axis, *(a for a in range(3) if a != axis))
        steps = [c for c in lattice.directions if c[axis] == 1 and not any(c[a] for a in range(axis))]
        if not steps:
            continue
        signs = mirror_signs((axis,), degree)
        planes = both_senses(extinction[None], along)[:, :, 0], both_senses(sources, along, signs=signs)
        total = total + one_grid(_scan(lattice, *planes, steps, along, degree, kind, own), along, signs=signs)
    return total


def mirror_signs(axes: tuple[int, ...], degree: int) -> np.ndarray:
    """[n] what moments are multiplied by when the grid is mirrored along the axes."""
    place = np.array([0.48, 0.6, 0.64])  # no harmonic is 0 there
    mirrored = np.where(np.isin(np.arange(3), axes), -place, place)
    return np.sign(np.array(basis(*mirrored, degree)) / np.array(basis(*place, degree)))


def _scan(lattice, extinction, sources, steps, along, degree, kind, own):
    """Moments [planes, 2, n, rows, columns] of the light of sources of that shape."""
    classes = sorted({link_class(c) for c in steps})
    headings = []
    for c in steps:
        values = [float(v) for v in basis(*(np.array(c) / np.linalg.norm(c)), degree)]
        headings.append((link_class(c), c[along[1]], c[along[2]], values))

    def body(arrivals, planes):
        sigma, source = planes
        link = {}
        for cls in classes:
            beta, gamma = beta_gamma(sigma * link_length(cls), kind)
            link[cls] = beta, gamma, 1.0 - sigma * link_length(cls) * beta
        gathered, leaving = [jnp.zeros_like(sigma)] * source.shape[1], []
        for f, (cls, row, column, values) in zip(arrivals, headings, strict=True):
            beta, gamma, passing = link[cls]
            emitted = lattice.weight(cls) * sum(v * source[:, n] for n, v in enumerate(values) if abs(v) > 1e-6)
            arriving = link_length(cls) * beta * f
            mean = arriving + link_length(cls) * gamma * emitted
            # values[0] = 1: what other moments of the source add to a voxel's own fluence its links cancel
            counted = [mean if n or own else arriving for n in range(len(values))]
            gathered = [t + v * m if abs(v) > 1e-6 else t for t, v, m in zip(gathered, values, counted, strict=True)]
            leaving.append(move_plane(passing * f + beta * emitted, row, column))
        return tuple(leaving), jnp.stack(gathered, axis=1)

    start = tuple(jnp.zeros((2, *sources.shape[3:]), sources.dtype) for _ in steps)
    return lax.scan(body, start, (extinction, sources))[1]


def first_collisions(
    scattering: Float[Array, "X Y Z"],
    track: Float[Array, "X Y Z"],
    flow: Float[Array, "3 X Y Z"],
    g: Float[Array, "X Y Z"],
    degree: int,
) -> Float[Array, "n X Y Z"]:
    """Moments of what the marched light scatters: k lambda_l track r^l Y(direction), r the length of its mean direction."""
    heading, straightness = mean_direction(track, flow)
    scale, power = eigenvalues(g, degree), [jnp.ones_like(g)]
    for _ in range(degree):
        power.append(power[-1] * straightness)
    values = basis(*heading, degree)
    return jnp.stack([scattering * track * scale[l] * power[l] * y for l, y in zip(orders(degree), values, strict=True)])


def mean_direction(track, flow):
    """(unit mean direction, its length before normalisation in 0..1) from fluence and flow; z where it is dark."""
    squared = flow[0] * flow[0] + flow[1] * flow[1] + flow[2] * flow[2]
    lit = squared > _DARK * _DARK
    size = jnp.sqrt(jnp.where(lit, squared, 1.0))
    heading = (jnp.where(lit, flow[0] / size, 0.0), jnp.where(lit, flow[1] / size, 0.0), jnp.where(lit, flow[2] / size, 1.0))
    # where interpolation leaves a flow but no track, it is straight
    known = track > _DARK
    ratio = jnp.where(known, size / jnp.where(known, track, 1.0), 1.0)
    straightness = jnp.where(lit, jnp.minimum(ratio, 1.0), 0.0)
    return heading, straightness


def solve(
    lattice: Lattice,
    scattering: Float[Array, "X Y Z"],
    absorption: Float[Array, "X Y Z"],
    g: Float[Array, "X Y Z"],
    sources: Float[Array, "n X Y Z"],
    *,
    degree: int,
    kind: ProbabilityMap = "pade",
    tolerance: float = 1e-4,
    max_steps: int = 100,
) -> Moments:
    """M = B (k Lambda M + sources); sigma_s h here is that without the forward part (1 - f)."""
    extinction = scattering + absorption
    scale = eigenvalues(g, degree)
    strength = jnp.stack([scattering * scale[l] for l in orders(degree)])
    run = partial(transport, lattice, extinction, degree=degree, kind=kind)
    right = run(sources)
    size = _norm(right)
    unit = right / jnp.where(size > 0, size, 1.0)
    # diffusion follows the transport cross-section, and only the fluence is diffusive
    reduced = extinction - scattering * scale[1] if degree else extinction
    levels = lax.stop_gradient(preconditioner.build(extinction.shape, reduced, absorption, kind=kind))
    frozen, tolerance = lax.stop_gradient((scattering, tolerance))
    leaves = _leaving(lattice, scattering, absorption, kind)

    def operator(m):
        """m - B (strength m), without the difference of 1 and of what stays in a thick white voxel: float32 has none left."""
        through = run(strength * m, own=False)
        return jnp.concatenate([(leaves * m[0] - through[0])[None], (m - through)[1:]])

    def precondition(r):
        return r.at[0].add(preconditioner.v_cycle(levels, frozen * r[0]))

    structure = jax.eval_shape(lambda: unit)
    answer = lx.linear_solve(
        lx.FunctionLinearOperator(operator, structure),
        unit,
        BiconjugateGradients(tolerance=tolerance, max_steps=max_steps),
        options={"preconditioner": lx.FunctionLinearOperator(precondition, structure)},
        throw=False,
    )
    rest = unit - operator(answer.value)
    residual = lax.stop_gradient(_norm(rest))
    # one more sweep: right + size B (strength value)
    return Moments(size * (answer.value + rest), 2 * answer.stats["num_steps"] + 2, residual, residual <= 3.0 * tolerance)


def _leaving(lattice, scattering, absorption, kind):
    """1 less what of a voxel's source it scatters again before it leaves (sigma_s h Gamma), by x gamma = 1 - beta."""
    extinction = scattering + absorption
    out = 0.0
    for cls, weight in lattice.class_weights:
        count = sum(link_class(c) == cls for c in lattice.directions)
        out = out + count * weight * beta_gamma(extinction * link_length(cls), kind)[0]
    thick = extinction > 0
    return jnp.where(thick, (absorption + scattering * out) / jnp.where(thick, extinction, 1.0), 1.0)


def _norm(x):
    """Length of x, with slope 0 where all is 0."""
    return slopes.root(jnp.sum(x * x))
