"""May light be put on now? One table: every way that leads to a lamp, and all that refuses it.

Whatever is lit is lit under a `Permission` (stage_service/devices/permission.py), and this table
grants it: the wrappers of light bank, projectors and trigger box command nothing without one that
is live. It is granted to one run, and what that run lights again (the next step, a missed frame, a
sequence that the trigger box clocks) needs it to be live still. Blackout, abort, the latch, a
standstill and the end of the service or of the run revoke it for good; a pause suspends it, and
`resume` asks this table. A service starts without any, and with the queue held, so that after a
start only a person's word puts a lamp on.

Arming is part of that word: `armed_by` answers for the flashes of one run, is on the disk before
the first of them, and is kept for no other run. What is shot again after a restart, or started from
the queue, has to be armed anew.
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
"""What puts light on: a person's `POST /captures` and `/snapshot`, `/captures/{id}/resume` of one
that is done and did not complete, `/queue/{id}/start`, and `/captures/{id}/resume` after a pause;
last the queue, by itself."""

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
"""Conditions, in the order in which they are looked at, by ways. A run that resumes is the one that
runs, and was armed when it started."""


class Busy(RuntimeError):
    """Another capture is running; the stage makes one at a time."""

    def __init__(self, running: str) -> None:
        super().__init__(f"capture {running} is running; wait for it, or abort it first")
        self.running = running


class NotNow(RuntimeError):
    """Light may not be put on at this moment; the message says why."""


STALE_S = 30.0
"""A word counts for so many seconds: whoever gave it still looks at the stage. Reading a head and
making a folder take less; a service that was stopped, or a machine that slept, takes longer."""


@dataclass(frozen=True)
class Moment:
    """When a word was given: how often all permissions had been revoked by then, and
    `boot_seconds`."""

    revocations: int
    at: float


@dataclass(frozen=True)
class Word:
    """On whose word light is to go on: `lease` is the token that they sent, `armed_by` answers for
    flashes, `who` is for the record. `given`: when; None: when it comes to the stage."""

    way: Way = "capture"
    lease: str | None = None
    armed_by: str | None = None
    who: str = SERVICE
    given: Moment | None = None


@dataclass(frozen=True)
class Facts:
    """How the stage is at one moment, as far as the table goes."""

    closing: bool = False
    """The service ends."""
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
    """Nobody has read back, or looked, whether the stage is dark."""
    unread: int = 0
    """Captures on the disk that were not read yet: one of them may be the queue's own."""
    leased: Lease | None = None
    """Somebody else's."""
    held: Held | None = None
    """The queue is."""
    flashes: FlashRefusal | None = None
    """The plan's flashes lack consent, or somebody who has armed them."""


def check(way: Way, facts: Facts) -> None:
    """Raise what refuses this way now: `NotNow`, `Busy`, `Unsafe`, `Leased`, `FlashRefusal`."""
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
_UNKNOWN = "whether the stage is dark is not known: send a blackout"
_STALE = (
    "{:.0f} s passed before it could begin; whoever started it may no longer watch: start it again"
)
_UNREAD = "the captures on the disk are still being read: {:,} to come"
