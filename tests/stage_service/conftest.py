"""A tiny stage on real wires: the device side of docs/reference/wire.md, with faults to script."""

from __future__ import annotations

import json
import os
import pty
import select
import socket
import socketserver
import struct
import threading
import tty
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from stage_service.captures import control
from stage_service.config import RigFile, load_rig_file

LAMPS, CAMERAS, ROWS = 200, 3, 12
WIDTH, HEIGHT = 8, 6
FULL_SCALE, BLACK, GAIN = 4095, 64, 10000.0


@pytest.fixture(autouse=True)
def patient(monkeypatch: pytest.MonkeyPatch) -> None:
    """A blackout's answer is waited for however busy the machine is, and so are audit's lines."""
    monkeypatch.setattr(control, "REPLY_S", 60.0)
    monkeypatch.setattr(control, "RECORDED_S", 60.0)


class World:
    """What is lit, and what the pulses made of it. `faults` are consumed as they strike."""

    def __init__(self) -> None:
        self.lock = threading.RLock()
        self.lit: set[int] = set()
        self.levels = [65535] * LAMPS
        self.table = [0] * 8192
        self.armed = self.position = 0
        self.owner = [0] * 17
        self.show = "OFF"
        self.pulses = 0
        self.heartbeats = 0
        self.watchdog_ms = 2000
        self.interlock = self.estop = False
        self.cameras: dict[str, dict[str, Any]] = {}
        self.requests: list[str] = []  # serial lines as they came
        self.drop: set[tuple[str, int]] = set()  # (camera, pulse): trigger missed
        self.lose: set[tuple[str, int]] = set()  # (camera, pulse): frame made, lost on the way
        self.double: set[int] = set()  # pulses that fire the cameras twice
        self.mute: set[str] = set()  # cameras that do not answer `read`
        self.busy: dict[str, int] = {}  # camera: answers `busy` this often
        self.dead_lamps = False  # lamps cannot be lit
        self.stuck_lamps = False  # lamps cannot be put off
        self.deaf_lights = False  # the light bank takes requests and answers none
        self.late: list[str] = []  # serial requests answered together with the next one
        self.hold_pulses = False  # the trigger box fires, and does not answer until `Wires.flush`
        self.pulses_held = 0
        self.put_on: Callable[[set[Any]], object] = lambda _lamps: None  # what lights up, at once

    def light(self, lamps: set[int]) -> None:
        """Exactly these lamps are on from now on."""
        new, self.lit = lamps - self.lit, lamps
        if new:
            self.put_on(new)

    def signal(self) -> int:
        """Counts above black per 10 ms of exposure, telling the light that was on."""
        if self.show.startswith("LINE"):
            return 1000 + int(self.show.split()[2])
        if self.show.startswith("ON"):
            return 900
        if len(self.lit) == 1:
            (lamp,) = self.lit
            return round((lamp + 1) * self.levels[lamp] / 65535)
        return 700 if self.lit else 0

    def pulse(self) -> None:
        self.pulses += 1
        for name, camera in self.cameras.items():
            if camera["exposure"] is None or (name, self.pulses) in self.drop:
                continue
            for _ in range(2 if self.pulses in self.double else 1):
                block = camera["block"]
                camera["block"] = block % 65535 + 1
                value = BLACK + self.signal() * camera["exposure"] / 0.01
                if (name, self.pulses) not in self.lose:
                    camera["queue"].append((block, min(round(value), FULL_SCALE)))

    @contextmanager
    def held(self) -> Iterator[None]:
        """A capture that starts meanwhile is still at its first frame, however slow its test is."""
        self.busy["cam_0"] = 10**9
        try:
            yield
        finally:
            del self.busy["cam_0"]


