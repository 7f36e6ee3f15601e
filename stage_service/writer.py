"""Frames on their way to disk: a bounded queue, so that a slow disk slows the sequence."""

from __future__ import annotations

import queue
import threading
from dataclasses import dataclass, replace

from reconstruction.capture import FrameRecord, Step
from reconstruction.capture_writer import CaptureWriter
from stage_service.devices.cameras.interface import CameraInfo, Frame

THREADS = 8
"""Threads that flush side by side; a disk takes their flushes together."""


@dataclass(frozen=True, eq=False)
class Shot:
    """A frame with what it takes to write it."""

    step: Step
    camera: str
    frame: Frame
    info: CameraInfo
    pulse: int
    attempt: int


class FrameWriter:
    """Converts and writes frames on threads of its own; at most `capacity` wait.

    One thread puts. Frames are stored side by side and journalled in the order of `put`, so a
    crash leaves a capture without gaps.
    """

    def __init__(self, writer: CaptureWriter, capacity: int) -> None:
        self._writer = writer
        self._queue: queue.Queue[tuple[int, Shot] | None] = queue.Queue(capacity)
        self._error: Exception | None = None
        self._stored: dict[int, FrameRecord] = {}
        self._next_put = self._next_commit = 0
        self._storing, self._committing = threading.Lock(), threading.Lock()
        self._threads = [
            threading.Thread(target=self._run, name=f"frame-writer-{i}", daemon=True)
            for i in range(THREADS)
        ]
        for thread in self._threads:
            thread.start()

    def put(self, shot: Shot) -> None:
        """Hand over a frame; waits while the queue is full. Raises what writing raised."""
        self.check()
        self._queue.put((self._next_put, shot))
        self._next_put += 1

    def check(self) -> None:
        """Raise what writing raised, if it did."""
        if self._error is not None:
            raise self._error

    def close(self) -> None:
        """Write what waits, then stop. Raises what writing raised."""
        for _ in self._threads:
            self._queue.put(None)
        for thread in self._threads:
            thread.join()
        self.check()

    def _run(self) -> None:
        while (item := self._queue.get()) is not None:
            # After an error the queue is still emptied, or `put` would wait for ever.
            if self._error is None:
                try:
                    self._write(*item)
                except Exception as error:  # handed to the sequencer by `check`
                    self._error = error

    def _write(self, number: int, shot: Shot) -> None:
        frame, info = shot.frame, shot.info
        record = self._writer.store_frame(
            shot.step,
            shot.camera,
            frame.radiance(info),
            full_scale=frame.full_scale(info),
            count_scale=frame.count_scale(info),
        )
        record = replace(
            record,
            pulse=shot.pulse,
            block_id=frame.block_id,
            timestamp=frame.timestamp,
            attempt=shot.attempt,
        )
        with self._storing:
            self._stored[number] = record
        # Whoever commits takes along what others stored meanwhile: one flush for all of it.
        with self._committing:
            batch = []
            with self._storing:
                while self._next_commit in self._stored:
                    batch.append(self._stored.pop(self._next_commit))
                    self._next_commit += 1
            if batch:
                self._writer.commit(batch)
