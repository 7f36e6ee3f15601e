"""Progress of a running job: a small file in the model folder, and the way out of a step."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from pathlib import Path

from stage_service.jobs.records import JobProgress

FILE = "progress.json"


class JobInterrupted(BaseException):
    """A step must stop now. Not an `Exception`, so that no `except Exception` swallows it."""


class JobCancelled(JobInterrupted):
    """The user cancelled the job."""


class WorkerStopping(JobInterrupted):
    """The worker was asked to stop; the next worker takes the job up at this step."""


class StepProgress:
    """The `Progress` callback of one step: tells readers, and raises when the step must stop.

    `interrupted` is asked at most every `every` seconds and returns the exception to raise, if any.
    The file is replaced, never half written, and at most as often.
    """

    def __init__(
        self,
        folder: Path,
        job: str,
        step: str,
        steps: tuple[str, ...],
        interrupted: Callable[[], JobInterrupted | None],
        *,
        every: float = 0.2,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._path = folder / FILE
        self._job, self._step, self._steps = job, step, steps
        self._interrupted, self._every, self._clock = interrupted, every, clock
        self._last = float("-inf")

    def __call__(self, what: str, share: float) -> None:
        now = self._clock()
        if now - self._last < self._every and share < 1:
            return
        self._last = now
        stop = self._interrupted()
        if stop is not None:
            raise stop
        done = self._steps.index(self._step)
        step_share = min(max(share, 0.0), 1.0)
        progress = JobProgress(
            step=self._step,
            steps=self._steps,
            what=what,
            share=(done + step_share) / len(self._steps),
            step_share=step_share,
        )
        part = self._path.with_suffix(".part")
        part.write_text(json.dumps({"job": self._job, **progress.model_dump(mode="json")}))
        part.replace(self._path)


def read_progress(model: Path, job: str) -> JobProgress | None:
    """What `job` last said in this model folder, or None when it said nothing there."""
    try:
        data = json.loads((model / FILE).read_text())
    except FileNotFoundError:
        return None
    return JobProgress(**data) if data.pop("job") == job else None
