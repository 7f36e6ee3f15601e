"""Captures read again: when somebody asks, and each so many days, never while the stage shoots."""

from __future__ import annotations

import json
import logging
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Sequence
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, TypeAdapter, ValidationError

from reconstruction.capture.writer import utc_now
from reconstruction.files.durable import write_json
from reconstruction.reading import printable, read_json
from stage_service.acquisition.states import CaptureStatus
from stage_service.background import Background
from stage_service.records.events import EventLog
from stage_service.signals import tied

log = logging.getLogger("hairstage.verification")
POLL_S = 0.3
LOOK_EVERY_S = 60.0
MOST_PROBLEMS = 100
NICE = 10


class Verification(BaseModel):
    """A capture that is read again: `finished` (UTC) is when it last was, `problems` the first of
    what was wrong then, `wrong` how many."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    capture: str
    state: Literal["never", "waiting", "running", "done"] = "never"
    finished: str | None = None
    wrong: int = 0
    problems: list[str] = []


class Verifier(Background):
    """Reads captures again, one at a time, in a process of its own that stands still while
    `busy()`; results are kept in `path`, beside `captures/`. With `days`, each of `due()` is read
    again so often.

    What is wrong is told by the event "capture.damaged".
    """

    def __init__(
        self,
        path: Path,
        events: EventLog,
        busy: Callable[[], bool],
        due: Callable[[], Sequence[CaptureStatus]],
        days: float | None,
    ) -> None:
        super().__init__("verifier")
        self._path, self._events, self._busy, self._due, self._days = path, events, busy, due, days
        self._waiting: dict[str, Path] = {}
        self._running: str | None = None
        self._known = self._read()

    def start(self) -> None:
        """Begin."""
        self._thread.start()

    def ask(self, capture: str, folder: Path) -> Verification:
        """Read it again, soon."""
        with self._changed:
            if capture != self._running:
                self._waiting[capture] = folder
            self._changed.notify_all()
        return self.get(capture)

    def get(self, capture: str) -> Verification:
        """What is known of it."""
        with self._changed:
            last = self._known.get(capture, Verification(capture=capture))
            if capture == self._running:
                return last.model_copy(update={"state": "running"})
            if capture in self._waiting:
                return last.model_copy(update={"state": "waiting"})
            return last

    def forget(self, capture: str) -> None:
        """It is here no more, or no more what was read."""
        with self._changed:
            self._waiting.pop(capture, None)
            if self._running == capture:
                self._running = None  # what is being found counts for nothing
            if self._known.pop(capture, None) is None:
                return
            kept = self._kept()
        self._write(kept)

    @property
    def damaged(self) -> list[str]:
        """The captures with which something was wrong when they were last read."""
        with self._changed:
            return [v.capture for v in self._known.values() if v.wrong]

    def _run(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._closed or self._waiting, LOOK_EVERY_S)
                if self._closed:
                    return
                if not self._waiting:
                    self._waiting = self._overdue()
                if not self._waiting:
                    continue
                self._running = capture = next(iter(self._waiting))
                folder = self._waiting.pop(capture)
            try:
                found = self._verify(capture, folder)
            except OSError as error:  # there is no process to be had: the next one may have one
                log.exception("%s", folder)
                found = [f"it could not be read again: {printable(str(error))}"]
            # One that was removed meanwhile is nobody's damage.
            self._learn(capture, found if folder.is_dir() else None)

    def _overdue(self) -> dict[str, Path]:
        """The one that was read longest ago, where that is too long."""
        if self._days is None:
            return {}
        before = (datetime.now(UTC) - timedelta(days=self._days)).isoformat()
        paths = {c.id: Path(c.path) for c in self._due()}
        last = {i: (self._known.get(i) or Verification(capture=i)) for i in paths}
        old = sorted((v.finished or "", i) for i, v in last.items() if (v.finished or "") < before)
        return {old[0][1]: paths[old[0][1]]} if old else {}

    def _verify(self, capture: str, folder: Path) -> list[str] | None:
        """What is wrong; None where the service ends first, or it is of no use any more."""
        command = [sys.executable, "-m", "stage_service.cli", "verify", str(folder), "--json"]
        child = subprocess.Popen(
            tied(command, "KILL"),  # one that stands still would never end
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            start_new_session=True,
        )
        os.setpriority(os.PRIO_PROCESS, child.pid, NICE)
        stopped = False
        try:
            while True:
                try:
                    out, _ = child.communicate(timeout=POLL_S)
                    break
                except subprocess.TimeoutExpired:
                    pass
                if self._closed or self._running != capture:
                    return None
                if (busy := self._busy()) != stopped:
                    child.send_signal(signal.SIGSTOP if busy else signal.SIGCONT)
                    stopped = busy
        finally:
            if child.poll() is None:
                child.kill()
                child.communicate()
        try:
            answer = json.loads(out)
            told = answer["problems"] if "problems" in answer else [answer["error"]["detail"]]
            return [str(problem) for problem in told]
        except (ValueError, KeyError, TypeError):
            return [f"reading it ended with exit code {child.returncode}"]

    def _learn(self, capture: str, problems: list[str] | None) -> None:
        with self._changed:
            forgotten, self._running = self._running != capture, None
            if problems is None or forgotten:
                return
            found = Verification(
                capture=capture,
                state="done",
                finished=utc_now(),
                wrong=len(problems),
                problems=[printable(p) for p in problems[:MOST_PROBLEMS]],
            )
            self._known[capture] = found
            kept = self._kept()
        kind = "capture.damaged" if problems else "capture.verified"
        self._events.publish(kind, {"id": capture, "wrong": len(problems)})
        self._write(kept)

    def _kept(self) -> list[dict[str, Any]]:
        return [v.model_dump(mode="json") for v in self._known.values()]

    def _write(self, kept: list[dict[str, Any]]) -> None:
        try:
            write_json(self._path, kept)
        except OSError:
            log.exception("%s cannot be written", self._path)

    def _read(self) -> dict[str, Verification]:
        """What is kept, of captures that are still there."""
        captures = self._path.parent / "captures"
        try:
            kept = TypeAdapter(list[Verification]).validate_python(read_json(self._path))
        except FileNotFoundError:
            return {}
        except (OSError, ValueError, ValidationError) as error:
            log.warning("%s cannot be read: %s", self._path, error)
            return {}
        return {v.capture: v for v in kept if (captures / v.capture).is_dir()}
