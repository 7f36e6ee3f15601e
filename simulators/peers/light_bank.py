"""The simulated light bank on whichever wire the rig file names."""

from __future__ import annotations

from pathlib import Path
from typing import Protocol

from simulators.peers.dmx_widget import DmxWidget
from simulators.peers.faults import Fault
from simulators.peers.lamps import Lamps
from simulators.peers.modbus_faults import DisturbedUnit
from simulators.peers.modbus_rtu import ModbusRtuPeer
from simulators.peers.modbus_tcp import ModbusTcpPeer
from simulators.peers.modbus_unit import ModbusUnit
from stage_service.config import DmxConfig, LightBankConfig, ModbusRtuConfig


class Wired(Protocol):
    """Lamps, and the faults of the wire to them, as `World` has them."""

    lamps: Lamps

    def begun(self, device: str, kind: str) -> bool:
        """Whether a lasting fault shows."""

    def strikes(self, device: str, request: str) -> Fault | None:
        """The fault of this request."""


class LightBankPeer(Protocol):
    """A bank's side of its wire; `start` returns its TCP port or its serial port's path."""

    def start(self) -> int | str:
        """Answer from now on. Raises `OSError` when the address is taken."""
        ...

    def stop(self) -> None:
        """Answer no more."""
        ...


def light_bank(
    config: LightBankConfig, world: Wired, link: Path, tcp: tuple[str, int], paced: bool = False
) -> LightBankPeer:
    """The peer for `config`: at `tcp` (port 0: a free one), or on a serial port at `link`.

    With `paced` a serial line takes the time that its baud rate needs.
    """

    def begun(fault: str) -> bool:
        return world.begun("lights", fault)

    def strikes(request: str) -> Fault | None:
        return world.strikes("lights", request)

    if isinstance(config, DmxConfig):
        return DmxWidget(world.lamps, config.first_channel, link, strikes, begun)
    unit = DisturbedUnit(ModbusUnit(world.lamps, config.registers, begun), strikes, begun)
    if isinstance(config, ModbusRtuConfig):
        return ModbusRtuPeer(unit, config, link, paced)
    return ModbusTcpPeer(unit, config.unit, *tcp)
