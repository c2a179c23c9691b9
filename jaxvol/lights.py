"""Light sources seen from a point: emitted radiance, next-event sampling with its pdf, and the tables behind them.

One light is chosen among all (each point, spot and directional light counts one, all emissive triangles together one,
the environment one), then a direction towards it. For sampling from the lights' side see `emission`.
"""

import math

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from jaxvol import slopes
from jaxvol.sampling import (
    dot,
    normalize,
    sample_cdf,
    sample_triangle,
    sample_uniform_sphere,
    sample_uniform_sphere_pdf,
)
from jaxvol.types import AreaLights, EnvironmentLight, Mesh, Scene, SpotLights

_LUMINANCE = (0.2126, 0.7152, 0.0722)


class LightSample(eqx.Module):
    """One direction towards a light. The estimate of reflected light is f * cos * radiance / pdf."""

    direction: Float[Array, "*b 3"]  # unit, from the point towards the light
    distance: Float[Array, "*b"]  # inf for directional and environment lights
    radiance: Float[Array, "*b 3"]  # radiance; intensity / distance^2 or irradiance for a delta light
    pdf: Float[Array, "*b"]  # of direction (1/sr) times choice; of the choice alone for a delta light
    delta: Bool[Array, "*b"]  # no other sampler can find this light
    position: Float[Array, "*b 3"]  # of the light; for infinite ones a far point along `direction`


def luminance(rgb: Float[Array, "*b 3"]) -> Float[Array, "*b"]:
    """Rec. 709 luminance, floored at a little of the strongest channel so that pure colours still get samples."""
    y = _LUMINANCE[0] * rgb[..., 0] + _LUMINANCE[1] * rgb[..., 1] + _LUMINANCE[2] * rgb[..., 2]
    return jnp.maximum(y, 0.1 * slopes.largest(rgb))


def _luminance_host(rgb):
    return np.maximum(rgb @ np.asarray(_LUMINANCE), 0.1 * rgb.max(axis=-1))


def triangle_geometry(mesh: Mesh) -> tuple[Float[Array, "F 3"], Float[Array, "F"]]:
    """Unit normals by the winding rule and areas of all faces; a degenerate face has normal 0 and area 0."""
    a, b, c = (mesh.vertices[mesh.faces[:, i]] for i in range(3))
    cross = jnp.cross(b - a, c - a)
    return normalize(cross), 0.5 * jnp.sqrt(jnp.maximum(dot(cross, cross), 0.0))


def area_lights(mesh: Mesh | None) -> AreaLights | None:
    """The emissive faces of a mesh and their sampling table; None when nothing emits. Eager."""
    if mesh is None or mesh.emission is None:
        return None
    emission = np.asarray(mesh.emission, np.float64)
    corners = np.asarray(mesh.vertices, np.float64)[np.asarray(mesh.faces)]
    area = 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=-1)
    weight = area * _luminance_host(emission)
    face = np.flatnonzero(weight > 0)
    if face.size == 0:
        return None
    weight = weight[face]
    cdf = np.cumsum(weight) / weight.sum()
    return AreaLights(
        face=jnp.asarray(face, jnp.int32),
        probability=jnp.asarray(weight / weight.sum(), jnp.float32),
        cdf=jnp.asarray(np.minimum(cdf, 1.0), jnp.float32),
        total=jnp.asarray(weight.sum(), jnp.float32),
    )


