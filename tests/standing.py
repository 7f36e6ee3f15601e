"""A process that stands still at one place of a capture, to be killed there."""

from __future__ import annotations

import functools
import importlib
import sys
import threading
from collections.abc import Callable
from typing import Any

PLACES = [
    ("connecting", "after stage_service.devices.device_set:DeviceSet.connect", 1, "software"),
    ("arming", "after stage_service.acquisition.frame_intake:FrameIntake.arm", 1, "software"),
    ("a lamp lit", "after stage_service.acquisition.exposing:Exposing._light", 6, "software"),
    ("all lamps lit", "after stage_service.acquisition.exposing:Exposing._light", 2, "software"),
    (
        "a scanline shown",
        "after stage_service.acquisition.exposing:Exposing._light",
        15,
        "software",
    ),
    ("after a pulse", "stage_service.acquisition.exposing:Exposing._check_lamps", 5, "software"),
    ("reading frames", "stage_service.acquisition.frame_intake:FrameIntake.account", 9, "software"),
    ("storing a frame", "reconstruction.files.durable:_write", 9, "software"),
    ("after storing frames", "reconstruction.capture.writer:CaptureWriter.commit", 4, "software"),
    (
        "after the journal",
        "after reconstruction.capture.writer:CaptureWriter.commit",
        4,
        "software",
    ),
    ("before the manifest", "reconstruction.capture.writer:CaptureWriter.finish", 1, "software"),
    (
        "a table armed",
        "after stage_service.devices.trigger.serial_box:SerialTriggerBox.load_table",
        1,
        "hardware",
    ),
    (
        "a table running",
        "stage_service.acquisition.hardware_run:HardwareRun._collect",
        1,
        "hardware",
    ),
]
"""What a capture is about there, the function (with "after ", once it is carried out), which of its
calls, and who clocks."""


def stand_still(
    place: str, call: int, here: Callable[[], object], counts: Callable[[], bool] = lambda: True
) -> None:
    """Let the `call`-th call of a function, of those while `counts()`, say `here()` and stay."""
    after = place.startswith("after ")
    module, path = place.removeprefix("after ").split(":")
    owner: Any = importlib.import_module(module)
    *owners, name = path.split(".")
    for part in owners:
        owner = getattr(owner, part)
    function, calls = getattr(owner, name), iter(range(1, sys.maxsize))

    @functools.wraps(function)
    def instead(*args: Any, **more: Any) -> Any:
        is_it = counts() and next(calls) == call
        result = function(*args, **more) if after or not is_it else None
        if is_it:
            here()
            threading.Event().wait()
        return result

    setattr(owner, name, instead)
