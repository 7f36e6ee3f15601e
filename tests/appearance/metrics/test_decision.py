"""A stage is kept if held-out frames improve by more than the standard error of that."""

from __future__ import annotations

import numpy as np
import pytest

from appearance.metrics.decision import Decision, decide, with_needed


def test_the_standard_error_is_the_spread_over_captures():
    """Of 400 captures whose views and parts of hair differ by independent random amounts."""
    rng, counts = np.random.default_rng(0), np.full((8, 9), 100.0)
    changes, errors = [], []
    for _ in range(400):
        before = counts * (1 + 0.1 * rng.normal(size=(8, 1)) + 0.1 * rng.normal(size=(1, 9)))
        after = before * (0.8 + 0.1 * rng.normal(size=(8, 1)) + 0.1 * rng.normal(size=(1, 9)))
        found = decide("shared", before, after, counts)
        changes.append(found.before - found.after)
        errors.append(found.standard_error)
    assert np.mean(errors) == pytest.approx(np.std(changes), rel=0.15)
    assert np.mean(changes) == pytest.approx(1 - 0.8**0.5, rel=0.05)


@pytest.mark.parametrize(
    ("after", "kept"), [(0.0398, True), (0.0408, False), (0.0412, False), (0.05, False)]
)
def test_one_standard_error_keeps(after, kept):
    found = Decision("lights", 0.0412, after, 0.0006)
    assert found.kept == kept
    assert str(found) == (
        f"lights: error on held-out frames 0.0412 → {after:.4f}, standard error 0.0006: "
        + ("kept" if kept else "dropped")
    )


def test_nothing_is_kept_without_a_standard_error_or_by_what_is_not_a_number():
    one = np.ones((1, 1))
    assert not decide("field", one, 0 * one, one).kept
    many = np.ones((3, 9))
    assert not decide("field", many, many * np.nan, many).kept
    assert not decide("field", 0 * many, 0 * many, 0 * many).kept


def test_the_estimate_is_linear_in_the_sums_by_hand():
    """Two views of one part, one pixel each: squares fall by 0.8 and 0.6, their mean by 0.7, with
    a standard error of 0.1; the sum after is that of noise, below 0."""
    before, after = np.array([[0.7], [0.74]]), np.array([[-0.1], [0.14]])
    found = decide("field", before, after, np.ones((2, 1)))
    was, now = 0.72**0.5, 0.02**0.5
    assert (found.before, found.after) == (pytest.approx(was), pytest.approx(now))
    assert found.standard_error == pytest.approx(0.1 / (was + now))
    negative = decide("field", before, after - 0.04, np.ones((2, 1)))
    assert negative.after == pytest.approx(-0.02 / was)
    assert negative.before - negative.after == pytest.approx(0.74 / was)
    assert negative.kept


@pytest.mark.parametrize("error", [0.1, 0.01, 0.0])
def test_what_changes_nothing_is_seldom_kept_at_any_error(error):
    """One standard error keeps 16 % where errors are of views or parts, fewer where they are of
    noise, also if the errors themselves vanish in it."""
    rng, counts = np.random.default_rng(0), np.full((8, 9), 100.0)
    draws = counts * (error**2 + 1e-3 * rng.normal(size=(1000, 2, 8, 9)))
    kept = np.mean([decide("field", a, b, counts).kept for a, b in draws])
    assert 0.02 < kept < 0.16


@pytest.mark.parametrize("shape", [(1, 9), (8, 1)])
def test_one_view_or_one_part_has_the_spread_of_the_other_axis(shape):
    rng, counts = np.random.default_rng(0), np.full(shape, 100.0)
    fall = 0.2 * (1 + 0.1 * rng.normal(size=shape))
    found = decide("field", counts, counts * (1 - fall), counts)
    scale = found.before + found.after
    expected = np.std(fall, ddof=1) / fall.size**0.5 / scale
    assert found.standard_error == pytest.approx(expected)
    assert found.kept
    assert not decide("field", counts, counts, counts).kept  # 0 is not more than 0


def test_views_and_parts_without_frames_do_not_count():
    rng = np.random.default_rng(0)
    before, after = rng.uniform(1, 2, (2, 4, 9))
    counts = np.full((4, 9), 10.0)
    padded = [np.pad(x, ((0, 2), (0, 0))) for x in (before, after, counts)]
    assert decide("field", *padded) == decide("field", before, after, counts)


def test_stages_are_in_order_with_what_they_start_from():
    assert with_needed(["field", "sun"]) == ("sun", "field")
    assert with_needed(["lights"]) == ("shared", "lights")
