"""Frames on their way to disk: a bounded queue, so that a slow disk slows the sequence."""

from __future__ import annotations

import queue
import threading
from dataclasses import dataclass, replace

from reconstruction import CaptureWriter, Rig, Step
from reconstruction.capture.records import FrameRecord
from reconstruction.report.report import usable_cores
from stage_service.devices.cameras.interface import CameraInfo, Frame

THREADS = usable_cores() + 2
"""Threads that convert, hash and write: one per processor, one that waits for the disk's writes and
one for its flushes."""
FEWEST_STEPS, MOST_STEPS = 2, 8
SMALL_BYTES = 32 << 20


def queued_frames(rig: Rig) -> int:
    """How many frames may be queued for the disk before the sequence waits for it.

    Those of two steps, and of up to eight while they have at most `SMALL_BYTES` together: a flush
    takes nearly as long for a few small files as for many.
    """
    step = sum(12 * c.width * c.height for c in rig.cameras)  # float32 RGB
    return len(rig.cameras) * min(max(SMALL_BYTES // step, FEWEST_STEPS), MOST_STEPS)


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
    """Converts and writes frames on threads of its own; at most `capacity` are under way.

    One thread calls `put`. Frames are stored in parallel and journalled in the order of `put`: a
    crash leaves no gap and loses at most `capacity` frames.
    """

    def __init__(self, writer: CaptureWriter, capacity: int) -> None:
        self._writer = writer
        self._queue: queue.SimpleQueue[tuple[int, Shot] | None] = queue.SimpleQueue()
        self._room = threading.Semaphore(capacity)
        self._batch = max(1, capacity // 2)
        self._error: Exception | None = None
        self._stored: dict[int, FrameRecord] = {}
        self._next_put = self._next_commit = 0
        self._lock = threading.Lock()
        self._committing = False
        names = (f"frame-writer-{i}" for i in range(THREADS))
        self._threads = [threading.Thread(target=self._run, name=n, daemon=True) for n in names]
        for thread in self._threads:
            thread.start()

    def put(self, shot: Shot) -> None:
        """Queue a frame; waits while the queue is full. Raises what writing raised."""
        self._room.acquire()
        try:
            self.check()
        except Exception:
            self._room.release()
            raise
        number = self._next_put
        self._next_put += 1  # before the queue: `_next_in_order` compares with it
        self._queue.put((number, shot))

    def check(self) -> None:
        """Raise what writing raised, if it did."""
        if self._error is not None:
            raise self._error

    def close(self) -> None:
        """Write the queued frames, then stop. Raises what writing raised."""
        for _ in self._threads:
            self._queue.put(None)
        for thread in self._threads:
            thread.join()
        try:
            if not self._committing:  # no commit failed
                self._commit_in_order()
        finally:
            self.check()

    def _run(self) -> None:
        while (item := self._queue.get()) is not None:
            if self._error is not None:
                continue
            try:
                self._write(*item)
            except Exception as error:  # raised by `check`
                self._error = self._error or error
                self._room.release()  # or `put` would wait for ever

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
        with self._lock:
            self._stored[number] = record
            if self._committing:  # the committing thread takes this one, too
                return
            self._committing = True
        self._commit_in_order()

    def _commit_in_order(self) -> None:
        while batch := self._next_in_order():
            self._writer.commit(batch)
            self._room.release(len(batch))

    def _next_in_order(self) -> list[FrameRecord]:
        """The stored frames that are next, once they are half a queue or no other is under way: a
        flush delays other writes, and takes as long for many frames as for one."""
        batch = []
        with self._lock:
            many = len(self._stored) >= self._batch
            last = self._next_commit + len(self._stored) == self._next_put
            while (many or last or self._error is not None) and self._next_commit in self._stored:
                batch.append(self._stored.pop(self._next_commit))
                self._next_commit += 1
            self._committing = bool(batch)
        return batch
