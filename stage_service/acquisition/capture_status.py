"""What is known about a capture, while it is made and from its folder afterwards."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict

from reconstruction import Capture
from stage_service.acquisition.states import Outcome, State


class CaptureStatus(BaseModel):
    """One capture: `state` says where it is, `outcome` how it ended (None while it is not done).

    `step` counts steps done of `steps`; `frames_missing` counts frames given up after all
    retries; `request` is what was given to `CaptureManager.start` as `extra`.
    """

    model_config = ConfigDict(frozen=True)

    id: str
    state: State
    outcome: Outcome | None
    error: str | None
    path: str
    steps: int
    step: int
    frames_planned: int
    frames_written: int
    frames_missing: int
    seconds_predicted: float | None
    seconds: float | None
    left_out: list[dict[str, str]]
    started: str | None
    request: dict[str, Any]


def read_status(path: Path) -> CaptureStatus:
    """The status of a capture folder that nobody is shooting: done, interrupted without manifest.

    Raises `CaptureError` where the folder is no capture.
    """
    capture = Capture(path)
    manifest, plan = capture.manifest, capture.plan
    written = {r.step for r in capture.records.values()}
    cost = plan.get("cost", {})
    return CaptureStatus(
        id=path.name,
        state="done",
        outcome="interrupted" if manifest is None else manifest["outcome"],
        error=None if manifest is None else manifest.get("error"),
        path=str(path),
        steps=len(capture.steps),
        step=len(written),
        frames_planned=len(capture.steps) * len(capture.rig.cameras),
        frames_written=sum(r.file is not None for r in capture.records.values()),
        frames_missing=sum(r.file is None for r in capture.records.values()),
        seconds_predicted=cost.get("seconds"),
        seconds=None if manifest is None else manifest.get("seconds"),
        left_out=cost.get("left_out", []),
        started=plan.get("started"),
        request=plan.get("request", {}),
    )
