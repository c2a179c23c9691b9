"""A few emissive triangles as spherical polygons: sampled by the solid angle they have at each point.

Seen from close by, samples by area sparkle as 1/distance^2; by solid angle the estimate of unoccluded light is nearly
constant. A triangle is chosen in proportion to radiance times solid angle, then a direction in it uniformly (Arvo 1995,
"Stratified Sampling of Spherical Triangles"); triangles that look small are sampled by area, where Arvo's formulas
cancel in float32. Light leaves the front side only.
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxvol import lights, slopes
from jaxvol.lights import LightSample
from jaxvol.sampling import dot, normalize
from jaxvol.types import Scene

MAX_FACES = 16  # the cost per sample grows with the number; beyond it faces are sampled by area and power
_SMALL = 1e-3  # sr


class Emitters(eqx.Module):
    """Corners, unit normals, areas and radiances of emissive faces."""

    corners: Float[Array, "F 3 3"]
    normal: Float[Array, "F 3"]
    area: Float[Array, "F"]
    radiance: Float[Array, "F 3"]
    face: Int[Array, "F"]  # of the mesh


def emitters(scene: Scene) -> Emitters | None:
    """The emissive faces of a scene, or None when there are none or more than `MAX_FACES`; eager."""
    if scene.area_lights is None or scene.area_lights.face.shape[0] > MAX_FACES:
        return None
    face = scene.area_lights.face
    normal, area = lights.triangle_geometry(scene.mesh)
    corners = scene.mesh.vertices[scene.mesh.faces[face]]
    return Emitters(corners, normal[face], area[face], scene.mesh.emission[face], face)


def solid_angle(
    corners: Float[Array, "3 3"], normal: Float[Array, "3"], area: Float[Array, ""], points: Float[Array, "*b 3"]
) -> Float[Array, "*b"]:
    """Solid angle of a triangle's front side, 0 behind it (van Oosterom and Strackee 1983; small ones: A cos / d^2)."""
    to_corner = [c - points for c in corners]
    a, b, c = (normalize(v) for v in to_corner)
    determinant = dot(a, jnp.cross(b - a, c - a))
    exact = 2.0 * jnp.arctan2(jnp.abs(determinant), 1.0 + dot(a, b) + dot(b, c) + dot(c, a))
    center = (to_corner[0] + to_corner[1] + to_corner[2]) * (1.0 / 3.0)
    squared = jnp.maximum(dot(center, center), 1e-30)
    flat = -dot(normal, center) * area / (squared * jnp.sqrt(squared))
    value = jnp.where(jnp.abs(flat) < _SMALL, flat, exact)
    return jnp.where(dot(normal, to_corner[0]) < 0, jnp.maximum(value, 0.0), 0.0)


def brightness(light: Emitters, points: Float[Array, "*b 3"]) -> list[Float[Array, "*b"]]:
    """Luminance times solid angle of every face."""
    power = lights.luminance(light.radiance)
    num = light.area.shape[0]
    return [power[i] * solid_angle(light.corners[i], light.normal[i], light.area[i], points) for i in range(num)]


def sample(light: Emitters, points: Float[Array, "*b 3"], u1: Float[Array, "*b"], u2: Float[Array, "*b"]) -> LightSample:
    """One direction towards the faces from each point; pdf 0 where none shows its front side."""
    weights = brightness(light, points)
    total = sum(weights)
    target, below = u1 * total, jnp.zeros_like(total)
    slot, base, share = jnp.zeros(total.shape, jnp.int32), jnp.zeros_like(total), weights[0]
    for i, weight in enumerate(weights):
        mine = (target >= below) & (weight > 0)
        slot, base, share = jnp.where(mine, i, slot), jnp.where(mine, below, base), jnp.where(mine, weight, share)
        below = below + weight
    rest = jnp.clip((target - base) / jnp.where(share > 0, share, 1.0), 1e-6, 1.0 - 1e-6)
    corners, normal, area = light.corners[slot], light.normal[slot], light.area[slot]
    radiance = light.radiance[slot]
    power = jnp.maximum(lights.luminance(radiance), 1e-30)
    angle = share / power
    wide = angle > _SMALL
    # Arvo's slopes are not finite in triangles of no angle; three axes stand for them.
    to_corners = jnp.where(wide[..., None, None], corners - points[..., None, :], jnp.eye(3))
    by_angle = _arvo(to_corners, jnp.where(wide, angle, 0.5 * jnp.pi), rest, u2)
    direction = jnp.where(wide[..., None], by_angle, _by_area(corners, points, rest, u2))
    cosine = -dot(direction, normal)
    height = -dot(normal, corners[..., 0, :] - points)
    lit = (total > 0) & (cosine > 1e-7) & (height > 0)
    distance = height / jnp.where(lit, cosine, 1.0)
    flat = distance * distance / jnp.where(lit & ~wide, area * cosine, 1.0)
    density = jnp.where(wide, 1.0 / jnp.where(wide, angle, 1.0), flat)
    pdf = jnp.where(lit, share / jnp.where(lit, total, 1.0) * density, 0.0)
    distance = jnp.where(lit, distance, 1.0)
    return LightSample(
        direction=direction,
        distance=distance,
        radiance=jnp.where(lit[..., None], radiance, 0.0),
        pdf=pdf,
        delta=jnp.zeros(pdf.shape, bool),
        position=points + distance[..., None] * direction,
    )


