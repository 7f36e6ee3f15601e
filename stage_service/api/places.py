"""Places: how many connections, streams and requests each caller may hold at once.

Callers are counted by token name. Of each kind some places are reserved for tokens with the scope
`steer`, and no single one of these can take all of them.
"""

from __future__ import annotations

import asyncio
from collections import Counter, deque
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Literal, Self

from stage_service.records.tokens import Identity

Kind = Literal["connections", "streams", "stops", "requests", "uploads", "downloads", "renders"]


@dataclass(frozen=True)
class Limit:
    """Places of one kind: `all`, `others` for all tokens without `steer` together, `each` for one
    token without it, `steering` for one with it. A caller waits for one up to `wait_s` seconds.
    `what` and `instead` are the kind and the advice in a refusal."""

    all: int
    others: int
    each: int
    steering: int
    wait_s: float
    what: str
    instead: str


LIMITS: dict[Kind, Limit] = {
    # With the 112 of `connections.HALL` half of the descriptors that `select` allows a process; the
    # other half is for the capture's files and devices. A browser opens up to 6.
    "connections": Limit(400, 144, 64, 224, 0, "connections", "close those that are idle"),
    # One per open page; each costs about 0.1 ms per round of events.
    "streams": Limit(256, 48, 16, 200, 0, "event streams", "close one"),
    # Threads of blackout, abort and hold. The third blackout of a token waits for its first.
    "stops": Limit(64, 6, 2, 16, 10.0, "stops under way", "wait for their responses"),
    # Python runs one thread at a time, so each request delays a blackout. The framework has 40
    # threads; 16 are left for the console's files.
    "requests": Limit(24, 4, 2, 16, 10.0, "requests at work", "send fewer at a time"),
    # Each takes up to 32 MiB of memory.
    "uploads": Limit(4, 1, 1, 2, 10.0, "uploads", "wait until one has ended"),
    # Each takes up to 256 KiB of memory and a descriptor.
    "downloads": Limit(32, 12, 4, 16, 0, "downloads", "read them to their end, or close them"),
    # They share one process, which traces on every core; a viewer's page sends several.
    "renders": Limit(8, 3, 2, 4, 30.0, "renders", "wait until one has ended"),
}

FILES: tuple[Kind, ...] = ("connections", "streams")
"""Kinds that are reduced if the process may open few files."""
AGAIN_S = 5
"""Retry-After of a refusal, seconds: by then stalled responses have been ended."""


@dataclass(frozen=True)
class Owner:
    """The owner of a place: a token's `name`, or all callers without one at an `address`."""

    name: str = ""
    address: str = ""
    steers: bool = False

    @classmethod
    def of(cls, identity: Identity | None, client: tuple[str, int] | None) -> Self:
        """The owner of the requests of this identity and client address."""
        if identity is None:
            return cls(address=client[0] if client else "this machine")
        return cls(identity.name, steers="steer" in identity.scopes)

    def __str__(self) -> str:
        if self.name:
            return f"token {self.name!r}"
        return f"{self.address} without a token" if self.address else "all callers together"


class NoPlace(RuntimeError):
    """No place is free; the message has the limit, the caller's count, and what to do.

    `status` is 429 if the caller's own limit is reached, 503 if others have the places.
    """

    def __init__(self, limit: Limit, owner: Owner, held: int) -> None:
        most = limit.steering if owner.steers else limit.each
        self.status = 429 if held >= most else 503
        if held >= most:
            why = f"{owner} has {held} of at most {most} {limit.what}"
        elif owner.steers:
            why = f"all {limit.all} {limit.what} are taken; {owner} has {held} of them"
        else:
            why = (
                f"the {limit.others} {limit.what} of all tokens without the scope 'steer' are "
                f"taken; {owner} has {held} of them"
            )
        super().__init__(f"{why}: {limit.instead}, and try again in {AGAIN_S} s")


