"""Whole captures over the wires that have less than Modbus TCP, from rig file to frames."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

import pytest
from pydantic import TypeAdapter

from reconstruction import Capture, CaptureWriter
from stage_service.acquisition.sequencer import Sequencer
from stage_service.device_config import LightBankConfig
from stage_service.devices.device_set import DeviceSet
from stage_service.devices.permission import Permission
from stage_service.plan.capture_plan import CapturePlan
from stage_service.plan.resolved import resolve

WIRE_PAGE = Path(__file__).resolve().parents[3] / "docs" / "reference" / "wire.md"
DMX = """[devices.lights]
kind = "dmx_enttec"
port = "lights"
accept_unverified_blackout = true
settle_s = 0.0"""
SACN = DMX.replace("dmx_enttec", "sacn").replace('port = "lights"', "channels = 60")
ART_NET = DMX.replace("dmx_enttec", "artnet").replace('port = "lights"', 'host = "node"')
COILS_ALONE = """[devices.lights.registers]
levels = "none"
selector = "none"
heartbeat = "none"
sequence = "none"
lit = "none"
signature = "none"
[devices.lights]
kind = "modbus_rtu"
port = "lights"
baud = 38400
accept_unverified_blackout = true"""


@pytest.mark.parametrize("wire", [DMX, SACN, ART_NET, COILS_ALONE])
def test_a_capture_over_a_bank_without_read_back(wire, simulated, small_rig, tmp_path):
    rig = small_rig.replace("[devices.lights]", wire) + "[capture.level]\nall_on = 1.0\n"
    rig_file, world = simulated(rig=rig)
    wanted = CapturePlan(lights=("light_003", "light_004"), stepping="software")
    plan = resolve(wanted, rig_file)
    writer = CaptureWriter.create(tmp_path / "c", rig_file.rig, {"steps": plan.steps})
    stage = DeviceSet.of(rig_file)
    run = Sequencer(stage, writer, plan, permission=Permission.granted("a test"))
    run.run()
    assert run.outcome == "completed", run.error
    assert not world.lamps.power().any()
    capture = Capture(tmp_path / "c")
    lit = {s.light: capture.frame(s, "cam_a").mean() for s in capture.steps if s.light}
    assert lit == pytest.approx({"light_003": 0.4, "light_004": 0.5}, abs=0.045)


def test_the_example_of_the_wire_page_is_read():
    examples = re.findall(r"```toml\n(.*?)```", WIRE_PAGE.read_text(), re.DOTALL)
    tables = [tomllib.loads(e)["devices"]["lights"] for e in examples if "devices.lights" in e]
    read = [TypeAdapter(LightBankConfig).validate_python(table) for table in tables]
    assert [(r.kind, r.unit, r.registers.sequence, r.registers.lit) for r in read] == [
        ("modbus_rtu", 1, None, 1)
    ]
