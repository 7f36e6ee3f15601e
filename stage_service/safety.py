"""Lights off, verified; and no light while the stage says no.

Software is not the safety function: the light bank's own watchdog and the wired emergency stop are.
"""

from __future__ import annotations

import atexit
import signal
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

from stage_service.devices.errors import DeviceError, SafetyRefusal
from stage_service.devices.stage import Stage

ATTEMPTS = 3


@dataclass(frozen=True)
class Blackout:
    """What a blackout came to: `safe` only if every lamp and projector was read back dark."""

    safe: bool
    detail: str


class _Dark(Protocol):
    name: str

    def off(self) -> None: ...


def blackout(stage: Stage, attempts: int = ATTEMPTS) -> Blackout:
    """Put lamps and projectors off and read it back; never raises for a device.

    A device that fails is tried again on a new connection. What cannot be verified is reported
    as "unknown, unsafe".
    """
    problems = _darken(
        stage.lights,
        stage.lights.capabilities.reads_back,
        lambda: stage.lights.status().lit == 0,
        attempts,
    )
    if problems:
        problems += f" Its watchdog puts the lamps off within {stage.config.watchdog_s:g} s."
    beams = stage.projectors
    if beams is not None:
        problems += _darken(beams, beams.capabilities.reads_back, beams.is_dark, attempts)
    if problems:
        return Blackout(False, f"unknown, unsafe: {problems.strip()}")
    return Blackout(True, "every lamp and projector was read back dark")


def _darken(device: _Dark, reads_back: bool, is_dark: Callable[[], bool], attempts: int) -> str:
    """Empty when the device was read back dark, else what went wrong the last time."""
    problem = ""
    for attempt in range(attempts):
        if attempt:
            time.sleep(0.05 * attempt)
        try:
            device.off()
            if not reads_back:
                return f" {device.name}: off was sent, but cannot be read back."
            if is_dark():
                return ""
            problem = f" {device.name}: still lit after off."
        except DeviceError as error:
            problem = f" {error}"
        except Exception as error:  # whatever it is, the next device must still be darkened
            problem = f" {device.name}: {type(error).__name__}: {error}"
    return problem


def check_interlocks(stage: Stage) -> None:
    """Raise `SafetyRefusal` while an interlock is open or the emergency stop is pressed."""
    trigger, lights = stage.trigger.status(), stage.lights.status()
    for seen, text in (
        (trigger.estop_pressed, f"{stage.trigger.name}: emergency stop pressed"),
        (trigger.interlock_open, f"{stage.trigger.name}: interlock open"),
        (lights.estop_pressed, f"{stage.lights.name}: emergency stop pressed"),
        (lights.interlock_open, f"{stage.lights.name}: interlock open"),
    ):
        if seen:
            raise SafetyRefusal(
                "stage",
                "arming",
                expected="interlock closed and emergency stop released",
                received=text,
                todo="Clear it at the stage; the service never does.",
            )


def off_on_exit(close: Callable[[], None]) -> Callable[[], None]:
    """Have `close` called when the process ends, by SIGTERM too; returns what undoes that.

    SIGTERM is turned into `SystemExit` where nobody else handles it; a server that does handle
    it ends in `atexit` as well.
    """

    def terminate(number: int, _frame: object) -> None:
        sys.exit(128 + number)

    atexit.register(close)
    main = threading.current_thread() is threading.main_thread()
    mine = main and signal.getsignal(signal.SIGTERM) is signal.SIG_DFL
    if mine:
        signal.signal(signal.SIGTERM, terminate)

    def undo() -> None:
        atexit.unregister(close)
        still_main = threading.current_thread() is threading.main_thread()
        if mine and still_main and signal.getsignal(signal.SIGTERM) is terminate:
            signal.signal(signal.SIGTERM, signal.SIG_DFL)

    return undo