def sample_pdf(
    light: Emitters,
    points: Float[Array, "*b 3"],
    direction: Float[Array, "*b 3"],
    face: Int[Array, "*b"],
    t: Float[Array, "*b"],
) -> Float[Array, "*b"]:
    """The density of `sample`, 1/sr, for a ray that meets `face` at distance t; 0 for faces that do not emit."""
    weights = brightness(light, points)
    total = sum(weights)
    pdf = jnp.zeros_like(t)
    for i, weight in enumerate(weights):
        angle = weight / jnp.maximum(lights.luminance(light.radiance[i]), 1e-30)
        cosine = -dot(direction, light.normal[i])
        safe_t = jnp.where(jnp.isfinite(t), t, 1.0)
        flat = safe_t * safe_t / jnp.maximum(light.area[i] * cosine, 1e-30)
        density = jnp.where(angle > _SMALL, 1.0 / jnp.maximum(angle, 1e-30), flat)
        mine = (face == light.face[i]) & (cosine > 1e-7) & (total > 0)
        pdf = jnp.where(mine, weight / jnp.maximum(total, 1e-30) * density, pdf)
    return pdf


def _by_area(corners, points, u1, u2):
    root = jnp.sqrt(u1)
    a, b, c = (corners[..., i, :] for i in range(3))
    target = a + (root * (1.0 - u2))[..., None] * (b - a) + (root * u2)[..., None] * (c - a)
    return normalize(target - points)


def _arvo(to_corners, area, u1, u2):
    """A direction uniform in the spherical triangle of solid angle `area`."""
    a, b, c = (normalize(to_corners[..., i, :]) for i in range(3))
    cos_alpha, sin_alpha = _dihedral(a, b, c)
    angle = area * u1
    sine, cosine = jnp.sin(angle), jnp.cos(angle)
    s, t = sine * cos_alpha - cosine * sin_alpha, cosine * cos_alpha + sine * sin_alpha  # of angle - alpha
    u = t - cos_alpha
    v = s + sin_alpha * dot(a, b)
    numerator = (v * t - u * s) * cos_alpha - v
    denominator = (v * s + u * t) * sin_alpha
    q = jnp.clip(numerator / jnp.where(jnp.abs(denominator) > 1e-30, denominator, 1e-30), -1.0, 1.0)
    third = q[..., None] * a + slopes.root((1.0 - q) * (1.0 + q))[..., None] * _orthogonal(c, a)
    away = third - b
    one_minus_z = u2 * 0.5 * dot(away, away)  # 1 - z = u2 (1 - third . b)
    sin_z = slopes.root(one_minus_z * (2.0 - one_minus_z))
    return normalize((1.0 - one_minus_z)[..., None] * b + sin_z[..., None] * _orthogonal(third, b))


def _orthogonal(x, y):
    """The part of x orthogonal to the unit vector y, normalised; from the difference, so that it does not cancel."""
    delta = x - y
    return normalize(delta - dot(delta, y)[..., None] * y)


def _dihedral(a, b, c):
    """(cos, sin) of the spherical triangle's interior angle at a."""
    first, second = _orthogonal(b, a), _orthogonal(c, a)
    cosine = jnp.clip(dot(first, second), -1.0, 1.0)
    cross = jnp.cross(first, second)
    return cosine, jnp.sqrt(jnp.maximum(dot(cross, cross), 1e-20))
