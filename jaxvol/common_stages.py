"""What the methods of one picture have in common, computed when first asked for and kept for the others.

A composite of methods hands one `CommonStages` to every method whose `render` names the argument `common`; a method that
is run alone makes its own. Ray casters are kept with their meshes anyway (`ray_casting.caster_for`).
"""

from functools import cached_property

import jax
import jax.numpy as jnp
import numpy as np

from jaxvol import camera as cameras
from jaxvol import extinction, pixel_edges, ray_casting, segments
from jaxvol.types import Camera, Rays, Scene


class CommonStages:
    """Casters, corner tables of the grids, rays through the pixels' centres, their first hits, pixels at edges; eager."""

    def __init__(self, scene: Scene, camera: Camera):
        self.scene = scene
        self.camera = camera

    @cached_property
    def caster(self) -> ray_casting.Caster:
        """Of all surfaces; None where there are none."""
        return ray_casting.caster_for(self.scene.mesh)

    @cached_property
    def medium_casters(self) -> tuple[ray_casting.Caster, ...]:
        """Of the media's boundary meshes."""
        return segments.medium_casters(self.scene.medium)

    @cached_property
    def marching(self) -> extinction.MarchingMedium | None:
        """The medium with corner tables of its grids; None without a medium."""
        return None if self.scene.medium is None else extinction.marching_medium(self.scene.medium)

    @cached_property
    def center_rays(self) -> Rays:
        """Rays through the centres of all pixels, row by row from the top."""
        return _center_rays(self.camera)

    @cached_property
    def center_hits(self) -> tuple[np.ndarray, np.ndarray]:
        """(t, face) of the first surface on each of `center_rays`; inf and -1 where there is none."""
        rays = self.center_rays
        t, face = ray_casting.intersect(self.caster, rays.origin, rays.direction, jnp.float32(np.inf))
        return np.asarray(t), np.asarray(face)

    @cached_property
    def edge_pixels(self) -> np.ndarray:
        """Pixels [H * W] that show more than one surface: one ray is not enough for them."""
        return pixel_edges.edge_pixels(self.scene.mesh, self.camera, self.caster, self.center_rays, self.center_hits)


@jax.jit
def _center_rays(camera):
    return cameras.generate_rays(camera, cameras.pixel_centers(camera))
