"""The paper's own modes of the lookup: similarity, and three g."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxvol import tables, zonal_lookup
from jaxvol.fit import wavenumber

KINDS = ("point", "directional", "area")


@pytest.fixture(scope="module")
def default():
    return tables.default_file()


@pytest.fixture(scope="module")
def lookups(default):
    return default.lookups()


def similar_share(response, tau, albedo):
    """Fluence of light scattered twice or more, over sigma_t^2 I0: sqrt(4 pi) sigma_s^2 G_0."""
    return np.sqrt(4 * np.pi) * albedo**2 * np.asarray(zonal_lookup.scaled_multiple(response, jnp.asarray(tau)))[:, 0]


@pytest.mark.parametrize(
    ("albedo", "total", "multiple"),
    [
        (0.9, (0.997, 0.877, 0.788, 0.938), (0.82, 0.72, 0.76, 0.94)),
        (0.5, (0.999, 0.923, 0.722, 0.598), (0.71, 0.49, 0.42, 0.55)),
    ],
)
def test_similarity_mode_is_the_papers(default, albedo, total, multiple):
    """Specification section 3, paper style at g = 0.5: ratios to the exact fluence at r = .1, 1, 3, 10."""
    tau, g = np.array([0.1, 1.0, 3.0, 10.0]), 0.5
    moments = wavenumber.effective_moments(g)
    direct = np.exp(-tau) / tau**2
    once, more = (
        np.sqrt(4 * np.pi) * wavenumber.point_table(tau, moments=moments, albedo=albedo, order=1, **bounces)[:, 0]
        for bounces in ({"first": 1, "last": 1}, {"first": 2})
    )
    with jax.enable_x64(True):
        response = zonal_lookup.medium_response(
            default.lookups(dtype=np.float64), "point", g=g, albedo=albedo, multiple="similarity"
        )
        found = similar_share(response, tau, albedo)
    ratio, total_ratio = (
        found / (albedo**2 * more),
        (direct + albedo * once + found) / (direct + albedo * once + albedo**2 * more),
    )
    np.testing.assert_allclose(ratio, multiple, atol=0.006)
    np.testing.assert_allclose(total_ratio, total, atol=0.0015)


@pytest.mark.parametrize("kind", KINDS)
def test_similarity_mode_is_the_isotropic_medium(lookups, kind):
    """Light scattered more than once is what an isotropic medium of sigma_s (1 - g), same sigma_a and geometry has."""
    sigma_s, sigma_a, g, distance = 0.8, 0.3, 0.6, 1.7
    reduced = (1 - g) * sigma_s
    theta = np.float32(1.0) if kind == "area" else None

    def more(response, sigma_s, sigma_t):
        if kind == "directional":
            both = [
                zonal_lookup.scattered_directional(response, distance, sigma_s=sigma_s, sigma_t=sigma_t, multiple=m)
                for m in (True, False)
            ]
        else:
            both = [
                zonal_lookup.scattered_point(response, distance, sigma_s=sigma_s, sigma_t=sigma_t, theta_n=theta, multiple=m)
                for m in (True, False)
            ]
        return np.asarray(both[0] - both[1])

    similar = zonal_lookup.medium_response(lookups, kind, g=g, albedo=sigma_s / (sigma_s + sigma_a), multiple="similarity")
    isotropic = zonal_lookup.medium_response(lookups, kind, g=0.0, albedo=reduced / (reduced + sigma_a))
    found, expected = more(similar, sigma_s, sigma_s + sigma_a), more(isotropic, reduced, reduced + sigma_a)
    assert np.max(np.abs(found - expected)) < 1e-5 * abs(expected[0])
    exact = zonal_lookup.medium_response(lookups, kind, g=g, albedo=sigma_s / (sigma_s + sigma_a))
    assert abs(more(exact, sigma_s, sigma_s + sigma_a)[0] / expected[0] - 1) > 0.03  # it is another medium
    albedo_one = zonal_lookup.medium_response(lookups, kind, g=g, albedo=1.0, multiple="similarity")
    at_zero = zonal_lookup.medium_response(lookups, kind, g=g, albedo=0.0, multiple="similarity")
    for response in (albedo_one, at_zero):
        assert np.all(np.isfinite(zonal_lookup.scaled_multiple(response, jnp.float32(2), theta_n=theta)))


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("g_range", [0.3, 0.5])
def test_three_g_mode_interpolates_linearly(lookups, kind, g_range):
    """Section 4.5, with a range of the user's choice: exact at its three values of g, linear between."""
    theta = np.float32(0.7) if kind == "area" else None

    def single(g, **mode):
        response = zonal_lookup.medium_response(lookups, kind, g=np.float32(g), **mode)
        return np.asarray(zonal_lookup.scaled_single(response, np.float32(1), theta_n=theta))

    for sign in (1, -1):
        ends, middle = single(sign * g_range), single(0.0)
        found = single(sign * g_range / 4, g_range=g_range)
        np.testing.assert_allclose(found, ends / 4 + 3 * middle / 4, atol=2e-6 * abs(middle).max())
        assert np.max(np.abs(found / middle[0] - single(sign * g_range / 4) / middle[0])) > 1e-3
        np.testing.assert_allclose(single(sign * g_range, g_range=g_range), ends, atol=2e-6 * abs(ends).max())


def test_bad_modes(lookups):
    with pytest.raises(ValueError, match="g_range = 1.0 must lie in"):
        zonal_lookup.medium_response(lookups, "point", g_range=1.0)
    with pytest.raises(ValueError, match="without moments"):
        zonal_lookup.medium_response(lookups, "point", g_range=0.5, moments=np.ones(2))
    with pytest.raises(ValueError, match="'table' or 'similarity'"):
        zonal_lookup.medium_response(lookups, "point", multiple="similar")


@pytest.mark.parametrize("emitter", KINDS)
def test_modes_compile_once_and_have_gradients(lookups, emitter):
    def value(g, albedo, g_range):
        response = zonal_lookup.medium_response(lookups, emitter, g=g, albedo=albedo, g_range=g_range, multiple="similarity")
        theta = jnp.float32(1) if emitter == "area" else None
        tau = jnp.float32(1.0)
        once, more = (f(response, tau, theta_n=theta) for f in (zonal_lookup.scaled_single, zonal_lookup.scaled_multiple))
        return jnp.sum(once) + jnp.sum(more)

    function = jax.jit(jax.value_and_grad(value, argnums=(0, 1, 2)))
    for arguments in ((0.2, 0.5, 0.5), (-0.4, 1.0, 0.3), (0.0, 0.0, 0.5)):
        assert all(np.isfinite(v) for v in jax.tree.leaves(function(*map(jnp.float32, arguments))))
    assert function._cache_size() == 1
