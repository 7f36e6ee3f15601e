"""A GigE Vision or USB3 Vision camera of any maker, through Aravis (its GObject introspection).

Some cameras restart the ids of their frames with each acquisition, others do not: `connect` takes
a frame in each of two acquisitions by software trigger, which also shows that frames arrive.
"""

from __future__ import annotations

import re
import threading
from typing import Any

import numpy as np

from reconstruction import Camera
from stage_service.device_config import GenicamConfig
from stage_service.devices.cameras import pixel_formats
from stage_service.devices.cameras.genicam import BLOCK_WRAP, BlockCounter, GenicamCamera, RawFrame
from stage_service.devices.cameras.genicam_nodes import Nodes
from stage_service.devices.errors import DeviceTimeout, DeviceUnreachable

_LISTING = threading.Lock()
"""The list of cameras belongs to the library, and cameras connect side by side."""


class AravisCamera(GenicamCamera):
    """Implements the hooks of `GenicamCamera` on Aravis."""

    sdk = "Aravis"
    maker = "GenICam"

    def __init__(self, config: GenicamConfig, geometry: Camera) -> None:
        super().__init__(config, geometry)
        self._aravis: Any = None
        self._stream: Any = None
        self._lost = threading.Event()
        self._restarts = True

    def close(self) -> None:
        self._camera = self._stream = None  # freed, they end the connection
        self._exposure = None

    def _load(self) -> None:
        try:
            import gi

            gi.require_version("Aravis", "0.8")
            from gi.repository import Aravis, GLib
        except (ImportError, ValueError) as error:
            todo = "Install it: apt install gir1.2-aravis-0.8, pip install 'hairstage[aravis]'."
            expected = "the library Aravis 0.8"
            raise DeviceUnreachable(
                self.device, "connecting", expected, str(error), todo
            ) from error
        self._aravis, self._failures = Aravis, GLib.Error

    def _serials(self) -> dict[str, Any]:
        aravis = self._aravis
        with _LISTING:
            aravis.update_device_list()
            found = range(aravis.get_n_devices())
            return {aravis.get_device_serial_nbr(i): aravis.get_device_id(i) for i in found}

    def _connect(self, found: Any) -> None:
        self._camera = self._aravis.Camera.new(found)
        self._lost = lost = threading.Event()
        self._camera.get_device().connect("control-lost", lambda *_: lost.set())

    def _nodes(self) -> Nodes:
        return _AravisNodes(self.device, self._camera.get_device(), self._aravis)

    def _prepare(self, nodes: Nodes) -> bool:
        camera = self._camera
        extended = {nodes.text(f"{by}GevGVSPExtendedIDMode") for by in ("", "Bsl")}
        first = 1 if camera.is_gv_device() else 0
        last = 65535 if first and "On" not in extended else BLOCK_WRAP
        self._stream = camera.create_stream(None, None)
        for _ in range(self.config.buffers):
            self._stream.push_buffer(self._aravis.Buffer.new_allocate(camera.get_payload()))
        nodes.write("TriggerSource", "Software")
        ids, stamped = zip(*(self._probe(nodes) for _ in range(2)), strict=True)
        nodes.write("TriggerSource", self.config.trigger_line)
        self._restarts = ids[0] == ids[1] == first
        self._blocks = BlockCounter(first, last)
        if not self._restarts:
            self._blocks.begin_after(ids[1])
        return all(stamped)

    def _probe(self, nodes: Nodes) -> tuple[int, bool]:
        """The id of a frame by software trigger, and whether it has a time stamp."""
        self._camera.start_acquisition()
        nodes.execute_if_there("TriggerSoftware")
        raw = self._retrieve(self.config.timeout_s)
        self._camera.stop_acquisition()
        if raw is None:
            todo = "Check that no firewall drops its frames, or raise timeout_s."
            doing, expected, limit = "connecting", "a frame", self.config.timeout_s
            raise DeviceTimeout(self.device, doing, expected, "nothing", todo, limit)
        return raw.block_id, raw.timestamp > 0

    def _kind(self, pixel_format: str) -> int:
        parts = re.findall("Mono|Bayer|[A-Z]{2}|[0-9]+", pixel_format)
        return int(getattr(self._aravis, f"PIXEL_FORMAT_{'_'.join(parts).upper()}"))

    def _start(self, doing: str) -> None:
        if self._restarts:
            self._blocks.restart()
        self._camera.start_acquisition()

    def _stop(self) -> None:
        self._camera.stop_acquisition()
        while (raw := self._retrieve(0.0)) is not None:
            self._blocks.take(raw.block_id)

    def _retrieve(self, seconds: float) -> RawFrame | None:
        buffer = self._stream.timeout_pop_buffer(round(seconds * 1e6))
        if buffer is None:
            return None
        try:
            if buffer.get_status() != self._aravis.BufferStatus.SUCCESS:
                return RawFrame(buffer.get_frame_id())
            size = buffer.get_image_width(), buffer.get_image_height()
            deep = pixel_formats.full_scale(self.config.pixel_format) > 255
            image = np.frombuffer(buffer.get_data(), "<u2" if deep else "u1")
            fits = image.size >= size[0] * size[1]
            return RawFrame(
                buffer.get_frame_id(),
                image[: size[0] * size[1]].reshape(size[::-1]) if fits else None,
                size,
                buffer.get_image_pixel_format(),
                buffer.get_timestamp() * 1e-9,
                left=self._stream.get_n_buffers().n_output_buffers,
            )
        finally:
            self._stream.push_buffer(buffer)

    def _removed(self) -> bool:
        return self._lost.is_set()


class _AravisNodes(Nodes):
    """The node map of an Aravis device."""

    def __init__(self, device: str, nodes: Any, aravis: Any) -> None:
        from gi.repository import GLib

        super().__init__(device, GLib.Error)
        self._nodes = nodes
        self._aravis = aravis

    def has(self, name: str) -> bool:
        return bool(self._nodes.is_feature_available(name))

    def symbols(self, name: str) -> tuple[str, ...]:
        if not self.has(name):
            return ()
        return tuple(self._nodes.dup_available_enumeration_feature_values_as_strings(name))

    def number(self, name: str) -> float | None:
        held = self.text(name)
        return None if held is None else float(held)

    def text(self, name: str) -> str | None:
        if not self.has(name):
            return None
        node = self._nodes.get_feature(name)
        if isinstance(node, self._aravis.GcBoolean):
            return str(int(node.get_value()))
        return str(node.get_value_as_string())

    def execute_if_there(self, name: str) -> None:
        if self.has(name):
            self._nodes.get_feature(name).execute()

    def _is_writable(self, name: str) -> bool:
        modes = self._aravis.GcAccessMode
        return self.has(name) and self._nodes.get_feature_access_mode(name) != modes.RO

    def _set(self, name: str, wanted: str) -> None:
        node = self._nodes.get_feature(name)
        if isinstance(node, self._aravis.GcBoolean):
            node.set_value(wanted in ("1", "true"))
        else:
            node.set_value_from_string(wanted)

    def _range(self, name: str) -> str:
        node = self._nodes.get_feature(name)
        if isinstance(node, self._aravis.GcEnumeration):
            return "one of " + ", ".join(self.symbols(name))
        if hasattr(node, "get_min"):
            return f"{node.get_min():g} to {node.get_max():g}"
        return "a value that the camera accepts"
