"""Blackout with read-back, and the check of interlocks before anything is armed.

Software is not the safety function: the light bank's own watchdog and the wired emergency stop are.
"""

from __future__ import annotations

import atexit
import signal
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Any, Literal

from stage_service.background import beside
from stage_service.devices.device_set import DeviceSet
from stage_service.devices.errors import DeviceError, SafetyRefusal
from stage_service.devices.lights.interface import CONTRADICTED, LightBank, LightStatus
from stage_service.devices.projectors.interface import ProjectorController
from stage_service.devices.trigger.interface import TriggerStatus

ATTEMPTS = 3
WITHIN_S = 30.0
"""Seconds that a blackout waits for one device."""
Darkness = Literal["dark", "said to be dark", "unknown, unsafe"]


@dataclass(frozen=True)
class Blackout:
    """Result of a blackout: `safe` only if every lamp and projector was read back dark.

    `accepted`: off was sent, nothing failed, and the rig file accepts that the light bank has no
    read-back (`accept_unverified_blackout`); or a person has looked and acknowledged darkness
    (`said`) that no link can read back. `known_at`: monotonic seconds.
    """

    safe: bool
    detail: str
    accepted: bool = False
    said: bool = False
    known_at: float = field(default_factory=time.monotonic, compare=False)

    @property
    def state(self) -> Darkness:
        """The lamps' state."""
        if self.safe:
            return "dark"
        return "said to be dark" if self.said else "unknown, unsafe"

    @property
    def blocks(self) -> bool:
        """Whether this fails the capture and refuses the next one."""
        return not (self.safe or self.accepted)

    def to_dict(self) -> dict[str, Any]:
        """As the API, events and manifests have it."""
        return {"safe": self.safe, "state": self.state, "detail": self.detail}


def blackout(devices: DeviceSet, attempts: int = ATTEMPTS, within_s: float = WITHIN_S) -> Blackout:
    """Put lamps and projectors off, in parallel, and read them back; never raises for a device.

    A device that fails is tried again on a new connection. A device not verified within `within_s`
    seconds is reported as "unknown, unsafe"; its attempts go on. `detail` names what else puts the
    lamps off: watchdog, interlock, emergency stop.
    """
    lights, beams, config = devices.lights, devices.projectors, devices.config
    problems = unread = causes = ""

    def lamps_are_off() -> bool:
        nonlocal causes
        status = lights.status()
        causes = status.causes.removeprefix(", ")
        return status.lit == 0

    lit: list[tuple[LightBank | ProjectorController, Callable[[], bool]]]
    lit = [(lights, lamps_are_off)]
    if beams is not None:
        lit.append((beams, beams.is_dark))
    found = [
        beside(
            partial(_darken, device, is_dark if device.capabilities.reads_back else None, attempts),
            "blackout",
        )
        for device, is_dark in lit
    ]
    deadline = time.monotonic() + within_s
    for (device, _), result in zip(lit, found, strict=True):
        can = device.capabilities
        try:
            problem = result.result(timeout=max(0.0, deadline - time.monotonic()))
        except TimeoutError:
            problem = f" {device.name}: not dark within {within_s:.3g} s."
        if problem and can.dead_man:
            problem += (
                f" Its watchdog acts {config.watchdog_s:g} s after the service's last heartbeat; a "
                "light that is on after that does not obey the device: cut the supply."
            )
        problems += problem
        if not problem and not can.reads_back:
            unread += f" {device.name}: off was sent, but cannot be read back."
    if not problems and not unread:
        dark = "every lamp and projector was read back dark"
        if causes:
            dark += f"; {lights.name} reported then: {causes}"
        if lights.contradicted:
            dark += f"; earlier {lights.name} {CONTRADICTED}: look before anybody goes in"
        return Blackout(True, dark)
    only_lamps = beams is None or beams.capabilities.reads_back
    accepted = not problems and only_lamps and config.lights.accept_unverified_blackout
    return Blackout(False, f"unknown, unsafe: {(problems + unread).strip()}", accepted)


def _darken(
    device: LightBank | ProjectorController, is_dark: Callable[[], bool] | None, attempts: int
) -> str:
    """Empty once the device is off, as far as it reads back; else the last attempt's problem."""
    problem = ""
    for attempt in range(attempts):
        if attempt:
            time.sleep(0.05 * attempt)
        try:
            device.off()
            if is_dark is None or is_dark():
                return ""
            problem = f" {device.name}: still lit after off."
        except DeviceError as error:
            problem = f" {error}"
        except Exception as error:  # any error: the result must report it
            problem = f" {device.name}: {type(error).__name__}: {error}"
    return problem


def check_interlocks(devices: DeviceSet) -> None:
    """Raise `SafetyRefusal` while an interlock is open or the emergency stop is pressed."""
    inputs: list[tuple[str, TriggerStatus | LightStatus]] = [
        (devices.trigger.name, devices.trigger.status())
    ]
    if devices.lights.capabilities.reads_back:
        inputs.append((devices.lights.name, devices.lights.status()))
    for name, status in inputs:
        if status.estop_pressed or status.interlock_open:
            text = "emergency stop pressed" if status.estop_pressed else "interlock open"
            expected = "interlock closed and emergency stop released"
            todo = "Clear it at the stage; the service never does."
            raise SafetyRefusal("stage", "arming", expected, f"{name}: {text}", todo)


def off_on_exit(close: Callable[[], None]) -> Callable[[], None]:
    """Call `close` when the process ends, by SIGTERM too; returns a function that undoes this.

    SIGTERM becomes `SystemExit` where no other handler is set; a server with a handler of its own
    reaches `atexit` as well.
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
