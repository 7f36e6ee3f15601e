"""The queue of captures in callers' names."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

from pydantic import ValidationError

from reconstruction.options import sentence
from stage_service.acquisition.states import CaptureStatus
from stage_service.captures.capture_queue import CaptureQueue, Entry
from stage_service.captures.control import Caller, Control
from stage_service.captures.manager import CaptureManager
from stage_service.captures.may_light import Word
from stage_service.inputs import BadInput
from stage_service.plan.resolved import resolve
from stage_service.service_models import CaptureRequest, QueueRequest, QueueView

Prepare = Callable[[QueueRequest], Callable[..., str]]


class Queueing:
    """The queue for callers. `prepare(request)` returns a function that starts the capture on a
    word.

    The table of `may_light` has what keeps the queue from starting an entry by itself. A held queue
    continues after a person who has read the reason releases the hold.
    """

    def __init__(
        self, path: Path, captures: CaptureManager, control: Control, prepare: Prepare
    ) -> None:
        self._captures, self._control, self._prepare = captures, control, prepare
        self._hold = captures.hold
        self._queue = CaptureQueue(
            path, captures.events, self._begin, captures.waits_for, captures.hold
        )

    def start(self, known: Sequence[CaptureStatus]) -> None:
        """Start the queue; `known` are the captures on the disk."""
        begun = {str(c.request["queue"]): c.id for c in known if "queue" in c.request}
        unfinished = {c.id for c in known if c.outcome != "completed"}
        self._queue.start(begun, unfinished, self._captures.died_in)

    def close(self) -> None:
        """Stop the queue."""
        self._queue.close()

    def view(self) -> QueueView:
        """The queue."""
        held = self._hold.current
        return QueueView(
            held=None if held is None else held.text,
            hold=held,
            waits_for=self._queue.waits_for(),
            waiting=self._queue.waiting(),
        )

    def history(self, limit: int) -> list[Entry]:
        """Started and removed entries, the newest first."""
        return self._queue.history(limit)

    def add(self, request: QueueRequest, by: Caller) -> Entry:
        """Queue a capture. Raises `PlanError`, `BadInput`, `FlashRefusal` (without a required
        consent), `Forbidden`, `QueueFull`."""
        if request.pipeline is not None:
            by.require("jobs")
        self._prepare(request)
        plan = resolve(request.plan, self._captures.rig_file)
        plan.check_flashing(armed_by="the person who starts it")
        kept = request.model_dump(mode="json", exclude={"place"}, exclude_defaults=True)
        flashes = plan.cost.flash.needs_consent
        work = partial(self._queue.add, kept, str(by), needs_arming=flashes, place=request.place)
        return self._control.do(by, "queue.add", work, "queue", detail=then(request), steers=False)

    def move(self, entry: str, place: int, by: Caller) -> Entry:
        """Move an entry. Raises `UnknownEntry`."""
        work = partial(self._queue.move, entry, place)
        return self._control.do(by, "queue.move", work, entry, detail=f"to {place}", steers=False)

    def remove(self, entry: str, by: Caller) -> Entry:
        """Remove an entry. Raises `UnknownEntry`."""
        work = partial(self._queue.remove, entry)
        return self._control.do(by, "queue.remove", work, entry, steers=False)

    def start_one(self, entry: str, by: Caller, armed_by: str | None) -> Entry:
        """Start an entry now, out of turn, also from a held queue. Raises `UnknownEntry`,
        `Forbidden`, and as starting a capture."""
        word = self._control.word(by, "entry", armed_by)
        work = partial(self._queue.begin, entry, partial(self._shoot, word=word))
        return self._control.do(by, "queue.start", work, entry)

    def hold(self, why: str) -> None:
        """Hold the queue; waits for neither disk nor device."""
        self._hold.set(why)

    def hold_by(self, by: Caller) -> QueueView:
        """Hold the queue; every caller may."""
        work = partial(self._hold.set, f"by {by}")
        self._control.do(by, "queue.hold", work, "queue", steers=False)
        return self.view()

    def go_on(self, hold: str, by: Caller) -> QueueView:
        """Release the hold of this id, which the caller has read. Raises `HoldChanged`,
        `Leased`."""
        held = self._hold.current
        detail = "" if held is None else f"was held: {held.text}"
        work = partial(self._hold.release, hold)
        self._control.do(by, "queue.go_on", work, "queue", detail=detail)
        self._captures.forget_death()
        return self.view()

    def _begin(self, entry: Entry) -> str:
        who, now = f"the queue, for {entry.by}", self._captures.moment()
        return self._shoot(entry, Word("queue", who=who, given=now))

    def _shoot(self, entry: Entry, word: Word) -> str:
        try:
            request = QueueRequest.model_validate(entry.request)
        except ValidationError as error:
            problem = f"{entry.id} was queued by another version: {sentence(error)}"
            raise BadInput(problem) from error
        capture = self._prepare(request)(word, queue=entry.id)
        who = f"the queue, for {entry.by}"
        self._control.audit.record(who, "capture.start", capture, detail=then(request))
        return capture


def then(request: CaptureRequest | QueueRequest) -> str:
    """The audit log's detail of the job that follows a capture."""
    return "" if request.pipeline is None else f"followed by {request.pipeline.name}"
