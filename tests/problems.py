"""Exact test problems as data: numbers with closed forms or several independent evaluations behind them.

Lengths in mean free paths (sigma_t = 1) unless stated, c = single-scattering albedo. Each table says what it holds; the
numbers T1 to T13 are those of the project's list of test problems.
"""

import math
from typing import NamedTuple

import numpy as np
from scipy.optimize import brentq

# T2. Infinite medium, isotropic point source of power 1, isotropic scattering: fluence phi(r) (Case, de Hoffmann and
# Placzek 1953), k = inverse diffusion length. A light of intensity 1 has power 4 pi.
POINT_SOURCE_RADII = (0.5, 1.0, 2.0, 5.0, 10.0)
POINT_SOURCE_FLUENCE = {  # c: (k, fluences)
    0.5: (0.9575040241, (0.29476312, 0.058695138, 0.0079276237, 1.2913241e-4, 4.608671e-7)),
    0.9: (0.5254295127, (0.48283269, 0.14328386, 0.037126399, 0.0029151251, 1.0489717e-4)),
    0.99: (0.1725110700, (0.59538560, 0.22019457, 0.084976895, 0.019841736, 0.0041850924)),
}


def point_source_total(c: float) -> float:
    """T2a. Integral of the fluence over space."""
    return 1.0 / (1.0 - c)


def point_source_mean_square(c: float, g: float) -> float:
    """T2a. <r^2> of the fluence for any phase function of mean cosine g; 19.231 at c = .8, g = .6."""
    return 2.0 / ((1.0 - c) * (1.0 - c * g))


# T3. Half space, isotropic scattering (Chandrasekhar 1950).
HALF_SPACE_ALBEDOS = (0.5, 0.9, 0.99, 1.0)
HALF_SPACE_H_AT_1 = (1.251260, 1.850099, 2.472793, 2.907811)
HALF_SPACE_H_AT_HALF = (1.187735, 1.556034, 1.848601, 2.012779)
HALF_SPACE_PLANE_ALBEDO = (0.115226, 0.414947, 0.752721, 1.0)  # light at normal incidence: 1 - H(1) sqrt(1 - c)
HALF_SPACE_SPHERICAL_ALBEDO = (0.146544, 0.478024, 0.794564, 1.0)
EXTRAPOLATION_LENGTH = 0.7104460896  # T3a, the Milne problem


class Slab(NamedTuple):
    """T4. A plane-parallel layer under collimated light at cosine mu0: diffuse reflectance and total transmittance."""

    tau: float
    c: float
    g: float
    mu0: float
    reflectance: float
    transmittance: float


SLABS = (
    Slab(1.0, 1.0, 0.0, 1.0, 0.341329, 0.658671),
    Slab(2.0, 1.0, 0.0, 1.0, 0.517515, 0.482485),
    Slab(8.0, 1.0, 0.0, 1.0, 0.821804, 0.178196),
    Slab(1.0, 1.0, 0.0, 0.5, 0.498376, 0.501624),
    Slab(2.0, 1.0 - 1e-7, 0.75, 1.0, 0.163176, 0.836824),
)

# T5. The same under Lambertian light, c = 1, g = 0: optical thickness, transmittance (reflectance = 1 - T).
LAMBERTIAN_SLABS = (
    (0.1, 0.91570),
    (0.2, 0.84918),
    (0.5, 0.70417),
    (1.0, 0.55341),
    (2.0, 0.39006),
    (3.0, 0.30165),
    (5.0, 0.20766),
    (10.0, 0.11674),
)

# T6. Share of the light of a uniform isotropic source in an absorbing sphere of optical radius t that escapes.
SPHERE_ESCAPE = ((0.1, 0.92884), (0.5, 0.70728), (1.0, 0.52725), (2.0, 0.33242), (5.0, 0.14700))


def sphere_escape(t: float) -> float:
    """T6 in closed form."""
    return 3.0 / (8.0 * t**3) * (2.0 * t * t - 1.0 + (1.0 + 2.0 * t) * math.exp(-2.0 * t))


class Airlight(NamedTuple):
    """T7. int e^{-s (t + r)} / r^2 dt along a ray (r from the light): times sigma_s / (4 pi) = radiance, g = 0, intensity 1."""

    sigma_t: float
    distance: float  # of the light from the ray's origin
    angle: float  # between the ray and the direction to the light
    length: float | None  # of the ray; None = infinite
    integral: float


AIRLIGHT = (
    Airlight(1.0, 1.0, math.pi / 2, None, 0.1933049620),
    Airlight(0.5, 2.0, 0.3, None, 1.1473272643),
    Airlight(1.0, 1.0, math.pi / 3, 2.0, 0.3532012825),
)


def airlight_without_extinction(distance: float, angle: float) -> float:
    """T7 at sigma_t = 0, infinite ray."""
    return (math.pi - angle) / (distance * math.sin(angle))


