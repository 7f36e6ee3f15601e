"""Steering the stage in a caller's name: permission, and the record in the audit log."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from concurrent.futures import Future, wait
from dataclasses import dataclass
from typing import Any, TypeVar

from stage_service.acquisition.safety import Blackout
from stage_service.background import beside
from stage_service.captures.may_light import Moment, Way, Word
from stage_service.records.audit import AuditLog
from stage_service.records.lease import Leases
from stage_service.records.tokens import SCOPES, Scope

T = TypeVar("T")
STAGE = "stage"
REPLY_S = 1.0
"""A blackout is replied to within this time, with "unknown" if it has not ended by then."""
RECORDED_S = 0.3
"""A reply waits this long for the audit log's disk; a flush takes 5 to 50 ms."""
MOST_BLACKOUTS = 16
"""Concurrent blackouts; a further request gets the result of the newest."""
LATE = Blackout(
    False,
    "unknown, unsafe: not every lamp and projector was read back dark in time. The blackout "
    "continues: treat every lamp as lit until it is reported dark",
)


class Forbidden(PermissionError):
    """The caller's token lacks `scope`."""

    def __init__(self, scope: Scope) -> None:
        super().__init__(f"this needs a token with the scope {scope!r}")
        self.scope = scope


@dataclass(frozen=True)
class Caller:
    """Who sent a request: address, lease token, name and scopes of their own token ("": tokens are
    off), and the moment of the request."""

    address: str
    token: str | None = None
    name: str = ""
    scopes: tuple[Scope, ...] = SCOPES
    moment: Moment | None = None

    def require(self, scope: Scope) -> None:
        """Raise `Forbidden` without this scope."""
        if scope not in self.scopes:
            raise Forbidden(scope)

    def __str__(self) -> str:
        return f"{self.name} ({self.address})" if self.name else self.address


class Control:
    """Enforces leases and records every caller's actions."""

    def __init__(self, audit: AuditLog, leases: Leases) -> None:
        self.audit, self.leases = audit, leases
        self._blackouts: list[Future[tuple[dict[str, Any], Future[None]]]] = []
        self._lock = threading.Lock()

    def do(
        self,
        by: Caller,
        action: str,
        work: Callable[[], T],
        subject: str | None = STAGE,
        *,
        detail: str = "",
        steers: bool = True,
    ) -> T:
        """`work()`, recorded in any case; `subject` None: its result is the subject.

        With `steers`, raises `Leased` while another caller holds the lease.
        """
        who = self._who(by)
        try:
            if steers:
                self.leases.check(by.token)
            result = work()
        except Exception as error:
            why = f"{type(error).__name__}: {error}"
            self._record(who, action, subject or STAGE, "refused", why)
            raise
        self._record(who, action, subject or str(result), detail=detail)
        return result

    def blackout(self, by: Caller, work: Callable[[], dict[str, Any]]) -> dict[str, Any]:
        """`work()`, a blackout, recorded with its state; every caller may.

        Returns within `REPLY_S` seconds, with `LATE` if it has not ended: it continues on its own
        thread. A slow disk of the audit log delays no reply.
        """
        who, until = self._who(by), time.monotonic() + REPLY_S

        def recorded() -> tuple[dict[str, Any], Future[None]]:
            try:
                answer = work()
            except Exception as error:
                why = f"{type(error).__name__}: {error}"
                self.audit.later(who, "blackout", STAGE, "failed", why)
                raise
            line = self.audit.later(who, "blackout", STAGE, answer["state"], answer["detail"])
            return answer, line

        with self._lock:
            self._blackouts = [b for b in self._blackouts if not b.done()]
            if len(self._blackouts) < MOST_BLACKOUTS:
                self._blackouts.append(beside(recorded, "blackout"))
            under_way = self._blackouts[-1]
        if not wait([under_way], until - time.monotonic()).done:
            return LATE.to_dict()
        answer, line = under_way.result()
        wait([line], max(0.0, min(RECORDED_S, until - time.monotonic())))
        return answer

    def word(self, by: Caller, way: Way, armed_by: str | None = None) -> Word:
        """The caller's word for light. Raises `Forbidden` for arming without the scope "arm"."""
        if armed_by is not None:
            by.require("arm")
        return Word(way, by.token, armed_by, self._who(by), by.moment)

    def _record(
        self, who: str, action: str, subject: str, result: str = "ok", detail: str = ""
    ) -> None:
        """Record, and wait at most `RECORDED_S` for the disk: an abort must not hang on it."""
        wait([self.audit.later(who, action, subject, result, detail)], RECORDED_S)

    def _who(self, caller: Caller) -> str:
        holder = self.leases.holder(caller.token)
        return f"{holder} ({caller})" if holder else str(caller)
