"""Baked light on surfaces in media by tables of impulse responses (Dubouchet, Sloan, Jarosz and Nowrouzezahrai 2019).

How a medium spreads the light of a point, directional or differential area emitter, seen from a receiver, is tabulated
once (`jaxvol.tables`). Baking traces surface paths only and weights each segment with the table.

Stages: `lookup` resamples the tables for a medium (sections 4.3 to 4.5); `receivers` and `shading` turn zonal and
mirror-symmetric radiance into irradiance, reflected light or SH (section 5, appendix A); `emitters` is the light of one
emitter at a receiver, with the image source that keeps light from coming back out of a surface (our addition);
`light_sources`, `surface_paths`, `steps` and `gather` trace (section 5, back-scattering of 5.2 in area form); `marched` and
`walks` integrate single segments where an occluder, the medium's bounds or the density's contrast make the tables wrong (our
addition); `cache`, `radiosity`, `final_gather` and `surface_walks` end paths at surfaces whose irradiance is known, and
`sharing` computes smooth light at few receivers (ours too);
`estimate` collects layers; `baking`, `lightmap`, `probes` and `gltf` make files; `rendering` shades first hits.

It cannot: know the bounds of a medium beyond the optical thickness of each segment; be exact about light scattered more than
once where density varies or occluders stand (its last leg alone is traced, at receivers only; at further vertices
the mean along each segment and the paper's rule serve); scatter light out of a spot's cone to receivers beside it;
reflect in Phong lobes after the first surface; bend rays.
"""

from jaxvol.methods.impulse_response.estimate import irradiance
from jaxvol.methods.impulse_response.planning import Plan, claims, plan, prepare
from jaxvol.methods.impulse_response.rendering import render

__all__ = ["Plan", "claims", "irradiance", "plan", "prepare", "render"]
