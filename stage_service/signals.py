"""Signals: waiting for one without missing it, and having one sent when somebody dies."""

from __future__ import annotations

import contextlib
import os
import shutil
import signal
from collections.abc import Callable, Iterator


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


@contextlib.contextmanager
def held(*numbers: signal.Signals) -> Iterator[None]:
    """Hold these signals back in the main thread until the end of the with-block.

    Unlike a blocked signal, one that is held is not held for the processes started meanwhile.
    """
    came: list[int] = []
    before = {number: signal.getsignal(number) for number in numbers}
    try:
        for number in numbers:
            signal.signal(number, lambda which, _: came.append(which))
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        for arrived in came:
            signal.raise_signal(arrived)


def tied(command: list[str], how: str = "TERM") -> list[str]:
    """`command`, to get the signal `how` when the thread that starts it is gone, even by SIGKILL.

    By util-linux's `setpriv`, which becomes the command; where that is missing, as it is.
    """
    setpriv = shutil.which("setpriv")
    return [setpriv, "--pdeathsig", how, "--", *command] if setpriv else command
