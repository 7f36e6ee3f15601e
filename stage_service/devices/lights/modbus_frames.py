"""Modbus requests and replies as bytes, and as texts for errors.

Sources: Modbus Application Protocol 1.1b3 (the functions), Modbus over Serial Line 1.02 (the CRC).
"""

from __future__ import annotations

import struct
from collections.abc import Sequence

CODES = {
    "read_coils": 1,
    "read_holding_registers": 3,
    "read_input_registers": 4,
    "write_register": 6,
    "write_coils": 15,
    "write_registers": 16,
}
EXCEPTION = 0x80
EXCEPTION_SIZE = 2
_WRITTEN_SIZE = 5
_READS = (1, 2, 3, 4)
_WRITES = (5, 6, 15, 16)


def request(method: str, address: int, payload: int | Sequence[int]) -> bytes:
    """A request without its frame: `payload` is the count of a read, else the values written."""
    code = CODES[method]
    if isinstance(payload, int):
        return struct.pack(">BHH", code, address, payload)
    if method == "write_coils":
        packed = bytearray(-(-len(payload) // 8))
        for i, on in enumerate(payload):
            packed[i // 8] |= bool(on) << i % 8
        data = bytes(packed)
    else:
        data = struct.pack(f">{len(payload)}H", *payload)
    return struct.pack(">BHHB", code, address, len(payload), len(data)) + data


def right_size(sent: bytes) -> int:
    """Bytes of the right reply to a request, without its frame."""
    code, count = sent[0], int.from_bytes(sent[3:5], "big")
    if code not in _READS:
        return _WRITTEN_SIZE
    return 2 + (-(-count // 8) if code == 1 else 2 * count)


def is_right(sent: bytes, reply: bytes) -> bool:
    """Whether a reply is a right one to this request; an exception is not."""
    if len(reply) != right_size(sent) or reply[0] != sent[0]:
        return False
    if sent[0] in _READS:
        return reply[1] == len(reply) - 2
    return reply == sent[:_WRITTEN_SIZE]


def registers(reply: bytes) -> list[int]:
    """The words of a right reply to a read of registers."""
    return list(struct.unpack(f">{reply[1] // 2}H", reply[2:]))


def expected(sent: bytes) -> str:
    """The right reply to a request in words, see `shown`."""
    code, address, number = struct.unpack(">BHH", sent[:5])
    if code in _READS:
        return _shown_read(code, right_size(sent) - 2)
    return _shown_write(code, address, number)


def shown(reply: bytes) -> str:
    """A reply in words."""
    code = reply[0]
    if code in _READS and len(reply) >= 2 and len(reply) == 2 + reply[1]:
        return _shown_read(code, reply[1])
    if code in _WRITES and len(reply) == _WRITTEN_SIZE:
        return _shown_write(*struct.unpack(">BHH", reply))
    return f"function {code} in {len(reply)} bytes"


def _shown_read(code: int, size: int) -> str:
    return f"function {code}, " + (f"{8 * size} bits" if code <= 2 else f"{size / 2:g} registers")


def _shown_write(code: int, address: int, number: int) -> str:
    return f"function {code}, {number} {'at' if code in (5, 6) else 'from'} {address}"


def unusable(data: bytes) -> str:
    """Received bytes that are no reply, in words."""
    text = data[:32].hex(" ") + (" …" if len(data) > 32 else "")
    return f"no reply in {len(data)} bytes: {text}" if data else "nothing"


def with_crc(data: bytes) -> bytes:
    """`data` as an RTU frame: its CRC-16 behind it, low byte first."""
    return data + _crc(data).to_bytes(2, "little")


def rtu_frame(data: bytes) -> bytes | None:
    """The complete reply at the start of `data`, with its frame; None if it is incomplete."""
    if len(data) < 3:
        return None
    code = data[1]
    if code & EXCEPTION:
        size = EXCEPTION_SIZE + 3
    elif code in _READS:
        size = data[2] + 5
    elif code in _WRITES:
        size = _WRITTEN_SIZE + 3
    else:
        return None
    whole = len(data) >= size and _crc(data[:size]) == 0
    return data[:size] if whole else None


def _crc(data: bytes) -> int:
    """CRC-16/MODBUS; 0 over a frame with its own."""
    remainder = 0xFFFF
    for byte in data:
        remainder = remainder >> 8 ^ _TABLE[(remainder ^ byte) & 0xFF]
    return remainder


def _of_byte(byte: int) -> int:
    for _ in range(8):
        byte = byte >> 1 ^ (0xA001 if byte & 1 else 0)
    return byte


_TABLE = [_of_byte(byte) for byte in range(256)]
