"""The porch: accepted connections whose first request has not been read yet.

Connections are accepted at once, so that none waits in the kernel; each costs some 10 µs of the
event loop until its first request has arrived. Its owner is then known: it is admitted, or held
until the owner has a place and a turn, or refused after `HELD_S`. The late refusal limits clients
that reconnect after each one.
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
"""Connections on the porch if the process may open `MOST + LOWEST` files, else `HALL`. Their
descriptors are above `LOWEST`: lower ones, which `select` needs, are left to the stage's
devices."""
AT_ONCE = 128
"""Connections that are accepted in one pass of the event loop."""
HELD_S = 5.0
"""A connection without a place and a turn within this time is refused."""
LINGER_S = 2.0
"""How long a refused client may continue to send, so that it receives the refusal."""
PACE_S, SHOOTING_PACE_S = 5e-3, 50e-3
"""Seconds between admissions of held connections, and during a capture; one takes about 0.5 ms."""


@dataclass(frozen=True)
class Verdict:
    """Verdict on a connection: it is admitted at once, or in its `owner`'s turn once `may()` is
    true; `refusal()` is the response if that takes too long."""

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
    """Accepts connections, judges each by the head of its first request and the client's address,
    and admits those allowed. For one event loop only."""

    def __init__(
        self,
        judge: Callable[[bytes, str], Verdict],
        admit: Callable[[socket.socket], object],
        shooting: Callable[[], bool],
        files: int,
        *,
        encrypted: bool = False,
    ) -> None:
        """With `encrypted` connections the judge gets an empty head. `files` is the process's limit
        of open files."""
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
        """Accept connections of `listener` from now on."""
        listener.setblocking(False)
        listener.listen(queued)
        self._listeners.append(listener)
        self._loop.add_reader(listener.fileno(), self._accept, listener)

    def close(self) -> None:
        """Stop accepting, and close all connections here."""
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
        """End the connection that has been silent for longest, else the one refused first, else the
        one held for longest."""
        self._look()
        for guests in (self._silent, self._refused):
            if guests:
                self._end(guests.pop(next(iter(guests))))
                return
        queues = [queue for queue in self._held.values() if queue]
        if queues:
            self._end(min(queues, key=lambda queue: queue[0].since).popleft())

    def _look(self) -> None:
        """Process connections that have sent something or closed."""
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
        """Admit one connection: owners take turns; of each the newest, whose client still waits."""
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
        """End connections that were silent for too long; refuse those held for too long."""
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
    """The same connection with a descriptor above `select`'s."""
    number = fcntl.fcntl(link.fileno(), fcntl.F_DUPFD_CLOEXEC, LOWEST)
    link.close()
    return socket.socket(fileno=number)


def _drained(link: socket.socket) -> bool:
    """Discard what was sent; whether the client has gone. A connection closed with unread bytes is
    reset and loses the response."""
    try:
        for _ in range(16):
            if not link.recv(1 << 16):
                return True
    except BlockingIOError:
        return False
    except OSError:
        return True
    return False
