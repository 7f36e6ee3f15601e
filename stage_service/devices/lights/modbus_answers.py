"""Modbus answers as texts: the right one to a request, and the one that came."""

from __future__ import annotations

from typing import Any

CODES = {
    "read_coils": 1,
    "read_holding_registers": 3,
    "read_input_registers": 4,
    "write_register": 6,
    "write_coils": 15,
    "write_registers": 16,
}


def expected(method: str, address: int, payload: Any) -> str:
    """What the right answer to a request looks like, as `received` tells it."""
    code = CODES[method]
    if code == 1:
        return f"function 1, {-(-payload // 8) * 8} bits"
    if code in (3, 4):
        return f"function {code}, {payload} registers"
    if code == 6:
        return f"function 6, {payload} at {address}"
    return f"function {code}, {len(payload)} from {address}"


def received(answer: Any) -> str:
    """What an answer is."""
    code = answer.function_code
    match code:
        case 1:
            return f"function 1, {len(answer.bits)} bits"
        case 3 | 4:
            return f"function {code}, {len(answer.registers)} registers"
        case 6:
            return f"function 6, {answer.registers[0]} at {answer.address}"
        case 15 | 16:
            return f"function {code}, {answer.count} from {answer.address}"
    return f"function {code}"


def unusable(data: bytes) -> str:
    """What came instead of an answer."""
    shown = data[:32].hex(" ") + (" …" if len(data) > 32 else "")
    return f"no answer in {len(data)} bytes: {shown}" if data else "nothing"
