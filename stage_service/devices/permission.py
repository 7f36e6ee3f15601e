"""The right of one run to put light on; the devices light nothing for a thread without it.

A thread lights by the permission that it uses (`Permission.used`), so that what is left of an
earlier run can never light by the permission of a later one.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Literal, Self

from stage_service.devices.standstill import Standstill

State = Literal["not granted", "live", "suspended", "revoked"]


class NotPermitted(RuntimeError):
    """Light was commanded without a live permission; no device has received the command."""


class Permission:
    """Of the run `what`: live once it is granted, until it is revoked, which is final.

    While it is `suspended`, as in a pause, it is not live. No method but `lighting` and `no_light`
    waits. Safe to call from several threads.
    """

    def __init__(self, what: str) -> None:
        self._what = what
        self._state: State = "not granted"
        self._why = "nobody has granted it"
        self._changing = threading.Lock()  # for moments
        self._lighting = threading.Lock()  # while a device is commanded to light something
        self._standstill: Standstill | None = None

    @classmethod
    def granted(cls, what: str) -> Self:
        """A live one."""
        new = cls(what)
        new.grant()
        return new

    @property
    def live(self) -> bool:
        """Whether light may be put on."""
        return self._state == "live"

    def grant(self) -> None:
        """Make it live. Raises `NotPermitted` where it was revoked."""
        with self._changing:
            if self._state == "revoked":
                raise NotPermitted(f"{self._what} may light nothing any more: {self._why}")
            self._state = "live"

    def suspend(self, why: str) -> None:
        """Let nothing be lit until `grant`."""
        self._leave(("live",), "suspended", why)

    def revoke(self, why: str) -> None:
        """Let nothing be lit any more; the first reason counts."""
        self._leave(("not granted", "live", "suspended"), "revoked", why)

    def lapse(self, why: str) -> None:
        """Revoke it where it is live: a suspended one is granted anew by a person."""
        self._leave(("live",), "revoked", why)

    @contextmanager
    def used(self) -> Iterator[None]:
        """A context in which the calling thread lights by this permission."""
        before: Permission | None = getattr(_thread, "permission", None)
        _thread.permission = self
        try:
            yield
        finally:
            _thread.permission = before

    @contextmanager
    def lapsing(self, limit_s: float) -> Iterator[None]:
        """A context in which it lapses where this process stands still for longer."""
        with Standstill(limit_s, self.lapse) as self._standstill:
            yield

    @contextmanager
    def lighting(self, doing: str) -> Iterator[None]:
        """A context for one command that may light something. Raises `NotPermitted`."""
        with self._lighting:
            if (standstill := self._standstill) is not None:
                standstill.check()
            if not self.live:
                raise NotPermitted(f"{doing}: {self._what} may not light it: {self._why}")
            yield

    @contextmanager
    def no_light(self, within_s: float) -> Iterator[None]:
        """A context in which no command that lights is under way; one that takes longer than
        `within_s` seconds to end is not waited for. Revoke it first."""
        held = self._lighting.acquire(timeout=max(0.0, within_s))
        try:
            yield
        finally:
            if held:
                self._lighting.release()

    def _leave(self, states: tuple[State, ...], state: State, why: str) -> None:
        with self._changing:
            if self._state in states:
                self._state, self._why = state, why


_thread = threading.local()


@contextmanager
def lighting(doing: str) -> Iterator[None]:
    """A context for one command of the calling thread that may light something: what every driver
    and wrapper enters that has such a command. Raises `NotPermitted`."""
    permission: Permission | None = getattr(_thread, "permission", None)
    if permission is None:
        raise NotPermitted(f"{doing}: this thread has no permission to light anything")
    with permission.lighting(doing):
        yield
