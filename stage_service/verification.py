"""Verifies captures on request, in a process of its own that pauses while the stage shoots."""

from __future__ import annotations

import json
import logging
import os
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Literal

from pydantic import BaseModel, ConfigDict

from reconstruction.capture.writer import utc_now
from reconstruction.reading import printable
from stage_service.background import Background
from stage_service.records.events import EventLog
from stage_service.signals import tied

log = logging.getLogger("hairstage.verification")
POLL_S = 0.3
MOST_PROBLEMS = 100
NICE = 10


class Verification(BaseModel):
    """The newest verification of a capture since the service started: when it `finished` (UTC), the
    number of problems (`wrong`), and the first of them."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    capture: str
    state: Literal["never", "waiting", "running", "done"] = "never"
    finished: str | None = None
    wrong: int = 0
    problems: list[str] = []


class Verifier(Background):
    """Verifies captures, one at a time; pauses while `busy()`.

    Each result is published as "capture.verified" or "capture.damaged".
    """

    def __init__(self, events: EventLog, busy: Callable[[], bool]) -> None:
        super().__init__("verifier")
        self._events, self._busy = events, busy
        self._waiting: dict[str, Path] = {}
        self._running: str | None = None
        self._known: dict[str, Verification] = {}

    def start(self) -> None:
        """Start the thread."""
        self._thread.start()

    def submit(self, capture: str, folder: Path) -> Verification:
        """Queue a capture."""
        with self._changed:
            if capture != self._running:
                self._waiting[capture] = folder
            self._changed.notify_all()
        return self.get(capture)

    def get(self, capture: str) -> Verification:
        """The newest result and the present state."""
        with self._changed:
            last = self._known.get(capture, Verification(capture=capture))
            if capture == self._running:
                return last.model_copy(update={"state": "running"})
            if capture in self._waiting:
                return last.model_copy(update={"state": "waiting"})
            return last

    def forget(self, capture: str) -> None:
        """Drop the results of a capture that was removed or continued."""
        with self._changed:
            self._waiting.pop(capture, None)
            self._known.pop(capture, None)
            if self._running == capture:
                self._running = None  # ends the process

    @property
    def damaged(self) -> list[str]:
        """The captures with problems at their last verification."""
        with self._changed:
            return [v.capture for v in self._known.values() if v.wrong]

    def _run(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._closed or self._waiting)
                if self._closed:
                    return
                self._running = capture = next(iter(self._waiting))
                folder = self._waiting.pop(capture)
            try:
                problems = self._verify(capture, folder)
            except OSError as error:  # no process available
                log.exception("%s", folder)
                problems = [f"it could not be verified: {printable(str(error))}"]
            self._store(capture, problems if folder.is_dir() else None)

    def _verify(self, capture: str, folder: Path) -> list[str] | None:
        """The problems; None if the service ends first or the capture is forgotten."""
        command = [sys.executable, "-m", "stage_service.cli", "verify", str(folder), "--json"]
        child = subprocess.Popen(
            tied(command, "KILL"),  # a stopped process ignores SIGTERM
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
            found = json.loads(out)
            problems = found["problems"] if "problems" in found else [found["error"]["detail"]]
            return [str(problem) for problem in problems]
        except (ValueError, KeyError, TypeError):
            return [f"`hairstage verify` ended with exit code {child.returncode}"]

    def _store(self, capture: str, problems: list[str] | None) -> None:
        with self._changed:
            forgotten, self._running = self._running != capture, None
            if problems is None or forgotten:
                return
            self._known[capture] = Verification(
                capture=capture,
                state="done",
                finished=utc_now(),
                wrong=len(problems),
                problems=[printable(p) for p in problems[:MOST_PROBLEMS]],
            )
        kind = "capture.damaged" if problems else "capture.verified"
        self._events.publish(kind, {"id": capture, "wrong": len(problems)})