def environment_light(radiance: ArrayLike, *, rotation_degrees: float = 0.0) -> EnvironmentLight | None:
    """A latitude-longitude map (h, w, 3), y up, rotated about y; a single RGB makes a uniform sky. Eager.

    The sampling table holds the 3 x 3 mean of luminance times solid angle, positive wherever the bilinear lookup is.
    None when the map is black. Raises ValueError when it is not (h, w, 3), not finite or negative.
    """
    image = np.asarray(radiance, np.float64)
    if image.shape == (3,):
        image = image[None, None]
    if image.ndim != 3 or image.shape[2] != 3 or image.size == 0:
        raise ValueError(f"environment map must have shape (h, w, 3), got {image.shape}")
    if not np.all(np.isfinite(image)) or image.min() < 0:
        raise ValueError("environment map must be finite and >= 0")
    if image.max() == 0:
        return None
    h, w, _ = image.shape
    y = _luminance_host(image)
    rows = np.pad(y, ((1, 1), (0, 0)), mode="edge")
    y = (rows[:-2] + rows[1:-1] + rows[2:]) / 3.0
    y = (np.roll(y, 1, axis=1) + y + np.roll(y, -1, axis=1)) / 3.0
    edges = np.cos(np.pi * np.arange(h + 1) / h)
    weight = y * (edges[:-1] - edges[1:])[:, None]
    probability = weight / weight.sum()
    row = probability.sum(axis=1)
    column = np.cumsum(probability, axis=1) / np.maximum(row, 1e-300)[:, None]
    angle = math.radians(rotation_degrees)
    cos, sin = math.cos(angle), math.sin(angle)
    world_from_map = np.array([[cos, 0.0, sin], [0.0, 1.0, 0.0], [-sin, 0.0, cos]])
    to32 = lambda x: jnp.asarray(x, jnp.float32)  # noqa: E731
    return EnvironmentLight(
        radiance=to32(image),
        map_from_world=to32(world_from_map.T),
        probability=to32(probability),
        row_cdf=to32(np.minimum(np.cumsum(row), 1.0)),
        column_cdf=to32(np.minimum(column, 1.0)),
    )


def _map_coordinates(environment, direction):
    """Continuous (row, column) of a direction towards the sky: row in [0, h], column in [0, w]."""
    h, w, _ = environment.radiance.shape
    local = direction @ environment.map_from_world.T
    horizontal = jnp.sqrt(local[..., 0] * local[..., 0] + local[..., 2] * local[..., 2])
    theta = jnp.arctan2(horizontal, local[..., 1])
    phi = jnp.arctan2(local[..., 0], -local[..., 2])
    column = phi * (w / (2.0 * math.pi))
    return theta * (h / math.pi), jnp.where(column < 0, column + w, column)


def environment_radiance(environment: EnvironmentLight, direction: Float[Array, "*b 3"]) -> Float[Array, "*b 3"]:
    """Radiance arriving from the sky in `direction` (pointing towards the sky), bilinear in the map."""
    h, w, _ = environment.radiance.shape
    if h == 1 and w == 1:
        return jnp.broadcast_to(environment.radiance[0, 0], direction.shape)
    row, column = _map_coordinates(environment, direction)
    row = jnp.clip(row - 0.5, 0.0, h - 1.0)
    column = column - 0.5
    r0 = jnp.minimum(row.astype(jnp.int32), max(h - 2, 0))
    c0 = jnp.floor(column).astype(jnp.int32)
    fr, fc = (row - r0)[..., None], (column - c0)[..., None]
    r1 = jnp.minimum(r0 + 1, h - 1)
    left, right = c0 % w, (c0 + 1) % w
    flat = environment.radiance.reshape(-1, 3)
    top = flat[r0 * w + left] * (1.0 - fc) + flat[r0 * w + right] * fc
    bottom = flat[r1 * w + left] * (1.0 - fc) + flat[r1 * w + right] * fc
    return top * (1.0 - fr) + bottom * fr


def sample_environment(
    environment: EnvironmentLight, u1: Float[Array, "*b"], u2: Float[Array, "*b"]
) -> tuple[Float[Array, "*b 3"], Float[Array, "*b"]]:
    """A direction towards the sky and its pdf, 1/sr: a cell of the map, uniform in solid angle inside it."""
    h, w, _ = environment.radiance.shape
    if h == 1 and w == 1:
        return sample_uniform_sphere(u1, u2), jnp.full(u1.shape, sample_uniform_sphere_pdf(), jnp.float32)
    row = sample_cdf(u1, environment.row_cdf)
    previous = jnp.where(row > 0, environment.row_cdf[row - 1], 0.0)
    fraction = jnp.clip((u1 - previous) / jnp.maximum(environment.row_cdf[row] - previous, 1e-30), 0.0, 1.0)
    column = _search_row(environment.column_cdf, row, u2)
    below = jnp.where(column > 0, environment.column_cdf[row, column - 1], 0.0)
    offset = jnp.clip((u2 - below) / jnp.maximum(environment.column_cdf[row, column] - below, 1e-30), 0.0, 1.0)
    top = jnp.cos(row * (math.pi / h))
    bottom = jnp.cos((row + 1) * (math.pi / h))
    cos_theta = jnp.clip(top + fraction * (bottom - top), -1.0, 1.0)
    sin_theta = jnp.sqrt((1.0 - cos_theta) * (1.0 + cos_theta))
    phi = (column + offset) * (2.0 * math.pi / w)
    local = jnp.stack([sin_theta * jnp.sin(phi), cos_theta, -sin_theta * jnp.cos(phi)], axis=-1)
    direction = local @ environment.map_from_world
    return direction, environment.probability[row, column] / _cell_solid_angle(h, w, row)


