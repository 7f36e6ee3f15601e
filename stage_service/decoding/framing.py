"""Messages between the service and its decoder: a JSON object, then parts of bytes.

No pickle: a process compromised by a hostile file must not run code in the service.
"""

from __future__ import annotations

import json
import socket
import struct
import time
from collections.abc import Sequence
from typing import Any

Part = bytes | bytearray | memoryview
_LENGTH = struct.Struct(">I")
MOST_TEXT = 4 << 20
"""Bytes of the JSON object: a board has at most 4,096 squares of about 60 bytes."""


def send(connection: socket.socket, head: dict[str, Any], parts: Sequence[Part] = ()) -> None:
    """Send a message. Raises `OSError`."""
    text = json.dumps({**head, "parts": [memoryview(part).nbytes for part in parts]}).encode()
    connection.sendall(_LENGTH.pack(len(text)) + text)
    for part in parts:
        connection.sendall(part)


def receive(
    connection: socket.socket, most: int, deadline: float | None = None
) -> tuple[dict[str, Any], list[bytearray]]:
    """The next message, its parts of at most `most` bytes together, until `deadline` (monotonic).

    Raises `TimeoutError`, `EOFError` if the other end has closed, and `ValueError` for an invalid
    or too large message.
    """
    (length,) = _LENGTH.unpack(_exactly(connection, _LENGTH.size, deadline))
    if length > MOST_TEXT:
        raise ValueError(f"a message of {length:,} bytes; at most {MOST_TEXT:,} are read")
    head = json.loads(_exactly(connection, length, deadline))
    sizes = head.pop("parts")
    if not all(isinstance(size, int) and size >= 0 for size in sizes) or sum(sizes) > most:
        raise ValueError(f"parts of {sizes} bytes; at most {most:,} are read")
    return head, [_exactly(connection, size, deadline) for size in sizes]


def _exactly(connection: socket.socket, count: int, deadline: float | None) -> bytearray:
    data = bytearray(count)
    view = memoryview(data)
    while view:
        if deadline is not None:
            connection.settimeout(max(1e-3, deadline - time.monotonic()))
        got = connection.recv_into(view)
        if not got:
            raise EOFError
        view = view[got:]
    return data
