"""Stage 2, shading: from incident radiance in harmonics to irradiance and reflected light (section 5, appendix A).

Lambert and Phong lobes are zonal about the normal and about the mirrored eye, incident radiance is zonal about the way to the
light, so their product is the O(N) double product sum_l g_l h_l P_l(cos beta).
"""

from math import pi

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxvol import harmonics
from jaxvol.sampling import dot, normalize, orthonormal_basis


def emitter_frame(
    axis: Float[Array, "*b 3"], emitter_normal: Float[Array, "*b 3"]
) -> tuple[Float[Array, "*b 3"], Float[Array, "*b 3"], Float[Array, "*b 3"]]:
    """The frame (x, y, z) in which a patch's response is mirror symmetric.

    z is the axis receiver -> patch, x the way its normal leans.
    """
    lean = emitter_normal - dot(emitter_normal, axis)[..., None] * axis
    squared = dot(lean, lean)
    s, _ = orthonormal_basis(axis)
    x = jnp.where((squared > 1e-12)[..., None], normalize(lean), s)
    return x, jnp.cross(axis, x), axis


def half_basis(local: Float[Array, "*b 3"], order: int, bands: tuple[int, ...]) -> dict:
    """y_lm, m >= 0, at unit directions, by pair (l, m) of the bands asked for."""
    x, y, z = local[..., 0], local[..., 1], local[..., 2]
    table = harmonics.normalised_legendre(z, order)
    values = {}
    cosine, sine = jnp.ones_like(x), jnp.zeros_like(x)  # sin^m(theta) cos(m phi) and sin(m phi)
    for m in range(order):
        values |= {(band, m): table[band, m] * cosine for band in bands if band >= m}
        cosine, sine = x * cosine - y * sine, x * sine + y * cosine
    return values


def _in_frame(frame, direction):
    return jnp.stack([dot(direction, axis) for axis in frame], axis=-1)


def half_irradiance(
    radiance: Float[Array, "*b C half"],
    frame: tuple[Float[Array, "*b 3"], Float[Array, "*b 3"], Float[Array, "*b 3"]],
    normal: Float[Array, "*b 3"],
) -> Float[Array, "*b C"]:
    """Irradiance of mirror-symmetric radiances, given in the frame of `emitter_frame`, on a plane with a world normal.

    Sums the bands alone whose clamped cosine does not vanish: 0, 1, 2, 4, 6, ...
    """
    order = round((2 * radiance.shape[-1]) ** 0.5 - 0.5)
    gain = harmonics.rotation_norm(order) * harmonics.clamped_cosine(order)
    bands = tuple(band for band in range(order) if gain[band] != 0)
    total = 0.0
    for (band, m), value in half_basis(_in_frame(frame, normal), order, bands).items():
        total = total + radiance[..., band * (band + 1) // 2 + m] * (float(gain[band]) * value)[..., None]
    return total


def half_product(
    radiance: Float[Array, "*b C half"],
    zonal: Float[Array, "*b bands"],
    frame: tuple[Float[Array, "*b 3"], Float[Array, "*b 3"], Float[Array, "*b 3"]],
    axis: Float[Array, "*b 3"],
) -> Float[Array, "*b C"]:
    """int L f of a mirror-symmetric radiance and a zonal function about a world axis: sum sqrt(4pi/(2l+1)) f_l L_lm y_lm."""
    order = zonal.shape[-1]
    norm = harmonics.rotation_norm(order)
    total = 0.0
    for (band, m), value in half_basis(_in_frame(frame, axis), order, tuple(range(order))).items():
        total = total + radiance[..., band * (band + 1) // 2 + m] * (float(norm[band]) * zonal[..., band] * value)[..., None]
    return total


def phong_lobe(exponent: Float[Array, "*b"], order: int) -> Float[Array, "*b order"]:
    """Zonal coefficients of (n+1)/(2 pi) max(0, cos)^n, which integrates to 1: K_l times the moments a_l.

    a_0 = 1, a_1 = (n+1)/(n+2), a_l = a_{l-2} (n-l+2)/(n+l+1).
    """
    exponent = jnp.asarray(exponent)
    moments = [jnp.ones_like(exponent), (exponent + 1) / (exponent + 2)]
    for band in range(2, order):
        moments.append(moments[-2] * (exponent - band + 2) / (exponent + band + 1))
    norm = jnp.asarray(harmonics.zonal_norm(order), dtype=exponent.dtype)
    return jnp.stack(moments[:order], axis=-1) * norm


def phong_radiance(
    radiance: Float[Array, "*b C bands"], exponent: Float[Array, "*b"], cos_angle: Float[Array, "*b"]
) -> Float[Array, "*b C"]:
    """Light that a Phong lobe of unit energy reflects; cos_angle between the mirrored eye direction and the radiance's axis."""
    lobe = phong_lobe(exponent, radiance.shape[-1])
    return harmonics.zonal_product(radiance, lobe[..., None, :], cos_angle[..., None])


def _quadratic_basis():
    """Symmetric 3 x 3 matrices M_m with y_2m(w) = w M_m w, m = -2..2 (no Condon-Shortley sign), float64."""
    matrices = np.zeros((5, 3, 3))
    c = np.sqrt(15 / (4 * pi)) / 2
    for row, (i, j) in {0: (0, 1), 1: (1, 2), 3: (0, 2)}.items():
        matrices[row, i, j] = matrices[row, j, i] = c
    matrices[2] = np.sqrt(5 / (16 * pi)) * np.diag([-1, -1, 2])
    matrices[4] = c * np.diag([1, -1, 0])
    return matrices


def half_to_world(
    radiance: Float[Array, "*b C half"], frame: tuple[Float[Array, "*b 3"], Float[Array, "*b 3"], Float[Array, "*b 3"]]
) -> Float[Array, "*b C 9"]:
    """World SH of order 3 of a mirror-symmetric radiance: band 1 turns as a vector, band 2 as a traceless tensor."""
    x, _, z = frame
    basis = jnp.asarray(_quadratic_basis(), dtype=radiance.dtype)
    xx, zz = x[..., :, None] * x[..., None, :], z[..., :, None] * z[..., None, :]
    xz = x[..., :, None] * z[..., None, :] + z[..., :, None] * x[..., None, :]
    identity = jnp.eye(3, dtype=radiance.dtype)
    yy = identity - xx - zz
    c, c0 = np.sqrt(15 / (4 * pi)), np.sqrt(5 / (16 * pi))
    a20, a21, a22 = (radiance[..., i, None, None] for i in (3, 4, 5))
    tensor = (
        a20 * (c0 * (2 * zz - xx - yy))[..., None, :, :]
        + a21 * (0.5 * c * xz)[..., None, :, :]
        + a22 * (0.5 * c * (xx - yy))[..., None, :, :]
    )
    second = jnp.einsum("...ij,mij->...m", tensor, basis) / np.sum(_quadratic_basis()[0] ** 2)
    first = radiance[..., 1, None] * z[..., None, :] + radiance[..., 2, None] * x[..., None, :]
    first = first[..., jnp.array([1, 2, 0])]  # y_1 = {y, z, x}
    return jnp.concatenate([radiance[..., :1], first, second], axis=-1)
