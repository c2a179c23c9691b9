"""One effective sigma per segment for heterogeneous media (section 4.4, Figure 7), and where it fails.

The paper replaces the medium by a homogeneous one with the mean sigma of the segment receiver-source. That is exact for the
directly attenuated light. Scattered light leaves the segment, and is then wrong by the factors that `compare` measures:
within 10 % for mild contrast along the segment, 60 % for a thick receiver side, without bound where the segment misses
the medium. The truth is the half-angle quadrature with sigma integrated exactly along both legs.
"""

from typing import NamedTuple

import numpy as np
from numpy.polynomial.legendre import legvander

from jaxvol import airlight, harmonics
from jaxvol.fit import zonal_tables


class Layers(NamedTuple):
    """Extinction sigma_near for z < split, sigma_far beyond; the receiver is at z = 0, the source at z = d > split."""

    sigma_near: float
    sigma_far: float
    split: float

    def sigma(self, points: np.ndarray) -> np.ndarray:
        """Extinction at points `[*, 3]`."""
        return np.where(points[..., 2] < self.split, self.sigma_near, self.sigma_far)

    def optical_thickness(self, start: np.ndarray, end: np.ndarray) -> np.ndarray:
        """Exact integral of sigma along segments."""
        low, high = np.minimum(start[..., 2], end[..., 2]), np.maximum(start[..., 2], end[..., 2])
        extent = np.where(high > low, high - low, 1)
        share = np.where(high > low, np.clip((self.split - low) / extent, 0, 1), low < self.split)
        mean = share * self.sigma_near + (1 - share) * self.sigma_far
        return mean * np.linalg.norm(end - start, axis=-1)


class Sphere(NamedTuple):
    """Extinction sigma_inside within a sphere centred on the axis, none outside."""

    sigma_inside: float
    centre: float
    radius: float

    def sigma(self, points: np.ndarray) -> np.ndarray:
        """Extinction at points `[*, 3]`."""
        offset = points - np.array([0, 0, self.centre])
        return np.where(np.sum(offset * offset, axis=-1) < self.radius**2, self.sigma_inside, 0.0)

    def optical_thickness(self, start: np.ndarray, end: np.ndarray) -> np.ndarray:
        """Exact integral of sigma along segments: the chord inside."""
        start, end = np.broadcast_arrays(start, end)
        along = end - start
        length = np.linalg.norm(along, axis=-1)
        direction = along / np.maximum(length, 1e-300)[..., None]
        offset = start - np.array([0, 0, self.centre])
        b = np.sum(offset * direction, axis=-1)
        root = np.sqrt(np.maximum(b * b - np.sum(offset * offset, axis=-1) + self.radius**2, 0))
        inside = np.clip(np.minimum(-b + root, length) - np.maximum(-b - root, 0), 0, None)
        return self.sigma_inside * np.where(root > 0, inside, 0)


def effective_sigma(medium, distance: float) -> float:
    """Mean extinction along the segment from the receiver to the source."""
    source = np.array([0.0, 0.0, distance])
    return float(medium.optical_thickness(np.zeros(3), source) / distance)


def truth(medium, distance: float, *, order: int = 11, num_nodes: int = 200) -> np.ndarray:
    """L_l of light scattered once (albedo 1, isotropic, point source of intensity 1) in a medium around the axis. `[order]`.

    L_l = 2 K_l / d int int P_l sigma(p) e^{-tau(receiver, p) - tau(p, source)} da dw. A jump of sigma across the nodes costs
    accuracy: layers 1e-3 at 200 nodes; spheres are integrated chord by chord.
    """
    if isinstance(medium, Sphere):
        return _truth_in_sphere(medium, distance, order, num_nodes)
    nodes = airlight.half_angle_nodes(num_nodes)
    t = distance * nodes.receiver_distance
    points = np.stack([t * nodes.sin_receiver, 0 * t, t * nodes.cos_receiver], axis=-1)
    keep = np.isfinite(points).all(axis=-1)
    points = points[keep]
    depth = medium.optical_thickness(np.zeros(3), points) + medium.optical_thickness(points, np.array([0.0, 0.0, distance]))
    value = nodes.weight[keep] * medium.sigma(points) * np.exp(-depth)
    return 2 / distance * harmonics.zonal_norm(order) * (value @ legvander(nodes.cos_receiver[keep], order - 1))


