"""The cameras of one run: arm them, match each frame to its pulse, pass it on to the disk."""

from __future__ import annotations

import threading
from collections import Counter, defaultdict

from reconstruction import Step
from stage_service.acquisition.accounting import FrameAccount, PulseAccount
from stage_service.acquisition.exposing import Pulse
from stage_service.acquisition.frame_queue import FrameWriter, Shot
from stage_service.acquisition.hardware_run import Shots
from stage_service.acquisition.progress import RunProgress
from stage_service.acquisition.timings import Timings
from stage_service.devices.cameras.fan_out import FanOut
from stage_service.devices.cameras.interface import CameraDevice, Frame
from stage_service.devices.device_set import DeviceSet
from stage_service.devices.errors import DeviceError, DeviceTimeout, IndexShift


class FrameIntake:
    """Accounts for every camera's frames; raises `IndexShift` where they do not fit the pulses.

    `by_device` counts frames, missed and late ones by camera. `withdrawn` has the steps whose
    frames may belong to another step, by camera: they are to be taken back.
    """

    def __init__(
        self,
        devices: DeviceSet,
        progress: RunProgress,
        timings: Timings,
        cancel: threading.Event,
    ) -> None:
        self.by_device: defaultdict[str, Counter[str]] = defaultdict(Counter)
        for camera in devices.cameras:
            self.by_device[camera.name].update(frames=0, missed=0, late=0)
        self.withdrawn: dict[str, list[Step]] = {}
        self.pulses = PulseAccount(devices.trigger.name)
        self._devices, self._progress = devices, progress
        self._timings, self._cancel = timings, cancel
        self._accounts = {
            c.name: FrameAccount(c.name, c.capabilities.block_wrap) for c in devices.cameras
        }
        self._exposure: float | None = None
        self._doubtful = False  # a frame may still be on its way: arm anew before the next pulse
        # By camera: frames since its queue was last found empty.
        self._unchecked: dict[str, list[Step]] = {c.name: [] for c in devices.cameras}

    def arm(self, exposure: float, cameras: FanOut) -> None:
        """Arm every camera; all have confirmed on return. Frames still queued are checked first,
        because arming drops them."""
        with self._timings.on("arm"):
            if self._exposure is not None:
                cameras(self.drain)
            self._exposure = None
            cameras(lambda camera: camera.arm(exposure))
            for account in self._accounts.values():
                account.armed()
            self._exposure, self._doubtful = exposure, False

    def ready(self, exposure: float) -> bool:
        """Whether the cameras are armed for this exposure and none may have a late frame."""
        return self._exposure == exposure and not self._doubtful

    def read(self, cameras: FanOut) -> dict[str, Frame | None]:
        """Each camera's frame of the newest pulse; None where it has none."""
        with self._timings.on("cameras"):
            return cameras(self._read, lambda: self._progress.waiting(self._devices.busy))

    def _read(self, camera: CameraDevice) -> Frame | None:
        frame = camera.read(self._cancel)
        self._progress.responded(camera.name)
        return frame

    def account(self, camera: CameraDevice, frame: Frame | None, pulse: Pulse) -> None:
        """Check what `read` returned against the pulse."""
        account = self._accounts[camera.name]
        if frame is None:
            # It may still come, and must not pass for the next pulse's.
            self._doubtful = True
            account.missed()
        else:
            account.arrived(frame.block_id, frame.left)
            if camera.capabilities.timestamps and frame.timestamp:
                account.timed(frame.timestamp, pulse.requested, pulse.replied)

    def place(self, shots: Shots) -> dict[str, list[int] | None]:
        """By camera, the pulse of a hardware-stepped run of each frame; None if ambiguous."""
        return {
            name: self._accounts[name].place([f.block_id for f in frames], shots.progress.pulses)
            for name, frames in shots.frames.items()
        }

    def count_missing(self, cameras: set[str]) -> None:
        """Count frames that did not come."""
        for camera in cameras:
            self.by_device[camera]["missed"] += 1
            self._doubtful = True

    def count_fault(self, error: DeviceError) -> None:
        """Count a failure that ended the run, by camera where it is one's, else by device."""
        names = (name for name in self._accounts if f" {name} " in f" {error.device} ")
        counts = self.by_device[next(names, error.device)]
        counts["timeouts" if isinstance(error, DeviceTimeout) else "faults"] += 1

    def put(self, frames: FrameWriter, shot: Shot) -> None:
        """Pass a frame on to the disk; waits while too many are under way."""
        with self._timings.on("storage"):
            frames.put(shot)
        self._unchecked[shot.camera].append(shot.step)
        self.by_device[shot.camera]["frames"] += 1

    def drain(self, camera: CameraDevice) -> None:
        """Drop frames that came late for pulses counted as missed. Any other frame raises
        `IndexShift`, and the frames since the last check are withdrawn."""
        try:
            while (frame := camera.read(self._cancel)) is not None:
                self._accounts[camera.name].late(frame.block_id)
                self.by_device[camera.name]["late"] += 1
        except IndexShift:
            self.withdrawn[camera.name] = self._unchecked[camera.name]
            raise
        self._unchecked[camera.name] = []
