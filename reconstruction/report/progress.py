"""Overall progress from the progress of stages."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager

from reconstruction.report.report import Progress, Report, Stage


def part_of(progress: Progress, begin: float, end: float) -> Progress:
    """A `Progress` whose 0 to 1 is `begin` to `end` of `progress`."""
    return lambda what, share: progress(what, begin + (end - begin) * share)


SECONDS = {
    "triangulation": 5,
    "masks": 4,
    "envelope": 4,
    "orientation": 14,
    "surface": 10,
    "lightcodes": 40,
    "depth": 65,
    "segments": 1,
    "connection": 75,
    "field": 5,
    "strands": 13,
    "refinement": 22,
    "hidden": 1,
    "roots": 3,
}
"""Relative duration of reconstruction stages: of a sweep on the demo's capture, of line stereo on a
patch of 24 cameras."""


class ReportWithProgress(Report):
    """A report that calls `progress` with the share of all stages, from 0 to 1.

    `stages` are expected in this order. Each stage reports 0 to 1, scaled to its share of the
    remaining time; skipped and unexpected stages never decrease the progress.
    """

    def __init__(self, progress: Progress, stages: Sequence[str]) -> None:
        super().__init__()
        self._progress, self._left = progress, list(stages)
        self._begin = self._end = self._done = 0.0

    @contextmanager
    def stage(self, name: str) -> Iterator[Stage]:
        """See `Report.stage`."""
        if name in self._left:
            self._left = self._left[self._left.index(name) + 1 :]
        seconds = SECONDS.get(name, 0)
        left = seconds + sum(SECONDS.get(later, 0) for later in self._left)
        self._begin = self._done = self._end
        if left:
            self._end += (1 - self._begin) * seconds / left
        self.progress(name, 0.0)
        with super().stage(name) as stage:
            yield stage

    def progress(self, what: str, share: float) -> None:
        """Report the `share` done of the stage that began last."""
        self._done = max(self._done, self._begin + (self._end - self._begin) * min(share, 1.0))
        self._progress(what, self._done)
