"""Progress of a run, and the remaining seconds as measured so far."""

from __future__ import annotations

import threading
import time
from collections import Counter, defaultdict, deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from statistics import median

from reconstruction import Step
from reconstruction.capture.records import StepKind
from stage_service.acquisition.states import Progress

NOTIFY_S = 0.2
"""Shortest interval between two progress events, so that listeners do not slow the run."""
MEASURED = 25
"""Steps of a kind, the newest, whose durations predict the next."""
ENOUGH = 3
"""Measured steps below which nothing is predicted."""


class StepDurations:
    """Seconds per step of each kind: the median of the newest, robust to a single slow step."""

    def __init__(self) -> None:
        self._took: dict[str, deque[float]] = defaultdict(lambda: deque(maxlen=MEASURED))

    def took(self, steps: Sequence[Step], seconds: float) -> None:
        """Record that these steps together took `seconds`."""
        for step in steps:
            self._took[step.kind].append(seconds / len(steps))

    def left(self, todo: Mapping[StepKind, int]) -> float | None:
        """Seconds for `todo` steps of each kind; an unmeasured kind takes the median of all. None
        while fewer than `ENOUGH` were measured."""
        known = [t for took in self._took.values() for t in took]
        if len(known) < ENOUGH:
            return None
        others = median(known)
        rates = {kind: median(took) for kind, took in self._took.items()}
        return sum(n * rates.get(kind, others) for kind, n in todo.items())


class RunProgress:
    """One run over `steps`; `frames` counts each camera's frames from before the run.

    `responded` and `came` may be called from cameras' threads, all else from one thread. `notify`
    is called with the progress, at most every `NOTIFY_S` seconds.
    """

    def __init__(
        self,
        steps: Iterable[Step],
        frames: Mapping[str, int],
        notify: Callable[[Progress], object],
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.again = 0
        self._notify, self._clock = notify, clock
        self._todo = Counter(step.kind for step in steps)
        self._lock = threading.RLock()
        self._frames = dict(frames)
        self._durations = StepDurations()
        self._done = 0
        self._step: Step | None = None
        self._here = 0
        self._run: Sequence[Step] = ()
        self._came = dict.fromkeys(frames, 0)  # in the current hardware-stepped run
        self._began = self._first_at = self._notified_at = 0.0
        self._notified: Progress | None = None

    def skip(self, steps: Iterable[Step]) -> None:
        """Count steps that were shot before this run."""
        for step in steps:
            self._count(step)

    def begin(self, step: Step) -> None:
        """The service is about to light this step."""
        with self._lock:
            self._step, self._began, self._here = step, self._clock(), 0
        self._publish()

    def responded(self) -> None:
        """One more camera has replied for the current software-stepped step."""
        with self._lock:
            self._here += 1
        self._publish()

    def arrived(self, camera: str) -> None:
        """Count a frame of the current software-stepped step."""
        with self._lock:
            self._frames[camera] += 1

    def done(self, step: Step) -> None:
        """Count a finished step."""
        with self._lock:
            if self._step is step:
                self._durations.took([step], self._clock() - self._began)
            self._count(step)
            self._here = 0
        self._publish()

    def begin_run(self, steps: Sequence[Step]) -> None:
        """The trigger box is about to clock these."""
        with self._lock:
            self._run, self._began = steps, self._clock()
            self._came = dict.fromkeys(self._frames, 0)
        self._publish()

    def came(self, camera: str) -> None:
        """Count a frame of the hardware-stepped run."""
        with self._lock:
            self._came[camera] += 1
            if self._live == 1 and self._came[camera] == 1:
                self._first_at = self._clock()
        self._publish()

    def end_run(self, kept: Mapping[str, int]) -> None:
        """End the hardware-stepped run, with the good frames of each camera."""
        with self._lock:
            if self._live:
                self._durations.took(self._run[: self._live], self._clock() - self._began)
            for camera, n in kept.items():
                self._frames[camera] += n
            self._run, self._came = (), dict.fromkeys(self._frames, 0)

    def now(self) -> Progress:
        """The present progress."""
        with self._lock:
            live = self._live
            step = self._run[min(live, len(self._run) - 1)] if self._run else self._step
            about = {} if step is None else step.to_dict()
            return Progress(
                step=self._done + live,
                **{k: about.get(k) for k in ("kind", "light", "projector", "row")},
                by_box=bool(self._run),
                frames={name: n + self._came[name] for name, n in self._frames.items()},
                here=min(self._here, len(self._frames)),
                again=self.again,
                seconds_left=self._left(live),
            )

    @property
    def _live(self) -> int:
        """Steps of the hardware-stepped run of which every camera has its frame."""
        return min(len(self._run), *self._came.values()) if self._came else 0

    def _left(self, live: int) -> float | None:
        todo = self._todo.copy()
        if live < 2:
            return self._durations.left(todo)
        each = (self._clock() - self._first_at) / (live - 1)  # without the wait for the first
        todo.subtract(step.kind for step in self._run)
        others = self._durations.left(todo)
        rest = each * todo.total() if others is None else others
        return each * (len(self._run) - live) + rest

    def _count(self, step: Step) -> None:
        with self._lock:
            self._done += 1
            self._todo[step.kind] -= 1

    def waiting(self) -> None:
        """Notify of what the interval held back."""
        self._publish()

    def _publish(self) -> None:
        with self._lock:
            now = self._clock()
            if now - self._notified_at < NOTIFY_S:
                return
            progress = self.now()
            if progress == self._notified:
                return
            self._notified_at, self._notified = now, progress
        self._notify(progress)
