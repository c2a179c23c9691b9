"""Baked light on surfaces in media by tables of impulse responses (Dubouchet, Sloan, Jarosz and Nowrouzezahrai 2019).

How a medium spreads the light of a point, directional or differential area emitter, seen from a receiver, is tabulated
once (`jaxvol.tables`). Baking traces surface paths only and weights each segment with the table.

Stages: `lookup` resamples the tables for a medium (sections 4.3 to 4.5); `shading` turns zonal and mirror-symmetric
radiance into irradiance (section 5, appendix A); `emitters` is the light of one emitter at a receiver, with the image
source that keeps light from coming back out of a surface (our addition); `surface_paths` and `gather` trace (section 5,
back-scattering of 5.2 in area form); `estimate` collects layers; `rendering` shades first hits.

It cannot: take light around occluders (dropped and counted, the paper's rule), know the bounds of a medium beyond the
optical thickness of each segment, nor contrast of density along one (the mean serves); scatter light out of a spot's cone;
reflect Phong lobes in `render`; bend rays.
"""

from jaxvol.methods.impulse_response.estimate import irradiance
from jaxvol.methods.impulse_response.planning import Plan, claims, plan, prepare
from jaxvol.methods.impulse_response.rendering import render

__all__ = ["Plan", "claims", "irradiance", "plan", "prepare", "render"]