def _truth_in_sphere(sphere: Sphere, distance: float, order: int, num_nodes: int) -> np.ndarray:
    """The same over the viewing angle theta and the angle y at the source (t = d cos theta + h tan y, h = d sin theta).

    L_l = sigma / (2 d) K_l int P_l int e^{-tau} dy dtheta, y over the part of the ray inside.
    """
    outside = sphere.centre >= sphere.radius
    widest = np.arcsin(sphere.radius / sphere.centre) if outside else np.pi
    if sphere.centre <= -sphere.radius:
        raise ValueError("a sphere behind the receiver is not supported")
    x, _, weight = airlight.double_exponential(num_nodes, limit=2.6)
    theta = (widest * x)[:, None]
    height, along = distance * np.sin(theta), sphere.centre * np.cos(theta)
    root = np.sqrt(np.maximum(sphere.radius**2 - (sphere.centre * np.sin(theta)) ** 2, 0))
    ends = [np.arctan2(np.maximum(along + side * root, 0) - distance * np.cos(theta), height) for side in (-1, 1)]
    y = ends[0] + (ends[1] - ends[0]) * x
    t = np.maximum(distance * np.cos(theta) + height * np.tan(y), 0)
    points = np.stack([t * np.sin(theta), 0 * t, t * np.cos(theta)], axis=-1)
    source = np.array([0.0, 0.0, distance])
    depth = sphere.optical_thickness(np.zeros(3), points) + sphere.optical_thickness(points, source)
    seen = (ends[1] - ends[0])[:, 0] * (np.exp(-depth) @ weight)
    polynomials = legvander(np.cos(theta[:, 0]), order - 1)
    return sphere.sigma_inside / (2 * distance) * widest * harmonics.zonal_norm(order) * ((weight * seen) @ polynomials)


def effective(medium, distance: float, *, order: int = 11) -> np.ndarray:
    """The paper's approximation of `truth`: the homogeneous response at the effective sigma; 0 where the segment sees none."""
    sigma = effective_sigma(medium, distance)
    if sigma == 0:
        return np.zeros(order)
    tau = np.array([sigma * distance])
    return sigma**2 * zonal_tables.unscale_point(zonal_tables.point_table(tau, order=order), tau)[0]


class Ratio(NamedTuple):
    """Effective-sigma over truth."""

    irradiance: float  # scattered, on a receiver facing the source
    band_0: float
    band_5: float
    irradiance_with_direct: float


def compare(medium, distance: float) -> Ratio:
    """Ratios of the approximation to the truth; nan where the truth is 0."""
    exact, rough = truth(medium, distance), effective(medium, distance)
    cosine = harmonics.clamped_cosine(exact.size)
    direct = np.exp(-effective_sigma(medium, distance) * distance) / distance**2
    facing, facing_rough = cosine @ exact, cosine @ rough
    return Ratio(facing_rough / facing, rough[0] / exact[0], rough[5] / exact[5], (facing_rough + direct) / (facing + direct))


CASES = {
    "layers 0.9 | 1.1": (Layers(0.9, 1.1, 0.5), 1.0),
    "layers 0.5 | 1.5": (Layers(0.5, 1.5, 0.5), 1.0),
    "layers 1.5 | 0.5": (Layers(1.5, 0.5, 0.5), 1.0),
    "layers 0.1 | 1.9": (Layers(0.1, 1.9, 0.5), 1.0),
    "layers 1.9 | 0.1": (Layers(1.9, 0.1, 0.5), 1.0),
    "sphere at source": (Sphere(2.0, 2.0, 0.5), 2.0),
    "sphere midway": (Sphere(2.0, 1.0, 0.5), 2.0),
    "wide sphere midway": (Sphere(1.0, 1.0, 1.2), 2.0),
}
