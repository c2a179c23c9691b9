"""What a bake prepares once, what it counts, and the two questions that it asks of the scene along a way."""

import equinox as eqx
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float

from jaxvol import extinction, ray_casting
from jaxvol.methods.impulse_response import surface_paths
from jaxvol.methods.impulse_response.cache import Cache
from jaxvol.methods.impulse_response.lookup import Responses
from jaxvol.types import Medium, Scene


class Kit(eqx.Module):
    """Everything that a bake prepares once."""

    scene: Scene
    responses: Responses | None  # None: light is attenuated only
    faces: surface_paths.Faces
    probe_sigma: Float[Array, ""]
    caster: ray_casting.Caster = eqx.field(static=True)
    marching: extinction.MarchingMedium | None = None
    medium_casters: tuple = eqx.field(static=True, default=())
    image: bool = eqx.field(static=True, default=True)
    num_steps: int = eqx.field(static=True, default=1)
    max_bounces: int = eqx.field(static=True, default=8)
    shares: tuple[float, float, float] = eqx.field(static=True, default=(1.0, 0.0, 0.0))
    march_occluded: bool = eqx.field(static=True, default=False)
    contrast: float | None = eqx.field(static=True, default=None)  # above it segments are marched; None = never
    march_all: bool = eqx.field(static=True, default=False)  # the medium's bounds are near everywhere
    legs: int = eqx.field(static=True, default=1)  # scatter points of a marched segment before the tables
    multiple: bool = eqx.field(static=True, default=True)
    cache: Cache | None = None  # what surfaces send on; None: paths walk on
    open: bool = eqx.field(static=True, default=False)  # all faces in one plane: nothing occludes

    @property
    def tables_end(self) -> bool:
        """Whether the receivers' own segments are all marched: nothing of them is looked up."""
        return self.march_all and (self.march_occluded or self.open)

    @property
    def walks_surfaces(self) -> bool:
        """Whether light of surfaces that scatters on its way to a receiver is found by `surface_walks`."""
        return self.tables_end and self.cache is not None

    @property
    def marches(self) -> bool:
        """Whether any segment may be marched."""
        return self.responses is not None and (self.march_occluded or self.march_all or self.contrast is not None)


class Tally(dict):
    """Counts, summed as they come; values stay on the device until read.

    `segments` of the receivers themselves and `marched` ones; `lookups` and those `beyond` the tables' tau; `traced`, all
    segments of live paths.
    """

    def count(self, **values: ArrayLike) -> None:
        """Add to some counts."""
        for name, value in values.items():
            self[name] = self.get(name, 0) + value


def thickness(kit: Kit, origin, direction, t_max) -> Float[Array, "n 3"] | None:
    """Optical thickness of ways, RGB; None without a medium."""
    medium: Medium | None = kit.scene.medium
    if medium is None:
        return None
    return extinction.optical_thickness(
        medium, origin, direction, t_max, casters=kit.medium_casters, num_steps=kit.num_steps, marching=kit.marching
    )


def occluded(kit: Kit, origin, direction, length) -> Bool[np.ndarray, "n"]:
    """Whether a surface cuts each way."""
    if kit.open:
        return np.zeros(origin.shape[0], bool)
    return np.asarray(ray_casting.occluded(kit.caster, origin, direction, length))