class Places:
    """Places in use by kind and owner. For one event loop only."""

    def __init__(self, share: float = 1.0) -> None:
        """`share` reduces connections and streams if the process may open few files."""
        self._share = share
        self._held: dict[Kind, Counter[Owner]] = {kind: Counter() for kind in LIMITS}
        self._waiting: dict[Kind, dict[Owner, deque[asyncio.Future[None]]]] = {
            kind: {} for kind in LIMITS
        }

    def held(self, kind: Kind, owner: Owner | None = None) -> int:
        """Number of places in use of a kind, by one owner or by all."""
        found = self._held[kind]
        return found.total() if owner is None else found[owner]

    def lacks(self, kind: Kind, owner: Owner) -> NoPlace | None:
        """Why the owner would get no place now; None if it would."""
        free = self._free(kind, owner)
        return None if free else NoPlace(self._limit(kind), owner, self._held[kind][owner])

    def take(self, kind: Kind, owner: Owner) -> None:
        """Take a place until `leave`. Raises `NoPlace`."""
        if (refusal := self.lacks(kind, owner)) is not None:
            raise refusal
        self._held[kind][owner] += 1

    async def wait(self, kind: Kind, owner: Owner) -> None:
        """Take a place when one is free. Raises `NoPlace` after the kind's `wait_s` seconds."""
        if self._free(kind, owner):
            self._held[kind][owner] += 1
            return
        granted = asyncio.get_running_loop().create_future()
        queue = self._waiting[kind].setdefault(owner, deque())
        queue.append(granted)
        try:
            async with asyncio.timeout(self._limit(kind).wait_s):
                await granted
        except BaseException as error:
            if granted.done() and not granted.cancelled():  # granted at that moment
                self.leave(kind, owner)
            elif granted in queue:
                queue.remove(granted)
            if isinstance(error, TimeoutError):
                raise NoPlace(self._limit(kind), owner, self._held[kind][owner]) from None
            raise
        finally:
            if not queue and self._waiting[kind].get(owner) is queue:
                del self._waiting[kind][owner]

    def leave(self, kind: Kind, owner: Owner) -> None:
        """Free a place and give it to a waiting owner: with `steer` first, then the one with
        fewest."""
        held, waiting = self._held[kind], self._waiting[kind]
        held[owner] -= 1
        if not held[owner]:
            del held[owner]
        able = [w for w, queue in waiting.items() if _first(queue) and self._free(kind, w)]
        if able:
            next_one = min(able, key=lambda w: (not w.steers, held[w]))
            held[next_one] += 1
            waiting[next_one].popleft().set_result(None)

    @contextmanager
    def holding(self, kind: Kind, owner: Owner) -> Iterator[None]:
        """Hold a place during the block. Raises `NoPlace`."""
        self.take(kind, owner)
        try:
            yield
        finally:
            self.leave(kind, owner)

    def _limit(self, kind: Kind) -> Limit:
        whole = kind not in FILES or self._share >= 1
        return LIMITS[kind] if whole else _part(LIMITS[kind], self._share)

    def _free(self, kind: Kind, owner: Owner) -> bool:
        held, limit = self._held[kind], self._limit(kind)
        if held.total() >= limit.all:
            return False
        if owner.steers:
            return held[owner] < limit.steering
        others = sum(count for who, count in held.items() if not who.steers)
        return held[owner] < limit.each and others < limit.others


def _first(queue: deque[asyncio.Future[None]]) -> bool:
    """Whether a waiter is left; removes those that have given up."""
    while queue and queue[0].done():
        queue.popleft()
    return bool(queue)


def _part(limit: Limit, share: float) -> Limit:
    """The limit scaled by `share`, at least 1 each."""
    return replace(
        limit,
        all=max(1, int(share * limit.all)),
        others=max(1, int(share * limit.others)),
        each=max(1, int(share * limit.each)),
        steering=max(1, int(share * limit.steering)),
    )
