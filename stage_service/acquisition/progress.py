"""What a run is at, and how long the rest will take by what was measured."""

from __future__ import annotations

import threading
import time
from collections import Counter, defaultdict, deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from statistics import median

from reconstruction import Step
from reconstruction.capture.folder import StepKind
from stage_service.acquisition.states import Progress

NOTIFY_S = 0.2
"""From one time that progress is told to the next, at least: who looks must not slow the run."""
MEASURED = 25
"""The newest steps of a kind tell how long the next ones take."""
ENOUGH = 3
"""So many steps must have been measured."""


class StepDurations:
    """Seconds that a step of each kind took, at the median of the newest: one that is slow because
    a camera warms up, or was shot again, says nothing of the rest."""

    def __init__(self) -> None:
        self._took: dict[str, deque[float]] = defaultdict(lambda: deque(maxlen=MEASURED))

    def took(self, steps: Sequence[Step], seconds: float) -> None:
        """These steps together took so long."""
        for step in steps:
            self._took[step.kind].append(seconds / len(steps))

    def left(self, todo: Mapping[StepKind, int]) -> float | None:
        """Seconds for so many steps of each kind; those of a kind that was not measured yet take as
        long as the others. None where too few were."""
        known = [t for took in self._took.values() for t in took]
        if len(known) < ENOUGH:
            return None
        others = median(known)
        rates = {kind: median(took) for kind, took in self._took.items()}
        return sum(n * rates.get(kind, others) for kind, n in todo.items())


class RunProgress:
    """One run over `steps`; `frames` are those of each camera that were there before it.

    Cameras' threads may say that a frame has arrived; all else is one thread's. `tell` hears of
    it, at most every `NOTIFY_S` seconds.
    """

    def __init__(
        self,
        steps: Iterable[Step],
        frames: Mapping[str, int],
        tell: Callable[[Progress], object],
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.again = 0
        self._tell, self._clock = tell, clock
        self._todo = Counter(step.kind for step in steps)
        self._lock = threading.RLock()
        self._frames = dict(frames)
        self._durations = StepDurations()
        self._done = 0
        self._step: Step | None = None
        self._here = 0
        self._run: Sequence[Step] = ()
        self._came = dict.fromkeys(frames, 0)  # of the box's run that is under way
        self._began = self._first_at = self._told_at = 0.0
        self._told: Progress | None = None

    def skip(self, steps: Iterable[Step]) -> None:
        """These were shot before this run."""
        for step in steps:
            self._count(step)

    def begin(self, step: Step) -> None:
        """The service is about to light this step."""
        with self._lock:
            self._step, self._began, self._here = step, self._clock(), 0
        self._say()

    def answered(self) -> None:
        """One more camera has, of those that the service's own step waits for."""
        with self._lock:
            self._here += 1
        self._say()

    def arrived(self, camera: str) -> None:
        """A frame of the service's own step has."""
        with self._lock:
            self._frames[camera] += 1

    def done(self, step: Step) -> None:
        """This step is over."""
        with self._lock:
            if self._step is step:
                self._durations.took([step], self._clock() - self._began)
            self._count(step)
            self._here = 0
        self._say()

    def begin_run(self, steps: Sequence[Step]) -> None:
        """The trigger box is about to clock these."""
        with self._lock:
            self._run, self._began = steps, self._clock()
            self._came = dict.fromkeys(self._frames, 0)
        self._say()

    def came(self, camera: str) -> None:
        """A frame of the box's run has arrived."""
        with self._lock:
            self._came[camera] += 1
            if self._live == 1 and self._came[camera] == 1:
                self._first_at = self._clock()
        self._say()

    def end_run(self, kept: Mapping[str, int]) -> None:
        """It is over; so many frames of each camera are good."""
        with self._lock:
            if self._live:
                self._durations.took(self._run[: self._live], self._clock() - self._began)
            for camera, n in kept.items():
                self._frames[camera] += n
            self._run, self._came = (), dict.fromkeys(self._frames, 0)

    def now(self) -> Progress:
        """Where it is."""
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
        """Steps of the box's run of which every camera has its frame."""
        return min(len(self._run), *self._came.values()) if self._came else 0

    def _left(self, live: int) -> float | None:
        todo = self._todo.copy()
        if live < 2:
            return self._durations.left(todo)
        each = (self._clock() - self._first_at) / (live - 1)  # without what the first waited for
        todo.subtract(step.kind for step in self._run)
        others = self._durations.left(todo)
        rest = each * todo.total() if others is None else others
        return each * (len(self._run) - live) + rest

    def _count(self, step: Step) -> None:
        with self._lock:
            self._done += 1
            self._todo[step.kind] -= 1

    def waiting(self) -> None:
        """The run still waits: tell what came too soon after the last time to be told."""
        self._say()

    def _say(self) -> None:
        with self._lock:
            now = self._clock()
            if now - self._told_at < NOTIFY_S:
                return
            progress = self.now()
            if progress == self._told:
                return
            self._told_at, self._told = now, progress
        self._tell(progress)
