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


def test_views_and_parts_without_frames_do_not_count():
    rng = np.random.default_rng(0)
    before, after = rng.uniform(1, 2, (2, 4, 9))
    counts = np.full((4, 9), 10.0)
    padded = [np.pad(x, ((0, 2), (0, 0))) for x in (before, after, counts)]
    assert decide("field", *padded) == decide("field", before, after, counts)


def test_stages_are_in_order_with_what_they_start_from():
    assert with_needed(["field", "sun"]) == ("sun", "field")
    assert with_needed(["lights"]) == ("shared", "lights")
