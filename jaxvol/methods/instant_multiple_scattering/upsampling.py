"""Evaluate few pixels, reconstruct the others, evaluate again where that fails (section 5 of the paper).

What is interpolated is the mean source along the ray, L / (1 - exp(-tau)), and the irradiance-like L / (tau albedo) of
surfaces, not the radiance: transmittance and albedo are known at every pixel and put back sharp.
"""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxvol import media, ray_casting
from jaxvol.methods.instant_multiple_scattering import receivers
from jaxvol.methods.instant_multiple_scattering.receivers import Segments
from jaxvol.types import Scene

_FLOOR = 1e-4  # of a demodulation factor: below it nothing is seen anyway


class Guides(eqx.Module):
    """What is cheap to know of every pixel and tells which neighbours resemble it."""

    enter: Float[Array, "n"]  # distance to the medium, in units of the scene
    end: Float[Array, "n"]  # distance to where the ray leaves it or meets a surface, in units of the scene
    inside: Bool[Array, "n"]  # the ray crosses the medium
    hits: Bool[Array, "n"]  # the ray meets a surface
    normal: Float[Array, "n 3"]
    source: Float[Array, "n 3"]  # 1 - exp(-tau): radiance of a unit source along the ray
    reflectance: Float[Array, "n 3"]  # tau * (albedo + specular)


@partial(jax.jit, static_argnames="num_steps")
def guides(
    scene: Scene,
    origin: Float[Array, "n 3"],
    direction: Float[Array, "n 3"],
    t: Float[Array, "n"],
    face: Array,
    *,
    num_steps: int,
) -> Guides:
    """Guides of eye rays with first hits (t, face)."""
    n = t.shape[0]
    hit = ray_casting.hits(scene.mesh, origin, direction, t, face)
    enter = jnp.zeros(n, jnp.float32)
    end = jnp.where(hit.valid, hit.t, 0.0)
    inside = jnp.zeros(n, bool)
    depth = jnp.zeros((n, 3), jnp.float32)
    size = jnp.float32(1.0) if scene.mesh is None else ray_casting.scene_scale(scene.mesh)
    if scene.medium is not None:
        t0, t1 = media.box_interval(scene.medium.bounds, origin, direction)
        t1 = jnp.maximum(jnp.minimum(t1, t), t0)
        segments = Segments(origin, direction, t0, t1, None)
        column = t1 - t0
        if scene.medium.density is not None:
            column = receivers.columns_along(segments, scene.medium, num_steps=num_steps)[-1]
        depth = column[:, None] * media.sigma_t(scene.medium)
        inside = t1 > t0
        enter, end = t0, jnp.where(hit.valid, hit.t, t1)
        size = 0.5 * jnp.max(scene.medium.bounds[1] - scene.medium.bounds[0])
    reflectance = jnp.zeros((n, 3), jnp.float32)
    if scene.mesh is not None:
        index = jnp.maximum(face, 0)
        reflectance = scene.mesh.albedo[index]
        if scene.mesh.specular is not None:
            reflectance = reflectance + scene.mesh.specular[index]
        reflectance = jnp.where(hit.valid[:, None], reflectance * jnp.exp(-depth), 0.0)
    return Guides(enter / size, end / size, inside, hit.valid, hit.normal, -jnp.expm1(-depth), reflectance)


def demodulate(value: Float[Array, "n 3"], factor: Float[Array, "n 3"]) -> Float[Array, "n 3"]:
    """value / factor, 0 where the factor vanishes."""
    return jnp.where(factor > _FLOOR, value / jnp.maximum(factor, _FLOOR), 0.0)


@partial(jax.jit, static_argnames=("height", "width", "factor"))
def reconstruct(
    low: dict[str, Float[Array, "m 3"]],
    low_guides: Guides,
    full_guides: Guides,
    *,
    height: int,
    width: int,
    factor: int,
    pixels: Int[Array, "n"] | None = None,
    spread: float = 0.3,
) -> tuple[dict[str, Float[Array, "n 3"]], Float[Array, "n"]]:
    """Layers at `pixels` (None: all) from the low-resolution ones, and the weight that their neighbours had (0: none fits).

    Weights are bilinear * exp(-|difference of (enter, end)|^2 / (2 spread^2)) * (same kind) * (normals agree).
    """
    rows, columns = -(-height // factor), -(-width // factor)
    flat = {
        name: demodulate(value, low_guides.source if name.startswith("volume") else low_guides.reflectance)
        for name, value in low.items()
    }
    pixels = jnp.arange(height * width) if pixels is None else pixels
    y = (pixels // width + 0.5) / factor - 0.5
    x = (pixels % width + 0.5) / factor - 0.5
    y0, x0 = jnp.floor(y).astype(jnp.int32), jnp.floor(x).astype(jnp.int32)
    total = jnp.zeros(pixels.shape, jnp.float32)
    sums = {name: jnp.zeros((*pixels.shape, 3), jnp.float32) for name in low}
    for dy in (0, 1):
        for dx in (0, 1):
            row, column = jnp.clip(y0 + dy, 0, rows - 1), jnp.clip(x0 + dx, 0, columns - 1)
            bilinear = (1.0 - jnp.abs(y - (y0 + dy))) * (1.0 - jnp.abs(x - (x0 + dx)))
            i = row * columns + column
            weight = bilinear * _likeness(jax.tree.map(lambda g, i=i: g[i], low_guides), full_guides, spread)
            total = total + weight
            sums = {name: sums[name] + weight[:, None] * flat[name][i] for name in sums}
    result = {}
    for name, value in sums.items():
        modulation = full_guides.source if name.startswith("volume") else full_guides.reflectance
        result[name] = value / jnp.maximum(total, 1e-12)[:, None] * modulation
    return result, total


def _likeness(a, b, spread):
    enter, end = a.enter - b.enter, a.end - b.end
    near = jnp.exp(-(enter * enter + end * end) * (0.5 / (spread * spread)))
    same = (a.inside == b.inside) & (a.hits == b.hits)
    faces = jnp.sum(a.normal * b.normal, axis=-1) > 0.9
    return jnp.where(same & (faces | ~a.hits), near, 0.0)
