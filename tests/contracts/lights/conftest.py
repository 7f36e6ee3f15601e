"""Light banks: each driver with a peer at the other end of a real wire, and a look at its lamps."""

from __future__ import annotations

import importlib.util
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest
from pyModbusTCP.server import DataHandler, ModbusServer
from waiting import slowed, until

from simulators.peers.devices import light_bank
from simulators.peers.dmx_node import HOST, DmxNode
from simulators.peers.faults import Fault, Faults
from simulators.peers.lamps import Lamps
from stage_service.device_config import (
    ArtNetConfig,
    DmxConfig,
    LightBankConfig,
    LightRegisters,
    ModbusRtuConfig,
    ModbusTcpConfig,
    SacnConfig,
)
from stage_service.devices.device_set import driver_for
from stage_service.devices.lights.interface import LightBank

LAMPS = 200
TIMEOUT_S = 0.2
COILS_ALONE = LightRegisters(
    levels=None,
    selector=None,
    heartbeat=None,
    watchdog=None,
    sequence=None,
    table=None,
    owner=None,
    status=None,
    lit=None,
    count=None,
    signature=None,
    position=None,
)
ELSEWHERE = LightRegisters(
    coils=50,
    levels=5000,
    level_full=255,
    selector=10,
    heartbeat=20,
    watchdog=30,
    sequence=40,
    table=20000,
    owner=600,
    status=9,
    lit=7,
    count=100,
    signature=(200, 4711),
    position=3,
)


class Bench:
    """A driver and what its peer's lamps give; `gate` is None where the peer has no gate.

    Simulated peers take `faults`; they strike once `pulses` has reached theirs.
    """

    def __init__(self, driver: LightBank, powers: Callable[[], Any]) -> None:
        self.driver = driver
        self.powers = powers
        self.lamps: Any = None
        self.faults = Faults()
        self.pulses = 0
        self.requests: list[str] = []
        self.link: Path | None = None
        self.peer: Any = None

    def lit(self) -> list[int]:
        """The numbers of the lamps that give light."""
        return [i for i, power in enumerate(self.powers()) if power > 0]

    def begun(self, device: str, kind: str) -> bool:
        return self.faults.since(device, kind, self.pulses)

    def strikes(self, device: str, request: str) -> Fault | None:
        self.requests.append(request)
        return self.faults.on_request(device, request, self.pulses)

    def plugged(self) -> bool:
        return self.link is None or self.link.is_symlink()


CONFIGS: dict[str, Callable[[str, float], LightBankConfig]] = {
    "simulated TCP": lambda _link, timeout_s: ModbusTcpConfig(port=1, timeout_s=timeout_s),
    "simulated RTU": lambda link, timeout_s: ModbusRtuConfig(
        kind="modbus_rtu", port=link, timeout_s=timeout_s, unit=7, parity="N", stop_bits=2
    ),
    "simulated RTU, other registers": lambda link, timeout_s: ModbusRtuConfig(
        kind="modbus_rtu", port=link, timeout_s=timeout_s, registers=ELSEWHERE, parity="N"
    ),
    "simulated TCP, coils alone": lambda _link, timeout_s: ModbusTcpConfig(
        port=1, timeout_s=timeout_s, registers=COILS_ALONE, accept_unverified_blackout=True
    ),
    "simulated DMX": lambda link, timeout_s: DmxConfig(
        kind="dmx_enttec",
        port=link,
        timeout_s=timeout_s,
        first_channel=5,
        accept_unverified_blackout=True,
    ),
    "simulated sACN": lambda _link, timeout_s: SacnConfig(
        kind="sacn",
        host=HOST,
        timeout_s=timeout_s,
        first_channel=500,
        channels=3,
        universe=7,
        accept_unverified_blackout=True,
    ),
    "simulated Art-Net": lambda _link, timeout_s: ArtNetConfig(
        kind="artnet", host=HOST, timeout_s=timeout_s, channels=4, accept_unverified_blackout=True
    ),
}


@pytest.fixture
def bench(tmp_path: Path, slack: int) -> Iterator[Callable[..., Bench]]:
    """`bench(kind, *faults, lamps=…, connect=…, clock=…)`: a driver and its peer.

    The faults' `seconds` are those of an idle machine, as `TIMEOUT_S` is.
    """
    timeout_s = TIMEOUT_S * slack
    with ExitStack() as stack:

        def start(
            kind: str,
            *faults: Fault,
            lamps: int = LAMPS,
            connect: bool = True,
            clock: Callable[[], float] = time.monotonic,
            paced: bool = False,
        ) -> Bench:
            if kind in CONFIGS:
                config = CONFIGS[kind](str(tmp_path / "lights"), timeout_s)
                struck = slowed(faults, slack)
                one = _simulated(config, struck, Lamps(lamps, clock), tmp_path, stack, paced)
            elif kind == "pyModbusTCP":
                one = _foreign(lamps, stack, timeout_s)
            else:
                one = _own(lamps, stack, timeout_s)
            stack.callback(one.driver.close)
            if connect:
                one.driver.connect()
            return one

        yield start


