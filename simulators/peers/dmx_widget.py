"""An Enttec DMX USB Pro with dimmers (DMX USB Pro Widget API Specification 1.44)."""

from __future__ import annotations

import struct
from collections.abc import Callable
from pathlib import Path

from simulators.peers.faults import Fault
from simulators.peers.lamps import Lamps
from simulators.peers.terminal import TerminalPeer

_START, _END = 0x7E, 0xE7
_MOST_DATA = 600
_PARAMETERS, _SEND_DMX, _SERIAL_NUMBER = 3, 6, 10
_FIRMWARE, _BREAK, _MARK, _RATE = 0x0144, 9, 1, 40
_SERIAL = bytes.fromhex("78563412")  # binary-coded decimal, low digits first: 12345678
_GARBAGE = b"\x7e\x03\xff\xff\x00\x55"


class DmxWidget(TerminalPeer):
    """The widget at a pseudo-terminal, and `lamps` as its dimmers from `first_channel` on,
    each with `channels`.

    It has no watchdog: lamps keep their last level if the host stops. `strikes` gets a request's
    label, "6".
    """

    def __init__(
        self,
        lamps: Lamps,
        first_channel: int,
        link: Path,
        strikes: Callable[[str], Fault | None] = lambda _request: None,
        begun: Callable[[str], bool] = lambda _fault: False,
        channels: int = 1,
    ) -> None:
        lamps.without_dead_man()
        self._lamps, self._before, self._width = lamps, first_channel - 1, channels
        self._strikes, self._begun = strikes, begun
        super().__init__(link)

    def _run(self) -> None:
        pending = b""
        while (data := self._terminal.receive()) is not None:
            pending += data
            while (message := _next(pending)) is not None:
                label, body, pending = message
                if not self._take(label, body):
                    pending = b""
            pending = pending[-_MOST_DATA - 5 :]

    def _take(self, label: int, data: bytes) -> bool:
        """Execute one message; False if the widget was unplugged."""
        if self._begun("hang"):
            return True
        fault = self._strikes(str(label))
        kind = None if fault is None else fault.kind
        if fault is not None and kind == "unplug":
            self._terminal.unplug(fault.seconds)
            return False
        reply = self._execute(label, data)
        if reply is None or kind == "silent":
            return True
        if fault is not None and kind == "late" and self._terminal.stops_within(fault.seconds):
            return False
        framed = struct.pack("<BBH", _START, label, len(reply)) + reply + bytes([_END])
        noise = _GARBAGE if kind in ("garbage", "noise") else b""
        self._terminal.send(noise if kind == "garbage" else noise + framed)
        return True

    def _execute(self, label: int, data: bytes) -> bytes | None:
        if label == _PARAMETERS and len(data) == 2:
            user_data = bytes(int.from_bytes(data, "little"))
            return struct.pack("<HBBB", _FIRMWARE, _BREAK, _MARK, _RATE) + user_data
        if label == _SERIAL_NUMBER:
            return _SERIAL
        if label == _SEND_DMX and 25 <= len(data) <= 513 and data[0] == 0:
            count = self._lamps.count
            mine = data[1 + self._before :: self._width][:count].ljust(count, b"\0")
            self._lamps.show([257 * level for level in mine])
        return None


def _next(data: bytes) -> tuple[int, bytes, bytes] | None:
    """(label, body, rest) of the first complete message; bytes before it are skipped."""
    start = data.find(_START)
    while start >= 0 and len(data) >= start + 4:
        label, size = struct.unpack_from("<BH", data, start + 1)
        end = start + 4 + size
        if size <= _MOST_DATA:
            if end >= len(data):
                return None
            if data[end] == _END:
                return label, data[start + 4 : end], data[end + 1 :]
        start = data.find(_START, start + 1)
    return None
