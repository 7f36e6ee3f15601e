"""The service's side: starts the decoder's process, asks it, checks its answers."""

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
"""Until the process has loaded its libraries, on a busy machine."""
GRACE_S = 10.0
"""Beyond its own limit of seconds, until a fork that does not answer is given up."""
END_S = 5.0
WAIT_S = 30.0
"""How long a file waits for its turn."""
KEPT_ENVIRONMENT = ("PATH", "HOME", "LANG", "LC_", "LD_", "PYTHON", "TMPDIR", "DRJIT_", "TZ")
"""What the process is told of the service's environment: no tokens, no database's password."""
FEW_THREADS = {
    **dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MALLOC_ARENA_MAX"), "1"),
    "OPENCV_LOG_LEVEL": "SILENT",
}
ENDED = "it ended the process that was to decode it: it is damaged, or needs too much memory"
PNG = b"\x89PNG\r\n\x1a\n"


class Undecodable(ValueError):
    """A file that cannot be decoded, or takes more than a limit: the message names both. `kind` is
    the name of the error's class in the decoder."""

    def __init__(self, message: str, kind: str = "") -> None:
        super().__init__(message)
        self.kind = kind


class DecoderBusy(RuntimeError):
    """Other files are being decoded, or there is no process to decode in."""


class Lane:
    """Places for files of one kind: `places` at the same time, `waiting` more wait for `WAIT_S`."""

    def __init__(self, places: int, waiting: int, limits: Limits) -> None:
        self.limits = limits
        self._free, self._room = threading.Semaphore(places), threading.Semaphore(places + waiting)

    @contextmanager
    def place(self) -> Iterator[None]:
        """Have a place. Raises `DecoderBusy`."""
        if not self._room.acquire(blocking=False):
            raise DecoderBusy("too many files wait to be decoded: ask again in some seconds")
        try:
            if not self._free.acquire(timeout=WAIT_S):
                raise DecoderBusy(
                    f"other files have been decoded for {WAIT_S:g} s: ask again in some seconds"
                )
            try:
                yield
            finally:
                self._free.release()
        finally:
            self._room.release()