def _search_row(cdf, row, u):
    low = jnp.zeros_like(row)
    high = jnp.full_like(row, cdf.shape[1] - 1)
    for _ in range(max(cdf.shape[1] - 1, 1).bit_length()):
        middle = (low + high) // 2
        right = cdf[row, middle] <= u
        low = jnp.where(right, jnp.minimum(middle + 1, high), low)
        high = jnp.where(right, high, middle)
    return low


def _cell_solid_angle(h, w, row):
    half = 0.5 * math.pi / h
    # cos a - cos b = 2 sin((a + b) / 2) sin((b - a) / 2)
    return 2.0 * jnp.sin((2.0 * row + 1.0) * half) * math.sin(half) * (2.0 * math.pi / w)


def sample_environment_pdf(environment: EnvironmentLight, direction: Float[Array, "*b 3"]) -> Float[Array, "*b"]:
    """The density of `sample_environment`, 1/sr."""
    h, w, _ = environment.radiance.shape
    if h == 1 and w == 1:
        return jnp.full(direction.shape[:-1], sample_uniform_sphere_pdf(), jnp.float32)
    row, column = _map_coordinates(environment, direction)
    row = jnp.clip(row.astype(jnp.int32), 0, h - 1)
    column = jnp.clip(column.astype(jnp.int32), 0, w - 1)
    return environment.probability[row, column] / _cell_solid_angle(h, w, row)


def spot_falloff(spots: SpotLights, index: Int[Array, "*b"], travel: Float[Array, "*b 3"]) -> Float[Array, "*b"]:
    """Share of full intensity in a direction of travel: 1 inside `falloff`, 0 outside `cutoff`, linear in the angle."""
    axis = spots.direction[index]
    cross = jnp.cross(axis, travel)
    angle = jnp.arctan2(jnp.sqrt(jnp.maximum(dot(cross, cross), 1e-30)), dot(axis, travel))
    width = spots.cutoff[index] - spots.falloff[index]
    ramp = (spots.cutoff[index] - angle) / jnp.where(width > 0, width, 1.0)
    return jnp.where(width > 0, jnp.clip(ramp, 0.0, 1.0), (angle <= spots.cutoff[index]).astype(jnp.float32))


def num_each(scene: Scene) -> dict[str, int]:
    """How many choices each kind of light offers, in order of choice."""
    return {
        "point": 0 if scene.point_lights is None else scene.point_lights.position.shape[0],
        "spot": 0 if scene.spot_lights is None else scene.spot_lights.position.shape[0],
        "directional": 0 if scene.directional_lights is None else scene.directional_lights.direction.shape[0],
        "area": 0 if scene.area_lights is None else 1,
        "environment": 0 if scene.environment is None else 1,
    }


def num_lights(scene: Scene) -> int:
    """Number of choices `sample_light` has: all emissive triangles count one, the environment one."""
    return sum(num_each(scene).values())


def _point_like(position, origin, intensity, shading):
    """A sample towards `origin` of an isotropic emitter; shading(travel direction) scales the intensity."""
    delta = origin - position
    distance = jnp.sqrt(jnp.maximum(dot(delta, delta), 1e-28))
    inverse = 1.0 / distance  # the slope of 1 / distance^2 in one step would leave float32
    direction = delta * inverse[..., None]
    radiance = intensity * (shading(-direction) * inverse * inverse)[..., None]
    return direction, distance, radiance, jnp.ones_like(distance), jnp.ones(distance.shape, bool), origin


def _sample_area(scene, position, u1, u2, u3):
    lights, mesh = scene.area_lights, scene.mesh
    chosen = sample_cdf(u3, lights.cdf)
    face = lights.face[chosen]
    a, b, c = (mesh.vertices[mesh.faces[face, i]] for i in range(3))
    w1, w2 = sample_triangle(u1, u2)
    point = a + w1[..., None] * (b - a) + w2[..., None] * (c - a)
    normal = normalize(jnp.cross(b - a, c - a))
    delta = point - position
    squared = jnp.maximum(dot(delta, delta), 1e-28)
    distance = jnp.sqrt(squared)
    direction = delta / distance[..., None]
    cosine = -dot(normal, direction)
    emission = mesh.emission[face]
    density = luminance(emission) / lights.total
    front = cosine > 1e-6
    pdf = density * squared / jnp.where(front, cosine, 1.0)
    return direction, distance, jnp.where(front[..., None], emission, 0.0), pdf, jnp.zeros(distance.shape, bool), point


