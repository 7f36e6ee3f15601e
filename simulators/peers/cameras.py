"""The cameras' side of the camera link (docs/wire.md): JSON requests and frames over TCP."""

from __future__ import annotations

import json
import socket
import socketserver
import struct
import threading
from typing import Any

from simulators.frames.sensor import Sensor
from simulators.world import World

_LONGEST_REQUEST = 1 << 16
_LONGEST_EXPOSURE = 10.0


class CameraLink:
    """Listens on one port; every connection speaks for the camera that it said hello for."""

    def __init__(self, world: World, sensor: Sensor, host: str, port: int) -> None:
        try:
            self._server = _Server((host, port), _Connection)
        except OSError as error:
            raise OSError(f"cameras: cannot listen on {host}:{port}: {error}") from error
        self._server.world = world
        self._server.sensor = sensor
        self._thread = threading.Thread(
            target=self._server.serve_forever, args=(0.02,), name="cameras", daemon=True
        )

    def start(self) -> int:
        """Answer from now on; returns the port."""
        self._thread.start()
        return int(self._server.server_address[1])

    def stop(self) -> None:
        """Close the port and every connection."""
        self._server.shutdown()
        self._server.server_close()
        self._server.hang_up()
        self._thread.join()


class _Server(socketserver.ThreadingTCPServer):
    allow_reuse_address = True
    daemon_threads = True
    block_on_close = False
    world: World
    sensor: Sensor

    def __init__(self, address: tuple[str, int], handler: type[_Connection]) -> None:
        self.stopping = threading.Event()
        self._open: set[socket.socket] = set()
        self._lock = threading.Lock()
        super().__init__(address, handler)

    def opened(self, connection: socket.socket) -> None:
        with self._lock:
            self._open.add(connection)

    def closed(self, connection: socket.socket) -> None:
        with self._lock:
            self._open.discard(connection)

    def hang_up(self) -> None:
        self.stopping.set()
        with self._lock:
            for connection in self._open:
                connection.shutdown(socket.SHUT_RDWR)


class _BadRequest(ValueError):
    """A request that is answered with an error."""


class _Connection(socketserver.BaseRequestHandler):
    server: _Server
    request: socket.socket

    def setup(self) -> None:
        self.request.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._camera: str | None = None
        self.server.opened(self.request)

    def finish(self) -> None:
        self.server.closed(self.request)

    def handle(self) -> None:
        try:
            while (message := self._receive()) is not None:
                payload = b""
                try:
                    answer, payload = self._answer(message)
                except _BadRequest as error:
                    answer = {"ok": False, "error": str(error)}
                while self._camera is not None and self.server.world.mute(self._camera):
                    if self.server.stopping.wait(0.05):
                        return
                text = json.dumps(answer).encode()
                self.request.sendall(struct.pack(">I", len(text)) + text + payload)
        except (ConnectionError, OSError):
            return  # the client went away; a camera waits for the next one

    def _receive(self) -> bytes | None:
        head = self._exactly(4)
        if head is None:
            return None
        (length,) = struct.unpack(">I", head)
        if length > _LONGEST_REQUEST:
            return None
        return self._exactly(length)

    def _exactly(self, count: int) -> bytes | None:
        data = b""
        while len(data) < count:
            part = self.request.recv(count - len(data))
            if not part:
                return None
            data += part
        return data

    def _answer(self, message: bytes) -> tuple[dict[str, Any], bytes]:
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
        self.server.world.arm(self._camera, _exposure(request) if op == "arm" else None)
        return {"ok": True}, b""

    def _hello(self, request: dict[str, Any]) -> dict[str, Any]:
        cameras = {c.name: c for c in self.server.world.rig.cameras}
        name = request.get("camera")
        if name not in cameras:
            raise _BadRequest(f"no camera {name!r}; there are {list(cameras)}")
        self.server.world.hello(name)
        self._camera = name
        sensor = self.server.sensor
        return {
            "ok": True,
            "width": cameras[name].width,
            "height": cameras[name].height,
            "full_scale": sensor.full_scale,
            "black": sensor.black,
            "gain": sensor.gain,
        }

    def _read(self, camera: str) -> tuple[dict[str, Any], bytes]:
        frame = self.server.world.oldest(camera)
        if frame is None:
            return {"ok": True, "status": "empty"}, b""
        if not frame.counts.done():
            return {"ok": True, "status": "busy"}, b""
        self.server.world.take(camera, frame)
        if frame.counts.cancelled():
            return {"ok": True, "status": "empty"}, b""
        failure = frame.counts.exception()
        if failure is not None:
            raise _BadRequest(f"{camera}: the frame could not be made: {failure}")
        payload = frame.counts.result().astype("<u2").tobytes()
        answer = {
            "ok": True,
            "status": "frame",
            "block_id": frame.block_id,
            "timestamp": frame.timestamp,
            "exposure": frame.exposure,
            "left": self.server.world.held(camera),
            "bytes": len(payload),
        }
        return answer, payload


def _exposure(request: dict[str, Any]) -> float:
    exposure = request.get("exposure")
    if isinstance(exposure, bool) or not isinstance(exposure, int | float):
        raise _BadRequest(f"exposure must be a number of seconds, got {exposure!r}")
    if not 0 < exposure <= _LONGEST_EXPOSURE:
        raise _BadRequest(f"exposure must be over 0 and at most {_LONGEST_EXPOSURE} s")
    return float(exposure)
