"""The porch: connections whose first request has not been read yet.

Each is accepted at once, so that none waits behind others in the kernel, and takes a few dozen
microseconds of the event loop until its first request is there. Then it is known whose it is: it
goes in, or is held until its owner has a place and a turn, and refused where that takes too long.
Refusing late is part of it: whoever opens a new connection for each that was refused does so once
in `HELD_S` for each socket.
"""

from __future__ import annotations

import asyncio
import fcntl
import select
import socket
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass

from stage_service.api.connections import HALL, HEADER_S, MOST_HEADER_BYTES

MOST, LOWEST = 4096, 1024
"""Connections on the porch, where the process may open `MOST + LOWEST` files and more; else there
are `HALL`. Their descriptors are above `LOWEST`: those below are all that `select` can watch, and
are left to the stage's devices."""
AT_ONCE = 128
"""Connections that are accepted before the event loop turns to something else."""
HELD_S = 5.0
"""Who has had no place and no turn within this time is refused."""
LINGER_S = 2.0
"""How long a client that is refused may go on sending, lest it lose the answer."""
PACE_S, SHOOTING_PACE_S = 5e-3, 50e-3
"""From one connection that has waited for its turn to the next; the second while a capture is shot:
one takes about 0.5 ms of the event loop."""


@dataclass(frozen=True)
class Verdict:
    """What becomes of a connection: it goes in at once, or in its `owner`'s turn as soon as `may()`
    allows it; until then `refusal()` is what it would be answered."""

    owner: object
    at_once: bool
    may: Callable[[], bool]
    refusal: Callable[[], bytes]


@dataclass(eq=False)
class _Guest:
    link: socket.socket
    address: str
    since: float
    verdict: Verdict | None = None


