"""The 8-bit interval map: error bounds, saturation."""

import numpy as np

from jaxvol.methods.deep_screen_space import encoding


def samples(seed=0, num=16, rays=200):
    rng = np.random.default_rng(seed)
    return (2.0 + np.sort(rng.uniform(0, 3, (num, rays)), axis=0)).astype(np.float32)


def test_half_a_step_and_no_accumulation():
    d, origin, step = samples(), np.full(200, 2.0, np.float32), np.full(200, 0.02, np.float32)
    decoded = encoding.decode_distances(encoding.encode_distances(d, origin, step), origin, step)
    error = np.abs(np.asarray(decoded) - d)
    assert error.max() <= 0.01 + 1e-5
    assert error[-1].max() < 1.2 * error[0].max()
    gaps = np.round(np.diff(np.concatenate([origin[None], d]), axis=0) / 0.02)  # what the module does not do
    assert np.abs(origin + 0.02 * np.cumsum(gaps, axis=0) - d).max() > 0.02


def test_a_step_of_the_span_never_saturates():
    d = samples(1)
    origin, step = np.full(200, 2.0, np.float32), ((5.0 - 2.0) / 255 * np.ones(200)).astype(np.float32)
    decoded = encoding.decode_distances(encoding.encode_distances(d, origin, step), origin, step)
    assert np.abs(np.asarray(decoded) - d).max() <= 0.5 * step[0] + 1e-5


def test_saturation_moves_samples_towards_the_camera():
    d, origin, step = samples(2), np.zeros(200, np.float32), np.full(200, 0.005, np.float32)
    decoded = np.asarray(encoding.decode_distances(encoding.encode_distances(d, origin, step), origin, step))
    assert (decoded[0] < d[0] - 0.5).all() and (decoded <= d + 0.003).all()


def test_coefficients():
    rng = np.random.default_rng(3)
    c = (rng.random((16, 200)) * rng.random(200) ** 3).astype(np.float32)
    code, top = encoding.encode_coefficients(c, np.float32(1.0))
    decoded = np.asarray(encoding.decode_coefficients(code, top, np.float32(1.0)))
    assert (np.abs(decoded - c) <= np.asarray(top) / 255 / 510 + 1e-6).all()
    zero, top = encoding.encode_coefficients(np.zeros((16, 3), np.float32), np.float32(1.0))
    assert (np.asarray(encoding.decode_coefficients(zero, top, np.float32(1.0))) == 0).all()
