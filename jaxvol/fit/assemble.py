"""From a configuration to the arrays of a table file, in parts that a job can save and resume.

`part_names` lists the parts, `compute_part` makes one, `join` puts them together (Chebyshev transforms happen there), and
`estimate_errors` compares the finished tables, through the lookup that users call, with fresh quadratures.
"""

from concurrent.futures import ThreadPoolExecutor
from functools import partial

import jax
import numpy as np
from threadpoolctl import threadpool_limits

from jaxvol import harmonics, zonal_lookup
from jaxvol.fit import compact, half_space, wavenumber, zonal_tables
from jaxvol.fit.table_config import TableConfig

QUANTUM = 2.0**-32  # coefficients are rounded to this share of the table's largest, so that files compress
MULTIPLE_QUANTUM = {"point": 2.0**-28, "directional": 2.0**-28, "area": 2.0**-24}  # far below these tables' errors
NUM_KAPPA = (24, 24)


def even_bands(limit: int) -> tuple[int, ...]:
    """Source moments of a Lambertian patch that do not vanish: 0, 1, 2, 4, 6, ..., limit."""
    return (0, 1, *range(2, limit + 1, 2)) if limit >= 1 else (0,)


def _u_range(config: TableConfig) -> tuple[float, float]:
    low, high = config.multiple.albedo
    return float(np.sqrt(1 - high)), float(np.sqrt(1 - low))


def _g_range(config: TableConfig) -> tuple[float, float]:
    return tuple(float(v) for v in np.arctanh(config.multiple.g))


def _nodes(num: int, low: float, high: float) -> np.ndarray:
    return np.array([low]) if low == high else compact.nodes(num, low, high)


def _albedos(config: TableConfig, num: int) -> np.ndarray:
    return 1 - _nodes(num, *_u_range(config)) ** 2


def _gs(config: TableConfig, num: int) -> np.ndarray:
    return np.tanh(_nodes(num, *_g_range(config)))


def _tau_single(num: int, config: TableConfig) -> np.ndarray:
    return compact.nodes(num, 0.0, config.tau_max**0.25) ** 4


def _tau_multiple(num: int, config: TableConfig) -> np.ndarray:
    low, high = config.multiple.tau
    return compact.nodes(num, low**0.25, high**0.25) ** 4


def _axes(config: TableConfig, kind: str) -> tuple[int, int, int]:
    """Numbers of tau, albedo and g nodes of the multiple-scattering table of one emitter."""
    if kind == "area":
        area, multiple = config.multiple.area, config.multiple
        single_g, single_albedo = multiple.num_g == 1, multiple.num_albedo == 1
        return area.num_tau, 1 if single_albedo else area.num_albedo, 1 if single_g else area.num_g
    return config.multiple.num_tau, config.multiple.num_albedo, config.multiple.num_g


def part_names(config: TableConfig) -> list[str]:
    """The parts of a job, in order."""
    names = [f"{kind}-single" for kind in config.emitters]
    if config.multiple is not None:
        names.append("kappa")
        for kind in config.emitters:
            names += [f"{kind}-multiple-{index}" for index in range(_axes(config, kind)[2])]
            if config.multiple.bounces > 1:
                names += [f"{kind}-bounces-{index}" for index in range(len(config.multiple.bounce_g))]
    return names


def compute_part(name: str, config: TableConfig) -> dict[str, np.ndarray]:
    """The arrays of one part, values at Chebyshev nodes."""
    if name == "kappa":
        return {"values": _kappa(config)}
    kind, quantity, *index = name.split("-")
    if quantity == "single":
        return {"values": _SINGLE[kind](config)}
    num_tau, num_albedo, num_g = _axes(config, kind)
    tau = _tau_multiple(num_tau, config)
    if quantity == "multiple":
        tolerance = 1e-7 if kind == "area" else 1e-10  # the sum over source moments is cut at 1e-3
        moments = wavenumber.effective_moments(_gs(config, num_g)[int(index[0])], tolerance=tolerance)
        albedos = _albedos(config, num_albedo)
        grid = np.broadcast_to(moments, (albedos.size, moments.size))
        kappas = wavenumber.diffusion_roots(grid, albedos, num_steps=20)  # integration paths need no more
        tables = _multiple(kind, tau, moments, albedos, config, kappa=kappas)
        return {"values": np.moveaxis(tables, 0, 2)}  # [tau, sources, albedo, bands]
    moments = wavenumber.effective_moments(config.multiple.bounce_g[int(index[0])])
    return {"values": _bounces(kind, tau, moments, config)}