class Lights(socketserver.BaseRequestHandler):
    """Modbus TCP by hand: functions 3 (levels, sequence and table), 4, 6, 15 (lamps from the first
    on) and 16."""

    def handle(self) -> None:
        world: World = self.server.world  # type: ignore[attr-defined]
        while header := self.request.recv(7, 0x100):  # MSG_WAITALL
            tid, _, length, unit = struct.unpack(">HHHB", header)
            pdu = self.request.recv(length - 1, 0x100)
            if world.deaf_lights:
                continue
            with world.lock:
                if self.server.dead:  # type: ignore[attr-defined]
                    return
                reply = self.respond(world, pdu)
            self.request.sendall(struct.pack(">HHHB", tid, 0, len(reply) + 1, unit) + reply)

    def respond(self, world: World, pdu: bytes) -> bytes:
        function, address, value = struct.unpack(">BHH", pdu[:5])
        if function == 4:
            bits = 2 * world.interlock | 4 * world.estop | 8 * bool(world.lit)
            bits |= 16 * bool(world.armed)
            inputs = [bits, len(world.lit), LAMPS, 0x4853, world.position]
            return struct.pack(f">BB{value}H", 4, 2 * value, *inputs[address : address + value])
        if function == 3:
            holding = {1003: [world.armed], 1004: world.owner, 0: world.levels}.get(address)
            words = (holding or world.table[address - 2000 :])[:value]
            return struct.pack(f">BB{value}H", 3, 2 * value, *words)
        if function == 15:
            on = [bool(pdu[6 + i // 8] >> i % 8 & 1) for i in range(value)]
            if address or world.armed:
                return struct.pack(">BB", 0x8F, 4)
            world.light(set() if world.dead_lamps else {i for i, lit in enumerate(on) if lit})
            return pdu[:5]
        if function == 16:
            if value > 123:
                return struct.pack(">BB", 0x90, 3)
            values = struct.unpack(f">{value}H", pdu[6:])
            store, first = (world.table, 2000) if address >= 2000 else (world.levels, 0)
            if address > 1004 and address < 2000:
                store, first = world.owner, 1004
            store[address - first : address - first + value] = values
            return struct.pack(">BHH", 16, address, value)
        if address == 1004 and value != world.owner[0]:
            if value and world.owner[0]:
                return struct.pack(">BB", 0x86, 4)
            world.owner = [value] + 16 * [0]
        if address == 1003:
            world.armed, world.position = value, 0
        if address == 1000 and world.armed:
            return struct.pack(">BB", 0x86, 4)
        if address in (1000, 1003):
            if not (value == 0 and world.stuck_lamps):
                dark = value == 0 or address == 1003 or world.dead_lamps
                every = value == 65535  # dead lamps are those that are lit alone
                world.light(set(range(LAMPS)) if every else set() if dark else {value - 1})
        elif address == 1001:
            world.heartbeats += 1
        elif address == 1002:
            if not 100 <= value <= 60000:
                return struct.pack(">BB", 0x86, 3)
            world.watchdog_ms = value
        return pdu


class Cameras(socketserver.BaseRequestHandler):
    def handle(self) -> None:
        world: World = self.server.world  # type: ignore[attr-defined]
        name = ""
        while header := self.request.recv(4, 0x100):
            (length,) = struct.unpack(">I", header)
            request = json.loads(self.request.recv(length, 0x100))
            name = request.get("camera", name)
            if request["op"] == "read" and name in world.mute:
                continue
            with world.lock:
                reply, payload = self.respond(world, name, request)
            data = json.dumps(reply).encode()
            self.request.sendall(struct.pack(">I", len(data)) + data + payload)

    def respond(
        self, world: World, name: str, request: dict[str, Any]
    ) -> tuple[dict[str, Any], bytes]:
        op = request["op"]
        if op == "hello":
            if name not in {f"cam_{i}" for i in range(CAMERAS)}:
                return {"ok": False, "error": f"no camera {name}"}, b""
            world.cameras[name] = {"block": 1, "queue": [], "exposure": None}
            info = {"width": WIDTH, "height": HEIGHT, "full_scale": FULL_SCALE}
            return {"ok": True, **info, "black": BLACK, "gain": GAIN}, b""
        camera = world.cameras[name]
        if op == "arm":
            camera.update(exposure=request["exposure"], queue=[])
        elif op == "disarm":
            camera["exposure"] = None
        elif world.busy.get(name, 0) > 0:
            world.busy[name] -= 1
            return {"ok": True, "status": "busy"}, b""
        elif not camera["queue"]:
            return {"ok": True, "status": "empty"}, b""
        else:
            block, value = camera["queue"].pop(0)
            payload = np.full((HEIGHT, WIDTH, 3), value, "<u2").tobytes()
            frame = {"block_id": block, "timestamp": 0.0, "exposure": camera["exposure"]}
            return {"ok": True, "status": "frame", **frame, "bytes": len(payload)}, payload
        return {"ok": True}, b""


def trigger(world: World, line: str) -> str:
    if line == "ID?":
        return "HAIRSTAGE-TRIGGER 1"
    if line.startswith("PULSE"):
        if world.interlock or world.estop:
            return "ERR 3 interlock or emergency stop"
        world.pulse()
        return f"OK {world.pulses}"
    if line == "COUNT?":
        return f"COUNT {world.pulses}"
    if line == "RESET":
        world.pulses = 0
        return "OK 0"
    if line == "STATUS?":
        return f"STATUS interlock={world.interlock:d} estop={world.estop:d}"
    return "ERR 1 unknown command"


def projectors(world: World, line: str) -> str:
    if line == "ID?":
        return "HAIRSTAGE-PROJECTORS left,right"
    if line == "SHOW?":
        return f"SHOW {world.show}"
    if line.split()[0] not in ("LINE", "ON", "OFF"):
        return "ERR 1 unknown command"
    if line.startswith("LINE") and line.split()[1] not in ("left", "right"):
        return "ERR 2 unknown projector"
    if line != "OFF":
        world.put_on({line})
    world.show = line
    return f"OK {line}"


class SerialPeer:
    """Answers lines on a pseudo-terminal; keeps the far end open, as a cable does.

    `path` is a link that `cut` removes: the number of a closed pseudo-terminal is given to the next
    one, which may be another test's.
    """

    def __init__(self, world: World, respond: Any, path: Path) -> None:
        self.master, self.far = pty.openpty()
        tty.setraw(self.far)
        self.path = path
        path.symlink_to(os.ttyname(self.far))
        self.world, self.respond = world, respond
        self.wake, self.waker = os.pipe()
        self.thread = threading.Thread(target=self.run, daemon=True)
        self.thread.start()

    def run(self) -> None:
        data, held = b"", b""
        while True:
            ready, _, _ = select.select([self.master, self.wake], [], [])
            if self.wake in ready:
                if os.read(self.wake, 1) == CUT:
                    return
                os.write(self.master, held)
                held = b""
                continue
            try:
                data += os.read(self.master, 1024)
            except OSError:
                return
            while b"\n" in data:
                line, data = data.split(b"\n", 1)
                text = line.decode()
                with self.world.lock:
                    self.world.requests.append(text)
                    reply = self.respond(self.world, text).encode() + b"\n"
                    if text in self.world.late:
                        self.world.late.remove(text)
                        held += reply
                        continue
                    if self.world.hold_pulses and text.startswith("PULSE"):
                        self.world.pulses_held += 1
                        held += reply
                        continue
                os.write(self.master, held + reply)
                held = b""

    def flush(self) -> None:
        """Send the replies that were held back."""
        os.write(self.waker, FLUSH)

    def cut(self) -> None:
        """From now on nothing that is sent arrives, and whoever reads finds the line hung up."""
        if self.thread.is_alive():
            os.write(self.waker, CUT)
            self.thread.join()
        self.path.unlink()
        for handle in (self.master, self.far, self.wake, self.waker):
            os.close(handle)


CUT, FLUSH = b"c", b"f"


class Server(socketserver.ThreadingTCPServer):
    daemon_threads = True
    allow_reuse_address = True
    block_on_close = False

    def __init__(self, world: World, handler: type[socketserver.BaseRequestHandler]) -> None:
        super().__init__(("127.0.0.1", 0), handler)
        self.world, self.dead = world, False
        self.links: set[Any] = set()
        threading.Thread(target=self.serve_forever, args=(0.01,), daemon=True).start()

    def process_request(self, request: Any, client_address: Any) -> None:
        self.links.add(request)
        super().process_request(request, client_address)

    def close_request(self, request: Any) -> None:
        self.links.discard(request)
        super().close_request(request)

    def handle_error(self, request: Any, client_address: Any) -> None:
        """A link that was cut."""

    def drop(self) -> None:
        """End the connections that there are."""
        for link in list(self.links):
            with suppress(OSError):
                link.shutdown(socket.SHUT_RDWR)

    def cut(self) -> None:
        """Take no more connections and requests, and end the connections that there are."""
        with self.world.lock:
            self.dead = True
        self.shutdown()
        self.server_close()
        self.drop()


@dataclass(frozen=True)
class Wires:
    """The wires from a rig file to a world, which outlives them."""

    rig_file: RigFile
    servers: list[Server]
    serial: list[SerialPeer]

    def flush(self) -> None:
        """Have the trigger box answer what it has held back."""
        for peer in self.serial:
            peer.flush()

    def drop_lights(self) -> None:
        """End the connections to the light bank; new ones are taken."""
        self.servers[0].drop()

    def cut(self) -> None:
        """As where the process at this end is gone: nothing arrives any more."""
        for each in (*self.servers, *self.serial):
            each.cut()


@pytest.fixture
def world() -> World:
    """The state behind the wires of `rig_file`; script faults here."""
    return World()


@pytest.fixture
def wire(tmp_path: Path, slack: int) -> Callable[..., Wires]:
    """`wire(world, **timeouts)`: wires to a rig of 200 lamps, 3 small cameras and 2 projectors,
    until they are cut; `timeouts` in seconds by device."""
    numbers = count()

    def made(world: World, **timeouts: float) -> Wires:
        servers = [Server(world, handler) for handler in (Lights, Cameras)]
        number = next(numbers) or ""
        serial = [
            SerialPeer(world, respond, tmp_path / f"{respond.__name__}{number}")
            for respond in (trigger, projectors)
        ]
        path = tmp_path / f"rig{number}.toml"
        ports, paths = [s.server_address[1] for s in servers], [str(s.path) for s in serial]
        path.write_text(RIG + devices(ports, paths, slack, **timeouts))
        return Wires(load_rig_file(path), servers, serial)

    return made


@pytest.fixture
def rig_file(world: World, wire: Callable[..., Wires]) -> Iterator[RigFile]:
    """A rig of 200 lamps, 3 small cameras and 2 projectors whose devices answer on real wires."""
    wires = wire(world)
    yield wires.rig_file
    wires.cut()


def devices(
    ports: list[int],
    paths: list[str],
    slack: int,
    lights: float = 0.8,
    trigger: float = 1.0,
    projectors: float = 1.0,
    cameras: float = 1.0,
) -> str:
    return f"""
[safety]
living_subject = false
[devices]
heartbeat_s = 0.05
watchdog_s = {1.0 * slack:g}
[devices.lights]
port = {ports[0]}
timeout_s = {lights * slack:g}
[devices.trigger]
port = "{paths[0]}"
timeout_s = {trigger * slack:g}
[devices.projectors]
port = "{paths[1]}"
timeout_s = {projectors * slack:g}
[devices.cameras]
port = {ports[1]}
timeout_s = {cameras * slack:g}
busy_s = 30.0
[capture.exposure]
dark = 0.002
all_on = 0.001
olat = 0.002
scanline = 0.002
tracking = 0.001
"""


RIG = f"""
name = "tiny"
[dome]
lights = {LAMPS}
radius = 1.0
intensity = [1.0, 1.0, 1.0]
""" + "".join(
    f"""
[[{kind}]]
name = "{name}"
position = [{i - 0.9}, -1.0, 0.2]
target = [0.0, 0.0, 0.0]
fov_deg = 20.0
width = {WIDTH}
height = {height}
"""
    for kind, height, names in (
        ("cameras", HEIGHT, [f"cam_{i}" for i in range(CAMERAS)]),
        ("projectors", ROWS, ["left", "right"]),
    )
    for i, name in enumerate(names)
)
