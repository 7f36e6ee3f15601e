"""The settings of a camera in libgphoto2, read and written one by one; its list of exposures."""

from __future__ import annotations

import math
import re
import time
from typing import Any

from stage_service.devices.cameras.genicam import EXPOSURE_TOLERANCE, SLICE_S
from stage_service.devices.errors import DeviceError

BULB_S = 2.0
"""Shortest exposure by bulb, which is timed on this machine: some 10 ms are uncertain."""
SPEEDS = ("shutterspeed2", "shutterspeed")
"""Settings with the exposure; of Nikon's two the first has no rounded values."""


class Settings:
    """The settings of an open camera; a busy one is waited for, `timeout_s` seconds at most.

    Raises `DeviceError` for what the camera does not have or take, and the library's errors.
    """

    def __init__(self, device: str, gphoto2: Any, camera: Any, timeout_s: float) -> None:
        self._device, self._gp, self._camera = device, gphoto2, camera
        self._timeout_s = timeout_s

    def value(self, name: str) -> Any:
        """A setting's value, None where the camera does not have it."""
        widget = self._widget(name)
        return None if widget is None else widget.get_value()

    def choices(self, name: str) -> list[str]:
        """The values of a setting, none where the camera does not have it or any value fits."""
        gp, widget = self._gp, self._widget(name)
        if widget is None or widget.get_type() not in (gp.GP_WIDGET_RADIO, gp.GP_WIDGET_MENU):
            return []
        return list(widget.get_choices())

    def write(self, name: str, value: bool | float | str) -> None:
        """Write a setting; text has to be one of its choices."""
        gp, deadline = self._gp, time.monotonic() + self._timeout_s
        doing = f"setting {name} to {value}"
        todo = "Correct [devices.cameras.settings]; `gphoto2 --list-all-config` lists what it has."
        widget = self._widget(name)
        if widget is None:
            raise self._error(doing, "the setting", "a camera without it", todo)
        choices = self.choices(name)
        if choices and str(value) not in choices:
            raise self._error(doing, f"one of {', '.join(choices)}", str(value), todo)
        if widget.get_readonly():
            todo = "Turn its mode dial to M."
            raise self._error(doing, "a setting that can be written", "one that cannot", todo)
        kind = {gp.GP_WIDGET_TOGGLE: int, gp.GP_WIDGET_RANGE: float, gp.GP_WIDGET_DATE: int}
        widget.set_value(kind.get(widget.get_type(), str)(value))
        while True:
            try:
                return self._camera.set_single_config(name, widget)
            except gp.GPhoto2Error as error:
                if error.code != gp.GP_ERROR_CAMERA_BUSY or time.monotonic() > deadline:
                    raise
            time.sleep(SLICE_S)

    def expose(self, exposure: float) -> tuple[float, bool]:
        """Choose a shutter speed; returns the exposure that it makes, in seconds, and whether it
        is by bulb, which makes any from `BULB_S` on."""
        doing = f"setting an exposure of {exposure:g} s"
        name = next((n for n in SPEEDS if self.choices(n)), "")
        speeds = {s: c for c in self.choices(name) if (s := seconds(c)) is not None}
        if not speeds:
            todo = "Turn its mode dial to M."
            raise self._error(doing, "a list of shutter speeds", "a camera without one", todo)
        nearest = min(speeds, key=lambda s: abs(math.log(s / exposure)))
        if abs(nearest - exposure) > EXPOSURE_TOLERANCE * exposure:
            bulb = next((c for c in self.choices(name) if c.lower() == "bulb"), None)
            if bulb is None or exposure < BULB_S:
                expected = f"a shutter speed of the camera; the nearest is {nearest:g} s"
                todo = f"Set the plan's exposure to {nearest:g} s."
                raise self._error(doing, expected, f"{exposure:g} s", todo)
            self.write(name, bulb)
            return exposure, True
        self.write(name, speeds[nearest])
        deadline = time.monotonic() + self._timeout_s
        while (actual := self.value(name)) != speeds[nearest]:
            if time.monotonic() > deadline:
                todo = "Turn its mode dial to M."
                raise self._error(doing, f"{name} = {speeds[nearest]}", str(actual), todo)
            time.sleep(SLICE_S)
        return nearest, False

    def _widget(self, name: str) -> Any:
        try:
            return self._camera.get_single_config(name) if name else None
        except self._gp.GPhoto2Error as error:
            if error.code == self._gp.GP_ERROR_BAD_PARAMETERS:
                return None
            raise

    def _error(self, doing: str, expected: str, received: str, todo: str) -> DeviceError:
        return DeviceError(self._device, doing, expected, received, todo)


def seconds(choice: str) -> float | None:
    """The exposure of a shutter speed such as "1/125", "0.0080s" or "2.5"; None of bulb."""
    match = re.fullmatch(r"(\d+(?:\.\d+)?)(?:/(\d+(?:\.\d+)?))?s?", choice)
    divisor = float(match[2] or 1) if match else 0.0
    return float(match[1]) / divisor or None if match and divisor else None
