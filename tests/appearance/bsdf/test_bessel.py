"""I0 against arbitrary precision, over all of [0, inf)."""

import drjit as dr
import mpmath
import numpy as np
import pytest

from appearance.bsdf.bessel import scaled_i0

X = np.concatenate([[0.0], np.geomspace(1e-8, 1e9, 120), np.linspace(0.1, 40, 160)])


@pytest.mark.parametrize(("kind", "most"), [(np.float64, 1e-12), (np.float32, 1e-6)])
def test_scaled_i0_matches_arbitrary_precision(kind, most):
    x = X.astype(kind)
    number = dr.llvm.ad.Float64 if kind is np.float64 else dr.llvm.ad.Float
    got = np.array(scaled_i0(number(x)), float)
    with mpmath.workdps(40):
        exact = [mpmath.besseli(0, mpmath.mpf(float(v))) * mpmath.exp(-float(v)) for v in x]
    assert np.abs(got / np.array(exact, float) - 1).max() < most


def test_scaled_i0_has_no_seam():
    """Neighbouring numbers give neighbouring values, and the slope is -exp(-x)(I0 - I1)."""
    x = dr.llvm.ad.Float64(np.geomspace(1e-3, 1e4, 20001))
    dr.enable_grad(x)
    y = scaled_i0(x)
    dr.forward(x)
    exact = [
        mpmath.exp(-v) * (mpmath.besseli(1, v) - mpmath.besseli(0, v)) for v in np.array(x)[::400]
    ]
    assert np.allclose(np.array(dr.grad(y))[::400], np.array(exact, float), rtol=1e-9)
    assert (np.diff(np.array(y)) < 0).all()