def _kappa(config: TableConfig) -> np.ndarray:
    num_albedo = 1 if config.multiple.num_albedo == 1 else NUM_KAPPA[0]
    num_g = 1 if config.multiple.num_g == 1 else NUM_KAPPA[1]
    albedo, g = _albedos(config, num_albedo), _gs(config, num_g)
    moments = g[:, None] ** np.arange(wavenumber.MAX_MOMENTS)
    grid = np.broadcast_to(moments, (albedo.size, *moments.shape))
    return wavenumber.diffusion_roots(grid, np.broadcast_to(albedo[:, None], grid.shape[:2]))


def _single_point(config: TableConfig) -> np.ndarray:
    tau = _tau_single(config.num_tau, config)
    return zonal_tables.point_moment_table(tau, order=config.order, num_moments=config.moments)[:, None, None]


def _single_directional(config: TableConfig) -> np.ndarray:
    tau = _tau_single(config.num_tau, config)
    return zonal_tables.directional_moment_table(tau, order=config.order, num_moments=config.moments)[:, None, None]


def _single_area(config: TableConfig) -> np.ndarray:
    area, half = config.area, np.pi / 2
    offset = half * compact.nodes(area.num_angle, 0.0, 1.0) ** 2  # clusters at pi/2, where the response is not smooth
    angles = np.concatenate([half - offset, half + offset])
    tau = _tau_single(area.num_tau, config)
    table = zonal_tables.area_moment_table(tau, angles, order=area.order, num_moments=area.moments)
    return table.reshape(tau.size, 2, area.num_angle, *table.shape[2:])


_SINGLE = {"point": _single_point, "directional": _single_directional, "area": _single_area}


def area_source_response(
    tau,
    *,
    moments: np.ndarray,
    albedo,
    order: int,
    source_bands: int,
    first: int = 2,
    last: int | None = None,
    kappa=None,
) -> np.ndarray:
    """c_k,lm with L_lm(theta_n) / albedo^first = sum_k c_k,lm y_km(theta_n) of a patch: `[*media, T, sources, half]`.

    c_k,lm = A_k sqrt(4pi/(2k+1)) R_{l k m}, bounces first..last, sigma_t = 1, k = 0, 1, 2, 4, ..., source_bands; albedo (and
    kappa) as in `wavenumber.moment_responses`.
    """
    bands = even_bands(source_bands)
    responses = wavenumber.moment_responses(
        tau, moments=moments, albedo=albedo, source_bands=bands, order=order, first=first, last=last, kappa=kappa
    )
    emission = harmonics.clamped_cosine(max(bands) + 1) * harmonics.rotation_norm(max(bands) + 1)
    table = np.zeros((*responses.shape[:-3], len(bands), harmonics.num_half(order)))
    for index, (band, m) in enumerate(harmonics.half_index(order)):
        for column, source in enumerate(bands):
            if m <= source:
                table[..., column, index] = emission[source] * responses[..., band, column, m]
    return table


def area_response(tau, theta_n, *, order: int, source_bands: int, **medium) -> np.ndarray:
    """L_lm / albedo^first of a Lambertian patch, bounces first..last, by source moments: `[*media, T, A, half]`, sigma_t = 1.

    Error over the largest L_00 of all angles, two bounces and more, with moments up to 10: 7e-4; it falls like the square of
    the number of moments. Keywords as in `area_source_response`.
    """
    table = area_source_response(tau, order=order, source_bands=source_bands, **medium)
    theta_n = np.asarray(theta_n, dtype=np.float64)
    bands = even_bands(source_bands)
    polynomials = harmonics.normalised_legendre(np.cos(theta_n), max(*bands, order) + 1)
    radiance = np.zeros((*table.shape[:-2], theta_n.size, table.shape[-1]))
    for index, (_, m) in enumerate(harmonics.half_index(order)):
        for column, source in enumerate(bands):
            if m <= source:
                radiance[..., index] += table[..., column, index, None] * polynomials[source, m] * np.sin(theta_n) ** m
    return radiance