# T8. Zonal coefficients of Henyey-Greenstein at g = .7: g^l sqrt((2l + 1)/(4 pi)), l = 0..4.
HENYEY_GREENSTEIN_ZONAL = (0.28209479, 0.34202176, 0.30908373, 0.25599896, 0.20319288)


def lattice_mean_square(num_steps: int, p_scatter: float) -> float:
    """T10. <r^2> after n steps on the six-direction lattice without absorption, q = 1 - p_s."""
    q = 1.0 - p_scatter
    return num_steps * (1 + q) / (1 - q) - 2 * q * (1 - q**num_steps) / (1 - q) ** 2


class Kobayashi(NamedTuple):
    """T11. Kobayashi problem 1-i without scattering: nested cubes in an octant, lengths in cm, source 1 / (cm3 s)."""

    source: float = 10.0  # edge of the source cube [0, 10]^3, an absorber itself
    void: float = 50.0
    outer: float = 100.0
    sigma_absorber: float = 0.1
    sigma_void: float = 1e-4
    y: tuple[float, ...] = (5, 15, 25, 35, 45, 55, 65, 75, 85, 95)
    flux: tuple[float, ...] = (  # at (5, y, 5)
        5.95659, 1.37185, 0.500871, 0.252429, 0.150260, 0.0595286, 0.0153283, 0.00417689, 0.00118533, 3.46846e-4,
    )  # fmt: skip


KOBAYASHI = Kobayashi()

# T13. Infinite floor of radiosity pi Le in fog: irradiance scattered once back onto itself, over c pi Le.
FLOOR_IN_FOG = (2.0 / 3.0) * (1.0 - math.log(2.0))


def point_source_fluence(r, c: float) -> np.ndarray:
    """T2 at any radii, by quadrature of the transient part; relative accuracy 1e-10 from r = .05 up."""
    r = np.asarray(r, np.float64)
    k = _inverse_diffusion_length(c)
    y, weight = _FLUENCE_NODES  # m = tanh(y): the logarithm at m = 1 becomes linear
    m = np.tanh(y)
    spectrum = weight * (1 / m**2 - 1) / ((1 - c * m * y) ** 2 + (0.5 * c * math.pi * m) ** 2)
    transient = np.exp(-r[..., None] / m) @ spectrum
    steady = 2 * k**2 * (1 - k**2) / (c * (k**2 + c - 1)) * np.exp(-k * r)
    return (steady + transient) / (4 * math.pi * r)


def _inverse_diffusion_length(c: float) -> float:
    return float(brentq(lambda k: c * math.atanh(k) / k - 1.0, 1e-6, 1 - 1e-15, xtol=1e-15, rtol=1e-14))


def _gauss_legendre(low: float, high: float, num: int) -> tuple[np.ndarray, np.ndarray]:
    node, weight = np.polynomial.legendre.leggauss(num)
    return 0.5 * (high + low) + 0.5 * (high - low) * node, 0.5 * (high - low) * weight


_FLUENCE_NODES = tuple(np.concatenate(x) for x in zip(_gauss_legendre(0, 3, 300), _gauss_legendre(3, 20, 100), strict=True))


def point_source_radiance(position, direction, c: float) -> float:
    """T2. Radiance arriving at `position` along `direction` (of the ray from the eye) in the same medium, scattered light only.

    Isotropic scattering re-emits the fluence: L = c / (4 pi) int exp(-t) phi(|position + t direction|) dt. The ray must
    not pass through the source, which stands at the origin.
    """
    position, direction = np.asarray(position, np.float64), np.asarray(direction, np.float64)
    nearest = -position @ direction
    pieces = [0.0, *(nearest + x for x in (-1.0, -0.3, 0.0, 0.3, 1.0, 4.0) if nearest + x > 0), max(nearest, 0.0) + 45.0]
    total = 0.0
    for low, high in zip(pieces[:-1], pieces[1:], strict=True):
        t, weight = _gauss_legendre(low, high, 80)
        r = np.linalg.norm(position + t[:, None] * direction, axis=1)
        total += weight @ (np.exp(-t) * point_source_fluence(r, c))
    return c / (4 * math.pi) * float(total)


def half_space_radiance(mu: float, mu0: float, c: float, h_mu: float, h_mu0: float) -> float:
    """T3. Radiance reflected at cosine mu for collimated light of unit irradiance (across its beam) at cosine mu0."""
    return c / (4 * math.pi) * mu0 / (mu + mu0) * h_mu * h_mu0


def thick_slab_reflectance(tau: float, h_mu0: float) -> float:
    """T3, T3a. Conservative isotropic slab at cosine mu0, up to terms of exp(-tau): 1 - H(mu0) / (sqrt 3 (tau + 2 q))."""
    return 1.0 - h_mu0 / (math.sqrt(3.0) * (tau + 2.0 * EXTRAPOLATION_LENGTH))


def airlight_in_vacuum(distance: float, angle: float, length: float) -> float:
    """T7 at sigma_t = 0 on a ray of finite length."""
    across, along = distance * math.sin(angle), distance * math.cos(angle)
    return (math.atan((length - along) / across) + math.atan(along / across)) / across
