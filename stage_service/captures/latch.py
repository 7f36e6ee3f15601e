"""Remembers, beyond a restart, that nobody knows whether the lamps are off."""

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
    """Nothing is latched, or the link can tell by itself whether the lamps are off."""


@dataclass(frozen=True)
class Latched:
    """Why and since when; `reads_back`: the link can tell that the lamps are off."""

    since: str
    detail: str
    reads_back: bool

    @property
    def way_out(self) -> str:
        """What ends it."""
        if self.reads_back:
            return "until a blackout reads every lamp back dark"
        return "until somebody has looked and acknowledges that the lamps are off"


class Latch:
    """ "Unknown, unsafe", kept in `path` until a blackout was read back dark.

    A link that cannot read back never clears it: a person does, by `acknowledge`. A file that is
    there and cannot be read counts as latched. Which of the two ends it, the stage's devices say,
    not the file, which may be damaged or of another light bank: until the first blackout, with
    which a service starts, no person can.
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
        """Take a blackout's result; returns "set" or "cleared" when that changes the latch."""
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
        """Raise `CannotAcknowledge` where it is not for a person to clear it."""
        if (latched := self.latched) is None:
            raise CannotAcknowledge("nothing is latched: there is nothing to acknowledge")
        if latched.reads_back:
            raise CannotAcknowledge(
                "this light bank reports itself whether its lamps are off: send a blackout once it "
                "answers"
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
        except OSError:  # a full disk must not keep anybody from a blackout
            log.exception("%s cannot be written: it ends with this process", self._path)

    def _clear(self) -> None:
        try:
            self._path.unlink(missing_ok=True)
        except OSError:  # it is latched again at the next start
            log.exception("%s cannot be removed", self._path)
        self.latched = None
