"""Bodies of requests: limits of size and time, and whether they are JSON."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Awaitable, Callable
from contextlib import suppress
from typing import Any

from starlette.datastructures import Headers
from starlette.types import Message, Receive, Send

from reconstruction.reading import parse_json

MOST_BODY, MOST_OTHERS = 1 << 20, 128 << 10
"""Bytes of a request; of one by a caller without `steer`, enough for the weights of 1,000 lights.
Parsing 1 MB of JSON blocks the event loop for 10 ms."""
BODY_S = 20.0
"""Deadline for a request's body."""
MOST_VALUES = 10_000
"""Values of a request, more than the weights of 1,000 lights have. Reporting 300,000 that are wrong
blocks the event loop for 3 s."""
MOST_UPLOAD, UPLOAD_S = 32 << 20, 120.0
"""Bytes of an upload, which is held in memory, and its deadline."""
GRACE_S, FLOOR = 5.0, 8 << 10
"""After `GRACE_S` a body must have arrived at `FLOOR` bytes a second on average."""
LINGER_S = 10.0
"""How long a refused request may continue to send."""


class TooSlow(Exception):
    """A body missed its deadline."""

    def __init__(self, came: int, seconds: float) -> None:
        super().__init__(
            f"received {came:,} bytes of the request's body in {seconds:.0f} s, expected at least "
            f"{FLOOR:,} bytes a second: send it again over a faster connection"
        )


class TooLarge(Exception):
    """A body exceeds its limit."""

    def __init__(self, most: int) -> None:
        super().__init__(f"a request may have at most {most:,} bytes")


class Left(Exception):
    """The client has gone."""


async def read(
    headers: Headers,
    receive: Receive,
    most: int,
    within_s: float,
    pause: Callable[[], Awaitable[object]],
) -> bytes:
    """The whole body, with a `pause` after each part but the last.

    Raises `TooLarge` beyond `most` bytes, `TooSlow` after `within_s` seconds or below `FLOOR`, and
    `Left`.
    """
    length = headers.get("content-length", "")
    if length.isdigit() and int(length) > most:
        raise TooLarge(most)
    began, body = time.monotonic(), bytearray()
    while True:
        left = began + min(within_s, GRACE_S + len(body) / FLOOR) - time.monotonic()
        try:
            async with asyncio.timeout(left):
                message = await receive()
        except TimeoutError:
            raise TooSlow(len(body), time.monotonic() - began) from None
        if message["type"] != "http.request":
            raise Left
        body += message.get("body", b"")
        if len(body) > most:
            raise TooLarge(most)
        if not message.get("more_body", False):
            return bytes(body)
        began += await _seconds(pause)


async def _seconds(pause: Callable[[], Awaitable[object]]) -> float:
    began = time.monotonic()
    await pause()
    return time.monotonic() - began


def again(body: bytes, receive: Receive) -> Receive:
    """A `receive` that gives the body that was read already, then further messages."""
    pending: list[Any] = [{"type": "http.request", "body": body, "more_body": False}]

    async def next_message() -> Message:
        return pending.pop() if pending else await receive()

    return next_message


def not_json(headers: Headers, body: bytes) -> str | None:
    """Why a body of JSON or unnamed content type is refused; None if it is not."""
    kind = headers.get("content-type", "json").partition(";")[0].strip().lower()
    if not body or not kind.endswith("json"):
        return None
    if (values := body.count(b",") + 1) > MOST_VALUES:
        return f"the body has {values:,} values, separated by commas, of at most {MOST_VALUES:,}"
    try:
        parse_json(body)
    except ValueError as error:
        return f"the body is not JSON: {error}"
    return None


def lingering(
    headers: Headers, receive: Receive, send: Send, pause: Callable[[], Awaitable[object]]
) -> Send:
    """A `send` that discards the rest of the request's body before the end of the response, with a
    `pause` after each part: a connection closed with unread bytes is reset and loses the response.
    """

    async def rest() -> None:
        while True:
            message = await receive()
            if message["type"] != "http.request" or not message.get("more_body", False):
                return
            await pause()

    async def send_then_wait(message: Message) -> None:
        last = message["type"] == "http.response.body" and not message.get("more_body", False)
        if last and "expect" not in headers:  # a client that expects 100 sends nothing yet
            await send({**message, "more_body": True})
            with suppress(TimeoutError):
                async with asyncio.timeout(LINGER_S):
                    await rest()
            message = {"type": "http.response.body", "body": b""}
        await send(message)

    return send_then_wait
