"""From segments to strands: support, mean shift, chains, tips."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from reconstruction.evaluation import compare_strands
from reconstruction.light_codes.chains import ChainOptions, chains
from reconstruction.light_codes.extension import ExtensionOptions, extend, fewest_views
from reconstruction.light_codes.mean_shift import MeanShiftOptions, mean_shift, thinned_lines
from reconstruction.light_codes.search import DepthSearch
from reconstruction.light_codes.segments import count_supports, to_segments
from reconstruction.strands import Strands, smoothed


def arc(count: int, turn: float = 1.5, radius: float = 0.02) -> Any:
    s = np.linspace(0, turn, count)
    points = radius * np.stack([np.cos(s), np.sin(s), 0 * s], axis=1)
    return points, np.stack([-np.sin(s), np.cos(s), 0 * s], axis=1)


def test_mean_shift_draws_noisy_lines_onto_their_middle() -> None:
    rng = np.random.default_rng(0)
    points, tangents = arc(600)
    noisy = points + rng.normal(size=points.shape) * 2e-4
    directions = tangents * rng.choice([-1, 1], 600)[:, None]  # signs mean nothing
    p, d = mean_shift(noisy, directions, np.ones(600))
    inner = slice(30, -30)
    before, after = (
        np.hypot(np.linalg.norm(q[inner, :2], axis=1) - 0.02, q[inner, 2]).mean()
        for q in (noisy, p)
    )
    assert after < 0.4 * before
    assert np.abs((d * tangents).sum(axis=1)).min() > 0.97


def test_mean_shift_leaves_crossing_lines_alone() -> None:
    s = np.linspace(-0.01, 0.01, 101)[:, None]
    points = np.concatenate([s * [1, 0, 0], s * [0, 1, 0] + [0, 0, 2e-4]])
    directions = np.repeat([[1.0, 0, 0], [0, 1.0, 0]], 101, axis=0)
    p, _ = mean_shift(points, directions, np.ones(202), MeanShiftOptions())
    np.testing.assert_allclose(p, points, atol=1e-9)


def test_thinning_averages_a_cells_alike_lines() -> None:
    points = np.array([[1e-5, 0, 0], [3e-5, 0, 0], [2e-5, 0, 0]])
    directions = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0]], float)
    p, d, w = thinned_lines(points, directions, np.array([1.0, 3.0, 1.0]), 1e-3)
    np.testing.assert_allclose(p[:, 0], [2.5e-5, 2e-5])
    np.testing.assert_allclose(np.abs(d), [[1, 0, 0], [0, 1, 0]])
    np.testing.assert_allclose(w, [4, 1])


def test_lines_in_any_order_are_strung_together() -> None:
    rng = np.random.default_rng(1)
    first, second = arc(80), arc(60, 1.0, 0.03)
    points = np.concatenate([first[0], second[0]])
    directions = np.concatenate([first[1], second[1]])
    directions *= rng.choice([-1, 1], len(points))[:, None]
    order = rng.permutation(len(points))
    found = sorted(chains(points[order], directions[order], ChainOptions(smooth=0)), key=len)
    assert [len(f) for f in found] == [60, 80]
    for polyline, (truth, _) in zip(found, (second, first), strict=True):
        either = polyline if np.allclose(polyline[0], truth[0]) else polyline[::-1]
        np.testing.assert_allclose(either, truth)


def test_a_ring_is_one_polyline_and_specks_are_none() -> None:
    points, directions = arc(200, 2 * np.pi * 199 / 200)
    found = chains(points, directions)
    assert [len(f) for f in found] == [200]
    assert chains(points[:3], directions[:3], ChainOptions(shortest=2e-3)) == []
    assert chains(points[:1], directions[:1]) == []


def test_smoothing_keeps_the_ends_and_takes_the_jitter() -> None:
    rng = np.random.default_rng(2)
    points, _ = arc(100)
    jitter = points + 1e-4 * rng.normal(size=points.shape)
    found = smoothed(jitter, 1e-3)
    off = np.hypot(np.linalg.norm(found[:, :2], axis=1) - 0.02, found[:, 2])
    assert off[15:-15].mean() < 0.5e-4
    np.testing.assert_allclose(found[[0, -1]], jitter[[0, -1]], atol=2e-4)
    np.testing.assert_array_equal(smoothed(jitter[:2], 2e-3), jitter[:2])


def test_how_many_views_must_agree() -> None:
    assert [fewest_views(n) for n in (24, 12, 6, 3, 25, 26)] == [6, 4, 3, 3, 6, 7]


def test_tips_grow_along_the_fibre_while_views_agree(make_fibres: Any, fibre_cameras: Any) -> None:
    """The middle third of a lone fibre grows to its whole length, and no further."""
    s = np.linspace(-0.7, 0.7, 200)
    fibre = 0.03 * np.stack([np.sin(s), 0.3 * np.sin(s), np.cos(s)], axis=1)
    stage = make_fibres(strands=Strands.from_list([fibre], 3e-4), cameras=fibre_cameras(12))
    (grown,) = extend(stage.views, [fibre[70:130]], ExtensionOptions(angle_deg=10.0))
    whole = np.linalg.norm(np.diff(fibre, axis=0), axis=1).sum()
    length = np.linalg.norm(np.diff(grown, axis=0), axis=1).sum()
    assert 0.8 * whole < length < 1.15 * whole
    off = np.linalg.norm(grown[:, None] - fibre[None], axis=2).min(axis=1)
    assert np.quantile(off, 0.9) < 1e-3
    assert extend(stage.views, []) == []


@pytest.fixture(scope="module")
def segments(fibres: Any) -> Any:
    search = DepthSearch(fibres.views, (0, 0, 0))
    maps = [search.run(k, *fibres.range(k)) for k in range(len(fibres.views))]
    return count_supports(fibres.views, maps, to_segments(fibres.views, maps))


def test_segments_that_three_views_find_alike_lie_on_fibres(fibres: Any, segments: Any) -> None:
    dense = fibres.strands.resampled(2e-4).points
    off = np.array([np.linalg.norm(dense - p, axis=1).min() for p in segments.points[::50]])
    agreed = segments.supports[::50] >= 3
    assert np.quantile(off[agreed], 0.9) < 7e-4
    assert off[agreed].mean() < 0.5 * off[~agreed].mean()
    assert segments.supports.max() <= len(fibres.views)


def test_fibres_come_back_as_strands(fibres: Any, segments: Any) -> None:
    good = segments.subset(segments.supports >= 3)
    points, directions = mean_shift(good.points, good.directions, good.confidence)
    points, directions, _ = thinned_lines(points, directions, good.confidence, 3e-4)
    found = extend(fibres.views, chains(points, directions))
    figures = compare_strands(Strands.from_list(found, 2e-4), fibres.strands, samples=None)["all"]
    assert figures["1mm_10deg"]["f"] > 0.75
    assert figures["2mm_20deg"]["f"] > 0.9
