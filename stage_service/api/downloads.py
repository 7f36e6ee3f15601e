"""Large responses: ranges, ETags, folders as tar files, HEAD.

RFC 9110, 13 and 14: one range a request, `If-Range`, `If-None-Match`.
"""

from __future__ import annotations

import hashlib
import os
import re
import tarfile
from bisect import bisect_right
from collections.abc import Callable, Iterator, Mapping
from contextlib import nullcontext
from itertools import accumulate
from pathlib import Path
from typing import Any, BinaryIO

from anyio import CapacityLimiter, to_thread
from fastapi.responses import Response
from starlette.datastructures import Headers
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from stage_service.api.connections import connection_of
from stage_service.api.entrance import no_place, owner_of
from stage_service.api.places import NoPlace, Places
from stage_service.api.problems import problem_response
from stage_service.api.throttle import Throttle, Turn
from stage_service.storage import InUse
from stage_service.web.headers import attachment

CHUNK = 256 << 10
"""Bytes that are read at a time; smaller responses do not count as downloads."""
READERS, OTHER_READERS = 8, 2
"""Concurrent disk reads of downloads: by callers with the scope `steer`, and by others."""
Read = Callable[[int, int], bytes]
"""Reads the bytes from one offset to before another, or fewer."""
RANGES: dict[int | str, dict[str, Any]] = {
    206: {"description": "The requested range"},
    304: {"description": "Not modified: the ETag is that of If-None-Match"},
    416: {"description": "The range is beyond the end"},
}


