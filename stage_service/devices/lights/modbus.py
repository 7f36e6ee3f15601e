"""A light bank on Modbus, TCP or RTU; `docs/reference/wire.md` has its register map."""

from __future__ import annotations

import logging
import threading
from collections.abc import Sequence

from stage_service.device_config import OWNER_WORDS, ModbusRtuConfig, ModbusTcpConfig
from stage_service.devices.errors import DeviceError, DeviceTimeout, DeviceUnreachable
from stage_service.devices.lights import limits
from stage_service.devices.lights import modbus_frames as frames
from stage_service.devices.lights import modbus_links as links
from stage_service.devices.lights.interface import (
    LightCapabilities,
    LightStatus,
    Lit,
    lamps_lit,
    mismatch_todo,
)
from stage_service.devices.lights.modbus_registers import (
    TABLE_ENTRIES,
    check_apart,
    text_of,
    words_of,
)

log = logging.getLogger("hairstage.lights")
ALL_ON, ALL_OFF = 65535, 0
MOST_WRITTEN, MOST_READ = 122, 124  # even, so that a table's entries stay whole; of 123 and 125
MOST_COILS = 1968
_ATTEMPTS = 3
_EXCEPTIONS = {1: "illegal function", 2: "illegal address", 3: "illegal value", 4: "refused now"}


class _OutOfStep(DeviceError):
    """The reply belongs to another request."""


