"""A capture in a process of its own that stands still at one place, to be killed there.

`python shoot.py RIG DEVICES CAPTURE PLAN MODULE:NAME CALL`: the CALL-th call of that function
prints "here" and does not return; with "after " before the name it is carried out first.
"""

from __future__ import annotations

import functools
import importlib
import sys
import threading
from pathlib import Path
from typing import Any

from reconstruction import CaptureWriter
from stage_service.acquisition.sequencer import Sequencer
from stage_service.config import load_rig_file
from stage_service.devices.device_set import DeviceSet
from stage_service.plan.capture_plan import CapturePlan
from stage_service.plan.resolved import resolve


def stand_still(place: str, call: int) -> None:
    after = place.startswith("after ")
    module, path = place.removeprefix("after ").split(":")
    owner: Any = importlib.import_module(module)
    *owners, name = path.split(".")
    for part in owners:
        owner = getattr(owner, part)
    function, calls = getattr(owner, name), iter(range(1, sys.maxsize))

    @functools.wraps(function)
    def instead(*args: Any, **more: Any) -> Any:
        here = next(calls) == call
        result = function(*args, **more) if after or not here else None
        if here:
            print("here", flush=True)
            threading.Event().wait()
        return result

    setattr(owner, name, instead)


rig, devices, capture, plan, place, call = sys.argv[1:]
stand_still(place, int(call))
rig_file = load_rig_file(rig, devices)
wanted = resolve(CapturePlan.model_validate_json(plan), rig_file)
if (Path(capture) / "plan.json").exists():
    writer = CaptureWriter.reopen(capture)
else:
    writer = CaptureWriter.create(capture, rig_file.rig, {"steps": wanted.steps})
Sequencer(DeviceSet.of(rig_file), writer, wanted).run()
