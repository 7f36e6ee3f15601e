"""SIGKILL at each stage of a capture: the lamps go off, and another process goes on."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest
from simulating import small_subject
from standing import PLACES
from waiting import until

from reconstruction import Capture, CaptureWriter, verify
from simulators.peers.devices import DEVICES_FILE
from stage_service.acquisition.sequencer import Sequencer
from stage_service.config import load_rig_file
from stage_service.devices.device_set import DeviceSet
from stage_service.devices.permission import Permission
from stage_service.plan.capture_plan import CapturePlan
from stage_service.plan.resolved import resolve

CHECKOUT = Path(__file__).resolve().parents[2]
FAST = ("a lamp lit", "a scanline shown", "reading frames", "after the journal", "a table running")
KILLS = [pytest.param(*p, id=p[0], marks=() if p[0] in FAST else pytest.mark.slow) for p in PLACES]
PLAN = {"lights": [f"light_{i:03d}" for i in range(10)], "rows": {"last": 9}}


@pytest.mark.parametrize(("name", "place", "call", "stepping"), KILLS)
def test_sigkill_of_the_service(name, place, call, stepping, simulated, slack, tmp_path, add_row):
    rig_file, world = simulated()
    plan = CapturePlan(**PLAN, stepping=stepping)
    child = subprocess.Popen(
        [
            sys.executable,
            Path(__file__).with_name("shoot.py"),
            rig_file.path,
            rig_file.path.with_suffix("") / DEVICES_FILE,
            tmp_path / "c",
            plan.model_dump_json(),
            place,
            str(call),
        ],
        stdout=subprocess.PIPE,
        cwd=CHECKOUT,
        env={**os.environ, "PYTHONPATH": f"{CHECKOUT}:{CHECKOUT / 'tests'}"},
    )
    assert child.stdout is not None
    assert child.stdout.readline() == b"here\n"
    if name == "a table running":
        until(lambda: world.lamps.power().any())
    child.kill()
    child.wait()
    child.stdout.close()
    lit = bool(world.lamps.power().any() or world.projectors.show.level)
    killed = time.monotonic()
    dark = rig_file.devices.watchdog_s + 1.0 * slack
    until(lambda: not (world.lamps.power().any() or world.projectors.show.level), dark)
    seconds = time.monotonic() - killed
    kept = frames(tmp_path / "c")
    writer = CaptureWriter.reopen(tmp_path / "c")
    again = Sequencer(
        DeviceSet.of(rig_file),
        writer,
        resolve(plan, rig_file),
        permission=Permission.granted("a test"),
    )
    assert again.run() == "completed", again.error
    assert verify(tmp_path / "c") == []
    assert kept.items() <= frames(tmp_path / "c").items(), "a finished frame was shot again"
    add_row(
        f"SIGKILL of the service: {name}",
        stepping,
        "resumed and completed",
        0,
        f"(dark {seconds:.1f} s after the kill, by the watchdog)" if lit else "(was dark)",
    )


def test_sigkill_of_the_devices(simulated, tmp_path, add_row):
    """The whole simulated stage dies in mid-capture; the capture fails, and names a device."""
    rig_file, _world = simulated()
    rig = tmp_path / "rig.toml"
    rig.write_text(rig_file.path.read_text())
    state = tmp_path / "state"
    with (tmp_path / "log").open("w") as log:
        command = [sys.executable, "-m", "simulators", "--rig", rig, "--state", state]
        peers = subprocess.Popen(
            [*command, "--ports", "auto", "--spp", "1", *small_subject(tmp_path)],
            cwd=CHECKOUT,
            stdout=log,
            stderr=log,
        )
    try:
        until(lambda: (state / DEVICES_FILE).exists() or peers.poll() is not None)
        there = load_rig_file(rig, state / DEVICES_FILE)
        plan = resolve(CapturePlan(projectors=(), stepping="software"), there)
        writer = CaptureWriter.create(tmp_path / "c", there.rig, {"steps": plan.steps})

        def notify(kind: str, data: dict[str, Any]) -> None:
            if kind == "capture.step" and data["steps_done"] == 6:
                peers.kill()
                peers.wait()

        run = Sequencer(
            DeviceSet.of(there),
            writer,
            plan,
            notify=notify,
            permission=Permission.granted("a test"),
        )
        assert run.run() == "failed"
    finally:
        peers.kill()
        peers.wait()
    assert run.error is not None
    assert "unknown, unsafe" in run.error  # nobody is there to say that the lamps are off
    assert len(frames(tmp_path / "c")) >= 2 * 5
    add_row("SIGKILL of the simulated stage", "software", str(run.outcome), 0, run.error)


def frames(path: Path) -> dict[tuple[int, str], str]:
    """Checksums of the frames that the journal names; each is readable."""
    capture = Capture(path)
    found = {}
    for step in capture.steps:
        for camera in ("cam_a", "cam_b"):
            if capture.has(step, camera):
                assert capture.frame(step, camera).shape == (12, 16, 3)
                found[step.index, camera] = str(capture.records[step.index, camera].sha256)
    return found