class ModbusLightBank:
    """Implements `LightBank`; see there for the contract.

    Any failure closes the link; the next request opens it, drains it and identifies the bank first,
    so that no late reply is taken for a later one's. Raises `RigError` where registers overlap.
    """

    def __init__(self, config: ModbusTcpConfig | ModbusRtuConfig, lamps: int) -> None:
        check_apart(config.registers, lamps)
        port = config.port
        place = port if isinstance(config, ModbusRtuConfig) else f"{config.host}:{port}"
        self.name = f"light bank ({place})"
        self.config = config
        self._map = r = config.registers
        self.capabilities = LightCapabilities(
            reads_back=r.lit is not None,
            dead_man=None not in (r.heartbeat, r.watchdog),
            table=TABLE_ENTRIES if config.sequences else 0,
            owned=r.owner is not None,
        )
        self.count = lamps
        self._level: int | None = None
        self._armed: int | None = None  # entries; None: not known
        self._owner = 0
        self._link: links.ModbusLink | None = None
        self._identified = False
        self._out_of_step = False
        self._resyncs = 0
        self._echo_logged = False
        self._lock = threading.RLock()

    def connect(self) -> None:
        """Connect; raises `DeviceError` where the peer is no light bank, has another size, or
        cannot guarantee a blackout and the rig file does not accept that."""
        accepted = self.config.accept_unverified_blackout
        limits.refuse_unverified_blackout(self.name, self.capabilities, accepted)
        with self._lock:
            self._identified = False
            self._trust()

    def close(self) -> None:
        with self._lock:
            if self._link is not None:
                self._link.close()
            self._link = self._level = self._armed = None
            self._identified = False

    def select(self, lamp: int) -> None:
        if not 0 <= lamp < self.count:
            raise ValueError(f"{self.name}: lamps are 0 to {self.count - 1}, got {lamp}")
        self._command(lamp + 1, 1, f"putting lamp {lamp} on")

    def all_on(self) -> None:
        self._command(ALL_ON, self.count, "putting all lamps on")

    def show(self, levels: Sequence[float]) -> None:
        doing = "putting lamps on at levels of their own"
        words = limits.level_words(self.name, doing, levels, self.count, self.config.level_steps())
        on = [word > 0 for word in words]
        with self._lock:
            self._trust()
            self._put(ALL_OFF, doing)  # lamps that are on would take the new levels
            if self._map.levels is not None:
                self._level = None
                self._write(words, self._map.levels, doing)
            self._switch(on, doing)
            if self.capabilities.reads_back:
                self._confirm(sum(on), doing)

    def off(self) -> None:
        doing = "putting all lamps off"
        with self._lock:
            if not self._identified:
                # Before the link is trusted: a bank whose replies are lost must go dark, too.
                self._open(doing)
                try:
                    self._put(ALL_OFF, doing)
                except (DeviceTimeout, DeviceUnreachable):
                    raise
                except DeviceError:
                    pass  # sent again, and confirmed, below
            self._command(ALL_OFF, 0, doing)
            self._armed = 0

    def set_level(self, level: float) -> None:
        """Set every lamp's level, unless it is set already; without level registers it is 1."""
        doing = f"setting the level to {level:g}"
        if self._map.levels is None and level == 1.0:
            return
        first = self._required(self._map.levels, doing, "level registers")
        value = self._level_word(level, doing)
        with self._lock:
            if value == self._level:
                return
            self._level = None
            self._write([value] * self.count, first, doing)
            self._level = value

    def set_watchdog(self, seconds: float) -> None:
        """Set the watchdog time, 0.1 to 60 s."""
        doing = f"setting the watchdog to {seconds:g} s"
        register = self._required(self._map.watchdog, doing, "a watchdog register")
        self._write([round(seconds * 1000)], register, doing)

    def heartbeat(self) -> None:
        """Feed the watchdog. Raises where the bank has lost its owner: by a power-up, after which
        levels are full and no sequence is armed, or to another service."""
        doing = "sending a heartbeat"
        register = self._required(self._map.heartbeat, doing, "a heartbeat register")
        with self._lock:
            self._write([1], register, doing)
            if not self._owner or self._map.owner is None:
                return
            (held,) = self._read("read_holding_registers", self._map.owner, 1, doing)
            if held != self._owner:
                self._level = self._armed = None
                expected = f"the bank to be service {self._owner}'s"
                received = f"service {held}'s" if held else "no owner: the bank was powered up"
                todo = "Frames since the last heartbeat may be lit at another level: check the "
                todo += "bank's supply and other services, then resume or shoot again."
                raise self._error(doing, expected, received, todo)

    def claim(self, number: int, name: str) -> str | None:
        """Write `number` to the owner register, which refuses it (exception 4) while it holds
        another service's, and the name into the registers behind it."""
        doing = "taking the stage" if number else "releasing the stage"
        first = self._required(self._map.owner, doing, "an owner register")
        with self._lock:
            self._trust()
            try:
                self._exchange(doing, "write_register", first, number)
            except DeviceError:
                held, *words = self._read("read_holding_registers", first, OWNER_WORDS, doing)
                if held in (0, number):
                    raise
                return text_of(words) or f"a service that gave no name ({held})"
            if number:
                self._exchange(doing, "write_registers", first + 1, words_of(name))
            self._owner = number
        return None

    def status(self) -> LightStatus:
        doing = "reading the status"
        lit = self._required(self._map.lit, doing, "a register with the number of lit lamps")
        first = self._map.status
        if first is not None and lit == first + 1:
            bits, count = self._read("read_input_registers", first, 2, doing)
        else:
            with self._lock:
                bits = 0 if first is None else self._input(first, doing)
                count = self._input(lit, doing)
        return LightStatus(bool(bits & 1), bool(bits & 2), bool(bits & 4), count)

    def load_sequence(self, entries: Sequence[tuple[Lit, float]]) -> None:
        doing = f"loading a sequence of {len(entries)} steps"
        table = self._required(self._map.table, doing, "a sequence table")
        sequence = self._required(self._map.sequence, doing, "a sequence register")
        if not 1 <= len(entries) <= self.capabilities.table:
            most = self.capabilities.table
            raise ValueError(f"{self.name}: a sequence has 1 to {most} steps, got {len(entries)}")
        words = [word for what, level in entries for word in self._entry(what, level)]
        with self._lock:
            self.off()
            self._write(words, table, doing)
            self._level = None  # entries set levels, too
            for start in range(0, len(words), MOST_READ):
                wanted = words[start : start + MOST_READ]
                got = self._read("read_holding_registers", table + start, len(wanted), doing)
                if got != wanted:
                    at = next(i for i, (a, b) in enumerate(zip(wanted, got, strict=True)) if a != b)
                    doing = f"{doing}: reading the table back"
                    expected = f"{wanted[at]} at register {table + start + at}"
                    todo = "Load it again; if it stays, the bank's table or its map is wrong."
                    raise self._error(doing, expected, f"{got[at]}", todo)
            self._armed = None
            self._write([len(entries)], sequence, f"{doing}: arming it")
            self._armed = len(entries)
            if self.capabilities.reads_back:
                self._confirm(0, f"{doing}: arming it")

    def position(self) -> int:
        doing = "reading the position in the sequence"
        position = self._input(self._required(self._map.position, doing, "a position"), doing)
        if self._armed is not None and position > self._armed:
            todo = "The gate closed more often than the sequence has steps: check the gate's wire."
            raise self._error(doing, f"at most {self._armed} steps, as armed", f"{position}", todo)
        return position

    def _entry(self, what: Lit, level: float) -> tuple[int, int]:
        if isinstance(what, int) and not 0 <= what < self.count:
            raise ValueError(f"{self.name}: lamps are 0 to {self.count - 1}, got {what}")
        selector = {"all": ALL_ON, "none": ALL_OFF}.get(what) if isinstance(what, str) else what + 1
        return selector or 0, self._level_word(level, "loading a sequence")

    def _level_word(self, level: float, doing: str) -> int:
        return limits.level_word(self.name, doing, level, self._map.level_full)

    def _command(self, selector: int, lit: int, doing: str) -> None:
        with self._lock:
            self._trust()
            self._put(selector, doing)
            if self.capabilities.reads_back:
                self._confirm(lit, doing)

    def _put(self, selector: int, doing: str) -> None:
        if selector == ALL_OFF and self._map.sequence is not None and self._armed != 0:
            # An armed sequence refuses the selector; this leaves it and puts all lamps off.
            self._exchange(doing, "write_register", self._map.sequence, 0)
        if self._map.selector is not None:
            self._exchange(doing, "write_register", self._map.selector, selector)
            return
        self._switch([selector in (ALL_ON, lamp + 1) for lamp in range(self.count)], doing)

    def _switch(self, on: Sequence[bool], doing: str) -> None:
        """Write every lamp's coil."""
        starts = range(0, self.count, MOST_COILS)
        # Chunks without a lit lamp first, so that never two lamps are on.
        for start in sorted(starts, key=lambda s: any(on[s : s + MOST_COILS])):
            part = on[start : start + MOST_COILS]
            self._exchange(doing, "write_coils", self._map.coils + start, part)

    def _confirm(self, lit: int, doing: str) -> None:
        status = self.status()
        if status.lit == lit:
            return
        received = f"{status.lit} lit{status.causes}"
        raise self._error(doing, lamps_lit(lit), received, mismatch_todo(lit, status))

    def _write(self, values: list[int], first: int, doing: str) -> None:
        """Write registers from `first` on, in chunks."""
        with self._lock:
            self._trust()
            if len(values) == 1:
                self._exchange(doing, "write_register", first, values[0])
                return
            for start in range(0, len(values), MOST_WRITTEN):
                part = values[start : start + MOST_WRITTEN]
                self._exchange(doing, "write_registers", first + start, part)

    def _input(self, address: int, doing: str) -> int:
        return self._read("read_input_registers", address, 1, doing)[0]

    def _read(self, method: str, address: int, count: int, doing: str) -> list[int]:
        with self._lock:
            self._trust()
            return frames.registers(self._exchange(doing, method, address, count))

    def _trust(self) -> None:
        """Open a link to the right bank on which no reply is late, unless there is one."""
        if self._identified:
            return
        for attempt in range(1, _ATTEMPTS + 1):
            self._open("connecting")
            try:
                self._resynchronise()
                self._log_echo()
                break
            except _OutOfStep:
                if attempt == _ATTEMPTS:
                    raise
        self._identify()
        self._identified = True

    def _resynchronise(self) -> None:
        """Read a number of registers that differs from the last times, so that a late reply has
        another length than this one's."""
        doing = "resynchronising"
        self._resyncs += 1
        if self._map.levels is not None:
            count = 1 + self._resyncs % min(self.count, MOST_READ)
            self._exchange(doing, "read_holding_registers", self._map.levels, count)
        else:
            count = 1 + 8 * self._resyncs % min(self.count, MOST_COILS)
            self._exchange(doing, "read_coils", self._map.coils, count)

    def _log_echo(self) -> None:
        if self._link is not None and self._link.echoes and not self._echo_logged:
            self._echo_logged = True
            log.warning("%s: the adapter echoes what is sent; the echoes are dropped", self.name)

    def _identify(self) -> None:
        r, doing = self._map, "identifying"
        if r.signature is not None:
            address, wanted = r.signature
            (got,) = frames.registers(self._exchange(doing, "read_input_registers", address, 1))
            if got != wanted:
                expected = f"input register {address} to be {wanted:#06x}"
                todo = "Check port and unit in [devices.lights]: this is another device."
                raise self._error(doing, expected, f"{got:#06x}", todo)
        if r.count is not None:
            (lamps,) = frames.registers(self._exchange(doing, "read_input_registers", r.count, 1))
            if lamps != self.count:
                expected = f"{self.count} lamps as in the rig file"
                raise self._error(doing, expected, f"{lamps}", "Use the rig file of this stage.")
        if r.sequence is not None:
            reply = self._exchange(doing, "read_holding_registers", r.sequence, 1)
            (self._armed,) = frames.registers(reply)

    def _open(self, doing: str) -> None:
        if self._link is not None:
            return
        try:
            self._link = links.open_link(self.config)
            if self._out_of_step:
                # Late replies may still come: drop them.
                self._link.drain(self.config.timeout_s)
                self._out_of_step = False
        except OSError as error:
            self.close()
            todo = "Check power, cable, and the address in [devices.lights]."
            raise DeviceUnreachable(
                self.name, doing, "a connection", f"none ({error})", todo, self.config.timeout_s
            ) from error

    def _exchange(
        self, doing: str, method: str, address: int, payload: int | Sequence[int]
    ) -> bytes:
        """One request: `payload` is the count of a read, else the values written, a single number
        for "write_register". Returns the right reply, without its frame."""
        assert self._link is not None
        sent = frames.request(method, address, payload)
        try:
            reply = self._link.exchange(sent)
        except (links.NoReply, OSError) as error:
            raise self._no_reply(doing, error) from error
        except links.WrongReply as other:
            raise self._other_reply(
                doing, f"{frames.expected(sent)}, {other.expected}", other
            ) from other
        if reply[0] == sent[0] | frames.EXCEPTION and len(reply) == frames.EXCEPTION_SIZE:
            code = reply[1]
            received = f"Modbus exception {code} ({_EXCEPTIONS.get(code, 'see its manual')})"
            todo = "Check the registers in [devices.lights]; 4 also says that a sequence is armed."
            raise self._error(doing, "a reply", received, todo)
        if not frames.is_right(sent, reply):
            raise self._other_reply(doing, frames.expected(sent), frames.shown(reply))
        return reply

    def _no_reply(self, doing: str, error: links.NoReply | OSError) -> DeviceError:
        """The error where no reply came; closes the link."""
        self.close()
        left = "its watchdog switches the lamps off"
        if not self.capabilities.dead_man:
            left = "its lamps may still be lit"
        return links.no_reply(self.name, doing, error, self.config, left)

    def _other_reply(self, doing: str, expected: str, received: object) -> _OutOfStep:
        """The error for a reply to another request; closes the link."""
        self.close()
        self._out_of_step = True
        todo = "Replies were out of step; the next request opens the link again. If it "
        todo += "happens again, look for a second master."
        return _OutOfStep(self.name, doing, f"the reply {expected}", f"{received}", todo)

    def _required(self, address: int | None, doing: str, what: str) -> int:
        if address is None:
            raise limits.cannot(self.name, doing, what)
        return address

    def _error(self, doing: str, expected: str, received: str, todo: str) -> DeviceError:
        return DeviceError(self.name, doing, expected, received, todo)
