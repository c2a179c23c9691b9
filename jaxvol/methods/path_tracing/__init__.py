"""The reference: unbiased null-collision volumetric path tracing, every layer, with per-pixel variance.

Kajiya 1986 extended to media; delta and ratio tracking on a coarse majorant grid (Woodcock 1965; Novak et al. 2014),
closed form where media are homogeneous; next-event estimation with multiple importance sampling (Veach 1997),
equi-angular distances for point and spot lights (Kulla and Fajardo 2012), spectral one-sample MIS over RGB (Wilkie et
al. 2014), Russian roulette. Stages: `sensors` start paths, `driver` casts rays between steps, `tracking` and `flight`
fly through the media, `step` collects, connects, scatters and refills, `lanes` holds the state,
`estimate` runs batches, `film` turns their sums into layers, `progressive` makes it a job.

It cannot: bend rays (a refractive index other than 1 is refused), render emitting media.
"""

from jaxvol.methods.path_tracing.estimate import (
    Plan,
    claims,
    fluence,
    irradiance,
    plan,
    radiance,
)
from jaxvol.methods.path_tracing.progressive import render, scene_digest

__all__ = ["Plan", "claims", "fluence", "irradiance", "plan", "radiance", "render", "scene_digest"]
