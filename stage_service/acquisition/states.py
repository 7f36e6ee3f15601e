"""State and outcome of a capture: one table for the sequencer, the API and the tests."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, ValidationError

from reconstruction import Capture, CaptureError
from reconstruction.options import sentence
from reconstruction.reading import printable
from stage_service.links import check_link

State = Literal["idle", "running", "pausing", "paused", "aborting", "finishing", "done"]
Outcome = Literal["completed", "aborted", "failed", "interrupted", "damaged"]

_END: dict[str, State] = {"complete": "finishing", "fail": "finishing"}

TRANSITIONS: dict[State, dict[str, State]] = {
    "idle": {"start": "running", "abort": "aborting", "fail": "finishing"},
    "running": {"pause": "pausing", "abort": "aborting", **_END},
    "pausing": {"hold": "paused", "resume": "running", "abort": "aborting", **_END},
    "paused": {"resume": "running", "abort": "aborting", "fail": "finishing"},
    "aborting": {"abort": "aborting", "stop": "finishing", **_END},
    "finishing": {"finish": "done", "fail": "finishing"},
    "done": {"continue": "running"},
}
"""state -> action -> next state; an action that is not listed is refused.

A person requests "pause" and "abort"; "hold" and "stop" follow once the run is dark. The step under
way may complete the capture before. "continue" is a new run over the frames that an ended,
incomplete capture lacks.
"""

OUTCOMES: dict[str, Outcome] = {"complete": "completed", "stop": "aborted", "fail": "failed"}
"""The outcome that an action decides; a later failure replaces an earlier success."""


def possible(state: State, outcome: Outcome | None) -> dict[str, State]:
    """The actions that a state allows, and where they lead.

    A completed capture is over, and a damaged one cannot be read.
    """
    return {} if state == "done" and outcome in ("completed", "damaged") else TRANSITIONS[state]


REQUESTABLE = {"abort": "abort", "pause": "pause", "resume": "resume", "continue": "resume"}
"""Actions that a person may request, and the request's name; all others are the run's own."""


class WrongState(RuntimeError):
    """The state does not allow the action; the message lists what may be requested."""

    def __init__(self, action: str, state: State, outcome: Outcome | None = None) -> None:
        verbs = (REQUESTABLE[a] for a in possible(state, outcome) if a in REQUESTABLE)
        allowed = ", ".join(sorted(verbs)) or "nothing"
        known = f"{state} ({outcome})" if state == "done" and outcome else state
        super().__init__(f"cannot {action} a capture that is {known}; possible now: {allowed}")
        self.action, self.state = action, state


class CannotPause(WrongState):
    """The trigger box clocks these steps and cannot wait."""

    def __init__(self, steps: int) -> None:
        RuntimeError.__init__(
            self,
            f"cannot pause: the trigger box clocks a run of {steps} steps by itself. Pause after "
            "this run, or abort: that stops the box at once and keeps the frames of finished steps",
        )
        self.action, self.state = "pause", "running"


class Machine:
    """A state and an outcome that only change as `TRANSITIONS` allows. Not locked: the owner is."""

    def __init__(self) -> None:
        self.state: State = "idle"
        self.outcome: Outcome | None = None

    def allows(self, action: str) -> bool:
        """Whether `action` is possible now."""
        return action in possible(self.state, self.outcome)

    def do(self, action: str) -> State:
        """Move along the table; raises `WrongState` for what is not in it."""
        if not self.allows(action):
            raise WrongState(action, self.state, self.outcome)
        self.state = TRANSITIONS[self.state][action]
        self.outcome = OUTCOMES.get(action, self.outcome)
        return self.state


class Waiting(BaseModel):
    """The cameras whose frames of the current step are not there, seconds since it began, and what
    they report to be doing ("": nothing)."""

    model_config = ConfigDict(frozen=True)

    cameras: tuple[str, ...]
    seconds: int
    doing: str


class Progress(BaseModel):
    """Progress of a run: the step's light, pattern, or projector and row; `by_box`: the trigger box
    clocks.

    `step` counts steps of which all frames have arrived, `frames` each camera's frames, `here`
    cameras that have replied for the current step, `again` frames that are shot again. `waiting`
    is set when a step takes a second longer than its exposure. `share` is the share of the time
    that has passed, 0 to 1. `seconds_left` is extrapolated from measured steps of each kind and
    from what busy cameras report, without pauses: None while they are too few.
    """

    model_config = ConfigDict(frozen=True)

    step: int
    kind: str | None = None
    light: str | None = None
    pattern: str | None = None
    projector: str | None = None
    row: int | None = None
    by_box: bool = False
    frames: dict[str, int]
    here: int = 0
    again: int
    waiting: Waiting | None = None
    share: float = 0.0
    seconds_left: float | None


class CaptureStatus(BaseModel):
    """One capture: its `state`, and its `outcome` (None until it is done).

    `error` names what failed; during a pause, a device that does not reply. `step` counts finished
    steps of `steps`, `frames_missing` frames given up after all retries. `request` is the
    `extra` of `CaptureManager.start`; `progress` is set while it is shot.
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
    progress: Progress | None = None


def read_status(path: Path) -> CaptureStatus:
    """The status of a capture folder that is not being shot; interrupted without a manifest.

    An unreadable folder is "damaged", with the reason as `error`; never raises.
    """
    try:
        return _read_status(path)
    except Exception as error:  # one bad folder must not stop the service
        reason = str(error) if isinstance(error, ValueError | OSError) else repr(error)
        if isinstance(error, ValidationError):
            reason = f"plan.json or manifest.json: {sentence(error)}"
        return CaptureStatus(
            id=path.name,
            state="done",
            outcome="damaged",
            error=printable(f"{reason}; `hairstage verify {path}` lists what is wrong"),
            path=str(path),
            steps=0,
            step=0,
            frames_planned=0,
            frames_written=0,
            frames_missing=0,
            seconds_predicted=None,
            seconds=None,
            left_out=[],
            started=None,
            request={},
        )


def _read_status(path: Path) -> CaptureStatus:
    check_link(f"the capture {path.name}", path)
    capture = Capture(path)
    if capture.manifest is not None and "outcome" not in capture.manifest:
        raise CaptureError(f"{path / 'manifest.json'}: the field 'outcome' is missing")
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