def _multiple(kind: str, tau, moments, albedos, config: TableConfig, *, kappa=None) -> np.ndarray:
    """`[albedo, tau, sources, bands]`, ratios."""
    if kind == "area":
        table = area_source_response(
            tau,
            moments=moments,
            albedo=albedos,
            order=config.area.order,
            source_bands=config.multiple.area.source_bands,
            kappa=kappa,
        )
    elif kind == "point":
        table = wavenumber.point_table(tau, moments=moments, albedo=albedos, order=config.order, kappa=kappa)[..., None, :]
    else:
        streams = half_space.streams_for(moments)
        make = partial(half_space.directional_table, tau, moments=moments, order=config.order, num_streams=streams)
        table = np.stack([make(albedo=albedo, num_nodes=64) for albedo in albedos])[..., None, :]
    return _to_ratios(table)


def _bounces(kind: str, tau, moments, config: TableConfig) -> np.ndarray:
    """`[bounce, tau, angle, bands]`, ratios; n = 2..bounces."""
    bounces = range(2, config.multiple.bounces + 1)
    if kind == "area":
        make = partial(
            area_source_response,
            tau,
            moments=moments,
            albedo=1.0,
            order=config.area.order,
            source_bands=config.multiple.area.source_bands,
        )
        tables = np.stack([make(first=n, last=n) for n in bounces])
    elif kind == "point":
        make = partial(wavenumber.point_table, tau, moments=moments, albedo=1.0, order=config.order)
        tables = np.stack([make(first=n, last=n) for n in bounces])[:, :, None]
    else:
        tables = half_space.bounce_tables(
            tau,
            moments=moments,
            num_bounces=config.multiple.bounces,
            order=config.order,
            num_streams=half_space.streams_for(moments),
        )[:, :, None]
    return _to_ratios(tables)


def _to_ratios(table: np.ndarray) -> np.ndarray:
    """(ln L_0, everything else over L_0) of `[..., sources, bands]`, L_0 the first of both."""
    first = table[..., :1, :1]
    form = table / first
    form[..., 0, 0] = np.log(first[..., 0, 0])
    return form


def _quantise(values: np.ndarray, quantum: float) -> np.ndarray:
    step = quantum * 2.0 ** np.ceil(np.log2(np.abs(values).max()))
    return np.round(values / step) * step


def _chebyshev(values: np.ndarray, axes: tuple[int, ...], *, quantum: float = QUANTUM) -> np.ndarray:
    for axis in axes:
        values = compact.transform(values, axis=axis)
    return _quantise(values, quantum)


def join(parts: dict[str, dict[str, np.ndarray]], config: TableConfig) -> dict[str, np.ndarray]:
    """All arrays of the table file."""
    arrays = {}
    for kind in config.emitters:
        arrays[f"{kind}.single"] = _chebyshev(parts[f"{kind}-single"]["values"], (0, 2))
        arrays[f"{kind}.single_range"] = np.array([0.0, config.tau_max])
        if config.multiple is None:
            continue
        num_g = _axes(config, kind)[2]
        stacked = np.stack([parts[f"{kind}-multiple-{index}"]["values"] for index in range(num_g)], axis=3)
        arrays[f"{kind}.multiple"] = _chebyshev(stacked, (0, 2, 3), quantum=MULTIPLE_QUANTUM[kind])
        arrays[f"{kind}.multiple_range"] = np.array(config.multiple.tau)
        if config.multiple.bounces > 1:
            bounces = [parts[f"{kind}-bounces-{i}"]["values"] for i in range(len(config.multiple.bounce_g))]
            arrays[f"{kind}.bounces"] = _chebyshev(np.stack(bounces), (2,))
    if config.multiple is not None:
        arrays["kappa"] = _chebyshev(parts["kappa"]["values"], (0, 1))
        arrays["bounce_g"] = np.array(config.multiple.bounce_g)
        arrays["source_bands"] = np.array(even_bands(config.multiple.area.source_bands), dtype=np.float64)
        arrays["albedo_range"], arrays["g_range"] = np.array(_u_range(config)), np.array(_g_range(config))
    if "point" in config.emitters:
        low, high = np.log(config.compact.tau)
        tau = np.exp(compact.nodes(config.compact.num, low, high))
        scaled = zonal_tables.point_table(tau, order=config.order)
        arrays["point.compact"] = compact.transform(np.log(scaled))
        arrays["point.compact_range"] = np.array(config.compact.tau)
    return arrays


