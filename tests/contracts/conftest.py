"""Serial devices on pseudo-terminals: simulated, of version 1, and the compiled firmware."""

from __future__ import annotations

import shutil
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest
from dslrs import VIRTUAL_SERIAL, Body, FakeGphoto2, dslr, jpeg, plug_in_virtual
from waiting import slowed

from reconstruction import Projector
from simulators.peers.faults import Fault, Faults
from simulators.peers.projector_controller import SimulatedProjectorController
from simulators.peers.serial_peer import SerialPeer
from simulators.peers.trigger_box import SimulatedTriggerBox
from stage_service.device_config import SerialConfig
from stage_service.devices.cameras import gphoto2
from stage_service.devices.cameras.gphoto2 import Gphoto2Camera
from stage_service.devices.projectors.serial_controller import SerialProjectorController
from stage_service.devices.trigger.serial_box import SerialTriggerBox

FIRMWARE = Path(__file__).resolve().parents[2] / "deploy" / "firmware"
TIMEOUT_S = 30.0  # where no deadline is meant to be missed


@pytest.fixture(autouse=True)
def _lights_itself(permitted: None) -> None:
    """Tests of drivers command them without a run."""


Edge = tuple[float, str, bool]
"""When, which output (L, P, C), and whether it went up; a camera pulse is the way up alone."""


class Wires:
    """What a simulated trigger box is wired to; keeps the edges of its outputs."""

    class Gate:
        def __init__(
            self, edges: list[Edge], name: str, device: SimulatedProjectorController | None
        ):
            self.edges, self.name, self.device = edges, name, device

        def gate(self, is_open: bool) -> None:
            self.edges.append((time.monotonic(), self.name, is_open))
            if self.device is not None:
                self.device.gate(is_open)

        @property
        def trigger_out(self) -> bool:
            return self.device is not None and self.device.trigger_out

    def __init__(self, controller: SimulatedProjectorController, faults: Faults) -> None:
        self.edges: list[Edge] = []
        self.pulses = self.fired = 0
        self.faults = faults
        self.lamps = self.Gate(self.edges, "L", None)
        self.projectors = self.Gate(self.edges, "P", controller)

    def pulse(self, fires: int = 1, counts: int = 1) -> int:
        self.pulses += counts
        self.fired += fires
        self.edges += [(time.monotonic(), "C", True)] * fires
        return self.pulses

    def reset(self) -> None:
        self.pulses = 0

    def safety(self) -> tuple[bool, bool]:
        interlock, estop = (
            self.faults.since("trigger", k, self.pulses) for k in ("interlock", "estop")
        )
        return interlock, estop


class SerialStage:
    """A simulated trigger box and projector controller, wired, each with its driver.

    `now` is the projector controller's clock, seconds; it stands still.
    """

    def __init__(self, folder: Path, faults: Faults, stack: ExitStack, timeout_s: float) -> None:
        places = {"left": [0.0, 1.0, 0.3], "right": [0.5, 1.0, 0.3]}
        rig = [Projector.look_at(n, 8, 768, p, [0, 0, 0], 20.0) for n, p in places.items()]
        self.folder, self.faults = folder, faults
        self.timeout_s, self.now = timeout_s, 0.0
        self.controller = SimulatedProjectorController(rig, self.blank, lambda: self.now)
        self.wires = Wires(self.controller, faults)
        self.box = SimulatedTriggerBox(self.wires, faults)
        stack.callback(self.box.stop)
        replies = {"trigger": self.box.reply, "projectors": self.controller.reply}
        self.peers: dict[str, SerialPeer] = {}
        for name, reply in replies.items():
            peer = SerialPeer(folder / name, self.heard(name, reply), self.strikes(name))
            self.peers[name] = peer
            peer.start()
            stack.callback(peer.stop)
        self.requests: list[str] = []
        config = {n: SerialConfig(port=str(folder / n), timeout_s=timeout_s) for n in replies}
        self.trigger = SerialTriggerBox(config["trigger"])
        self.projectors = SerialProjectorController(config["projectors"], ("left", "right"))
        for driver in (self.trigger, self.projectors):
            driver.connect()
            stack.callback(driver.close)

    def heard(self, name: str, reply: Callable[[str], str]) -> Callable[[str], str]:
        def respond(line: str) -> str:
            self.requests.append(f"{name} {line}")
            return reply(line)

        return respond

    def strikes(self, name: str) -> Callable[[str], Fault | None]:
        return lambda line: self.faults.on_request(name, line, self.wires.pulses + 1)

    def port_of(self, device: str) -> str:
        """The port of the trigger box or of the projector controller."""
        return str(self.folder / ("trigger" if device == "trigger box" else "projectors"))

    def plugged(self, name: str) -> bool:
        return (self.folder / name).is_symlink()

    def open_gates(self) -> set[str]:
        state = {name: up for _, name, up in list(self.wires.edges) if name != "C"}
        return {name for name, up in state.items() if up}

    def blank(self) -> bool:
        return self.faults.since("projectors", "blank", self.wires.pulses)