def sample_light(
    scene: Scene, position: Float[Array, "*b 3"], u1: Float[Array, "*b"], u2: Float[Array, "*b"], u3: Float[Array, "*b"]
) -> LightSample:
    """One direction from each position towards one light, chosen uniformly; needs `num_lights(scene) > 0`."""
    counts = num_each(scene)
    number = sum(counts.values())
    scaled = u3 * number
    choice = jnp.minimum(scaled.astype(jnp.int32), number - 1)
    rest = jnp.clip(scaled - choice, 1e-7, 1.0 - 1e-7)  # reusable as a uniform
    far = 1e30
    candidates = []
    first = 0
    for kind, count in counts.items():
        if count == 0:
            continue
        index = jnp.clip(choice - first, 0, count - 1)
        if kind == "point":
            lights = scene.point_lights
            found = _point_like(position, lights.position[index], lights.intensity[index], lambda w: jnp.ones_like(u1))
        elif kind == "spot":
            spots = scene.spot_lights
            found = _point_like(
                position, spots.position[index], spots.intensity[index], lambda w, s=spots, i=index: spot_falloff(s, i, w)
            )
        elif kind == "directional":
            suns = scene.directional_lights
            direction = -suns.direction[index]
            infinite = jnp.full(u1.shape, jnp.inf, jnp.float32)
            always = jnp.ones(u1.shape, bool)
            sky = position + far * direction
            found = (direction, infinite, suns.irradiance[index], jnp.ones_like(u1), always, sky)
        elif kind == "area":
            found = _sample_area(scene, position, u1, u2, rest)
        else:
            direction, pdf = sample_environment(scene.environment, u1, u2)
            radiance = environment_radiance(scene.environment, direction)
            infinite = jnp.full(u1.shape, jnp.inf, jnp.float32)
            found = (direction, infinite, radiance, pdf, jnp.zeros(u1.shape, bool), position + far * direction)
        candidates.append((first, count, found))
        first += count
    result = candidates[0][2]
    for begin, _, found in candidates[1:]:
        mine = choice >= begin
        result = tuple(
            jnp.where(mine[..., None] if new.ndim > mine.ndim else mine, new, old)
            for new, old in zip(found, result, strict=True)
        )
    direction, distance, radiance, pdf, delta, origin = result
    return LightSample(direction, distance, radiance, pdf / number, delta, origin)


def sample_light_pdf(
    scene: Scene,
    position: Float[Array, "*b 3"],
    direction: Float[Array, "*b 3"],
    face: Int[Array, "*b"],
    t: Float[Array, "*b"],
    normal: Float[Array, "*b 3"],
) -> Float[Array, "*b"]:
    """The density (1/sr) with which `sample_light` finds `direction` when a ray from `position` hits `face` (-1: the sky).

    t and normal belong to the hit. Delta lights never count.
    """
    number = max(num_lights(scene), 1)
    pdf = jnp.zeros(t.shape, jnp.float32)
    if scene.environment is not None:
        pdf = jnp.where(face < 0, sample_environment_pdf(scene.environment, direction), pdf)
    if scene.area_lights is not None:
        cosine = -dot(normal, direction)
        density = luminance(scene.mesh.emission[jnp.maximum(face, 0)]) / scene.area_lights.total
        safe_t = jnp.where(face >= 0, t, 1.0)
        area = density * safe_t * safe_t / jnp.where(cosine > 1e-6, cosine, 1.0)
        pdf = jnp.where((face >= 0) & (cosine > 1e-6), area, pdf)
    return pdf / number


def emitted_radiance(
    mesh: Mesh, face: Int[Array, "*b"], normal: Float[Array, "*b 3"], direction: Float[Array, "*b 3"]
) -> Float[Array, "*b 3"]:
    """Radiance that a face emits against the travel `direction` of an eye ray: on its front side only."""
    shape = direction.shape
    if mesh.emission is None:
        return jnp.zeros(shape, jnp.float32)
    visible = (face >= 0) & (dot(normal, direction) < -1e-6)
    return jnp.where(visible[..., None], mesh.emission[jnp.maximum(face, 0)], 0.0)
