"""The captures of one stage: start, steer, list. The only seam that the API's routes call."""

from __future__ import annotations

import secrets
import shutil
import threading
from collections.abc import Callable
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from reconstruction.capture_writer import CaptureWriter, utc_now
from reconstruction.mesh import Mesh
from stage_service.capture_status import CaptureStatus, read_status
from stage_service.config import RigFile
from stage_service.devices.stage import Stage
from stage_service.events import EventLog
from stage_service.plan import CapturePlan, PlanError
from stage_service.safety import blackout, off_on_exit
from stage_service.sequencer import Sequencer
from stage_service.states import WrongState

STOP_WITHIN_S = 30.0
"""A capture that is stopped at once is out of its last device call within this time."""


class Busy(RuntimeError):
    """Another capture is running; the stage makes one at a time."""

    def __init__(self, running: str) -> None:
        super().__init__(f"capture {running} is running; wait for it, or abort it first")
        self.running = running


class UnknownCapture(LookupError):
    """No capture has this id."""

    def __init__(self, capture_id: str) -> None:
        super().__init__(f"there is no capture {capture_id!r}; GET /captures lists those there are")


class CaptureManager:
    """Makes captures under `root/captures/<id>`, one at a time, each on a thread of its own.

    `on_complete(status)` is called on that thread when a capture is done with outcome "completed".
    Folders without a manifest found at the start are listed as interrupted. Constructing connects
    to nothing; `start`, `devices` and `blackout` talk to the stage.
    """

    def __init__(
        self,
        rig_file: RigFile,
        root: Path,
        on_complete: Callable[[CaptureStatus], None] | None = None,
    ) -> None:
        self.rig_file = rig_file
        self.folder = root / "captures"
        self.folder.mkdir(parents=True, exist_ok=True)
        self.events = EventLog()
        self._on_complete = on_complete
        self._lock = threading.RLock()
        self._talking = threading.Lock()
        self._running: _Run | None = None
        self._closed = False
        self._done: dict[str, CaptureStatus] = {}
        for plan in sorted(self.folder.glob("*/plan.json")):
            # a folder that is no capture, or a damaged one, must not keep the service from starting
            with suppress(ValueError, LookupError, OSError):
                self._done[plan.parent.name] = read_status(plan.parent)
        self._stay_on_exit = off_on_exit(self.close)

    def start(
        self,
        plan: CapturePlan,
        *,
        masks: dict[str, NDArray[np.bool_]] | None = None,
        head: Mesh | None = None,
        extra: dict[str, Any] | None = None,
    ) -> str:
        """Validate, create the folder, begin on a thread; returns the capture's id at once.

        `extra` is kept in `plan.json` and shown as `CaptureStatus.request`. Raises `Busy`;
        `PlanError` and `CaptureError` (masks) before any device is touched. Trouble with devices
        appears as outcome "failed" with `error`.
        """
        cost = plan.cost(self.rig_file)
        free = shutil.disk_usage(self.folder).free
        if cost.bytes > free:
            need, have = cost.bytes / 1e9, free / 1e9
            raise PlanError(
                [f"the plan writes {need:.1f} GB, {self.folder} has {have:.1f} GB free"]
            )
        with self._lock:
            if self._closed:
                raise Busy("none, but the service is closing")
            if self._running is not None:
                raise Busy(self._running.id)
            stage = Stage.of(self.rig_file)
            now = datetime.now(UTC)
            capture_id = f"{now:%Y%m%d-%H%M%S}-{secrets.token_hex(2)}"
            description = {
                "steps": list(plan.steps(self.rig_file)),
                "plan": plan.model_dump(mode="json"),
                "cost": cost.model_dump(mode="json"),
                "started": utc_now(),
                "request": extra or {},
            }
            writer = CaptureWriter.create(
                self.folder / capture_id, self.rig_file.rig, description, masks=masks, head=head
            )
            retries = plan.retries_on(self.rig_file)
            run = _Run(capture_id, stage, writer, retries, self.events)
            run.thread = threading.Thread(
                target=self._run, args=(run,), name=f"capture-{capture_id}", daemon=True
            )
            self._running = run
            run.thread.start()
        return capture_id

    def get(self, capture_id: str) -> CaptureStatus:
        """What is known about a capture. Raises `UnknownCapture`."""
        with self._lock:
            if self._running is not None and self._running.id == capture_id:
                return self._running.status()
            if capture_id not in self._done:
                raise UnknownCapture(capture_id)
            return self._done[capture_id]

    def list(self) -> list[CaptureStatus]:
        """All captures, oldest first."""
        with self._lock:
            done = [self._done[k] for k in sorted(self._done)]
            return done + ([self._running.status()] if self._running is not None else [])

    def path(self, capture_id: str) -> Path:
        """The capture's folder. Raises `UnknownCapture`."""
        return Path(self.get(capture_id).path)

    def wait(self, capture_id: str, timeout: float) -> CaptureStatus:
        """Wait until it is done, at most `timeout` seconds; returns the status either way."""
        run = self._running
        if run is not None and run.id == capture_id and run.thread is not None:
            run.thread.join(timeout)
        return self.get(capture_id)

    def pause(self, capture_id: str) -> CaptureStatus:
        """Pause at the next step boundary. Raises `UnknownCapture`, `WrongState`."""
        return self._steer(capture_id, "pause")

    def resume(self, capture_id: str) -> CaptureStatus:
        """Go on after a pause. Raises `UnknownCapture`, `WrongState`."""
        return self._steer(capture_id, "resume")

    def abort(self, capture_id: str) -> CaptureStatus:
        """Abort at the next step boundary. Raises `UnknownCapture`, `WrongState`."""
        return self._steer(capture_id, "abort")

    def devices(self) -> dict[str, Any]:
        """Per device kind: {"state": "ok" | "unreachable" | "in use", "error"?: str, figures};
        under "cameras" one such table per camera. Without a capture, connects for the answer."""
        with self._talking:
            run = self._running
            if run is not None:
                return run.sequencer.stage.status(connect=False)
            stage = Stage.of(self.rig_file)
            try:
                return stage.status(connect=True)
            finally:
                stage.close()

    def blackout(self) -> dict[str, Any]:
        """Put every lamp and projector off and read it back; a running capture ends as aborted.

        Returns {"safe": bool, "detail": str}; not safe means unknown, and is to be treated as lit.
        """
        run = self._stop()
        with self._talking:
            if run is not None and run.sequencer.blackout is not None:
                result = run.sequencer.blackout
            else:
                stage = run.sequencer.stage if run is not None else Stage.of(self.rig_file)
                try:
                    result = blackout(stage)
                finally:
                    stage.close()
        answer = {"safe": result.safe, "detail": result.detail}
        self.events.publish("stage.blackout", answer)
        return answer

    def close(self) -> None:
        """Stop what runs, lights off, wait for the thread; the manager starts nothing any more."""
        with self._lock:
            self._closed = True
        run = self._stop()
        if run is not None and run.sequencer.blackout is None:  # its thread is stuck somewhere
            blackout(run.sequencer.stage)
        self._stay_on_exit()

    def _stop(self) -> _Run | None:
        """Stop the running capture within its step, and wait until it has ended in order."""
        with self._lock:  # until `start` has started its thread
            run = self._running
        if run is None or run.thread is None:
            return None
        run.sequencer.stop_now()
        run.thread.join(STOP_WITHIN_S)
        return run

    def _steer(self, capture_id: str, action: str) -> CaptureStatus:
        with self._lock:
            status = self.get(capture_id)
            run = self._running
            if run is None or run.id != capture_id:
                raise WrongState(action, status.state)
        getattr(run.sequencer, action)()
        return self.get(capture_id)

    def _run(self, run: _Run) -> None:
        # Not while a short connection of `devices` holds a serial port.
        with self._talking:
            pass
        try:
            run.sequencer.run()
        finally:
            # `devices` may have opened the links once more after the sequencer closed them.
            with self._talking, self._lock:
                run.sequencer.stage.close()
                status = run.status()
                self._done[run.id] = status
                self._running = None
        if status.outcome == "completed" and self._on_complete is not None:
            try:
                self._on_complete(status)
            except Exception as error:  # the capture is whole; what follows it is told apart
                data = {"id": run.id, "error": f"{type(error).__name__}: {error}"}
                self.events.publish("capture.follow_up_failed", data)


class _Run:
    """The capture that is being made."""

    def __init__(
        self, capture_id: str, stage: Stage, writer: CaptureWriter, retries: int, events: EventLog
    ) -> None:
        self.id = capture_id
        self.thread: threading.Thread | None = None
        self._events = events
        self._writer = writer
        self._first = read_status(writer.path)
        self.sequencer = Sequencer(stage, writer, retries=retries, notify=self._notify)

    def status(self) -> CaptureStatus:
        sequencer = self.sequencer
        written, missing = self._writer.counts()
        return self._first.model_copy(
            update={
                "state": sequencer.state,
                "outcome": sequencer.outcome if sequencer.state == "done" else None,
                "error": sequencer.error,
                "step": sequencer.steps_done,
                "frames_written": written,
                "frames_missing": missing,
                "seconds": sequencer.seconds,
            }
        )

    def _notify(self, kind: str, data: dict[str, Any]) -> None:
        self._events.publish(kind, {"id": self.id, **data})
