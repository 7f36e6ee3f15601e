"""The renderer in a process of its own, so that the wires answer while it works."""

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
"""Until the system says how a process ended whose pipe is closed."""


class RenderError(RuntimeError):
    """The rendering process failed or ended; the message has its reason."""


class _Remote(ABC):
    """A `Responder` whose answers are made elsewhere; every call may raise `RenderError`."""

    def lights(self, camera: str) -> Response:
        """See `Responder.lights`."""
        answer: Response = self._call("lights", camera)
        return answer

    def lights_together(self, camera: str, pose: int, power: Array) -> Response:
        """See `Responder.lights_together`; `power (L,)`."""
        answer: Response = self._call("lights_together", camera, pose, power)
        return answer

    def sweep(self, camera: str, pose: int) -> dict[str, Response]:
        """See `Responder.sweep`."""
        answer: dict[str, Response] = self._call("sweep", camera, pose)
        return answer

    @abstractmethod
    def _call(self, what: str, camera: str, *args: Any) -> Any:
        """The answer of the responder's method `what`."""


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
        """End the child at once, in mid-picture if need be."""
        self._process.terminate()
        self._process.join()
        with self._lock:  # a call in the middle ends first: it finds the pipe closed at the far end
            self._ours.close()

    def _call(self, what: str, camera: str, *args: Any) -> Any:
        with self._lock:
            try:
                self._ours.send((what, (camera, *args)))
                fine, answer = self._ours.recv()
            except (OSError, EOFError) as error:
                self._process.join(_ENDED_S)  # the pipe closes before the system says why
                code = self._process.exitcode
                raise RenderError(
                    f"the rendering process ended (exit code {code}) in {what} of {camera}; its "
                    "last words are on stderr"
                ) from error
        if not fine:
            raise RenderError(str(answer))
        return answer


class RenderPool(_Remote):
    """A `Responder` of `count` processes; each camera has its own among them.

    Camera number i belongs to process i modulo `count`, as `World` deals its frames to its lanes:
    calls for cameras of different processes run at the same time.
    """

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
    """The child: answers calls until the pipe closes, which the parent's end does, too."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the group; the parent decides
    os.nice(5)  # the wires come first
    responder = make()
    while True:
        try:
            what, args = pipe.recv()
        except EOFError:
            return
        try:
            answer = (True, getattr(responder, what)(*args))
        except Exception as error:  # whatever it is, the parent tells the camera's client
            answer = (False, f"{type(error).__name__}: {error}")
        pipe.send(answer)
