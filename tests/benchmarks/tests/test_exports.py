"""What is said of exports that another program opened."""

from __future__ import annotations

import subprocess
import sys

from benchmarks.exports.blender import IN_BPY, tables

ROW = {"seconds": 1.0, "cpu_s": 0.5, "bytes": 2_000_000}


def test_a_colour_that_is_off_in_one_channel_misses_its_goal() -> None:
    opened = {"curves": 3, "points": 9, "box_off": 1e-6, "radius": 2e-4, "true_radius": 1e-4}
    result = {
        "strands": 3,
        "points": 12,
        "opened": {"abc": {**opened, "material": [], **ROW}},
        "colours": {
            "thin": {
                "front": {"hair": [0.91, 1.0, 1.09], "skin": [1.0, 1.0, 1.0]},
                "side": {"hair": [0.95, 1.0, 1.11], "skin": []},
                "behind": {"hair": [], "skin": []},
            }
        },
        "exporters": {"strands": 5, "points": 20, "ours": ROW},
    }
    text = tables(result)
    assert "| abc | 3 of 3 | 9 of 12 | 0.001 | 2.0000 | none | none | 1.00 |" in text
    lines = [line for line in text.splitlines() if line.startswith("| thin")]
    assert [line.split(" | ")[-1] for line in lines] == ["met |", "missed |", "in the dark |"]
    assert "| ours | 1.0 | 0.5 | 2.0 |" in text


def test_the_script_for_blender_is_python_without_ours() -> None:
    """It has to run where hairstage is not installed."""
    done = subprocess.run([sys.executable, "-I", str(IN_BPY)], capture_output=True, text=True)
    assert "No module named 'bpy'" in done.stderr
