"""The queue of captures as the seam has it: in callers' names, and what keeps it from going on."""

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
    """Who may change what waits for the stage, and when the stage takes it.

    `prepare(request)` is what starts a capture, on a word. What keeps an entry from beginning by
    itself is in the table of `may_light`; while the queue is held, a person who has read why has to
    say that it may go on.
    """

    def __init__(
        self, path: Path, captures: CaptureManager, control: Control, prepare: Prepare
    ) -> None:
        self._captures, self._control, self._prepare = captures, control, prepare
        self._hold = captures.hold
        self._line = CaptureQueue(
            path, captures.events, self._begin, captures.waits_for, captures.hold
        )

    def start(self, known: Sequence[CaptureStatus]) -> None:
        """Begin what waits; `known` are the captures on the disk."""
        begun = {str(c.request["queue"]): c.id for c in known if "queue" in c.request}
        unfinished = {c.id for c in known if c.outcome != "completed"}
        self._line.start(begun, unfinished, self._captures.died_in)

    def close(self) -> None:
        """Begin nothing any more."""
        self._line.close()

    def view(self) -> QueueView:
        """What waits for the stage."""
        line, held = self._line, self._hold.current
        return QueueView(
            held=None if held is None else held.text,
            hold=held,
            waits_for=line.waits_for(),
            waiting=line.waiting(),
        )

    def history(self, limit: int) -> list[Entry]:
        """What was started, or removed; the newest first."""
        return self._line.history(limit)

    def add(self, request: QueueRequest, by: Caller) -> Entry:
        """Let a capture wait. Raises `PlanError`, `BadInput` and `FlashRefusal` (without consent
        where one is needed) as starting it would, `Forbidden`, `QueueFull`."""
        if request.pipeline is not None:
            by.require("jobs")
        self._prepare(request)
        plan = resolve(request.plan, self._captures.rig_file)
        plan.check_flashing(armed_by="whoever starts it")
        kept = request.model_dump(mode="json", exclude={"place"}, exclude_defaults=True)
        flashes = plan.cost.flash.needs_consent
        work = partial(self._line.add, kept, str(by), needs_arming=flashes, place=request.place)
        return self._control.do(by, "queue.add", work, "queue", detail=then(request), steers=False)

    def move(self, entry: str, place: int, by: Caller) -> Entry:
        """Put what waits at another place. Raises `UnknownEntry`."""
        work = partial(self._line.move, entry, place)
        return self._control.do(by, "queue.move", work, entry, detail=f"to {place}", steers=False)

    def remove(self, entry: str, by: Caller) -> Entry:
        """Take out what waits. Raises `UnknownEntry`."""
        work = partial(self._line.remove, entry)
        return self._control.do(by, "queue.remove", work, entry, steers=False)

    def start_one(self, entry: str, by: Caller, armed_by: str | None) -> Entry:
        """Start what waits now, out of turn, held or not; armed where it flashes. Raises
        `UnknownEntry`, `Forbidden`, and what starting a capture does."""
        word = self._control.word(by, "entry", armed_by)
        work = partial(self._line.begin, entry, partial(self._shoot, word=word))
        return self._control.do(by, "queue.start", work, entry)

    def hold(self, why: str) -> None:
        """Begin nothing by itself any more; waits for neither disk nor device."""
        self._hold.set(why)

    def hold_by(self, by: Caller) -> QueueView:
        """Begin nothing by itself any more; anybody may."""
        work = partial(self._hold.set, f"by {by}")
        self._control.do(by, "queue.hold", work, "queue", steers=False)
        return self.view()

    def go_on(self, hold: str, by: Caller) -> QueueView:
        """End the hold of this id, which the caller has read. Raises `HoldChanged`, `Leased`."""
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
            told = f"{entry.id} is what another version could shoot: {sentence(error)}"
            raise BadInput(told) from error
        capture = self._prepare(request)(word, queue=entry.id)
        who = f"the queue, for {entry.by}"
        self._control.audit.record(who, "capture.start", capture, detail=then(request))
        return capture


def then(request: CaptureRequest | QueueRequest) -> str:
    """What the audit says of the job that is to follow a capture."""
    return "" if request.pipeline is None else f"{request.pipeline.name} is to follow"
