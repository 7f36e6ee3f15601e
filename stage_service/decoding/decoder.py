"""Client of the decoder's process: starts it, sends requests, validates responses."""

from __future__ import annotations

import logging
import math
import os
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from reconstruction import Light, Mesh
from reconstruction.arrays import Array, Bools
from reconstruction.reading import printable
from stage_service.background import beside
from stage_service.decoding import framing
from stage_service.decoding.limits import FRAMES, GIVEN, Limits

log = logging.getLogger("hairstage.decoding")
START_S = 60.0
"""Deadline for the process to load its libraries."""
GRACE_S = 10.0
"""Seconds beyond a fork's own limit until it is given up."""
END_S = 5.0
WAIT_S = 30.0
"""Seconds that a file waits for its turn."""
KEPT_ENVIRONMENT = ("PATH", "HOME", "LANG", "LC_", "LD_", "PYTHON", "TMPDIR", "DRJIT_", "TZ")
"""Environment variables passed to the process: no tokens, no database password."""
FEW_THREADS = {
    **dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MALLOC_ARENA_MAX"), "1"),
    "OPENCV_LOG_LEVEL": "SILENT",
}
ENDED = "decoding it crashed: the file is damaged, or needs too much memory"
PNG = b"\x89PNG\r\n\x1a\n"


class Undecodable(ValueError):
    """A file that cannot be decoded or exceeds a limit; the message names file and reason. `kind`
    is the class name of the decoder's error."""

    def __init__(self, message: str, kind: str = "") -> None:
        super().__init__(message)
        self.kind = kind


class DecoderBusy(RuntimeError):
    """Other files are being decoded, or the process cannot be started."""


class Lane:
    """A queue of files of one kind: `places` at a time, `waiting` more wait up to `WAIT_S`."""

    def __init__(self, places: int, waiting: int, limits: Limits) -> None:
        self.limits = limits
        self._free, self._room = threading.Semaphore(places), threading.Semaphore(places + waiting)

    @contextmanager
    def place(self) -> Iterator[None]:
        """Hold a place. Raises `DecoderBusy`."""
        if not self._room.acquire(blocking=False):
            raise DecoderBusy(
                "too many files are waiting to be decoded: repeat the request in some seconds"
            )
        try:
            if not self._free.acquire(timeout=WAIT_S):
                raise DecoderBusy(
                    f"no decoder was free within {WAIT_S:g} s: repeat the request in some seconds"
                )
            try:
                yield
            finally:
                self._free.release()
        finally:
            self._room.release()


