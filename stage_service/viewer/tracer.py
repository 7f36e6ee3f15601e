"""A process of its own in which models are viewed and their light is traced.

Tracing takes every core for seconds and cannot be interrupted, and Python computes for one thread
at a time: in the service's own process it would slow the capture. The other process
(`python -m stage_service.viewer.server`) has the lowest priority, and while a capture is shot it
stands still (SIGSTOP) unless somebody who may steer waits for it.
"""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from typing import Any

from reconstruction import CaptureError, ModelError
from stage_service.decoding import framing
from stage_service.signals import tied
from stage_service.viewer.operations import Source
from stage_service.viewer.viewed import BadLight, NothingToView

MOST_BYTES = 1 << 30
"""Of one reply: a model's strands and visibility have a hundredth of it."""
START_S, REPLY_S, END_S = 60.0, 600.0, 5.0
"""Deadlines of its start, of a reply, and of its end before it is killed."""
LOOK_S = 0.02
"""Period of the check, during a call, whether a capture is running."""
STOPPED_S = 10.0
"""A call that waits longer than this for the stopped process is refused."""
KINDS: dict[str, type[Exception]] = {
    kind.__name__: kind for kind in (NothingToView, BadLight, ModelError, CaptureError)
}
"""Errors that a reply may name; any other is a fault."""


class TracerStopped(RuntimeError):
    """It stands still for a capture, or could not be reached; the message says what to do."""

    status, retry_after = 503, 15


class Tracer:
    """The process, started when it is first needed, kept until `close`. `shooting()` says whether a
    capture is being shot. Safe to use from several threads."""

    def __init__(self, shooting: Callable[[], bool]) -> None:
        self._shooting = shooting
        self._lock = threading.Lock()
        self._process: subprocess.Popen[bytes] | None = None
        self._control: socket.socket | None = None
        self._calls: dict[socket.socket, bool] = {}
        self._stopped_since: float | None = None
        self._starter = ThreadPoolExecutor(1, "tracer-starter")
        self._watching = self._closed = False

    def do(self, source: Source, operation: str, options: dict[str, Any], *, yields: bool) -> Any:
        """What one of `OPERATIONS` makes of a model: bytes, or JSON-ready. A call that `yields`
        lets a capture go first. Raises `KINDS`, `TracerStopped`, `RuntimeError` for a fault."""
        request = {
            "model": str(source.model),
            "captures": [str(path) for path in source.captures],
            "operation": operation,
            "options": options,
        }
        with self._call(yields) as connection:
            try:
                framing.send(connection, request)
                head, parts = framing.receive(connection, MOST_BYTES, time.monotonic() + REPLY_S)
            except (OSError, EOFError, ValueError) as error:
                if yields and self._shooting():
                    raise TracerStopped(
                        "a capture is being shot: light is traced when it is over; try again then"
                    ) from None
                raise TracerStopped(
                    f"the process that views models sent no reply ({type(error).__name__}): try "
                    "again; where that does not help, the model may need more memory than there is"
                ) from error
        if (kind := head.get("kind")) is not None:
            raise KINDS.get(kind, RuntimeError)(head["error"])
        return bytes(parts[0]) if parts else head["result"]

    def close(self) -> None:
        """End the process, whatever it is at."""
        with self._lock:
            self._closed = True
            self._end()
        self._starter.shutdown(wait=False)

    @property
    def pid(self) -> int | None:
        """Of the process, while there is one."""
        return None if self._process is None else self._process.pid

    @contextmanager
    def _call(self, yields: bool) -> Iterator[socket.socket]:
        ours, theirs = socket.socketpair()
        with ours:
            with theirs, self._lock:
                self._calls[ours] = yields
                self._see_to_captures()
                for attempt in (1, 2):  # it may have ended since
                    try:
                        socket.send_fds(self._running(), [b"call"], [theirs.fileno()])
                        break
                    except OSError as error:
                        self._end()
                        if attempt == 2:
                            del self._calls[ours]
                            raise TracerStopped(f"no process can be started: {error}") from error
                if not self._watching:
                    self._watching = True
                    threading.Thread(target=self._watch, name="tracer", daemon=True).start()
            try:
                yield ours
            finally:
                with self._lock:
                    del self._calls[ours]

    def _watch(self) -> None:
        """Stop it for captures and let it go on, as long as somebody waits for it."""
        while True:
            with self._lock:
                if not self._calls or self._closed:
                    self._watching = False
                    return
                self._see_to_captures()
            time.sleep(LOOK_S)

    def _see_to_captures(self) -> None:
        """Holds the lock."""
        if self._process is None:
            return
        stop, now = self._shooting() and all(self._calls.values()), time.monotonic()
        if stop != (self._stopped_since is not None):
            with suppress(ProcessLookupError):
                os.kill(self._process.pid, signal.SIGSTOP if stop else signal.SIGCONT)
            self._stopped_since = now if stop else None
        if self._stopped_since is not None and now - self._stopped_since > STOPPED_S:
            for call in self._calls:
                with suppress(OSError):
                    call.shutdown(socket.SHUT_RDWR)

    def _running(self) -> socket.socket:
        """The way to the process, which is started where there is none. Holds the lock."""
        if self._closed:
            raise BrokenPipeError("the service is being stopped")
        if self._control is not None:
            return self._control
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        with theirs:
            module = [sys.executable, "-m", "stage_service.viewer.server"]
            # The kernel kills it when the thread that started it ends, even where it is stopped:
            # one thread that lives as long as the service. A group of its own keeps the
            # terminal's signals away; a session of its own would void its priority.
            start = self._starter.submit(
                subprocess.Popen,
                tied([*module, str(theirs.fileno())], "KILL"),
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                pass_fds=[theirs.fileno()],
                process_group=0,
            )
            self._control, self._process = ours, start.result()
        ours.settimeout(START_S)
        if not ours.recv(16):
            raise BrokenPipeError("it ended before it was ready")
        return ours

    def _end(self) -> None:
        process, self._process = self._process, None
        control, self._control = self._control, None
        self._stopped_since = None
        if control is not None:
            control.close()
        if process is not None:
            with suppress(ProcessLookupError):
                os.kill(process.pid, signal.SIGCONT)
            try:
                process.wait(END_S)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
