"""Deep screen space for indirect light in volumes: light that a surface reflects and the medium then scatters to the eye.

Nalbach, Ritschel, Seidel 2014, "Deep Screen Space for Indirect Lighting of Volumes" (VMV), made accurate. Stages:

1. `surfels`       the mesh as disks of equal size on the screen (section 3.2)
2. `lighting`      light of every kind on them, with visibility and extinction (4.2); `bounce`: of other surfels too
3. `interval_map`  (jaxvol.interval_map) N samples per ray at equal drops in transmittance, exact weights (4.1)
4. `framebuffer`   active pixels spread over 4^l sub-buffers on level l (3.2)
5. `transport`     transmittance and visibility from surfels to samples: a table over clusters; not in the paper (5)
6. `tile_lists`    which surfels reach which tiles of rays (4.2, the splats' bounds)
7. `splatting`     the pairs, shell by shell, with `kernel` (4.2)
8. `reconstruction` unshuffle, blur, sum (4.2)

Nothing is kept between frames. Computes the layer `volume_from_surface`; with `second_bounce` also light of two surface
bounces, a part of `volume_from_multiple` that is never claimed. Cannot: follow more surface bounces or any second
scattering in the medium, bend rays (ior), resolve light that a surfel sends past an edge finer than a cluster of surfels.
Biased by the blur, by the transport table and by the size of surfels; `plan(...)` has switches for each, and `references`
measures them apart.
"""

from jaxvol.methods.deep_screen_space.frame import render
from jaxvol.methods.deep_screen_space.planning import Plan, claims, plan

__all__ = ["Plan", "claims", "plan", "render"]
