"""The devices of one stage between captures: who has them, what they said, what is lit."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cached_property
from pathlib import Path
from typing import Any

from stage_service.acquisition.safety import Blackout, blackout
from stage_service.captures.latch import Latch
from stage_service.config import RigFile
from stage_service.devices.cached_status import CachedStatus
from stage_service.devices.device_set import DeviceSet
from stage_service.devices.ownership import Ownership, StageInUse
from stage_service.records.audit import SERVICE, AuditLog
from stage_service.records.events import EventLog


def unknown(detail: str, latched: str | None) -> dict[str, Any]:
    """What `Stage.darkness` tells where nobody knows, and nobody accepts that."""
    state = {"state": "unknown, unsafe", "detail": detail}
    return {**state, "latched": latched, "accepted": False}


def put_off(rig_file: RigFile, root: Path, *, take_over: bool = False) -> str:
    """Put a stage off whose service cannot have its `root`; what came of it, in words.

    Touches nothing where another service has the stage.
    """
    if rig_file.devices is None:
        return "the rig file names no devices"
    devices = DeviceSet.of(rig_file)
    try:
        ownership = Ownership(devices.config.lights, root, take_over)
    except StageInUse as error:
        return f"left as they are: {error}"
    try:
        ownership.claim(devices.lights)
        return blackout(devices, attempts=1).detail
    except StageInUse as error:
        return f"left as they are: {error}"
    finally:
        devices.close()
        ownership.release(devices.lights)


class Stage:
    """All who connect to the devices outside a capture go through here, one after the other.

    `lit()` says whether a capture has the devices now; `revoke(why)` takes the right to light from
    every capture, which the latch does when it is set. Constructing connects to nothing; raises
    `RigError` for devices that cannot be, and `StageInUse` while another process on this machine
    has the stage, `take_over` says that one on another machine has it no more. A blackout that
    could not be verified is latched (`latch`), which is recorded in `audit`.
    """

    def __init__(
        self,
        rig_file: RigFile,
        root: Path,
        audit: AuditLog,
        events: EventLog,
        lit: Callable[[], bool],
        revoke: Callable[[str], object],
        *,
        take_over: bool = False,
    ) -> None:
        self._revoke = revoke
        self._rig_file, self._audit, self._events, self._lit = rig_file, audit, events, lit
        self._ownership = None
        if rig_file.devices is not None:
            self._ownership = Ownership(self.devices.config.lights, root, take_over)
        self.latch = Latch(root / "unsafe.json")
        self._last: Blackout | None = None
        self._learning = threading.Lock()
        self._one = threading.Lock()

    @property
    def there(self) -> bool:
        """Whether the rig file names devices at all."""
        return self._rig_file.devices is not None

    @cached_property
    def devices(self) -> DeviceSet:
        """The one set of them; nothing is connected by asking for it."""
        return DeviceSet.of(self._rig_file)

    @contextmanager
    def alone(self) -> Iterator[DeviceSet]:
        """Nobody else connects for a moment (a serial port has room for one); closes after it."""
        with self._one:
            try:
                yield self.devices
            finally:
                self.devices.close()

    def wait_for_others(self) -> None:
        """Return once nobody holds a short connection any more; opens and closes none."""
        with self._one:
            pass

    def take(self) -> None:
        """Have the stage for this service, before anything is commanded. Raises `StageInUse`."""
        if self._ownership is not None:
            with self.alone() as devices:
                self._ownership.claim(devices.lights)

    def release(self) -> None:
        """Let others have it."""
        if self._ownership is not None:
            self._ownership.release(self.devices.lights)

    def darken(self) -> None:
        """Put everything off that answers, as the service starts; what does not is latched."""
        if self.there:
            with self.alone() as devices:
                self.learn(blackout(devices, attempts=1))

    def learn(self, result: Blackout) -> None:
        """Keep what a blackout came to, and latch or unlatch.

        What is older than what is known counts for nothing: a run that hung tells its last blackout
        when it ends, and others, or a person who has looked, may have found out more meanwhile.
        """
        beams = self.devices.projectors
        lamps = self.devices.lights.capabilities.reads_back
        reads_back = lamps and (beams is None or beams.capabilities.reads_back)
        with self._learning:
            if self._last is not None and result.known_at < self._last.known_at:
                return
            self._last = result
            change = self.latch.learn(result, reads_back)
        self._tell(change, result)

    def acknowledge(self, said: str) -> None:
        """Unlatch on the word of a person who has looked, until a blackout says otherwise; `said`:
        who they are and what they saw. Raises `CannotAcknowledge`."""
        with self._learning:
            self.latch.acknowledge()
            word = Blackout(False, f"somebody has looked: {said}", accepted=True, said=True)
            self._last = word
        self._tell("cleared", word)

    def _tell(self, change: str | None, result: Blackout) -> None:
        """Record and publish what `result` did to the latch, and what is known of the lamps."""
        if change == "set":
            self._revoke(f"the stage was latched: {result.detail}")
        if change is not None:
            self._audit.record(SERVICE, f"latch.{change}", "stage", detail=result.detail)
            self._events.publish("stage.latch", {"latched": change == "set", **result.to_dict()})
        self._events.publish("stage.lamps", self.darkness())

    def darkness(self) -> dict[str, Any]:
        """What is known of the lamps when no capture runs: {"state", "detail", "latched",
        "accepted"}; accepted: off was sent, and the rig file accepts that no more is known."""
        none_yet = "no blackout yet" if self.there else "the rig file names no devices"
        last, latched = self._last or Blackout(False, none_yet), self.latch.latched
        if latched is not None:
            return unknown(latched.detail, latched.since)
        accepted = last.accepted and not last.said
        known = {"state": last.state, "detail": last.detail}
        return {**known, "latched": None, "accepted": accepted}

    @property
    def known_dark(self) -> bool:
        """Whether a blackout, or somebody's look, came to what a capture may begin after."""
        return self._last is not None and not self._last.blocks

    def query(self) -> dict[str, Any]:
        """What the devices say, with its age; they are asked anew, but not waited for."""
        return self._seen.get() if self.there else {"age_s": None}

    def states(self) -> dict[str, str]:
        """Each device's state when it was last asked, by kind or a camera's name; asks nobody."""
        if not self.there:
            return {}
        seen = self._seen.peek()
        named = {**seen.pop("cameras", {}), **seen}
        return {k: v["state"] for k, v in named.items() if isinstance(v, dict) and "state" in v}

    @cached_property
    def _seen(self) -> CachedStatus:
        return CachedStatus(self._look, self.devices.unqueried())

    def _look(self) -> dict[str, Any] | None:
        """Ask the devices; without a capture, connect for the answer, until one begins."""
        with self._one:
            if self._lit():
                return self.devices.status(connect=False)
            try:
                return self.devices.status(connect=True, given_up=self._lit)
            finally:
                self.devices.close()
