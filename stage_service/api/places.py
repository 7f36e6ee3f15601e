"""Places: how much each caller may hold at once, and what is kept for those who steer.

A caller counts by its token's name. Of each kind some places are out of reach of all tokens without
the scope `steer` together, whatever these open, and some out of reach of these and of any one token
that has it.
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
    """Places of one kind: `all` of them, `others` for all tokens without `steer` together, `each`
    for one token without it, `steering` for one token with it. Whoever finds none waits up to
    `wait_s` seconds. `what` they are, and what to do `instead`, for the refusal."""

    all: int
    others: int
    each: int
    steering: int
    wait_s: float
    what: str
    instead: str


LIMITS: dict[Kind, Limit] = {
    # These and the 112 of `connections.UNNAMED` are half of the descriptors that `select`, and most
    # systems, allow a process: the capture's files and devices have the other half. A browser opens
    # up to 6.
    "connections": Limit(400, 144, 64, 224, 0, "connections", "close those that are idle"),
    # One for each open page; each costs about 0.1 ms for each round of news.
    "streams": Limit(256, 48, 16, 200, 0, "event streams", "close one"),
    # Threads of blackout, abort and hold. The third blackout of a token waits for its first.
    "stops": Limit(64, 6, 2, 16, 10.0, "stops under way", "wait for their answers"),
    # Python runs one thread at a time: each that works delays a blackout. The framework has threads
    # for 40, so that 16 are left for the console's files.
    "requests": Limit(24, 4, 2, 16, 10.0, "requests at work", "send fewer at a time"),
    # Each has up to 32 MiB in memory.
    "uploads": Limit(4, 1, 1, 2, 10.0, "uploads", "wait until one has ended"),
    # Each has up to 256 KiB in memory, and a descriptor.
    "downloads": Limit(32, 12, 4, 16, 0, "downloads", "read them to their end, or close them"),
    # They take turns at one process, and trace on every core; a viewer's page sends several.
    "renders": Limit(8, 3, 2, 4, 30.0, "renders", "wait until one has ended"),
}
"""All limits, and the reason of each."""

FILES: tuple[Kind, ...] = ("connections", "streams")
"""Of which there are fewer where a process may open few files."""
AGAIN_S = 5
"""When somebody who was refused may find a place: an answer that nobody takes is ended by then."""


@dataclass(frozen=True)
class Owner:
    """Whose a place is: a token's, by its name, or that of all who sent none from one `address`;
    and whether it may steer the stage."""

    name: str = ""
    address: str = ""
    steers: bool = False

    @classmethod
    def of(cls, identity: Identity | None, client: tuple[str, int] | None) -> Self:
        """The owner of what somebody of this identity opens at this address."""
        if identity is None:
            return cls(address=client[0] if client else "this machine")
        return cls(identity.name, steers="steer" in identity.scopes)

    def __str__(self) -> str:
        if self.name:
            return f"token {self.name!r}"
        return f"{self.address} without a token" if self.address else "everybody together"


class NoPlace(RuntimeError):
    """There is no place; the message says which limit, how many the caller has, and what to do.

    `status` is 429 where the caller's own limit is reached, 503 where others have the places.
    """

    def __init__(self, limit: Limit, owner: Owner, held: int) -> None:
        most = limit.steering if owner.steers else limit.each
        self.status = 429 if held >= most else 503
        if held >= most:
            why = f"{owner} has {held} {limit.what}, of {most} that it may have"
        elif owner.steers:
            why = f"all {limit.all} {limit.what} are taken; {owner} has {held} of them"
        else:
            why = (
                f"the {limit.others} {limit.what} of all tokens without the scope 'steer' are "
                f"taken; {owner} has {held} of them"
            )
        super().__init__(f"{why}: {limit.instead}, and try again in {AGAIN_S} s")


class Places:
    """Who has how much of each kind. For one event loop, and no other thread."""

    def __init__(self, share: float = 1.0) -> None:
        """With this share of connections and streams, where the process may open few files."""
        self._share = share
        self._held: dict[Kind, Counter[Owner]] = {kind: Counter() for kind in LIMITS}
        self._waiting: dict[Kind, dict[Owner, deque[asyncio.Future[None]]]] = {
            kind: {} for kind in LIMITS
        }

    def held(self, kind: Kind, owner: Owner | None = None) -> int:
        """How many there are of a kind: of one owner, or of all."""
        found = self._held[kind]
        return found.total() if owner is None else found[owner]

    def lacks(self, kind: Kind, owner: Owner) -> NoPlace | None:
        """Why the owner would have no place now."""
        free = self._free(kind, owner)
        return None if free else NoPlace(self._limit(kind), owner, self._held[kind][owner])

    def take(self, kind: Kind, owner: Owner) -> None:
        """Take a place, to be given back by `leave`. Raises `NoPlace`."""
        if (refusal := self.lacks(kind, owner)) is not None:
            raise refusal
        self._held[kind][owner] += 1

    async def wait(self, kind: Kind, owner: Owner) -> None:
        """Take a place once there is one. Raises `NoPlace` after the kind's `wait_s` seconds."""
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
            if granted.done() and not granted.cancelled():  # it was given one at that moment
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
        """Give a place back: to whoever waits and may have it, those who steer first, then the
        owner that has fewest."""
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
        """A place for as long as the block. Raises `NoPlace`."""
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
    """Whether somebody still waits there; takes out those who have just given up."""
    while queue and queue[0].done():
        queue.popleft()
    return bool(queue)


def _part(limit: Limit, share: float) -> Limit:
    """The limit for fewer places, of which some are still kept."""
    return replace(
        limit,
        all=max(1, int(share * limit.all)),
        others=max(1, int(share * limit.others)),
        each=max(1, int(share * limit.each)),
        steering=max(1, int(share * limit.steering)),
    )
