"""Log records as lines of JSON with their subject, and a limited rate per cause."""

from __future__ import annotations

import json
import logging
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from datetime import UTC, datetime

_ABOUT: ContextVar[dict[str, str]] = ContextVar("about", default={})  # noqa: B039 (never changed)


@contextmanager
def about(**ids: str) -> Iterator[None]:
    """Add these ids to the records of this thread, for instance `capture="…"`."""
    token = _ABOUT.set({**_ABOUT.get(), **ids})
    try:
        yield
    finally:
        _ABOUT.reset(token)


class JsonLines(logging.Formatter):
    """One object a line, in ASCII: time (UTC), level, logger, thread, message, `about`, error."""

    def format(self, record: logging.LogRecord) -> str:
        """The record as JSON."""
        at = datetime.fromtimestamp(record.created, UTC).isoformat(timespec="milliseconds")
        data = {
            "time": at,
            "level": record.levelname,
            "logger": record.name,
            "thread": record.threadName,
            "message": record.getMessage(),
            **_ABOUT.get(),
        }
        if record.exc_info:
            data["error"] = self.formatException(record.exc_info)
        return json.dumps(data)


EVERY_S = 60.0
"""Interval of log lines of a lasting cause, each with its count."""
MOST_CAUSES = 1000
"""Causes that are counted; the oldest is dropped first."""


@dataclass
class _Cause:
    """Since when it lasts (None: over), its count in all and since the last line, the time of that
    line, and whether its present period has a line."""

    since: float | None = None
    count: int = 0
    unlogged: int = 0
    logged: float | None = None
    begun: bool = False


class Causes:
    """Repeated errors by cause: a line when one begins, one per minute with a count while it lasts,
    and one when it ends. Safe to call from several threads."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._causes: dict[str, _Cause] = {}
        self._lock = threading.Lock()

    def failed(
        self,
        log: logging.Logger,
        cause: str,
        detail: object,
        error: BaseException | None = None,
    ) -> None:
        """Count an occurrence; `error` is the traceback for its line."""
        with self._lock:
            one = self._causes.pop(cause, None) or _Cause()
            self._causes[cause] = one  # the newest last
            while len(self._causes) > MOST_CAUSES:
                del self._causes[next(iter(self._causes))]
            now = self._clock()
            one.since = now if one.since is None else one.since
            one.count += 1
            one.unlogged += 1
            if one.logged is not None and now - one.logged < EVERY_S:
                return
            times, lasts = one.unlogged, now - one.since
            one.logged, one.unlogged, one.begun = now, 0, True
        again = f" ({times} times, and for {lasts:.0f} s now)" if times > 1 else ""
        log.error("%s: %s%s", cause, detail, again, exc_info=error)

    def over(self, log: logging.Logger, cause: str) -> None:
        """End a cause, if it lasts."""
        if cause not in self._causes:
            return
        with self._lock:
            one = self._causes.get(cause)
            if one is None or one.since is None:
                return
            lasted, count, begun = self._clock() - one.since, one.count, one.begun
            one.since, one.count, one.begun = None, 0, False
        if begun:
            log.warning("%s: over after %.0f s (it came %d times)", cause, lasted, count)


CAUSES = Causes()
"""The causes of this process."""


class Folded(logging.Filter):
    """A handler's filter that counts libraries' records of one `cause` instead of logging them.
    `loggers` are the libraries' loggers, `words` occur in the text or traceback of such records."""

    def __init__(self, log: logging.Logger, cause: str, loggers: set[str], words: set[str]) -> None:
        super().__init__()
        self._log, self._cause, self._loggers, self._words = log, cause, loggers, words

    def filter(self, record: logging.LogRecord) -> bool:
        """False for a counted record."""
        if record.name.partition(".")[0] not in self._loggers:
            return True
        text = record.getMessage()
        raised = record.exc_info[1] if record.exc_info else None
        where = type(raised).__module__ if raised is not None else ""
        if not any(word in text or where.startswith(word) for word in self._words):
            return True
        CAUSES.failed(self._log, self._cause, text.partition("\n")[0])
        return False
