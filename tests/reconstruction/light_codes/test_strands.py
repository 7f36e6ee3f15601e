"""From segments to strands: support, thinning, tracing, tips."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from reconstruction import Camera, Report, Strands
from reconstruction.evaluation.matching import compare_strands
from reconstruction.geometry.strands import smoothed
from reconstruction.light_codes import line_strands
from reconstruction.light_codes.extension import extend, fewest_views
from reconstruction.light_codes.line_strands import connect_segments
from reconstruction.light_codes.search import DepthMap, DepthSearch
from reconstruction.light_codes.segments import count_supports, thinned_lines, to_segments


def arc(count: int, turn: float = 1.5, radius: float = 0.02) -> Any:
    s = np.linspace(0, turn, count)
    points = radius * np.stack([np.cos(s), np.sin(s), 0 * s], axis=1)
    return points, np.stack([-np.sin(s), np.cos(s), 0 * s], axis=1)


def test_thinning_averages_a_cells_alike_lines() -> None:
    points = np.array([[1e-5, 0, 0], [3e-5, 0, 0], [2e-5, 0, 0]])
    directions = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0]], float)
    p, d, w = thinned_lines(points, directions, np.array([1.0, 3.0, 1.0]), 1e-3)
    np.testing.assert_allclose(p[:, 0], [2.5e-5, 2e-5])
    np.testing.assert_allclose(np.abs(d), [[1, 0, 0], [0, 1, 0]])
    np.testing.assert_allclose(w, [4, 1])


def test_smoothing_keeps_the_ends_and_takes_the_jitter() -> None:
    rng = np.random.default_rng(2)
    points, _ = arc(100)
    jitter = points + 1e-4 * rng.normal(size=points.shape)
    (found,) = smoothed([jitter], 1e-3)
    off = np.hypot(np.linalg.norm(found[:, :2], axis=1) - 0.02, found[:, 2])
    assert off[15:-15].mean() < 0.5e-4
    np.testing.assert_allclose(found[[0, -1]], jitter[[0, -1]], atol=2e-4)
    np.testing.assert_array_equal(smoothed([jitter[:2]], 2e-3)[0], jitter[:2])


@pytest.mark.parametrize("length", [1e-12, 1e-6, 1e-3])
def test_lines_far_shorter_than_the_gaussian_become_their_chords(length: float) -> None:
    s = np.linspace(0, 1, 9)
    bow = length * np.stack([s, np.sin(np.pi * s), 0 * s], axis=1)
    (found,) = smoothed([bow], 0.01)
    np.testing.assert_allclose(
        found, length * np.stack([s, 0 * s, 0 * s], axis=1), atol=2e-5 * length
    )


def test_jointly_smoothed_lines_are_independent() -> None:
    """Straight ones stay as they are, however short; a wave loses what a Gaussian takes of it."""
    rng = np.random.default_rng(5)
    straight = [
        np.arange(n)[:, None] * [2e-4, 1e-4, 0] + rng.normal(size=3) for n in (1, 2, 3, 5, 60)
    ]
    x = np.arange(400) * 1e-4
    wave = np.stack([x, 1e-5 * np.sin(2 * np.pi * x / 5e-3), 0 * x], axis=1)
    *found, waved = smoothed([*straight, wave], 1e-3)
    for line, before in zip(found, straight, strict=True):
        np.testing.assert_allclose(line, before, atol=1e-12)
    left = np.exp(-0.5 * (2 * np.pi * 1e-3 / 5e-3) ** 2)
    np.testing.assert_allclose(waved[60:-60, 1], left * wave[60:-60, 1], atol=2e-8)


def test_how_many_views_must_agree() -> None:
    assert [fewest_views(n) for n in (24, 12, 6, 3, 25, 26)] == [6, 4, 3, 3, 6, 7]


def test_tips_grow_along_the_fibre_while_views_agree(make_fibres: Any, fibre_cameras: Any) -> None:
    """The middle third of a lone fibre grows to its whole length, and no further."""
    s = np.linspace(-0.7, 0.7, 200)
    fibre = 0.03 * np.stack([np.sin(s), 0.3 * np.sin(s), np.cos(s)], axis=1)
    stage = make_fibres(strands=Strands.from_list([fibre], 3e-4), cameras=fibre_cameras(12))
    (grown,) = extend(stage.views, [fibre[70:130]], angle_deg=10.0)
    whole = np.linalg.norm(np.diff(fibre, axis=0), axis=1).sum()
    length = np.linalg.norm(np.diff(grown, axis=0), axis=1).sum()
    assert 0.8 * whole < length < 1.15 * whole
    off = np.linalg.norm(grown[:, None] - fibre[None], axis=2).min(axis=1)
    assert np.quantile(off, 0.9) < 1e-3
    assert extend(stage.views, []) == []


SIDE, PIXEL = 9, 2e-4  # pixels, and metres that one spans at the origin
BESIDE = np.array([1.0, 0.0, 0.0])


def looking(position: Any, target: Any = (0, 0, 0), middle: int = SIDE // 2) -> Any:
    """A view of SIDE² pixels from 1 m off; the target falls on the pixel (middle, middle)."""
    fov = 2 * np.degrees(np.arctan(SIDE * PIXEL / 2))
    camera = Camera.look_at("c", SIDE, SIDE, position, target, fov)
    camera.K[:2, 2] = middle
    return SimpleNamespace(camera=camera)


def single(x: int, depth: float, direction: Any, y: int = SIDE // 2) -> DepthMap:
    """The map of a view that found one segment."""
    one = np.ones(1, np.float32)
    at, along = (np.full(1, v) for v in (x, y)), np.asarray(direction, np.float32)[None]
    return DepthMap(*at, one * np.float32(depth), along, one, one, one, np.ones(1, np.int64))


def nothing() -> DepthMap:
    no, none = np.zeros(0, np.float32), np.zeros(0, np.int64)
    return DepthMap(none, none, no, np.zeros((0, 3), np.float32), no, no, no, none)


@pytest.mark.parametrize(
    ("deeper", "turned", "x", "agrees"),
    [
        (0.9e-3, 9.0, 4, True),
        (-0.9e-3, 171.0, 4, True),  # the sign of a direction means nothing
        (1.1e-3, 0.0, 4, False),
        (0.0, 11.0, 4, False),
        (0.0, 0.0, 5, True),
        (0.0, 0.0, 6, False),  # within the distance, but two pixels off
    ],
)
def test_a_view_agrees_that_found_the_segment_near_and_alike(
    deeper: float, turned: float, x: int, agrees: bool
) -> None:
    a = np.radians(turned)
    views = [looking((0, -1, 0)), looking(BESIDE)]
    maps = [single(4, 1.0, (0, 0, 1)), single(x, 1.0 + deeper, (np.sin(a), 0, np.cos(a)))]
    found = count_supports(views, maps, to_segments(views, maps), distance=1e-3, angle_deg=10.0)
    assert found.supports[0] == 1 + agrees


def test_views_that_see_a_segment_at_their_corner_behind_them_or_not_at_all() -> None:
    corner = looking(BESIDE, middle=0)
    away = looking(BESIDE, target=2 * BESIDE)
    views = [looking((0, -1, 0)), corner, looking((0, 1, 0)), away, looking(-BESIDE, middle=-50)]
    up = (0, 0, 1)
    maps = [single(4, 1.0, up), single(0, 1.0, up, y=0), nothing(), single(4, 1.0, up), nothing()]
    assert count_supports(views, maps, to_segments(views, maps)).supports.tolist() == [2, 2, 1]
    empty = [nothing()] * 5
    assert not len(count_supports(views, empty, to_segments(views, empty)))


@pytest.fixture(scope="module")
def segments(fibres: Any) -> Any:
    search = DepthSearch(fibres.views, (0, 0, 0))
    maps = [search.run(k, *fibres.range(k)) for k in range(len(fibres.views))]
    return count_supports(fibres.views, maps, to_segments(fibres.views, maps))


def test_segments_that_three_views_find_alike_lie_on_fibres(fibres: Any, segments: Any) -> None:
    dense = fibres.strands.resampled(2e-4).points
    off = np.array([np.linalg.norm(dense - p, axis=1).min() for p in segments.points[::50]])
    agreed = segments.supports[::50] >= 3
    camera = fibres.cameras[0]
    pixel = np.linalg.norm(camera.center) / camera.K[0, 0]  # metres at the ball
    assert np.quantile(off[agreed], 0.9) < 0.8 * pixel
    assert off[agreed].mean() < 0.5 * off[~agreed].mean()
    assert segments.supports.max() <= len(fibres.views)


def test_more_lines_than_can_be_traced_are_averaged_in_larger_cells(
    fibres: Any, segments: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    good = segments.subset(segments.supports >= 3)
    report = Report()
    whole = connect_segments(fibres.views, good, report)
    every = report.stages[-1].figures
    monkeypatch.setattr(line_strands, "MOST_LINES", every["lines"] // 2)
    fewer = connect_segments(fibres.views, good, report)
    figures = report.stages[-1].figures
    assert figures["lines"] <= every["lines"] // 2
    assert figures["cells_mm"] > every["cells_mm"] == pytest.approx(0.3)
    assert 0 < len(fewer) < len(whole)
    found = compare_strands(Strands.from_list(fewer, 2e-4), fibres.strands, samples=None)["all"]
    assert found["2mm_20deg"]["precision"] > 0.85


def test_fibres_come_back_as_strands(fibres: Any, segments: Any) -> None:
    good = segments.subset(segments.supports >= 3)
    found = connect_segments(fibres.views, good, Report())
    figures = compare_strands(Strands.from_list(found, 2e-4), fibres.strands, samples=None)["all"]
    assert figures["1mm_10deg"]["f"] > 0.75
    assert figures["2mm_20deg"]["f"] > 0.9
