"""Longitudinal lobe and parameter maps against references of arbitrary precision."""

import mpmath
import numpy as np
import pytest

from appearance.bsdf.longitudinal import (
    ColourRange,
    absorption_of_colour,
    log_longitudinal,
    longitudinal,
    roughness_of_variance,
    variance_of_roughness,
)

mpmath.mp.dps = 60


def printed_log(theta_i, theta_o, v):
    """Log of Sun's Eq. 8 exactly as printed, at 60 digits."""
    a, b, v = mpmath.mpf(float(theta_i)), mpmath.mpf(float(theta_o)), mpmath.mpf(float(v))
    c, s = mpmath.cos(a) * mpmath.cos(b) / v, mpmath.sin(a) * mpmath.sin(b) / v
    bessel = mpmath.log(mpmath.besseli(0, c))
    return -s - 1 / v + bessel - mpmath.log(v * (1 - mpmath.exp(-2 / v)))


@pytest.mark.parametrize("v", [1e-7, 5e-7, 1e-5, 1.5e-3, 0.02, 0.3, 5.0, 27.4, 110.0])
def test_log_lobe_matches_the_printed_equation_at_high_precision(v):
    rng = np.random.default_rng(0)
    theta_i = np.concatenate([rng.uniform(-1.57, 1.57, 6), rng.uniform(-1.2, 1.2, 6)])
    near_mirror = -theta_i[6:] + min(3 * np.sqrt(v), 0.3)
    theta_o = np.concatenate([rng.uniform(-1.57, 1.57, 6), near_mirror])
    got = log_longitudinal(theta_i, theta_o, v)
    for i in range(12):
        want = printed_log(theta_i[i], theta_o[i], v)
        # relative to M, absolute in log M; the far tails hold 1e7 times a rounding
        assert abs(float(got[i] - want)) <= 1e-13 * max(1.0, abs(float(want))) + 1e-10


def test_lobe_is_finite_at_grazing_angles_and_the_ends_of_its_range():
    theta = np.linspace(-np.pi / 2, np.pi / 2, 7)
    for v in (1e-7, np.float32(1e-7), 110.0):
        assert np.isfinite(log_longitudinal(theta[:, None], theta, v)).all()
    with pytest.raises(ValueError, match="v must be in"):
        longitudinal(0, 0, 0.0)


def test_roughness_map_over_its_range():
    beta = np.linspace(0.001, 1, 500)
    v = variance_of_roughness(beta)
    assert (np.diff(v) > 0).all()
    assert float(variance_of_roughness(1.0)) == pytest.approx(27.44, abs=0.01)
    assert float(variance_of_roughness(0.001)) == pytest.approx(5.28e-7, rel=1e-2)
    assert float(roughness_of_variance(110.0)) == 1.0
    with pytest.raises(ValueError, match="beta_m must be in"):
        variance_of_roughness(1.2)


def test_colour_bracket_is_chiangs():
    b = 0.3
    bracket = 5.969 - 0.215 * b + 2.532 * b**2 - 10.73 * b**3 + 5.574 * b**4 + 0.245 * b**5
    want = (np.log([0.2, 0.5, 0.9]) / bracket) ** 2
    np.testing.assert_allclose(absorption_of_colour([0.2, 0.5, 0.9], b), want, rtol=1e-14)


def test_colour_outside_its_range_is_clamped_with_a_warning():
    with pytest.warns(ColourRange, match="clamped"):
        sigma = absorption_of_colour([0.0, 1.25, 0.8], 0.2)
    assert np.isfinite(sigma).all()
    assert sigma[1] == 0.0
    assert sigma[0] > 1.0
    with pytest.raises(ValueError, match="finite"):
        absorption_of_colour([np.nan], 0.2)
