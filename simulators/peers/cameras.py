"""The cameras' side of the camera link (docs/reference/wire.md): JSON and frames over TCP."""

from __future__ import annotations

import json
import socket
import struct
import threading
from typing import Any

from simulators.frames.frames import Sensor
from simulators.peers.tcp import TcpServer, exactly
from simulators.world import World

_LONGEST_REQUEST = 1 << 16
_LONGEST_EXPOSURE = 10.0


class CameraLink:
    """Listens on one port; each connection is for the camera of its hello."""

    def __init__(self, world: World, sensor: Sensor, host: str, port: int) -> None:
        self._world, self._sensor = world, sensor
        self._address = (host, port)
        self._server: TcpServer | None = None
        self._stopping = threading.Event()

    def start(self) -> int:
        """Listen; returns the port. Raises `OSError` if it is taken."""
        self._server = TcpServer("cameras", self._address, self._serve)
        return self._server.port

    def stop(self) -> None:
        """Close the port and every connection."""
        self._stopping.set()
        if self._server is not None:
            self._server.hang_up()

    def _serve(self, connection: socket.socket) -> None:
        _Connection(self._world, self._sensor, self._stopping).handle(connection)


class _BadRequest(ValueError):
    """A request with an error as its response."""


class _Connection:
    def __init__(self, world: World, sensor: Sensor, stopping: threading.Event) -> None:
        self._world, self._sensor, self._stopping = world, sensor, stopping
        self._camera: str | None = None

    def handle(self, connection: socket.socket) -> None:
        while head := exactly(connection, 4):
            (length,) = struct.unpack(">I", head)
            if length > _LONGEST_REQUEST:
                return
            payload = b""
            try:
                response, payload = self._respond(exactly(connection, length))
            except _BadRequest as error:
                response = {"ok": False, "error": str(error)}
            while self._camera is not None and self._world.begun("camera", "mute", self._camera):
                if self._stopping.wait(0.05):
                    return
            text = json.dumps(response).encode()
            connection.sendall(struct.pack(">I", len(text)) + text + payload)

    def _respond(self, message: bytes) -> tuple[dict[str, Any], bytes]:
        try:
            request = json.loads(message)
        except ValueError as error:
            raise _BadRequest(f"not JSON: {error}") from error
        op = request.get("op") if isinstance(request, dict) else None
        if op == "hello":
            return self._hello(request), b""
        if op not in ("arm", "read", "disarm"):
            raise _BadRequest(f"unknown op {op!r}; known are hello, arm, read, disarm")
        if self._camera is None:
            raise _BadRequest(f"{op} before hello")
        if op == "read":
            return self._read(self._camera)
        self._world.arm(self._camera, _exposure(request) if op == "arm" else None)
        return {"ok": True}, b""

    def _hello(self, request: dict[str, Any]) -> dict[str, Any]:
        cameras = {c.name: c for c in self._world.rig.cameras}
        name = request.get("camera")
        if name not in cameras:
            raise _BadRequest(f"no camera {name!r}; there are {list(cameras)}")
        self._world.hello(name)
        self._camera = name
        sensor = self._sensor
        return {
            "ok": True,
            "width": cameras[name].width,
            "height": cameras[name].height,
            "full_scale": sensor.full_scale,
            "black": sensor.black,
            "gain": sensor.gain,
        }

    def _read(self, camera: str) -> tuple[dict[str, Any], bytes]:
        frame = self._world.oldest(camera)
        if frame is None:
            return {"ok": True, "status": "empty"}, b""
        if not frame.counts.done():
            return {"ok": True, "status": "busy", **self._world.busy(camera)}, b""
        self._world.take(camera, frame)
        if frame.counts.cancelled():
            return {"ok": True, "status": "empty"}, b""
        failure = frame.counts.exception()
        if failure is not None:
            raise _BadRequest(f"{camera}: the frame could not be made: {failure}")
        payload = frame.counts.result().astype("<u2").tobytes()
        response = {
            "ok": True,
            "status": "frame",
            "block_id": frame.block_id,
            "timestamp": frame.timestamp,
            "exposure": frame.exposure,
            "left": self._world.held(camera),
            "bytes": len(payload),
        }
        return response, payload


def _exposure(request: dict[str, Any]) -> float:
    exposure = request.get("exposure")
    if isinstance(exposure, bool) or not isinstance(exposure, int | float):
        raise _BadRequest(f"exposure must be a number of seconds, got {exposure!r}")
    if not 0 < exposure <= _LONGEST_EXPOSURE:
        raise _BadRequest(f"exposure must be over 0 and at most {_LONGEST_EXPOSURE} s")
    return float(exposure)
