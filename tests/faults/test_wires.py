"""Scripted faults on every wire of the simulated stage, in the middle of a capture."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Any

import pytest
from waiting import until

from reconstruction import Capture, CaptureWriter, verify
from simulators.peers.faults import Fault
from stage_service.acquisition.sequencer import Sequencer
from stage_service.devices.device_set import DeviceSet
from stage_service.devices.permission import Permission
from stage_service.plan.capture_plan import CapturePlan
from stage_service.plan.resolved import resolve

PULSE = 9
LIGHTS = tuple(f"light_{i:03d}" for i in range(12))
DEVICE_ERROR = r".+: .+: expected .+, received .+\. .+"
"""Device: operation: expected …[ within … s], received …. What to do."""


@dataclass(frozen=True)
class Case:
    """A fault and what must become of the capture: `error` is a pattern, "" for none.

    Times are those of an idle machine; {timeout} in `error` is the rig file's.
    """

    name: str
    faults: tuple[Fault, ...]
    outcome: str
    error: str = ""
    missing: int = 0
    stepping: tuple[str, ...] = ("software", "hardware")
    links: tuple[str, ...] = ("Modbus TCP",)
    dark: bool = True


def case(name: str, device: str, kind: str, outcome: str, error: str = "", **more: Any) -> Case:
    own = {k: more.pop(k) for k in ("camera", "request", "seconds", "pulse") if k in more}
    fault = Fault(device, kind, own.pop("pulse", PULSE), **own)
    return Case(name, (fault,), outcome, error, **more)


SOFTWARE, HARDWARE = {"stepping": ("software",)}, {"stepping": ("hardware",)}
IN_TIME = "within {timeout} s"
CASES = [
    case("trigger box: timeout", "trigger", "silent", "failed", f"trigger box.*{IN_TIME}",
         **SOFTWARE),
    case("trigger box: timeout of a table's question", "trigger", "silent", "failed",
         f"trigger box.*{IN_TIME}", request="SEQ?", pulse=1, **HARDWARE),
    case("trigger box: NAK", "trigger", "nak", "failed", "trigger box.*ERR", **SOFTWARE),
    case("trigger box: NAK of a table", "trigger", "nak", "failed", "trigger box.*ERR",
         request="ROW", pulse=0, **HARDWARE),
    case("trigger box: late reply", "trigger", "late", "failed", f"trigger box.*{IN_TIME}",
         seconds=0.5, **SOFTWARE),
    case("trigger box: garbage in a reply", "trigger", "garbage", "failed", "trigger box",
         **SOFTWARE),
    case("trigger box: garbage before a reply", "trigger", "noise", "failed", "trigger box",
         **SOFTWARE),
    case("trigger box: unplugged and plugged in again", "trigger", "unplug", "failed",
         "trigger box", seconds=0.5, **SOFTWARE),
    case("trigger box: unplugged while a table runs", "trigger", "unplug", "failed",
         "trigger box", request="SEQ?", pulse=1, seconds=0.5, **HARDWARE),
    case("trigger: doubled", "trigger", "double", "failed", "matching frames|pulses"),
    case("trigger: dropped by the box", "trigger", "dropped", "completed"),
    case("trigger: fired but not counted", "trigger", "uncounted", "failed", "pulse"),
    case("trigger: late", "trigger", "late_trigger", "failed", f"trigger box.*{IN_TIME}",
         seconds=0.5, **SOFTWARE),
    case("trigger: late in a table", "trigger", "late_trigger", "completed", seconds=0.1,
         **HARDWARE),
    case("interlock opened", "trigger", "interlock", "failed", "interlock"),
    case("emergency stop pressed", "trigger", "estop", "failed", "emergency stop|estop"),
    case("projectors: timeout", "projectors", "silent", "failed", f"projector.*{IN_TIME}",
         pulse=16, **SOFTWARE),
    case("projectors: NAK", "projectors", "nak", "failed", "projector", pulse=16, **SOFTWARE),
    case("projectors: late reply", "projectors", "late", "failed", "projector", pulse=16,
         seconds=0.5, **SOFTWARE),
    case("projectors: garbage in a reply", "projectors", "garbage", "failed", "projector",
         pulse=16, **SOFTWARE),
    case("projectors: unplugged and plugged in again", "projectors", "unplug", "failed",
         "projector", pulse=16, seconds=0.5, **SOFTWARE),
    case("projectors: no pattern comes up", "projectors", "blank", "failed", "no-pattern",
         pulse=16, **HARDWARE),
    case("camera: dropped trigger", "camera", "drop", "completed", camera="cam_b"),
    case("camera: frame lost on the way", "camera", "lost", "completed", camera="cam_b"),
    case("camera: repeated block id", "camera", "repeat", "failed", "cam_b.*block id",
         camera="cam_b"),
    case("camera: a frame nobody asked for", "camera", "stray", "failed", "cam_b",
         camera="cam_b"),
    case("camera: late frame", "camera", "late_frame", "completed", camera="cam_b", **SOFTWARE),
    case("camera: mute", "camera", "mute", "failed", f"camera cam_b.*{IN_TIME}",
         camera="cam_b"),
    Case("camera: a trigger that never comes",
         tuple(Fault("camera", "drop", p, camera="cam_b") for p in (PULSE, PULSE + 1, PULSE + 2)),
         "completed", missing=1, **SOFTWARE),
]  # fmt: skip
BOTH = ("Modbus TCP", "Modbus RTU")
SELECT = {"request": "6 1000", "links": BOTH, **SOFTWARE}
CASES += [
    case("light bank: hangs", "lights", "hang", "failed", f"light bank.*{IN_TIME}", links=BOTH),
    case("light bank: timeout", "lights", "silent", "failed", f"light bank.*{IN_TIME}", **SELECT),
    case("light bank: exception reply", "lights", "nak", "failed", "light bank.*exception",
         **SELECT),
    case("light bank: garbage in a reply", "lights", "garbage", "failed", "light bank", **SELECT),
    case("light bank: late reply", "lights", "late", "failed", f"light bank.*{IN_TIME}",
         seconds=0.45, **SELECT),
    case("light bank: wrong echo", "lights", "echo", "failed", "light bank.*reply", **SELECT),
    case("light bank: CRC error", "lights", "crc", "failed", "light bank",
         **{**SELECT, "links": ("Modbus RTU",)}),
    case("light bank: unplugged and plugged in again", "lights", "unplug", "failed", "light bank",
         seconds=0.4, **SELECT),
    case("light bank: reports no lamp lit", "lights", "lies", "failed", "light bank.*0 lit",
         links=BOTH, **SOFTWARE),
    case("light bank: a lamp cannot be put off", "lights", "stuck", "failed", "unknown, unsafe",
         links=BOTH, dark=False, **SOFTWARE),
]  # fmt: skip
RTU = '[devices.lights]\nkind = "modbus_rtu"\nport = "lights"'


def marks(one: Case, link: str) -> list[pytest.MarkDecorator]:
    """The contracts of light banks have each fault of the second wire as well."""
    return [] if link == one.links[0] else [pytest.mark.slow]


@pytest.mark.parametrize(
    ("one", "stepping", "link"),
    [
        pytest.param(c, s, k, id=f"{c.name}, {s}, {k}", marks=marks(c, k))
        for c in CASES
        for s in c.stepping
        for k in c.links
    ],
)
def test_a_fault_on_the_wire(one, stepping, link, simulated, small_rig, slack, tmp_path, add_row):
    rig = small_rig if link == "Modbus TCP" else small_rig.replace("[devices.lights]", RTU)
    rig_file, world = simulated(*one.faults, rig=rig)
    plan = resolve(CapturePlan(lights=LIGHTS, stepping=stepping), rig_file)
    writer = CaptureWriter.create(tmp_path / "c", rig_file.rig, {"steps": plan.steps})
    run = Sequencer(DeviceSet.of(rig_file), writer, plan, permission=Permission.granted("a test"))
    run.run()
    assert run.outcome == one.outcome, run.error
    if one.dark:
        dark = rig_file.devices.watchdog_s + 1.0 * slack
        until(lambda: not (world.lamps.power().any() or world.projectors.show.level), dark)
    capture = Capture(tmp_path / "c")
    check_frames(capture)
    for problem in verify(tmp_path / "c"):
        assert re.search(r"outcome is|never captured|^Step \d+ .* is missing", problem), problem
    missing = sum(r.file is None for r in capture.records.values())
    assert missing == one.missing
    if one.error:
        expected = one.error.format(timeout=f"{rig_file.devices.trigger.timeout_s:g}")
        assert re.search(expected, str(run.error), re.S), run.error
        assert re.search(DEVICE_ERROR, str(run.error), re.S)
    else:
        assert run.error is None
        assert len(capture.records) == len(plan.steps) * 2
    name = one.name if len(one.links) == 1 else f"{one.name} ({link})"
    add_row(name, stepping, run.outcome, missing, run.error)


def check_frames(capture: Capture) -> None:
    """Every frame there is shows what its step lit."""
    pose = -1
    for step in capture.steps:
        pose += step.kind == "tracking"
        level = {"dark": 0.0}.get(step.kind)
        if step.light is not None:
            level = 0.1 * (int(step.light[-3:]) + 1)
        elif step.row is not None:
            level = 0.2 * (step.row + 1) + pose
        for camera in ("cam_a", "cam_b"):
            if level is not None and capture.has(step, camera):
                brightness = capture.frame(step, camera).mean()
                assert brightness == pytest.approx(level, abs=0.045), (step, camera)
