"""Evaluate impulse-response tables: pure, jittable, float32 or float64, at any tau from 0 upward.

A medium's response is a Chebyshev series in tau^(1/4) (responses start like tau ln tau and end like e^{-kappa tau}). For area
emitters it also depends on the angle theta_n of their normal: scattered once, a Chebyshev series in |theta_n - pi/2|^(1/2) on
either side of pi/2, where it is not smooth; scattered more often, a sum over moments k of the patch's emission times
y_km(theta_n). Tables of the infinite sum have two more axes, sqrt(1 - albedo) and
artanh(g), which `medium_response` contracts once per medium; after that a lookup is a few dozen multiply-adds.

With d the distance, tau = sigma_t d, for unit intensity I0, irradiance E0 or Le dA (sigma-ratio of section 4.3, exact):

    scattered once               point, area: (sigma_s / d) e^-tau S(tau)          directional: albedo e^-tau S(tau)
    scattered twice or more      point, area: sigma_s^2 G(tau)                     directional: albedo^2 G(tau)
    scattered exactly n times    point, area: sigma_s^2 albedo^{n-2} F_n(tau)      directional: albedo^n F_n(tau)

S is stored for every phase moment; G and F_n as (ln G_0, G_1/G_0, ...). Coefficients describe incident radiance as a function
of the direction toward the light about the axis receiver -> source: zonal, or mirror symmetric (m >= 0) for area
emitters, whose normal leans to +x. Directly attenuated light is not in the tables: `direct_point`, `direct_directional`.
Beyond the largest tau the responses are continued as e^{-kappa tau}/tau; below the smallest they are held.

The paper's own approximations are modes of `medium_response`: three values of g for single scattering (section 4.5) and
similarity theory, an isotropic medium with sigma_s' = (1 - g) sigma_s, for all further scattering (section 5.1).
"""

from math import pi, sqrt

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxvol import harmonics

ALBEDO_FLOOR = 1e-8  # of 1 - albedo: at albedo 1 the infinite sum has an infinite derivative


class EmitterTable(eqx.Module):
    """Chebyshev coefficients of one kind of emitter; `bands` = order, or half(order) for area emitters.

    Other emitters than area have neither sides (of theta_n = pi/2) nor angles nor sources (moments of emission): 1 of each.
    """

    single: Float[Array, "tau sides angle bands moments"]
    single_range: Float[Array, "2"]  # of tau
    multiple: Float[Array, "tau sources albedo g bands"] | None = None
    multiple_range: Float[Array, "2"] | None = None  # of tau
    bounces: Float[Array, "g bounce tau sources bands"] | None = None  # n = 2, 3, ...; same tau range as `multiple`


class ZonalTables(eqx.Module):
    """Everything that a table file holds for lookups; an emitter that was not tabulated is None."""

    point: EmitterTable | None = None
    directional: EmitterTable | None = None
    area: EmitterTable | None = None
    albedo_range: Float[Array, "2"] | None = None  # of sqrt(1 - albedo)
    g_range: Float[Array, "2"] | None = None  # of artanh(g)
    kappa: Float[Array, "albedo g"] | None = None  # diffusion root
    bounce_g: tuple[float, ...] = eqx.field(static=True, default=())
    source_bands: tuple[int, ...] = eqx.field(static=True, default=(0,))  # k of the area emitter's `sources` axis


class MediumResponse(eqx.Module):
    """One emitter's table contracted for one medium: `single` for its moments, `multiple` for its albedo and g."""

    single: Float[Array, "tau sides angle bands"]
    single_range: Float[Array, "2"]
    multiple: Float[Array, "tau sources bands"] | None
    multiple_range: Float[Array, "2"] | None
    kappa: Float[Array, ""] | None
    source_bands: tuple[int, ...] = eqx.field(static=True, default=(0,))
    tau_scale: Float[Array, ""] | None = None  # similarity: sigma_t' / sigma_t, the tau of `multiple` per tau


