"""One progress for the demo's capture and job, with the time left."""

from __future__ import annotations

import csv
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from reconstruction import Progress
from stage_service.cli.support.client import capture_work, job_progress, time_text

LOG_EVERY_S = 2.0
MOST_BY_TIME = 0.95
"""Of a step that reports no progress."""


class DemoProgress:
    """Shows, by `show`, the share of the demo's time that has passed, and the time left.

    `capture_s` and `steps_s`, see `DemoKind`, are usual durations; the run's own pace scales them.
    The rest of a capture is the service's estimate.
    """

    def __init__(
        self,
        show: Progress,
        capture_s: float,
        steps_s: Mapping[str, float],
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._show, self._clock, self._began = show, clock, clock()
        self._capture_s = capture_s
        self._steps_s = dict(steps_s)
        self._share = 0.0
        self._step: str | None = None
        self._step_at, self._pace = 0.0, 1.0
        self._log: list[tuple[float, float, float | None, str]] = []

    def capture(self, status: dict[str, Any]) -> None:
        """Show a status of the capture."""
        left = None if status["progress"] is None else status["progress"]["seconds_left"]
        if left is not None:
            pace = (self._elapsed + left) / self._capture_s
            left += pace * sum(self._steps_s.values())
        self._at(capture_work(status), left)

    def job(self, status: dict[str, Any]) -> None:
        """Show a status of the job. A step that reports no progress advances at the pace so far."""
        names, progress, now = list(self._steps_s), status["progress"], self._elapsed
        step, share = names[0], 0.0
        if progress is not None:
            step, share = progress["step"], progress["step_share"]
        what, all_s = job_progress(status)[0], sum(self._steps_s.values())
        if step not in names:
            self._at(what, 0.0)
            return
        usual_s = self._steps_s[step]
        done_s = self._capture_s + sum(self._steps_s[s] for s in names[: names.index(step)])
        if step != self._step:
            self._step, self._step_at, self._pace = step, now, now / done_s
        by_time = min((now - self._step_at) / self._pace, MOST_BY_TIME * usual_s)
        done_s += max(share * usual_s, by_time)
        self._at(what, now / done_s * (self._capture_s + all_s - done_s))

    def save(self, path: Path) -> None:
        """Write what was shown as a table, with the seconds that were left in fact, now being the
        end."""
        end = self._elapsed
        with path.open("w", newline="") as file:
            rows = csv.writer(file)
            rows.writerow(("seconds", "share", "left_estimated_s", "left_s", "what"))
            for at, share, left, what in self._log:
                estimated = "" if left is None else f"{left:.0f}"
                rows.writerow((f"{at:.0f}", f"{share:.3f}", estimated, f"{end - at:.0f}", what))

    @property
    def _elapsed(self) -> float:
        return self._clock() - self._began

    def _at(self, what: str, left: float | None) -> None:
        elapsed = self._elapsed
        if left is not None:
            self._share = max(self._share, elapsed / max(elapsed + left, 1e-9))
            what = f"{what}; {time_text(left)} left"
        self._show(what, self._share)
        if not self._log or elapsed - self._log[-1][0] >= LOG_EVERY_S:
            self._log.append((elapsed, self._share, left, what))
