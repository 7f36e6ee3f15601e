"""May light be put on now, and off at once: all that concerns lamps and no capture folder."""

from __future__ import annotations

import threading
from abc import ABC, abstractmethod
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from stage_service.acquisition.safety import blackout
from stage_service.acquisition.states import CaptureStatus, State
from stage_service.captures.capture_run import CaptureRun
from stage_service.captures.hold import STARTED, Hold
from stage_service.captures.may_light import Facts, Moment, Word, check
from stage_service.captures.stage import Stage, unknown
from stage_service.config import RigFile
from stage_service.plan.flash import FlashRefusal
from stage_service.plan.resolved import ResolvedPlan
from stage_service.records.audit import AuditLog
from stage_service.records.clock import boot_seconds
from stage_service.records.events import EventLog
from stage_service.records.lease import Leases, RootLock

STOP_WITHIN_S = 3.0
"""Seconds that the end of the service waits until a running capture is read back dark."""
TIDY_S = 1.0
"""Seconds that a blackout, once dark, waits for the capture's folder to be finished."""
GIVEN_UP_S = 5.0
"""A blackout ends within this time, or three times the slowest timeout_s of the devices."""
LATE_AFTER_S = 1.0
"""After this time a blackout that is not read back dark is published as unknown."""
UNREAD = "a blackout is under way: not every lamp and projector has been read back dark yet"


