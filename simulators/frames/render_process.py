"""The renderer in a separate process, so that the devices respond meanwhile."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from multiprocessing.connection import Connection
from typing import Any

from reconstruction.arrays import Array
from simulators.frames.responses import Responder, Response

_ENDED_S = 5.0
"""Seconds until the exit code of a process with a closed pipe is available."""


class RenderError(RuntimeError):
    """The rendering process failed or ended; the message has the reason."""


class _Remote(ABC):
    """A `Responder` in another process; every call may raise `RenderError`."""

    def lights(self, camera: str) -> Response:
        """See `Responder.lights`."""
        response: Response = self._call("lights", camera)
        return response

    def lights_together(self, camera: str, pose: int, power: Array) -> Response:
        """See `Responder.lights_together`; `power (L,)`."""
        response: Response = self._call("lights_together", camera, pose, power)
        return response

    def sweep(self, camera: str, pose: int) -> dict[str, Response]:
        """See `Responder.sweep`."""
        responses: dict[str, Response] = self._call("sweep", camera, pose)
        return responses

    @abstractmethod
    def _call(self, what: str, camera: str, *args: Any) -> Any:
        """The result of the responder's method `what`."""


class RenderProcess(_Remote):
    """A `Responder` in a child process, made there by `make()`.

    `make` and what it holds must be picklable. Calls from several threads wait for each other.
    """

    def __init__(self, make: Callable[[], Responder]) -> None:
        context = multiprocessing.get_context("spawn")
        self._ours, theirs = context.Pipe()
        self._process = context.Process(
            target=_serve, args=(theirs, make), name="simulators renderer", daemon=True
        )
        self._process.start()
        theirs.close()
        self._lock = threading.Lock()

    def stop(self) -> None:
        """End the child at once."""
        self._process.terminate()
        self._process.join()
        with self._lock:  # a call under way ends first, on the closed pipe
            self._ours.close()

    def _call(self, what: str, camera: str, *args: Any) -> Any:
        with self._lock:
            try:
                self._ours.send((what, (camera, *args)))
                fine, result = self._ours.recv()
            except (OSError, EOFError) as error:
                self._process.join(_ENDED_S)  # the pipe closes before the exit code is available
                code = self._process.exitcode
                raise RenderError(
                    f"the rendering process ended (exit code {code}) in {what} of {camera}: see "
                    "its "
                    "output on stderr"
                ) from error
        if not fine:
            raise RenderError(str(result))
        return result


class RenderPool(_Remote):
    """A `Responder` of `count` processes. Camera number i belongs to process i modulo `count`, as
    in `World`; calls for cameras of different processes run at the same time."""

    def __init__(self, make: Callable[[], Responder], cameras: Sequence[str], count: int) -> None:
        self._processes = [RenderProcess(make) for _ in range(min(count, len(cameras)))]
        self._lane = {name: i % len(self._processes) for i, name in enumerate(cameras)}

    def stop(self) -> None:
        """End all processes at once."""
        for process in self._processes:
            process.stop()

    def _call(self, what: str, camera: str, *args: Any) -> Any:
        return self._processes[self._lane[camera]]._call(what, camera, *args)


def _serve(pipe: Connection, make: Callable[[], Responder]) -> None:
    """The child: serves calls until the pipe is closed."""
    signal.signal(
        signal.SIGINT, signal.SIG_IGN
    )  # Ctrl-C reaches the group; the parent ends the child
    os.nice(5)  # the devices come first
    responder = make()
    while True:
        try:
            what, args = pipe.recv()
        except EOFError:
            return
        try:
            result = (True, getattr(responder, what)(*args))
        except Exception as error:  # the camera's client gets the message
            result = (False, f"{type(error).__name__}: {error}")
        pipe.send(result)
