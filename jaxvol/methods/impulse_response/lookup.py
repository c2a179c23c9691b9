"""Stage 1, lookup: the tables resampled for one medium, then one interpolation per query (sections 4.3 to 4.5).

`prepare` contracts the Chebyshev tables for a medium's albedo, g and phase moments, channel by channel, onto grids that are
uniform in tau^(1/4) and, for area emitters, in sign(pi/2 - theta_n) |theta_n / (pi/2) - 1|^(1/2): the variables in which the
tables are smooth. A query interpolates linearly and puts the exponentials back; inside random paths it may instead take one
node, drawn with the weights of the interpolation, which has the same mean for a quarter of the cost. With tau the optical
thickness of the segment and d its length, the effective sigma_t is tau / d (section 4.4: the mean along the segment),
sigma_s = albedo tau / d:

    point, area:  L_l = albedo tau / d^2 { e^-tau S_l(tau) + albedo tau G_l(tau) }     for I0 = 1 or Le dA = 1
    directional:  L_l = albedo e^-tau S_l(tau) + albedo^2 G_l(tau)                     for E0 = 1

S is light scattered once, G twice or more; directly attenuated light is not in them. Coefficients are of radiance as a
function of the direction toward the light, about the axis receiver -> source.
"""

from functools import partial
from math import pi

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxvol import fast_math, media, phase, zonal_lookup
from jaxvol.types import Medium

Pick = tuple[Float[Array, "*b"], Float[Array, "*b"]]


class ResponseGrid(eqx.Module):
    """One emitter's response in one channel; emitters without an angle have one node of it."""

    rows: Float[Array, "tau angle sets"]  # S, and behind it G e^{kappa tau} where light is scattered more than once
    kappa: Float[Array, ""] | None  # slowest decay of G per unit of tau
    quarter_max: Float[Array, ""]  # tau^(1/4) at the last node
    multiple_max: Float[Array, ""]  # tau beyond which G is an exponential


class Responses(eqx.Module):
    """What a medium answers to each kind of emitter; one entry per channel, or a single one for a grey medium."""

    point: tuple[ResponseGrid, ...]
    directional: tuple[ResponseGrid, ...]
    area: tuple[ResponseGrid, ...]
    albedo: Float[Array, "3"]  # single-scattering albedo
    transport: Float[Array, "3"]  # sigma_t' / sigma_t = 1 - albedo g
    returned: Float[Array, "3"]  # albedo / 2 p(pi), 1/sr: what a beam of unit irradiance sends back to where it starts


def prepare(
    tables: zonal_lookup.ZonalTables,
    medium: Medium,
    *,
    grey: bool,
    multiple: bool,
    similarity: bool = False,
    g_range: float | None = None,
    num_tau: int = 192,
    num_angle: int = 33,
) -> Responses:
    """Resample the tables for a medium's phase function and albedo; `grey` shares one channel among three.

    `similarity` and `g_range` are the paper's modes (`zonal_lookup.medium_response`). Linear interpolation costs at most
    4e-4 of band 0 with the default nodes (tests/methods/impulse_response). Raises ValueError where the tables lack an emitter
    or, with `multiple`, the infinite sum.
    """
    for kind in ("point", "directional", "area"):
        table = getattr(tables, kind)
        if table is None:
            raise ValueError(f"the table file lacks the emitter {kind!r}; baking needs point, directional and area")
        if multiple and table.multiple is None:
            raise ValueError(f"the table file has no multiple scattering of {kind!r}; set scattering = 'single'")
    mode = "similarity" if similarity else "table"
    albedo, moments, g, constants = _constants(medium)
    numbers = {"moments": moments, "g": g, "g_range": g_range}
    shapes = {"mode": mode, "multiple": multiple, "num_tau": num_tau}
    grids = {}
    for kind in ("point", "directional", "area"):
        shapes["num_angle"] = num_angle if kind == "area" else 1
        # Channel by channel: grey media and others share the program.
        grids[kind] = tuple(_grid(tables, kind, albedo=albedo[i], **numbers, **shapes) for i in range(1 if grey else 3))
    return Responses(**grids, **constants)


@jax.jit
def _constants(medium):
    """Albedo of each channel, moments and mean cosine of the phase function, and what needs no table."""
    albedo = media.single_scattering_albedo(medium)
    moments = None if medium.phase is None else medium.phase.moments
    g = medium.g if medium.phase is None else medium.phase.moments[1]
    returned = 0.5 * albedo * phase.evaluate(medium, jnp.float32(-1.0))
    constants = {"albedo": albedo, "transport": 1 - albedo * g, "returned": returned}
    return tuple(albedo), moments, g, constants


@partial(jax.jit, static_argnames=("kind", "mode", "multiple", "num_tau", "num_angle"))
def _grid(tables, kind, *, moments, g, albedo, g_range, mode, multiple, num_tau, num_angle):
    response = zonal_lookup.medium_response(tables, kind, moments=moments, g=g, albedo=albedo, g_range=g_range, multiple=mode)
    dtype = response.single.dtype
    last = jnp.sqrt(jnp.sqrt(response.single_range[1]))
    quarter = jnp.linspace(0, 1, num_tau, dtype=dtype) * last
    tau = quarter * quarter * quarter * quarter
    if kind == "area":
        v = jnp.linspace(-1, 1, num_angle, dtype=dtype)
        theta = pi / 2 * (1 - jnp.sign(v) * v * v)
        # The table is two-sided at pi/2, where both series hold the same value: any side will do.
        tau, theta = jnp.broadcast_arrays(tau[:, None], theta[None, :])
        once = zonal_lookup.scaled_single(response, tau, theta_n=theta)
    else:
        tau, theta = tau[:, None], None
        once = zonal_lookup.scaled_single(response, tau)
    if not multiple:
        return ResponseGrid(once, None, last, response.single_range[1])
    scale = 1.0 if response.tau_scale is None else response.tau_scale  # the similar medium's tau per tau
    limit, kappa = response.multiple_range[1] / scale, response.kappa * scale
    more = zonal_lookup.scaled_multiple(response, jnp.minimum(tau, limit), theta_n=theta)
    more = more * jnp.exp(kappa * jnp.minimum(tau, limit))[..., None]
    return ResponseGrid(jnp.concatenate([once, more], axis=-1), kappa, last, limit)


