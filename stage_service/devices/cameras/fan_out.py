"""The same call on all cameras at once."""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import Future, wait
from typing import Any, TypeVar

from stage_service.devices.cameras.interface import CameraDevice
from stage_service.devices.errors import Cancelled

T = TypeVar("T")
LOOK_S = 0.25
Work = queue.SimpleQueue[tuple[Callable[[CameraDevice], Any], Future[Any]] | None]


class FanOut:
    """A thread per camera, for calls that wait on the network.

    Not a `ThreadPoolExecutor`: that refuses work while the interpreter exits, when a capture still
    has to be stopped in order.
    """

    def __init__(self, cameras: Sequence[CameraDevice]) -> None:
        self.cameras = tuple(cameras)
        self._work: list[Work] = [queue.SimpleQueue() for _ in self.cameras]
        for camera, work in zip(self.cameras, self._work, strict=True):
            name = f"camera-{camera.name}"
            threading.Thread(target=_serve, args=(camera, work), name=name, daemon=True).start()

    def __call__(
        self, call: Callable[[CameraDevice], T], waiting: Callable[[], object] | None = None
    ) -> dict[str, T]:
        """`call(camera)` of every camera, by name; calls `waiting()` every `LOOK_S` seconds until
        all are done.

        Raises the error of the only camera that failed, or an `ExceptionGroup` of several;
        `Cancelled` only where there is no other error.
        """
        results = self.start(call)
        while waiting is not None and wait(results, LOOK_S).not_done:
            waiting()
        errors = [e for r in results if isinstance(e := r.exception(), Exception)]
        errors = [e for e in errors if not isinstance(e, Cancelled)] or errors[:1]
        if len(errors) == 1:
            raise errors[0]
        if errors:
            raise ExceptionGroup("; ".join(str(e) for e in errors), errors)
        return {c.name: r.result() for c, r in zip(self.cameras, results, strict=True)}

    def start(self, call: Callable[[CameraDevice], T]) -> list[Future[T]]:
        """`call(camera)` of every camera, before any later call of that camera."""
        results: list[Future[T]] = [Future() for _ in self.cameras]
        for work, result in zip(self._work, results, strict=True):
            work.put((call, result))
        return results

    def close(self) -> None:
        """Let the threads end."""
        for work in self._work:
            work.put(None)


def _serve(camera: CameraDevice, work: Work) -> None:
    while (item := work.get()) is not None:
        call, result = item
        try:
            result.set_result(call(camera))
        except Exception as error:  # raised in the caller
            result.set_exception(error)
