"""Progress of a running job: a small file in the model folder, and the way out of a step."""

from __future__ import annotations

import time
from collections.abc import Callable

from reconstruction import Model
from stage_service.jobs.records import JobProgress

EVERY_S = 0.2
"""A step's progress is written, and whether it must stop is asked, at most this often."""


class JobInterrupted(BaseException):
    """A step must stop now. Not an `Exception`, so that no `except Exception` swallows it."""


class JobCancelled(JobInterrupted):
    """The user cancelled the job."""


class WorkerStopping(JobInterrupted):
    """The worker was asked to stop; the next worker takes the job up at this step."""


class StepProgress:
    """The `Progress` callback of one step: tells readers, and raises when the step must stop.

    The share that is told never goes back, though a step may learn that it has more to do.
    `interrupted` returns the exception to raise, if any.
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
        done = self._steps.index(self._step)
        self._share = step_share = max(self._share, min(share, 1.0))
        progress = JobProgress(
            step=self._step,
            steps=self._steps,
            what=what,
            share=(done + step_share) / len(self._steps),
            step_share=step_share,
        )
        told = {"job": self._job, **progress.model_dump(mode="json")}
        self._model.write_json("progress.json", told, durable=False)  # five times a second


def read_progress(model: Model, job: str) -> JobProgress | None:
    """What `job` last said of this model, or None where it said nothing that can be read."""
    try:
        data = model.json("progress.json")
        return JobProgress(**data) if data.pop("job") == job else None
    except (OSError, ValueError, TypeError, LookupError, AttributeError):
        return None
