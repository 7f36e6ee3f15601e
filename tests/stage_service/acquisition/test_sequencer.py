"""The sequencer over real wires: every frame in its place, dark at every end."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from reconstruction import Capture, CaptureWriter, verify
from stage_service.acquisition.sequencer import Sequencer
from stage_service.config import RigFile
from stage_service.devices.device_set import DeviceSet
from stage_service.devices.permission import Permission
from stage_service.plan.capture_plan import CapturePlan
from stage_service.plan.resolved import ResolvedPlan, resolve

LIGHTS = ("light_003", "light_000", "light_150")
GAIN = 10000.0
SIGNALS = {"dark": 0, "all_on": 700, "tracking": 900}


def sequencer(
    rig_file: RigFile, path: Path, events: list[Any] | None = None, **plan: Any
) -> Sequencer:
    wanted = in_software(rig_file, **plan)
    writer = CaptureWriter.create(path, rig_file.rig, {"steps": wanted.steps})
    heard: list[Any] = [] if events is None else events
    return Sequencer(
        DeviceSet.of(rig_file),
        writer,
        wanted,
        notify=lambda *event: heard.append(event),
        permission=Permission.granted("a test"),
    )


def in_software(rig_file: RigFile, **plan: Any) -> ResolvedPlan:
    return resolve(CapturePlan(**{"lights": LIGHTS, "stepping": "software", **plan}), rig_file)


def is_dark(world: Any) -> bool:
    return not world.lit and world.show == "OFF"


def test_every_frame_shows_the_light_of_its_step(rig_file, world, tmp_path):
    run = sequencer(rig_file, tmp_path / "c")
    assert run.run() == "completed"
    assert is_dark(world)
    assert world.heartbeats > 1
    assert world.watchdog_ms == 1000 * rig_file.devices.watchdog_s
    assert verify(tmp_path / "c") == []
    capture = Capture(tmp_path / "c")
    assert world.pulses == len(capture.steps)
    for step in capture.steps:
        expected = SIGNALS.get(step.kind)
        if step.light is not None:
            expected = int(step.light[-3:]) + 1
        elif step.row is not None:
            expected = 1000 + step.row
        for camera in rig_file.rig.cameras:
            # `signal` counts per 10 ms: radiance · gain · exposure counts, whatever the exposure.
            counts = capture.frame(step, camera.name) * GAIN * 0.01
            np.testing.assert_allclose(counts, expected, atol=0.5 * 0.01 / step.exposure)
    record = capture.records[5, "cam_1"]
    assert (record.pulse, record.block_id, record.attempt) == (6, 6, 0)


def test_levels_reach_every_lamp_in_chunks(rig_file, world, tmp_path):
    plan = {"level": {"all_on": 0.25, "olat": 0.5}, "projectors": ()}
    assert sequencer(rig_file, tmp_path / "c", **plan).run() == "completed"
    assert world.levels == [round(0.25 * 65535)] * 200


def test_only_the_missing_frame_is_shot_again(rig_file, world, tmp_path):
    world.drop = {("cam_1", 4)}
    world.lose = {("cam_2", 9)}
    events: list[Any] = []
    assert sequencer(rig_file, tmp_path / "c", events).run() == "completed"
    capture = Capture(tmp_path / "c")
    again = {k: r for k, r in capture.records.items() if r.attempt > 0}
    # Pulse 4 is step 3; its repetition is pulse 5, so pulse 9 is step 7.
    assert set(again) == {(3, "cam_1"), (7, "cam_2")}
    assert again[3, "cam_1"].pulse == 5
    lines = (tmp_path / "c" / "journal.jsonl").read_text().splitlines()
    assert len(lines) == len(capture.steps) * 3
    assert world.pulses == len(capture.steps) + 2
    missing = [data for kind, data in events if kind == "capture.frame_missing"]
    assert [m["cameras"] for m in missing] == [["cam_1"], ["cam_2"]]
    assert verify(tmp_path / "c") == []


def test_a_frame_that_never_comes_is_recorded_with_its_reason(rig_file, world, tmp_path):
    world.drop = {("cam_0", p) for p in (3, 4, 5)}
    assert sequencer(rig_file, tmp_path / "c").run() == "completed"
    (problem,) = verify(tmp_path / "c")
    assert problem == "Step 2 (olat), cam_0 is missing: no frame from the camera after 3 pulses."


def test_frames_that_an_index_shift_put_in_doubt_are_shot_again(rig_file, world, tmp_path):
    """Cameras without a clock, which do not say what they hold: it shows at the next arming."""
    world.double = {4}
    assert sequencer(rig_file, tmp_path / "c").run() == "failed"
    records = Capture(tmp_path / "c").records
    taken_back = {step for (step, _), r in records.items() if r.file is None}
    assert taken_back == {2, 3, 4}  # armed alike, the pulse that fired twice among them
    assert "another step" in str(records[2, "cam_0"].reason)
    assert {step for step, _ in records} == {0, 1, 2, 3, 4}

    world.double = set()
    writer = CaptureWriter.reopen(tmp_path / "c")
    assert (
        Sequencer(
            DeviceSet.of(rig_file),
            writer,
            in_software(rig_file),
            permission=Permission.granted("a test"),
        ).run()
        == "completed"
    )
    assert verify(tmp_path / "c") == []
    capture = Capture(tmp_path / "c")
    for step, light in zip((2, 3, 4), LIGHTS, strict=True):
        counts = capture.frame(capture.steps[step], "cam_1") * GAIN * 0.01
        np.testing.assert_allclose(counts, int(light[-3:]) + 1, atol=2.5)


@pytest.mark.parametrize(
    ("fault", "text"),
    [
        ({"mute": {"cam_1"}}, "camera cam_1"),
        ({"dead_lamps": True}, "putting lamp 3 on: expected 1 lamp lit, received 0 lit"),
        ({"interlock": True}, "interlock open"),
        ({"estop": True}, "emergency stop pressed"),
        ({"late": ["PULSE 2000"]}, "firing the cameras: expected a line within"),
    ],
)
def test_trouble_fails_the_capture_dark_and_named(rig_file, world, tmp_path, fault, text):
    for name, value in fault.items():
        setattr(world, name, value)
    run = sequencer(rig_file, tmp_path / "c")
    assert run.run() == "failed"
    assert text in str(run.error)
    assert is_dark(world)
    assert run.state == "done"
    manifest = json.loads((tmp_path / "c" / "manifest.json").read_text())
    assert manifest["outcome"] == "failed"
    assert manifest["blackout"]["safe"]


def test_an_emergency_stop_in_mid_exposure_is_named(rig_file, world, tmp_path):
    run = sequencer(rig_file, tmp_path / "c")
    pulse = run.devices.trigger.pulse

    def stopped(exposure: float) -> int:
        count = pulse(exposure)
        if count == 3:
            world.lit, world.estop = set(), True
        return count

    run.devices.trigger.pulse = stopped  # type: ignore[method-assign]
    assert run.run() == "failed"
    message = "received 0 lit, the emergency stop is pressed. Clear the cause at the stage."
    assert message in str(run.error)
    assert "watchdog" not in str(run.error).partition("; blackout")[0]


def test_a_lamp_that_stays_lit_is_named(rig_file, world, tmp_path):
    run = sequencer(rig_file, tmp_path / "c")
    pulse = run.devices.trigger.pulse

    def stick(exposure: float) -> int:
        count = pulse(exposure)
        world.stuck_lamps = count == 3
        return count

    run.devices.trigger.pulse = stick  # type: ignore[method-assign]
    assert run.run() == "failed"
    (lamp,) = world.lit
    message = f"expected 0 lamps lit, received 1 lit (light_{lamp:03d} was lit last)"
    assert message in str(run.error)
    assert run.blackout is not None
    assert message in run.blackout.detail


def test_lamps_that_go_off_in_mid_exposure_leave_no_dark_frame(rig_file, world, tmp_path):
    run = sequencer(rig_file, tmp_path / "c")
    pulse = run.devices.trigger.pulse

    def cut(exposure: float) -> int:
        count = pulse(exposure)
        if count == 3:
            world.lit = set()
        return count

    run.devices.trigger.pulse = cut  # type: ignore[method-assign]
    assert run.run() == "failed"
    assert "expected 1 lamp lit, received 0 lit" in str(run.error)
    assert max(step for step, _ in Capture(tmp_path / "c").records) == 1


def test_pause_is_dark_and_resume_continues(rig_file, world, tmp_path):
    observed: list[tuple[bool, int]] = []
    run = sequencer(rig_file, tmp_path / "c")

    def notify(kind: str, data: dict[str, Any]) -> None:
        if kind == "capture.step" and data["steps_done"] == 4:
            run.pause()
        if kind == "capture.state" and data["state"] == "paused":
            observed.append((is_dark(world), world.pulses))
            run.resume()

    run._notify = notify
    assert run.run() == "completed"
    assert observed == [(True, 4)]


def test_while_paused_a_dead_bank_is_reported_and_a_repaired_one_continues(
    rig_file, world, tmp_path
):
    reported: list[str | None] = []
    run = sequencer(rig_file, tmp_path / "c")

    def notify(kind: str, data: dict[str, Any]) -> None:
        if kind == "capture.step" and data["steps_done"] == 4:
            run.pause()
        if kind == "capture.state" and data["state"] == "paused":
            reported.append(data["error"])
            world.deaf_lights = len(reported) == 1
            if len(reported) == 3:
                run.resume()

    run._notify = notify
    assert run.run() == "completed"
    assert [text is not None for text in reported] == [False, True, False]
    assert reported[1] is not None
    assert reported[1].startswith("light bank")
    assert "lamps off. Remove the cause first: until then resuming fails the capture" in reported[1]
    assert run.error is None
    assert verify(tmp_path / "c") == []


def test_abort_keeps_what_is_finished_and_reopening_shoots_the_rest(rig_file, world, tmp_path):
    run = sequencer(rig_file, tmp_path / "c")
    run._notify = lambda kind, data: run.abort() if data.get("steps_done") == 5 else None
    assert run.run() == "aborted"
    assert is_dark(world)
    problems = verify(tmp_path / "c")
    assert problems[0] == "The capture's outcome is 'aborted', not 'completed'."
    assert len(Capture(tmp_path / "c").records) == 15
    pulses = len(Capture(tmp_path / "c").steps) - 5
    again = Sequencer(
        DeviceSet.of(rig_file),
        CaptureWriter.reopen(tmp_path / "c"),
        in_software(rig_file),
        permission=Permission.granted("a test"),
    )
    assert again.run() == "completed"
    assert world.pulses == pulses
    assert verify(tmp_path / "c") == []


def test_keyboard_interrupt_leaves_darkness_and_a_manifest(rig_file, world, tmp_path):
    run = sequencer(rig_file, tmp_path / "c")

    def notify(kind: str, data: dict[str, Any]) -> None:
        if data.get("steps_done") == 3:
            raise KeyboardInterrupt

    run._notify = notify
    with pytest.raises(KeyboardInterrupt):
        run.run()
    assert is_dark(world)
    assert Capture(tmp_path / "c").manifest["outcome"] == "failed"
