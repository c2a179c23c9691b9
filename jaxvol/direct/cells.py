"""An eye ray through the medium cut into cells of constant density, and nodes on it where lights are asked for.

Within a cell transmittance falls exponentially and everything about it is exact; what comes from outside the cell (light,
phase function, visibility) is evaluated at nodes. Nodes have a density proportional to scattered light as far as the
cells know it: scattering times transmittance, times 1/d^2 for a light at a point (equi-angular within each cell).
Pixels are in the lanes, cells along the first axis.
"""

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

from jaxvol import extinction, fast_math, media
from jaxvol.extinction import MarchingMedium
from jaxvol.sampling import dot, sample_truncated_exponential, sample_truncated_exponential_pdf

_DEEP = 30.0  # optical thickness beyond which the eye sees nothing, in the clearest channel


class Cells(eqx.Module):
    """Cells along rays. Everything about a region's medium is linear in its density, kept as a column per region."""

    t: Float[Array, "M+1 n"]  # borders, nondecreasing
    density: Float[Array, "M n"]  # of the region that owns the cell, at its middle
    region: Int[Array, "M n"] | None  # owner, -1 = vacuum; None: the medium is one box
    column: tuple[Float[Array, "M+1 n"], ...]  # per region: integral of its density up to each border
    importance: Float[Array, "M n"]  # sigma_s times transmittance, mean over the cell and over channels


class Nodes(eqx.Module):
    """Points on eye rays, with the estimator's weight: light scattered to the eye = sum of weight * phase * light."""

    t: Float[Array, "N n"]
    region: Int[Array, "N n"] | None
    weight: Float[Array, "N n 3"]  # sigma_s T / (N pdf)


def box_borders(
    marching: MarchingMedium, t0: Float[Array, "n"], t1: Float[Array, "n"], num_cells: int
) -> Float[Array, "M+1 n"]:
    """Borders of cells in [t0, t1]: equal with a grid; without, growing from t0 on as fast as the medium is thick."""
    medium = marching.regions[0]
    u = jnp.linspace(0.0, 1.0, num_cells + 1)[:, None]
    length = jnp.maximum(t1 - t0, 0.0)
    if medium.density is not None:
        return t0 + u * length
    sigma_t = media.sigma_t(medium)
    length = jnp.minimum(length, _DEEP / jnp.maximum(jnp.min(sigma_t), 1e-30))
    growth = jnp.log1p(jnp.max(sigma_t) * length * 0.125)  # first cell: optical thickness below about one
    safe = jnp.maximum(growth, 1e-3)
    share = jnp.where(growth > 1e-3, jnp.expm1(u * safe) / jnp.expm1(safe), u)
    return t0 + share * length


def build(
    marching: MarchingMedium,
    origin: Float[Array, "n 3"],
    direction: Float[Array, "n 3"],
    borders: Float[Array, "M+1 n"],
    region: Int[Array, "M n"] | None,
) -> Cells:
    """Density, columns and importance of the cells between borders; one lookup a cell."""
    low, high = borders[:-1], borders[1:]
    num_regions = len(marching.regions)
    sigma_t = [media.sigma_t(m) for m in marching.regions]
    zero = jnp.zeros_like(low[0])

    def body(columns, cell):
        begin, end, owner = cell
        points = origin + (0.5 * (begin + end))[:, None] * direction
        length = end - begin
        density, scattering, rate, depth = zero, [zero] * 3, [zero] * 3, [zero] * 3
        passed = []
        for r, medium in enumerate(marching.regions):
            owned = True if owner is None else owner == r
            if medium.density is None:
                value = jnp.where(owned, 1.0, zero)
            else:
                value = jnp.where(owned, extinction.region_density(marching, r, points), 0.0)
            density = density + value
            passed.append(columns[r] + value * length)
            for c in range(3):
                scattering[c] = scattering[c] + value * medium.sigma_s[c]
                rate[c] = rate[c] + value * sigma_t[r][c]
                depth[c] = depth[c] + columns[r] * sigma_t[r][c]
        importance = sum(s * jnp.exp(-d) * _mean_exp(k * length) for s, k, d in zip(scattering, rate, depth, strict=True)) / 3.0
        return tuple(passed), (density, importance, tuple(passed))

    empty = tuple(zero for _ in range(num_regions))
    _, (density, importance, passed) = lax.scan(body, empty, (low, high, region))
    column = tuple(jnp.concatenate([zero[None], p]) for p in passed)
    return Cells(t=borders, density=density, region=region, column=column, importance=importance)


def _mean_exp(x):
    """(1 - exp(-x)) / x."""
    small = x < 1e-3
    return jnp.where(small, 1.0 - 0.5 * x, -jnp.expm1(-x) / jnp.where(small, 1.0, x))


def _angle(y, x):
    """atan2 for y >= 0, in (0, pi)."""
    width = jnp.abs(x)
    value = fast_math.atan_unit(jnp.minimum(y, width) / jnp.maximum(jnp.maximum(y, width), 1e-30))
    value = jnp.where(y > width, 0.5 * jnp.pi - value, value)
    return jnp.where(x >= 0, value, jnp.pi - value)


def transmittance(
    marching: MarchingMedium, column: tuple[Float[Array, "*b"], ...]
) -> tuple[Float[Array, "*b"], Float[Array, "*b"], Float[Array, "*b"]]:
    """exp(-sum of columns times sigma_t), one array per channel."""
    depth = [sum(c * media.sigma_t(m)[k] for c, m in zip(column, marching.regions, strict=True)) for k in range(3)]
    return tuple(jnp.exp(-d) for d in depth)


