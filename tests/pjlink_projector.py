"""A projector's side of PJLink class 1 on TCP: power and lamp, and what goes wrong on its wire.

Written from the PJLink Specifications 1.04 (JBMIA): greeting, authentication, POWR, LAMP, errors.
"""

from __future__ import annotations

import secrets
import socketserver
import threading
import time
from collections.abc import Callable
from hashlib import md5

GREETING = "GREETING"
"""What `strikes` is asked before the projector greets a new connection."""
IDLE_S = 30.0
STANDBY, ON, COOLING, WARM_UP = range(4)


class SimulatedProjector:
    """The projector behind the protocol: one lamp that takes its time to warm up and to cool.

    `lamps` False: it counts no lamp hours. `clock` is monotonic seconds. Safe to call from
    several threads.
    """

    def __init__(
        self,
        warm_up_s: float = 60.0,
        cooling_s: float = 90.0,
        hours: float = 1234.0,
        lamps: bool = True,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._times = {WARM_UP: (warm_up_s, ON), COOLING: (cooling_s, STANDBY)}
        self._lamps = lamps
        self._clock = clock
        self._state, self._since = STANDBY, clock()
        self._hours, self._counted = hours, clock()
        self._lock = threading.Lock()

    def reply(self, command: str) -> str:
        """The answer to one command, without its end."""
        with self._lock:
            self._look()
            match command.partition(" "):
                case ("%1POWR", _, "?"):
                    text = str(self._state)
                case ("%1POWR", _, "0" | "1" as wanted):
                    text = self._switch(wanted == "1")
                case ("%1POWR", _, _):
                    text = "ERR2"
                case ("%1LAMP", _, "?") if self._lamps:
                    text = f"{int(self._hours)} {int(self._lit)}"
                case _:
                    text = "ERR1"
        return f"{command[:6]}={text}"

    @property
    def _lit(self) -> bool:
        return self._state in (ON, WARM_UP)

    def _switch(self, on: bool) -> str:
        if self._state == (COOLING if on else WARM_UP):
            return "ERR3"
        if on != self._lit:
            self._state, self._since = (WARM_UP if on else COOLING), self._clock()
        return "OK"

    def _look(self) -> None:
        now = self._clock()
        if self._lit:
            self._hours += (now - self._counted) / 3600
        self._counted = now
        lasts, then = self._times.get(self._state, (float("inf"), self._state))
        if now - self._since >= lasts:
            self._state = then


class PjLinkServer(socketserver.ThreadingTCPServer):
    """Serves `projector` on a free port of this machine, or `port`.

    `strikes(command)` is the fault at this command, or at `GREETING`: silent (no answer), garbage,
    cut (half of it, then closed), slow (byte by byte, and never the last one); or, not carried out:
    busy (ERR3), failure (ERR4), lie (OK). None: no fault.
    """

    allow_reuse_address = True
    daemon_threads = True

    def __init__(
        self,
        projector: SimulatedProjector,
        password: str = "",
        strikes: Callable[[str], str | None] = lambda _command: None,
        port: int = 0,
    ) -> None:
        super().__init__(("127.0.0.1", port), _Connection)
        self.projector = projector
        self.password = password
        self.strikes = strikes
        self.ending = threading.Event()
        self._thread = threading.Thread(target=self.serve_forever, args=(0.05,), daemon=True)

    @property
    def port(self) -> int:
        """Where it listens."""
        return int(self.server_address[1])

    def start(self) -> None:
        """Answer from now on."""
        self._thread.start()

    def stop(self) -> None:
        """Close the port."""
        self.ending.set()
        self.shutdown()
        self._thread.join()
        self.server_close()


class _Connection(socketserver.StreamRequestHandler):
    """One controller's connection: greeting, then commands until it is closed or idle."""

    server: PjLinkServer
    timeout = IDLE_S

    def handle(self) -> None:
        seed = secrets.token_hex(4) if self.server.password else ""
        expected = md5((seed + self.server.password).encode(), usedforsecurity=False).hexdigest()
        if not self._say(f"PJLINK 1 {seed}" if seed else "PJLINK 0", self.server.strikes(GREETING)):
            return
        while True:
            command = self._command()
            if command is None:
                return
            if seed:
                if not command.startswith(expected):
                    self._say("PJLINK ERRA", None)
                    return
                seed, command = "", command.removeprefix(expected)
            fault = self.server.strikes(command)
            if not self._say(self._reply(command, fault), fault):
                return

    def _reply(self, command: str, fault: str | None) -> str:
        instead = {"busy": "ERR3", "failure": "ERR4", "lie": "OK"}.get(fault or "")
        if instead is not None:
            return f"{command[:6]}={instead}"
        return self.server.projector.reply(command)

    def _command(self) -> str | None:
        data = b""
        try:
            while not data.endswith(b"\r"):
                byte = self.rfile.read(1)
                if not byte:
                    return None
                data += byte
        except OSError:
            return None
        return data[:-1].decode("ascii", "replace")

    def _say(self, line: str, fault: str | None) -> bool:
        """Send it; False where the connection is over."""
        data = line.encode() + b"\r"
        try:
            if fault == "silent":
                return True
            if fault == "garbage":
                data = b"\xff\x00\x1b[A" + data[4:]
            elif fault == "cut":
                self.wfile.write(data[: len(data) // 2])
                return False
            elif fault == "slow":
                for byte in data[:-1]:
                    self.wfile.write(bytes((byte,)))
                    self.server.ending.wait(0.02)
                return True
            self.wfile.write(data)
        except OSError:
            return False
        return True
