"""Strands for a browser: 16 bits, few points, and an error that is told as it is."""

from __future__ import annotations

import numpy as np
import pytest

from reconstruction import Strands
from stage_service.viewer.packing import PackedStrands


def arcs(count: int, radius: float, points: int) -> Strands:
    """Half circles side by side, of so many points each."""
    angle = np.linspace(0, np.pi, points)
    circle = radius * np.stack([np.cos(angle), 0 * angle, np.sin(angle)], axis=1)
    return Strands.from_list(
        [circle + np.array([0, 0.01 * i, 0]) for i in range(count)], radius=5e-5
    )


def test_points_stay_within_a_hundredth_of_a_millimetre_of_straight_strands():
    lines = [np.array([[x, 0, 0], [x + 0.1, 0.05, 0.2]]) for x in 0.02 * np.arange(5)]
    packed = PackedStrands.of(Strands.from_list(lines))
    share = np.linspace(0, 1, packed.points.shape[1])[:, None]
    expected = np.array([a + (b - a) * share for a, b in lines])[packed.order]
    np.testing.assert_allclose(packed.positions(), expected, atol=1e-5)
    np.testing.assert_allclose(packed.lengths, np.linalg.norm([0.1, 0.05, 0.2]), rtol=1e-6)


def test_the_deviation_is_the_sagitta_of_the_chords():
    packed = PackedStrands.of(arcs(3, radius=0.05, points=2001))
    chords = packed.points.shape[1] - 1
    sagitta = 0.05 * (1 - np.cos(np.pi / (2 * chords)))
    assert packed.deviation[2] == pytest.approx(sagitta, rel=0.02, abs=5e-6)
    assert packed.deviation[0] <= 1e-4


def test_points_lie_on_the_curve_that_is_rendered_not_on_its_chords():
    """Between 20 points of half a circle, whose chords lie up to 0.17 mm inside it."""
    places = PackedStrands.of(arcs(1, radius=0.05, points=20)).positions()[0]
    inside = 0.05 - np.hypot(places[:, 0], places[:, 2])
    assert np.percentile(np.abs(inside), 90) < 4.5e-5


@pytest.mark.parametrize("part", [20, 60])
def test_any_beginning_of_the_order_is_spread_over_all_strands(part):
    order = PackedStrands.of(arcs(300, 0.05, 20)).order
    assert sorted(order) == list(range(300))
    gaps = np.diff(np.sort(order[:part]))
    assert gaps.max() <= 3 * 300 / part


def test_a_chunk_holds_points_lengths_and_radii():
    packed = PackedStrands.of(arcs(7, 0.05, 40))
    data, n = packed.chunk(5, 10), packed.points.shape[1]
    assert len(data) == 2 * n * 6 + 2 * 4 + 2 * 4
    points = np.frombuffer(data, "<u2", 2 * n * 3).reshape(2, n, 3)
    np.testing.assert_array_equal(points, packed.points[5:])
    lengths, radii = np.frombuffer(data[2 * n * 6 :], "<f4").reshape(2, 2)
    chord = 2 * 0.05 * np.sin(np.pi / 2 / 39)
    np.testing.assert_allclose(lengths, 39 * chord, rtol=1e-5)
    np.testing.assert_allclose(radii, 5e-5, rtol=1e-6)


def test_no_strands_are_no_fault():
    packed = PackedStrands.of(Strands.from_list([]))
    assert packed.chunk(0, 100) == b""
