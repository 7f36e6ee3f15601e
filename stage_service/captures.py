"""The captures of one stage: start, steer, list. The only seam that the API's routes call."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict

from reconstruction.mesh import Mesh
from stage_service.config import RigFile
from stage_service.events import EventLog
from stage_service.plan import CapturePlan
from stage_service.states import Outcome, State, WrongState  # noqa: F401


class CaptureStatus(BaseModel):
    """What is known about one capture: `state` says where it is, `outcome` how it ended."""

    model_config = ConfigDict(frozen=True)

    id: str
    state: State  # idle | running | paused | finishing | done
    outcome: Outcome | None  # completed | aborted | failed | interrupted; None while not done
    path: str
    error: str | None  # why it failed
    steps: int
    step: int  # steps done so far
    frames_planned: int
    frames_written: int
    frames_missing: int  # recorded as missing after all retries
    seconds_predicted: float
    seconds: float
    left_out: list[dict[str, str]]  # {"what", "why", "saved"}
    started: str | None  # UTC ISO 8601
    request: dict[str, Any]  # `extra` of start(), e.g. the pipeline asked for


class Busy(RuntimeError):
    """Another capture is running; the stage makes one at a time."""

    def __init__(self, running: str) -> None:
        super().__init__(f"capture {running} is running; wait for it, or abort it first")
        self.running = running


class UnknownCapture(LookupError):
    """No capture has this id."""


class CaptureManager:
    """Makes captures under `root/captures/<id>`, one at a time, each on its own thread.

    `on_complete(status)` is called on that thread when a capture is done with outcome "completed".
    Folders without a manifest found at the start are listed as interrupted.
    Constructing connects to nothing; `start`, `devices` and `blackout` talk to the stage.
    """

    events: EventLog

    def __init__(
        self,
        rig_file: RigFile,
        root: Path,
        on_complete: Callable[[CaptureStatus], None] | None = None,
    ) -> None: ...

    def start(
        self,
        plan: CapturePlan,
        *,
        masks: dict[str, NDArray[np.bool_]] | None = None,
        head: Mesh | None = None,
        extra: dict[str, Any] | None = None,
    ) -> str:
        """Validate, create the folder, begin on a thread; returns the capture's id at once.

        Raises `Busy`, or `PlanError` (plan.py; `.problems: list[str]`) before any device is
        touched. Device trouble appears as outcome "failed" with `error`.
        """
        raise NotImplementedError

    def get(self, capture_id: str) -> CaptureStatus:
        """Raises `UnknownCapture`."""
        raise NotImplementedError

    def list(self) -> list[CaptureStatus]:
        """All captures, oldest first."""
        raise NotImplementedError

    def path(self, capture_id: str) -> Path:
        """The capture's folder. Raises `UnknownCapture`."""
        raise NotImplementedError

    def wait(self, capture_id: str, timeout: float) -> CaptureStatus:
        """Wait until it is done, at most `timeout` seconds; returns the status either way."""
        raise NotImplementedError

    def pause(self, capture_id: str) -> CaptureStatus:
        """Pause at the next step boundary. Raises `UnknownCapture`, `WrongState`."""
        raise NotImplementedError

    def resume(self, capture_id: str) -> CaptureStatus:
        """Go on after a pause. Raises `UnknownCapture`, `WrongState`."""
        raise NotImplementedError

    def abort(self, capture_id: str) -> CaptureStatus:
        """Abort at the next step boundary. Raises `UnknownCapture`, `WrongState`."""
        raise NotImplementedError

    def devices(self) -> dict[str, Any]:
        """Per device kind: {"state": "ok" | "unreachable", "error"?: str, more figures}."""
        raise NotImplementedError

    def blackout(self) -> dict[str, Any]:
        """All lamps and projectors off, verified; aborts a running capture.

        {"safe": bool, "detail": str}
        """
        raise NotImplementedError

    def close(self) -> None:
        """Abort what runs, lights off, wait for the thread."""
        raise NotImplementedError
