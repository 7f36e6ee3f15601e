"""Refused requests in the audit log: the first of each cause line by line, then as a count."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass

from stage_service.background import Background
from stage_service.records.audit import AuditLog

FIRST = 5
"""Refusals of one cause with a line each."""
EVERY_S = 60.0
"""Interval of the line that counts further ones."""
FORGET_S = 600.0
"""Seconds without a refusal after which a cause starts again."""
MOST_CAUSES = 64
"""Causes that are counted one by one; further addresses are counted together. 64 lines per minute
are 20 MB per day."""
LONGEST = 200
"""Characters of a request's path in a line."""


@dataclass
class _Count:
    last: float = 0.0
    lines: int = 0
    more: int = 0
    due: float = math.inf


class Refusals(Background):
    """Records refused requests in `audit`; `note` does not wait for the disk."""

    def __init__(self, audit: AuditLog) -> None:
        super().__init__("refusals")
        self._audit = audit
        self._counts: dict[tuple[str, str, str, str], _Count] = {}

    def note(
        self, name: str, address: str, action: str, subject: str, slug: str, detail: str
    ) -> None:
        """Record that `action` on `subject` was refused, for the problem `slug`, to the token of
        this name ("": unknown) at `address` (host and port)."""
        now, host = time.monotonic(), address.rpartition(":")[0] or address
        with self._changed:
            if self._thread.ident is None and not self._closed:
                self._thread.start()
            cause = (host, name, action, slug)
            if cause not in self._counts and len(self._counts) >= MOST_CAUSES:
                cause = ("other addresses", "", action, slug)
            count = self._counts.setdefault(cause, _Count())
            count.last = now
            if count.lines >= FIRST:
                count.more += 1
                if count.due == math.inf:
                    count.due = now + EVERY_S
                    self._changed.notify_all()
                return
            count.lines += 1
        self._line(name, address, action, subject[:LONGEST], f"{slug}: {detail}")

    def close(self) -> None:
        """Record the remaining counts."""
        super().close()
        with self._changed:
            self._sum_up(math.inf)

    def _run(self) -> None:
        with self._changed:
            while not self._closed:
                now = time.monotonic()
                self._sum_up(now)
                due = min((count.due for count in self._counts.values()), default=math.inf)
                self._changed.wait(min(due - now, FORGET_S))

    def _sum_up(self, now: float) -> None:
        for (host, name, action, slug), count in self._counts.items():
            if count.more and count.due <= now:
                more = f"{slug}: {count.more:,} more since the line before of this cause"
                self._line(name, host, action, "service", more)
                count.more, count.due = 0, math.inf
        self._counts = {
            cause: count
            for cause, count in self._counts.items()
            if count.more or now - count.last < FORGET_S
        }

    def _line(self, name: str, address: str, action: str, subject: str, detail: str) -> None:
        who = f"{name} ({address})" if name else address
        self._audit.later(who, action, subject, "refused", detail)
