"""GenICam cameras triggered by wire, whatever library reaches them; see `docs/reference/wire.md`.

A camera's features are read from its node map, never derived from the model's name.
"""

from __future__ import annotations

import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from reconstruction import Camera
from stage_service.device_config import GenicamConfig
from stage_service.devices.cameras import pixel_formats
from stage_service.devices.cameras.genicam_nodes import Nodes
from stage_service.devices.cameras.interface import Busy, CameraCapabilities, CameraInfo, Frame
from stage_service.devices.errors import Cancelled, DeviceError, DeviceUnreachable

SLICE_S = 0.05
"""Seconds between two checks of `cancel` while waiting for a frame."""
BLOCK_WRAP = (1 << 63) - 1
"""Block ids are unwrapped here."""
EXPOSURE_TOLERANCE = 0.01
"""Largest relative error of an exposure; cameras round to their line time."""
EXPOSURES = ("ExposureTime", "ExposureTimeAbs")
"""Microseconds; the second on cameras older than SFNC 2."""
QUIET: tuple[tuple[str, str | float | bool], ...] = (
    ("AcquisitionMode", "Continuous"),
    ("AcquisitionFrameRateEnable", False),
    ("ExposureAuto", "Off"),
    ("ExposureMode", "Timed"),
    ("GainAuto", "Off"),
    ("BalanceWhiteAuto", "Off"),
    ("Gamma", 1.0),
)
"""Settings that would pace the camera or bend its response; not every model has all of them."""
OURS = {
    *(name for name, _ in QUIET),
    *EXPOSURES,
    *("PixelFormat", "ChunkModeActive", "ChunkSelector", "ChunkEnable"),
    *("TriggerSelector", "TriggerMode", "TriggerSource", "TriggerActivation", "TriggerOverlap"),
    *("TriggerDelay", "TriggerDelayAbs", "LineSelector", "LineMode"),
}
"""Nodes that the driver sets; `features` may not."""


@dataclass(frozen=True, eq=False)
class RawFrame:
    """A frame as a library gives it; `image` is None where it was damaged on its way, `exposure` in
    seconds where the frame has it."""

    block_id: int
    image: NDArray[np.unsignedinteger] | None = None
    size: tuple[int, int] = (0, 0)
    kind: int = 0
    timestamp: float = 0.0
    exposure: float | None = None
    left: int = 0


