"""The same call on all cameras at once."""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable, Sequence
from typing import Any, TypeVar

from stage_service.devices.cameras.interface import Camera
from stage_service.devices.errors import Cancelled

T = TypeVar("T")


class FanOut:
    """A thread per camera, for calls that wait on the network.

    Not a `ThreadPoolExecutor`: that refuses work while the interpreter exits, which is when a
    capture still has to be stopped in order.
    """

    def __init__(self, cameras: Sequence[Camera]) -> None:
        self.cameras = tuple(cameras)
        self._work: list[queue.SimpleQueue[tuple[Any, ...] | None]] = []
        for camera in self.cameras:
            work: queue.SimpleQueue[tuple[Any, ...] | None] = queue.SimpleQueue()
            self._work.append(work)
            threading.Thread(
                target=_serve, args=(camera, work), name=f"camera-{camera.name}", daemon=True
            ).start()

    def __call__(self, call: Callable[[Camera], T]) -> dict[str, T]:
        """`call(camera)` for every camera, by name, when all are done.

        Raises the error of the only camera that failed, or an `ExceptionGroup` of all that did;
        `Cancelled` only where nothing else went wrong.
        """
        answers: queue.SimpleQueue[tuple[str, T | None, Exception | None]] = queue.SimpleQueue()
        for work in self._work:
            work.put((call, answers))
        done: dict[str, T] = {}
        errors: list[Exception] = []
        for _ in self.cameras:
            name, value, error = answers.get()
            if error is not None:
                errors.append(error)
            else:
                done[name] = value  # type: ignore[assignment]
        errors = [e for e in errors if not isinstance(e, Cancelled)] or errors[:1]
        if len(errors) == 1:
            raise errors[0]
        if errors:
            raise ExceptionGroup("; ".join(str(e) for e in errors), errors)
        return {c.name: done[c.name] for c in self.cameras}

    def close(self) -> None:
        """Let the threads end."""
        for work in self._work:
            work.put(None)


def _serve(camera: Camera, work: queue.SimpleQueue[tuple[Any, ...] | None]) -> None:
    while (item := work.get()) is not None:
        call, answers = item
        try:
            answers.put((camera.name, call(camera), None))
        except Exception as error:  # handed to the caller
            answers.put((camera.name, None, error))
