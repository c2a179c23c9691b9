"""Light paths that survive from frame to frame (section 7): reweighted, retraced or renewed, never all traced again.

While only the medium changes, a path's vertices stay and its throughput is recomputed: every segment's transmittance and
every scattering is replaced by the new medium's, L_i new = L_i old * prod tau_new / tau_old * prod (sigma_s f_p) new /
old. That is the estimator L tau / p_old with the old pdf, unbiased as long as the old medium scattered wherever the new one
does. Vertices of paths that moving geometry touches are traced again from the same random numbers.
"""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxvol import media, phase, ray_casting, sampling
from jaxvol.methods.instant_multiple_scattering import light_paths, receivers
from jaxvol.methods.instant_multiple_scattering.light_paths import Vertices
from jaxvol.types import Scene


def segment_starts(scene: Scene, vertices: Vertices, *, seed: int) -> Float[np.ndarray, "m 3"]:
    """Where the segment that arrives at each vertex began: the vertex before, or the point on the light."""
    padded = light_paths.padded(np.asarray(vertices.path, np.uint32))
    emitted = light_paths.emit(scene, jnp.asarray(padded), jnp.uint32(seed))
    origin = np.asarray(emitted.origin)[: len(vertices.path)]
    before = np.roll(np.asarray(vertices.position), 1, axis=0)
    return np.where((np.asarray(vertices.depth) == 0)[:, None], origin, before)


@partial(jax.jit, static_argnames="num_steps")
def _ratios(old, new, start, position, direction, outgoing, surface, *, num_steps):
    """tau_new / tau_old of the arriving segments, (sigma_s f_p) new / old of the scatterings, and the new density."""
    columns = [receivers.column_between(m, start, position, num_steps=num_steps) for m in (old, new)]
    depths = [c[:, None] * media.sigma_t(m) for c, m in zip(columns, (old, new), strict=True)]
    densities = [media.density(m, position) for m in (old, new)]
    cosine = sampling.dot(direction, outgoing)
    before, after = (
        d[:, None] * m.sigma_s * phase.evaluate(m, cosine)[:, None] for d, m in zip(densities, (old, new), strict=True)
    )
    scattering = jnp.where(before > 0, after / jnp.where(before > 0, before, 1.0), 0.0)
    scattering = jnp.where(surface[:, None], 1.0, scattering)
    return jnp.exp(depths[0] - depths[1]), scattering, jnp.where(surface, 1.0, densities[1])


def reweighted(old: Scene, new: Scene, vertices: Vertices, *, seed: int, num_steps: int = 32) -> Vertices:
    """The same paths with the throughput of the new scene's medium; geometry, materials and lights must be the same.

    Raises ValueError when one scene has a medium and the other has none.
    """
    if (old.medium is None) != (new.medium is None):
        raise ValueError("medium: paths can be reweighted only between two scenes that both have a medium")
    count = len(vertices.path)
    if old.medium is None or count == 0:
        return vertices
    start = segment_starts(old, vertices, seed=seed)
    surface = np.asarray(vertices.face) >= 0
    arrays = (start, vertices.position, vertices.direction, vertices.outgoing, surface)
    padded = [light_paths.padded(np.asarray(a)) for a in arrays]
    tau, scattering, density = (np.asarray(x)[:count] for x in _ratios(old.medium, new.medium, *padded, num_steps=num_steps))
    depth = np.asarray(vertices.depth)
    change = np.array(tau, np.float64)
    for d in range(1, int(depth.max(initial=0)) + 1):
        rows = np.flatnonzero(depth == d)  # sorted by path and depth: the row before is the vertex before
        change[rows] *= change[rows - 1] * scattering[rows - 1]
    incident = (vertices.incident * change).astype(np.float32)
    power = (vertices.power * change * scattering).astype(np.float32)
    return eqx.tree_at(lambda v: (v.incident, v.power, v.density), vertices, (incident, power, density))


def touched_paths(
    scene: Scene,
    caster: ray_casting.Caster,
    vertices: Vertices,
    paths: Int[np.ndarray, "n"],
    moved_faces: Bool[np.ndarray, "F"],
    *,
    seed: int,
) -> Int[np.ndarray, "k"]:
    """Numbers of the paths that geometry which moved can have changed; `scene` and `caster` are after the move.

    A path is touched when a vertex lies on a moved face, a segment is blocked, or a ray that left the scene meets a
    moved face. (A face that moved away from such a ray leaves it as it is.)
    """
    face = np.asarray(vertices.face)
    hit = np.zeros(len(face), bool)
    on = face >= 0
    hit[on] = moved_faces[face[on]]
    start, end = segment_starts(scene, vertices, seed=seed), np.asarray(vertices.position)
    delta = end - start
    length = np.maximum(np.linalg.norm(delta, axis=-1), 1e-30)
    direction = delta / length[:, None]
    margin = 1e-3 * length
    hit |= np.asarray(ray_casting.occluded(caster, start + margin[:, None] * direction, direction, length - 2 * margin))
    last = np.append(np.asarray(vertices.path)[1:] != np.asarray(vertices.path)[:-1], True)[: len(face)]
    leaves = np.flatnonzero(last & np.asarray(vertices.continues))
    outgoing = np.asarray(vertices.outgoing)[leaves]
    off = 1e-3 * float(ray_casting.scene_scale(scene.mesh))
    hit[leaves] |= _meets_moved(caster, end[leaves] + off * outgoing, outgoing, moved_faces)
    missed = np.setdiff1d(paths, np.asarray(vertices.path))
    emitted = light_paths.emit(scene, jnp.asarray(light_paths.padded(missed.astype(np.uint32))), jnp.uint32(seed))
    origin, away = (np.asarray(x)[: len(missed)] for x in (emitted.origin, emitted.direction))
    new = missed[_meets_moved(caster, origin, away, moved_faces)]
    return np.union1d(np.unique(np.asarray(vertices.path)[hit]), new)


def _meets_moved(caster, origin, direction, moved_faces):
    if len(origin) == 0:
        return np.zeros(0, bool)
    _, face = ray_casting.intersect(caster, origin, direction, np.inf)
    face = np.asarray(face)
    return (face >= 0) & moved_faces[np.maximum(face, 0)]


def replaced(vertices: Vertices, fresh: Vertices, paths: Int[np.ndarray, "k"]) -> Vertices:
    """`vertices` with everything of the given paths exchanged for `fresh`."""
    kept = ~np.isin(np.asarray(vertices.path), paths)
    joined = jax.tree.map(lambda a, b: np.concatenate([np.asarray(a)[kept], np.asarray(b)]), vertices, fresh)
    order = np.lexsort((joined.depth, joined.path))
    return jax.tree.map(lambda x: x[order], joined)


def renewed(paths: Array, *, frame: int, share: float, num_paths: int) -> tuple[np.ndarray, np.ndarray]:
    """Path numbers of the next frame, and which of the old ones go: every path lives for about 1 / share frames."""
    paths = np.asarray(paths)
    slots = paths % num_paths
    period = max(1, round(1.0 / share)) if share > 0 else 0
    out = (slots % period == frame % period) if period else np.zeros(len(paths), bool)
    return np.where(out, paths + num_paths, paths), paths[out]
