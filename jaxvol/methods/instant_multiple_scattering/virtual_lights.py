"""Virtual point lights: the vertices of light paths, sorted by what they contribute to, ready for the gather kernels."""

import math
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxvol.methods.instant_multiple_scattering.light_paths import Vertices
from jaxvol.types import Scene

BLOCKS = ("volume_first", "volume_later", "surface_first", "surface_later")
ORIGIN = {"volume_first": "volume", "volume_later": "multiple", "surface_first": "surface", "surface_later": "multiple"}


class VirtualLights(eqx.Module):
    """Lights of one kind; rows beyond the real number have strength 0.

    Radiance leaving towards w: in the medium strength * f_p(direction . w); on a surface (strength + specular lobe) * D,
    D = max(0, normal . w) the emitter's cosine.
    """

    position: Float[Array, "M 3"]
    direction: Float[Array, "M 3"]  # in the medium: travel, arriving; on a surface: after an ideal reflection
    strength: Float[Array, "M 3"]  # L_i sigma_s / N, or L_i albedo / (pi N)
    normal: Float[Array, "M 3"] | None = None  # on the lit side; None: in the medium
    specular: Float[Array, "M 3"] | None = None  # L_i specular (n + 2) / (2 pi N)
    exponent: Float[Array, "M"] | None = None


class LightSet(eqx.Module):
    """All virtual lights by kind and by whether they are the first interaction of their path; None = there are none."""

    volume_first: VirtualLights | None = None
    volume_later: VirtualLights | None = None
    surface_first: VirtualLights | None = None
    surface_later: VirtualLights | None = None


def capacity(count: int) -> int:
    """`count` rounded up to 4, 5, 6 or 7 times a power of two, at least 64: similar sets share a compilation."""
    size = 64
    while size < count:
        size *= 2
    for eighths in (4, 5, 6, 7):
        if size * eighths // 8 >= max(count, 64):
            return size * eighths // 8
    return size


def _pad(values, size, filler=0.0):
    values = np.asarray(values, np.float32)
    padded = np.full((size, *values.shape[1:]), filler, np.float32)
    padded[: len(values)] = values
    return jnp.asarray(padded)


def _in_medium(medium, vertices, num_paths, size):
    strength = vertices.incident * vertices.density[:, None] * (np.asarray(medium.sigma_s) / num_paths)
    # Padding has a unit-sized direction, so that phase functions of it stay finite.
    direction = _pad(vertices.direction, size, math.sqrt(1.0 / 3.0))
    return VirtualLights(_pad(vertices.position, size), direction, _pad(strength, size))


def _on_surface(mesh, vertices, num_paths, size):
    face, direction = vertices.face, vertices.direction
    corners = np.asarray(mesh.vertices)[np.asarray(mesh.faces)[face]]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal = normal / np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-30)
    cosine = np.sum(normal * direction, axis=-1, keepdims=True)
    mirrored = direction - 2.0 * cosine * normal
    normal = np.where(cosine > 0, -normal, normal)
    incident = vertices.incident / num_paths
    strength = incident * np.asarray(mesh.albedo)[face] / np.pi
    position, normal = _pad(vertices.position, size), _pad(normal, size)
    if mesh.specular is None:
        return VirtualLights(position, _pad(mirrored, size), _pad(strength, size), normal)
    exponent = np.asarray(mesh.exponent)[face]
    lobe = incident * np.asarray(mesh.specular)[face] * ((exponent + 2.0) / (2.0 * np.pi))[:, None]
    return VirtualLights(position, _pad(mirrored, size), _pad(strength, size), normal, _pad(lobe, size), _pad(exponent, size))


def _is_black(mesh, face):
    """Whether faces reflect nothing."""
    dark = np.asarray(mesh.albedo)[face].max(axis=-1) == 0
    return dark if mesh.specular is None else dark & (np.asarray(mesh.specular)[face].max(axis=-1) == 0)


def virtual_lights(scene: Scene, vertices: Vertices, *, num_paths: int, sizes: dict[str, int] | None = None) -> LightSet:
    """Turn path vertices (numpy) into sets of lights; `num_paths` counts ALL emitted paths, also those that missed.

    Vertices on black surfaces send nothing and are left out. `sizes` are array sizes to keep where they suffice, so that
    the next set of lights needs no compilation.
    """
    first = vertices.depth == 0
    surface = vertices.face >= 0
    sends = vertices.valid
    if scene.mesh is not None:
        sends = sends & ~(surface & _is_black(scene.mesh, np.maximum(vertices.face, 0)))
    chosen = {
        "volume_first": first & ~surface,
        "volume_later": ~first & ~surface,
        "surface_first": first & surface,
        "surface_later": ~first & surface,
    }
    found = {}
    for name, rows in chosen.items():
        part = jax.tree.map(lambda x, rows=rows: np.asarray(x)[rows & sends], vertices)
        count, size = len(part.path), (sizes or {}).get(name, 0)
        if count > size:
            size = capacity(count) if sizes is None else capacity(count + count // 8)
        if size == 0:
            found[name] = None
        elif name.startswith("surface"):
            found[name] = _on_surface(scene.mesh, part, num_paths, size)
        else:
            found[name] = _in_medium(scene.medium, part, num_paths, size)
    return LightSet(**found)


def blocks(lights: LightSet) -> list[tuple[str, VirtualLights]]:
    """Name and lights of every kind that exists."""
    return [(name, getattr(lights, name)) for name in BLOCKS if getattr(lights, name) is not None]


def sizes(lights: LightSet) -> dict[str, int]:
    """Array size of every kind, for the next call of `virtual_lights`."""
    return {name: block.position.shape[0] for name, block in blocks(lights)}


def num_lights(lights: LightSet) -> int:
    """Capacity of all blocks together: the number of lights that a full gather evaluates."""
    return sum(block.position.shape[0] for _, block in blocks(lights))


@partial(jax.jit, static_argnames="stride")
def subset(lights: VirtualLights, offset: Array, *, stride: int) -> VirtualLights:
    """Every `stride`-th light from `offset` on, weighted up: unbiased when `offset` is uniform in 0 ... stride - 1."""

    def thin(x):
        return x.reshape(x.shape[0] // stride, stride, *x.shape[1:])[:, offset]

    scaled = jax.tree.map(thin, lights)
    specular = None if scaled.specular is None else scaled.specular * stride
    return VirtualLights(scaled.position, scaled.direction, scaled.strength * stride, scaled.normal, specular, scaled.exponent)
