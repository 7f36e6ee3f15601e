"""Cameras that the service releases itself, under lamps on real wires: see tests/dslrs.py."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from dslrs import Body, FakeGphoto2, jpeg
from waiting import until

from reconstruction import Capture, CaptureWriter, verify
from stage_service.acquisition.sequencer import Sequencer
from stage_service.config import RigFile
from stage_service.device_config import Gphoto2Config
from stage_service.devices.cameras import gphoto2
from stage_service.devices.device_set import DeviceSet
from stage_service.devices.permission import Permission
from stage_service.plan.capture_plan import CapturePlan
from stage_service.plan.resolved import PlanError, ResolvedPlan, resolve

LIGHTS = ("light_003", "light_000", "light_150")
CODES = {0: 20, 700: 80, 4: 120, 1: 160, 151: 220}  # of the photographs by the lamps' signal
GAIN = 50000.0
RELEASE_S = 0.06
Rig = tuple[RigFile, list[Body]]


@pytest.fixture
def dslrs(rig_file: RigFile, world: Any, monkeypatch: pytest.MonkeyPatch, slack: int) -> Rig:
    """The tiny rig with three DSLRs of the stand-in library, whose photographs show the lamps."""

    def picture() -> bytes:
        return jpeg(CODES[world.signal()], (8, 6))

    bodies = [
        Body(str(i), f"usb:001,00{i}", lag_s=0.03, picture=picture, torn=jpeg(255, (8, 6)))
        for i in range(3)
    ]
    monkeypatch.setitem(sys.modules, "gphoto2", FakeGphoto2(*bodies))
    monkeypatch.setattr(gphoto2, "_SERIALS", {})
    table = {"kind": "gphoto2", "gain": GAIN, "jpeg": True, "release_s": RELEASE_S * slack}
    serials = {f"cam_{i}": str(i) for i in range(3)}
    config = Gphoto2Config.model_validate({**table, "serials": serials, "frame_s": 2.0})
    assert rig_file.devices is not None
    devices = rig_file.devices.model_copy(update={"cameras": config})
    return replace(rig_file, devices=devices), bodies


def planned(rig_file: RigFile, **plan: Any) -> ResolvedPlan:
    return resolve(CapturePlan(**{"lights": LIGHTS, "projectors": (), **plan}), rig_file)


def run(rig_file: RigFile, writer: CaptureWriter, plan: ResolvedPlan) -> Sequencer:
    permission = Permission.granted("a test")
    return Sequencer(DeviceSet.of(rig_file), writer, plan, permission=permission)


@pytest.fixture
def lit(world: Any) -> list[float]:
    """How long lamps were lit each time, in seconds."""
    spans: list[float] = []
    light: Callable[[set[int]], None] = world.light

    def timed(lamps: set[int]) -> None:
        if world.lit and not lamps:
            spans.append(time.monotonic() - world.since)
        elif lamps and not world.lit:
            world.since = time.monotonic()
        light(lamps)

    world.light = timed
    return spans


def test_every_photograph_shows_its_light_and_lamps_go_off_as_planned(
    dslrs, world, lit, tmp_path, slack
):
    rig_file, _ = dslrs
    plan = planned(rig_file)
    writer = CaptureWriter.create(tmp_path / "c", rig_file.rig, {"steps": plan.steps})
    assert run(rig_file, writer, plan).run() == "completed"
    assert verify(tmp_path / "c") == []
    capture = Capture(tmp_path / "c")
    signals = {"dark": 0, "all_on": 700}
    for step in capture.steps:
        code = CODES[signals.get(step.kind, int((step.light or "_-01")[-3:]) + 1)]
        light = ((code / 255 + 0.055) / 1.055) ** 2.4  # IEC 61966-2-1
        for camera in rig_file.rig.cameras:
            expected = light * (65535 - 4096) / (GAIN * step.exposure)
            np.testing.assert_allclose(capture.frame(step, camera.name), expected, rtol=0.01)
    steps = [s for s in plan.steps if s.kind != "dark"]
    assert len(lit) == len(steps)
    release_s = RELEASE_S * slack
    for step, seconds in zip(steps, lit, strict=True):
        assert release_s + step.exposure <= seconds < release_s + step.exposure + 0.1 * slack
    lamps = {"olat": 1, "all_on": 200}
    lamp_seconds = sum(lamps[s.kind] * s.level * (s.exposure + release_s) for s in steps)
    assert plan.cost.lamp_seconds == pytest.approx(lamp_seconds, rel=0.05)
    assert plan.cost.seconds > len(plan.steps) * (1.0 + release_s)  # readout_s is 1 s
    assert "not set in the rig file" in plan.stepping_why


def test_lamps_go_off_as_planned_though_a_release_takes_longer(dslrs, lit, tmp_path, slack):
    rig_file, bodies = dslrs
    bodies[1].lag_s, bodies[1].blocks = 0.5 * slack, True
    plan = planned(rig_file, sentinels=False)
    writer = CaptureWriter.create(tmp_path / "c", rig_file.rig, {"steps": plan.steps})
    capturing = run(rig_file, writer, plan)
    assert capturing.run() == "failed"
    assert "cam_1" in (capturing.error or "")
    assert "raise release_s" in (capturing.error or "")
    (seconds,) = lit
    assert seconds < 0.3 * slack


def test_a_busy_camera_is_shot_again(dslrs, tmp_path):
    rig_file, bodies = dslrs
    plan = planned(rig_file)
    writer = CaptureWriter.create(tmp_path / "c", rig_file.rig, {"steps": plan.steps})
    capturing = run(rig_file, writer, plan)
    taken = bodies[2].picture

    def picture_then_busy() -> bytes:
        if bodies[2].shots == 2 and not bodies[2].opened[2:]:
            bodies[2].busy = 3
        return taken()

    bodies[2].picture = picture_then_busy
    assert capturing.run() == "completed"
    assert capturing.by_device["cam_2"]["missed"] >= 1
    assert verify(tmp_path / "c") == []
    assert all(record.file is not None for record in writer.records.values())


def test_frames_before_a_cable_came_off_are_kept_and_the_rest_is_shot_later(dslrs, tmp_path):
    rig_file, bodies = dslrs
    plan = planned(rig_file)
    writer = CaptureWriter.create(tmp_path / "c", rig_file.rig, {"steps": plan.steps})
    taken = bodies[0].picture

    def unplugged_at_the_third() -> bytes:
        if bodies[0].shots == 2:
            bodies[0].faults = {"unplugged"}
        return taken()

    bodies[0].picture = unplugged_at_the_third
    capturing = run(rig_file, writer, plan)
    assert capturing.run() == "failed"
    assert "camera cam_0" in (capturing.error or "")
    assert "unplugged" in (capturing.error or "")
    kept = {key for key, record in writer.records.items() if record.file is not None}
    assert {(step, camera) for step, camera in kept if step < 2} >= {(0, "cam_0"), (1, "cam_0")}
    bodies[0].faults, bodies[0].picture, bodies[0].port = set(), taken, "usb:001,009"
    again = CaptureWriter.reopen(tmp_path / "c")
    assert run(rig_file, again, plan).run() == "completed"
    assert len([r for r in again.records.values() if r.file]) == 3 * len(plan.steps)
    assert verify(tmp_path / "c") == []


def test_the_trigger_box_cannot_clock_them(dslrs, tmp_path):
    rig_file, _ = dslrs
    with pytest.raises(PlanError, match="stepping"):
        planned(rig_file, stepping="hardware")


def test_an_abort_does_not_wait_for_a_camera_that_hangs(dslrs, world, tmp_path, slack):
    rig_file, bodies = dslrs
    bodies[1].lag_s, bodies[1].blocks = 2.0 * slack, True
    cameras = rig_file.devices.cameras.model_copy(update={"timeout_s": 0.1})
    rig_file = replace(rig_file, devices=rig_file.devices.model_copy(update={"cameras": cameras}))
    plan = planned(rig_file, sentinels=False)
    writer = CaptureWriter.create(tmp_path / "c", rig_file.rig, {"steps": plan.steps})
    capturing = run(rig_file, writer, plan)
    ended = threading.Thread(target=capturing.run)
    ended.start()
    until(lambda: bodies[1].releases)
    began = time.monotonic()
    capturing.stop_now()
    ended.join()
    assert time.monotonic() - began < 1.5 * slack
    assert capturing.outcome == "aborted"
    assert not world.lit
