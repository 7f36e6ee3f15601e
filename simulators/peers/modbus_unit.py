"""The light bank as a Modbus unit: its registers (docs/reference/wire.md) and functions.

Written from the Modbus Application Protocol Specification 1.1b3, without framing. `DisturbedUnit`
adds faults.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

from simulators.peers.faults import Fault
from simulators.peers.lamps import ENTRIES, FULL, OWNER_WORDS, Lamps, NotNow
from stage_service.device_config import LightRegisters

ILLEGAL_FUNCTION, ILLEGAL_ADDRESS, ILLEGAL_VALUE, FAILURE = 1, 2, 3, 4
_MOST_READ, _MOST_WRITTEN = 125, 123
_MOST_COILS_READ, _MOST_COILS_WRITTEN = 2000, 1968
_ON, _OFF = 0xFF00, 0x0000
GARBAGE = b"\x00\xffhs\x7f\x81\x00\x00\x55\xaa"
_WRITES = (5, 6, 15, 16)


class Refused(Exception):
    """The reply is the exception `code`."""

    def __init__(self, code: int) -> None:
        super().__init__(f"exception {code}")
        self.code = code


_Read = Callable[[], Sequence[int]]
_Write = Callable[[int, Sequence[int]], None]


@dataclass(frozen=True)
class _Block:
    """`count` registers from `first`; `write(offset, values)` is None where they are read-only."""

    first: int
    count: int
    read: _Read
    write: _Write | None = None


class ModbusUnit:
    """Executes requests for `lamps`, at the addresses of `registers`.

    A bank without heartbeat or watchdog register has no watchdog. `begun(fault)` is whether a
    lasting fault is active; with "lies" no lamp is reported lit.
    """

    def __init__(
        self,
        lamps: Lamps,
        registers: LightRegisters | None = None,
        begun: Callable[[str], bool] = lambda _fault: False,
    ) -> None:
        self._lamps, self._begun = lamps, begun
        r = registers or LightRegisters()
        self._full = r.level_full
        if None in (r.heartbeat, r.watchdog):
            lamps.without_dead_man()
        self._coils = [_Block(r.coils, lamps.count, lamps.coils, lamps.switch)]
        self._holding = _there(
            (r.levels, lamps.count, self._levels, self._dim),
            (r.selector, 1, lambda: lamps.control()[:1], _accepted(lamps.select)),
            (r.heartbeat, 1, lambda: lamps.control()[1:2], lambda _, v: lamps.beat(v[0])),
            (r.watchdog, 1, lambda: lamps.control()[2:], _accepted(lamps.watch)),
            (r.sequence, 1, lambda: lamps.sequence()[:1], _accepted(lamps.arm)),
            (r.owner, OWNER_WORDS, lamps.owner, lamps.own),
            (r.table, 2 * ENTRIES, self._table, self._load),
        )
        signature = r.signature or (None, 0)
        self._inputs = _there(
            (r.status, 1, lambda: self._status()[:1], None),
            (r.lit, 1, lambda: self._status()[1:], None),
            (r.count, 1, lambda: [lamps.count], None),
            (signature[0], 1, lambda: [signature[1]], None),
            (r.position, 1, lambda: [lamps.sequence()[1] & 0xFFFF], None),
        )

    def reply(self, request: bytes) -> bytes:
        """The reply to a request, function code first in both."""
        function = request[0]
        try:
            return request[:1] + self._execute(function, request[1:])
        except Refused as refused:
            return bytes([function | 0x80, refused.code])
        except NotNow:
            return bytes([function | 0x80, FAILURE])
        except struct.error:
            return bytes([function | 0x80, ILLEGAL_VALUE])

    def _execute(self, function: int, data: bytes) -> bytes:
        match function:
            case 1:
                return self._read_coils(*struct.unpack(">HH", data))
            case 3 | 4:
                blocks = self._holding if function == 3 else self._inputs
                return self._read(blocks, *struct.unpack(">HH", data))
            case 5:
                address, value = struct.unpack(">HH", data)
                _check(value in (_ON, _OFF))
                self._write(self._coils, address, [value == _ON])
                return data
            case 6:
                address, value = struct.unpack(">HH", data)
                self._write(self._holding, address, [value])
                return data
            case 15:
                address, count, size = struct.unpack(">HHB", data[:5])
                packed = data[5:]
                _check(0 < count <= _MOST_COILS_WRITTEN)
                _check(size == len(packed) == -(-count // 8))
                on = [bool(packed[i // 8] >> i % 8 & 1) for i in range(count)]
                self._write(self._coils, address, on)
                return data[:4]
            case 16:
                address, count, size = struct.unpack(">HHB", data[:5])
                _check(0 < count <= _MOST_WRITTEN and size == 2 * count)
                self._write(self._holding, address, struct.unpack(f">{count}H", data[5:]))
                return data[:4]
        raise Refused(ILLEGAL_FUNCTION)

    def _read_coils(self, address: int, count: int) -> bytes:
        _check(0 < count <= _MOST_COILS_READ)
        bits = _values(self._coils, address, count)
        packed = bytearray(-(-count // 8))
        for i, on in enumerate(bits):
            packed[i // 8] |= on << i % 8
        return bytes([len(packed)]) + packed

    def _read(self, blocks: list[_Block], address: int, count: int) -> bytes:
        _check(0 < count <= _MOST_READ)
        return struct.pack(f">B{count}H", 2 * count, *_values(blocks, address, count))

    def _write(self, blocks: list[_Block], address: int, values: Sequence[int]) -> None:
        parts = list(_parts(blocks, address, len(values)))
        if any(block.write is None for block, _, _ in parts):
            raise Refused(ILLEGAL_ADDRESS)
        for block, at, count in parts:
            assert block.write is not None
            block.write(at, values[:count])
            values = values[count:]

    def _levels(self) -> list[int]:
        return [self._register_level(level) for level in self._lamps.levels()]

    def _dim(self, first: int, levels: Sequence[int]) -> None:
        self._lamps.dim(first, [self._lamp_level(level) for level in levels])

    def _table(self) -> list[int]:
        words = self._lamps.table()
        return [self._register_level(word) if at % 2 else word for at, word in enumerate(words)]

    def _load(self, first: int, words: Sequence[int]) -> None:
        levels = [self._lamp_level(w) if at % 2 else w for at, w in enumerate(words, first)]
        self._lamps.load(first, levels)

    def _lamp_level(self, level: int) -> int:
        """A lamp's level of a register's."""
        _check(level <= self._full)
        return round(level * FULL / self._full)

    def _register_level(self, level: int) -> int:
        """A register's level of a lamp's."""
        return round(level * self._full / FULL)

    def _status(self) -> tuple[int, int]:
        bits, lit = self._lamps.status()
        return (bits & ~8, 0) if self._begun("lies") else (bits, lit)


@dataclass(frozen=True)
class Reply:
    """The reply: `frame` (None: none) after `delay_s`, or an unplugged link."""

    frame: bytes | None = None
    delay_s: float = 0.0
    unplugged_s: float | None = None


class DisturbedUnit:
    """A `unit` with faults: `strikes(request)` gives the fault of a request, described by function
    code and address, "6 1000"."""

    def __init__(
        self,
        unit: ModbusUnit,
        strikes: Callable[[str], Fault | None] = lambda _request: None,
        begun: Callable[[str], bool] = lambda _fault: False,
    ) -> None:
        self._unit, self._strikes, self._begun = unit, strikes, begun

    def reply(self, request: bytes, frame: Callable[[bytes], bytes]) -> Reply:
        """Execute a request, unless a fault prevents it; `frame` frames the reply."""
        if self._begun("hang"):
            return Reply()
        fault = self._strikes(f"{request[0]} {int.from_bytes(request[1:3], 'big')}")
        kind = None if fault is None else fault.kind
        if fault is not None and kind == "unplug":
            return Reply(unplugged_s=fault.seconds)
        nak = bytes([request[0] | 0x80, FAILURE])
        reply = nak if kind == "nak" else self._unit.reply(request)
        if kind == "echo" and reply[0] in _WRITES:
            reply = reply[:-1] + bytes([reply[-1] ^ 1])
        framed = frame(reply)
        match kind:
            case "silent":
                return Reply()
            case "garbage":
                return Reply(GARBAGE)
            case "noise":
                return Reply(GARBAGE + framed)
            case "crc":
                return Reply(framed[:-1] + bytes([framed[-1] ^ 1]))
        return Reply(framed, fault.seconds if fault is not None and kind == "late" else 0.0)


def _parts(blocks: list[_Block], address: int, count: int) -> Iterator[tuple[_Block, int, int]]:
    """(block, offset, count) of the span; raises `Refused` for a missing register."""
    while count:
        for block in blocks:
            at = address - block.first
            if 0 <= at < block.count:
                break
        else:
            raise Refused(ILLEGAL_ADDRESS)
        part = min(count, block.count - at)
        yield block, at, part
        address, count = address + part, count - part


def _values(blocks: list[_Block], address: int, count: int) -> list[int]:
    parts = _parts(blocks, address, count)
    return [value for block, at, part in parts for value in block.read()[at : at + part]]


def _there(*blocks: tuple[int | None, int, _Read, _Write | None]) -> list[_Block]:
    return [_Block(at, count, read, write) for at, count, read, write in blocks if at is not None]


def _accepted(command: Callable[[int], bool]) -> _Write:
    return lambda _, values: _check(command(values[0]))


def _check(good: bool) -> None:
    if not good:
        raise Refused(ILLEGAL_VALUE)
