"""Which service has a stage: two must not drive one, whatever their root folders are."""

from __future__ import annotations

import logging
import os
import re
import socket
import tempfile
import threading
import zlib
from pathlib import Path

from stage_service.config import LightBankConfig, ModbusTcpConfig
from stage_service.devices.errors import DeviceError
from stage_service.devices.lights.interface import LightBank
from stage_service.records.lease import FileLock, LockedBy

log = logging.getLogger("hairstage.ownership")
RELEASE_S = 1.0
"""A bank that hangs keeps a service for no longer from ending."""


class StageInUse(DeviceError):
    """Another service has this stage; the message says which."""


class Ownership:
    """A service's hold on the stage whose light bank is `bank`, by a name that others can read.

    On this machine it is a lock file, named for the bank's address, which the kernel frees when the
    process dies. For services on other machines it is the bank's owner register, where it has one
    (docs/reference/wire.md), which outlives the process: who finds the name of a dead process of
    its own machine there takes its place, and `take_over` says that the one of another machine is
    dead.
    Making one raises `StageInUse` where the lock is held.
    """

    def __init__(self, config: LightBankConfig, root: Path, take_over: bool = False) -> None:
        self._host = _host()
        self._name = f"{self._host}:{os.getpid()}"
        # The same after a restart, so that what this service has left is its own.
        self._number = zlib.crc32(f"{self._host}:{root.resolve()}".encode()) % 0xFFFF + 1
        self._take_over = take_over
        place = _place(config)
        try:
            text = f"{self._name}, root {root.resolve()}"
            self._lock = FileLock(_folder() / f"hairstage-{place}.lock", text, shared=True)
        except LockedBy as error:
            raise _in_use(f"light bank ({place})", str(error)) from error

    def claim(self, bank: LightBank) -> None:
        """Have the bank say that this service has it; call it before lamps are commanded.

        Raises `StageInUse`. A bank that does not answer belongs to nobody, and lights nothing.
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
            log.warning("nobody can tell whether another service has this stage: %s", error)
            return
        if held is not None:
            raise _in_use(bank.name, held)

    def release(self, bank: LightBank) -> None:
        """Give the stage up; may be called again."""
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
        except DeviceError:  # it is gone; so is whoever could have had it
            pass


def _host() -> str:
    """This machine's name in 24 characters, of which the last tell long ones apart."""
    host = socket.gethostname()
    return host if len(host) <= 24 else f"{host[:15]}-{zlib.crc32(host.encode()):08x}"


def _in_use(bank: str, holder: str) -> StageInUse:
    todo = "Stop that service first. If its machine is dead: hairstage serve --take-over."
    return StageInUse(bank, "taking the stage", "nobody else", f"held by {holder}", todo)


def _place(config: LightBankConfig) -> str:
    """The bank's address, the same for everybody on this machine, as part of a file's name."""
    if isinstance(config, ModbusTcpConfig):
        try:
            host = socket.gethostbyname(config.host)
        except OSError:
            host = config.host
        place = f"{host}:{config.port}:{config.unit}"
    else:
        place = os.path.realpath(config.port)
    return re.sub(r"[^\w.:-]", "_", place)[-100:]


def _folder() -> Path:
    """Where every user of this machine may leave a lock."""
    shared = Path("/run/lock")
    return shared if os.access(shared, os.W_OK) else Path(tempfile.gettempdir())
