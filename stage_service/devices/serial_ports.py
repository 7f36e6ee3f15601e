"""Serial ports that are this process's alone."""

from __future__ import annotations

import errno
import fcntl
import time

import serial

_AGAIN_S = 0.02


class ExclusivePort(serial.Serial):  # type: ignore[misc]  # pyserial has no types
    """A port locked by `flock(2)` until `close`.

    A forked child shares the lock until it calls `exec`, so `close` unlocks explicitly and `open`
    retries a locked port for `write_timeout` seconds before it raises `serial.SerialException`.
    """

    def __init__(
        self,
        port: str,
        baud: int = 9600,
        *,
        timeout_s: float,
        parity: str = "N",
        stop_bits: int = 1,
    ) -> None:
        super().__init__(
            port,
            baud,
            parity=parity,
            stopbits=stop_bits,
            write_timeout=timeout_s,
            exclusive=True,
        )

    def open(self) -> None:
        deadline = time.monotonic() + (self.write_timeout or 0.0)
        while not self.is_open:
            try:
                super().open()
            except serial.SerialException as error:
                if error.errno != errno.EAGAIN or time.monotonic() > deadline:
                    raise
                time.sleep(_AGAIN_S)

    def close(self) -> None:
        if self.is_open:
            fcntl.flock(self.fd, fcntl.LOCK_UN)
        super().close()
