"""Progress of a run, and the remaining seconds as measured so far."""

from __future__ import annotations

import threading
import time
from collections import Counter, defaultdict, deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from statistics import median

from reconstruction import Step
from reconstruction.capture.records import StepKind
from stage_service.acquisition.states import Progress, Waiting
from stage_service.devices.cameras.interface import Busy

NOTIFY_S = 0.2
"""Shortest interval between two progress events, so that listeners do not slow the run."""
WAITING_S = 1.0
"""The same while only time passes, and seconds beyond a step's exposure from which its cameras are
waited for."""
MEASURED = 25
"""Steps of a kind, the newest, whose durations predict the next."""
ENOUGH = 3
"""Measured steps, of a kind or of all, below which they predict nothing."""
Alike = tuple[StepKind, float]
"""Kind and exposure of steps."""


class StepDurations:
    """Seconds of steps to come: their exposure and what a step of the kind takes beyond it.

    That is what the cameras report (`Busy.frame_s`), else the median of the newest measured steps,
    robust to a single slow one; of all kinds where fewer than `ENOUGH` of the kind were measured.
    """

    def __init__(self) -> None:
        self._beyond: dict[str, deque[float]] = defaultdict(lambda: deque(maxlen=MEASURED))
        self._reported: dict[str, float] = {}

    def took(self, steps: Sequence[Step], seconds: float) -> None:
        """Record that these steps together took `seconds`."""
        for step in steps:
            self._beyond[step.kind].append(seconds / len(steps) - step.exposure)

    def report(self, cameras: Iterable[Busy]) -> None:
        """Take the slowest of the cameras for each kind that they report."""
        found: dict[str, float] = {}
        for camera in cameras:
            for kind, seconds in camera.frame_s.items():
                found[kind] = max(found.get(kind, 0.0), seconds)
        self._reported = found or self._reported

    def left(self, todo: Mapping[Alike, int]) -> float | None:
        """Seconds for `todo` steps of each kind and exposure; None while nothing predicts them."""
        known = [t for took in self._beyond.values() for t in took]
        enough = len(known) >= ENOUGH
        if not enough and not self._reported:
            return None
        others = median(known) if enough else 0.0
        beyond = defaultdict[str, float](lambda: others)
        beyond |= {kind: median(t) for kind, t in self._beyond.items() if len(t) >= ENOUGH}
        beyond |= self._reported
        return sum(n * (exposure + beyond[kind]) for (kind, exposure), n in todo.items())


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
        self._todo = Counter(map(_alike, steps))
        self._total = self._todo.total()
        self._lock = threading.RLock()
        self._frames = dict(frames)
        self._durations = StepDurations()
        self._done = self._skipped = 0
        self._first = True  # the first step has what devices do once, and predicts none
        self._step: Step | None = None
        self._waited_for: set[str] | None = None  # in the current software-stepped step
        self._busy: Mapping[str, Busy] = {}
        self._spent = self._share = 0.0
        self._run: Sequence[Step] = ()
        self._came = dict.fromkeys(frames, 0)  # in the current hardware-stepped run
        self._began = self._first_at = self._notified_at = 0.0
        self._notified: Progress | None = None

    def skip(self, steps: Iterable[Step]) -> None:
        """Count steps that were shot before this run."""
        for step in steps:
            self._count(step)
            self._skipped += 1

    def begin(self, step: Step) -> None:
        """The service is about to light this step."""
        with self._lock:
            self._step, self._began = step, self._clock()
            self._waited_for, self._busy = set(self._frames), {}
        self._publish()

    def responded(self, camera: str) -> None:
        """The camera has replied for the current software-stepped step."""
        with self._lock:
            if self._waited_for is not None:
                self._waited_for.discard(camera)
        self._publish()

    def arrived(self, camera: str) -> None:
        """Count a frame of the current software-stepped step."""
        with self._lock:
            self._frames[camera] += 1

    def done(self, step: Step) -> None:
        """Count a finished step."""
        with self._lock:
            if self._step is step:
                seconds = self._clock() - self._began
                self._spent += seconds
                if not self._first:
                    self._durations.took([step], seconds)
                self._first = False
            self._count(step)
            self._waited_for, self._busy = None, {}
        self._publish()

    def begin_run(self, steps: Sequence[Step]) -> None:
        """The trigger box is about to clock these."""
        with self._lock:
            self._run, self._began, self._busy = steps, self._clock(), {}
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
            seconds = self._clock() - self._began
            self._spent += seconds
            if self._live:
                self._durations.took(self._run[: self._live], seconds)
            for camera, n in kept.items():
                self._frames[camera] += n
            self._run, self._came = (), dict.fromkeys(self._frames, 0)
            self._busy = {}

    def now(self) -> Progress:
        """The present progress."""
        with self._lock:
            live = self._live
            step = self._run[min(live, len(self._run) - 1)] if self._run else self._step
            about = {} if step is None else step.to_dict()
            left = self._left(live)
            return Progress(
                step=self._done + live,
                **{k: about.get(k) for k in ("kind", "light", "pattern", "projector", "row")},
                by_box=bool(self._run),
                frames={name: n + self._came[name] for name, n in self._frames.items()},
                here=0 if self._waited_for is None else len(self._frames) - len(self._waited_for),
                again=self.again,
                waiting=self._waiting(step),
                share=self._share_done(live, left),
                seconds_left=None if left is None else round(left, 1),
            )

    @property
    def _live(self) -> int:
        """Steps of the hardware-stepped run of which every camera has its frame."""
        return min(len(self._run), *self._came.values()) if self._came else 0

    @property
    def _under_way(self) -> float:
        """Seconds since the current step or run began; 0 between them."""
        idle = self._waited_for is None and not self._run
        return 0.0 if idle else self._clock() - self._began

    def _left(self, live: int) -> float | None:
        todo = self._todo.copy()
        if live >= 2:
            each = (self._clock() - self._first_at) / (live - 1)  # without the wait for the first
            todo.subtract(map(_alike, self._run))
            others = self._durations.left(todo)
            rest = each * todo.total() if others is None else others
            return each * (len(self._run) - live) + rest
        step = self._run[live] if self._run else self._step
        if step is None or (self._waited_for is None and not self._run):
            return self._durations.left(todo)
        todo[_alike(step)] -= 1
        rest_s = self._durations.left(todo)
        reported = [busy.left_s for busy in self._busy.values() if busy.left_s is not None]
        own = self._durations.left({_alike(step): 1}) or 0.0
        this = max(reported) if reported else max(own - self._under_way, 0.0)
        return None if rest_s is None else this + rest_s

    def _share_done(self, live: int, left: float | None) -> float:
        """Seconds of this run over those expected, after the share of steps shot before; of steps
        where nothing is expected. It never decreases."""
        before, spent = self._skipped / max(self._total, 1), self._spent + self._under_way
        if left is None:
            share = (self._done + live) / max(self._total, 1)
        else:
            share = before + (1 - before) * spent / max(spent + left, 1e-9)
        self._share = max(self._share, round(share, 4))
        return self._share

    def _waiting(self, step: Step | None) -> Waiting | None:
        """The cameras that the current step waits for; of a hardware-stepped run the busy ones."""
        waited_for = self._busy if self._waited_for is None else self._waited_for
        names = [c for c in self._frames if c in waited_for]
        if step is None or not names or self._under_way < step.exposure + WAITING_S:
            return None
        doing = next((busy.doing for c in names if (busy := self._busy.get(c)) and busy.doing), "")
        return Waiting(cameras=tuple(names), seconds=int(self._under_way), doing=doing)

    def _count(self, step: Step) -> None:
        with self._lock:
            self._done += 1
            self._todo[_alike(step)] -= 1

    def waiting(self, busy: Mapping[str, Busy]) -> None:
        """Record what busy cameras report; notify of what the interval held back."""
        with self._lock:
            self._busy = busy
            self._durations.report(busy.values())
        self._publish(WAITING_S)

    def _publish(self, every_s: float = NOTIFY_S) -> None:
        with self._lock:
            now = self._clock()
            if now - self._notified_at < every_s:
                return
            progress = self.now()
            if progress == self._notified:
                return
            self._notified_at, self._notified = now, progress
        self._notify(progress)


def _alike(step: Step) -> Alike:
    return step.kind, step.exposure
