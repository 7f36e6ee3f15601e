"""Signals: wait for one without missing it, and send one when the parent dies."""

from __future__ import annotations

import contextlib
import os
import shutil
import signal
import threading
from collections.abc import Callable, Iterator


def taken(*numbers: signal.Signals) -> Callable[[], None]:
    """Handle these signals in the main thread; returns a function that waits for the first.

    They arrive through a pipe. An `Event` set by a handler could be missed: Python runs handlers
    between bytecodes, so a signal right before the wait would be handled after it.
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


class Terminated(BaseException):
    """SIGTERM came."""


@contextlib.contextmanager
def terminable() -> Iterator[None]:
    """Raise `Terminated` at SIGTERM in the with-block, so that every `finally` runs.

    SIGHUP, a terminal that is closed, counts as SIGTERM unless it is ignored (nohup). A stop that
    another exception wraps, as in Dr.Jit's loops, is raised itself.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def end(*_: object) -> None:
        raise Terminated

    before = {n: signal.getsignal(n) for n in (signal.SIGTERM, signal.SIGHUP)}
    try:
        for number, handler in before.items():
            if handler is signal.SIG_DFL:
                signal.signal(number, end)
        yield
    except Exception as error:
        cause = error.__cause__
        while isinstance(cause, Exception):
            cause = cause.__cause__
        if cause is None:
            raise
        raise cause from None
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@contextlib.contextmanager
def held(*numbers: signal.Signals) -> Iterator[None]:
    """Defer these signals in the main thread until the end of the with-block.

    Unlike blocked signals, they are not deferred in processes started meanwhile.
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
    """`command`, wrapped to get the signal `how` when the thread that starts it ends, even by
    SIGKILL.

    Uses util-linux's `setpriv`; without it the command is unchanged.
    """
    setpriv = shutil.which("setpriv")
    return [setpriv, "--pdeathsig", how, "--", *command] if setpriv else command
