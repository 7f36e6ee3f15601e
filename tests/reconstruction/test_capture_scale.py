"""Lengths of a reconstruction from a capture's pixels."""

from __future__ import annotations

import numpy as np
import pytest

from reconstruction import Camera
from reconstruction.capture_scale import CaptureScale, pixel_size


def cameras(pixel: float) -> list[Camera]:
    """Three cameras a metre away whose pixels are so many metres wide there."""
    fov = np.degrees(2 * np.arctan(32 * pixel))
    return [
        Camera.look_at(f"c{k}", 64, 64, (np.sin(a), -np.cos(a), 0.0), (0, 0, 0), float(fov))
        for k, a in enumerate((-0.5, 0.0, 0.5))
    ]


@pytest.mark.parametrize("pixel", [1e-4, 4.5e-4, 2e-3])
def test_a_pixel_is_as_wide_as_the_field_of_view_says(pixel: float) -> None:
    assert pixel_size(cameras(pixel), np.zeros(3)) == pytest.approx(pixel, rel=1e-3)
    points = np.zeros((3, 3))
    assert CaptureScale.of(cameras(pixel), points).pixel == pytest.approx(pixel, rel=1e-3)


def test_lengths_follow_the_pixel_between_their_bounds() -> None:
    fine, coarse = CaptureScale.of_pixel(4e-4), CaptureScale.of_pixel(8e-4)
    assert coarse.thin == pytest.approx(2 * fine.thin)
    assert coarse.tolerance == pytest.approx(2 * fine.tolerance)
    for pixel in (1e-6, 1e-1):
        scale = CaptureScale.of_pixel(pixel)
        assert 1e-4 <= scale.thin <= 2e-3
        assert 1e-3 <= scale.grid <= 2e-3
