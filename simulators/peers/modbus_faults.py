"""A Modbus unit behind a wire that a fault may disturb."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from simulators.peers.faults import Fault
from simulators.peers.modbus_unit import FAILURE, ModbusUnit

GARBAGE = b"\x00\xffhs\x7f\x81\x00\x00\x55\xaa"
_WRITES = (5, 6, 15, 16)


@dataclass(frozen=True)
class Reply:
    """What goes back: nothing where `frame` is None; after `delay_s`; or the link goes away."""

    frame: bytes | None = None
    delay_s: float = 0.0
    unplugged_s: float | None = None


class DisturbedUnit:
    """`unit`, its answers framed by `frame`. The fault that `strikes(request)` disturbs one answer.

    A request is told to `strikes` as function code and address, "6 1000".
    """

    def __init__(
        self,
        unit: ModbusUnit,
        strikes: Callable[[str], Fault | None] = lambda _request: None,
        begun: Callable[[str], bool] = lambda _fault: False,
    ) -> None:
        self._unit = unit
        self._strikes = strikes
        self._begun = begun

    def reply(self, request: bytes, frame: Callable[[bytes], bytes]) -> Reply:
        """Carry a request out, unless the fault keeps it from that."""
        if self._begun("hang"):
            return Reply()
        fault = self._strikes(f"{request[0]} {int.from_bytes(request[1:3], 'big')}")
        kind = None if fault is None else fault.kind
        if fault is not None and kind == "unplug":
            return Reply(unplugged_s=fault.seconds)
        nak = bytes([request[0] | 0x80, FAILURE])
        answer = nak if kind == "nak" else self._unit.answer(request)
        if kind == "echo" and answer[0] in _WRITES:
            answer = answer[:-1] + bytes([answer[-1] ^ 1])
        framed = frame(answer)
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
