"""Transport along many directions, and the correction of the lattice's fluence by it.

The lattice's links are few: 26 directions leave ray effects, and in a slab a third of their weight never meets its faces
(reflectance of a slab of thickness 2: +6 %). `transport` here runs the same kind of sweep along 80 directions, each from
plane to plane of its dominant axis. They integrate all polynomials of degree 7, and the flux through a face besides: half
of |cos| and of |cos|^3. The level-symmetric S8 set (Carlson and Lathrop 1965), of as many directions, lets 1.7 % too much
out through faces; a slab of thickness 8 is 1.3 % dark with it. What a voxel passes on and emits is the lattice's own map
(`beta_gamma`), which keeps all power; between the columns of a plane intensities are interpolated by parabolas: linear
interpolation spreads light sideways by f (1 - f) voxels^2 a step, which is 8 % of the diffusion constant at sigma_t h =
0.5 (measured: a point source in a cube 4.1 % off with it, 1.4 % without). The parabolas are those of Lax and Wendroff in
flux form: what is not conserved at the faces shows as reflectance (+4 % at thickness 8).

Intensities move sideways between planes; with the exponential map, which is that of thick voxels, in the middle of each
step. Then as much light leaves an opaque voxel through its sides as marched light enters there: under an even sky, where
all is 1, a cube of 6^3 voxels of 50 mean free paths each is 22 % too bright in its corners otherwise and 7 % on average
(now 1.0 and .5 %).

The correction (illumination.py) removes the lattice's angular error: phi <- phi + (I - B26 k)^-1 (B80 (k phi + b) - phi),
two of them, each a lattice solve, also for moments of anisotropic light (`moments`).
"""

from itertools import permutations

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from jaxvol.methods.lattice_boltzmann.anisotropy import basis
from jaxvol.methods.lattice_boltzmann.lattice import ProbabilityMap, beta_gamma

# points and weights of one octant, with all orders of their components: the weights sum to 1, and so that the means of
# |x|, |x|^3, x^4, x^6 and (x y z)^2 are 1/2, 1/4, 1/5, 1/7 and 1/105
_POINTS = (
    ((0.6784016, 0.6784016, 0.2820329), 0.1092940),
    ((0.9210917, 0.3809143, 0.0805876), 0.0960954),
    ((0.5773503, 0.5773503, 0.5773503), 0.0955456),
)


def directions() -> tuple[tuple[tuple[float, float, float], float], ...]:
    """((x, y, z), weight) of the 40 directions whose dominant component is positive; weights of all 80 sum to 1."""
    found = {}
    for point, weight in _POINTS:
        for cosines in permutations(point):
            for signs in np.ndindex(2, 2, 2):
                vector = tuple(c if s == 0 else -c for c, s in zip(cosines, signs, strict=True))
                dominant = max(range(3), key=lambda a: (abs(vector[a]), -a))
                if vector[dominant] > 0:
                    found[vector] = weight / 8.0
    return tuple(sorted(found.items()))


def transport(
    extinction: Float[Array, "..."], source: Float[Array, "X Y Z"], *, kind: ProbabilityMap = "pade"
) -> Float[Array, "X Y Z"]:
    """phi: the fluence times h^2 that an isotropic source [W per voxel] makes without scattering, from sigma_t h."""
    return moments(extinction, source[None], degree=0, kind=kind)[0]


def moments(
    extinction: Float[Array, "..."], sources: Float[Array, "n X Y Z"], *, degree: int, kind: ProbabilityMap = "pade"
) -> Float[Array, "n X Y Z"]:
    """The same for sources with the moments of `anisotropy.basis`, up to `degree`: moments of the light that they make."""
    total = jnp.zeros_like(sources)
    for axis in range(3):
        along = (axis, *(a for a in range(3) if a != axis))
        back = (0, *(1 + int(k) for k in np.argsort(along)))
        mine = [(v, w) for v, w in directions() if max(range(3), key=lambda a, v=v: (abs(v[a]), -a)) == axis]
        moved = extinction if jnp.ndim(extinction) == 0 else jnp.transpose(extinction, along)
        emitted = jnp.transpose(sources, (1 + axis, 0, *(1 + a for a in along[1:])))  # planes first
        found = sum(_scan(moved, emitted, mine, along, degree, kind, sense=sense) for sense in (1, -1))
        total = total + jnp.transpose(jnp.moveaxis(found, 1, 0), back)
    return total


