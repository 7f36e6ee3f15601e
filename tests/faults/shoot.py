"""A capture in a process of its own that stands still at one place, to be killed there.

`python shoot.py RIG DEVICES CAPTURE PLAN MODULE:NAME CALL`: the CALL-th call of that function
prints "here" and does not return; with "after " before the name it is carried out first.
"""

from __future__ import annotations

import sys
from pathlib import Path

from standing import stand_still

from reconstruction import CaptureWriter
from stage_service.acquisition.sequencer import Sequencer
from stage_service.config import load_rig_file
from stage_service.devices.device_set import DeviceSet
from stage_service.devices.permission import Permission
from stage_service.plan.capture_plan import CapturePlan
from stage_service.plan.resolved import resolve

rig, devices, capture, plan, place, call = sys.argv[1:]
stand_still(place, int(call), lambda: print("here", flush=True))
rig_file = load_rig_file(rig, devices)
wanted = resolve(CapturePlan.model_validate_json(plan), rig_file)
if (Path(capture) / "plan.json").exists():
    writer = CaptureWriter.reopen(capture)
else:
    writer = CaptureWriter.create(capture, rig_file.rig, {"steps": wanted.steps})
Sequencer(DeviceSet.of(rig_file), writer, wanted, permission=Permission.granted("a test")).run()
