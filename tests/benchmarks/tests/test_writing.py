"""The writing benchmark: it measures what it says and leaves nothing behind."""

from __future__ import annotations

from benchmarks.acquisition.writing import measure


def test_both_writes_are_measured_on_as_many_bytes(tmp_path):
    result = measure(tmp_path, width=40, height=30, cameras=3, steps=4, repetitions=3)
    assert (result["width"], result["height"], result["cameras"]) == (40, 30, 3)
    assert result["frames"] == 12
    assert result["bytes"] >= 12 * 40 * 30 * 3 * 4
    assert result["bytes_per_s"] > 0
    assert len(result["ratios"]) == 3
    assert min(result["ratios"]) <= result["ratio"] <= max(result["ratios"])
    assert list(tmp_path.iterdir()) == []
