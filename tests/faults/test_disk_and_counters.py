"""A disk without room and block ids that begin again, in the middle of a capture."""

from __future__ import annotations

import shutil

import pytest

import simulators.world
import stage_service.devices.cameras.link
from reconstruction import CaptureWriter, verify
from stage_service.acquisition.sequencer import Sequencer
from stage_service.captures.manager import CaptureManager
from stage_service.devices.device_set import DeviceSet
from stage_service.devices.permission import Permission
from stage_service.plan.capture_plan import CapturePlan
from stage_service.plan.resolved import resolve

STEPPING = pytest.mark.parametrize("stepping", ["software", "hardware"])


@STEPPING
def test_wrapped_block_ids(stepping, simulated, small_rig, tmp_path, add_row, monkeypatch):
    """65535 frames take long: a camera that wraps at 21, and a driver that knows it."""
    monkeypatch.setattr(stage_service.devices.cameras.link, "BLOCK_WRAP", 21)
    monkeypatch.setattr(simulators.world, "BLOCK_IDS", 21)
    rig_file, world = simulated(
        rig=small_rig.replace("[devices.cameras]", "[devices.cameras]\nbuffers = 16")
    )
    plan = resolve(CapturePlan(stepping=stepping), rig_file)
    writer = CaptureWriter.create(tmp_path / "c", rig_file.rig, {"steps": plan.steps})
    run = Sequencer(DeviceSet.of(rig_file), writer, plan, permission=Permission.granted("a test"))
    assert run.run() == "completed", run.error
    assert verify(tmp_path / "c") == []
    assert world.pulses == len(plan.steps) > 2 * 21
    assert max(r.block_id for r in writer.records.values()) == 21
    add_row("camera: wrapped block ids", stepping, "completed", 0, None)


@STEPPING
def test_a_full_disk(stepping, simulated, tmp_path, add_row):
    rig_file, world = simulated()
    plan = resolve(CapturePlan(stepping=stepping), rig_file)
    writer = CaptureWriter.create(tmp_path / "c", rig_file.rig, {"steps": plan.steps})
    filled = []

    def notify(kind: str, data: dict[str, object]) -> None:
        if kind == "capture.step" and data["steps_done"] == 1:
            filled.append(writer.counts()[0])
            # As if another program had taken what was left.
            writer.reserve = 2 * shutil.disk_usage(tmp_path).total

    if stepping == "hardware":
        writer.reserve = 2 * shutil.disk_usage(tmp_path).total
    run = Sequencer(
        DeviceSet.of(rig_file), writer, plan, notify=notify, permission=Permission.granted("a test")
    )
    assert run.run() == "failed"
    assert "bytes are needed and a reserve" in str(run.error)
    assert not world.lamps.power().any()
    assert not world.projectors.show.level
    (outcome, never) = verify(tmp_path / "c")
    assert "outcome is 'failed'" in outcome
    assert "never captured" in never
    add_row("disk: no room left", stepping, "failed", 0, run.error)

    again = CaptureWriter.reopen(tmp_path / "c")
    run = Sequencer(DeviceSet.of(rig_file), again, plan, permission=Permission.granted("a test"))
    assert run.run() == "completed", run.error
    assert verify(tmp_path / "c") == []


def test_the_duty_is_counted_over_captures_that_the_box_clocks(simulated, small_rig, tmp_path):
    """0.05 s in each capture, and 0.12 s a minute: two captures, and no third."""
    safety = "[safety]\nmax_duty = 0.002\nduty_window_s = 60.0"
    rig_file, world = simulated(rig=small_rig.replace("[safety]", safety))
    plan = CapturePlan(
        lights=tuple(f"light_{i:03}" for i in range(8)),
        projectors=(),
        sentinels=False,
        exposure={"olat": 0.05},
        stepping="hardware",
    )
    manager = CaptureManager(rig_file, tmp_path / "root")
    manager.stage.darken()
    captures = [manager.wait(manager.start(plan), 30) for _ in range(3)]
    manager.close()
    assert [c.outcome for c in captures] == ["completed", "completed", "failed"]
    assert "max_duty in [safety]" in str(captures[-1].error)
    assert not world.lamps.power().any()


def test_the_duty_of_a_lamp_is_counted_over_several_captures(simulated, small_rig, tmp_path):
    """Each capture alone keeps to the limit."""
    safety = "[safety]\nmax_duty = 0.1\nduty_window_s = 2.0"
    rig_file, world = simulated(rig=small_rig.replace("[safety]", safety))
    plan = CapturePlan(
        lights=("light_003",), projectors=(), sentinels=False, exposure={"olat": 0.09}
    )
    manager = CaptureManager(rig_file, tmp_path / "root")
    manager.stage.darken()
    captures = []
    for _ in range(4):
        captures.append(manager.wait(manager.start(plan), 30))
        if captures[-1].outcome != "completed":
            break
    manager.close()
    assert captures[0].outcome == "completed"
    assert captures[-1].outcome == "failed"
    assert "max_duty in [safety]" in str(captures[-1].error)
    assert not world.lamps.power().any()