def moments_of_g(g: Float[Array, "*batch"], num: int) -> Float[Array, "*batch num"]:
    """Henyey-Greenstein moments g^j by products, so that the gradient at g = 0 is right."""
    values = [jnp.ones_like(g)]
    for _ in range(1, num):
        values.append(values[-1] * g)
    return jnp.stack(values, axis=-1)


def moments_of_three_g(g: Float[Array, ""], g_range: Float[Array, ""], num: int) -> Float[Array, "num"]:
    """Moments that equal linear interpolation between tables at -g_range, 0 and g_range (section 4.5).

    Beyond the range it extrapolates. `jaxvol.fit.phase_moments.three_g` is the same in numpy.
    """
    share = jnp.abs(g) / g_range
    ends = moments_of_g(jnp.where(g < 0, -g_range, g_range), num)
    return share * ends + (1 - share) * moments_of_g(jnp.zeros_like(g), num)


def similarity(
    albedo: Float[Array, "*batch"], g: Float[Array, "*batch"]
) -> tuple[Float[Array, "*batch"], Float[Array, "*batch"]]:
    """(albedo', sigma_t' / sigma_t) of the isotropic medium with sigma_s' = (1 - g) sigma_s and the same absorption."""
    ratio = 1 - albedo * g
    return (1 - g) * albedo / ratio, ratio


def chebyshev_basis(x: Float[Array, "*batch"], num: int) -> Float[Array, "*batch num"]:
    """T_0..T_{num-1} at x in [-1, 1]."""
    values = [jnp.ones_like(x), x]
    for _ in range(2, num):
        values.append(2 * x * values[-1] - values[-2])
    return jnp.stack(values[:num], axis=-1)


def _position(value, limits):
    """To [-1, 1], held at the ends; 0 on an axis without extent."""
    extent = limits[1] - limits[0]
    scale = 2 / jnp.where(extent > 0, extent, 1)
    return jnp.where(extent > 0, jnp.clip((value - limits[0]) * scale - 1, -1, 1), 0)


def _quarter(tau):
    """tau^(1/4) with a finite gradient at 0."""
    positive = tau > 1e-12
    root = jnp.sqrt(jnp.sqrt(jnp.where(positive, tau, 1)))
    return jnp.where(positive, root, 1e-3)


def _tau_basis(tau, limits, num):
    lowest = jnp.where(limits[0] > 0, _quarter(limits[0]), 0)
    quarters = jnp.stack([lowest, _quarter(limits[1])])
    return chebyshev_basis(_position(_quarter(tau), quarters), num)


def _side_basis(theta, num: int):
    """Basis of the side of pi/2 that holds theta, zero on the other: `[*batch, 2, num]`."""
    theta = jnp.asarray(theta)
    off = jnp.abs(theta - pi / 2) / (pi / 2)
    far = off > 1e-6  # keeps the gradient of the root finite
    x = jnp.clip(2 * jnp.where(far, jnp.sqrt(jnp.where(far, off, 1)), 0) - 1, -1, 1)
    basis = chebyshev_basis(x, num)
    front = (theta < pi / 2)[..., None]
    return jnp.stack([jnp.where(front, basis, 0), jnp.where(front, 0, basis)], axis=-2)


