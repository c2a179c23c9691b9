"""The state of many light paths traced side by side, and the film that collects finished ones.

A lane holds one path from the eye. When it ends, the next work item starts in the same lane at once; the lane's sums
still belong to the ended sample, and go to the film when its last shadow ray is resolved, before the new one adds any.

A sample's radiance is kept by group; X is the type (surface or volume) of its first vertex from the eye:
"""

from dataclasses import dataclass

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, UInt

from jaxvol.columns import Columns

EMISSION, SURFACE_LIGHT, VOLUME_LIGHT, FROM_SURFACE, FROM_VOLUME, FROM_MULTIPLE = range(6)
NUM_GROUPS = 6  # emission; surface_from_light; volume_from_light; X_from_surface; X_from_volume; X_from_multiple

Sums = tuple[Float[Array, "n 3"] | None, ...]  # by group; None where the scene cannot have it


@dataclass(frozen=True)
class Settings:
    """What is static for one compilation of a step."""

    max_scatterings: int
    roulette_from: int  # number of vertices from which Russian roulette may end a path
    tracked: bool  # some medium has a density grid: flights are tracked, a few tentative collisions a step
    tracking_steps: int
    bounded: bool  # meshes bound the media: the driver supplies spans
    equiangular: bool


class Arrival(eqx.Module):
    """Where a flight ended."""

    collided: Array
    position: Array
    normal: Array  # geometric; of the surface
    region: Array
    weight: Array  # of the throughput
    density: Array  # of the collision by free flight, 1/length (equi-angular MIS)
    on_surface: Array
    escaped: Array


class Segment(eqx.Module):
    """The flight that led to a lane's last volume vertex: what equi-angular sampling could have done on it."""

    origin: Float[Array, "n 3"]
    direction: Float[Array, "n 3"]
    t0: Float[Array, "n"]  # of the media along it
    t1: Float[Array, "n"]
    density: Float[Array, "n"]  # of the vertex by free flight, 1/length; 0 where the last vertex is none of these


class Shadow(eqx.Module):
    """A connection to a light whose visibility (and, in a grid, transmittance) is still to be found."""

    origin: Float[Array, "n 3"]
    direction: Float[Array, "n 3"]
    distance: Float[Array, "n"]
    contribution: Float[Array, "n 3"]  # what it adds if nothing is in between
    group: Int[Array, "n"]
    active: Bool[Array, "n"]
    of_finished: Bool[Array, "n"]  # belongs to the sample in `Finished`
    event: UInt[Array, "n"]  # of its sample, for the random numbers of tracking


class Finished(eqx.Module):
    """A sample whose path has ended; its sums are still in the lane."""

    pixel: Int[Array, "n"]
    sample: UInt[Array, "n"]
    first_volume: Bool[Array, "n"]
    valid: Bool[Array, "n"]


# Stages of a tracked flight: the shadow ray of the last vertex; the path's ray up to the equi-angular vertex, and that
# vertex' shadow ray; the path's own flight; and its end.
ON_SHADOW, ON_APPROACH, ON_SECOND_SHADOW, ON_PATH, ARRIVED = range(5)


class Flight(eqx.Module):
    """Progress of a lane through density grids, one ray after the other."""

    stage: Int[Array, "n"]
    t: Float[Array, "n"]  # negative before the first step
    span: Int[Array, "n"]
    ratio: Float[Array, "n 3"]  # to lights: transmittance so far; path: null-collision probabilities over the hero's
    hero: Int[Array, "n"]  # channel that decides the collisions of the path's flight
    collided: Bool[Array, "n"]
    region: Int[Array, "n"]  # medium of the collision
    counter: UInt[Array, "n"]


class Casts(eqx.Module):
    """What ray casting found for the path ray and the shadow rays of each lane."""

    t: Float[Array, "n"]
    face: Int[Array, "n"]
    blocked: tuple[Bool[Array, "n"], ...]  # one for each shadow slot
    path_spans: tuple | None = None  # (t [n, K+1], region [n, K]) where meshes bound the media
    shadow_spans: tuple[tuple, ...] | None = None


class Lanes(eqx.Module):
    """One path per lane."""

    pixel: Int[Array, "n"]
    sample: UInt[Array, "n"]
    alive: Bool[Array, "n"]
    starting: Bool[Array, "n"]  # a sensor that gathers from a solid angle has yet to be connected to a light
    origin: Float[Array, "n 3"]
    direction: Float[Array, "n 3"]
    throughput: Float[Array, "n 3"]
    pdf: Float[Array, "n"]  # solid-angle density of `direction`; 0 = the camera's, which no light sampling competes with
    num_vertices: Int[Array, "n"]
    first_volume: Bool[Array, "n"]
    last_volume: Bool[Array, "n"]  # type of the vertex farthest from the eye
    event: UInt[Array, "n"]  # numbers the sample's events for its random numbers
    region: Int[Array, "n"]  # medium in which the ray starts; -1 where that is not known
    sums: Sums
    shadows: tuple[Shadow, ...]
    finished: Finished
    flight: Flight | None
    segment: Segment | None  # only with equi-angular sampling
    recast: Bool[Array, "n"]  # the path's ray is new and wants casting
    recast_shadows: tuple[Bool[Array, "n"], ...]  # likewise those of each shadow slot


