"""Modbus requests and answers as bytes, and as texts for errors.

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
    """A request without its frame: `payload` is the count of a read, else what is written."""
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
    """How many bytes the right answer to a request has, without its frame."""
    code, count = sent[0], int.from_bytes(sent[3:5], "big")
    if code not in _READS:
        return _WRITTEN_SIZE
    return 2 + (-(-count // 8) if code == 1 else 2 * count)


def is_right(sent: bytes, answer: bytes) -> bool:
    """Whether an answer is one to this request; its exception is none."""
    if len(answer) != right_size(sent) or answer[0] != sent[0]:
        return False
    if sent[0] in _READS:
        return answer[1] == len(answer) - 2
    return answer == sent[:_WRITTEN_SIZE]


def registers(answer: bytes) -> list[int]:
    """The words of a right answer to a read of registers."""
    return list(struct.unpack(f">{answer[1] // 2}H", answer[2:]))


def bits(answer: bytes, count: int) -> list[bool]:
    """The first `count` bits of a right answer to a read of coils."""
    return [bool(answer[2 + i // 8] >> i % 8 & 1) for i in range(count)]


def expected(sent: bytes) -> str:
    """What the right answer to a request is, as `shown` has it."""
    code, address, number = struct.unpack(">BHH", sent[:5])
    if code in _READS:
        return _shown_read(code, right_size(sent) - 2)
    return _shown_write(code, address, number)


def shown(answer: bytes) -> str:
    """What an answer is, in words."""
    code = answer[0]
    if code in _READS and len(answer) >= 2 and len(answer) == 2 + answer[1]:
        return _shown_read(code, answer[1])
    if code in _WRITES and len(answer) == _WRITTEN_SIZE:
        return _shown_write(*struct.unpack(">BHH", answer))
    return f"function {code} in {len(answer)} bytes"


def _shown_read(code: int, size: int) -> str:
    return f"function {code}, " + (f"{8 * size} bits" if code <= 2 else f"{size / 2:g} registers")


def _shown_write(code: int, address: int, number: int) -> str:
    return f"function {code}, {number} {'at' if code in (5, 6) else 'from'} {address}"


def unusable(data: bytes) -> str:
    """What came instead of an answer."""
    text = data[:32].hex(" ") + (" …" if len(data) > 32 else "")
    return f"no answer in {len(data)} bytes: {text}" if data else "nothing"


def with_crc(data: bytes) -> bytes:
    """`data` as an RTU frame: its CRC-16 behind it, low byte first."""
    return data + _crc(data).to_bytes(2, "little")


def rtu_frame(data: bytes) -> bytes | None:
    """The whole answer that `data` begins with, frame and all; None where there is none yet."""
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
