"""Progress of a running job: a file in the model folder, and cancellation of a step."""

from __future__ import annotations

import time
from collections.abc import Callable

from reconstruction import Model
from stage_service.jobs.pipelines import SECONDS
from stage_service.jobs.records import JobProgress

EVERY_S = 0.2
"""Shortest interval between two writes of a step's progress, each with a check for cancellation."""


class JobInterrupted(BaseException):
    """A step must stop now. Not an `Exception`, so that no `except Exception` swallows it."""


class JobCancelled(JobInterrupted):
    """The user cancelled the job."""


class WorkerStopping(JobInterrupted):
    """The worker is stopping; the next worker resumes the job at this step."""


class StepProgress:
    """The `Progress` callback of one step: writes its progress, and raises when it must stop.

    The written share never decreases. `interrupted()` returns the exception to raise, or None.
    """

    def __init__(
        self,
        model: Model,
        job: str,
        step: str,
        steps: tuple[str, ...],
        interrupted: Callable[[], JobInterrupted | None],
        *,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._model = model
        self._job, self._step, self._steps = job, step, steps
        self._interrupted, self._clock = interrupted, clock
        self._last = float("-inf")
        self._share = 0.0

    def __call__(self, what: str, share: float) -> None:
        now = self._clock()
        if now - self._last < EVERY_S and share < 1:
            return
        self._last = now
        stop = self._interrupted()
        if stop is not None:
            raise stop
        seconds = [SECONDS[step] for step in self._steps]
        done = self._steps.index(self._step)
        self._share = step_share = max(self._share, min(share, 1.0))
        progress = JobProgress(
            step=self._step,
            steps=self._steps,
            what=what,
            share=(sum(seconds[:done]) + step_share * seconds[done]) / sum(seconds),
            step_share=step_share,
        )
        data = {"job": self._job, **progress.model_dump(mode="json")}
        self._model.write_json("progress.json", data, durable=False)  # five times a second


def read_progress(model: Model, job: str) -> JobProgress | None:
    """The newest progress of `job` in this model, or None."""
    try:
        data = model.json("progress.json")
        return JobProgress(**data) if data.pop("job") == job else None
    except (OSError, ValueError, TypeError, LookupError, AttributeError):
        return None
