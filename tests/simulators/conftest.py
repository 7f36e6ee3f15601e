"""A small stage on real wires, and the clients' side of each, from docs/reference/wire.md."""

from __future__ import annotations

import json
import socket
import struct
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import serial
from pymodbus.client import ModbusTcpClient
from waiting import machine_slack

from reconstruction import Camera, Light, Projector, Rig
from reconstruction.geometry.lights import dome_positions
from simulators.frames.frames import FrameMaker, Sensor
from simulators.frames.responses import Response
from simulators.peers.devices import SimulatedStage
from simulators.peers.faults import Fault, Faults
from simulators.peers.lamps import Lamps
from simulators.world import World


@pytest.fixture(scope="session")
def tiny_rig() -> Rig:
    """Two cameras of 16x16, 5 lamps, a projector of 8 rows."""
    places = {"cam_a": [0.0, -0.9, 0.1], "cam_b": [0.7, 0.6, 0.3]}
    cameras = tuple(Camera.look_at(n, 16, 16, p, [0, 0, 0], 22.0) for n, p in places.items())
    lights = tuple(
        Light(f"light_{i}", p, [8, 8, 8]) for i, p in enumerate(dome_positions(5, 1.2, -30))
    )
    projector = Projector.look_at(
        "proj", 8, 8, [0.4, -0.9, 0.5], [0, 0, 0], 20.0, 45.0, intensity=[20, 20, 20]
    )
    return Rig("tiny", cameras, lights, (projector,))


class Known:
    """Responses that tests can foresee: lamp i answers 0.1 (i + 1), row r 0.2 (r + 1) + pose."""

    def __init__(self, rig: Rig) -> None:
        self.rig = rig
        self.calls: list[tuple[Any, ...]] = []

    def lights(self, camera: str) -> Response:
        self.calls.append(("lamps", camera))
        levels = 0.1 * (1 + np.arange(len(self.rig.lights)))
        return self._response(levels)

    def lights_together(self, camera: str, pose: int, power: np.ndarray) -> Response:
        self.calls.append(("together", camera, pose))
        return self._response(np.array([0.1 * (1 + np.arange(len(power))) @ power]))

    def sweep(self, camera: str, pose: int) -> dict[str, Response]:
        self.calls.append(("sweep", camera, pose))
        return {
            p.name: self._response(0.2 * (1 + np.arange(p.height)) + pose)
            for p in self.rig.projectors
        }

    def _response(self, levels: np.ndarray) -> Response:
        pixels = np.arange(100)  # the other pixels are background
        images = np.broadcast_to(levels[:, None, None], (len(levels), 100, 3))
        return Response(pixels, images.astype(np.float32))


class SerialClient:
    """One line out, one line back."""

    def __init__(self, port: str) -> None:
        self.port = serial.Serial(port, timeout=0.5 * machine_slack())

    def send(self, line: str) -> str:
        self.port.write(line.encode() + b"\n")
        return self.port.readline().decode("ascii", "replace").removesuffix("\n")


class CameraClient:
    """One connection to the camera link."""

    def __init__(self, host: str, port: int) -> None:
        self.socket = socket.create_connection((host, port), timeout=60)

    def send(self, **request: Any) -> dict[str, Any]:
        return self.raw(json.dumps(request).encode())

    def raw(self, body: bytes) -> dict[str, Any]:
        self.socket.sendall(struct.pack(">I", len(body)) + body)
        (length,) = struct.unpack(">I", self._exactly(4))
        reply: dict[str, Any] = json.loads(self._exactly(length))
        if "bytes" in reply:
            reply["payload"] = self._exactly(reply["bytes"])
        return reply

    def read(self) -> dict[str, Any]:
        """The next answer to `read` that is not busy."""
        while (reply := self.send(op="read")).get("status") == "busy":
            pass
        return reply

    def frame(self) -> np.ndarray:
        return np.frombuffer(self.read()["payload"], "<u2").reshape(16, 16, 3)

    def _exactly(self, count: int) -> bytes:
        data = b""
        while len(data) < count:
            part = self.socket.recv(count - len(data))
            assert part, "the camera link closed the connection"
            data += part
        return data


class Bench:
    """A running stage with clients on all its wires."""

    def __init__(self, stage: SimulatedStage, world: World, now: list[float]) -> None:
        d = stage.devices
        self.stage, self.world, self.now, self.wires = stage, world, now, d
        self.lights = ModbusTcpClient(d["lights"]["host"], port=d["lights"]["port"], timeout=30)
        assert self.lights.connect()
        self.trigger = SerialClient(d["trigger"]["port"])
        self.projectors = SerialClient(d["projectors"]["port"])
        self.sockets: list[CameraClient] = []

    def camera(self, name: str) -> CameraClient:
        client = CameraClient(self.wires["cameras"]["host"], self.wires["cameras"]["port"])
        self.sockets.append(client)
        assert client.send(op="hello", camera=name)["ok"]
        return client

    def select(self, command: int) -> None:
        assert not self.lights.write_register(1000, command).isError()

    def close(self) -> None:
        self.lights.close()
        for line in (self.trigger, self.projectors):
            line.port.close()
        for client in self.sockets:
            client.socket.close()


@pytest.fixture
def start(tiny_rig: Rig, tmp_path: Path) -> Iterator[Callable[..., Bench]]:
    """Start a stage with faults, a `responder` (default: `Known`) and a clock that stands still."""
    running: list[tuple[Bench, SimulatedStage]] = []

    def begin(*faults: Fault, responder: Any = None, seed: int = 0) -> Bench:
        now = [100.0]
        used = Faults(faults)
        sensor = Sensor()
        frames = FrameMaker(tiny_rig, responder or Known(tiny_rig), sensor, seed)
        world = World(tiny_rig, Lamps(5, lambda: now[0]), used, frames.counts)
        stage = SimulatedStage(world, sensor, tmp_path / f"state{len(running)}")
        stage.__enter__()
        bench = Bench(stage, world, now)
        running.append((bench, stage))
        return bench

    yield begin
    for bench, stage in running:
        bench.close()
        stage.__exit__(None, None, None)


@pytest.fixture
def bench(start: Callable[..., Bench]) -> Bench:
    """A stage without faults."""
    return start()
