"""Tables of impulse responses: how a medium spreads light from a point, a direction or a patch to a receiver.

Dubouchet, Sloan, Jarosz and Nowrouzezahrai, "Impulse Responses for Precomputing Light from Volumetric Media", EGSR 2019.

    zonal_tables     single scattering, point / directional / area emitters (section 4.2), any phase function (4.5)
    green            closed forms: isotropic scattering in an infinite medium, bounce by bounce and summed
    wavenumber       multiple scattering of point and area emitters, any phase function, exactly (section 5.1)
    half_space       multiple scattering of a directional emitter above a half-space
    compact          Chebyshev form of the tables
    zonal_axis       best axis of an area emitter's response (Figure 5)
    sigma_ratio      how responses depend on sigma, recovered by least squares (section 4.3, Figure 6)
    heterogeneous    effective sigma of a segment, and where it fails (section 4.4, Figure 7)
    monte_carlo      the paper's estimator, with the sampling that makes its variance finite
    validation       independent quadratures that tables are checked against

All entry points compute in float64 inside a scoped `jax.enable_x64` and take and return numpy arrays. The responses
know neither bounds of the medium (except the top of a directional emitter's half-space) nor occluders.
"""