def possible_groups(*, has_mesh: bool, has_medium: bool) -> tuple[int, ...]:
    """The groups that paths of such a scene can fall into."""
    surface = (SURFACE_LIGHT, FROM_SURFACE) if has_mesh else ()
    volume = (VOLUME_LIGHT, FROM_VOLUME) if has_medium else ()
    multiple = (FROM_MULTIPLE,) if has_mesh or has_medium else ()
    return tuple(sorted((EMISSION, *surface, *volume, *multiple)))


def idle(num_lanes: int, *, groups: tuple[int, ...], num_shadows: int, tracked: bool, equiangular: bool) -> Lanes:
    """Lanes without work: the next step fills them."""
    n = num_lanes
    f = lambda *shape: jnp.zeros(shape, jnp.float32)  # noqa: E731
    i = lambda: jnp.zeros(n, jnp.int32)  # noqa: E731
    u = lambda: jnp.zeros(n, jnp.uint32)  # noqa: E731
    b = lambda: jnp.zeros(n, bool)  # noqa: E731
    x = lambda: jnp.tile(jnp.array([1.0, 0.0, 0.0], jnp.float32), (n, 1))  # noqa: E731
    return Lanes(
        pixel=i(),
        sample=u(),
        alive=b(),
        starting=b(),
        origin=f(n, 3),
        direction=x(),
        throughput=f(n, 3),
        pdf=f(n),
        num_vertices=i(),
        first_volume=b(),
        last_volume=b(),
        event=u(),
        region=i(),
        sums=tuple(f(n, 3) if g in groups else None for g in range(NUM_GROUPS)),
        shadows=tuple(Shadow(f(n, 3), x(), f(n), f(n, 3), i(), b(), b(), u()) for _ in range(num_shadows)),
        finished=Finished(i(), u(), b(), b()),
        flight=Flight(i(), f(n), i(), f(n, 3), i(), b(), i(), u()) if tracked else None,
        segment=Segment(f(n, 3), x(), f(n), f(n), f(n)) if equiangular else None,
        recast=b(),
        recast_shadows=tuple(b() for _ in range(num_shadows)),
    )


def add_to_group(sums: Sums, group: Int[Array, "n"], value: Float[Array, "n 3"]) -> Sums:
    """Add `value` to each lane's group."""
    return tuple(None if old is None else old + jnp.where((group == g)[:, None], value, 0.0) for g, old in enumerate(sums))


def group_after(num_vertices: Int[Array, "n"], first_volume: Bool[Array, "n"], last_volume: Bool[Array, "n"]):
    """Group of light that joins a path of `num_vertices` whose first and last (farthest) vertices have these types."""
    first = jnp.where(first_volume, VOLUME_LIGHT, SURFACE_LIGHT)
    second = jnp.where(last_volume, FROM_VOLUME, FROM_SURFACE)
    group = jnp.where(num_vertices == 1, first, jnp.where(num_vertices == 2, second, FROM_MULTIPLE))
    return jnp.where(num_vertices == 0, EMISSION, group).astype(jnp.int32)


def num_columns(groups: tuple[int, ...]) -> int:
    """Columns of the film: sums and squares of every possible group, then of the total."""
    return 6 * (len(groups) + 1)


def film_columns(sums: Sums) -> Float[Array, "n columns"]:
    """What a sample adds to the film: its groups, their total, and the squares of both. numpy or JAX."""
    xp = np if isinstance(sums[0], np.ndarray) else jnp
    groups = [s for s in sums if s is not None]
    values = xp.concatenate([*groups, sum(groups)], axis=1)
    return xp.concatenate([values, values * values], axis=1)


def flush(film: Float[Array, "rows columns"], sums: Sums, finished: Finished, num_pixels: int, first_pixel):
    """Add the valid finished samples to the film; row = type of the first vertex * num_pixels + pixel."""
    row = finished.pixel - first_pixel + finished.first_volume * num_pixels
    row = jnp.where(finished.valid, row, film.shape[0])
    return film.at[row].add(film_columns(sums), mode="drop")


def rows(value, index: np.ndarray) -> np.ndarray:
    """Chosen rows of an array that may be split into columns, as numpy."""
    if isinstance(value, Columns):
        return np.stack([np.asarray(c)[index] for c in value.columns], axis=1)
    return np.asarray(value)[index]


def flush_host(film: np.ndarray, sums: Sums, finished: Finished, num_pixels: int, first_pixel: int) -> None:
    """The same in place with numpy, touching only finished lanes: XLA's scatter on the CPU pays for all of them."""
    lane = np.flatnonzero(np.asarray(finished.valid))
    if not lane.size:
        return
    columns = film_columns(tuple(None if s is None else rows(s, lane) for s in sums))
    pixel, first_volume = np.asarray(finished.pixel)[lane], np.asarray(finished.first_volume)[lane]
    row = pixel - first_pixel + first_volume * num_pixels
    while lane.size:  # rounds without repeated rows: `+=` keeps only one of those
        _, first = np.unique(row, return_index=True)
        film[row[first]] += columns[first]
        rest = np.ones(row.size, bool)
        rest[first] = False
        row, columns, lane = row[rest], columns[rest], lane[rest]