def place(
    marching: MarchingMedium,
    cells: Cells,
    u: Float[Array, "N n"],
    *,
    origin: Float[Array, "n 3"] | None = None,
    direction: Float[Array, "n 3"] | None = None,
    point: Float[Array, "n 3"] | None = None,
    interval: tuple[Float[Array, "n"], Float[Array, "n"]] | None = None,
    brightness: Float[Array, "M n"] | None = None,
) -> Nodes:
    """Nodes at the quantiles u of the importance, over `interval` where given.

    With a `point` (then `origin` and `direction` too) the density also falls as 1/distance^2 from it; `brightness` multiplies
    the importance of the cells by what is known of a light. Each node's weight is
    sigma_s T / (N pdf) with the transmittance AT the node, so the sum is right for any density of nodes.
    """
    low, high = cells.t[:-1], cells.t[1:]
    if interval is not None:
        low, high = (jnp.clip(x, interval[0], jnp.maximum(*interval)) for x in (low, high))
    if point is None:
        spread = high - low
    else:
        closest, distance = _closest_approach(origin, direction, point)
        angle = _angle(distance * (high - low), distance * distance + (low - closest) * (high - closest))
        spread = jnp.where(high > low, angle, 0.0) / distance
    density = cells.importance * spread if brightness is None else cells.importance * brightness * spread
    total, cumulative = lax.scan(lambda c, w: (c + w, c + w), jnp.zeros_like(density[0]), density)
    num_cells, n = density.shape
    target = u * total
    index = _search(cumulative, target)
    lane = jnp.broadcast_to(jnp.arange(n, dtype=jnp.int32), index.shape)
    at = index * n + lane

    def pick(x):
        return x.reshape(-1)[at]

    share, end, width = pick(density), pick(cumulative), pick(spread)
    begin, finish, cell_begin, rho = pick(low), pick(high), pick(cells.t[:-1]), pick(cells.density)
    there = share > 0
    share = jnp.where(there, share, 1.0)
    v = jnp.clip(1.0 - (end - target) / share, 0.0, 1.0)
    region = None if cells.region is None else pick(cells.region)
    owner = [None if region is None else region == r for r in range(len(marching.regions))]
    if point is None:
        rate = _owned(owner, rho, [jnp.mean(media.sigma_t(m)) for m in marching.regions])
        inside = sample_truncated_exponential(v, rate, finish - begin)
        t = begin + inside
        inverse_pdf = 1.0 / jnp.maximum(sample_truncated_exponential_pdf(inside, rate, finish - begin), 1e-37)
    else:
        t = jnp.clip(closest + _from_angle(v * width * distance, begin - closest, distance), begin, finish)
        inverse_pdf = width * (distance * distance + (t - closest) * (t - closest))
    # 1 / pdf(t) = total / share * 1 / pdf(t in the cell)
    scale = jnp.where(there, total / share * inverse_pdf, 0.0) * (rho / u.shape[0])
    columns = tuple(
        pick(c[:-1]) + (rho * (t - cell_begin) if o is None else jnp.where(o, rho * (t - cell_begin), 0.0))
        for c, o in zip(cells.column, owner, strict=True)
    )
    through = transmittance(marching, columns)
    scattering = [_owned(owner, scale, [m.sigma_s[k] for m in marching.regions]) for k in range(3)]
    return Nodes(t=t, region=region, weight=jnp.stack([s * x for s, x in zip(scattering, through, strict=True)], axis=-1))


def _owned(owner, value, factors):
    """value times the factor of the region that owns each node."""
    if owner[0] is None:
        return value * factors[0]
    return sum(jnp.where(o, value * f, 0.0) for o, f in zip(owner, factors, strict=True))


def _closest_approach(origin, direction, point):
    delta = point - origin
    t = dot(delta, direction)
    perpendicular = delta - t[:, None] * direction
    # No nearer than a millionth of the way, whatever the unit of length.
    return t, jnp.sqrt(jnp.maximum(dot(perpendicular, perpendicular), 1e-12 * dot(delta, delta) + 1e-30))


def _from_angle(angle, x, distance):
    """Distance tan(atan(x / distance) + angle) without an arctangent; the sum stays below pi/2."""
    sin_half, cos_half = fast_math.sin_cos(0.5 * angle)
    sine, cosine = 2.0 * sin_half * cos_half, 1.0 - 2.0 * sin_half * sin_half
    below = distance * cosine - x * sine
    return distance * (x * cosine + distance * sine) / jnp.where(below > 0, below, 1e-30)


def _search(cumulative, target):
    """The first index along axis 0 whose cumulative value exceeds the target, per lane, by halving."""
    num, n = cumulative.shape
    flat = cumulative.reshape(-1)
    lane = jnp.arange(n, dtype=jnp.int32)
    low = jnp.zeros(target.shape, jnp.int32)
    high = jnp.full(target.shape, num - 1, jnp.int32)
    for _ in range((num - 1).bit_length()):
        middle = (low + high) // 2
        right = flat[middle * n + lane] <= target
        low = jnp.where(right, jnp.minimum(middle + 1, high), low)
        high = jnp.where(right, high, middle)
    return low
