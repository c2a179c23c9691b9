"""Light that a grid scatters from the environment to one eye, as a field on the grid: J(x) = int p(w . e(x)) L(w) T(x, w) dw.

Seen from one point, the direction e(x) in which x is looked at is fixed, so J depends on x alone and is as smooth as
optical depth. Directions w are a low-discrepancy set drawn where L and p are large. For each, optical depths at all
vertices come from one sweep through the grid along the light: lines parallel to it are carried from layer to layer,
their positions relative to the vertices being the same in a whole layer, so that a sweep is slices and two weights, no
lookups. Lines are carried exactly (never interpolated twice), density is taken at the middle of each layer, depth is
interpolated to vertices within the layer; second order in the cell. Between vertices log J is interpolated, which is
exact where J falls exponentially.

For a medium that is one box with a grid, the eye and all surfaces outside the box; surfaces block lines as a whole, on
a coarse grid of points.
"""

from functools import cache, partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from jaxvol import extinction, lights, media, phase, ray_casting
from jaxvol.columns import compiler_options
from jaxvol.direct import patterns
from jaxvol.types import EnvironmentLight, Medium, Scene

MAX_VERTICES = 2_000_000  # three floats at eight corners each: 200 MB
_SMALL = 150_000  # vertices that always may be had: they cost a second or two
_VISIBILITY_POINTS = 12  # along each axis
_DARK = 1e-30


class SkyField(eqx.Module):
    """Logarithm of J at the corners of the cells between vertices; the outer vertices are on the box."""

    corners: Float[Array, "cells 24"]  # RGB of the eight corners
    bounds: Float[Array, "2 3"]
    shape: tuple[int, int, int] = eqx.field(static=True)  # cells along each axis


class _Sweeps(eqx.Module):
    """Directions that are swept along one axis; K of them, the first `count` real."""

    count: Array
    ascending: Float[Array, "K"]  # 1 when light travels towards larger indices, else 0
    shear: Float[Array, "K 2"]  # cells that a line moves along the other axes from layer to layer
    length: Float[Array, "K"]  # of a line in a layer
    towards: Float[Array, "K 3"]  # the sky; axes permuted
    radiance: Float[Array, "K 3"]  # over K times the density of the direction
    visible: Float[Array, "K P P P"] | None  # axes permuted; None: nothing stands in the way


def occupied(medium: Medium) -> tuple[Float[np.ndarray, "2 3"], tuple[int, int, int]]:
    """Bounds and voxels of the part of the box that is not empty; eager."""
    density = np.asarray(medium.density)
    low, high = np.asarray(medium.bounds, np.float64)
    voxel = (high - low) / density.shape
    begin, end = np.zeros(3, int), np.array(density.shape)
    for i in range(3):
        filled = np.flatnonzero(density.max(axis=tuple(k for k in range(3) if k != i)) > 0)
        if filled.size:
            begin[i], end[i] = max(filled[0] - 1, 0), min(filled[-1] + 2, density.shape[i])  # trilinear lookups reach out
    return np.stack([low + begin * voxel, low + end * voxel]), tuple(int(n) for n in end - begin)