class Ranged(Response):
    """`size` bytes, as `read` gives them, or the requested range."""

    def __init__(
        self,
        size: int,
        read: Read,
        etag: str,
        media_type: str,
        name: str = "",
        close: Callable[[], object] = lambda: None,
    ) -> None:
        super().__init__(media_type=media_type)
        self._size, self._read, self._close = size, read, close
        del self.headers["content-length"]
        self.headers["etag"] = f'"{etag}"'
        self.headers["accept-ranges"] = "bytes"
        if name:
            self.headers["content-disposition"] = attachment(name)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Respond with 200, 206, 304 or 416, and with 429 or 503 if the caller has no place."""
        try:
            await self._respond(scope, receive, send)
        except NoPlace as error:
            await no_place(scope, error)(scope, receive, send)
        finally:
            self._close()

    async def _respond(self, scope: Scope, receive: Receive, send: Send) -> None:
        headers, etag = Headers(scope=scope), self.headers["etag"]
        known = [
            tag.strip().removeprefix("W/") for tag in headers.get("if-none-match", "").split(",")
        ]
        first, last = 0, self._size
        if etag in known or "*" in known:
            self.status_code, last = 304, 0
        elif (found := self._range(headers)) is not None:
            first, last = found
            if first >= min(last, self._size):
                detail = f"the file has {self._size} bytes"
                response = problem_response(scope["path"], "http", detail, status=416)
                response.headers["content-range"] = f"bytes */{self._size}"
                await response(scope, receive, send)
                return
            self.status_code, last = 206, min(last, self._size)
            self.headers["content-range"] = f"bytes {first}-{last - 1}/{self._size}"
        if self.status_code != 304:
            self.headers["content-length"] = str(last - first)
        start = {"type": "http.response.start", "status": self.status_code}
        places: Places = scope["app"].state.places
        large = last - first > CHUNK
        with places.holding("downloads", owner_of(scope)) if large else nullcontext():
            await send({**start, "headers": self.raw_headers})
            await self._send(first, last, scope, send)

    async def _send(self, first: int, last: int, scope: Scope, send: Send) -> None:
        """Send the bytes until the client has gone; each part but the first waits for a turn."""
        connection, owner = connection_of(scope), owner_of(scope)
        throttle: Throttle = scope["app"].state.throttle
        more = False
        while first < last and not (connection is not None and connection.gone):
            turn = await throttle.turn(owner, patient=True) if more else Turn()
            stop = min(first + CHUNK, last)
            try:
                data = await to_thread.run_sync(self._read, first, stop, limiter=_readers(scope))
            finally:
                turn.end()
            if not data:
                raise OSError(f"{scope['path']}: the file has become shorter")
            first, more = first + len(data), True
            await send({"type": "http.response.body", "body": data, "more_body": True})
        await send({"type": "http.response.body", "body": b"", "more_body": False})

    def _range(self, headers: Headers) -> tuple[int, int] | None:
        """First byte, and the one after the last; None without a valid range: everything."""
        found = re.fullmatch(r"bytes=(\d{0,18})-(\d{0,18})", headers.get("range", "").strip())
        if found is None or headers.get("if-range", self.headers["etag"]) != self.headers["etag"]:
            return None
        first, last = found.groups()
        if not first:
            return (max(0, self._size - int(last)), self._size) if last else None
        if last and int(last) < int(first):
            return None
        return int(first), int(last) + 1 if last else self._size


def file_response(file: Path, media_type: str) -> Ranged:
    """A file. Raises `InUse` if it has just been removed."""
    found = _stat(file)
    return Ranged(found.st_size, _reader(file), _etag(found), media_type)


def opened_response(file: BinaryIO, media_type: str, name: str) -> Ranged:
    """An open file, as `name`: complete even if it is removed meanwhile. It is closed
    afterwards."""
    number = file.fileno()
    found = os.fstat(number)
    return Ranged(
        found.st_size,
        lambda first, last: os.pread(number, last - first, first),
        _etag(found),
        media_type,
        name,
        file.close,
    )


def tar_response(name: str, files: Mapping[str, Path]) -> Ranged:
    """Files by their names in the archive, as `name`.tar. Raises `InUse` for a removed one."""
    tar = _Tar(name, files)
    return Ranged(tar.size, tar.read, tar.etag, "application/x-tar", f"{name}.tar")


class _Tar:
    """An uncompressed tar file that is generated while it is sent, with known offsets."""

    def __init__(self, name: str, files: Mapping[str, Path]) -> None:
        digest = hashlib.sha256()
        self._parts: list[tuple[int, Read]] = []
        for relative, path in files.items():
            found = _stat(path)
            entry = tarfile.TarInfo(f"{name}/{relative}")
            entry.size, entry.mtime, entry.mode = found.st_size, int(found.st_mtime), 0o640
            head = entry.tobuf(tarfile.GNU_FORMAT)
            digest.update(head + str(found.st_mtime_ns).encode())
            self._part(len(head), _fixed(head))
            self._part(found.st_size, _reader(path))
            self._part(-found.st_size % tarfile.BLOCKSIZE, _zeros)
        self._part(2 * tarfile.BLOCKSIZE, _zeros)
        self._ends = list(accumulate(size for size, _ in self._parts))
        self.size, self.etag = self._ends[-1], digest.hexdigest()

    def _part(self, size: int, read: Read) -> None:
        self._parts.append((size, read))

    def read(self, first: int, last: int) -> bytes:
        """The bytes from `first` to before `last`."""
        return b"".join(self._pieces(first, last))

    def _pieces(self, first: int, last: int) -> Iterator[bytes]:
        part = bisect_right(self._ends, first)
        while first < last:
            size, read = self._parts[part]
            begin = self._ends[part] - size
            stop = min(last, self._ends[part])
            data = read(first - begin, stop - begin)
            if len(data) < stop - first:
                raise OSError("a file has become shorter while it was sent")
            yield data
            first, part = stop, part + 1


def _etag(found: os.stat_result) -> str:
    return f"{found.st_mtime_ns:x}-{found.st_size:x}-{found.st_ino:x}"


def _fixed(data: bytes) -> Read:
    return lambda first, last: data[first:last]


def _zeros(first: int, last: int) -> bytes:
    return bytes(last - first)


def _stat(file: Path) -> os.stat_result:
    try:
        return file.stat()
    except FileNotFoundError:
        raise InUse(
            f"{file.name} has just been removed by a job that writes or compresses there: repeat "
            "the request after the job"
        ) from None


def _reader(file: Path) -> Read:
    def read(first: int, last: int) -> bytes:
        with file.open("rb") as opened:
            opened.seek(first)
            return opened.read(last - first)

    return read


def _steers(scope: Scope) -> bool:
    return owner_of(scope).steers


def _readers(scope: Scope) -> CapacityLimiter:
    state = scope["app"].state
    if not hasattr(state, "readers"):
        state.readers = {True: CapacityLimiter(READERS), False: CapacityLimiter(OTHER_READERS)}
    limiter: CapacityLimiter = state.readers[_steers(scope)]
    return limiter


class _HeadersSent(Exception):
    """The headers of a HEAD request have been sent."""


class Heads:
    """Responds to HEAD with the headers of GET."""

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass the request on, a HEAD as a GET that ends after its headers."""
        if scope["type"] != "http" or scope["method"] != "HEAD":
            await self._app(scope, receive, send)
            return

        async def without_body(message: Message) -> None:
            if message["type"] == "http.response.start":
                await send(message)
                await send({"type": "http.response.body", "body": b"", "more_body": False})
            raise _HeadersSent

        try:
            await self._app({**scope, "method": "GET"}, receive, without_body)
        except* _HeadersSent:
            pass
