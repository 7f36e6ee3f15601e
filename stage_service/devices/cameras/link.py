"""A camera on the camera link: length-prefixed JSON and counts; see `docs/reference/wire.md`."""

from __future__ import annotations

import json
import socket
import struct
import threading
import time
from typing import Any

import numpy as np

from reconstruction import Camera
from reconstruction.reading import parse_json
from stage_service.device_config import LinkCamerasConfig
from stage_service.devices.cameras.interface import Busy, CameraCapabilities, CameraInfo, Frame
from stage_service.devices.errors import Cancelled, DeviceError, DeviceTimeout, DeviceUnreachable

BLOCK_WRAP = 65535
LONGEST_HEADER = 1 << 20
LONGEST_PAYLOAD = 1 << 30
LONGEST_DOING = 100
POLL_S = (0.001, 0.25)
"""Wait before a busy camera is read again: a quarter of the time so far, within these limits."""


class LinkCamera:
    """Implements `CameraDevice` on a TCP connection of its own; see there for the contract."""

    def __init__(self, config: LinkCamerasConfig, geometry: Camera) -> None:
        self.capabilities = CameraCapabilities(config.buffers, True, BLOCK_WRAP)
        self.name = geometry.name
        self.device = f"camera {geometry.name} ({config.host}:{config.port})"
        self.config = config
        self.geometry = geometry
        self.busy: Busy | None = None
        self._info: CameraInfo | None = None
        self._socket: socket.socket | None = None
        self._armed: float | None = None
        self._lock = threading.Lock()

    @property
    def info(self) -> CameraInfo:
        if self._info is None:
            raise RuntimeError(f"{self.device}: not connected")
        return self._info

    def connect(self) -> None:
        """Connect and say hello; raises `DeviceError` for a camera of another size."""
        self.close()
        address, timeout_s = (self.config.host, self.config.port), self.config.timeout_s
        try:
            self._socket = socket.create_connection(address, timeout_s)
        except OSError as error:
            doing, expected = "connecting", "a TCP connection"
            todo = "Check power, network, and host and port in [devices.cameras]."
            raise DeviceUnreachable(
                self.device, doing, expected, str(error), todo, timeout_s
            ) from error
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        doing = "saying hello"
        reply, _ = self._request({"op": "hello", "camera": self.name}, doing)
        whole = (int(self._number(reply, f, doing)) for f in ("width", "height", "full_scale"))
        info = CameraInfo(*whole, *(self._number(reply, f, doing) for f in ("black", "gain")))
        size = (self.geometry.width, self.geometry.height)
        if (info.width, info.height) != size:
            expected = f"{size[0]}x{size[1]} pixels as in the rig file"
            todo = "Set the camera's region of interest, or calibrate the rig for this size."
            raise self._error(doing, expected, f"{info.width}x{info.height}", todo)
        if info.gain <= 0 or info.full_scale <= info.black:
            expected = "gain above 0 and full_scale above black"
            received = f"gain {info.gain}, full_scale {info.full_scale}, black {info.black}"
            todo = "Check the camera's configuration."
            raise self._error(doing, expected, received, todo)
        self._info = info

    def close(self) -> None:
        if self._socket is not None:
            self._socket.close()
        self._socket = None
        self._armed = None

    def arm(self, exposure: float) -> None:
        self._request({"op": "arm", "exposure": exposure}, f"arming for {exposure:g} s")
        self._armed = exposure

    def release(self) -> None:
        """Nothing: the trigger box fires it."""

    def disarm(self) -> None:
        self._request({"op": "disarm"}, "disarming")
        self._armed = None

    def read(self, cancel: threading.Event) -> Frame | None:
        try:
            return self._read(cancel)
        finally:
            self.busy = None

    def _read(self, cancel: threading.Event) -> Frame | None:
        doing = "reading a frame"
        busy_s = self.config.busy_s
        began = time.monotonic()
        while True:
            reply, payload = self._request({"op": "read"}, doing)
            status = reply.get("status")
            if status == "frame":
                return self._frame(reply, payload, doing)
            if status == "empty":
                return None
            if status != "busy":
                todo = "Check that the camera follows docs/reference/wire.md."
                raise self._error(doing, "the status frame, busy or empty", repr(status), todo)
            waited = time.monotonic() - began
            if waited > busy_s:
                todo = "Check the camera, or raise busy_s in [devices.cameras]."
                received = "busy all the time"
                raise DeviceTimeout(self.device, doing, "a frame", received, todo, busy_s)
            self.busy = _busy(reply)
            if cancel.wait(min(max(waited / 4, POLL_S[0]), POLL_S[1])):
                raise Cancelled(f"{self.device}: {doing} was given up")

    def _frame(self, reply: dict[str, Any], payload: bytes, doing: str) -> Frame:
        info = self.info
        expected = info.width * info.height * 3 * 2
        if len(payload) != expected:
            todo = "Check the camera's pixel format: RGB, 16 bits, little-endian."
            raise self._error(doing, f"{expected} bytes of counts", f"{len(payload)}", todo)
        exposure = self._number(reply, "exposure", doing)
        if self._armed is None or abs(exposure - self._armed) > 1e-3 * self._armed:
            received = f"{exposure} s"
            todo = "A frame from before arming was in the queue, or the camera cannot expose so."
            raise self._error(doing, f"an exposure of {self._armed} s as armed", received, todo)
        counts = np.frombuffer(payload, "<u2").reshape(info.height, info.width, 3)
        block_id, timestamp = (self._number(reply, f, doing) for f in ("block_id", "timestamp"))
        left = int(self._number({"left": 0, **reply}, "left", doing))
        counts = counts.astype(np.uint16, copy=False)
        return Frame(counts, int(block_id), timestamp, exposure, left)

    def _number(self, reply: dict[str, Any], field: str, doing: str) -> Any:
        value = reply.get(field)
        if not isinstance(value, int | float) or isinstance(value, bool):
            todo = "Check that the camera follows docs/reference/wire.md."
            raise self._error(doing, f"a number {field!r}", repr(value), todo)
        return value

    def _request(self, request: dict[str, Any], doing: str) -> tuple[dict[str, Any], bytes]:
        """One request, one reply, within `timeout_s`; a failure closes the connection."""
        with self._lock:
            if self._socket is None:
                received = "a closed one"
                todo = "Connect again; what the camera held is lost."
                raise DeviceUnreachable(self.device, doing, "an open connection", received, todo)
            timeout_s = self.config.timeout_s
            deadline = time.monotonic() + timeout_s
            try:
                data = json.dumps(request).encode()
                self._socket.settimeout(timeout_s)
                self._socket.sendall(struct.pack(">I", len(data)) + data)
                (length,) = struct.unpack(">I", self._receive(4, deadline))
                if length > LONGEST_HEADER:
                    raise ValueError(f"a message of {length} bytes")
                reply = parse_json(self._receive(length, deadline))
                length = int(reply.get("bytes", 0))
                if not 0 <= length <= LONGEST_PAYLOAD:
                    raise ValueError(f"a payload of {length} bytes")
                payload = self._receive(length, deadline)
            except (OSError, EOFError) as error:
                self.close()
                late = isinstance(error, TimeoutError)
                kind = DeviceTimeout if late else DeviceUnreachable
                came = "nothing, or not all of it" if late else str(error) or "a closed connection"
                todo = "Check the camera's power and network, and start again."
                raise kind(self.device, doing, "a reply", came, todo, timeout_s) from error
            except (ValueError, AttributeError, TypeError) as error:
                self.close()
                todo = "Check the port in [devices.cameras]: this is another device."
                raise self._error(doing, "length-prefixed JSON", str(error), todo) from error
        if reply.get("ok") is not True:
            if reply.get("ok") is not False:  # not a reply: the true one may still come
                self.close()
            todo = "Check that the rig file is this stage's."
            raise self._error(doing, "ok", f"{reply.get('error', reply)}", todo)
        return reply, payload

    def _receive(self, count: int, deadline: float) -> bytes:
        assert self._socket is not None
        data = bytearray(count)
        view, got = memoryview(data), 0
        while got < count:
            left = deadline - time.monotonic()
            if left <= 0:
                raise TimeoutError
            self._socket.settimeout(left)
            n = self._socket.recv_into(view[got:])
            if n == 0:
                raise EOFError("the connection was closed by the camera")
            got += n
        return bytes(data)

    def _error(self, doing: str, expected: str, received: str, todo: str) -> DeviceError:
        return DeviceError(self.device, doing, expected, received, todo)


def _busy(reply: dict[str, Any]) -> Busy:
    """What a busy camera reports, without fields of another type."""
    doing, frame_s = reply.get("doing"), reply.get("frame_s")
    found = frame_s.items() if isinstance(frame_s, dict) else ()
    return Busy(
        doing[:LONGEST_DOING] if isinstance(doing, str) else "",
        _seconds(reply.get("left_s")),
        {kind: s for kind, value in found if (s := _seconds(value)) is not None},
    )


def _seconds(value: Any) -> float | None:
    number = isinstance(value, int | float) and not isinstance(value, bool)
    return max(float(value), 0.0) if number else None
