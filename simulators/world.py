"""The simulated stage: a trigger pulse turns the devices' commanded state into frames."""

from __future__ import annotations

import json
import threading
import time
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from reconstruction import Rig
from reconstruction.arrays import Array
from simulators.frames.frames import Snapshot
from simulators.peers.faults import Fault, Faults
from simulators.peers.lamps import Lamps
from simulators.peers.projector_controller import Show, SimulatedProjectorController

Counts = NDArray[np.uint16]
MakeCounts = Callable[[str, Snapshot, float], Counts]
BLOCK_IDS = 65535


@dataclass(frozen=True, eq=False)
class Exposed:
    """A frame in a camera's queue; `counts` may still be rendered."""

    block_id: int
    timestamp: float
    exposure: float
    counts: Future[Counts]


@dataclass
class _CameraState:
    exposure: float | None = None  # None: not armed
    block_id: int = 0
    queue: deque[Exposed] = field(default_factory=deque)
    late: list[Exposed] = field(default_factory=list)


class World:
    """The commanded state of the stage, and the resulting frames. Safe to call from any thread.

    The subject is at pose 0 until the sweep. A tracking exposure (all projectors on) after rows
    begins the next pose; a repeated one keeps it. Pose 0 returns when a new capture begins: at the
    first pulse after a reset if it is dark, or when a single lamp or a pattern of lamps is lit.

    `make` renders and exposes on one thread per lane; camera number i belongs to lane i modulo
    `lanes`. `log` gets one JSON line per pulse with its pose. `busy(camera)` has the further fields
    of the reply for a frame that is not ready.
    """

    def __init__(
        self,
        rig: Rig,
        lamps: Lamps,
        faults: Faults,
        make: MakeCounts,
        log: Path | None = None,
        lanes: int = 1,
        busy: Callable[[str], dict[str, Any]] = lambda _camera: {},
    ) -> None:
        self.rig, self.lamps, self.faults, self.busy = rig, lamps, faults, busy
        self._make, self._log = make, log
        self._pulses = self._fired = self._pose = 0
        self.projectors = SimulatedProjectorController(
            rig.projectors, partial(self.begun, "projectors", "blank")
        )
        lamps.cut_by(self.safety)
        self._lock = threading.RLock()
        self._rows_shown = False
        self._cameras = {c.name: _CameraState() for c in rig.cameras}
        self._lanes = [ThreadPoolExecutor(1, thread_name_prefix="frames") for _ in range(lanes)]
        self._began = time.monotonic()

    @property
    def pulses(self) -> int:
        """Pulses since reset."""
        return self._pulses

    def safety(self) -> tuple[bool, bool]:
        """Whether the interlock is open, and whether the emergency stop is pressed."""
        return self.begun("trigger", "interlock"), self.begun("trigger", "estop")

    def reset(self) -> None:
        """Set the pulse count to 0."""
        with self._lock:
            self._pulses = 0

    def pulse(self, fires: int = 1, counts: int = 1) -> int:
        """Fire all armed cameras in the present state; returns the pulse count.

        A faulty trigger fires twice, not at all, or does not count.
        """
        with self._lock:
            self._pulses += counts
            self._fired += 1
            if self.faults.at("lights", "stuck", self._pulses):
                self.lamps.stick()
            power, show = self.lamps.power(), self.projectors.show
            if fires:
                self._move_subject(power, show)
            shot = Snapshot(self._pulses, power, show, self._pose)
            for _ in range(fires):
                self._expose(shot)
            if self._log is not None:
                with self._log.open("a") as log:
                    log.write(json.dumps({"pulse": shot.pulse, "pose": shot.pose}) + "\n")
            return self._pulses

    def strikes(self, device: str, request: str) -> Fault | None:
        """The fault of a serial device's wire at this request; PULSE has the number of its
        pulse."""
        return self.faults.on_request(device, request, self._pulses + request.startswith("PULSE"))

    def hello(self, camera: str) -> None:
        """Reset the camera: not armed, no frames, frame number 0."""
        with self._lock:
            self._empty(camera)
            self._cameras[camera].exposure = None
            self._cameras[camera].block_id = 0

    def arm(self, camera: str, exposure: float | None) -> None:
        """Arm with an empty queue; None disarms and keeps the queue."""
        with self._lock:
            if exposure is not None:
                self._empty(camera)
            self._cameras[camera].exposure = exposure

    def oldest(self, camera: str) -> Exposed | None:
        """The oldest frame in the queue, rendered or not; it stays until `take`."""
        with self._lock:
            queue = self._cameras[camera].queue
            return queue[0] if queue else None

    def take(self, camera: str, frame: Exposed) -> None:
        """Remove `frame` if it is still the oldest."""
        with self._lock:
            queue = self._cameras[camera].queue
            if queue and queue[0] is frame:
                queue.popleft()

    def held(self, camera: str) -> int:
        """Number of frames in the camera's queue."""
        with self._lock:
            return len(self._cameras[camera].queue)

    def begun(self, device: str, kind: str, camera: str | None = None) -> bool:
        """Whether a lasting fault of the device is active."""
        return self.faults.since(device, kind, self._fired, camera)

    def stop(self) -> None:
        """Make no more frames."""
        with self._lock:
            for name in self._cameras:
                self._empty(name)
        for lane in self._lanes:
            lane.shutdown(wait=True, cancel_futures=True)

    def _expose(self, shot: Snapshot) -> None:
        for index, (name, camera) in enumerate(self._cameras.items()):
            if camera.exposure is None or self.faults.at("camera", "drop", shot.pulse, name):
                continue
            camera.queue.extend(camera.late)
            camera.late.clear()
            lane = self._lanes[index % len(self._lanes)]
            counts = lane.submit(self._make, name, shot, camera.exposure)
            kinds = ("repeat", "lost", "late_frame", "stray")
            fault = next((k for k in kinds if self.faults.at("camera", k, shot.pulse, name)), "")
            self._queue(camera, camera.exposure, counts, fault)

    def _move_subject(self, power: Array, show: Show) -> None:
        lit = int(np.count_nonzero(power))
        anew = lit == 1 or np.ptp(power) > 0 or (self._pulses == 1 and lit == 0 and show.level == 0)
        if anew:
            self._pose, self._rows_shown = 0, False
        elif show.everything:
            self._pose += self._rows_shown
            self._rows_shown = False
        elif show.level > 0:
            self._rows_shown = True

    def _queue(
        self, camera: _CameraState, exposure: float, counts: Future[Counts], fault: str
    ) -> None:
        for _ in range(2 if fault == "stray" else 1):
            if fault != "repeat":
                camera.block_id = camera.block_id % BLOCK_IDS + 1
            now = time.monotonic() - self._began
            frame = Exposed(camera.block_id, now, exposure, counts)
            if fault == "late_frame":
                camera.late.append(frame)
            elif fault != "lost":
                camera.queue.append(frame)

    def _empty(self, camera: str) -> None:
        held = self._cameras[camera]
        for frame in (*held.queue, *held.late):
            frame.counts.cancel()
        held.queue.clear()
        held.late.clear()