def _scan(extinction, sources, mine, along, degree, kind, *, sense):
    steps = []  # (length of a step, weight, shifts of rows and columns, values of the basis)
    for vector, weight in mine:
        length = 1.0 / vector[along[0]]
        values = [float(v) for v in basis(*(sense * np.array(vector)), degree)]
        steps.append((round(length, 6), weight, vector[along[1]] * length, vector[along[2]] * length, values))
    lengths = sorted({length for length, *_ in steps})
    varying = jnp.ndim(extinction) > 0

    halves = kind == "exp"

    def links(sigma):
        """(what of an arrival counts, of the own source, what passes, of the source) by the length of a step or of its half."""
        maps = {length: beta_gamma(length * sigma, kind) for length in lengths}
        if halves:
            return {k: _half(k, jnp.exp(-0.5 * k * sigma), *found) for k, found in maps.items()}
        return {k: (beta, k * gamma, 1.0 - k * sigma * beta, k * beta) for k, (beta, gamma) in maps.items()}

    same = None if varying else links(extinction)

    def body(faces, planes):
        sigma, source = planes if varying else (extinction, planes)
        voxel = links(sigma) if varying else same
        across = tuple(_alike(sigma, axis) for axis in (0, 1)) if varying and halves else (1.0, 1.0)
        gathered, leaving = [0.0] * source.shape[0], []
        for face, (length, weight, row_shift, column_shift, values) in zip(faces, steps, strict=True):
            beta, own, through, out = voxel[length]
            emitted = sum(v * source[n] for n, v in enumerate(values))
            entering = face
            if halves:
                face = through * face + out * emitted
            face = _shift(face, 0, sense * row_shift, across[0])
            face = _shift(face, 1, sense * column_shift, across[1])
            counted = 0.5 * (entering + face) if halves else face
            mean = weight * (beta * counted + own * emitted)
            gathered = [total + v * mean for total, v in zip(gathered, values, strict=True)]
            leaving.append(through * face + out * emitted)
        return tuple(leaving), jnp.stack(gathered)

    start = tuple(jnp.zeros(sources.shape[2:], sources.dtype) for _ in steps)
    return lax.scan(body, start, (extinction, sources) if varying else sources, reverse=sense < 0)[1]


def _half(length, passing, beta, gamma):
    """The same four numbers of half a step, two of which make the step of `beta_gamma`."""
    share = beta / (1.0 + passing)
    return 2.0 * share, length * (gamma - share * share), passing, length * share


def _alike(sigma, axis):
    """1 between columns of like transmittance, down to 0 between clear and opaque ones; 1 at the outer faces."""
    passing = jnp.exp(-sigma)
    low, high = (lax.slice_in_dim(passing, k, sigma.shape[axis] + k - 1, axis=axis) for k in (0, 1))
    widths = [(1, 1) if a == axis else (0, 0) for a in range(2)]
    return jnp.pad(1.0 - jnp.abs(high - low), widths, constant_values=1.0)


def _shift(plane, axis, amount, alike=1.0):
    """The plane moved by a fraction t of a column, at most 1: parabola through a column, its source and its successor.

    In flux form, a column passes t (p + (1 - t)/2 (its successor - p)) on (Lax and Wendroff 1960), so that nothing is
    lost inside. Nothing comes in at the first column. Beyond the last one the plane goes on linearly: held constant, too
    much of it leaves where it falls towards the face (1.5 % of the fluence there, at sigma_t h = 0.5). The slope counts as
    much as columns are `alike`: light leaves an opaque column for a clear one as bright as it is.
    """
    t, size = abs(amount), plane.shape[axis]
    if t < 1e-6:
        return plane
    low, high = (lax.slice_in_dim(plane, k, k + 1, axis=axis) for k in (0, size - 1))
    inflow, outflow = (low, high) if amount > 0 else (high, low)
    inner = max(size - 2, 0) if amount > 0 else min(1, size - 1)
    before = -(1.0 - t) / (1.0 + t) * inflow  # then its inflow is zero
    beyond = 2.0 * outflow - lax.slice_in_dim(plane, inner, inner + 1, axis=axis)
    padded = jnp.concatenate([before, plane, beyond] if amount > 0 else [beyond, plane, before], axis=axis)
    left, right = (lax.slice_in_dim(padded, k, k + size + 1, axis=axis) for k in (0, 1))
    source, successor = (left, right) if amount > 0 else (right, left)
    flow = amount * (source + 0.5 * (1.0 - t) * alike * (successor - source))
    return plane + lax.slice_in_dim(flow, 0, size, axis=axis) - lax.slice_in_dim(flow, 1, size + 1, axis=axis)
