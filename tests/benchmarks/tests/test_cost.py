"""Cost against size: one small run, and the table."""

from __future__ import annotations

import argparse
import json

import pytest
from benchmarks.renderers.cost import BENCHMARK, _table

from reconstruction import silent


def test_the_table_has_estimated_over_measured():
    size = {"cameras": 8, "side": 128, "lights": 24, "strands": 20_000, "bounces": 16}
    row = {"job": "fit, sun", "size": size, "seconds": 50.0, "estimated_seconds": 60.0}
    lines = _table([row | {"gb": 0.8, "estimated_gb": 0.6}]).splitlines()
    assert lines[-1] == "| fit, sun | 8 | 128 | 24 | 20000 | 16 | 50.0 | 1.20 | 0.80 | 0.75 |"


@pytest.mark.slow
def test_a_quick_run_measures_frames_and_a_fit_beside_their_estimates(tmp_path):
    args = argparse.Namespace(quick=True, full=False, out=tmp_path, seed=0)
    result = BENCHMARK.run(args, silent)
    assert json.loads((tmp_path / "cost.json").read_text()) == result
    assert [x["job"] for x in result["rows"]] == ["frames", "frames", "fit, sun"]
    for row in result["rows"]:
        assert row["seconds"] > 0.5
        assert 0.2 < row["gb"] < 2  # of a process that has loaded the renderer
    frames = result["rows"][:2]
    assert all(x["estimated_gb"] == pytest.approx(x["gb"], rel=0.3) for x in frames)
