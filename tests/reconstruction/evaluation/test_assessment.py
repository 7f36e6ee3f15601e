"""Strands beside the true ones: errors, lengths, wholeness, roots, pictures."""

from __future__ import annotations

import json
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from reconstruction import Camera, Mesh, Strands
from reconstruction.evaluation import oriented_points
from reconstruction.evaluation.assessment import assess_strands, input_warnings, root_figures
from reconstruction.evaluation.connectivity import length_figures
from reconstruction.evaluation.error_pictures import draw_errors


def lines(starts: NDArray[np.floating], ends: NDArray[np.floating]) -> Strands:
    points = np.stack([starts, ends], axis=1).reshape(-1, 3)
    return Strands(points.astype(np.float32), 2 * np.arange(len(starts) + 1))


def row(count: int = 5, length: float = 0.1, apart: float = 0.02) -> Strands:
    """Lines along x from x = 0, far from each other."""
    starts = np.column_stack([np.zeros(count), apart * np.arange(count), np.zeros(count)])
    return lines(starts, starts + np.array([length, 0, 0]))


def brush(count: int = 3000, radius: float = 0.09, length: float = 0.03) -> Strands:
    """Hair that stands off a sphere, all but a face towards -y and a neck below."""
    k = np.arange(count) + 0.5
    z, turn = 1 - 2 * k / count, np.pi * (1 + 5**0.5) * k
    r = np.sqrt(1 - z**2)
    out = np.column_stack([r * np.cos(turn), r * np.sin(turn), z])
    out = out[(z > -0.6) & ~((out[:, 1] < -0.5) & (z < 0.4))]
    return lines(radius * out, (radius + length) * out)


@pytest.mark.parametrize("shift", [5e-4, 2.5e-3, 8e-3])
def test_a_shift_is_the_distance_that_is_reported(shift: float) -> None:
    errors = assess_strands(row().transformed(np.eye(3), [0, 0, shift]), row()).figures["errors"]
    for which in ("pred", "true"):
        for mark in ("mean", "p5", "p50", "p95"):
            assert errors[which]["distance_mm"][mark] == pytest.approx(1e3 * shift, rel=1e-4)
        assert errors[which]["angle_deg"]["p95"] == pytest.approx(0, abs=0.1)
        assert errors[which]["reversed"] == 0.0


def test_a_turn_is_the_angle_that_is_reported_and_turned_round_is_not_an_angle() -> None:
    true = lines(np.zeros((1, 3)), np.array([[0.1, 0, 0]]))
    c, s = np.cos(np.radians(7)), np.sin(np.radians(7))
    turned = true.transformed([[c, -s, 0], [s, c, 0], [0, 0, 1]], np.zeros(3))
    for pred, other_way in ((turned, 0.0), (Strands(turned.points[::-1], turned.offsets), 1.0)):
        errors = assess_strands(pred, true).figures["errors"]["pred"]
        assert errors["angle_deg"]["p5"] == pytest.approx(7, abs=0.05)
        assert errors["angle_deg"]["p95"] == pytest.approx(7, abs=0.05)
        assert errors["reversed"] == other_way


def test_strands_in_place_that_lean_are_found_once_they_are_turned_as_the_truth_is() -> None:
    camera = Camera.look_at("cam_0", 100, 100, [0.05, 0.04, 0.5], [0.05, 0.04, 0], 30)
    pixel = 0.5 / camera.K[0, 0]  # each true strand in the middle of its cubes
    true = row(20, apart=pixel).transformed(np.eye(3), [0, pixel / 2, pixel / 2])
    places = true.resampled(4e-3).points.astype(float)
    places = places[np.abs(places[:, 0] - 0.05) < 0.047]  # nothing beyond their ends
    # 25° off, each within half a millimetre of a true strand
    half = 1e-3 * np.array([np.cos(np.radians(25)), np.sin(np.radians(25)), 0])
    cameras = [camera]
    figures = assess_strands(lines(places - half, places + half), true, cameras=cameras).figures
    for over in ("visible", "all"):
        assert figures[over]["1mm_10deg"]["f"] == 0.0
        for at in (figures["true_directions"], figures["true_directions"]["equal_length"]):
            assert at[over]["1mm_10deg"]["precision"] == 1.0
            assert at[over]["1mm_10deg"]["recall"] > 0.9
    assert "true_directions" not in assess_strands(true, true).figures  # how wide is a pixel?