class Decoder:
    """Decodes files in another process, started when it is first needed, kept until `close`.

    Files of captures, files from requests and maps do not wait for each other. Methods may be
    called from any thread; they raise `Undecodable`, `DecoderBusy`, and `FileNotFoundError` for a
    missing path.
    """

    def __init__(self) -> None:
        # a console requests the frames of all cameras at once
        self.frames = Lane(2, 24, FRAMES)
        self.given, self.maps = Lane(1, 4, GIVEN), Lane(1, 4, GIVEN)
        self._lock = threading.Lock()
        self._process: subprocess.Popen[bytes] | None = None
        self._starting: subprocess.Popen[bytes] | None = None
        self._control: socket.socket | None = None
        self._closed = False

    def start(self) -> None:
        """Start the process now."""
        with self._lock:
            self._running()

    def warm_up(self) -> None:
        """Start the process in the background."""

        def start() -> None:
            try:
                self.start()
            except (DecoderBusy, OSError) as error:  # the next request tries again
                log.warning("no decoder could be started: %s", error)

        beside(start, "decoder")

    def close(self) -> None:
        """End the process at once."""
        self._closed = True
        while not self._lock.acquire(timeout=0.05):
            if (process := self._starting) is not None:
                process.kill()  # it is loading libraries, and holds the lock until it is ready
        try:
            self._end()
        finally:
            self._lock.release()

    def preview(self, file: Path, **look: Any) -> bytes:
        """A PNG of a frame, as `png_of_frame` makes it with `look`."""
        _, (png,) = self._request(self.frames, "preview", file, str(file), look, count=1)
        if not png.startswith(PNG):
            raise Undecodable(f"{file}: the decoder returned no PNG")
        return bytes(png)

    def figures(self, file: Path) -> dict[str, Any]:
        """Exposure and sharpness of a frame."""
        head, _ = self._request(self.frames, "figures", file, str(file), {})
        return dict(head["figures"])

    def board(
        self, capture: Path, camera: str, board: Sequence[Any], calibrated: Path | None
    ) -> dict[str, Any]:
        """The board in a camera's lit frame of `capture`; see `board_view`."""
        options = {
            "camera": camera,
            "board": list(board),
            "calibrated": None if calibrated is None else str(calibrated.resolve()),
        }
        name = f"{capture}, {camera}"
        head, _ = self._request(self.frames, "board", capture.resolve(), name, options)
        return dict(head["board"])

    def head(self, source: Path | bytes, name: str) -> Mesh:
        """The head of an OBJ file, given as a path or as bytes with a `name`."""
        head, parts = self._request(self.given, "head", source, name, {}, count=None)
        shapes = [("<f8", (None, 3)), ("<i8", (None, 3)), ("|b1", (None,))]
        arrays = _arrays(name, head, parts, shapes[: len(parts)])
        try:
            return Mesh(*arrays)
        except (TypeError, ValueError) as error:
            raise Undecodable(f"{name}: {error}") from error

    def mask(self, source: Path | bytes, name: str, width: int, height: int) -> Bools:
        """A hair mask `(height, width)`."""
        size = {"width": width, "height": height}
        head, parts = self._request(self.given, "mask", source, name, size, count=1)
        return _arrays(name, head, parts, [("|b1", (height, width))])[0]

    def map_weights(
        self, data: bytes, name: str, kind: str, rotation_deg: float, lights: Sequence[Light]
    ) -> Array:
        """Weights `(L, 3)` of the lights that represent an environment map."""
        options = {
            "kind": kind,
            "rotation_deg": rotation_deg,
            "positions": [x.position.tolist() for x in lights],
            "intensities": [x.intensity_towards(np.zeros(3)).tolist() for x in lights],
        }
        head, parts = self._request(self.maps, "map_weights", data, name, options, count=1)
        (weights,) = _arrays(name, head, parts, [("<f8", (len(lights), 3))])
        if not np.isfinite(weights).all():
            raise Undecodable(f"{name}: its radiance is not finite")
        return weights

    def _request(
        self,
        lane: Lane,
        operation: str,
        source: Path | bytes,
        name: str,
        options: dict[str, Any],
        count: int | None = 0,
    ) -> tuple[dict[str, Any], list[bytearray]]:
        """The response about a file called `name`, of `count` parts (None: any)."""
        limits = lane.limits
        path = str(source.absolute()) if isinstance(source, Path) else None
        request = {
            "operation": operation,
            "name": name,
            "path": path,
            "options": options,
            "limits": [limits.memory, limits.cpu_s, limits.wall_s],
        }
        with lane.place(), self._connection() as connection:
            deadline = time.monotonic() + limits.wall_s + GRACE_S
            connection.settimeout(limits.wall_s + GRACE_S)
            try:
                with suppress(ConnectionError):  # it has ended: reported below
                    framing.send(connection, request, [source] if isinstance(source, bytes) else [])
                head, parts = framing.receive(connection, limits.response, deadline)
                right = count is None or len(parts) == count
            except TimeoutError:
                raise Undecodable(f"{name}: {limits.exceeded('clock')}: it is not read") from None
            except (EOFError, OSError, ValueError, LookupError, TypeError, AttributeError):
                raise Undecodable(f"{name}: {ENDED}") from None
        if "limit" in head:
            raise Undecodable(f"{name}: {limits.exceeded(str(head['limit']))}: it is not read")
        if "ended" in head:
            raise Undecodable(f"{name}: {ENDED}: {head['ended']}")
        if "error" in head:
            text, kind = printable(str(head["error"])), str(head.get("kind", ""))
            gone = kind == "FileNotFoundError"
            raise FileNotFoundError(text) if gone else Undecodable(text, kind)
        if not right:
            raise Undecodable(f"{name}: the decoder returned {len(parts)} parts, expected {count}")
        return head, parts

    @contextmanager
    def _connection(self) -> Iterator[socket.socket]:
        """A connection to a new fork. Raises `DecoderBusy`."""
        ours, theirs = socket.socketpair()
        with ours:
            with theirs, self._lock:
                for attempt in (1, 2):  # it may have been killed meanwhile
                    try:
                        socket.send_fds(self._running(), [b"file"], [theirs.fileno()])
                        break
                    except OSError as error:
                        self._end()
                        if attempt == 2:
                            raise DecoderBusy(f"the decoder cannot be started: {error}") from error
            yield ours

    def _running(self) -> socket.socket:
        """The socket of the process, which is started if necessary. Call with the lock held."""
        if self._closed:
            raise DecoderBusy("the service is stopping")
        if self._control is not None:
            return self._control
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        with theirs:
            command = [sys.executable, "-m", "stage_service.decoding.server", str(theirs.fileno())]
            self._control, self._process = (
                ours,
                subprocess.Popen(
                    command,
                    stdin=subprocess.DEVNULL,
                    stdout=subprocess.DEVNULL,
                    stderr=subprocess.DEVNULL,
                    pass_fds=[theirs.fileno()],
                    env=_environment(),
                    start_new_session=True,
                ),
            )
        self._starting = self._process
        ours.settimeout(START_S)
        try:
            if not ours.recv(16):
                raise ConnectionError("its process ended before it was ready")
        finally:
            self._starting = None
        return ours

    def _end(self) -> None:
        process, self._process = self._process, None
        control, self._control = self._control, None
        if control is not None:
            control.close()  # ends the process and its forks
        if process is not None:
            try:
                process.wait(END_S)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()


def _environment() -> dict[str, str]:
    kept = {k: v for k, v in os.environ.items() if k.startswith(KEPT_ENVIRONMENT)}
    return {**kept, **FEW_THREADS}


def _arrays(
    name: str,
    head: dict[str, Any],
    parts: list[bytearray],
    expected: Sequence[tuple[str, tuple[int | None, ...]]],
) -> list[NDArray[Any]]:
    """The arrays of a response, checked for the expected types and shapes (None: any length)."""
    found = []
    with suppress(ValueError, KeyError, TypeError):
        for described, part, (dtype, shape) in zip(head["arrays"], parts, expected, strict=True):
            size = tuple(described["shape"])
            fits = len(size) == len(shape) and all(
                isinstance(n, int) and n >= 0 and wanted in (None, n)
                for n, wanted in zip(size, shape, strict=True)
            )
            if not fits or described["dtype"] != dtype:
                break
            if math.prod(size) * np.dtype(dtype).itemsize != len(part):
                break
            found.append(np.frombuffer(part, dtype).reshape(size))
        else:
            return found
    raise Undecodable(f"{name}: the decoder returned no valid arrays")
