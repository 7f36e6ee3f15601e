"""The permission of one run to put light on; drivers light nothing for a thread without it.

A thread lights under the permission that it uses (`Permission.used`), so a thread left over from an
earlier run can never light under the permission of a later one.
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
    """The permission of the run `what`: live from `grant` to `revoke`, which is final.

    A suspended one, as in a pause, is not live. Only `lighting` and `no_light` wait. Safe to call
    from several threads.
    """

    def __init__(self, what: str) -> None:
        self._what = what
        self._state: State = "not granted"
        self._why = "its permission is not granted"
        self._changing = threading.Lock()  # for moments
        self._lighting = threading.Lock()  # during a command that may light something
        self._standstill: Standstill | None = None

    @classmethod
    def granted(cls, what: str) -> Self:
        """A live permission."""
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
                raise NotPermitted(f"{self._what} has lost its permission to light: {self._why}")
            self._state = "live"

    def suspend(self, why: str) -> None:
        """Refuse light until `grant`."""
        self._leave(("live",), "suspended", why)

    def revoke(self, why: str) -> None:
        """Refuse light for good; the first reason is kept."""
        self._leave(("not granted", "live", "suspended"), "revoked", why)

    def lapse(self, why: str) -> None:
        """Revoke it if it is live; a suspended one needs a person's grant anyway."""
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
        """A context in which it lapses when this process stands still for more than `limit_s`."""
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
        """A context in which no lighting command is under way; waits at most `within_s` seconds for
        one to end. Revoke the permission first."""
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
    """A context for one command of the calling thread that may light something. Every driver and
    wrapper enters it for such commands. Raises `NotPermitted`."""
    permission: Permission | None = getattr(_thread, "permission", None)
    if permission is None:
        raise NotPermitted(f"{doing}: this thread has no permission to light anything")
    with permission.lighting(doing):
        yield