def _source_basis(theta, source_bands: tuple[int, ...], num_bands: int):
    """y_km(theta) for every source band k and the m of every receiver band, 0 for m > k: `[*batch, sources, bands]`."""
    order = round(sqrt(2 * num_bands) - 0.5) if num_bands > 1 else 1
    values = harmonics.evaluate_half(jnp.cos(theta), jnp.sin(theta), max(*source_bands, order) + 1)
    azimuthal = np.array([m for _, m in harmonics.half_index(order)])
    bands = np.array(source_bands)[:, None]
    present = azimuthal <= bands
    return jnp.where(present, values[..., np.where(present, bands * (bands + 1) // 2 + azimuthal, 0)], 0)


def medium_response(
    tables: ZonalTables,
    emitter: str,
    *,
    moments: Float[Array, "J"] | None = None,
    g: Float[Array, ""] = 0.0,
    albedo: Float[Array, ""] = 0.0,
    g_range: Float[Array, ""] | None = None,
    multiple: str = "table",
) -> MediumResponse:
    """Contract one emitter's table for a medium with scalar albedo and g (use vmap for channels).

    Args:
        emitter: "point", "directional" or "area".
        moments: Legendre moments for single scattering; None = those of g. Missing ones count as 0, surplus ones are cut.
        g: mean cosine, for the infinite sum; held at the ends of the table's range (`outside` tells).
        albedo: single-scattering albedo.
        g_range: the paper's single scattering, interpolated linearly in g between -g_range, 0 and g_range, in (0, 1); at
            0.5 and |g| <= 0.5 coefficients are wrong by up to 11 %, irradiance by up to 6 %. None = every moment.
        multiple: "table", or "similarity", the paper's map of all light scattered twice or more to an isotropic medium with
            sigma_s' = (1 - g) sigma_s (too dark by up to half at g = 0.5). Needs g = 0 in the table's range.

    Raises ValueError where the tables lack the emitter, or a mode contradicts the other arguments.
    """
    table = getattr(tables, emitter, None)
    if not isinstance(table, EmitterTable):
        have = [name for name in ("point", "directional", "area") if getattr(tables, name) is not None]
        raise ValueError(f"no table for emitter {emitter!r}; this file has {', '.join(have) or 'none'}")
    if multiple not in ("table", "similarity"):
        raise ValueError(f"multiple = {multiple!r} must be 'table' or 'similarity'")
    if g_range is not None and moments is not None:
        raise ValueError("g_range interpolates in g; give it without moments")
    if not isinstance(g_range, jax.core.Tracer | None) and not 0 < float(g_range) < 1:
        raise ValueError(f"g_range = {float(g_range)} must lie in (0, 1)")
    dtype = table.single.dtype
    num = table.single.shape[-1]
    g, albedo = jnp.asarray(g, dtype), jnp.asarray(albedo, dtype)
    if g_range is not None:
        moments = moments_of_three_g(g, jnp.asarray(g_range, dtype), num)
    elif moments is None:
        moments = moments_of_g(g, num)
    moments = jnp.asarray(moments, dtype)[:num]
    single = jnp.matmul(table.single[..., : moments.size], moments, precision="highest")
    contracted = kappa = tau_scale = None
    if table.multiple is not None:
        scattering = jnp.ones((), dtype)  # what G counts as sigma_s (point, area) or albedo (directional)
        if multiple == "similarity":
            albedo, tau_scale = similarity(albedo, g)
            scattering = (1 - g) / tau_scale if emitter == "directional" else 1 - g
            g = jnp.zeros_like(g)
        u = _sqrt_absorption(albedo)
        x = jnp.arctanh(g)
        along_u = chebyshev_basis(_position(u, tables.albedo_range), tables.kappa.shape[0])
        along_g = chebyshev_basis(_position(x, tables.g_range), tables.kappa.shape[1])
        contracted = jnp.einsum(
            "tsugl,u,g->tsl",
            table.multiple,
            along_u[: table.multiple.shape[2]],
            along_g[: table.multiple.shape[3]],
            precision="highest",
        )
        contracted = contracted.at[0, 0, 0].add(2 * jnp.log(scattering))  # ln G_0
        kappa = jnp.einsum("ug,u,g->", tables.kappa, along_u, along_g, precision="highest")
    bands = tables.source_bands if emitter == "area" else (0,)
    return MediumResponse(single, table.single_range, contracted, table.multiple_range, kappa, bands, tau_scale)


def bounce_response(tables: ZonalTables, emitter: str, *, num_scatterings: int, g: float = 0.0) -> MediumResponse:
    """The table of light scattered exactly n times (n >= 2, static) at one of the tabulated g, as `multiple`.

    Its value G stands for F_n; kappa is 1 (single bounces end like e^-tau). Raises ValueError outside the table.
    """
    table = getattr(tables, emitter)
    if table is None or table.bounces is None:
        raise ValueError(f"these tables hold no bounces of emitter {emitter!r}")
    if g not in tables.bounce_g:
        raise ValueError(f"g = {g} has no bounce table; tabulated: {', '.join(map(str, tables.bounce_g))}")
    if not 2 <= num_scatterings <= table.bounces.shape[1] + 1:
        raise ValueError(f"bounce {num_scatterings} is not tabulated; 2..{table.bounces.shape[1] + 1} are")
    chosen = table.bounces[tables.bounce_g.index(g), num_scatterings - 2]
    single = jnp.matmul(table.single, moments_of_g(jnp.asarray(g, chosen.dtype), table.single.shape[-1]))
    bands = tables.source_bands if emitter == "area" else (0,)
    return MediumResponse(single, table.single_range, chosen, table.multiple_range, jnp.ones((), chosen.dtype), bands)


def _sqrt_absorption(albedo):
    return jnp.sqrt(jnp.maximum(1 - albedo, ALBEDO_FLOOR))


def scaled_single(
    response: MediumResponse, tau: Float[Array, "*batch"], *, theta_n: Float[Array, "*batch"] | None = None
) -> Float[Array, "*batch bands"]:
    """S: point and area tau e^tau L / (albedo sigma_t^2), directional e^tau L / albedo. No overflow at any tau >= 0."""
    num, _, angles, _ = response.single.shape
    basis = _tau_basis(tau, response.single_range, num)
    if theta_n is None:
        return jnp.matmul(basis, response.single[:, 0, 0], precision="highest")
    along = _side_basis(theta_n, angles)
    return jnp.einsum("...t,...sa,tsab->...b", basis, along, response.single, precision="highest")


def _multiple_tau(response: MediumResponse, tau):
    return tau if response.tau_scale is None else tau * response.tau_scale


def scaled_multiple(
    response: MediumResponse, tau: Float[Array, "*batch"], *, theta_n: Float[Array, "*batch"] | None = None
) -> Float[Array, "*batch bands"]:
    """G of light scattered twice or more (or F_n of a bounce response), continued beyond the table as e^{-kappa tau}."""
    if response.multiple is None:
        raise ValueError("this response was tabulated without multiple scattering")
    num, _, num_bands = response.multiple.shape
    tau = _multiple_tau(response, tau)
    basis = _tau_basis(tau, response.multiple_range, num)
    form = jnp.einsum("...t,tsb->...sb", basis, response.multiple, precision="highest")
    past = jnp.maximum(tau - response.multiple_range[1], 0)
    first = jnp.exp(form[..., :1, :1] - (response.kappa * past)[..., None, None])
    ones = jnp.ones_like(first)
    ratios = jnp.concatenate([jnp.concatenate([ones, form[..., :1, 1:]], axis=-1), form[..., 1:, :]], axis=-2)
    if theta_n is None:
        return (ratios * first)[..., 0, :]
    return jnp.sum(ratios * first * _source_basis(theta_n, response.source_bands, num_bands), axis=-2)


def _spread(tau, limit):
    """tau_max / tau beyond the table (radiance of a compact source also falls with distance), 1 inside."""
    return jnp.minimum(1, limit / jnp.maximum(tau, limit))


def scattered_point(
    response: MediumResponse,
    distance: Float[Array, "*batch"],
    *,
    sigma_s: Float[Array, "*batch"],
    sigma_t: Float[Array, "*batch"],
    theta_n: Float[Array, "*batch"] | None = None,
    multiple: bool = True,
) -> Float[Array, "*batch bands"]:
    """Scattered radiance from a point source of intensity 1, or from a patch with Le dA = 1 given theta_n.

    distance > 0. With `multiple` the infinite sum, else single scattering. Exactly 0 at sigma_s = 0.
    """
    distance, sigma_s, sigma_t = jnp.asarray(distance), jnp.asarray(sigma_s), jnp.asarray(sigma_t)
    tau = sigma_t * distance
    once = scaled_single(response, tau, theta_n=theta_n) * (_spread(tau, response.single_range[1]) * jnp.exp(-tau))[..., None]
    radiance = (sigma_s / distance)[..., None] * once
    if multiple and response.multiple is not None:
        spread = _spread(_multiple_tau(response, tau), response.multiple_range[1])
        more = scaled_multiple(response, tau, theta_n=theta_n) * spread[..., None]
        radiance = radiance + (sigma_s * sigma_s)[..., None] * more
    return radiance


def scattered_directional(
    response: MediumResponse,
    depth: Float[Array, "*batch"],
    *,
    sigma_s: Float[Array, "*batch"],
    sigma_t: Float[Array, "*batch"],
    multiple: bool = True,
) -> Float[Array, "*batch order"]:
    """Scattered radiance at a depth below the top of a half-space lit straight down with irradiance 1. 0 at sigma_t = 0."""
    depth, sigma_s, sigma_t = jnp.asarray(depth), jnp.asarray(sigma_s), jnp.asarray(sigma_t)
    tau = sigma_t * depth
    albedo = jnp.where(sigma_t > 0, sigma_s / jnp.where(sigma_t > 0, sigma_t, 1), 0)
    radiance = (albedo * jnp.exp(-tau))[..., None] * scaled_single(response, tau)
    if multiple and response.multiple is not None:
        radiance = radiance + (albedo * albedo)[..., None] * scaled_multiple(response, tau)
    return radiance


def direct_point(distance: Float[Array, "*batch"], sigma_t: Float[Array, "*batch"]) -> Float[Array, "*batch"]:
    """e^-tau / d^2: irradiance facing a point source of intensity 1 (times cos+ theta_n for a patch), unscattered."""
    return jnp.exp(-sigma_t * distance) / (distance * distance)


def direct_directional(depth: Float[Array, "*batch"], sigma_t: Float[Array, "*batch"]) -> Float[Array, "*batch"]:
    """e^-tau: irradiance facing a directional light of irradiance 1, unscattered."""
    return jnp.exp(-sigma_t * depth)


def outside(
    tables: ZonalTables, response: MediumResponse, tau: Float[Array, "*batch"], g: Float[Array, ""]
) -> dict[str, Array]:
    """Counts of queries beyond the tables' ranges: `tau` (continued as an exponential) and `g` (held at the end)."""
    limit = response.single_range[1] if response.multiple is None else response.multiple_range[1]
    counts = {"tau_outside": jnp.sum(_multiple_tau(response, tau) > limit)}
    if tables.g_range is not None and response.multiple is not None and response.tau_scale is None:
        x = jnp.arctanh(jnp.asarray(g, tables.g_range.dtype))
        slack = 1e-5
        counts["g_outside"] = jnp.sum((x < tables.g_range[0] - slack) | (x > tables.g_range[1] + slack))
    return counts


def from_arrays(arrays: dict[str, np.ndarray], *, dtype=np.float32) -> ZonalTables:
    """Tables from a file's arrays (`tables.load`), named `<emitter>.<field>` and `<field>`, in the given precision."""

    def field(name):
        return jnp.asarray(arrays[name], dtype) if name in arrays else None

    emitters = {}
    for kind in ("point", "directional", "area"):
        if f"{kind}.single" in arrays:
            names = ("single", "single_range", "multiple", "multiple_range", "bounces")
            emitters[kind] = EmitterTable(*(field(f"{kind}.{name}") for name in names))
    shared = {name: field(name) for name in ("albedo_range", "g_range", "kappa")}
    bounce_g = tuple(float(g) for g in arrays.get("bounce_g", ()))
    source_bands = tuple(int(k) for k in arrays.get("source_bands", (0,)))
    return ZonalTables(**emitters, **shared, bounce_g=bounce_g, source_bands=source_bands)
