"""The tables as the paper lays them out, for GPUs: bins of tau, eight angles, zonal harmonics, three values of g.

One OpenEXR image, num_bins wide. Column i holds ln tau = ln tau_0 + (i + 1/2)/num_bins ln(tau_1 / tau_0); the rows are

    0 .. N-1                  point source, band l = row
    N .. 2N-1                 directional source
    2N .. 2N + A N - 1        area source at theta_n = pi (a + 1/2) / A, row 2N + a N + l, about its best-fit axis
    2N + A N + a              d_fit = sin(theta_fit) of that axis, leaning to the normal's side (row per angle)

Channels B, G, R: scaled single scattering (tau e^tau L / (alpha sigma_t^2), directional e^tau L / alpha) for g = -g_range, 0,
g_range; A: light scattered twice or more, G (L / sigma_s^2, directional L / alpha^2), g = 0, at the texture's albedo.
Linear interpolation in ln tau of these scaled values has relative error 2e-4 at 256 bins.
"""

import os

import numpy as np

from jaxvol import image, tables
from jaxvol.fit import assemble, half_space, wavenumber, zonal_axis, zonal_tables
from jaxvol.fit.table_config import TableConfig


def bin_tau(config: TableConfig) -> np.ndarray:
    """tau of every column."""
    low, high = np.log(config.texture.tau)
    return np.exp(low + (np.arange(config.texture.num_bins) + 0.5) / config.texture.num_bins * (high - low))


def angles(config: TableConfig) -> np.ndarray:
    """theta_n of every angle block."""
    return np.pi * (np.arange(config.texture.num_angles) + 0.5) / config.texture.num_angles


def channels(config: TableConfig) -> dict[str, np.ndarray]:
    """R, G, B, A of the texture, float32 `[rows, bins]`."""
    tau, theta, order = bin_tau(config), angles(config), config.order
    g = config.texture.g_range
    result = {}
    for channel, value in (("B", -g), ("G", 0.0), ("R", g)):
        area = zonal_tables.area_table(tau, theta, order=order, g=value)
        point, directional = (
            make(tau, order=order, g=value) for make in (zonal_tables.point_table, zonal_tables.directional_table)
        )
        result[channel] = _stack(point, directional, area, order)
    isotropic, albedo = np.ones(1), config.texture.albedo
    half = assemble.area_response(tau, theta, moments=isotropic, albedo=albedo, order=order, source_bands=10)
    point = wavenumber.point_table(tau, moments=isotropic, albedo=albedo, order=order)
    directional = half_space.directional_table(tau, moments=isotropic, albedo=albedo, order=order)
    result["A"] = _stack(point, directional, half, order)
    return result


def _stack(point, directional, area, order: int) -> np.ndarray:
    num_tau, num_angles, _ = area.shape
    axis = zonal_axis.optimal_linear(area)
    zonal = zonal_axis.project(area, axis)
    rows = [point.T, directional.T, zonal.transpose(1, 2, 0).reshape(num_angles * order, num_tau), np.sin(axis).T]
    return np.concatenate(rows).astype(np.float32)


def save(path: str | os.PathLike, config: TableConfig, table: tables.TableFile) -> None:
    """Write the texture with the table's metadata, atomically."""
    image.write_exr(path, channels(config), metadata=table.metadata)


def rows(config: TableConfig) -> int:
    """Height of the texture."""
    return config.order * (2 + config.texture.num_angles) + config.texture.num_angles
