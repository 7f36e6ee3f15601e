"""May light be put on now? One table: every way to a lamp, and every condition that refuses it.

A run lights under a `Permission` (stage_service/devices/permission.py), which is granted after this
check: the wrappers of light bank, projectors and trigger box command nothing without a live one.
Blackout, abort, the latch, a standstill and the end of the service or the run revoke it for good; a
pause suspends it, and `resume` checks this table again. A service starts without a permission and
with the queue held, so after a start only a person's word puts a lamp on.

`armed_by` arms the flashes of one run. It is on the disk before the first flash and is never used
for another run: a run after a restart or from the queue has to be armed again.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, get_args

from stage_service.captures.hold import Held
from stage_service.captures.latch import Latched, Unsafe
from stage_service.plan.flash import FlashRefusal
from stage_service.records.audit import SERVICE
from stage_service.records.lease import Lease, Leased

Way = Literal["capture", "snapshot", "continue", "entry", "resume", "queue"]
"""Ways to put light on: a person's `POST /captures` and `/snapshot`, `/captures/{id}/resume` of an
ended, incomplete capture, `/queue/{id}/start`, and `/captures/{id}/resume` after a pause; last the
queue, by itself."""

TABLE = """
            capture   snapshot  continue  entry     resume    queue
closing     refused   refused   refused   refused   refused   refused
darkening   refused   refused   refused   refused   refused   refused
revoked     refused   refused   refused   refused   refused   refused
stale       refused   refused   refused   refused   refused   refused
running     refused   refused   refused   refused   -         refused
latched     refused   refused   refused   refused   refused   refused
unknown     refused   refused   refused   refused   refused   refused
unread      -         -         -         -         -         refused
leased      refused   refused   refused   refused   refused   refused
held        -         -         -         -         -         refused
flashes     refused   refused   refused   refused   -         refused
"""
"""Conditions, in the order in which they are checked, by ways. A run that resumes is the running
one and was armed when it started."""


class Busy(RuntimeError):
    """Another capture is running; the stage makes one at a time."""

    def __init__(self, running: str) -> None:
        super().__init__(f"capture {running} is running; wait for it, or abort it first")
        self.running = running


class NotNow(RuntimeError):
    """Light is refused now; the message has the reason."""


STALE_S = 30.0
"""Seconds for which a word is valid: the person who gave it still watches the stage. Reading a head
and making a folder take less; a stopped service, or a machine that slept, takes longer."""


@dataclass(frozen=True)
class Moment:
    """When a word was given: the number of revocations so far, and `boot_seconds`."""

    revocations: int
    at: float


@dataclass(frozen=True)
class Word:
    """A person's word for light: `lease` is the token that they sent, `armed_by` arms flashes,
    `who` is for the record. `given`: when; None: on arrival at the stage."""

    way: Way = "capture"
    lease: str | None = None
    armed_by: str | None = None
    who: str = SERVICE
    given: Moment | None = None


@dataclass(frozen=True)
class Facts:
    """The conditions of the table at one moment."""

    closing: bool = False
    """The service is closing."""
    darkening: bool = False
    """A blackout is under way."""
    revoked: bool = False
    """A blackout has begun, or the stage was latched, since the word was given."""
    stale: float = 0.0
    """Seconds since the word was given."""
    running: str | None = None
    """Another capture, or one that is being prepared."""
    latched: Latched | None = None
    """The last blackout was not verified."""
    unknown: bool = False
    """Darkness was neither read back nor acknowledged by a person."""
    unread: int = 0
    """Captures on the disk that were not read yet: one may be the queue's own."""
    leased: Lease | None = None
    """Another caller's."""
    held: Held | None = None
    """The queue's hold."""
    flashes: FlashRefusal | None = None
    """The plan's flashes lack consent or arming."""


def check(way: Way, facts: Facts) -> None:
    """Raise the first condition that refuses this way: `NotNow`, `Busy`, `Unsafe`, `Leased`,
    `FlashRefusal`."""
    for condition, refuses in _TABLE.items():
        if refuses[way] and (error := _ERRORS[condition](facts)) is not None:
            raise error


def _parsed() -> dict[str, dict[str, bool]]:
    head, *rows = (line.split() for line in TABLE.strip().splitlines())
    assert sorted(head) == sorted(get_args(Way))
    assert all(cell in ("refused", "-") for _, *row in rows for cell in row)
    return {n: dict(zip(head, (c == "refused" for c in row), strict=True)) for n, *row in rows}


_TABLE = _parsed()

_ERRORS: dict[str, Callable[[Facts], Exception | None]] = {
    "closing": lambda f: NotNow("the service is closing") if f.closing else None,
    "darkening": lambda f: NotNow("the stage is being put dark") if f.darkening else None,
    "revoked": lambda f: NotNow("the stage was put dark meanwhile") if f.revoked else None,
    "stale": lambda f: NotNow(_STALE.format(f.stale)) if f.stale > STALE_S else None,
    "running": lambda f: Busy(f.running) if f.running is not None else None,
    "latched": lambda f: Unsafe(f.latched) if f.latched is not None else None,
    "unknown": lambda f: NotNow(_UNKNOWN) if f.unknown else None,
    "unread": lambda f: NotNow(_UNREAD.format(f.unread)) if f.unread else None,
    "leased": lambda f: Leased(f.leased) if f.leased is not None else None,
    "held": lambda f: NotNow(f"held: {f.held.text}") if f.held is not None else None,
    "flashes": lambda f: f.flashes,
}
_UNKNOWN = "it is unknown whether the stage is dark: send a blackout"
_STALE = "{:.0f} s passed before it could start; look at the stage, then start it again"
_UNREAD = "the captures on the disk are still being read: {:,} to come"