def test_lengths_and_how_far_their_distributions_are_apart() -> None:
    figures = length_figures(row(4, 0.05), row(10, 0.08))
    assert figures["pred"]["strands"] == 4
    assert figures["pred"]["total_m"] == pytest.approx(0.2, rel=1e-6)
    for mark in ("mean", "p5", "p50", "p95"):
        assert figures["true"][mark] == pytest.approx(80, rel=1e-5)
    assert figures["distance_mm"] == pytest.approx(30, rel=1e-5)
    starts = np.zeros((101, 3))
    even = lines(starts, np.column_stack([np.linspace(0, 0.1, 101), *starts.T[:2]]))
    marks = length_figures(even, row(1, 0.1))
    assert [marks["pred"][p] for p in ("p5", "p25", "p50", "p75", "p95")] == pytest.approx(
        [5, 25, 50, 75, 95], rel=1e-5
    )
    assert marks["distance_mm"] == pytest.approx(50, rel=1e-5)  # from a uniform one to its end
    assert "distance_mm" not in length_figures(Strands.from_list([]), row())


def test_whole_strands_are_whole() -> None:
    figures = assess_strands(row(), row()).figures["connectivity"]
    for of, name in (("pred", "on_one"), ("true", "by_one"), ("true", "covered")):
        assert figures[of][name]["p5"] == 1.0
        assert figures[of][name]["error"] == 0.0


def test_a_strand_cut_in_four_is_covered_by_quarters() -> None:
    cuts = np.linspace(0, 0.1, 5)
    pieces = Strands.from_list(
        [
            np.array([[a + 3e-3, y, 0], [b - 3e-3, y, 0]])
            for y in 0.02 * np.arange(5)
            for a, b in pairwise(cuts)
        ]
    )
    figures = assess_strands(pieces, row()).figures["connectivity"]
    assert figures["pred"]["on_one"]["mean"] == 1.0
    # each covers its 19 mm and 2 mm to both sides
    assert figures["true"]["by_one"]["mean"] == pytest.approx(0.23, abs=0.015)
    assert figures["true"]["covered"]["mean"] == pytest.approx(0.88, abs=0.03)


def test_a_strand_that_changes_hairs_lies_on_one_of_them_by_half() -> None:
    jump = np.array([[0, 0, 0], [0.049, 0, 0], [0.051, 0.02, 0], [0.1, 0.02, 0]])
    figures = assess_strands(Strands.from_list([jump]), row()).figures["connectivity"]
    assert figures["pred"]["on_one"]["mean"] == pytest.approx(49 / 118, abs=0.02)
    missing = assess_strands(row(2), row(5)).figures["connectivity"]["true"]
    assert missing["covered"]["mean"] == pytest.approx(0.4)


def consistency(pred: Strands, true: Strands) -> list[float]:
    """Strand consistency at 1, 2 and 3 mm."""
    found = assess_strands(pred, true).figures["connectivity"]["true"]
    assert found["strand_consistency"]["2mm_20deg"] == found["by_one"]["mean"]
    return [found["strand_consistency"][t.name] for t in oriented_points.THRESHOLDS]


@pytest.mark.parametrize("pieces", [1, 2, 4, 10])
def test_strand_consistency_of_strands_in_equal_pieces(pieces: int) -> None:
    true = row(length=0.0999)  # 101 points
    assert consistency(true, true) == [1.0, 1.0, 1.0]
    cuts = np.linspace(0, 0.1, pieces + 1)
    cut = [
        np.array([[a + 3.5e-3, y, 0], [b - 3.5e-3, y, 0]])
        for y in 0.02 * np.arange(5)
        for a, b in pairwise(cuts)
    ]
    # a piece covers its length without 3.5 mm at both ends, and 1 to 3 mm beyond them
    expected = [(100 / pieces - 7 + 2 * reach) / 101 for reach in (1, 2, 3)]
    assert consistency(Strands.from_list(cut), true) == pytest.approx(expected)


def test_strand_consistency_of_strands_that_are_shifted_or_turned() -> None:
    for shift, expected in ((1.5e-3, [0, 1, 1]), (2.5e-3, [0, 0, 1]), (3.5e-3, [0, 0, 0])):
        assert consistency(row().transformed(np.eye(3), [0, 0, shift]), row()) == expected
    true = lines(np.array([[-2e-3, 0, 0]]), np.array([[2e-3, 0, 0]]))
    for degrees, expected in ((9, [1, 1, 1]), (25, [0, 0, 1]), (35, [0, 0, 0])):
        c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
        turned = true.transformed([[c, -s, 0], [s, c, 0], [0, 0, 1]], np.zeros(3))
        assert consistency(turned, true) == expected


