"""A Basler camera through pylon, triggered by wire; see `docs/reference/wire.md`.

A camera's features are read from its node map, never derived from the model's name.
"""

from __future__ import annotations

import threading
import time
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

from reconstruction import Camera
from stage_service.device_config import BaslerConfig
from stage_service.devices.cameras import pixel_formats
from stage_service.devices.cameras.genicam_nodes import Nodes
from stage_service.devices.cameras.interface import Busy, CameraCapabilities, CameraInfo, Frame
from stage_service.devices.errors import Cancelled, DeviceError, DeviceTimeout, DeviceUnreachable

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


class BaslerCamera:
    """Implements `CameraDevice` on pylon; see there for the contract.

    `capabilities.timestamps` is known after `connect`.
    """

    def __init__(self, config: BaslerConfig, geometry: Camera) -> None:
        self.name = geometry.name
        self.serial = config.serials.get(geometry.name)
        self.device = f"camera {geometry.name} (Basler {self.serial})"
        self.config = config
        self.geometry = geometry
        self.capabilities = CameraCapabilities(config.buffers, False, BLOCK_WRAP)
        self.busy: Busy | None = None
        self._info: CameraInfo | None = None
        self._pylon: Any = None
        self._genicam: Any = None
        self._camera: Any = None
        self._blocks = BlockCounter(1, BLOCK_WRAP)
        self._ticks_per_s = 0.0
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
        self._pylon, self._genicam = _pypylon(self.device)
        with self._as_device_error("connecting"):
            factory = self._pylon.TlFactory.GetInstance()
            there = {d.GetSerialNumber(): d for d in factory.EnumerateDevices()}
            if self.serial not in there:
                expected = f"a camera with serial number {self.serial}"
                received = ", ".join(sorted(there)) or "no camera at all"
                todo = "Check power, cable and serials in [devices.cameras]."
                raise DeviceUnreachable(self.device, "connecting", expected, received, todo)
            self._camera = self._pylon.InstantCamera(factory.CreateDevice(there[self.serial]))
            self._camera.Open()
        try:
            self._set_up()
        except DeviceError:
            self.close()
            raise

    def close(self) -> None:
        if self._camera is not None:
            self._camera.Close()
        self._camera = None
        self._exposure = None

    def arm(self, exposure: float) -> None:
        """Expose at the next pulses for `exposure` seconds; returns once the camera waits for them.

        Unread frames are dropped, but counted in the block ids once they reached the queue.
        """
        doing = f"arming for {exposure:g} s"
        with self._as_device_error(doing):
            camera = self._open(doing)
            self._stop(camera)
            nodes = self._nodes()
            name = next(n for n in EXPOSURES if nodes.has(n))
            nodes.write(name, exposure * 1e6)
            actual = (nodes.number(name) or 0.0) * 1e-6
            self._check_exposure(actual, exposure, doing)
            camera.StartGrabbing(self._pylon.GrabStrategy_OneByOne)
            self._blocks.restart()
            # Pulses before the camera waits for them are ignored, and leave no gap in its ids.
            ready = not camera.CanWaitForFrameTriggerReady() or camera.WaitForFrameTriggerReady(
                round(self.config.timeout_s * 1e3), self._pylon.TimeoutHandling_Return
            )
        if not ready:
            expected = "the camera waiting for a trigger"
            received = "a camera that is busy"
            todo = "Check that nothing else triggers it, or raise timeout_s."
            raise DeviceTimeout(self.device, doing, expected, received, todo, self.config.timeout_s)
        self._exposure = actual

    def disarm(self) -> None:
        """Ignore pulses from now on; unread frames are dropped."""
        with self._as_device_error("disarming"):
            self._stop(self._open("disarming"))

    def read(self, cancel: threading.Event) -> Frame | None:
        """The oldest unread frame; None where none came within its exposure and `frame_s`, or it
        was damaged on its way."""
        doing = "reading a frame"
        with self._as_device_error(doing):
            camera = self._open(doing)
            if self._exposure is None:
                return None
            deadline = time.monotonic() + self._exposure + self.config.frame_s
            while True:
                left = deadline - time.monotonic()
                result = self._retrieve(camera, min(max(left, 0.0), SLICE_S))
                if result.IsValid():
                    with result:
                        frame = self._frame(result, self._exposure, doing)
                    left = int(camera.NumReadyBuffers.Value)
                    return None if frame is None else replace(frame, left=left)
                if camera.IsCameraDeviceRemoved():
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
            camera, nodes, config = self._open(doing), self._nodes(), self.config
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
            camera.MaxNumBuffer.Value = config.buffers
            self._blocks = BlockCounter(*_block_ids(camera, nodes))
            self._ticks_per_s = _ticks_per_s(nodes)
            size = (nodes.number("Width"), nodes.number("Height"))
        expected = (self.geometry.width, self.geometry.height)
        if size != expected:
            wanted = f"{expected[0]}x{expected[1]} pixels as in the rig file"
            todo = "Set OffsetX, OffsetY, Width and Height in [devices.cameras.features], or "
            todo += "calibrate the rig for this size."
            raise self._error(doing, wanted, f"{size[0]}x{size[1]}", todo)
        self.capabilities = replace(self.capabilities, timestamps=self._ticks_per_s > 0)
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

    def _stop(self, camera: Any) -> None:
        self._exposure = None
        while camera.IsGrabbing() and (result := self._retrieve(camera, 0.0)).IsValid():
            with result:
                self._blocks.take(result.GetBlockID())
        camera.StopGrabbing()

    def _retrieve(self, camera: Any, seconds: float) -> Any:
        milliseconds = round(seconds * 1e3)
        return camera.RetrieveResult(milliseconds, self._pylon.TimeoutHandling_Return)

    def _frame(self, result: Any, exposure: float, doing: str) -> Frame | None:
        block_id = self._blocks.take(result.GetBlockID())
        if not result.GrabSucceeded():
            return None
        if block_id is None:
            received = f"{result.GetBlockID()}"
            todo = "The camera does not number its frames, so losses could not be detected."
            raise self._error(doing, f"a block id from {self._blocks.first}", received, todo)
        info, pixel_format = self.info, self.config.pixel_format
        kind = getattr(self._pylon, f"PixelType_{pixel_format}")
        size = (result.GetWidth(), result.GetHeight())
        if (*size, result.GetPixelType()) != (info.width, info.height, kind):
            expected = f"{info.width}x{info.height} pixels, type {kind:#x} ({pixel_format})"
            received = f"{size[0]}x{size[1]}, type {result.GetPixelType():#x}"
            todo = "Another program changed the camera's settings: close it and start again."
            raise self._error(doing, expected, received, todo)
        chunks = Nodes(self.device, result.GetChunkDataNodeMap(), self._genicam)
        if (actual := chunks.number("ChunkExposureTime")) is not None:
            self._check_exposure(actual * 1e-6, exposure, doing)
        ticks = result.GetTimeStamp()
        timestamp = ticks / self._ticks_per_s if self._ticks_per_s else 0.0
        counts = pixel_formats.rgb(result.GetArray(), pixel_format)
        return Frame(counts, block_id, timestamp, exposure)

    def _check_exposure(self, actual: float, requested: float, doing: str) -> None:
        if abs(actual - requested) > EXPOSURE_TOLERANCE * requested:
            todo = "The camera cannot make this exposure: choose one that it offers."
            raise self._error(doing, f"an exposure of {requested:g} s", f"{actual:g} s", todo)

    def _nodes(self) -> Nodes:
        return Nodes(self.device, self._camera.GetNodeMap(), self._genicam)

    def _open(self, doing: str) -> Any:
        if self._camera is None:
            todo = "Connect again; what the camera held is lost."
            raise DeviceUnreachable(self.device, doing, "an open camera", "a closed one", todo)
        return self._camera

    @contextmanager
    def _as_device_error(self, doing: str) -> Iterator[None]:
        """Turn pylon's exceptions into `DeviceError`."""
        try:
            yield
        except self._generic_exception() as error:
            if self._camera is not None and self._camera.IsCameraDeviceRemoved():
                raise self._gone(doing) from error
            todo = "Check power and cable, and that no other program holds the camera."
            raise self._error(doing, "pylon to carry it out", str(error), todo) from error

    def _generic_exception(self) -> type[Exception] | tuple[()]:
        return () if self._genicam is None else self._genicam.GenericException

    def _gone(self, doing: str) -> DeviceUnreachable:
        self.close()
        received = "a camera that was unplugged or lost power"
        todo = "Check power and cable, and start again."
        return DeviceUnreachable(self.device, doing, "the camera", received, todo)

    def _error(self, doing: str, expected: str, received: str, todo: str) -> DeviceError:
        return DeviceError(self.device, doing, expected, received, todo)


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

    def take(self, block_id: int) -> int | None:
        """The frame's number, the same for a repeated id; None for a value that is no id."""
        if not self.first <= block_id <= self.last:
            return None
        self.count += (block_id - self._before) % (self.last - self.first + 1)
        self._before = block_id
        return self.count


def _pypylon(device: str) -> tuple[Any, Any]:
    """The modules `pylon` and `genicam`, loaded when the first camera is connected."""
    try:
        with warnings.catch_warnings():
            # Its generated types warn on import.
            warnings.simplefilter("ignore")
            from pypylon import genicam, pylon
    except ImportError as error:
        expected = "the library pypylon"
        todo = "Install it: pip install 'hairstage[basler]'."
        raise DeviceUnreachable(device, "connecting", expected, str(error), todo) from error
    return pylon, genicam


def _block_ids(camera: Any, nodes: Nodes) -> tuple[int, int]:
    """First and last block id: GigE Vision counts from 1, in 16 bits unless extended."""
    if not camera.IsGigE():
        return 0, BLOCK_WRAP
    extended = {nodes.text(f"{by}GevGVSPExtendedIDMode") for by in ("", "Bsl")}
    return 1, BLOCK_WRAP if "On" in extended else 65535


def _ticks_per_s(nodes: Nodes) -> float:
    """The rate of the camera's clock; nanoseconds by SFNC 2, 0 for a camera without one."""
    frequency = nodes.number("GevTimestampTickFrequency")
    if frequency is None:
        return 1e9 if nodes.has("TimestampLatch") else 0.0
    return float(frequency)
