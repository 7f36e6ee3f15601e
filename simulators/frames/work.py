"""The rendering of frames: what is under way, and how long the rest takes."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from statistics import median
from typing import Any, NamedTuple

from reconstruction import Camera, Rig
from reconstruction.arrays import Array
from simulators.frames.responses import Quality, Responder, Response


class Cost(NamedTuple):
    """Seconds on one core of the reference machine: of a call, of its pixels' paths, more for each
    of these and each light of the rig, and more for the first call in a process, which compiles."""

    call: float
    path: float
    light: float
    first: float


COSTS = {
    "lights": Cost(0.3, 3e-6, 4.5e-7, 3.0),
    "lights_together": Cost(0.3, 2e-6, 0.0, 1.0),
    "sweep": Cost(0.2, 6e-6, 0.0, 1.0),
}
"""The prediction until calls are measured."""
OVERDUE = 1.1
"""A call that takes longer than predicted is expected to take this multiple of its time so far."""


def predicted_seconds(what: str, camera: Camera, lights: int, quality: Quality) -> float:
    """Seconds of a call (a name of `COSTS`) for a camera of a rig with so many `lights`."""
    cost = COSTS[what]
    paths = {
        "lights": quality.lights,
        "lights_together": quality.together,
        "sweep": quality.sweep,
    }
    pixels = camera.width * camera.height
    return cost.call + pixels * paths[what] * (cost.path + cost.light * lights)


@dataclass
class _Lane:
    """Cameras whose calls follow each other, and the call under way: for `at`, since `began`."""

    cameras: Sequence[str]
    batch: tuple[str, int] = ("", 0)
    """What is rendered for each of the cameras, and at which pose."""
    ready: set[str] = field(default_factory=set)
    at: str | None = None
    began: float = 0.0
    compiled: set[str] = field(default_factory=set)


class MeasuredResponder:
    """A `Responder` that measures the calls of another, and predicts the rest.

    Camera number i belongs to lane i modulo `lanes`, as in `World`; a lane's calls follow each
    other in the rig's order. `poses` is their number in a sweep of all projectors.
    """

    def __init__(
        self,
        responder: Responder,
        rig: Rig,
        quality: Quality,
        lanes: int,
        poses: int,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._responder, self._poses, self._clock = responder, poses, clock
        self._names = [c.name for c in rig.cameras]
        self._lanes = [_Lane(self._names[i::lanes]) for i in range(min(lanes, len(self._names)))]
        self._lane = {name: lane for lane in self._lanes for name in lane.cameras}
        self._predicted = {
            (what, c.name): predicted_seconds(what, c, len(rig.lights), quality)
            for what in COSTS
            for c in rig.cameras
        }
        self._lock = threading.Lock()
        # measured / predicted seconds
        self._paces: dict[str, list[float]] = {what: [] for what in COSTS}

    def lights(self, camera: str) -> Response:
        """See `Responder.lights`."""
        with self._measured("lights", camera, 0):
            return self._responder.lights(camera)

    def lights_together(self, camera: str, pose: int, power: Array) -> Response:
        """See `Responder.lights_together`; `power (L,)`."""
        with self._measured("lights_together", camera, pose):
            return self._responder.lights_together(camera, pose, power)

    def sweep(self, camera: str, pose: int) -> Mapping[str, Response]:
        """See `Responder.sweep`."""
        with self._measured("sweep", camera, pose):
            return self._responder.sweep(camera, pose)

    def busy(self, camera: str) -> dict[str, Any]:
        """`doing`, `left_s` and `frame_s` of a frame of `camera` that is not ready, as in
        docs/reference/wire.md; empty while nothing is rendered for it."""
        with self._lock:
            lane = self._lane[camera]
            what, pose = lane.batch
            if lane.at is None or camera in lane.ready:
                return {}
            ready = sum(len(x.ready) for x in self._lanes if x.batch == lane.batch)
            doing = f"rendering camera {ready + 1} of {len(self._names)}"
            if what == "sweep":
                doing += f", pose {pose + 1} of {self._poses}"
            until = lane.cameras[: lane.cameras.index(camera) + 1]
            left = self._seconds(what, [c for c in until if c not in lane.ready])
            left -= self._clock() - lane.began
            later = {"all_on": "lights_together"}
            if self._poses > 1:  # each tracking frame begins one
                later["tracking"] = "sweep"
            frame_s = {
                kind: max(self._seconds(w, x.cameras) for x in self._lanes)
                for kind, w in later.items()
            }
            return {"doing": doing, "left_s": left, "frame_s": frame_s}

    def _seconds(self, what: str, cameras: Sequence[str]) -> float:
        """Expected seconds of one call each for cameras of a lane, one after the other."""
        return self._pace(what) * self._usual(what, cameras)

    def _usual(self, what: str, cameras: Sequence[str]) -> float:
        """The same on the reference machine."""
        first = any(what not in self._lane[c].compiled for c in cameras)
        return first * COSTS[what].first + sum(self._predicted[what, c] for c in cameras)

    def _pace(self, what: str) -> float:
        """Measured over predicted seconds of calls of this kind, or of all."""
        every = [pace for paces in self._paces.values() for pace in paces]
        measured = self._paces[what] or every or [1.0]
        now = self._clock()
        late = [
            OVERDUE * (now - lane.began) / self._usual(what, [lane.at])
            for lane in self._lanes
            if lane.at is not None and lane.batch[0] == what
        ]
        return max([median(measured), *late])

    @contextmanager
    def _measured(self, what: str, camera: str, pose: int) -> Iterator[None]:
        lane = self._lane[camera]
        with self._lock:
            if lane.batch != (what, pose):
                lane.batch, lane.ready = (what, pose), set()
            lane.at, lane.began = camera, self._clock()
        try:
            yield
        finally:
            with self._lock:
                pace = (self._clock() - lane.began) / self._usual(what, [camera])
                self._paces[what].append(pace)
                lane.compiled.add(what)
                lane.ready.add(camera)
                lane.at = None