class LightControl(ABC):
    """One service's stage: every way to a lamp passes `_check`, and `blackout` revokes all of them.

    Raises `RootInUse` while another process uses this root, `StageInUse` while one on this machine
    has the stage; `take_over`: the service of another machine that has it is dead.
    """

    def __init__(self, rig_file: RigFile, root: Path, *, take_over: bool) -> None:
        self.rig_file = rig_file
        self._root_lock = RootLock(root)
        self.audit, self.events = AuditLog(root / "audit.jsonl"), EventLog()
        self.hold = Hold(self.events, _started(self._root_lock.left_by))
        self._lock = threading.RLock()  # held briefly, never during a wait for device or disk
        self._running: CaptureRun | None = None
        self._preparing: str | None = None
        self._revocations = 0
        self._closed = False
        self._darkening = 0  # blackouts under way
        self._unread = 0  # of these, those without every device's reply
        try:
            self.leases = Leases(root / "lease.json")
            self.stage = Stage(
                rig_file,
                root,
                self.audit,
                self.events,
                lambda: self._running is not None,
                self._revoke,
                take_over=take_over,
            )
        except BaseException:
            self._root_lock.release()
            raise

    @property
    @abstractmethod
    def unlisted(self) -> int:
        """Captures on the disk that have not been read yet; may wait for the disk."""

    def moment(self) -> Moment:
        """The present moment, for a word that is given now."""
        return Moment(self._revocations, boot_seconds())

    def _stamped(self, word: Word) -> Word:
        return word if word.given is not None else replace(word, given=self.moment())

    def _check(self, word: Word, plan: ResolvedPlan | None = None, own: str | None = None) -> None:
        """Raise what the table refuses the word for; `own` is the word's own capture."""
        flashes, given = None, word.given or self.moment()
        if plan is not None:
            try:
                plan.check_flashing(word.armed_by)
            except FlashRefusal as error:
                flashes = error
        unlisted = self.unlisted if word.way == "queue" else 0
        with self._lock:
            current = self._current
            facts = Facts(
                closing=self._closed,
                darkening=self._darkening > 0,
                revoked=given.revocations != self._revocations,
                stale=boot_seconds() - given.at,
                running=None if current == own else current,
                latched=self.stage.latch.latched,
                unknown=not self.stage.known_dark,
                unread=unlisted,
                leased=self.leases.of_others(word.lease),
                held=self.hold.current,
                flashes=flashes,
            )
        check(word.way, facts)

    def _revoke(self, why: str) -> None:
        """Refuse light on every word that was given until now."""
        with self._lock:
            self._revocations += 1
            if self._running is not None:
                self._running.permission.revoke(why)

    @property
    def _current(self) -> str | None:
        """The id of the capture that runs or is being prepared."""
        return self._preparing if self._running is None else self._running.id

    @property
    def running(self) -> str | None:
        """The id of the running capture; reads neither disk nor device."""
        run = self._running
        return None if run is None else run.id

    @property
    def running_state(self) -> State:
        """The state of the running capture; "idle" without one."""
        run = self._running
        return "idle" if run is None else while_running(run.status()).state

    def waits_for(self) -> str | None:
        """What keeps the queue from starting a capture by itself; None: nothing."""
        try:
            self._check(Word("queue"))
        except RuntimeError as error:
            return str(error)
        return None

    def not_dark(self) -> str | None:
        """Why the lamps' state refuses every capture; None where it does not.

        A bank without read-back, where that is accepted, refuses none.
        """
        known = self.safety()
        if known["state"] != "unknown, unsafe":
            return None
        return None if known["accepted"] else str(known["detail"])

    def safety(self) -> dict[str, Any]:
        """The lamps' present state: {"state", "detail", "latched", "accepted"}."""
        run = self._running
        if self._unread:
            return unknown(UNREAD, self.stage.darkness()["latched"])
        if run is None or self.stage.latch.latched is not None:  # then the run hangs
            return self.stage.darkness()
        known = {"state": "in use", "detail": f"capture {run.id} runs"}
        return {**known, "latched": None, "accepted": False}

    def blackout(self) -> dict[str, Any]:
        """Put every lamp and projector off and read it back; a running capture ends as aborted.

        Returns {"safe": bool, "state": "dark" | "unknown, unsafe", "detail": str}; treat "unknown"
        as lit. Waits for no disk, no camera and no status query. Until it ends, `safety` is
        "unknown, unsafe", which is published after `LATE_AFTER_S`.
        """
        devices = self.stage.devices
        with self._lock:
            self._darkening += 1  # refuses every start until it ends
            self._unread += 1
            run = self._running
            self._revoke("the stage was put dark")
        publish = partial(self.events.publish, "stage.lamps")
        late = threading.Timer(LATE_AFTER_S, lambda: publish(self.safety()))
        late.daemon = True
        try:
            with suppress(RuntimeError):  # no thread available
                late.start()
            within_s = max(GIVEN_UP_S, 3 * devices.slowest_s)
            try:
                if run is not None:
                    result = run.sequencer.darken(within_s)
                else:
                    result = blackout(devices, within_s=within_s)
            finally:
                late.cancel()
                if late.ident is not None:
                    late.join()  # its event precedes the result
                with self._lock:
                    self._unread -= 1
            self.stage.learn(result)
            if run is not None and run.thread is not None:
                run.thread.join(TIDY_S)
        finally:
            with self._lock:
                self._darkening -= 1
                alone = self._darkening == 0 and self._running is None
            if alone:
                devices.close_lit()
        answer = result.to_dict()
        self.events.publish("stage.blackout", answer)
        return answer

    def _stop(self) -> None:
        """Refuse light for good, and end the running capture dark."""
        with self._lock:
            self._closed = True
            run = self._running
            self._revoke("the service is closing")
        if run is not None and run.thread is not None:
            result = run.sequencer.darken(STOP_WITHIN_S)
            run.thread.join(TIDY_S)
            if run.thread.is_alive():  # it hangs
                self.stage.learn(result)
            else:  # `darken` may have opened links after the run had closed them
                self.stage.devices.close_lit()


def while_running(status: CaptureStatus) -> CaptureStatus:
    """The status of a run whose thread has not ended: nothing else can start before."""
    if status.state != "done":
        return status
    return status.model_copy(update={"state": "finishing", "outcome": None})


def _started(left_by: str | None) -> str:
    """Why the queue is held since the service started."""
    if left_by is None:
        return STARTED
    return f"{STARTED}; the one before it (process {left_by}) was killed or died"
