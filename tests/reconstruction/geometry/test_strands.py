"""Polylines: their bookkeeping, tangents and resampling."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from reconstruction import Strands

metres = st.floats(-1, 1, width=32)


@st.composite
def some_strands(draw: st.DrawFn) -> Strands:
    counts = draw(st.lists(st.integers(2, 7), min_size=1, max_size=5))
    strands = [draw(hnp.arrays(np.float32, (n, 3), elements=metres)) for n in counts]
    out = Strands.from_list(strands)
    radius = np.linspace(1e-5, 1e-3, len(out.points)).astype(np.float32)
    return Strands(out.points, out.offsets, radius)


@given(strands=some_strands(), step=st.floats(0.005, 3))
def test_resampling(strands: Strands, step: float) -> None:
    fine = strands.resampled(step)
    assert len(fine) == len(strands)
    lengths = strands.lengths()
    for i in range(len(strands)):
        np.testing.assert_allclose(fine[i][[0, -1]], strands[i][[0, -1]], atol=1e-6)
        assert len(fine[i]) == max(int(np.ceil(lengths[i] / step)), 1) + 1
        # chords are never longer than the arcs they span
        chords = np.linalg.norm(np.diff(fine[i].astype(float), axis=0), axis=1)
        assert chords.max() <= lengths[i] / (len(fine[i]) - 1) + 1e-5
        # every new point lies on the old polyline
        a, b = strands[i][:-1].astype(float), strands[i][1:].astype(float)
        t = ((fine[i][:, None] - a) * (b - a)).sum(-1) / np.maximum(((b - a) ** 2).sum(-1), 1e-30)
        nearest = a + np.clip(t, 0, 1)[..., None] * (b - a)
        assert np.linalg.norm(fine[i][:, None] - nearest, axis=-1).min(axis=1).max() < 1e-5
    assert (fine.lengths() <= lengths + 1e-5).all()
    assert np.min(strands.radius) * 0.999 <= np.min(fine.radius)
    assert np.max(fine.radius) <= np.max(strands.radius) * 1.001


@given(strands=some_strands())
def test_tangents_are_unit_or_zero(strands: Strands) -> None:
    norm = np.linalg.norm(strands.tangents(), axis=1)
    assert ((norm < 1e-12) | (np.abs(norm - 1) < 1e-5)).all()


@given(strands=some_strands(), data=st.data())
def test_subset_keeps_order_points_and_radii(strands: Strands, data: st.DataObject) -> None:
    which = data.draw(st.lists(st.integers(0, len(strands) - 1), max_size=6))
    some = strands.subset(np.array(which, int))
    assert len(some) == len(which)
    radius = np.asarray(some.radius)
    for k, i in enumerate(which):
        np.testing.assert_array_equal(some[k], strands[i])
        mine = radius[some.offsets[k] : some.offsets[k + 1]]
        theirs = np.asarray(strands.radius)[strands.offsets[i] : strands.offsets[i + 1]]
        np.testing.assert_array_equal(mine, theirs)


def test_equal_steps_on_a_long_groom() -> None:
    """The one growing arc coordinate keeps micrometres over a kilometre of hair."""
    t = np.linspace(0, 1, 40)
    helix = np.stack([0.01 * np.cos(20 * t), 0.01 * np.sin(20 * t), 0.2 * t], axis=1)
    strands = Strands.from_list([helix + np.array([0, 0, 1e-4 * i]) for i in range(4000)])
    fine = strands.resampled(1e-3)
    last = np.linalg.norm(np.diff(fine[3999].astype(float), axis=0), axis=1)
    assert last.max() / last.min() < 1.02
    np.testing.assert_allclose(fine.lengths(), strands.lengths(), rtol=2e-3)


def test_tangents_of_a_circle() -> None:
    t = np.linspace(0, 2, 400)
    circle = Strands.from_list([np.stack([np.cos(t), np.sin(t), 0 * t], axis=1)])
    expected = np.stack([-np.sin(t), np.cos(t), 0 * t], axis=1)
    np.testing.assert_allclose(circle.tangents()[1:-1], expected[1:-1], atol=1e-5)
    np.testing.assert_allclose(circle.tangents()[[0, -1]], expected[[0, -1]], atol=3e-3)


def test_tangents_do_not_leak_between_strands() -> None:
    strands = Strands.from_list([np.eye(3)[:2] * 0.5, np.array([[5, 0, 0], [6, 0, 0], [6, 0, 0]])])
    expected = np.array([[-1, 1, 0]]) / np.sqrt(2)
    np.testing.assert_allclose(strands.tangents()[:2], np.repeat(expected, 2, axis=0), atol=1e-7)
    np.testing.assert_array_equal(strands.tangents()[2:4], [[1, 0, 0], [1, 0, 0]])
    assert not strands.tangents()[4].any()


def test_bookkeeping() -> None:
    strands = Strands.from_list([np.zeros((2, 3)), np.ones((3, 3))])
    assert strands.strand_of_point.tolist() == [0, 0, 1, 1, 1]
    assert strands.segment_starts.tolist() == [0, 2, 3]
    assert strands.roots.tolist() == [[0, 0, 0], [1, 1, 1]]
    assert strands.lengths().tolist() == [0, 0]
    assert [len(s) for s in strands] == [2, 3]
    with pytest.raises(IndexError, match="strand 2 of 2"):
        strands[2]
    assert strands.resampled(0.1).offsets.tolist() == [0, 2, 4]


def test_a_cone_is_as_thick_where_it_is_cut_as_it_was_there() -> None:
    """50 µm at the root and 10 µm at the tip, 10 cm long: 40 µm a quarter of the way."""
    points = np.array([[0, 0, 0], [0, 0, 0.1], [0, 0, 0], [0, 0, 0.02]])
    radius, confidence = np.array([5e-5, 1e-5, 5e-5, 1e-5]), np.array([1.0, 0.0, 1.0, 0.0])
    short = Strands(points, np.array([0, 2, 4]), radius, confidence).cut(0.025)
    np.testing.assert_allclose(short.points[:, 2], [0, 0.025, 0, 0.02], rtol=1e-6)
    np.testing.assert_allclose(short.radius, [5e-5, 4e-5, 5e-5, 1e-5], rtol=1e-6)
    np.testing.assert_allclose(short.confidence, [1, 0.75, 1, 0], rtol=1e-6)


def test_no_hair_is_allowed() -> None:
    bald = Strands.from_list([])
    assert len(bald) == 0
    assert len(bald.resampled(1e-3)) == 0
    assert bald.tangents().shape == (0, 3)
    assert bald.lengths().shape == (0,)
    assert bald.segment_starts.shape == (0,)
    assert len(bald.subset([])) == 0


def test_moving() -> None:
    strands = Strands.from_list([np.array([[1, 2, 3], [4, 5, 6]])])
    turn = np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1]])
    assert strands.transformed(turn, [1, 0, 0]).points.tolist() == [[-1, 1, 3], [-4, 4, 6]]


@pytest.mark.parametrize(
    ("points", "offsets", "radius", "words"),
    [
        (np.zeros((4, 3)), [0, 2, 3], 1e-4, "offsets must run from 0 to the 4 points"),
        (np.zeros((4, 3)), [1, 4], 1e-4, "offsets must run"),
        (np.zeros((4, 3)), [0, 3, 4], 1e-4, "1 strands have under two points, the first is 1"),
        (np.zeros((4, 3)), [0, 4, 2, 4], 1e-4, "under two points"),
        (np.full((2, 3), np.nan), [0, 2], 1e-4, "points must be finite"),
        (np.zeros((2, 3)), [0, 2], 0.0, "radius must be positive"),
        (np.zeros((2, 3)), [0, 2], np.ones(3), r"radius must be a scalar or \(2,\)"),
    ],
)
def test_bad_strands(points: np.ndarray, offsets: list[int], radius: float, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        Strands(points, np.array(offsets), radius)


def test_bad_steps() -> None:
    with pytest.raises(ValueError, match="step must be positive"):
        Strands.from_list([np.eye(3)]).resampled(0)
