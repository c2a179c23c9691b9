"""Classes of light paths: their names, what a method claims of them, sums over them (ARCHITECTURE section 3).

A path is written from light to eye. Its class is its last scattering vertex before the eye, surface (S) or volume (V),
and what came before that. Null and refracting boundaries are no vertices.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxvol.types import Layers

NAMES = (
    "emission",  # L E
    "surface_from_light",  # L S E
    "surface_from_surface",  # L S S E
    "surface_from_volume",  # L V S E
    "surface_from_multiple",  # L (S or V){2+} S E
    "volume_from_light",  # L V E
    "volume_from_surface",  # L S V E
    "volume_from_volume",  # L V V E
    "volume_from_multiple",  # L (S or V){2+} V E
)
SURFACE = tuple(name for name in NAMES if name.startswith("surface_"))
VOLUME = tuple(name for name in NAMES if name.startswith("volume_"))


@dataclass(frozen=True)
class Claim:
    """One layer, or a sum of layers that the method cannot split, that a method computes for a given scene."""

    layers: tuple[str, ...]
    partial: str | None = None  # which paths of the class are missed, in words; None = complete

    @property
    def name(self) -> str:
        return "+".join(self.layers)


def canonical_sum(name: str) -> str:
    """The name of a sum with its parts in the order of `NAMES`. Raises ValueError for an unknown or repeated part."""
    parts = name.split("+")
    for part in parts:
        if part not in NAMES:
            raise ValueError(f"layer {part!r} is unknown; layers are {', '.join(NAMES)}")
    if len(set(parts)) != len(parts):
        raise ValueError(f"layer sum {name!r} names a layer twice")
    return "+".join(sorted(parts, key=NAMES.index))


def items(layers: Layers) -> Iterator[tuple[str, Float[Array, "*batch 3"]]]:
    """Name and array of every layer or sum that is estimated, in the order of `NAMES`, sums last."""
    for name in NAMES:
        value = getattr(layers, name)
        if value is not None:
            yield name, value
    yield from sorted(layers.sums.items())


def from_items(images: dict[str, Float[Array, "*batch 3"]]) -> Layers:
    """The inverse of `items`: names with a plus go into `sums`."""
    single = {name: image for name, image in images.items() if "+" not in name}
    sums = {canonical_sum(name): image for name, image in images.items() if "+" in name}
    return Layers(**single, sums=sums)


def total(layers: Layers) -> Float[Array, "*batch 3"]:
    """The image: the sum of all estimated layers. Raises ValueError when there are none."""
    images = [image for _, image in items(layers)]
    if not images:
        raise ValueError("no layer is estimated, so there is no image to sum")
    return sum(images[1:], start=images[0])


def select(layers: Layers, names: Sequence[str]) -> Float[Array, "*batch 3"]:
    """The sum over `names`; a stored sum serves when all its parts are asked for. Raises ValueError for what is absent."""
    wanted = set()
    for name in names:
        wanted.update(canonical_sum(name).split("+"))
    picked = []
    for name, image in sorted(items(layers), key=lambda item: -item[0].count("+")):
        parts = set(name.split("+"))
        if parts <= wanted:
            picked.append(image)
            wanted -= parts
    if wanted:
        have = ", ".join(name for name, _ in items(layers)) or "none"
        raise ValueError(f"layer {'+'.join(sorted(wanted, key=NAMES.index))} is not in the picture; it has {have}")
    return sum(picked[1:], start=picked[0])


def zeros(names: Sequence[str], shape: tuple[int, ...]) -> Layers:
    """Layers that hold exact zeros of `shape + (3,)` for `names`: classes that a scene cannot contain."""
    return from_items({name: jnp.zeros((*shape, 3), jnp.float32) for name in names})
