"""Instant multiple scattering with virtual point lights and bias compensation (Engelhardt, Novak, Dachsbacher 2010).

Stages: `light_paths` walks from the lights and leaves vertices (4.1), which `virtual_lights` sorts into lights, of which
`selection` may keep those that the picture sees most (with max_lights; Hasan, Pellacini and Bala 2007);
`gathering` sums the light of all of them along eye rays, `picking` does so where a pair needs marching or a shadow ray,
on surfaces too (4.2); both bound the geometry term, and `compensation` returns the energy that bounding takes (4.3,
4.4); `stages` runs these for a tile of receivers, `rendering` for all pixels and sets of lights.

Layers: light that scattered or reflected at least twice, in the medium and on surfaces (six of the nine). It cannot:
split off emission and direct light (use `direct`), bend rays, follow media inside meshes. Unbiased up to the energy
beyond the last compensation step ("clamped" end), the marched transmittance in grids, and the modes that say so. Forward
peaks (g >= 0.9) need very many lights: use the path tracer there.
"""

from jaxvol.methods.instant_multiple_scattering.planning import Plan, claims, plan
from jaxvol.methods.instant_multiple_scattering.rendering import render

__all__ = ["Plan", "claims", "plan", "render"]
