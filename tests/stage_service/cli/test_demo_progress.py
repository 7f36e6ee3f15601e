"""The demo's time left, of statuses and by a clock of our own."""

from __future__ import annotations

import csv
import json

import pytest

from reconstruction import Rig
from stage_service.cli.demo_kinds import LIGHTS, PIXELS, quick_rig
from stage_service.cli.demo_progress import DemoProgress
from stage_service.cli.support.commands import BadArgument, rig_path

STEPS = ("reconstruct", "fit", "inverse_rendering", "relight", "assess", "evaluate", "results")
USUAL_S = dict.fromkeys(STEPS, 10.0)  # 70 s in all
RENDERING = {"cameras": ["cam_3", "cam_5"], "seconds": 41, "doing": "rendering camera 3 of 8"}


def capture(left: float | None, waiting: dict | None = None) -> dict:
    progress = {"frames": {"cam_3": 8, "cam_5": 4}, "seconds_left": left, "share": 0.25}
    progress["waiting"] = waiting
    return {"state": "running", "frames_planned": 4360, "frames_written": 8, "progress": progress}


def job(step: str, share: float) -> dict:
    progress = {"step": step, "step_share": share, "what": "tracing", "share": 0.0}
    return {"state": "running", "progress": progress}


def test_the_runs_own_pace_scales_the_usual_durations(tmp_path):
    shown, now = list[tuple[str, float]](), [0.0]
    progress = DemoProgress(
        lambda what, share: shown.append((what, share)), 100.0, USUAL_S, lambda: now[0]
    )
    progress.capture(capture(None))
    assert shown[-1] == ("running, 12 of 4,360 frames", 0.0)
    now[0] = 50.0
    progress.capture(capture(150.0, RENDERING))
    # 200 s instead of 100 s: the job's 70 s will be 140 s
    text = "rendering camera 3 of 8, 41 s; 12 of 4,360 frames; 5 min left"
    assert shown[-1] == (text, pytest.approx(50 / (50 + 150 + 140)))
    now[0] = 200.0
    progress.job(job("fit", 0.5))
    # 200 s for 115 s: the last 55 s take 96 s
    assert shown[-1] == ("fit: tracing; 2 min left", pytest.approx(200 / (200 + 55 * 200 / 115)))
    progress.job(job("relight", 0.0))
    now[0] += 10 * 200 / 130  # 10 s at the pace of 200 s for 130 s, and nothing is reported
    progress.job(job("relight", 0.1))
    done_s = 130 + 9.5
    assert shown[-1][1] == pytest.approx(done_s / 170, abs=0.01)
    now[0] = 300.0
    progress.job(job("compress", 0.1))
    assert shown[-1][1] == 1.0
    progress.save(tmp_path / "progress.csv")
    rows = list(csv.reader((tmp_path / "progress.csv").read_text().splitlines()))
    assert [row[2:4] for row in rows[1:]] == [
        ["", "300"],
        ["290", "250"],
        ["96", "100"],
        ["47", "85"],
        ["0", "0"],
    ]


def test_the_quick_rig_has_fewer_lights_and_pixels(tmp_path):
    file = tmp_path / "rig.json"
    file.write_text(json.dumps(quick_rig(rig_path("demo"))))
    quick, full = Rig.load(file), Rig.load(rig_path("demo"))
    assert len(quick.lights) == LIGHTS < len(full.lights)
    assert {(c.width, c.height) for c in quick.cameras} == {(PIXELS, PIXELS)}
    # the same field of view
    assert quick.cameras[0].K[0, 0] / PIXELS == pytest.approx(full.cameras[0].K[0, 0] / 160)


def test_a_rig_without_a_dome_has_no_quick_demo(tmp_path):
    file = tmp_path / "rig.toml"
    file.write_text("[[lights]]\nname = 'lamp'\n")
    with pytest.raises(BadArgument, match=r"needs a rig file with \[dome\]"):
        quick_rig(file)