def test_strand_consistency_of_two_strands_that_swap_in_the_middle_is_a_half() -> None:
    swapped = Strands.from_list(
        [
            np.array([[0, a, 0], [0.0495, a, 0], [0.0505, b, 0], [0.1, b, 0]])
            for a, b in ((0, 0.02), (0.02, 0))
        ]
    )
    assert consistency(swapped, row(2)) == pytest.approx([0.5, 0.5, 0.5], abs=0.03)


def test_wholeness_does_not_depend_on_blocks(monkeypatch: pytest.MonkeyPatch) -> None:
    true = row(12, apart=1e-3)
    pred = true.transformed(np.eye(3), [0, 5e-4, 1e-3]).subset(np.arange(3, 9))
    whole = assess_strands(pred, true).figures
    monkeypatch.setattr(oriented_points, "BLOCK", 250)
    monkeypatch.setattr(oriented_points, "MOST_PAIRS", 300)
    assert assess_strands(pred, true).figures == whole


def test_strands_that_reach_the_scalp_with_root_or_tip() -> None:
    true = brush()
    loose = true.subset([2]).transformed(np.eye(3), 0.3 * true.roots[2])
    turned = Strands(true.subset([1]).points[::-1], [0, 2])
    pred = Strands.from_list([true[0], turned[0], loose[0], true[3]])
    assert root_figures(pred, true)["pred"] == {"rooted": 0.5, "upside_down": 0.25}
    assert root_figures(pred, true)["true"] == {"rooted": 1.0, "upside_down": 0.0}
    floor = np.array([[-1, -1, 0], [1, -1, 0], [0, 1, 0.0]])
    head = Mesh(floor, np.array([[0, 1, 2]]), np.array([True]))
    up = lines(np.array([[0, 0, 4e-3], [0, 0, 6e-3]]), np.array([[0, 0, 0.1], [0, 0, 0.1]]))
    assert root_figures(up, true, head)["scalp"] == "marked"
    assert root_figures(up, true, head)["pred"]["rooted"] == 0.5


def test_suspicious_input_gives_a_warning() -> None:
    assert input_warnings(row(), row()) == []
    millimetres = Strands(row().points * np.float32(1e3), row().offsets)
    assert "span 128 m" in input_warnings(millimetres, row())[0]
    assert "both are in metres" in input_warnings(millimetres, row())[0]
    assert "one frame" in input_warnings(row().transformed(np.eye(3), [3, 0, 0]), row())[0]
    to_y_up = np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]])
    y_up = brush(600).transformed(to_y_up, [0, 0, 0])
    assert "both are z up" in input_warnings(y_up, brush(600))[0]
    assert input_warnings(brush(600), brush(600)) == []
    still = Strands(np.repeat(row().points[:2], 2, axis=0), [0, 2, 4])
    assert "2 of 2 predicted strands have zero length" in input_warnings(still, still)[-1]


@pytest.mark.parametrize(
    "pred",
    [
        Strands.from_list([]),
        Strands.from_list([np.zeros((2, 3))]),
        Strands(row(1).points * np.float32(1e3), [0, 2]),
        Strands.from_list([np.array([[0, 0, 0.09], [0, 0, 1e-12]])]),
    ],
    ids=["none", "a point", "millimetres", "one"],
)
def test_degenerate_predictions_give_finite_figures(pred: Strands) -> None:
    figures = assess_strands(pred, brush(400), samples=2000).figures
    assert json.loads(json.dumps(figures, allow_nan=False)) == figures
    assert figures["all"]["1mm_10deg"]["recall"] <= 0.1


def test_pictures(tmp_path: Path) -> None:
    pictures = draw_errors(assess_strands(row(), brush(400), samples=500), tmp_path)
    assert {p.name for p in pictures} == {"distance.png", "angle.png"}
    assert all(p.stat().st_size > 5000 for p in pictures)


def test_a_single_true_strand() -> None:
    true = row(1)
    figures = assess_strands(true, true).figures
    assert figures["all"]["1mm_10deg"]["f"] == 1.0
    with pytest.raises(ValueError, match="no true strands"):
        assess_strands(true, Strands.from_list([]))


def test_sampled_wholeness_says_its_error() -> None:
    rng = np.random.default_rng(0)
    true = row(3000, 0.02, 5e-3)
    keep = rng.random(len(true)) < 0.7
    covered = assess_strands(true.subset(keep), true, samples=500).figures["connectivity"]["true"]
    assert covered["followed"] == 1000
    error = covered["covered"]["error"]
    assert error == pytest.approx(np.sqrt(0.7 * 0.3 / 1000), rel=0.1)
    assert abs(covered["covered"]["mean"] - keep.mean()) < 4 * error
