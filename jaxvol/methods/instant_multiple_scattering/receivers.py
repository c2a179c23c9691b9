"""What gathers light: eye rays inside the medium, and points in the medium or on surfaces."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from jaxvol import materials, media, ray_casting, sampling
from jaxvol.types import Medium, Mesh, Scene

_LEAST = 1e-18  # of denominators: the square of its inverse, which their slopes hold, stays within float32

class Segments(eqx.Module):
    """Pieces of eye rays inside the medium; t0 >= t1 where a ray misses it. Directions point away from the eye."""

    origin: Float[Array, "n 3"]
    direction: Float[Array, "n 3"]
    t0: Float[Array, "n"]
    t1: Float[Array, "n"]
    clamp: Float[Array, ""] | None  # least clamp distance along the rays; None = unclamped
    column: Float[Array, "s n"] | None = None  # of density from t0 to the ends of s equal steps; None = homogeneous


class Points(eqx.Module):
    """Points that scatter light towards `outgoing`; surface fields are None in a scene without surfaces."""

    position: Float[Array, "n 3"]
    outgoing: Float[Array, "n 3"]  # unit, of travel
    scattering: Float[Array, "n 3"]  # sigma_s there; 0 outside the medium and on surfaces
    clamp: Float[Array, "n"] | None  # clamp distance; None = unclamped
    on_surface: Bool[Array, "n"] | None = None
    normal: Float[Array, "n 3"] | None = None
    surface: materials.Surface | None = None


def with_clamp(points: Points, clamp: Float[Array, "n"] | None) -> Points:
    """The same points with another clamp distance."""
    return Points(
        points.position,
        points.outgoing,
        points.scattering,
        clamp,
        points.on_surface,
        points.normal,
        points.surface,
    )


@jax.jit
def lifted(scene: Scene, points: Points) -> Float[Array, "n 3"]:
    """Points, those on surfaces moved off them to the side of `outgoing`."""
    if points.on_surface is None:
        return points.position
    moved = ray_casting.offset_origin(
        points.position, points.normal, points.outgoing, scale=ray_casting.scene_scale(scene.mesh)
    )
    return jnp.where(points.on_surface[:, None], moved, points.position)


def column_between(medium: Medium, a: Float[Array, "*n 3"], b: Float[Array, "*n 3"], *, num_steps: int) -> Float[Array, "*n"]:
    """Integral of density from a to b: the midpoint rule over the part inside the bounds, closed form without a grid."""
    delta = b - a
    length = jnp.sqrt(jnp.maximum(sampling.dot(delta, delta), 1e-30))
    direction = delta / length[..., None]
    t0, t1 = media.box_interval(medium.bounds, a, direction)
    span = jnp.maximum(jnp.minimum(t1, length) - t0, 0.0)
    if medium.density is None:
        return span
    h = span / num_steps

    def body(i, total):
        t = t0 + (i + 0.5) * h
        return total + media.density(medium, a + t[..., None] * direction)

    return h * lax.fori_loop(0, num_steps, body, jnp.zeros_like(length))


def columns_along(segments: Segments, medium: Medium, *, num_steps: int) -> Float[Array, "s n"]:
    """Column of density from t0 to the end of each of `num_steps` equal steps of every eye ray (midpoint rule)."""
    h = jnp.maximum(segments.t1 - segments.t0, 0.0) / num_steps

    def body(total, i):
        t = segments.t0 + (i + 0.5) * h
        total = total + h * media.density(medium, segments.origin + t[:, None] * segments.direction)
        return total, total

    return lax.scan(body, jnp.zeros_like(h), jnp.arange(num_steps))[1]


def column_at(segments: Segments, t: Float[Array, "*k n"]) -> Float[Array, "*k n"]:
    """Column of density from t0 to t along each ray: linear in the table; t - t0 without a grid."""
    if segments.column is None:
        return jnp.maximum(t - segments.t0, 0.0)
    step, fraction = _step_of(segments, t)
    lanes = jnp.arange(segments.t0.shape[0])
    after = segments.column[step, lanes]
    before = jnp.where(step > 0, segments.column[jnp.maximum(step - 1, 0), lanes], 0.0)
    return before + fraction * (after - before)


def _step_of(segments, t):
    """Step of the table that holds t, and the position in it."""
    number = segments.column.shape[0]
    length = jnp.maximum(segments.t1 - segments.t0, _LEAST)
    x = jnp.clip((t - segments.t0) / length, 0.0, 1.0) * number
    step = jnp.minimum(x.astype(jnp.int32), number - 1)
    return step, jnp.clip(x - step, 0.0, 1.0)


def sample_transmittance(
    segments: Segments, u: Float[Array, "n"], sigma: Float[Array, ""]
) -> tuple[Float[Array, "n"], Float[Array, "n"]]:
    """A distance with pdf proportional to the source's weight density(t) exp(-sigma column(t)), and 1 / pdf without density.

    Returns (t, w) with w = integral of density exp(-sigma column) dt / exp(-sigma column(t)): an estimate of an integral
    of density * f over the ray is w * f(t). In a table, pdf is that of its steps.
    """
    length = jnp.maximum(segments.t1 - segments.t0, 0.0)
    if segments.column is None:
        offset = sampling.sample_truncated_exponential(u, sigma, length)
        pdf = sampling.sample_truncated_exponential_pdf(offset, sigma, length)
        return segments.t0 + offset, jnp.where(length > 0, 1.0 / jnp.maximum(pdf, _LEAST), 0.0)
    total = segments.column[-1]
    column = sampling.sample_truncated_exponential(u, sigma, total)
    inverse = 1.0 / jnp.maximum(sampling.sample_truncated_exponential_pdf(column, sigma, total), _LEAST)
    number = segments.column.shape[0]
    step = jnp.minimum(jnp.sum(segments.column < column, axis=0), number - 1)
    lanes = jnp.arange(total.shape[0])
    after = segments.column[step, lanes]
    before = jnp.where(step > 0, segments.column[jnp.maximum(step - 1, 0), lanes], 0.0)
    fraction = (column - before) / jnp.maximum(after - before, _LEAST)
    t = segments.t0 + (step + jnp.clip(fraction, 0.0, 1.0)) * (length / number)
    return t, jnp.where(total > 0, inverse, 0.0)


def sample_transmittance_or_light(
    segments: Segments,
    u: Float[Array, "n"],
    to_light: Bool[Array, "n"],
    sigma: Float[Array, ""],
    light: Float[Array, "n 3"],
    near: Bool[Array, "n"],
) -> tuple[Float[Array, "n"], Float[Array, "n"]]:
    """`sample_transmittance`, half of it replaced by equi-angular distances where the light is `near` (balance heuristic).

    `to_light` says which half, at random or in turn. Without it a light in the medium makes single rays that pass it very
    bright. Returns (t, w) as `sample_transmittance` does.
    """
    t, w = sample_transmittance(segments, u, sigma)
    place = jnp.where(near[:, None], light, segments.origin)
    ray = (segments.origin, segments.direction, segments.t0, segments.t1, place)
    t_light, _ = sampling.sample_equiangular(u, *ray)
    chosen = jnp.where(near & to_light, t_light, t)
    pdf = sampling.sample_equiangular_pdf(chosen, *ray)
    density, by_column, filled = _density_and_pdf(segments, chosen, sigma)
    # Not by way of 1 / pdf, which is inf where a light is behind an optical thickness of hundreds, with a slope of NaN.
    mixed = density / jnp.where(filled, jnp.maximum(0.5 * density * by_column + 0.5 * pdf, _LEAST), 1.0)
    return chosen, jnp.where(near, jnp.where(filled, mixed, 0.0), w)


def _density_and_pdf(segments, t, sigma):
    """Density of the table's step at t, the pdf of `sample_transmittance` at t over it, and whether there is any medium."""
    if segments.column is None:
        length = jnp.maximum(segments.t1 - segments.t0, 0.0)
        pdf = sampling.sample_truncated_exponential_pdf(t - segments.t0, sigma, length)
        return jnp.ones_like(t), pdf, length > 0
    total = segments.column[-1]
    pdf = sampling.sample_truncated_exponential_pdf(column_at(segments, t), sigma, total)
    step, _ = _step_of(segments, t)
    lanes = jnp.arange(total.shape[0])
    before = jnp.where(step > 0, segments.column[jnp.maximum(step - 1, 0), lanes], 0.0)
    length = jnp.maximum(segments.t1 - segments.t0, _LEAST)
    density = (segments.column[step, lanes] - before) * (segments.column.shape[0] / length)
    return density, pdf, total > 0


def no_surface(mesh: Mesh, n: int) -> materials.Surface:
    """Black material for points that are not on a surface, in the structure that the mesh's materials have."""
    black = jnp.zeros((n, 3), jnp.float32)
    if mesh.specular is None:
        return materials.Surface(albedo=black)
    return materials.Surface(albedo=black, specular=black, exponent=jnp.ones((n,), jnp.float32))
