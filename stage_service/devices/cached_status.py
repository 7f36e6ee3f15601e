"""What the devices said of themselves when they were last asked, so that nobody waits for them."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from contextlib import suppress
from typing import Any

WAIT_S = 2.0
"""How long somebody who asks waits for an answer that is under way."""


class CachedStatus:
    """Asks one at a time, on a thread of its own, however many want to know.

    `look()` returns what it saw, or None where it gave up; before the first look it is `unseen`.
    """

    def __init__(
        self,
        look: Callable[[], dict[str, Any] | None],
        unseen: dict[str, Any],
        wait_s: float = WAIT_S,
    ) -> None:
        self._look, self._seen, self._wait_s = look, unseen, wait_s
        self._at: float | None = None
        self._began = 0.0
        self._looking = False
        self._changed = threading.Condition()

    def get(self) -> dict[str, Any]:
        """What was seen last and, as "age_s", how many seconds ago (None: not yet)."""
        with self._changed:
            if not self._looking:
                self._began = time.monotonic()
                with suppress(RuntimeError):  # no thread can be had: its age tells
                    threading.Thread(target=self._run, name="device-look", daemon=True).start()
                    self._looking = True
            self._changed.wait_for(lambda: not self._looking, self._wait_s)
            age = None if self._at is None else time.monotonic() - self._at
            return {**self._seen, "age_s": age}

    def looking_s(self) -> float:
        """How long the look that is under way has taken; 0 where none is."""
        with self._changed:
            return time.monotonic() - self._began if self._looking else 0.0

    def peek(self) -> dict[str, Any]:
        """What was seen last; has nobody look."""
        with self._changed:
            return dict(self._seen)

    def _run(self) -> None:
        seen, at = None, time.monotonic()
        try:
            seen = self._look()
        finally:
            with self._changed:
                if seen is not None:
                    self._seen, self._at = seen, at
                self._looking = False
                self._changed.notify_all()
