"""Directions towards the environment, drawn where a picture wants them.

The map's own table draws in proportion to luminance. What the light meets matters as much: the phase function about the
directions that the picture looks in, the cosine on the surfaces that it shows. Both are averaged over a few of the
picture's rays and multiplied into the table, with a floor, so that no direction that carries light is left out.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxvol import phase
from jaxvol.types import EnvironmentLight, Medium

_FLOOR = 0.1  # share of the weight that does not look at the picture
_ROWS, _COLUMNS = 64, 128  # least size of a table


def map_directions(environment: EnvironmentLight, height: int, width: int) -> Float[np.ndarray, "height width 3"]:
    """Directions towards the middles of a map of another size."""
    theta = (np.arange(height) + 0.5) * np.pi / height
    azimuth = (np.arange(width) + 0.5) * 2.0 * np.pi / width
    sine = np.sin(theta)[:, None]
    local = np.stack(
        [sine * np.sin(azimuth), np.broadcast_to(np.cos(theta)[:, None], (height, width)), -sine * np.cos(azimuth)], -1
    )
    return (local @ np.asarray(environment.map_from_world, np.float64)).astype(np.float32)


@jax.jit
def phase_weight(regions: tuple[Medium, ...], eye: Float[Array, "r 3"], towards: Float[Array, "*b 3"]) -> Float[Array, "*b"]:
    """Phase function towards the eye, averaged over viewing directions and regions."""
    cosine = jnp.einsum("rk,...k->...r", eye, towards)
    return sum(jnp.mean(phase.evaluate(m, cosine), axis=-1) for m in regions)


@jax.jit
def cosine_weight(normal: Float[Array, "r 3"], towards: Float[Array, "*b 3"]) -> Float[Array, "*b"]:
    """Cosine at surfaces, averaged over normals (each turned towards the eye)."""
    return jnp.mean(jnp.maximum(jnp.einsum("rk,...k->...r", normal, towards), 0.0), axis=-1)


def guided(environment: EnvironmentLight, weigh) -> EnvironmentLight:
    """The map's sampling table times `weigh(directions)`, as a light whose `radiance` has the table's size, unused; eager.

    For `lights.sample_environment` and its pdf; radiance is that of the environment itself.
    """
    table = np.asarray(environment.probability, np.float64)
    rows, columns = (-(-least // n) for least, n in zip((_ROWS, _COLUMNS), table.shape, strict=True))
    h, w = table.shape[0] * rows, table.shape[1] * columns
    # A cell is uniform in solid angle: its parts get their share of it.
    edges = np.cos(np.pi * np.arange(h + 1) / h)
    solid = (edges[:-1] - edges[1:]).reshape(-1, rows)
    share = (solid / solid.sum(axis=1, keepdims=True)).reshape(-1) / columns
    probability = np.repeat(np.repeat(table, rows, axis=0), columns, axis=1) * share[:, None]
    # The weight is smooth: on a coarser map, repeated.
    down, across = _coarsening(h, _ROWS), _coarsening(w, _COLUMNS)
    weight = np.asarray(weigh(jnp.asarray(map_directions(environment, h // down, w // across))), np.float64)
    weight = np.repeat(np.repeat(weight, down, axis=0), across, axis=1)
    mean = np.sum(probability * weight)
    probability = probability * (_FLOOR + (1.0 - _FLOOR) * weight / mean) if mean > 0 else probability
    row = probability.sum(axis=1)
    column = np.cumsum(probability, axis=1) / np.maximum(row, 1e-300)[:, None]
    to32 = lambda x: jnp.asarray(np.minimum(x, 1.0), jnp.float32)  # noqa: E731
    return EnvironmentLight(
        radiance=jnp.zeros((h, w, 0), jnp.float32),
        map_from_world=environment.map_from_world,
        probability=to32(probability / row.sum()),
        row_cdf=to32(np.cumsum(row) / row.sum()),
        column_cdf=to32(column),
    )


def _coarsening(size: int, least: int) -> int:
    """The largest divisor that leaves at least `least`."""
    return max(d for d in range(1, size + 1) if size % d == 0 and (d == 1 or size // d >= least))
