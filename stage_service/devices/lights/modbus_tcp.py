"""A light bank on Modbus TCP; `docs/wire.md` has its register map."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from typing import Any

from pymodbus import ModbusException
from pymodbus.client import ModbusTcpClient

from stage_service.config import ModbusTcpConfig
from stage_service.devices.errors import DeviceError, DeviceTimeout, DeviceUnreachable
from stage_service.devices.lights.interface import LightCapabilities, LightStatus, Lit

SELECTOR, HEARTBEAT, WATCHDOG = 1000, 1001, 1002
ALL_ON, ALL_OFF = 65535, 0
MOST_REGISTERS = 123
FULL_LEVEL = 65535
SIGNATURE = 0x4853


class ModbusLightBank:
    """Implements `LightBank` with pymodbus; see there for the contract."""

    capabilities = LightCapabilities(reads_back=True, dead_man=True, table=0)

    def __init__(self, config: ModbusTcpConfig, lamps: int) -> None:
        self.name = f"light bank ({config.host}:{config.port})"
        self.config = config
        self._lamps = lamps
        self._level: int | None = None
        self._client: ModbusTcpClient | None = None
        self._lock = threading.RLock()

    @property
    def count(self) -> int:
        """Number of lamps, as the rig file has it and `connect` has confirmed it."""
        return self._lamps

    def connect(self) -> None:
        """Connect; raises `DeviceError` where the peer is no light bank or has another size."""
        with self._lock:
            self._open()
            _, _, lamps, signature = self._read_input(0, 4, "identifying")
            if signature != SIGNATURE:
                raise self._error(
                    "identifying",
                    f"input register 3 to be {SIGNATURE:#06x}",
                    f"{signature:#06x}",
                    "Check host, port and unit in [devices.lights]: this is another device.",
                )
            if lamps != self._lamps:
                raise self._error(
                    "identifying",
                    f"{self._lamps} lamps as in the rig file",
                    f"{lamps}",
                    "Use the rig file of this stage.",
                )

    def close(self) -> None:
        """Close the connection; the lamps stay as they are."""
        with self._lock:
            if self._client is not None:
                self._client.close()  # type: ignore[no-untyped-call]
            self._client = None
            self._level = None

    def select(self, lamp: int) -> None:
        """Put exactly lamp `lamp` on, and confirm that one lamp is lit."""
        if not 0 <= lamp < self._lamps:
            raise ValueError(f"{self.name}: lamps are 0 to {self._lamps - 1}, got {lamp}")
        self._command(lamp + 1, 1, f"putting lamp {lamp} on")

    def all_on(self) -> None:
        """Put every lamp on, and confirm that all are lit."""
        self._command(ALL_ON, self._lamps, "putting all lamps on")

    def off(self) -> None:
        """Put every lamp off, and confirm that none is lit."""
        self._command(ALL_OFF, 0, "putting all lamps off")

    def set_level(self, level: float) -> None:
        """Set every lamp's level in chunks of 123 registers, unless it is set already."""
        if not 0 <= level <= 1:
            raise ValueError(f"{self.name}: a level is 0 to 1, got {level}")
        value = round(level * FULL_LEVEL)
        with self._lock:
            if value == self._level:
                return
            self._level = None
            for start in range(0, self._lamps, MOST_REGISTERS):
                count = min(MOST_REGISTERS, self._lamps - start)
                doing = f"setting the level of lamps {start} to {start + count - 1}"
                answer = self._ask(doing, "write_registers", start, [value] * count)
                if (answer.address, answer.count) != (start, count):
                    raise self._error(
                        doing,
                        f"the echo of {count} registers from {start}",
                        f"{answer.count} from {answer.address}",
                        "Answers are out of step: reconnect, and check for a second master.",
                    )
            self._level = value

    def set_watchdog(self, seconds: float) -> None:
        """Set the watchdog time, 0.1 to 60 s."""
        self._write(WATCHDOG, round(seconds * 1000), f"setting the watchdog to {seconds:g} s")

    def heartbeat(self) -> None:
        """Feed the watchdog."""
        self._write(HEARTBEAT, 1, "sending a heartbeat")

    def status(self) -> LightStatus:
        """Read status bits and the number of lamps that are lit."""
        bits, lit = self._read_input(0, 2, "reading the status")
        return LightStatus(bool(bits & 1), bool(bits & 2), bool(bits & 4), lit)

    def load_sequence(self, entries: Sequence[tuple[Lit, float]]) -> None:
        """Not there yet."""
        raise NotImplementedError

    def position(self) -> int:
        """Not there yet."""
        raise NotImplementedError

    def _command(self, selector: int, lit: int, doing: str) -> None:
        with self._lock:
            self._write(SELECTOR, selector, doing)
            status = self.status()
        if status.lit != lit:
            causes = [
                text
                for seen, text in (
                    (status.watchdog_tripped, "its watchdog has tripped"),
                    (status.interlock_open, "the interlock is open"),
                    (status.estop_pressed, "the emergency stop is pressed"),
                )
                if seen
            ]
            raise self._error(
                doing,
                f"{lit} lamps lit",
                f"{status.lit} lit" + "".join(f", {c}" for c in causes),
                "Clear the cause at the stage."
                if causes
                else "Check the lamp drivers' supply, and that nobody else writes to the bank.",
            )

    def _write(self, address: int, value: int, doing: str) -> None:
        answer = self._ask(doing, "write_register", address, value)
        if (answer.address, answer.registers) != (address, [value]):
            raise self._error(
                doing,
                f"the echo of {value} at register {address}",
                f"{answer.registers} at {answer.address}",
                "Answers are out of step: reconnect, and check for a second master.",
            )

    def _read_input(self, address: int, count: int, doing: str) -> list[int]:
        answer = self._ask(doing, "read_input_registers", address, count=count)
        registers: list[int] = answer.registers
        if len(registers) != count:
            raise self._error(
                doing,
                f"{count} registers",
                f"{len(registers)}",
                "Check that the device follows docs/wire.md.",
            )
        return registers

    def _open(self) -> ModbusTcpClient:
        if self._client is None:
            # retries=0: a command that is repeated unseen would hide a failing link, and the
            # default of three multiplies every deadline by four.
            client = ModbusTcpClient(
                self.config.host,
                port=self.config.port,
                timeout=self.config.timeout_s,
                retries=0,
            )
            if not client.connect():  # type: ignore[no-untyped-call]
                raise DeviceUnreachable(
                    self.name,
                    "connecting",
                    expected="a TCP connection",
                    received="none",
                    deadline_s=self.config.timeout_s,
                    todo="Check power, network, and host and port in [devices.lights].",
                )
            self._client = client
        return self._client

    def _ask(self, doing: str, method: str, *args: Any, **more: Any) -> Any:
        """One request. A late answer must never be taken for the next one's: on any trouble the
        connection is closed, and the next request opens a new one."""
        with self._lock:
            client = self._open()
            try:
                answer = getattr(client, method)(*args, device_id=self.config.unit, **more)
            except (ModbusException, OSError) as error:
                self.close()
                raise DeviceTimeout(
                    self.name,
                    doing,
                    expected="an answer",
                    received=f"none ({error})",
                    deadline_s=self.config.timeout_s,
                    todo="Check power and network of the bank; its watchdog puts the lamps off.",
                ) from error
            if answer.isError():
                raise self._error(
                    doing,
                    "an answer",
                    f"Modbus exception {getattr(answer, 'exception_code', answer)}",
                    "Check that the device follows docs/wire.md.",
                )
            return answer

    def _error(self, doing: str, expected: str, received: str, todo: str) -> DeviceError:
        return DeviceError(self.name, doing, expected=expected, received=received, todo=todo)
