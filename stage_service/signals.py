"""Waiting for a signal without missing one."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable


def taken(*numbers: signal.Signals) -> Callable[[], None]:
    """Take these signals over, for the main thread; what is returned waits for the first.

    The signals come through a pipe. An `Event` that a handler sets can be slept through: Python
    runs handlers between bytecodes, so a signal just before the wait is seen only after it.
    """
    read, write = os.pipe()
    os.set_blocking(write, False)
    for number in numbers:
        signal.signal(number, lambda *_: None)
    signal.set_wakeup_fd(write, warn_on_full_buffer=False)

    def wait() -> None:
        while os.read(read, 1)[0] not in numbers:
            pass

    return wait
