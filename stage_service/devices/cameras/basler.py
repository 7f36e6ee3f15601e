"""A Basler camera through pylon."""

from __future__ import annotations

import warnings
from typing import Any

from reconstruction import Camera
from stage_service.device_config import GenicamConfig
from stage_service.devices.cameras.genicam import BLOCK_WRAP, BlockCounter, GenicamCamera, RawFrame
from stage_service.devices.cameras.genicam_nodes import Nodes, PylonNodes
from stage_service.devices.errors import DeviceTimeout, DeviceUnreachable


class BaslerCamera(GenicamCamera):
    """Implements the hooks of `GenicamCamera` on pylon."""

    sdk = "pylon"
    maker = "Basler"

    def __init__(self, config: GenicamConfig, geometry: Camera) -> None:
        super().__init__(config, geometry)
        self._pylon: Any = None
        self._genicam: Any = None
        self._ticks_per_s = 0.0

    def close(self) -> None:
        if self._camera is not None:
            self._camera.Close()
        self._camera = None
        self._exposure = None

    def _load(self) -> None:
        self._pylon, self._genicam = _pypylon(self.device)
        self._failures = self._genicam.GenericException

    def _serials(self) -> dict[str, Any]:
        factory = self._pylon.TlFactory.GetInstance()
        return {d.GetSerialNumber(): d for d in factory.EnumerateDevices()}

    def _connect(self, found: Any) -> None:
        factory = self._pylon.TlFactory.GetInstance()
        self._camera = self._pylon.InstantCamera(factory.CreateDevice(found))
        self._camera.Open()

    def _nodes(self) -> Nodes:
        return PylonNodes(self.device, self._camera.GetNodeMap(), self._genicam)

    def _prepare(self, nodes: Nodes) -> bool:
        self._camera.MaxNumBuffer.Value = self.config.buffers
        self._blocks = BlockCounter(*_block_ids(self._camera, nodes))
        self._ticks_per_s = _ticks_per_s(nodes)
        return self._ticks_per_s > 0

    def _kind(self, pixel_format: str) -> int:
        return int(getattr(self._pylon, f"PixelType_{pixel_format}"))

    def _start(self, doing: str) -> None:
        camera = self._camera
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

    def _stop(self) -> None:
        while self._camera.IsGrabbing() and (raw := self._retrieve(0.0)) is not None:
            self._blocks.take(raw.block_id)
        self._camera.StopGrabbing()

    def _retrieve(self, seconds: float) -> RawFrame | None:
        handling = self._pylon.TimeoutHandling_Return
        result = self._camera.RetrieveResult(round(seconds * 1e3), handling)
        if not result.IsValid():
            return None
        with result:
            if not result.GrabSucceeded():
                return RawFrame(result.GetBlockID())
            nodes = PylonNodes(self.device, result.GetChunkDataNodeMap(), self._genicam)
            exposure = nodes.number("ChunkExposureTime")
            return RawFrame(
                result.GetBlockID(),
                result.GetArray(),
                (result.GetWidth(), result.GetHeight()),
                result.GetPixelType(),
                result.GetTimeStamp() / self._ticks_per_s if self._ticks_per_s else 0.0,
                None if exposure is None else exposure * 1e-6,
                int(self._camera.NumReadyBuffers.Value),
            )

    def _removed(self) -> bool:
        return bool(self._camera.IsCameraDeviceRemoved())


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