@pytest.fixture
def serial_stage(tmp_path: Path, slack: int) -> Iterator[Callable[..., SerialStage]]:
    """`serial_stage(*faults)`: simulated trigger box and projectors on pseudo-terminals.

    Times are those of an idle machine.
    """
    with ExitStack() as stack:

        def start(*faults: Fault, timeout_s: float = TIMEOUT_S) -> SerialStage:
            return SerialStage(tmp_path, slowed(faults, slack), stack, timeout_s * slack)

        yield start


@pytest.fixture
def serve(tmp_path: Path) -> Iterator[Callable[[Callable[[str], str]], SerialConfig]]:
    """`serve(reply)`: a peer of the tests' own on a pseudo-terminal."""
    with ExitStack() as stack:

        def start(reply: Callable[[str], str]) -> SerialConfig:
            peer = SerialPeer(tmp_path / "own", reply)
            peer.start()
            stack.callback(peer.stop)
            return SerialConfig(port=str(peer.link), timeout_s=TIMEOUT_S)

        yield start


@pytest.fixture(scope="session")
def build_firmware(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., Path]:
    """`build_firmware(name, *options)`: the portable core, compiled; with sanitizers if it can."""
    compiler = shutil.which("cc")
    folder = tmp_path_factory.mktemp("firmware")

    def build(name: str, *options: str, sources: tuple[str, ...] = ("host.c",)) -> Path:
        if compiler is None:
            pytest.skip("no C compiler: `cc` is not on the path")
        strict = ["-std=c99", "-Wall", "-Wextra", "-Werror", "-pedantic", "-O1", "-g"]
        core = ("protocol.c", "table.c", "text.c")
        command = [compiler, *strict, *options, "-o", str(folder / name), *core, *sources]
        subprocess.run(command, cwd=FIRMWARE, check=True, timeout=60)
        return folder / name

    return build


@pytest.fixture(scope="session")
def firmware_host(build_firmware: Callable[..., Path]) -> Path:
    """The trigger box's firmware as a program for this machine."""
    try:
        checked = "-fsanitize=address,undefined", "-fno-sanitize-recover=all"
        return build_firmware("host", *checked)
    except subprocess.CalledProcessError:  # a compiler without the sanitizers' libraries
        return build_firmware("host")


class Firmware:
    """The compiled trigger box on a pseudo-terminal; `steer` sets its inputs (host.c)."""

    def __init__(self, program: Path, clock: int = 0) -> None:
        self.edges: list[Edge] = []
        self.process = subprocess.Popen(
            [program, str(clock)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            bufsize=1,
        )
        assert self.process.stdout is not None
        port = self.process.stdout.readline().strip()
        self.trigger = SerialTriggerBox(SerialConfig(port=port, timeout_s=TIMEOUT_S))
        self.reader = threading.Thread(target=self._read, daemon=True)
        self.reader.start()

    def _read(self) -> None:
        assert self.process.stdout is not None
        up: set[str] = set()
        for line in self.process.stdout:
            microseconds, outputs = line.split()
            now = set(outputs) - {"-"}
            for name in sorted(now ^ up):
                if name != "C" or name in now:
                    self.edges.append((int(microseconds) * 1e-6, name, name in now))
            up = now

    def steer(self, letter: str) -> None:
        assert self.process.stdin is not None
        self.process.stdin.write(letter)
        self.process.stdin.flush()

    def close(self) -> None:
        self.trigger.close()
        assert self.process.stdin is not None
        self.process.stdin.close()
        assert self.process.wait(10) == 0  # the sanitizers say what is wrong by their exit code
        self.reader.join(5)
        assert self.process.stdout is not None
        self.process.stdout.close()


@pytest.fixture
def firmware(firmware_host: Path) -> Iterator[Callable[..., Firmware]]:
    """`firmware(clock)`: the compiled trigger box, its microseconds beginning at `clock`."""
    with ExitStack() as stack:

        def start(clock: int = 0) -> Firmware:
            one = Firmware(firmware_host, clock)
            stack.callback(one.close)
            one.trigger.connect()
            return one

        yield start


@pytest.fixture
def virtual_nikon(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> Iterator[Callable[..., Gphoto2Camera]]:
    """`virtual_nikon(picture=…, **fields)`: libgphoto2's virtual camera, not connected."""
    with ExitStack() as stack:

        def make(picture: bytes = jpeg(), **fields: Any) -> Gphoto2Camera:
            plug_in_virtual(monkeypatch, tmp_path, picture)
            camera = dslr(VIRTUAL_SERIAL, **fields)
            stack.callback(camera.close)
            return camera

        yield make


@pytest.fixture
def stand_in(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[..., Gphoto2Camera]]:
    """`stand_in(*bodies, **fields)`: a camera of the stand-in library, not connected."""
    with ExitStack() as stack:

        def make(*bodies: Body, **fields: Any) -> Gphoto2Camera:
            found = bodies or (Body(),)
            monkeypatch.setitem(sys.modules, "gphoto2", FakeGphoto2(*found))
            monkeypatch.setattr(gphoto2, "_SERIALS", {})
            camera = dslr(**{"serial": found[0].serial, **fields})
            stack.callback(camera.close)
            return camera

        yield make