def estimate_errors(arrays: dict[str, np.ndarray], config: TableConfig, *, num: int = 24) -> dict[str, float]:
    """Largest error of each table at random points between the nodes, relative to band 0 (area: its maximum over angles).

    Multiple scattering is judged at tau <= 10; farther out, at small albedo, tables are 10 times worse.
    Evaluated in float64 by the jitted lookup; truth is a fresh quadrature (single) or solution (multiple) at those points.
    """
    with jax.enable_x64(True):
        tables = zonal_lookup.from_arrays(arrays, dtype=np.float64)

    def judge(name: str) -> float:
        kind, quantity = name.split(".")
        rng = np.random.default_rng((config.seed, *name.encode()))
        with jax.enable_x64(True):  # a setting of the thread
            if quantity == "single":
                return _single_error(tables, kind, config, rng, num)
            return _multiple_error(tables, kind, config, rng, max(4, num // 4))

    quantities = ("single",) if config.multiple is None else ("multiple", "single")
    names = [f"{kind}.{quantity}" for quantity in quantities for kind in reversed(config.emitters)]
    with threadpool_limits(1, user_api="blas"), ThreadPoolExecutor() as pool:
        return dict(sorted(zip(names, pool.map(judge, names), strict=True)))


def _relative(found: np.ndarray, truth: np.ndarray) -> float:
    scale = np.abs(truth[..., :1])
    if truth.ndim == 3:
        scale = scale.max(axis=1, keepdims=True)
    return float(np.max(np.abs(found - truth) / scale))


_single = jax.jit(zonal_lookup.scaled_single)
_many = jax.jit(zonal_lookup.scaled_multiple)


def _single_error(tables, kind, config, rng, num) -> float:
    tau = np.geomspace(1e-4, config.tau_max, num) * rng.uniform(0.9, 1, num)
    response = zonal_lookup.medium_response(tables, kind, g=0.0)
    if kind != "area":
        make = zonal_tables.point_table if kind == "point" else zonal_tables.directional_table
        return _relative(np.asarray(_single(response, tau)), make(tau, order=config.order))
    theta = rng.uniform(0, np.pi, 6)
    truth = zonal_tables.area_table(tau, theta, order=config.area.order)
    found = np.asarray(_single(response, tau[:, None], theta_n=np.broadcast_to(theta, (num, 6))))
    return _relative(found, truth)


def _multiple_error(tables, kind, config, rng, num) -> float:
    worst = 0.0
    low, high = config.multiple.tau
    tau = np.geomspace(low, min(high, 10.0), 9) * rng.uniform(1, 1.05, 9)
    theta = rng.uniform(0, np.pi, 4)
    for _ in range(num):
        albedo = 1 - rng.uniform(*_u_range(config)) ** 2
        g = float(np.tanh(rng.uniform(*_g_range(config))))
        response = zonal_lookup.medium_response(tables, kind, g=g, albedo=albedo)
        moments = wavenumber.effective_moments(g, tolerance=1e-8)
        if kind == "area":
            bands, order = config.multiple.area.source_bands, config.area.order
            truth = area_response(tau, theta, moments=moments, albedo=albedo, order=order, source_bands=bands + 6)
            found = _many(response, tau[:, None], theta_n=np.broadcast_to(theta, (tau.size, theta.size)))
        else:
            truth = compact.from_ratios(_multiple(kind, tau, moments, np.array([albedo]), config)[0, :, 0])
            found = _many(response, tau)
        worst = np.maximum(worst, _relative(np.asarray(found), truth))  # keeps nan
    return float(worst)