def _nodes(grid: ResponseGrid, tau, angle, pick):
    """Flat indices and weights of the two or four nodes about a query; with `pick` one of them, drawn by its weight."""
    num_tau, num_angle, _ = grid.rows.shape
    positive = tau > 1e-12
    quarter = jnp.where(positive, jnp.sqrt(jnp.sqrt(jnp.where(positive, tau, 1))), 0)
    x = jnp.minimum(quarter / grid.quarter_max, 1) * (num_tau - 1)
    i = jnp.clip(x.astype(jnp.int32), 0, num_tau - 2)
    f = x - i
    if pick is not None:
        i = i + (pick[0] < f)
    if num_angle == 1:
        return ((i, 1),) if pick is not None else ((i, 1 - f), (i + 1, f))
    y = jnp.clip(angle * 0.5 + 0.5, 0, 1) * (num_angle - 1)
    j = jnp.clip(y.astype(jnp.int32), 0, num_angle - 2)
    h = y - j
    row = i * num_angle + j
    if pick is not None:
        return ((row + (pick[1] < h), 1),)
    return (
        (row, (1 - f) * (1 - h)),
        (row + 1, (1 - f) * h),
        (row + num_angle, f * (1 - h)),
        (row + num_angle + 1, f * h),
    )


def _interpolate(grid, nodes):
    """(S, G e^{kappa tau} or None) at the nodes."""
    flat = grid.rows.reshape(-1, grid.rows.shape[-1])
    found = [flat[index] if isinstance(weight, int) else flat[index] * weight[..., None] for index, weight in nodes]
    values = sum(found[1:], found[0])
    if grid.kappa is None:
        return values, None
    bands = values.shape[-1] // 2
    return values[..., :bands], values[..., bands:]


def angle_variable(cos_n: Float[Array, "*b"]) -> Float[Array, "*b"]:
    """The grid's variable of the angle between a patch's normal and the way to the receiver: 1 facing, 0 edge-on, -1 behind."""
    size = jnp.abs(cos_n)
    aside = size < 1  # the arccosine's slope is infinite at 1, where responses, even in the angle, are level
    off = 1 - jnp.where(aside, fast_math.arccos_unit(jnp.where(aside, size, 0)), 0) * (2 / pi)
    far = off > 1e-6
    return jnp.where(far, jnp.sign(cos_n) * jnp.sqrt(jnp.where(far, off, 1)), 0)


def compact_source(
    grids: tuple[ResponseGrid, ...],
    albedo: Float[Array, "3"],
    tau: Float[Array, "*b 3"],
    distance: Float[Array, "*b 3"],
    cos_n: Float[Array, "*b 3"] | None,
    *,
    pick: Pick | None = None,
) -> tuple[Float[Array, "*b C bands"], Float[Array, "*b C bands"] | None]:
    """Incident radiance of a point (cos_n None) or patch with I0 or Le dA = 1: (scattered once, twice or more or None).

    Per channel C of the grids. tau is the optical thickness of the segment, distance > 0 its length (which image sources make
    another one in each channel), `pick` random numbers that choose a single node. Beyond the table's tau the response falls
    like e^{-kappa tau} / tau.
    """
    once, more = [], []
    for channel, grid in enumerate(grids):
        t, d = tau[..., channel], distance[..., channel]
        nodes = _nodes(grid, t, None if cos_n is None else angle_variable(cos_n[..., channel]), pick)
        first, rest = _interpolate(grid, nodes)
        scale = albedo[channel] * t / (d * d)
        table_end = grid.quarter_max * grid.quarter_max * grid.quarter_max * grid.quarter_max
        spread = jnp.minimum(1, table_end / jnp.maximum(t, 1e-12))
        once.append((scale * spread * jnp.exp(-t))[..., None] * first)
        if rest is not None:
            past = jnp.minimum(1, grid.multiple_max / jnp.maximum(t, 1e-12))
            factor = scale * albedo[channel] * t * past * jnp.exp(-grid.kappa * t)
            more.append(factor[..., None] * rest)
    return jnp.stack(once, axis=-2), jnp.stack(more, axis=-2) if more else None


def directional_source(
    grids: tuple[ResponseGrid, ...], albedo: Float[Array, "3"], tau: Float[Array, "*b 3"], *, pick: Pick | None = None
) -> tuple[Float[Array, "*b C bands"], Float[Array, "*b C bands"] | None]:
    """Incident radiance of a directional light of irradiance 1 at optical depth tau of a half-space lit straight down."""
    once, more = [], []
    for channel, grid in enumerate(grids):
        t = tau[..., channel]
        first, rest = _interpolate(grid, _nodes(grid, t, None, pick))
        once.append((albedo[channel] * jnp.exp(-t))[..., None] * first)
        if rest is not None:
            factor = albedo[channel] * albedo[channel] * jnp.exp(-grid.kappa * t)
            more.append(factor[..., None] * rest)
    return jnp.stack(once, axis=-2), jnp.stack(more, axis=-2) if more else None