class Decoder:
    """Decodes files in another process, started when it is first needed, kept until `close`.

    Files of captures, files from requests and maps do not wait for each other. All methods may be
    called from any thread; they raise `Undecodable`, `DecoderBusy`, and `FileNotFoundError` for a
    path where nothing is.
    """

    def __init__(self) -> None:
        # As many frames wait as a console of many cameras asks for at once.
        self.frames = Lane(2, 24, FRAMES)
        self.given, self.maps = Lane(1, 4, GIVEN), Lane(1, 4, GIVEN)
        self._lock = threading.Lock()
        self._process: subprocess.Popen[bytes] | None = None
        self._control: socket.socket | None = None
        self._closed = False

    def start(self) -> None:
        """Start the process now, so that the first file waits for nothing."""
        with self._lock:
            self._running()

    def warm_up(self) -> None:
        """Start the process beside all else."""

        def start() -> None:
            try:
                self.start()
            except (DecoderBusy, OSError) as error:  # whoever needs it tries again, and is told
                log.warning("no decoder could be started: %s", error)

        beside(start, "decoder")

    def close(self) -> None:
        """End the process, whatever it is at."""
        with self._lock:
            self._closed = True
            self._end()

    def preview(self, file: Path, **look: Any) -> bytes:
        """A PNG of a frame, as `png_of_frame` makes it with `look`."""
        _, (png,) = self._ask(self.frames, "preview", file, str(file), look, count=1)
        if not png.startswith(PNG):
            raise Undecodable(f"{file}: the decoder answered with something that is no PNG")
        return bytes(png)

    def figures(self, file: Path) -> dict[str, Any]:
        """How a frame is exposed."""
        head, _ = self._ask(self.frames, "figures", file, str(file), {})
        return dict(head["figures"])

    def board(
        self, capture: Path, camera: str, board: Sequence[Any], calibrated: Path | None
    ) -> dict[str, Any]:
        """What a camera's lit frame in `capture` shows of a board; see `board_view`."""
        asked = {
            "camera": camera,
            "board": list(board),
            "calibrated": None if calibrated is None else str(calibrated.resolve()),
        }
        name = f"{capture}, {camera}"
        head, _ = self._ask(self.frames, "board", capture.resolve(), name, asked)
        return dict(head["board"])

    def head(self, source: Path | bytes, name: str) -> Mesh:
        """The head of an OBJ file, or of the bytes of one that is called `name`."""
        head, parts = self._ask(self.given, "head", source, name, {}, count=None)
        shapes = [("<f8", (None, 3)), ("<i8", (None, 3)), ("|b1", (None,))]
        arrays = _arrays(name, head, parts, shapes[: len(parts)])
        try:
            return Mesh(*arrays)
        except (TypeError, ValueError) as error:
            raise Undecodable(f"{name}: {error}") from error

    def mask(self, source: Path | bytes, name: str, width: int, height: int) -> Bools:
        """A hair mask `(height, width)`."""
        size = {"width": width, "height": height}
        head, parts = self._ask(self.given, "mask", source, name, size, count=1)
        return _arrays(name, head, parts, [("|b1", (height, width))])[0]

    def map_weights(
        self, data: bytes, name: str, kind: str, rotation_deg: float, lights: Sequence[Light]
    ) -> Array:
        """What each light is multiplied by to stand for an environment map: `(L, 3)`."""
        asked = {
            "kind": kind,
            "rotation_deg": rotation_deg,
            "positions": [x.position.tolist() for x in lights],
            "intensities": [x.intensity_towards(np.zeros(3)).tolist() for x in lights],
        }
        head, parts = self._ask(self.maps, "map_weights", data, name, asked, count=1)
        (weights,) = _arrays(name, head, parts, [("<f8", (len(lights), 3))])
        if not np.isfinite(weights).all():
            raise Undecodable(f"{name}: its light is not finite")
        return weights

    def _ask(
        self,
        lane: Lane,
        operation: str,
        source: Path | bytes,
        name: str,
        options: dict[str, Any],
        count: int | None = 0,
    ) -> tuple[dict[str, Any], list[bytearray]]:
        """The answer about a file that is called `name`, of `count` parts (None: any)."""
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
                with suppress(ConnectionError):  # it has ended, and says so below
                    framing.send(connection, request, [source] if isinstance(source, bytes) else [])
                head, parts = framing.receive(connection, limits.answer, deadline)
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
            raise Undecodable(f"{name}: the decoder answered with {len(parts)} parts")
        return head, parts

    @contextmanager
    def _connection(self) -> Iterator[socket.socket]:
        """A connection to a new fork. Raises `DecoderBusy`."""
        ours, theirs = socket.socketpair()
        with ours:
            with theirs, self._lock:
                for attempt in (1, 2):  # the process may have been killed meanwhile
                    try:
                        socket.send_fds(self._running(), [b"file"], [theirs.fileno()])
                        break
                    except OSError as error:
                        self._end()
                        if attempt == 2:
                            raise DecoderBusy(f"there is no decoder: {error}") from error
            yield ours

    def _running(self) -> socket.socket:
        """The way to the process, which is started where there is none. Holds the lock."""
        if self._closed:
            raise DecoderBusy("the service is being stopped: nothing is decoded any more")
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
        ours.settimeout(START_S)
        if not ours.recv(16):
            raise ConnectionError("its process ended before it was ready")
        return ours

    def _end(self) -> None:
        process, self._process = self._process, None
        control, self._control = self._control, None
        if control is not None:
            control.close()  # the process ends with it, and with the process its forks
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
    """The arrays of an answer, where each is of the type and shape (None: any length) that is
    expected."""
    found = []
    with suppress(ValueError, KeyError, TypeError):
        for told, part, (dtype, shape) in zip(head["arrays"], parts, expected, strict=True):
            size = tuple(told["shape"])
            fits = len(size) == len(shape) and all(
                isinstance(n, int) and n >= 0 and wanted in (None, n)
                for n, wanted in zip(size, shape, strict=True)
            )
            if not fits or told["dtype"] != dtype:
                break
            if math.prod(size) * np.dtype(dtype).itemsize != len(part):
                break
            found.append(np.frombuffer(part, dtype).reshape(size))
        else:
            return found
    raise Undecodable(f"{name}: the decoder answered with something else than arrays")
