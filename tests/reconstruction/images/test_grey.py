"""The mean over channels beside NumPy's own."""

from __future__ import annotations

import numpy as np
import pytest

from reconstruction.images.grey import grey


@pytest.mark.parametrize("scale", [0.0, 1e-40, 1.0, 1e30, np.nan, np.inf])
def test_grey_is_the_mean_to_the_bit(scale: float) -> None:
    image = (np.random.default_rng(0).standard_normal((7, 5, 3)) * scale).astype(np.float32)
    with np.errstate(invalid="ignore"):
        np.testing.assert_array_equal(grey(image), image.mean(axis=-1))