class Porch:
    """Accepts connections, has each judged by the head of its first request and the client's
    address, and hands over those that may go in. For one event loop, and no other thread."""

    def __init__(
        self,
        judge: Callable[[bytes, str], Verdict],
        admit: Callable[[socket.socket], object],
        shooting: Callable[[], bool],
        files: int,
        *,
        encrypted: bool = False,
    ) -> None:
        """With `encrypted` there is no head to read: the judge is given none. `files` is how many
        the process may open."""
        self._judge, self._admit, self._shooting = judge, admit, shooting
        self._encrypted = encrypted
        self._high = files >= MOST + LOWEST
        self._most = MOST if self._high else HALL
        self._loop = asyncio.get_running_loop()
        self._poll = select.epoll()
        self._listeners: list[socket.socket] = []
        self._silent: dict[int, _Guest] = {}
        self._held: dict[object, deque[_Guest]] = {}
        self._refused: dict[int, _Guest] = {}
        self._turn: asyncio.TimerHandle | None = None
        self._let_in = 0.0
        self._loop.add_reader(self._poll.fileno(), self._look)
        self._sweep = self._loop.call_later(HEADER_S / 10, self._end_late)

    def listen(self, listener: socket.socket, queued: int) -> None:
        """Accept what comes there from now on."""
        listener.setblocking(False)
        listener.listen(queued)
        self._listeners.append(listener)
        self._loop.add_reader(listener.fileno(), self._accept, listener)

    def close(self) -> None:
        """Accept nothing more, and end what is here."""
        for listener in self._listeners:
            self._loop.remove_reader(listener.fileno())
        self._loop.remove_reader(self._poll.fileno())
        for timer in filter(None, (self._sweep, self._turn)):
            timer.cancel()
        held = [guest for guests in self._held.values() for guest in guests]
        for guest in [*self._silent.values(), *held, *self._refused.values()]:
            guest.link.close()
        self._poll.close()

    def _accept(self, listener: socket.socket) -> None:
        for _ in range(AT_ONCE):
            try:
                link, address = listener.accept()
            except BlockingIOError:
                return
            except OSError:  # no descriptor is left, or the client has gone
                self._make_room()
                return
            link.setblocking(False)
            with suppress(OSError):  # a Unix socket has no such delay
                link.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            if self._high:
                link = _above(link)
            host = address[0] if isinstance(address, tuple) else ""
            self._silent[link.fileno()] = _Guest(link, host, self._loop.time())
            self._poll.register(link.fileno(), select.EPOLLIN | select.EPOLLET)
            if self._count() > self._most:
                self._make_room()

    def _count(self) -> int:
        return len(self._silent) + len(self._refused) + sum(map(len, self._held.values()))

    def _make_room(self) -> None:
        """End the one that has said nothing for longest, once all that has come is read; else the
        one that was refused first, or has been held for longest."""
        self._look()
        for guests in (self._silent, self._refused):
            if guests:
                self._end(guests.pop(next(iter(guests))))
                return
        queues = [queue for queue in self._held.values() if queue]
        if queues:
            self._end(min(queues, key=lambda queue: queue[0].since).popleft())

    def _look(self) -> None:
        """See to whatever has sent something, or gone."""
        for number, _ in self._poll.poll(0):
            if (guest := self._silent.get(number)) is not None:
                self._read(guest)
            elif (guest := self._refused.get(number)) is not None and _drained(guest.link):
                self._end(self._refused.pop(number))

    def _read(self, guest: _Guest) -> None:
        try:
            head = guest.link.recv(MOST_HEADER_BYTES, socket.MSG_PEEK)
        except BlockingIOError:
            return
        except OSError:
            head = b""
        whole = b"\r\n\r\n" in head or len(head) >= MOST_HEADER_BYTES
        if head and not (whole or self._encrypted):
            return
        del self._silent[guest.link.fileno()]
        if not head:
            self._end(guest)
            return
        verdict = guest.verdict = self._judge(b"" if self._encrypted else head, guest.address)
        if verdict.at_once:
            self._go_in(guest)
        else:
            guest.since = self._loop.time()
            self._held.setdefault(verdict.owner, deque()).append(guest)
            self._next_turn()

    def _go_in(self, guest: _Guest) -> None:
        self._poll.unregister(guest.link.fileno())
        self._admit(guest.link)

    def _next_turn(self) -> None:
        if self._turn is None and self._held:
            pace = SHOOTING_PACE_S if self._shooting() else PACE_S
            self._turn = self._loop.call_at(self._let_in + pace, self._let_one_in)

    def _let_one_in(self) -> None:
        """Let one in whose owner may: owners take turns, and the newest of each is first, whose
        client still waits."""
        self._turn, self._let_in = None, self._loop.time()
        for owner in list(self._held):
            guests = self._held.pop(owner)
            verdict = guests[-1].verdict if guests else None
            may = verdict is not None and verdict.may()
            if may:
                self._go_in(guests.pop())
            if guests:
                self._held[owner] = guests  # at the end
            if may:
                break
        self._next_turn()

    def _end_late(self) -> None:
        """End who has said nothing in time, and refuse who was held for too long."""
        now = self._loop.time()
        self._sweep = self._loop.call_later(HEADER_S / 10, self._end_late)
        for guests, most_s in ((self._silent, HEADER_S), (self._refused, LINGER_S)):
            for number in [n for n, guest in guests.items() if now - guest.since > most_s]:
                self._end(guests.pop(number))
        for held in self._held.values():
            while held and now - held[0].since > HELD_S:
                self._refuse(held.popleft())

    def _refuse(self, guest: _Guest) -> None:
        assert guest.verdict is not None
        try:
            gone = _drained(guest.link)
            guest.link.send(guest.verdict.refusal())
            guest.link.shutdown(socket.SHUT_WR)
        except OSError:
            gone = True
        if gone:
            self._end(guest)
        else:
            guest.since = self._loop.time()
            self._refused[guest.link.fileno()] = guest

    def _end(self, guest: _Guest) -> None:
        guest.link.close()


def _above(link: socket.socket) -> socket.socket:
    """The same connection by a descriptor that is left free by `select`'s."""
    number = fcntl.fcntl(link.fileno(), fcntl.F_DUPFD_CLOEXEC, LOWEST)
    link.close()
    return socket.socket(fileno=number)


def _drained(link: socket.socket) -> bool:
    """Forget what was sent; whether the client has gone. What is closed with unread bytes is reset,
    and an answer is lost with it."""
    try:
        for _ in range(16):
            if not link.recv(1 << 16):
                return True
    except BlockingIOError:
        return False
    except OSError:
        return True
    return False
