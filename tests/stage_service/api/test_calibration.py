"""Calibration over HTTP: pictures of a board whose place is known, and the rig that comes of it."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from serving import Client, serving, slug
from shooting import shoot
from waiting import gone, orphan, until

from reconstruction import Camera, Light, Rig, Step
from reconstruction.calibration.boards import Board
from simulators.subject.props import PropResponder, board_pose
from stage_service.calibrating import Calibrating
from stage_service.config import load_rig_file
from stage_service.decoding import Decoder
from stage_service.records.events import EventLog
from stage_service.service_models import CalibrationRequest

BOARD = Board()
STEPS = [Step(0, "dark", 0.02, 0.0), Step(1, "all_on", 0.02, 0.5)]


@pytest.fixture
def truth() -> Rig:
    """Two cameras 20° apart that see the board at 3 px a millimetre, and a light."""
    eyes = ((0.9, -0.05, 0.1), (0.85, 0.28, 0.1))
    cameras = [
        Camera.look_at(f"cam_{k}", 240, 200, eye, (0, 0, 0), 21.0) for k, eye in enumerate(eyes)
    ]
    return Rig("stage", tuple(cameras), (Light("lamp", (1.1, 0.1, 0.3), (8.0, 8.0, 8.0)),), ())


@pytest.fixture
def nominal(truth: Rig) -> Rig:
    """The second camera 20 mm too far from the first."""
    far = replace(truth.cameras[1], t=truth.cameras[1].t + np.array([0.0, 0.004, 0.02]))
    return replace(truth, cameras=(truth.cameras[0], far))


@pytest.fixture
def http(truth: Rig, nominal: Rig, tmp_path: Path) -> Iterator[Callable[..., Client]]:
    """`http(pose, …)`: a service without a stage that has captures of the board in these poses."""
    with ExitStack() as stack:

        def start(*poses: int) -> Client:
            for pose in poses:
                path = tmp_path / "root" / "captures" / f"pose-{pose}"
                path.parent.mkdir(parents=True, exist_ok=True)
                responder = PropResponder(truth, board_pose(pose, BOARD), samples=2)
                shoot(path, truth, responder, STEPS, written=nominal)
            rig_path = tmp_path / "nominal.json"
            rig_path.write_text(json.dumps(nominal.to_dict()))
            return stack.enter_context(serving(load_rig_file(rig_path), tmp_path / "root"))

        yield start


def test_corners_are_where_the_camera_has_them(truth, http):
    client, prop, (camera, _) = http(0), board_pose(0, BOARD), truth.cameras
    observed = client.get("/captures/pose-0/board/cam_0").json()
    assert (observed["lens"], observed["of"]) == ("nominal", 48)
    assert observed["corners"] >= 30
    tilt = np.degrees(np.arccos(abs((camera.R @ prop.rotation[:, 2])[2])))
    assert observed["tilt_deg"] == pytest.approx(tilt, abs=2)
    world = BOARD.corners @ prop.rotation.T + prop.translation
    true, _ = cv2.projectPoints(world, cv2.Rodrigues(camera.R)[0], camera.t, camera.K, None)
    apart = np.linalg.norm(np.array(observed["pixels"])[:, None] - true[:, 0], axis=-1)
    assert apart.min(axis=1).max() < 0.5
    rms = np.sqrt((np.array(observed["off"]) ** 2).sum(axis=1).mean())
    assert observed["rms_px"] == pytest.approx(rms, abs=1e-3)
    assert observed["rms_px"] < 0.2
    none = client.get("/captures/pose-0/board/cam_0?square_mm=9&marker_mm=12")
    assert slug(none) == "bad-input"
    assert slug(client.get("/captures/pose-0/board/cam_9")) == "unknown-frame"
    assert slug(client.get("/calibration/rig.json")) == "not-there"
    assert slug(client.post("/calibration", json={"boards": ["nope"]})) == "unknown-capture"
    assert client.get("/calibration").json()["state"] == "none"


def test_a_camera_that_the_calibrated_rig_lacks_is_shown_by_its_own_lens(truth, http, tmp_path):
    client = http(0)
    calibrated = tmp_path / "root" / "calibration" / "rig.json"
    calibrated.parent.mkdir(exist_ok=True)
    one, other = truth.cameras
    for cameras in ((one,), (one, replace(other, width=other.width // 2))):
        calibrated.write_text(json.dumps(replace(truth, cameras=cameras).to_dict()))
        views = [
            client.get(f"/captures/pose-0/board/{c.name}?calibrated=true").json()
            for c in truth.cameras
        ]
        assert [view["lens"] for view in views] == ["calibrated", "nominal"]


@pytest.mark.slow
def test_the_rig_that_comes_of_it_and_why_none_does(truth, http, tmp_path):
    client = http(0, 1, 16)
    body = {"boards": ["pose-0", "pose-1", "pose-16"], "keep_lens": True}
    assert client.post("/calibration", json=body).json()["state"] == "running"
    view = until(
        lambda: v if (v := client.get("/calibration").json())["state"] != "running" else None
    )
    assert (view["state"], view["error"]) == ("done", None)
    assert [stage["name"] for stage in view["stages"]] == ["cameras", "lights"]
    (tmp_path / "found.json").write_text(client.get("/calibration/rig.json").text)
    found = load_rig_file(tmp_path / "found.json").rig
    apart = [np.linalg.norm(r.cameras[1].center - r.cameras[0].center) for r in (found, truth)]
    assert apart[0] == pytest.approx(apart[1], abs=0.002)
    observed = client.get("/captures/pose-0/board/cam_1?calibrated=true").json()
    assert observed["lens"] == "calibrated"

    client.post("/calibration", json={"boards": ["pose-0"]})
    view = until(
        lambda: v if (v := client.get("/calibration").json())["state"] == "failed" else None
    )
    assert "cam_0: sees 8 or more corners of the board in 1" in view["error"]
    assert view["rig"], "that of before is still there"


def test_one_whose_rig_cannot_be_put_in_its_place_has_failed(nominal, tmp_path, monkeypatch):
    monkeypatch.setattr("sys.executable", "/bin/true")  # ends well, and leaves nothing behind
    (tmp_path / "nominal.json").write_text(json.dumps(nominal.to_dict()))
    rig_file = load_rig_file(tmp_path / "nominal.json")
    one = Calibrating(tmp_path / "calibration", rig_file, EventLog(), Decoder())
    one.begin(CalibrationRequest(boards=["pose"]), lambda _: tmp_path)
    until(lambda: one.view().state != "running")
    assert one.view().state == "failed"
    assert "next.report.json" in (one.view().error or "")


def test_one_that_runs_ends_with_a_service_that_is_killed(nominal, tmp_path):
    code = """
import os, signal, sys, time
from pathlib import Path
from stage_service.calibrating import Calibrating
from stage_service.config import load_rig_file
from stage_service.decoding import Decoder
from stage_service.records.events import EventLog
from stage_service.service_models import CalibrationRequest

root = Path(sys.argv[1])
one = Calibrating(root / "calibration", load_rig_file(root / "nominal.json"), EventLog(), Decoder())
one.begin(CalibrationRequest(boards=["pose"]), lambda _: root / "pose")
child = one._process.pid
words = Path(f"/proc/{child}/cmdline")
while b"setpriv" in (said := words.read_bytes()) or not said:  # none: it becomes setpriv just now
    time.sleep(0.01)
os.kill(child, signal.SIGSTOP)  # it would end by itself otherwise
print(child, flush=True)
time.sleep(600)
"""
    (tmp_path / "nominal.json").write_text(json.dumps(nominal.to_dict()))
    child = orphan(code, tmp_path)
    until(lambda: gone(child))
