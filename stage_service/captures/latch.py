"""The latch: "unknown, unsafe", stored across restarts."""

from __future__ import annotations

import json
import logging
import threading
from dataclasses import asdict, dataclass, replace
from pathlib import Path

from pydantic import TypeAdapter

from reconstruction.capture.writer import utc_now
from reconstruction.files.durable import write_whole
from reconstruction.reading import read_json
from stage_service.acquisition.safety import Blackout

log = logging.getLogger("hairstage.safety")


class Unsafe(RuntimeError):
    """Captures are refused: the last blackout could not be verified."""

    def __init__(self, latched: Latched) -> None:
        detail = latched.detail.rstrip(".")
        super().__init__(f"since {latched.since}: {detail}. Nothing is lit {latched.way_out}.")


class CannotAcknowledge(RuntimeError):
    """Nothing is latched, or the link reads back by itself whether the lamps are off."""


@dataclass(frozen=True)
class Latched:
    """Why and since when; `reads_back`: the link can confirm that the lamps are off."""

    since: str
    detail: str
    reads_back: bool

    @property
    def way_out(self) -> str:
        """What ends the latch."""
        if self.reads_back:
            return "until a blackout reads every lamp back dark"
        return "until somebody has looked and acknowledges that the lamps are off"


class Latch:
    """ "Unknown, unsafe", stored in `path` until a blackout is read back dark.

    Without read-back a person clears it, by `acknowledge`. An unreadable file counts as latched.
    The stage's devices determine which of the two ends it, not the file, which may be of another
    light bank: before the first blackout of a service no person can.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._lock = threading.Lock()
        self.latched: Latched | None = None
        try:
            self.latched = TypeAdapter(Latched).validate_python(read_json(path))
        except FileNotFoundError:
            pass
        except (OSError, ValueError) as error:
            self.latched = Latched(utc_now(), f"{path} could not be read: {error}", True)

    def check(self) -> None:
        """Raise `Unsafe` while it is set."""
        if (latched := self.latched) is not None:
            raise Unsafe(latched)

    def learn(self, result: Blackout, reads_back: bool) -> str | None:
        """Apply a blackout's result; returns "set" or "cleared" if the latch changed."""
        with self._lock:
            was = self.latched
            if result.blocks:
                self._set(Latched(was.since if was else utc_now(), result.detail, reads_back))
                return None if was else "set"
            if was is None:
                return None
            if result.safe:
                self._clear()
                return "cleared"
            if was.reads_back != reads_back:
                self._set(replace(was, reads_back=reads_back))
        return None

    def check_acknowledge(self) -> None:
        """Raise `CannotAcknowledge` unless a person may clear it."""
        if (latched := self.latched) is None:
            raise CannotAcknowledge("nothing is latched: there is nothing to acknowledge")
        if latched.reads_back:
            raise CannotAcknowledge(
                "this light bank reads back whether its lamps are off: send a blackout once it "
                "replies"
            )

    def acknowledge(self) -> None:
        """Clear it on a person's word. Raises `CannotAcknowledge`."""
        with self._lock:
            self.check_acknowledge()
            self._clear()

    def _set(self, latched: Latched) -> None:
        self.latched = latched
        try:
            write_whole(self._path, json.dumps(asdict(latched)).encode())
        except OSError:  # a full disk must not fail a blackout
            log.exception("%s cannot be written: the latch ends with this process", self._path)

    def _clear(self) -> None:
        try:
            self._path.unlink(missing_ok=True)
        except OSError:  # latched again at the next start
            log.exception("%s cannot be removed", self._path)
        self.latched = None
