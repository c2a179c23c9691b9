"""Lattices of directions, and the map from physical sigma to what a link does (Bernabei et al. 2012, section III-C, eq. 4-5).

Power travels along links r -> r + c_i. With x_i = sigma_t h l_i (l_i = |c_i|, h the voxel size), arrivals f_i and the
isotropic source s of a voxel (its own emission and everything it scatters, W per voxel), one voxel does

    psi_i = beta_i f_i + w_i gamma_i s          mean power along link i inside the voxel
    g_i   = (1 - x_i beta_i) f_i + w_i beta_i s   what leaves, conserving: f_i + w_i s = g_i + x_i psi_i
    phi   = sum_i l_i psi_i                      fluence * h^2 [W]; a voxel scatters sigma_s h phi and absorbs sigma_a h phi

with gamma = (1 - beta) / x. beta = 1 / (1 + x/2) is the Pade map (diamond differences): p_t = x beta = x/(1+x/2), and
for equal links p_s = p_t - x_a/(1+x_a/2) as in the specification; its diffusion constant is exact for every x. beta =
(1 - exp(-x))/x is the exponential map: exact for straight unscattered flight, never negative, diffusion constant x^2/12
too large. Because a link gathers (l_i beta_i) and emits (w_i beta_i) with the same beta, the operator s -> phi is
symmetric for every lattice and every medium, so that conjugate gradients serve for 26 directions as well as for six.

A diffuse wall is a voxel that lets nothing through, gathers 1 per link and emits w_i / l_i per link (Lambert's law on
the lattice); it has the same symmetry. Paper: Theta of eq. 5 conserves all energy (its columns sum to 1, so that
nothing is absorbed); here absorption is a sink. `paper_theta` keeps the printed matrix for the test that shows it.
"""

import math
from dataclasses import dataclass
from typing import Literal

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float

ProbabilityMap = Literal["pade", "exp"]


@dataclass(frozen=True)
class Lattice:
    """Directions c_i and quadrature weights w_i (sum 1); a class is the number of non-zero components (1, 2 or 3)."""

    name: str
    directions: tuple[tuple[int, int, int], ...]
    class_weights: tuple[tuple[int, float], ...]  # (class, w) in increasing class

    @property
    def classes(self) -> tuple[int, ...]:
        return tuple(c for c, _ in self.class_weights)

    def weight(self, link_class: int) -> float:
        return dict(self.class_weights)[link_class]

    @property
    def weights(self) -> np.ndarray:
        return np.array([self.weight(link_class(c)) for c in self.directions])

    @property
    def lengths(self) -> np.ndarray:
        return np.array([link_length(link_class(c)) for c in self.directions])


def link_class(direction: tuple[int, int, int]) -> int:
    """The number of non-zero components: 1 along an axis, 2 across a face, 3 across a cube."""
    return sum(component != 0 for component in direction)


def link_length(cls: int) -> float:
    """|c_i| in voxels of a link of class `cls`."""
    return math.sqrt(cls)


def _make(name: str, class_weights: dict[int, float]) -> Lattice:
    steps = (-1, 0, 1)
    all_directions = [(x, y, z) for x in steps for y in steps for z in steps if x or y or z]
    directions = tuple(d for d in all_directions if link_class(d) in class_weights)
    return Lattice(name=name, directions=directions, class_weights=tuple(sorted(class_weights.items())))


LATTICES = {
    # six axes: the paper's choice, for its memory; degree 3, large ray effects
    "paper": _make("paper", {1: 1 / 6}),
    # Geist et al. 2004's links with the weights that make a degree-5 rule of them (1/12, 1/24 are only degree 3)
    "18": _make("18", {1: 1 / 30, 2: 1 / 15}),
    # Lebedev's 26 points, degree 7
    "26": _make("26", {1: 1 / 21, 2: 4 / 105, 3: 9 / 280}),
}


def lattice(name: str) -> Lattice:
    """The lattice called `name`. Raises ValueError for an unknown name."""
    if name not in LATTICES:
        raise ValueError(f"lattice = {name!r} is unknown; allowed: {', '.join(LATTICES)}")
    return LATTICES[name]


class Coefficients(eqx.Module):
    """What the links of each voxel do; every field is a scalar (homogeneous) or [X, Y, Z]. Tuples run over link classes."""

    gather: tuple[Float[Array, "..."], ...]  # l_i beta_i; 1 at walls
    passing: tuple[Float[Array, "..."], ...] | None  # 1 - x_i beta_i; 0 at walls. None = 2 gather / l - 1 (Pade, no walls)
    own: Float[Array, "..."]  # Gamma = sum_i w_i l_i gamma_i, phi that a voxel's source makes in itself; 0 at walls
    scattering: Float[Array, "..."]  # k = sigma_s h; at walls their reflectance over the share of links that point inside
    absorption: Float[Array, "..."]  # sigma_a h; 0 at walls
    wall: Bool[Array, "X Y Z"] | None = None


