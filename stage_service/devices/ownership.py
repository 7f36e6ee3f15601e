"""One service to a stage: two must not drive the same devices, whatever their root folders."""

from __future__ import annotations

import logging
import os
import re
import socket
import tempfile
import threading
import zlib
from pathlib import Path

from stage_service.device_config import DmxConfig, LightBankConfig, ModbusRtuConfig, ModbusTcpConfig
from stage_service.devices.errors import DeviceError
from stage_service.devices.lights.interface import LightBank
from stage_service.records.lease import FileLock, LockedBy

log = logging.getLogger("hairstage.ownership")
RELEASE_S = 1.0
"""Seconds that the end of a service waits for a bank that hangs."""


class StageInUse(DeviceError):
    """Another service has this stage; the message says which."""


class Ownership:
    """A service's exclusive use of the stage whose light bank `config` describes.

    On this machine: a lock file named for the bank's address, which the kernel frees when the
    process dies. Across machines: the bank's owner register, where it has one
    (docs/reference/wire.md), which outlives the process. A service replaces the name of a dead
    process of its own machine; `take_over` replaces that of another machine. Raises `StageInUse`
    where the lock is held.
    """

    def __init__(self, config: LightBankConfig, root: Path, take_over: bool = False) -> None:
        self._host = _host()
        self._name = f"{self._host}:{os.getpid()}"
        # The same number after a restart, so that a service recognises its own entry.
        self._number = zlib.crc32(f"{self._host}:{root.resolve()}".encode()) % 0xFFFF + 1
        self._take_over = take_over
        place = _place(config)
        try:
            text = f"{self._name}, root {root.resolve()}"
            self._lock = FileLock(_folder() / f"hairstage-{place}.lock", text, shared=True)
        except LockedBy as error:
            raise _in_use(f"light bank ({place})", str(error)) from error

    def claim(self, bank: LightBank) -> None:
        """Write this service into the bank's owner register, before lamps are commanded.

        Raises `StageInUse`. A bank that does not reply is taken as free: it lights nothing.
        """
        if not bank.capabilities.owned:
            return
        try:
            held = bank.claim(self._number, self._name)
            if held is not None and (self._take_over or held.rpartition(":")[0] == self._host):
                log.warning("%s: taken over from %s", bank.name, held)
                bank.claim(0, "")
                held = bank.claim(self._number, self._name)
        except DeviceError as error:
            log.warning("the stage's owner cannot be read: %s", error)
            return
        if held is not None:
            raise _in_use(bank.name, held)

    def release(self, bank: LightBank) -> None:
        """Release the stage; may be called again."""
        if bank.capabilities.owned:
            thread = threading.Thread(target=self._disown, args=(bank,), daemon=True)
            thread.start()
            thread.join(RELEASE_S)
        self._lock.release()

    def _disown(self, bank: LightBank) -> None:
        try:
            if bank.claim(self._number, self._name) is None:
                bank.claim(0, "")
            bank.close()
        except DeviceError:  # the bank is gone
            pass


def _host() -> str:
    """This machine's name in 24 characters; long names end in a checksum."""
    host = socket.gethostname()
    return host if len(host) <= 24 else f"{host[:15]}-{zlib.crc32(host.encode()):08x}"


def _in_use(bank: str, holder: str) -> StageInUse:
    todo = "Stop that service first. If its machine is dead: hairstage serve --take-over."
    return StageInUse(bank, "taking the stage", "nobody else", f"held by {holder}", todo)


def _place(config: LightBankConfig) -> str:
    """The bank's address as part of a file name, the same for every user of this machine."""
    if isinstance(config, ModbusRtuConfig | DmxConfig):
        place = os.path.realpath(config.port)
    else:
        try:
            host = socket.gethostbyname(config.host)
        except OSError:
            host = config.host
        unit = config.unit if isinstance(config, ModbusTcpConfig) else config.universe
        place = f"{host}:{config.port}:{unit}"
    return re.sub(r"[^\w.:-]", "_", place)[-100:]


def _folder() -> Path:
    """A folder where every user of this machine may create a lock file."""
    shared = Path("/run/lock")
    return shared if os.access(shared, os.W_OK) else Path(tempfile.gettempdir())