def field_shape(voxels: tuple[int, int, int], limit: int) -> tuple[int, int, int]:
    """Cells of a field over so many voxels: merged by a whole factor while there are more than `limit`, small grids split."""
    factor = 1
    while np.prod([n * (factor + 1) + 1 for n in voxels]) <= min(_SMALL, limit):
        factor += 1
    if factor > 1:
        return tuple(n * factor for n in voxels)
    while np.prod([-(-n // factor) + 1 for n in voxels]) > limit:
        factor += 1
    return tuple(-(-n // factor) for n in voxels)


def sky_field(
    scene: Scene,
    marching: extinction.MarchingMedium,
    sampler: EnvironmentLight,
    eye: Float[np.ndarray, "3"],
    *,
    num_directions: int,
    caster: ray_casting.Caster,
    max_vertices: int = MAX_VERTICES,
) -> SkyField:
    """Sweep all directions; eager. `sampler` draws directions (`sky_sampling.guided`), radiance is the scene's."""
    medium = marching.regions[0]
    bounds, voxels = occupied(medium)
    shape = field_shape(voxels, max_vertices)
    low, high = bounds
    bounds = jnp.asarray(bounds, jnp.float32)
    cell = (high - low) / np.array(shape)
    index = jnp.arange(num_directions, dtype=jnp.uint32)
    u1, u2 = patterns.shifted(jnp.uint32(0), jnp.zeros_like(index), index, 7, 2)
    towards, radiance = _draw(scene.environment, sampler, u1, u2)
    towards, radiance = np.asarray(towards), np.asarray(radiance) / num_directions
    visible = _visibility(caster, low, high, towards)
    if visible is not None:
        seen = visible.reshape(num_directions, -1).max(axis=1) > 0
        towards, radiance, visible = towards[seen], radiance[seen], visible[seen]
        visible = None if visible.size == 0 or visible.min() == 1 else visible
    density = _cell_density(marching, bounds, shape=shape, parts=tuple(-(-n // m) for n, m in zip(voxels, shape, strict=True)))
    eyes = _eye_directions(bounds, jnp.asarray(eye, jnp.float32), shape=shape)
    total = jnp.zeros((3, *(n + 1 for n in shape)), jnp.float32)
    axis_of = np.argmax(np.abs(towards) / cell, axis=1)
    grey = bool(np.ptp(np.asarray(media.sigma_t(medium))) == 0.0)
    sweep = _jitted_sweep(jax.default_backend())
    for axis in range(3):
        mine = np.flatnonzero(axis_of == axis)
        if mine.size == 0:
            continue
        order = (axis, *(i for i in range(3) if i != axis))
        sweeps = _sweeps(order, cell, towards[mine], radiance[mine], None if visible is None else visible[mine], num_directions)
        aside = tuple(jnp.transpose(eyes[i], order) for i in order)
        found = sweep(medium, sweeps, jnp.transpose(density, order), aside, grey=grey)
        total = total + jnp.transpose(found, (0, *(1 + int(i) for i in np.argsort(order))))
    return SkyField(_pack(total), bounds, shape)


@jax.jit
def _draw(environment, sampler, u1, u2):
    towards, pdf = lights.sample_environment(sampler, u1, u2)
    return towards, lights.environment_radiance(environment, towards) / pdf[:, None]


def _visibility(caster, low, high, towards):
    """Whether the sky is seen from points spread over the box, [K, P, P, P]; None when it always is."""
    if caster is None:
        return None
    steps = [np.linspace(a, b, _VISIBILITY_POINTS) for a, b in zip(low, high, strict=True)]
    points = np.stack(np.meshgrid(*steps, indexing="ij"), axis=-1).reshape(-1, 3).astype(np.float32)
    # A surface may touch the box: from its faces rays start a little inside.
    middle = (0.5 * (low + high)).astype(np.float32)
    points = middle + (points - middle) * np.float32(1.0 - 1e-4)
    seen = []
    for way in towards:
        rays = points, np.broadcast_to(way, points.shape), np.full(len(points), np.inf, np.float32)
        seen.append(~np.asarray(ray_casting.occluded(caster, *rays)))
    seen = np.stack(seen).reshape(len(towards), *(3 * (_VISIBILITY_POINTS,)))
    return None if seen.all() else seen.astype(np.float32)


@partial(jax.jit, static_argnames=("shape", "parts"))
def _cell_density(marching, bounds, *, shape, parts):
    """Density of the field's cells: the mean over lookups, one for each voxel of the grid that a cell covers."""
    low, high = bounds
    size = (high - low) / jnp.asarray(shape, jnp.float32)
    cells = jnp.stack(jnp.meshgrid(*(jnp.arange(n, dtype=jnp.float32) for n in shape), indexing="ij"), axis=-1)
    total = jnp.zeros(shape, jnp.float32)
    for offset in np.ndindex(*parts):
        inside = jnp.asarray((np.array(offset) + 0.5) / np.array(parts), jnp.float32)
        total = total + extinction.region_density(marching, 0, low + (cells + inside) * size)
    return total / float(np.prod(parts))


@partial(jax.jit, static_argnames="shape")
def _eye_directions(bounds, eye, *, shape):
    """Unit directions from the eye to the vertices, one array per component."""
    steps = [jnp.linspace(bounds[0, i], bounds[1, i], n + 1) - eye[i] for i, n in enumerate(shape)]
    delta = jnp.meshgrid(*steps, indexing="ij")
    inverse = lax.rsqrt(jnp.maximum(sum(d * d for d in delta), 1e-20))
    return tuple(d * inverse for d in delta)


def _sweeps(order, cell, towards, radiance, visible, capacity):
    """What the kernel wants of the directions swept along `order[0]`, padded so that scenes share a compilation."""
    travel = -towards[:, list(order)]
    sizes = cell[list(order)]
    step = sizes[0] / np.abs(travel[:, 0])  # way between layers
    shear = travel[:, 1:] * step[:, None] / sizes[1:]

    def padded(x):
        return jnp.asarray(np.concatenate([x, np.zeros((capacity - len(x), *x.shape[1:]))]), jnp.float32)

    if visible is not None:
        visible = padded(np.transpose(visible, (0, *(1 + i for i in order))))
    return _Sweeps(
        count=jnp.int32(len(towards)),
        ascending=padded((travel[:, 0] > 0).astype(np.float64)),
        shear=padded(shear),
        length=padded(step),
        towards=padded(-travel),
        radiance=padded(radiance),
        visible=visible,
    )


@cache
def _jitted_sweep(backend):
    """The jitted `_sweep`, compiled so that its barriers last: five times faster on a CPU."""
    return jax.jit(_sweep, static_argnames="grey", compiler_options=compiler_options(backend))


def _sweep(medium, sweeps, density, eyes, *, grey):
    """Sum over directions of radiance times phase function times transmittance at the vertices [3, n+1, n1+1, n2+1].

    A line that crosses vertex layer j at i + f (cells along one other axis, f in [0, 1)) crosses layer j + 1 at
    i + f + shear. Lines are kept in the order of their crossings: entry m is at m - 1 + f. Barriers keep what several
    loops read from being computed anew in each. `grey`: all channels have one transmittance.
    """
    n, n1, n2 = density.shape
    sigma_t = media.sigma_t(medium)
    padded = jnp.pad(density, ((0, 0), (2, 3), (2, 3)), mode="edge")
    lines = jnp.arange(n1 + 3, dtype=jnp.float32) - 1.0, jnp.arange(n2 + 3, dtype=jnp.float32) - 1.0
    rows = None if sweeps.visible is None else [_hat_weights(m + 1) for m in (n, n1, n2)]

    def one_direction(k, total):
        shear, length, towards = sweeps.shear[k], sweeps.length[k], sweeps.towards[k]
        ascending = sweeps.ascending[k] > 0
        # Vertices on the faces through which light enters have depth 0; lines beside them would be interpolated.
        edges = [_entry_mask(shear[i], m + 1) for i, m in enumerate((n1, n2))]
        entry = edges[0][:, None] * edges[1][None, :]

        def layer(j, carry):
            total, depth = carry
            at = jnp.where(ascending, j, n - j)
            f = [_fraction(j * shear[i]) for i in (0, 1)]
            here = _between(depth, f, n1 + 1, n2 + 1) * entry
            cosine = towards[0] * eyes[0][at] + towards[1] * eyes[1][at] + towards[2] * eyes[2][at]
            scattered = _kept(phase.evaluate(medium, cosine))
            if rows is not None:
                seen = jnp.tensordot(rows[0][at], sweeps.visible[k], axes=1)
                scattered = scattered * (rows[1] @ seen @ rows[2].T)
            if grey:
                arriving = [_kept(scattered * jnp.exp(-sigma_t[0] * here))] * 3
            else:
                arriving = [scattered * jnp.exp(-sigma_t[c] * here) for c in range(3)]
            total = tuple(t.at[at].add(arriving[c] * sweeps.radiance[k, c]) for c, t in enumerate(total))
            # Through the layer of cells to the next vertices; after the last one this is thrown away.
            mine = lax.dynamic_index_in_dim(padded, jnp.clip(jnp.where(ascending, j, n - 1 - j), 0, n - 1), keepdims=False)
            passed = _layer_density(mine, f, shear, n1, n2) * _inside(lines, f, shear, n1, n2)
            depth = _kept(depth + length * passed)
            moved = [jnp.floor((j + 1) * shear[i]) - jnp.floor(j * shear[i]) for i in (0, 1)]
            shift = [1 - moved[i].astype(jnp.int32) for i in (0, 1)]
            depth = lax.dynamic_slice(jnp.pad(depth, 1), shift, depth.shape)
            return total, depth

        start = jnp.zeros((n1 + 3, n2 + 3), jnp.float32)
        return lax.fori_loop(0, n + 1, layer, (total, start))[0]

    empty = tuple(jnp.zeros((n + 1, n1 + 1, n2 + 1), jnp.float32) for _ in range(3))
    return jnp.stack(lax.fori_loop(0, sweeps.count, one_direction, empty))


_kept = lax.optimization_barrier  # computed once


def _fraction(x):
    return x - jnp.floor(x)


def _entry_mask(shear, num):
    """0 at the vertices of the side face through which light enters, 1 elsewhere."""
    index = jnp.arange(num)
    first, last = (shear > 1e-6) & (index == 0), (shear < -1e-6) & (index == num - 1)
    return jnp.where(first | last, 0.0, 1.0)


def _between(depth, f, num1, num2):
    """Depths at vertices from those of the lines on both sides: entry m is at m - 1 + f."""
    rows = _kept(_kept(_across(depth, f[0], num1)).T)
    return jnp.maximum(_kept(_across(rows, f[1], num2)).T, 0.0)


def _across(depth, f, num):
    """Between lines along the first axis: parabolas, as lines under a cloud's edge see depth grow with its square.

    Straight lines alone would say a few per cent too much, always. The smaller bend of both sides' counts, none where
    they differ in sign: at a face of the box depth has a kink, and straight lines are exact there.
    """
    bend = jnp.pad(depth[2:] - 2.0 * depth[1:-1] + depth[:-2], ((1, 1), (0, 0)))
    left, right = bend[:num], bend[1 : num + 1]
    common = jnp.where(left * right > 0.0, jnp.where(jnp.abs(left) < jnp.abs(right), left, right), 0.0)
    return f * depth[:num] + (1.0 - f) * depth[1 : num + 1] - 0.5 * f * (1.0 - f) * common


def _layer_density(layer, f, shear, n1, n2):
    """Density where the lines cross the middle of a layer; cell i has its centre at i + 1/2 and is entry i + 2 of `layer`.

    Line m is at cell m - 1 + x, x = f + shear / 2 - 1/2 in [-1, 1): three hat weights along each axis, for all lines.
    """
    weights = [[jnp.maximum(1.0 - jnp.abs(f[i] + 0.5 * shear[i] - 0.5 - o), 0.0) for o in (-1, 0, 1)] for i in (0, 1)]
    rows = _kept(sum(w * layer[o : o + n1 + 3] for o, w in enumerate(weights[0])))
    return sum(w * rows[:, o : o + n2 + 3] for o, w in enumerate(weights[1]))


def _inside(lines, f, shear, n1, n2):
    """Share of each line's way through a layer that is inside the box."""
    ends = []
    for i, size in enumerate((n1, n2)):
        start = lines[i] + f[i]
        still = jnp.abs(shear[i]) < 1e-6
        inverse = 1.0 / jnp.where(still, 1.0, shear[i])
        a, b = -start * inverse, (size - start) * inverse
        within = (start >= 0.0) & (start <= size)
        ends.append(jnp.where(still, jnp.where(within, 0.0, 1.0), jnp.clip(jnp.minimum(a, b), 0.0, 1.0)))
        ends.append(jnp.where(still, jnp.where(within, 1.0, 0.0), jnp.clip(jnp.maximum(a, b), 0.0, 1.0)))
    # Without the barrier every line of the plane would compute them anew.
    enter1, leave1, enter2, leave2 = _kept(tuple(ends))
    enter, leave = (jnp.maximum(enter1[:, None], enter2), jnp.minimum(leave1[:, None], leave2))
    return jnp.maximum(leave - enter, 0.0)


def _hat_weights(num):
    """Linear interpolation from the points of visibility to vertices, [num, P]."""
    position = np.arange(num) / max(num - 1, 1) * (_VISIBILITY_POINTS - 1)
    weight = np.maximum(1.0 - np.abs(position[:, None] - np.arange(_VISIBILITY_POINTS)), 0.0)
    return jnp.asarray(weight, jnp.float32)


@jax.jit
def _pack(total):
    """log J of the eight corners of each cell, RGB: [cells, 24]."""
    values = jnp.log(jnp.maximum(jnp.moveaxis(total, 0, -1), _DARK))
    nx, ny, nz = (s - 1 for s in values.shape[:3])
    corners = [values[i : i + nx, j : j + ny, k : k + nz] for i in (0, 1) for j in (0, 1) for k in (0, 1)]
    return jnp.concatenate(corners, axis=-1).reshape(-1, 24)


def scattered_radiance(field: SkyField, points: Float[Array, "*b 3"]) -> Float[Array, "*b 3"]:
    """J at points inside the box: radiance that a particle of albedo one scatters to the eye, 1/sr included."""
    coordinate = media.voxel_coordinates(field.bounds, field.shape, points)
    cell = [jnp.clip(coordinate[..., i].astype(jnp.int32), 0, n - 1) for i, n in enumerate(field.shape)]
    f = [jnp.clip(coordinate[..., i] - cell[i], 0.0, 1.0)[..., None] for i in range(3)]
    rows = field.corners[(cell[0] * field.shape[1] + cell[1]) * field.shape[2] + cell[2]]
    z = [rows[..., 6 * i : 6 * i + 3] * (1.0 - f[2]) + rows[..., 6 * i + 3 : 6 * i + 6] * f[2] for i in range(4)]
    y = [z[2 * i] * (1.0 - f[1]) + z[2 * i + 1] * f[1] for i in range(2)]
    return jnp.exp(y[0] * (1.0 - f[0]) + y[1] * f[0])