def beta_gamma(x: Float[Array, "..."], kind: ProbabilityMap) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
    """beta(x) and gamma(x) = (1 - beta)/x of the module docstring, smooth through x = 0."""
    if kind == "pade":
        beta = 1.0 / (1.0 + 0.5 * x)
        return beta, 0.5 * beta
    if kind == "exp":
        small = x < 0.02
        safe = jnp.where(small, 1.0, x)
        beta = jnp.where(small, 1.0 - x * (0.5 - x * (1.0 / 6.0)), -jnp.expm1(-safe) / safe)
        gamma = jnp.where(small, 0.5 - x * (1.0 / 6.0 - x * (1.0 / 24.0)), (1.0 - beta) / safe)
        return beta, gamma
    raise ValueError(f"probability_map = {kind!r} is unknown; allowed: pade, exp")


def coefficients(
    lattice: Lattice,
    scattering: Float[Array, "..."],
    absorption: Float[Array, "..."],
    *,
    kind: ProbabilityMap = "pade",
    wall: Bool[Array, "X Y Z"] | None = None,
    wall_reflectance: Float[Array, ""] | float = 0.0,
) -> Coefficients:
    """Coefficients from sigma_s h and sigma_a h (scalars or [X, Y, Z]); `wall` marks voxels that reflect diffusely.

    A wall returns `wall_reflectance` of what arrives; the rest is lost and counts as escaped.
    """
    gather, passing = [], []
    own = jnp.zeros_like(scattering)
    for cls, weight in lattice.class_weights:
        length = link_length(cls)
        x = (scattering + absorption) * length
        beta, gamma = beta_gamma(x, kind)
        gather.append(length * beta)
        passing.append(1.0 - x * beta)
        num_links = sum(link_class(c) == cls for c in lattice.directions)
        own = own + num_links * weight * length * gamma
    derived = kind == "pade" and wall is None
    if wall is not None:
        scattering = jnp.where(wall, wall_scattering(lattice, wall, wall_reflectance), scattering)
        absorption = jnp.where(wall, 0.0, absorption)
        gather = [jnp.where(wall, 1.0, value) for value in gather]
        passing = [jnp.where(wall, 0.0, value) for value in passing]
        own = jnp.where(wall, 0.0, own)
    return Coefficients(
        gather=tuple(gather),
        passing=None if derived else tuple(passing),
        own=own,
        scattering=scattering,
        absorption=absorption,
        wall=wall,
    )


def wall_scattering(
    lattice: Lattice, wall: Bool[Array, "X Y Z"], reflectance: Float[Array, ""] | float
) -> Float[Array, "X Y Z"]:
    """k of wall voxels so that they return `reflectance` of what the medium sends them, by Lambert's law w_i / l_i.

    A wall voxel also exchanges light with its neighbours in the wall; with alpha the share of its links that lead to the
    medium, rho' = rho / (alpha + rho (1 - alpha)) per visit makes the whole return rho. Walls that no link joins to the
    medium are black.
    """

    def share(field):
        total = jnp.zeros(wall.shape, jnp.float32)
        for c in lattice.directions:
            cls = link_class(c)
            total = total + lattice.weight(cls) / link_length(cls) * shift(field, tuple(-component for component in c))
        return total

    inward = share(jnp.logical_not(wall).astype(jnp.float32))
    live = jnp.logical_and(wall, inward > 0)
    everything = jnp.where(live, inward + share(live.astype(jnp.float32)), 1.0)
    alpha = inward / everything
    per_visit = reflectance / jnp.where(live, alpha + reflectance * (1.0 - alpha), 1.0)
    return jnp.where(live, per_visit / everything, 0.0)


def shift(field: Float[Array, "X Y Z"], direction: tuple[int, int, int]) -> Float[Array, "X Y Z"]:
    """The field moved by one voxel along `direction`: out[r + c] = field[r]; zeros come in."""
    padding = [(component, -component, 0) for component in direction]
    return lax.pad(field, jnp.zeros((), field.dtype), padding)


def paper_theta(sigma_s: float, sigma_a: float) -> np.ndarray:
    """Theta [7, 7] of eq. 5 as printed, sigma as probability per step; row and column 0 are the rest state."""
    theta = np.full((7, 7), sigma_s / 6.0)
    theta[1:, 1:] += np.eye(6) * (1.0 - sigma_s - sigma_a)
    theta[0, 1:] = sigma_a
    theta[1:, 0] = 1.0 / 6.0
    theta[0, 0] = 0.0
    return theta


def theta(lattice: Lattice, scattering: float, absorption: float, *, kind: ProbabilityMap = "pade") -> np.ndarray:
    """The matrix Theta_ij [q, q] of one voxel without a source: outgoing = Theta arrivals (eq. 4), here with a sink."""
    lengths, weights = lattice.lengths, lattice.weights
    beta, gamma = (np.asarray(value, float) for value in beta_gamma(jnp.asarray((scattering + absorption) * lengths), kind))
    multiple = 1.0 / (1.0 - scattering * np.sum(weights * lengths * gamma))  # scattered again before it left the voxel
    scattered = np.outer(weights * beta, scattering * lengths * beta) * multiple
    return scattered + np.diag(1.0 - (scattering + absorption) * lengths * beta)


def mean_through(thickness: Float[Array, "..."]) -> Float[Array, "..."]:
    """(1 - exp(-x)) / x: mean transmittance inside a step of optical thickness x."""
    thin, series = thickness < 1e-4, 1.0 - 0.5 * thickness
    return jnp.where(thin, series, -jnp.expm1(-thickness) / jnp.where(thin, 1.0, thickness))
