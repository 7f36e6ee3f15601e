"""Runs that the trigger box clocks, on the simulators' devices: every frame in its place."""

from __future__ import annotations

import re
import threading
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pjlink_projector import PjLinkServer, SimulatedProjector

from reconstruction import Capture, CaptureWriter, verify
from simulators.peers.faults import Fault
from stage_service.acquisition.safety import blackout
from stage_service.acquisition.sequencer import Sequencer
from stage_service.acquisition.states import CannotPause
from stage_service.devices.device_set import DeviceSet
from stage_service.devices.permission import Permission
from stage_service.plan.capture_plan import CapturePlan
from stage_service.plan.resolved import resolve


def sequencer(rig_file: Any, path: Path, heard: list[Any], **plan: Any) -> Sequencer:
    wanted = resolve(CapturePlan(**plan), rig_file)
    writer = CaptureWriter.create(path, rig_file.rig, {"steps": wanted.steps})
    assert "hardware" in {r.stepping for r in wanted.runs}
    return Sequencer(
        DeviceSet.of(rig_file),
        writer,
        wanted,
        notify=lambda *event: heard.append(event),
        permission=Permission.granted("a test"),
    )


def expected(step: Any, pose: int) -> float | None:
    """What `Flat` answers to a step; None for all lamps together, which saturate."""
    if step.kind == "dark":
        return 0.0
    if step.kind == "olat":
        return 0.1 * (int(step.light[-3:]) + 1)
    if step.kind == "scanline":
        return 0.2 * (step.row + 1) + pose
    return None


def check_frames(path: Path, cameras: tuple[str, ...] = ("cam_a", "cam_b")) -> Capture:
    capture, pose = Capture(path), -1
    for step in capture.steps:
        pose += step.kind == "tracking"
        level = expected(step, pose)
        for camera in cameras:
            if level is not None and capture.has(step, camera):
                brightness = capture.frame(step, camera).mean()
                assert brightness == pytest.approx(level, abs=0.045), (step, camera)
    return capture


def is_dark(world: Any) -> bool:
    return not world.lamps.power().any() and world.projectors.show.level == 0


def test_a_whole_capture_clocked_by_the_box(simulated, tmp_path):
    rig_file, world = simulated()
    heard: list[Any] = []
    run = sequencer(rig_file, tmp_path / "c", heard)
    assert run.run() == "completed", run.error
    assert verify(tmp_path / "c") == []
    capture = check_frames(tmp_path / "c")
    assert [r.pulse for (_, c), r in sorted(capture.records.items()) if c == "cam_a"] == [
        *range(1, len(capture.steps) + 1)
    ]
    assert not [e for e in heard if e[0] == "capture.frame_missing"]
    assert is_dark(world)
    manifest = capture.manifest
    assert manifest["seconds_by_cause"]["hardware run"] > 0
    assert manifest["sentinels_unclear"] == {}


def test_a_run_with_a_dropped_frame_is_shot_again(simulated, tmp_path):
    rig_file, _world = simulated(Fault("camera", "drop", 7, "cam_b"))
    heard: list[Any] = []
    lights = tuple(f"light_{i:03d}" for i in range(8))
    run = sequencer(rig_file, tmp_path / "c", heard, projectors=(), lights=lights)
    assert run.run() == "completed"
    capture = check_frames(tmp_path / "c")
    again = {k for k, r in capture.records.items() if r.pulse > len(capture.steps)}
    # An over-trigger leaves no gap in the numbers, so no frame of this camera's run is used.
    assert (6, "cam_b") in again
    assert {camera for _, camera in again} == {"cam_b"}
    missing = [d["cameras"] for k, d in heard if k == "capture.frame_missing"]
    assert missing == [["cam_b"]] * len(again)


@pytest.mark.parametrize(
    ("fault", "text"),
    [
        (Fault("trigger", "double", 9), "at most|counting pulses|frames"),
        (Fault("trigger", "estop", 9), "estop"),
        (Fault("trigger", "interlock", 9), "interlock"),
    ],
)
def test_trouble_in_a_run_ends_it_dark_and_named(simulated, tmp_path, fault, text):
    rig_file, world = simulated(fault)
    run = sequencer(rig_file, tmp_path / "c", [], projectors=())
    assert run.run() == "failed"
    assert re.search(text, str(run.error))
    assert is_dark(world)
    capture = check_frames(tmp_path / "c")
    if fault.kind in ("estop", "interlock"):
        done = {s for (s, _), r in capture.records.items() if r.file}
        assert done == set(range(8))  # the ninth pulse was cut short


def test_pause_is_refused_and_abort_stops_the_box_at_once(simulated, tmp_path):
    rig_file, world = simulated()
    run = sequencer(rig_file, tmp_path / "c", [], rate_hz=20.0, exposure={"olat": 0.01})
    thread = threading.Thread(target=run.run)
    thread.start()
    while not (world.lamps.power().any() and run._clocked):
        assert thread.is_alive()
    with pytest.raises(CannotPause, match="clocks a run of 24 steps"):
        run.pause()
    run.abort()
    thread.join(10)
    assert (run.state, run.outcome) == ("done", "aborted")
    assert is_dark(world)
    check_frames(tmp_path / "c")
    assert np.count_nonzero([r.file is not None for r in Capture(tmp_path / "c").records.values()])


