"""Modbus on a serial line: the light bank's side (Modbus over Serial Line 1.02, RTU mode)."""

from __future__ import annotations

import time
from pathlib import Path

from simulators.peers.modbus_unit import DisturbedUnit
from simulators.peers.terminal import TerminalPeer
from stage_service.device_config import ModbusRtuConfig

BROADCAST = 0
_SHORTEST, _LONGEST = 4, 256
_FIXED_ABOVE_BAUD, _FIXED_SILENCE_S = 19200, 1.75e-3


class ModbusRtuPeer(TerminalPeer):
    """Serves a unit at a pseudo-terminal.

    `paced`: replies are delayed to the line's baud rate, which a pseudo-terminal ignores.
    """

    def __init__(
        self, bank: DisturbedUnit, config: ModbusRtuConfig, link: Path, paced: bool = False
    ) -> None:
        self._bank = bank
        self._unit = config.unit
        bits = 9 + (config.parity != "N") + config.stop_bits
        self._character_s = bits / config.baud
        fixed = config.baud > _FIXED_ABOVE_BAUD
        self._silence_s = _FIXED_SILENCE_S if fixed else 3.5 * self._character_s
        self._paced = paced
        super().__init__(link)

    def _run(self) -> None:
        while (frame := self._terminal.receive()) is not None:
            began = time.monotonic()
            while more := self._terminal.receive(self._silence_s):
                frame += more
            if more is None:
                return
            self._take(frame, began)

    def _take(self, frame: bytes, began: float) -> None:
        """Ignore frames with a wrong CRC or for other units."""
        if not _SHORTEST <= len(frame) <= _LONGEST or crc(frame) != 0:
            return
        unit, request = frame[0], frame[1:-2]
        if unit not in (self._unit, BROADCAST):
            return
        reply = self._bank.reply(request, lambda reply: with_crc(bytes([unit]) + reply))
        if reply.unplugged_s is not None:
            self._terminal.unplug(reply.unplugged_s)
        elif reply.frame is not None and unit != BROADCAST:
            wait = reply.delay_s
            if self._paced:
                on_the_wire = (len(frame) + len(reply.frame)) * self._character_s + self._silence_s
                wait += max(0.0, began + on_the_wire - time.monotonic())
            if not self._terminal.stops_within(wait):
                self._terminal.send(reply.frame)


def crc(data: bytes) -> int:
    """CRC-16/MODBUS of `data`: reflected 0x8005, from 0xFFFF; 0 over a frame with its own CRC."""
    remainder = 0xFFFF
    for byte in data:
        remainder ^= byte
        for _ in range(8):
            remainder = remainder >> 1 ^ (0xA001 if remainder & 1 else 0)
    return remainder


def with_crc(data: bytes) -> bytes:
    """`data` and its CRC, low byte first."""
    return data + crc(data).to_bytes(2, "little")
