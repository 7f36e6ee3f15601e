"""The seam that the API calls: one capture at a time, listed, steered, dark at the end."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from waiting import until as waited

from reconstruction import Capture
from stage_service.acquisition.states import WrongState
from stage_service.captures.capture_run import plan_of
from stage_service.captures.manager import CaptureManager
from stage_service.captures.may_light import NotNow
from stage_service.config import RigFile
from stage_service.plan.capture_plan import CapturePlan
from stage_service.plan.resolved import PlanError

SHORT = CapturePlan(lights=("light_003", "light_000"), projectors=())
LONG = CapturePlan(projectors=())


@pytest.fixture
def completed() -> list[Any]:
    return []


@pytest.fixture
def manager(rig_file: RigFile, tmp_path: Path, completed: list[Any]) -> Iterator[CaptureManager]:
    one = CaptureManager(rig_file, tmp_path / "service", completed.append)
    one.stage.darken()
    yield one
    one.close()


def until(manager: CaptureManager, kind: str, **wanted: Any) -> Any:
    """The first event of this kind with these values."""
    number = 0
    for _ in range(1000):
        events = manager.events.wait(number, 10.0)
        assert events, f"no {kind} {wanted} within 10 s"
        for event in events:
            number = event.number
            if event.kind == kind and wanted.items() <= event.data.items():
                return event
    raise AssertionError(kind)


def test_blackout_ends_a_capture_at_once_even_while_cameras_are_busy(manager, world):
    world.busy = {"cam_1": 10**9, "cam_2": 10**9}
    capture_id = manager.start(LONG)
    until(manager, "capture.state", state="running")
    assert manager.blackout() == {
        "safe": True,
        "state": "dark",
        "detail": "every lamp and projector was read back dark",
    }
    assert manager.wait(capture_id, 20).outcome == "aborted"


def test_a_capture_for_which_no_thread_can_be_had_keeps_nobody_from_anything(
    manager, world, completed, monkeypatch
):
    begin = threading.Thread.start

    def none_left(thread: threading.Thread) -> None:
        if thread.name.startswith("capture-"):
            raise RuntimeError("can't start new thread")
        begin(thread)

    monkeypatch.setattr(threading.Thread, "start", none_left)
    with pytest.raises(RuntimeError, match="can't start new thread"):
        manager.start(SHORT)
    assert manager.running is None
    assert manager.blackout()["safe"]
    (status,) = manager.list()
    assert status.outcome == "interrupted"
    monkeypatch.undo()
    manager.resume(status.id)
    ended = manager.wait(status.id, 20)
    assert ended.outcome == "completed", ended.error


PATTERNS = CapturePlan(
    patterns={"grey": {"light_003": 0.5, "light_004": 1.0}}, projectors=(), sentinels=False
)


def test_a_plan_of_patterns_is_recorded_and_found_again(manager, rig_file, completed):
    capture_id = manager.start(PATTERNS)
    assert manager.wait(capture_id, 20).outcome == "completed"
    capture = Capture(manager.path(capture_id))
    assert capture.lightings() == ["grey"]
    assert capture.patterns.lights == ("light_003", "light_004")
    assert plan_of(capture, rig_file).steps == capture.steps
    coarse = rig_file.devices.lights.registers.model_copy(update={"level_full": 25})
    lights = rig_file.devices.lights.model_copy(update={"registers": coarse})
    devices = rig_file.devices.model_copy(update={"lights": lights})
    with pytest.raises(PlanError, match=r"\[devices\] has changed since this capture"):
        plan_of(capture, replace(rig_file, devices=devices))


def test_a_pattern_over_the_limit_is_refused_before_anything_is_lit(
    manager, world, rig_file, monkeypatch
):
    lit = []
    world.put_on = lit.append
    limits = rig_file.safety.model_copy(update={"max_power_w": 0.59})
    monkeypatch.setattr(manager, "rig_file", replace(rig_file, safety=limits))
    with pytest.raises(PlanError, match=r"2 lamps of grey at level 0\.0399939 draw 0\.5998 W"):
        manager.start(PATTERNS)
    assert (lit, manager.list(), manager.running) == ([], [], None)


def test_blackout_without_a_capture(manager, world):
    world.lit, world.show = {3, 4}, "ON 65535"
    assert manager.blackout()["safe"]
    assert not world.lit
    assert world.show == "OFF"
    world.lit, world.stuck_lamps = {7}, True
    response = manager.blackout()
    assert not response["safe"]
    assert "unknown, unsafe" in response["detail"]


def test_devices_are_queried_one_by_one(manager, world):
    world.estop = True
    world.late = ["ID?"]
    manager.devices()
    # Another `devices()` would begin a second query, for which the trigger box has its late reply.
    waited(lambda: not manager.stage._status.running_s())
    devices = manager.stage._status.peek()
    assert devices["lights"]["estop_pressed"] is True
    assert devices["lights"]["count"] == 200
    assert devices["trigger"]["state"] == "unreachable"
    assert "identifying: expected a trigger box" in devices["trigger"]["error"]
    assert devices["projectors"]["names"] == ["left", "right"]
    assert devices["cameras"]["cam_2"]["gain"] == 10000.0


def test_an_interrupted_capture_is_listed_after_a_restart(manager, rig_file, world):
    capture_id = manager.start(SHORT)
    manager.wait(capture_id, 20)
    (manager.path(capture_id) / "manifest.json").unlink()
    (manager.folder / "not a capture").mkdir()
    damaged = manager.folder / "damaged"
    damaged.mkdir()
    (damaged / "plan.json").write_text("{")
    (damaged / "rig.json").write_text("{")
    manager.close()
    again = CaptureManager(rig_file, manager.folder.parent)
    status, broken = again.list()
    assert (status.state, status.outcome) == ("done", "interrupted")
    assert status.frames_written == 18
    assert (broken.id, broken.outcome) == ("damaged", "damaged")
    assert "rig.json" in broken.error
    with pytest.raises(WrongState, match="possible now: nothing"):
        again.resume("damaged")
    again.close()


def test_a_failed_follow_up_is_reported_and_the_capture_stays_completed(rig_file, tmp_path, world):
    def broken(_status: Any) -> None:
        raise RuntimeError("no queue")

    manager = CaptureManager(rig_file, tmp_path / "service", broken)
    manager.stage.darken()
    status = manager.wait(manager.start(SHORT), 20)
    assert status.outcome == "completed"
    event = until(manager, "capture.follow_up_failed")
    assert event.data["error"] == "RuntimeError: no queue"
    manager.close()


def test_a_closed_manager_starts_nothing(manager):
    manager.close()
    with pytest.raises(NotNow, match="the service is closing"):
        manager.start(SHORT)


WHOLE = {"kind": "dark", "exposure": 0.01}
DAMAGES = {
    "a plan without steps": {"plan.json": '{"steps": null}'},
    "a step whose number is text": {"plan.json": json.dumps({"steps": [{**WHOLE, "index": "a"}]})},
    "a plan too deep": {"plan.json": "[" * 100_000},
    "a request that is a list": {"plan.json": '{"steps": [], "request": [1]}'},
    "a request with half a character": {
        "plan.json": r'{"steps": [], "request": {"environment": "\ud800"}}'
    },
    "a rig whose camera is a number": {"rig.json": '{"cameras": [5]}'},
    "an empty manifest": {"manifest.json": ""},
    "a manifest without an outcome": {"manifest.json": "{}"},
    "a journal that is no text": {"journal.jsonl": b"\xff\xfe\x00\n{}\n"},
    "a journal line cut": {"journal.jsonl": '{"step": 0, "cam\n{}\n'},
}


def test_a_damaged_capture_is_listed_with_its_reason_and_harms_no_other(manager, rig_file):
    whole = manager.start(SHORT)
    manager.wait(whole, 20)
    folder = manager.folder
    for name, files in DAMAGES.items():
        shutil.copytree(folder / whole, folder / name)
        for file, content in files.items():
            path = folder / name / file
            path.unlink()
            if content is None:
                path.mkdir()
            else:
                path.write_bytes(content if isinstance(content, bytes) else content.encode())
    no_text = folder / os.fsdecode(b"caf\xe9")
    no_text.mkdir()
    (no_text / "plan.json").write_text("{}")
    manager.close()
    again = CaptureManager(rig_file, folder.parent)
    listed = {status.id: status for status in again.list()}
    again.close()
    assert set(listed) == {whole, *DAMAGES}
    for name, status in listed.items():
        status.model_dump_json().encode()
        if name == whole:
            assert (status.outcome, status.frames_written) == ("completed", 18)
            continue
        assert (name, status.outcome) == (name, "damaged")
        broken = next(iter(DAMAGES[name]))
        assert broken in status.error or "outcome" in status.error or "request" in status.error


PROCESS = """
import sys, time
from pathlib import Path
from stage_service.captures.capture_run import plan_of
from stage_service.captures.manager import CaptureManager
from stage_service.config import load_rig_file
from stage_service.plan.capture_plan import CapturePlan
from stage_service.plan.resolved import PlanError
manager = CaptureManager(load_rig_file(sys.argv[1]), Path(sys.argv[2]))
manager.stage.darken()
manager.start(CapturePlan(projectors=()))
while manager.events.last < 12:
    manager.events.wait(manager.events.last, 1.0)
print("going", flush=True)
{ending}
"""
# Short sleeps: Python sees a signal that came just before a sleep only after it.
ASLEEP = "for _ in range(600): time.sleep(0.1)"


@pytest.mark.parametrize(
    ("ending", "send"),
    [
        ("", None),
        (ASLEEP, signal.SIGTERM),
        (ASLEEP, signal.SIGINT),
        ("raise ValueError", None),
    ],
    ids=["exit", "SIGTERM", "Ctrl-C", "exception"],
)
def test_the_process_leaves_darkness_behind(rig_file, world, tmp_path, ending, send):
    process = subprocess.Popen(
        [sys.executable, "-c", PROCESS.format(ending=ending), rig_file.path, tmp_path / "service"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        env={**os.environ, "PYTHONPATH": str(Path(__file__).resolve().parents[3])},
        text=True,
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "going\n"
    if send is not None:
        process.send_signal(send)
    process.communicate(timeout=20)
    assert not world.lit
    assert world.show == "OFF"
    manager = CaptureManager(rig_file, tmp_path / "service")
    (status,) = manager.list()
    assert status.outcome == "aborted"
    assert 0 < status.frames_written < status.frames_planned
    manager.close()
