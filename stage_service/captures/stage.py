"""The devices of one stage between captures: ownership, status, darkness."""

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
    """The state of lamps that may be lit, as `Stage.darkness` returns it."""
    state = {"state": "unknown, unsafe", "detail": detail}
    return {**state, "latched": latched, "accepted": False}


def put_off(rig_file: RigFile, root: Path, *, take_over: bool = False) -> str:
    """Put a stage off whose service cannot use its `root`; returns the result in words.

    Does nothing while another service has the stage.
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
    """Every connection to the devices outside a capture, one after the other.

    `lit()`: a capture has the devices now. `revoke(why)`, called when the latch is set, revokes
    every capture's permission to light. An unverified blackout is latched (`latch`) and recorded in
    `audit`. Constructing connects to nothing. Raises `RigError` for an invalid rig file,
    `StageInUse` while another process on this machine has the stage; `take_over`: the service of
    another machine that has it is dead.
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
        """The only set of drivers; connects to nothing."""
        return DeviceSet.of(self._rig_file)

    @contextmanager
    def alone(self) -> Iterator[DeviceSet]:
        """A context for a short connection (a serial port has one user); closes it at the end."""
        with self._one:
            try:
                yield self.devices
            finally:
                self.devices.close()

    def wait_for_others(self) -> None:
        """Return once no short connection is open."""
        with self._one:
            pass

    def take(self) -> None:
        """Take the stage for this service, before any command. Raises `StageInUse`."""
        if self._ownership is not None:
            with self.alone() as devices:
                self._ownership.claim(devices.lights)

    def release(self) -> None:
        """Release the stage."""
        if self._ownership is not None:
            self._ownership.release(self.devices.lights)

    def darken(self) -> None:
        """Put everything off, as the service starts; latched where it is not verified."""
        if self.there:
            with self.alone() as devices:
                self.learn(blackout(devices, attempts=1))

    def learn(self, result: Blackout) -> None:
        """Store a blackout's result, and latch or unlatch.

        A result older than the stored one is ignored: a run that hung reports its last blackout
        when it ends, after newer results.
        """
        beams = self.devices.projectors
        lamps = self.devices.lights.capabilities.reads_back
        reads_back = lamps and (beams is None or beams.capabilities.reads_back)
        with self._learning:
            if self._last is not None and result.known_at < self._last.known_at:
                return
            self._last = result
            change = self.latch.learn(result, reads_back)
        self._publish(change, result)

    def acknowledge(self, said: str) -> None:
        """Unlatch on the word of a person who has looked; `said`: their name and what they saw. The
        next blackout replaces it. Raises `CannotAcknowledge`."""
        with self._learning:
            self.latch.acknowledge()
            word = Blackout(False, f"somebody has looked: {said}", accepted=True, said=True)
            self._last = word
        self._publish("cleared", word)

    def _publish(self, change: str | None, result: Blackout) -> None:
        """Record and publish a change of the latch, and the lamps' state."""
        if change == "set":
            self._revoke(f"the stage was latched: {result.detail}")
        if change is not None:
            self._audit.record(SERVICE, f"latch.{change}", "stage", detail=result.detail)
            self._events.publish("stage.latch", {"latched": change == "set", **result.to_dict()})
        self._events.publish("stage.lamps", self.darkness())

    def darkness(self) -> dict[str, Any]:
        """The lamps' state without a capture: {"state", "detail", "latched", "accepted"}; accepted:
        off was sent, and the rig file accepts that it is not read back."""
        none_yet = "no blackout yet" if self.there else "the rig file names no devices"
        last, latched = self._last or Blackout(False, none_yet), self.latch.latched
        if latched is not None:
            return unknown(latched.detail, latched.since)
        accepted = last.accepted and not last.said
        known = {"state": last.state, "detail": last.detail}
        return {**known, "latched": None, "accepted": accepted}

    @property
    def known_dark(self) -> bool:
        """Whether the last blackout, or a person's word, allows a capture to start."""
        return self._last is not None and not self._last.blocks

    def query(self) -> dict[str, Any]:
        """The devices' newest status with its age in seconds; starts a new query."""
        return self._status.get() if self.there else {"age_s": None}

    def states(self) -> dict[str, str]:
        """Each device's state at the last query, by kind or a camera's name; queries none."""
        if not self.there:
            return {}
        found = self._status.peek()
        named = {**found.pop("cameras", {}), **found}
        return {k: v["state"] for k, v in named.items() if isinstance(v, dict) and "state" in v}

    @cached_property
    def _status(self) -> CachedStatus:
        return CachedStatus(self._query, self.devices.unqueried())

    def _query(self) -> dict[str, Any] | None:
        """Query the devices; without a capture, connect for it, until one starts."""
        with self._one:
            if self._lit():
                return self.devices.status(connect=False)
            try:
                return self.devices.status(connect=True, given_up=self._lit)
            finally:
                self.devices.close()
