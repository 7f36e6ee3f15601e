"""The rig file of the service: geometry, devices, safety limits, defaults for captures.

`reconstruction.geometry.rig` reads the geometry. The other tables are strict: an unknown or wrong
field is an error that names file and field.
"""

from __future__ import annotations

import json
import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from pydantic import (
    Field,
    StringConstraints,
    ValidationError,
)

from reconstruction import Rig
from reconstruction.containment import LONGEST_NAME
from reconstruction.geometry.rig import RigError
from stage_service.device_config import DevicesConfig, NumberedCamerasConfig, Seconds, Strict
from stage_service.wire_names import unfit_projectors, unfit_serials

SHORTEST_S, LONGEST_S = 1e-6, 10.0  # the trigger box's range of exposures
PROJECTOR_LEVELS = 65535  # above 0, on the projector controller's wire
Exposure = Annotated[float, Field(ge=SHORTEST_S, le=LONGEST_S)]
Level = Annotated[float, Field(gt=0.0, le=1.0)]
Text = StringConstraints(strip_whitespace=True)
"""Text without blanks at its ends."""
Name = Annotated[str, Field(max_length=LONGEST_NAME)]
Names = Annotated[tuple[Name, ...], Field(max_length=4096)]


class Exposures(Strict):
    """Seconds of exposure per kind of step."""

    dark: Exposure = 0.02
    all_on: Exposure = 0.02
    olat: Exposure = 0.02
    pattern: Exposure = 0.02
    scanline: Exposure = 0.02
    tracking: Exposure = 0.02


class Levels(Strict):
    """Lamp (`olat`, `all_on`, `pattern`) and projector (`scanline`, `tracking`) levels, 0 to 1.

    All lamps at once are some hundred times one lamp: `all_on` must be low, or it saturates; so
    must `pattern`, of half of the lamps, whose weights it scales.
    """

    all_on: Level = 0.02
    olat: Level = 1.0
    pattern: Level = 0.04
    scanline: Level = 1.0
    tracking: Level = 0.5


class CaptureDefaults(Strict):
    """`[capture]`: the defaults of a plan."""

    tracking_every: int = Field(default=10, ge=0)
    retries: int = Field(default=2, ge=0, le=20)
    storage_bytes_per_s: float = Field(default=200e6, gt=0.0)
    exposure: Exposures = Exposures()
    level: Levels = Levels()


class SafetyLimits(Strict):
    """`[safety]`: the lamps' limits, checked in the plan and during a run.

    One lamp is lit for at most `max_on_s` at a time and `max_duty` of any `duty_window_s`; at most
    `max_lamps` are lit at once, and `max_power_w` drawn at `lamp_power_w` a lamp at full level.
    None: no limit. With `living_subject`, flashes of 3 to 30 Hz need recorded consent.
    """

    max_on_s: Seconds = 12.0
    max_duty: float = Field(default=1.0, gt=0.0, le=1.0)
    duty_window_s: Seconds = 60.0
    max_lamps: int | None = Field(default=None, ge=1)
    max_power_w: float | None = Field(default=None, gt=0.0)
    lamp_power_w: float = Field(default=10.0, gt=0.0)
    living_subject: bool = True


@dataclass(frozen=True, eq=False)
class RigFile:
    """The content of a rig file; `devices` is None if it has only geometry."""

    path: Path
    rig: Rig
    devices: DevicesConfig | None
    capture: CaptureDefaults
    safety: SafetyLimits


class _Tables(Strict):
    devices: DevicesConfig | None = None
    capture: CaptureDefaults = CaptureDefaults()
    safety: SafetyLimits = SafetyLimits()


GEOMETRY = {"name", "dome", "cameras", "lights", "projectors", "profiles"}


def load_rig_file(path: str | Path, devices: str | Path | None = None) -> RigFile:
    """Read a rig file; the `[devices]` table of the file `devices`, field by field, wins over it.

    Raises `RigError` that names the file and the field.
    """
    path = Path(path)
    rig = Rig.load(path)
    tables = {k: v for k, v in _read(path).items() if k not in GEOMETRY}
    if devices is None:
        read = _validate(path, tables)
    else:
        devices = Path(devices)
        override = _read(devices)
        if set(override) != {"devices"}:
            raise RigError(f"{devices}: expected one table [devices], got {sorted(override)}")
        _validate(path, {k: v for k, v in tables.items() if k != "devices"})
        merged = _merge(tables.get("devices", {}), override["devices"])
        read = _validate(devices, {**tables, "devices": merged})
    _check_names(path, rig, read.devices)
    return RigFile(path, rig, read.devices, read.capture, read.safety)


def _check_names(path: Path, rig: Rig, devices: DevicesConfig | None) -> None:
    """Raise `RigError` for names that the devices' wires cannot carry."""
    unfit: list[str] = []
    if devices is not None and devices.projectors is not None:
        unfit += unfit_projectors([p.name for p in rig.projectors])
    if devices is not None and isinstance(devices.cameras, NumberedCamerasConfig):
        unfit += unfit_serials(devices.cameras.serials, [c.name for c in rig.cameras])
    if unfit:
        raise RigError(f"{path}: " + "; ".join(unfit))


def _read(path: Path) -> dict[str, Any]:
    try:
        text = path.read_text()
        return json.loads(text) if path.suffix == ".json" else tomllib.loads(text)
    except FileNotFoundError:
        raise RigError(f"{path}: no such file") from None
    except (json.JSONDecodeError, tomllib.TOMLDecodeError) as error:
        raise RigError(f"{path}: {error}") from error


def _place(loc: tuple[int | str, ...]) -> str:
    """The field's path in the file, without the table's kind, which pydantic adds."""
    return ".".join(str(p) for p in loc if p not in _KINDS)


_KINDS = (
    *("modbus_tcp", "modbus_rtu", "dmx_enttec", "sacn", "artnet"),
    *("link", "basler", "aravis", "gphoto2"),
)


def _validate(path: Path, tables: dict[str, Any]) -> _Tables:
    try:
        return _Tables.model_validate(tables)
    except ValidationError as error:
        problems = [f"{_place(e['loc'])}: {e['msg']}, got {e['input']!r}" for e in error.errors()]
        raise RigError(f"{path}: " + "; ".join(problems)) from error


def _merge(base: dict[str, Any], over: dict[str, Any]) -> dict[str, Any]:
    out = dict(base)
    for key, value in over.items():
        both = isinstance(value, dict) and isinstance(out.get(key), dict)
        out[key] = _merge(out[key], value) if both else value
    return out