class GenicamCamera(ABC):
    """Implements `CameraDevice`; see there for the contract. `capabilities.timestamps` is known
    after `connect`; `sdk` and `maker` are names in errors.
    """

    sdk: str
    maker: str

    def __init__(self, config: GenicamConfig, geometry: Camera) -> None:
        self.name = geometry.name
        self.serial = config.serials.get(geometry.name)
        self.device = f"camera {geometry.name} ({self.maker} {self.serial})"
        self.config = config
        self.geometry = geometry
        self.capabilities = CameraCapabilities(config.buffers, False, BLOCK_WRAP)
        self.busy: Busy | None = None
        self._info: CameraInfo | None = None
        self._camera: Any = None
        self._failures: type[Exception] | tuple[()] = ()
        self._blocks = BlockCounter(1, BLOCK_WRAP)
        self._exposure: float | None = None

    @property
    def info(self) -> CameraInfo:
        """Size from the camera, `gain` and `black` from the rig file."""
        if self._info is None:
            raise RuntimeError(f"{self.device}: not connected")
        return self._info

    def connect(self) -> None:
        """Find the camera by its serial number and set it up for triggers on its line.

        Raises `DeviceError` where it lacks a setting or has another size than the rig file's.
        """
        self.close()
        self._load()
        with self._as_device_error("connecting"):
            there = self._serials()
            if self.serial not in there:
                expected = f"a camera with serial number {self.serial}"
                received = ", ".join(sorted(there)) or "no camera at all"
                todo = "Check power, cable and serials in [devices.cameras]."
                raise DeviceUnreachable(self.device, "connecting", expected, received, todo)
            self._connect(there[self.serial])
        try:
            self._set_up()
        except DeviceError:
            self.close()
            raise

    @abstractmethod
    def close(self) -> None: ...

    def arm(self, exposure: float) -> None:
        """Expose at the next pulses for `exposure` seconds; returns once the camera waits for them.

        Unread frames are dropped, but counted in the block ids once they reached the queue.
        """
        doing = f"arming for {exposure:g} s"
        with self._as_device_error(doing):
            self._open(doing)
            self._end()
            nodes = self._nodes()
            name = next((n for n in EXPOSURES if nodes.has(n)), EXPOSURES[0])
            nodes.write(name, exposure * 1e6)
            actual = (nodes.number(name) or 0.0) * 1e-6
            self._check_exposure(actual, exposure, doing)
            self._start(doing)
        self._exposure = actual

    def release(self) -> None:  # noqa: B027
        """Nothing: the trigger box fires it."""

    def disarm(self) -> None:
        """Ignore pulses from now on; unread frames are dropped."""
        with self._as_device_error("disarming"):
            self._open("disarming")
            self._end()

    def read(self, cancel: threading.Event) -> Frame | None:
        """The oldest unread frame; None where none came within its exposure and `frame_s`, or it
        was damaged on its way."""
        doing = "reading a frame"
        with self._as_device_error(doing):
            self._open(doing)
            if self._exposure is None:
                return None
            deadline = time.monotonic() + self._exposure + self.config.frame_s
            while True:
                left = deadline - time.monotonic()
                raw = self._retrieve(min(max(left, 0.0), SLICE_S))
                if raw is not None:
                    return self._frame(raw, self._exposure, doing)
                if self._removed():
                    raise self._gone(doing)
                if left <= 0:
                    return None
                if cancel.is_set():
                    raise Cancelled(f"{self.device}: {doing} was given up")

    def _set_up(self) -> None:
        doing = "setting up"
        if ours := sorted(OURS & self.config.features.keys()):
            received = ", ".join(ours)
            todo = "Remove them from [devices.cameras.features]."
            raise self._error(doing, "features that the driver does not set itself", received, todo)
        with self._as_device_error(doing):
            self._open(doing)
            nodes, config = self._nodes(), self.config
            nodes.write_if_there("UserSetSelector", "Default")
            nodes.execute_if_there("UserSetLoad")
            nodes.write("PixelFormat", config.pixel_format)
            for name, value in config.features.items():
                nodes.write(name, value)
            for name, value in QUIET:
                nodes.write_if_there(name, value)
            self._set_trigger(nodes)
            timed = "ExposureTime" in nodes.symbols("ChunkSelector")
            nodes.write_if_there("ChunkModeActive", timed)
            if timed:
                nodes.write("ChunkSelector", "ExposureTime")
                nodes.write("ChunkEnable", True)
            timestamps = self._prepare(nodes)
            size = (nodes.number("Width"), nodes.number("Height"))
        expected = (self.geometry.width, self.geometry.height)
        if size != expected:
            wanted = f"{expected[0]}x{expected[1]} pixels as in the rig file"
            todo = "Set OffsetX, OffsetY, Width and Height in [devices.cameras.features], or "
            todo += "calibrate the rig for this size."
            raise self._error(doing, wanted, f"{size[0]}x{size[1]}", todo)
        self.capabilities = replace(self.capabilities, timestamps=timestamps)
        full_scale = pixel_formats.full_scale(config.pixel_format)
        self._info = CameraInfo(*expected, full_scale, config.black, config.gain)

    def _set_trigger(self, nodes: Nodes) -> None:
        line = self.config.trigger_line
        for selector in nodes.symbols("TriggerSelector"):
            nodes.write("TriggerSelector", selector)
            nodes.write_if_there("TriggerMode", "Off")
        nodes.write_if_there("LineSelector", line)
        nodes.write_if_there("LineMode", "Input")
        nodes.write("TriggerSelector", "FrameStart")
        nodes.write("TriggerSource", line)
        nodes.write("TriggerActivation", "RisingEdge")
        nodes.write_if_there("TriggerDelay", 0.0)
        nodes.write_if_there("TriggerDelayAbs", 0.0)
        nodes.write_if_there("TriggerOverlap", "ReadOut")
        nodes.write("TriggerMode", "On")

    def _check_exposure(self, actual: float, requested: float, doing: str) -> None:
        if abs(actual - requested) > EXPOSURE_TOLERANCE * requested:
            todo = "The camera cannot make this exposure: choose one that it offers."
            raise self._error(doing, f"an exposure of {requested:g} s", f"{actual:g} s", todo)

    def _end(self) -> None:
        """Stop exposing; unread frames are dropped."""
        self._exposure = None
        self._stop()

    def _frame(self, raw: RawFrame, exposure: float, doing: str) -> Frame | None:
        block_id = self._blocks.take(raw.block_id)
        if raw.image is None:
            return None
        if block_id is None:
            todo = "The camera does not number its frames, so losses could not be detected."
            expected, received = f"a block id from {self._blocks.first}", f"{raw.block_id}"
            raise self._error(doing, expected, received, todo)
        info, pixel_format = self.info, self.config.pixel_format
        kind = self._kind(pixel_format)
        if (*raw.size, raw.kind) != (info.width, info.height, kind):
            expected = f"{info.width}x{info.height} pixels, type {kind:#x} ({pixel_format})"
            received = f"{raw.size[0]}x{raw.size[1]}, type {raw.kind:#x}"
            todo = "Another program changed the camera's settings: close it and start again."
            raise self._error(doing, expected, received, todo)
        if raw.exposure is not None:
            self._check_exposure(raw.exposure, exposure, doing)
        counts = pixel_formats.rgb(raw.image, pixel_format)
        return Frame(counts, block_id, raw.timestamp, exposure, raw.left)

    def _open(self, doing: str) -> Any:
        if self._camera is None:
            todo = "Connect again; what the camera held is lost."
            raise DeviceUnreachable(self.device, doing, "an open camera", "a closed one", todo)
        return self._camera

    @contextmanager
    def _as_device_error(self, doing: str) -> Iterator[None]:
        """Turn the library's exceptions into `DeviceError`."""
        try:
            yield
        except self._failures as error:
            if self._camera is not None and self._removed():
                raise self._gone(doing) from error
            todo = "Check power and cable, and that no other program holds the camera."
            expected = f"success of {self.sdk}"
            raise self._error(doing, expected, str(error), todo) from error

    def _gone(self, doing: str) -> DeviceUnreachable:
        self.close()
        received = "a camera that was unplugged or lost power"
        todo = "Check power and cable, and start again."
        return DeviceUnreachable(self.device, doing, "the camera", received, todo)

    def _error(self, doing: str, expected: str, received: str, todo: str) -> DeviceError:
        return DeviceError(self.device, doing, expected, received, todo)

    @abstractmethod
    def _load(self) -> None:
        """Import the library and set `_failures` to its exceptions; raises `DeviceUnreachable` with
        what to install."""

    @abstractmethod
    def _serials(self) -> dict[str, Any]:
        """What `_connect` takes of each camera that is there, by serial number."""

    @abstractmethod
    def _connect(self, found: Any) -> None:
        """Open the camera as `_camera`."""

    @abstractmethod
    def _nodes(self) -> Nodes:
        """The camera's node map."""

    @abstractmethod
    def _prepare(self, nodes: Nodes) -> bool:
        """Make buffers and the block counter; returns whether frames have time stamps."""

    @abstractmethod
    def _kind(self, pixel_format: str) -> int:
        """The number of a pixel format."""

    @abstractmethod
    def _start(self, doing: str) -> None:
        """Wait for pulses from now on, with `_blocks` restarted."""

    @abstractmethod
    def _stop(self) -> None:
        """Stop, and count unread frames in `_blocks`."""

    @abstractmethod
    def _retrieve(self, seconds: float) -> RawFrame | None:
        """The oldest frame that comes within so long."""

    @abstractmethod
    def _removed(self) -> bool:
        """Whether the camera has been unplugged."""


class BlockCounter:
    """Counts frames from 1 by their block ids, across wraps and restarts.

    Ids run from `first` to `last`, then begin again at `first`, as after every `restart`. A gap of
    a whole round is not detected.
    """

    def __init__(self, first: int, last: int) -> None:
        self.first, self.last = first, last
        self.count = 0
        self._before = first - 1

    def restart(self) -> None:
        """The next frame's id is `first`."""
        self._before = self.first - 1

    def begin_after(self, block_id: int) -> None:
        """The next frame's id follows `block_id`."""
        self._before = block_id

    def take(self, block_id: int) -> int | None:
        """The frame's number, the same for a repeated id; None for a value that is no id."""
        if not self.first <= block_id <= self.last:
            return None
        self.count += (block_id - self._before) % (self.last - self.first + 1)
        self._before = block_id
        return self.count
