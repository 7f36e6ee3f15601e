"""A camera misses a trigger: the frame is missed by count, and shot again."""

from __future__ import annotations

import json
from pathlib import Path

import pytest


@pytest.mark.slow
def test_exactly_the_dropped_frame_is_captured_again(stage):
    pulse = 6
    stage.simulate([{"device": "camera", "kind": "drop", "pulse": pulse, "camera": "cam_1"}])
    stage.serve()
    capture = stage.capture({})
    assert capture["outcome"] == "completed"
    assert (capture["frames_written"], capture["frames_missing"]) == (stage.FRAMES, 0)
    path = Path(capture["path"])
    journal = [json.loads(line) for line in (path / "journal.jsonl").read_text().splitlines()]
    again = [(r["step"], r["camera"]) for r in journal if r["file"] and r["attempt"] > 0]
    assert again == [(pulse - 1, "cam_1")]
    written = [(r["step"], r["camera"]) for r in journal if r["file"]]
    assert len(written) == len(set(written)) == stage.FRAMES
    assert stage.verify(path) == []
    # The frame that came on the second try shows its own lamp, not the next one's.
    response = stage.http.get(f"/captures/{capture['id']}/frames/{pulse - 1}/cam_1.exr")
    assert response.is_success