def _simulated(
    config: LightBankConfig,
    faults: Faults,
    lamps: Lamps,
    folder: Path,
    stack: ExitStack,
    paced: bool,
) -> Bench:
    one = Bench(driver_for(config, lamps.count), lamps.power)
    one.lamps, one.faults = lamps, faults
    peer = light_bank(config, one, folder / "lights", ("127.0.0.1", 0), paced)
    one.peer, place = peer, peer.start()
    stack.callback(peer.stop)
    if isinstance(place, int):
        assert isinstance(config, ModbusTcpConfig | SacnConfig | ArtNetConfig)
        one.driver = driver_for(config.model_copy(update={"port": place}), lamps.count)
        if isinstance(peer, DmxNode):
            node = peer
            one.powers = lambda: until(node.idle) and lamps.power()
    else:
        one.link = Path(place)
    return one


class Foreign(DataHandler):  # type: ignore[misc]
    """The light bank's register map on a server that nobody here wrote."""

    def __init__(self, lamps: int) -> None:
        super().__init__()
        self.on = [False] * lamps
        self.holding = dict.fromkeys(range(lamps), 65535)
        self.holding |= {1000: 0, 1001: 0, 1002: 2000, 1003: 0}
        self.holding |= dict.fromkeys(range(1004, 1021), 0)
        self.holding |= dict.fromkeys(range(2000, 2000 + 8192), 0)

    def powers(self) -> list[float]:
        return [self.holding[i] / 65535 if on else 0.0 for i, on in enumerate(self.on)]

    def read_i_regs(self, address: int, count: int, srv_info: Any) -> Any:
        lit = sum(self.on)
        bits = 8 * bool(lit) | 16 * bool(self.holding[1003])
        words = [bits, lit, len(self.on), 0x4853, 0]
        return self.Return(0, words[address : address + count])

    def read_h_regs(self, address: int, count: int, srv_info: Any) -> Any:
        return self.Return(0, [self.holding[a] for a in range(address, address + count)])

    def write_coils(self, address: int, bits_l: list[bool], srv_info: Any) -> Any:
        self.on[address : address + len(bits_l)] = bits_l
        return self.Return(0)

    def write_h_regs(self, address: int, words_l: list[int], srv_info: Any) -> Any:
        if address == 1002 and not 100 <= words_l[0] <= 60000:
            return self.Return(3)
        if address == 1000 and self.holding[1003]:
            return self.Return(4)
        if address == 1004 and words_l[0] != self.holding[1004]:
            if words_l[0] and self.holding[1004]:
                return self.Return(4)
            self.holding |= dict.fromkeys(range(1005, 1021), 0)
        self.holding |= dict(enumerate(words_l, address))
        if address in (1000, 1003):
            what = words_l[0] if address == 1000 else 0
            self.on = [what in (i + 1, 65535) for i in range(len(self.on))]
        return self.Return(0)


class ForeignServer(ModbusServer):  # type: ignore[misc]
    """Notices within 10 ms, not half a second, that it is to stop."""

    def _serve(self) -> None:
        self._evt_running.set()
        self._service.serve_forever(0.01)


def _foreign(lamps: int, stack: ExitStack, timeout_s: float) -> Bench:
    handler = Foreign(lamps)
    server = ForeignServer("127.0.0.1", 0, no_block=True, data_hdl=handler)
    server.start()
    stack.callback(server._service.server_close)
    stack.callback(server._service.shutdown)
    port = server._service.socket.getsockname()[1]
    return Bench(driver_for(ModbusTcpConfig(port=port, timeout_s=timeout_s), lamps), handler.powers)


def _own(lamps: int, stack: ExitStack, timeout_s: float) -> Bench:
    """The hand-written peer that the service's tests use."""
    file = Path(__file__).resolve().parents[2] / "stage_service" / "conftest.py"
    spec = importlib.util.spec_from_file_location("service_peers", file)
    assert spec is not None
    assert spec.loader is not None
    peers = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = peers  # dataclasses look there
    spec.loader.exec_module(peers)
    assert lamps == peers.LAMPS
    world = peers.World()
    server = peers.Server(world, peers.Lights)
    stack.callback(server.server_close)
    stack.callback(server.shutdown)
    config = ModbusTcpConfig(port=server.server_address[1], timeout_s=timeout_s)

    def powers() -> list[float]:
        return [world.levels[i] / 65535 if i in world.lit else 0.0 for i in range(lamps)]

    return Bench(driver_for(config, lamps), powers)