def test_a_sweep_needs_projectors_that_are_on(simulated, small_rig, tmp_path):
    now = [0.0]
    lamp = SimulatedProjector(warm_up_s=60.0, clock=lambda: now[0])
    server = PjLinkServer(lamp, "secret")
    server.start()
    (tmp_path / "password").write_text("secret\n")
    link = f'[devices.pjlink.left]\nhost = "127.0.0.1"\nport = {server.port}\n'
    rig_file, world = simulated(rig=small_rig + link + 'password_file = "password"\n')
    try:
        (tmp_path / "password").rename(tmp_path / "elsewhere")
        world.lamps.select(3)
        stage = DeviceSet.of(rig_file)
        assert blackout(stage).safe  # whatever becomes of a password
        assert is_dark(world)
        power = stage.status(connect=True)["projector_power"]["left"]
        stage.close()
        assert "No such file" in power["error"]
        assert "correct password_file" in power["error"]
        (tmp_path / "elsewhere").rename(tmp_path / "password")
        run = sequencer(rig_file, tmp_path / "c", [])
        assert run.run() == "failed"
        assert "left (PJLink" in str(run.error)
        assert "expected power on, received standby" in str(run.error)
        assert world.pulses == 0
        (projector,) = DeviceSet.of(rig_file).powers
        projector.switch(True)
        now[0] = 61.0
        stage = DeviceSet.of(rig_file)
        power = stage.status(connect=True)["projector_power"]["left"]
        stage.close()
        assert (power["state"], power["power"]) == ("ok", "ON")
        assert sequencer(rig_file, tmp_path / "d", []).run() == "completed"
    finally:
        server.stop()


def test_brackets_are_clocked_one_exposure_at_a_time(simulated, tmp_path):
    rig_file, _ = simulated()
    plan = CapturePlan(brackets=(1.0, 0.25), projectors=())
    runs = resolve(plan, rig_file).runs
    assert [(len(r.steps), r.stepping) for r in runs] == [
        (26, "hardware"),  # dark, all on, the lights
        (24, "hardware"),
        (2, "software"),
    ]
    run = sequencer(rig_file, tmp_path / "c", [], brackets=(1.0, 0.25), projectors=())
    assert run.run() == "completed", run.error
    check_frames(tmp_path / "c")
    response, saturated = Capture(tmp_path / "c").light("light_011", "cam_a")
    assert response.mean() == pytest.approx(1.2, abs=0.03)
    assert not saturated.any()


@pytest.mark.parametrize("end", ["abort", "estop"])
def test_a_run_that_is_cut_short_keeps_no_frame_of_a_lamp_that_lagged_behind(
    simulated, tmp_path, end
):
    """The fourth flash's edges do not reach the bank: from then on it lights the lamp before."""
    fault = (Fault("trigger", "estop", 9),) if end == "estop" else ()
    rig_file, world = simulated(*fault)
    run = sequencer(rig_file, tmp_path / "c", [], projectors=(), rate_hz=25.0)
    gate, opened = world.lamps.gate, [0]

    def lossy(is_open: bool) -> None:
        opened[0] += is_open
        if opened[0] != 4:
            gate(is_open)
        if end == "abort" and opened[0] == 9 and not is_open:
            run.abort()

    world.lamps.gate = lossy
    assert run.run() == "failed"
    cause = "estop" if end == "estop" else "counting the steps of a hardware-stepped run"
    assert cause in str(run.error)
    assert is_dark(world)
    assert not [r for r in check_frames(tmp_path / "c").records.values() if r.file]


LAMPS_BY_THE_SERVICE = {
    "DMX": 'kind = "dmx_enttec"\nport = "lights"\naccept_unverified_blackout = true',
    "no table": 'registers = { table = "none" }',
}


@pytest.mark.parametrize("bank", LAMPS_BY_THE_SERVICE)
def test_lamps_without_a_sequence_table_are_lit_by_the_service(
    bank, simulated, small_rig, tmp_path
):
    table = f"[devices.lights]\n{LAMPS_BY_THE_SERVICE[bank]}"
    rig_file, _world = simulated(rig=small_rig.replace("[devices.lights]", table))
    lights = tuple(f"light_{i:03d}" for i in range(9))
    plan = CapturePlan(lights=lights, level={"all_on": 1.0})
    cost = resolve(plan, rig_file).cost
    assert cost.stepping == {"software": 12, "hardware": 20}
    assert "the light bank has no sequence table" in cost.stepping_why
    run = sequencer(rig_file, tmp_path / "c", [], lights=lights, level={"all_on": 1.0})
    assert run.run() == "completed", run.error
    check_frames(tmp_path / "c")


def test_a_table_without_read_back_is_stepped_by_its_position(simulated, small_rig, tmp_path):
    table = 'accept_unverified_blackout = true\nregisters = { lit = "none" }'
    rig = small_rig.replace("[devices.lights]", f"[devices.lights]\n{table}")
    rig_file, _world = simulated(rig=rig)
    run = sequencer(rig_file, tmp_path / "c", [], projectors=())
    assert run.run() == "completed", run.error
    check_frames(tmp_path / "c")
