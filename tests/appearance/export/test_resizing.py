"""Fewer strands, or more between those that are there."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import cKDTree

from appearance.export.resizing import resized
from reconstruction import Strands


def upright(feet, height=0.05, radius=1e-4):
    """Straight strands up from `feet (S, 2)`, a point every 2 mm."""
    z = np.arange(0, height + 1e-9, 2e-3)
    return Strands.from_list([np.column_stack([np.tile(f, (len(z), 1)), z]) for f in feet], radius)


def square(n, spacing):
    return spacing * np.stack(np.meshgrid(np.arange(n), np.arange(n)), -1).reshape(-1, 2)


def test_fewer_strands_cover_what_all_did():
    """Of one strand of 3 cm and two of 1 cm: 5 cm of radius r, or 3 cm of 5/3 r."""
    lines = [np.array([[x, 0, 0], [x, 0, z]]) for x, z in ((0, 0.03), (1, 0.01), (2, 0.01))]
    strands = Strands.from_list(lines, radius=3e-5)
    radius = {0: 5e-5, 1: 15e-5, 2: 15e-5}
    for seed in range(6):
        few, (kept,) = resized(strands, 1, seed)
        assert few.radius == pytest.approx(radius[kept], rel=1e-6)
        np.testing.assert_array_equal(few.points, strands[kept])
    vary = replace(strands, radius=np.float32([1, 1, 4, 4, 2, 2]) * 1e-5)
    few, (kept,) = resized(vary, 1, 0)
    area = {0: 3.0, 1: 4.0, 2: 2.0}  # 3·1, 1·4, 1·2 in all 9
    np.testing.assert_allclose(few.radius, vary.radius[2 * kept] * 9 / area[kept], rtol=1e-6)
    for same in (3, None):
        assert resized(strands, same, 0)[0] is strands


def test_strands_without_length_and_no_strands_are_left_as_they_are():
    still = Strands.from_list([np.zeros((2, 3))] * 4, radius=3e-5)
    few, _ = resized(still, 2, 0)
    assert (len(few), few.radius) == (2, 3e-5)
    many, _ = resized(still, 9, 0)
    assert len(many) == 9
    assert np.linalg.norm(many.points, axis=1).max() <= 3e-5
    assert len(resized(Strands.from_list([]), 7, 0)[0]) == 0


def test_more_strands_fill_the_gaps_evenly_in_the_same_direction():
    """Nine for each of a square millimetre: feet as even as random ones, all upright."""
    given = upright(square(60, 1e-3), height=0.01)
    many, ids = resized(given, 9 * 3600, 0)
    assert len(many) == 9 * 3600
    assert many.radius == pytest.approx(1e-4 / 9, rel=1e-3)
    np.testing.assert_allclose(np.abs(many.tangents()[:, 2]), 1, atol=1e-6)
    np.testing.assert_allclose(many.lengths(), given.lengths()[ids], rtol=1e-5)
    per_mm2 = np.histogram2d(*many.roots[:, :2].T, bins=50, range=[[4.5e-3, 54.5e-3]] * 2)[0]
    assert per_mm2.mean() == pytest.approx(9, rel=0.1)
    assert per_mm2.std() < 3  # as many of random places: 3
    # every given strand is among them, unchanged
    assert cKDTree(many.roots).query(given.roots)[0].max() == 0


def test_strands_with_four_times_the_area_get_four_times_as_many():
    dense, loose = square(24, 0.5e-3), square(12, 1e-3) + np.array([0.1, 0])
    _, ids = resized(upright(np.concatenate([dense, loose])), 20_000, 1)
    added = np.bincount(ids, minlength=720) - 1
    inner = [added[:576].reshape(24, 24)[4:-4, 4:-4], added[576:].reshape(12, 12)[3:-3, 3:-3]]
    assert inner[1].mean() / inner[0].mean() == pytest.approx(4, rel=0.1)


def test_beside_an_arc_strands_are_arcs_about_the_same_axis():
    """Arcs of a tube's wall: the distance of every new one from the axis is constant."""
    turn = np.linspace(0, 1.5, 60)
    arcs = [
        np.column_stack([r * np.cos(turn), r * np.sin(turn), np.full(60, z)])
        for r in np.arange(0.05, 0.054, 1e-3)
        for z in np.arange(0, 0.004, 1e-3)
    ]
    many, _ = resized(Strands.from_list(arcs, radius=1e-4), 400, 2)
    middle = [line[10:-10] for line in np.split(many.points, many.offsets[1:-1])]
    wander = [np.ptp(np.hypot(*line[:, :2].T)) for line in middle]
    assert np.median(wander) < 2e-5
    assert np.ptp([np.hypot(*line[0, :2]) for line in middle]) > 3.5e-3


def test_a_fly_away_is_not_spread_over_the_space_around_it():
    feet = np.concatenate([square(10, 1e-3), [[0.3, 0.3]]])
    many, ids = resized(upright(feet), 3000, 0)
    off = many.roots[ids == 100][:, :2] - 0.3
    assert 1 < len(off) < 300
    assert np.linalg.norm(off, axis=1).max() < 3e-3


def test_one_strand_becomes_many_within_its_own_thickness():
    many, _ = resized(upright([[0, 0]], radius=3e-4), 50, 0)
    assert np.linalg.norm(many.points[:, :2], axis=1).max() <= 3e-4 * (1 + 1e-6)
    assert many.radius == pytest.approx(3e-4 / 50, rel=1e-5)


def test_what_is_added_is_marked_as_guessed():
    given = upright(square(4, 1e-3))
    given = replace(given, confidence=np.full(len(given.points), 0.7, np.float32))
    many, ids = resized(given, 40, 0)
    first = np.r_[True, ids[1:] != ids[:-1]][many.strand_of_point]
    np.testing.assert_array_equal(many.confidence, np.where(first, np.float32(0.7), 0))
