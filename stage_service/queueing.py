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
from stage_service.captures.manager import Busy, CaptureManager
from stage_service.inputs import BadInput
from stage_service.plan.resolved import resolve
from stage_service.service_models import CaptureRequest, QueueRequest, QueueView

Prepare = Callable[[QueueRequest, str | None], Callable[..., str]]


class Queueing:
    """Who may change what waits for the stage, and when the stage takes it.

    `prepare(request, armed_by)` is what starts a capture. Nothing begins by itself while another
    capture runs, the stage is latched or not known to be dark, or somebody holds the lease; after a
    blackout, an acknowledgement, an abort, or a capture that did not complete, somebody has to say
    that it may go on.
    """

    def __init__(
        self, path: Path, captures: CaptureManager, control: Control, prepare: Prepare
    ) -> None:
        self._captures, self._control, self._prepare = captures, control, prepare
        self._line = CaptureQueue(path, captures.events, self._begin, self._stage_waits_for)
        self._judged: CaptureStatus | None = None

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
        line = self._line
        waits_for = line.waits_for()
        return QueueView(held=line.held, waits_for=waits_for, waiting=line.waiting())

    def history(self, limit: int) -> list[Entry]:
        """What was started, or removed; the newest first."""
        return self._line.history(limit)

    def add(self, request: QueueRequest, by: Caller) -> Entry:
        """Let a capture wait. Raises `PlanError`, `BadInput` and `FlashRefusal` (without consent
        where one is needed) as starting it would, `Forbidden`, `QueueFull`."""
        if request.pipeline is not None:
            by.require("jobs")
        self._prepare(request, None)
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
        if armed_by is not None:
            by.require("arm")

        def begin(waiting: Entry) -> str:
            return self._shoot(waiting, armed_by, self._captures.blackouts)

        work = partial(self._line.begin, entry, begin)
        started = self._control.do(by, "queue.start", work, entry)
        self._control.record_arming(by, str(started.capture), armed_by)
        return started

    def hold(self, why: str) -> None:
        """Begin nothing by itself any more, where anything waits; asks neither disk nor device."""
        self._line.hold(why)

    def hold_by(self, by: Caller) -> QueueView:
        """Begin nothing by itself any more; anybody may."""
        work = partial(self._line.hold, f"by {by}", always=True)
        self._control.do(by, "queue.hold", work, "queue", steers=False)
        return self.view()

    def go_on(self, by: Caller) -> QueueView:
        """Begin what waits again. Raises `Leased`."""
        self._control.do(by, "queue.go_on", self._line.go_on, "queue")
        self._captures.forget_death()
        return self.view()

    def _begin(self, entry: Entry) -> str:
        since = self._captures.blackouts  # before `held`: a blackout holds first
        if self._line.held is not None:
            raise Busy("none, but the queue was held meanwhile")
        return self._shoot(entry, None, since)

    def _shoot(self, entry: Entry, armed_by: str | None, since: int) -> str:
        try:
            request = QueueRequest.model_validate(entry.request)
        except ValidationError as error:
            told = f"{entry.id} is what another version could shoot: {sentence(error)}"
            raise BadInput(told) from error
        capture = self._prepare(request, armed_by)(since, queue=entry.id)
        who = f"the queue, for {entry.by}"
        self._control.audit.record(who, "capture.start", capture, detail=then(request))
        return capture

    def _stage_waits_for(self) -> str | None:
        reason = self._captures.waits_for()
        if unread := self._captures.catalogue.unread:
            reason = f"the captures on the disk are still being read: {unread:,} to come"
        ended = self._captures.ended
        if ended is not None and ended is not self._judged:
            self._judged = ended
            if ended.outcome != "completed":
                self._line.hold(f"capture {ended.id}: {ended.outcome}")
        lease = self._control.leases.current
        if reason is None and lease is not None:
            reason = f"{lease.holder} steers the stage until {lease.expires}"
        return reason


def then(request: CaptureRequest | QueueRequest) -> str:
    """What the audit says of the job that is to follow a capture."""
    return "" if request.pipeline is None else f"{request.pipeline.name} is to follow"
