"""The rig file of the service: geometry, devices, safety limits, defaults for captures.

`reconstruction.geometry.rig` reads the geometry. The other tables are strict: an unknown or wrong
field is an error that names file and field.
"""

from __future__ import annotations

import json
import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import (
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    StringConstraints,
    ValidationError,
    field_validator,
    model_validator,
)

from reconstruction import Rig
from reconstruction.containment import LONGEST_NAME
from reconstruction.geometry.rig import RigError
from stage_service.wire_names import unfit_projectors, unfit_serials

SHORTEST_S, LONGEST_S = 1e-6, 10.0  # the trigger box's range of exposures
PROJECTOR_LEVELS = 65535  # above 0, on the projector controller's wire
Exposure = Annotated[float, Field(ge=SHORTEST_S, le=LONGEST_S)]
Level = Annotated[float, Field(gt=0.0, le=1.0)]
Port = Annotated[int, Field(ge=1, le=65535)]
Seconds = Annotated[float, Field(gt=0.0)]
Baud = Annotated[int, Field(ge=300, le=100_000_000)]
Address = Annotated[int, Field(ge=0, le=65535)]
Text = StringConstraints(strip_whitespace=True)
"""Text without blanks at its ends."""
Names = Annotated[
    tuple[Annotated[str, Field(max_length=LONGEST_NAME)], ...], Field(max_length=4096)
]


class Strict(BaseModel):
    """A table whose unknown fields are errors."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


OWNER_WORDS = 17
"""The owner's registers: a number, then 32 characters of ASCII."""


class LightRegisters(Strict):
    """`[devices.lights.registers]`: Modbus addresses, by default those of docs/reference/wire.md.

    Holding registers, then input registers; `levels`, `coils`, `table` and `owner` are the first of
    several. None, "none" in TOML: the bank has no such register. Without `selector` coils switch
    the lamps; without `heartbeat` and `watchdog` there is no dead-man, without `lit` no read-back,
    without `sequence`, `table` and `position` no hardware stepping, without `owner` no protection
    against services of other machines. `signature` is (address, value), checked at `connect`.
    """

    coils: Address = 0
    levels: Address | None = 0
    level_full: int = Field(default=65535, ge=1, le=65535)
    selector: Address | None = 1000
    heartbeat: Address | None = 1001
    watchdog: Address | None = 1002
    sequence: Address | None = 1003
    owner: Address | None = 1004
    table: Address | None = 2000
    status: Address | None = 0
    lit: Address | None = 1
    count: Address | None = 2
    signature: tuple[Address, Address] | None = (3, 0x4853)
    position: Address | None = 4

    @model_validator(mode="before")
    @classmethod
    def _none_in_toml(cls, table: Any) -> Any:
        if not isinstance(table, dict):
            return table
        return {key: None if value == "none" else value for key, value in table.items()}


class _LightBank(Strict):
    """Fields of every light bank. `settle_s` passes between lamp and pulse.

    A bank without read-back or dead-man is refused unless `accept_unverified_blackout` is set.
    """

    timeout_s: Seconds = 1.0
    settle_s: float = Field(default=0.0, ge=0.0, le=1.0)
    accept_unverified_blackout: bool = False

    @property
    def sequences(self) -> bool:
        """Whether it has a sequence table, which the trigger box's gate steps."""
        return False

    def level_steps(self, by_table: bool = False) -> int:
        """Its number of levels above 0; 1: lamps are always at full level."""
        return 1


class _ModbusConfig(_LightBank):
    registers: LightRegisters = LightRegisters()

    @property
    def sequences(self) -> bool:
        r = self.registers
        return None not in (r.sequence, r.table, r.position)

    def level_steps(self, by_table: bool = False) -> int:
        r = self.registers
        return 1 if r.levels is None and not by_table else r.level_full


class ModbusTcpConfig(_ModbusConfig):
    """`[devices.lights]`: a light bank on Modbus TCP."""

    kind: Literal["modbus_tcp"] = "modbus_tcp"
    host: str = "127.0.0.1"
    port: Port = 502
    unit: int = Field(default=1, ge=0, le=255)


class ModbusRtuConfig(_ModbusConfig):
    """`[devices.lights]`: a light bank on Modbus RTU, 8 data bits."""

    kind: Literal["modbus_rtu"]
    port: str = Field(min_length=1)
    baud: Baud = 115200
    parity: Literal["N", "E", "O"] = "E"
    stop_bits: Literal[1, 2] = 1
    unit: int = Field(default=1, ge=1, le=247)


class DmxConfig(_LightBank):
    """`[devices.lights]`: lamps on DMX channels `first_channel` … through an Enttec USB Pro.

    A command takes two frames: 50 ms at the widget's 40 frames per second.
    """

    kind: Literal["dmx_enttec"]
    port: str = Field(min_length=1)
    first_channel: int = Field(default=1, ge=1, le=512)

    def level_steps(self, by_table: bool = False) -> int:
        return 255


def _kind_by_default(kind: str) -> BeforeValidator:
    return BeforeValidator(lambda t: {"kind": kind, **t} if isinstance(t, dict) else t)


LightBankConfig = Annotated[
    ModbusTcpConfig | ModbusRtuConfig | DmxConfig, Field(discriminator="kind")
]


class SerialConfig(Strict):
    """`[devices.trigger]` and `[devices.projectors]`: a serial port and a request's deadline."""

    kind: Literal["serial"] = "serial"
    port: str = Field(min_length=1)
    baud: Baud = 115200
    timeout_s: Seconds = 1.0


class PjLinkConfig(Strict):
    """`[devices.pjlink.<projector>]`: power and lamp hours. The password is in a file of its
    own."""

    host: str = Field(min_length=1)
    port: Port = 4352
    password_file: Path | None = None
    timeout_s: Seconds = 5.0


class _Cameras(Strict):
    """`readout_s` (sensor, per frame) and `bytes_per_s` (all cameras together) are for predictions.

    `buffers`: unread frames that a camera can hold; it limits a hardware-stepped run.
    """

    timeout_s: Seconds = 2.0
    readout_s: float = Field(default=0.02, ge=0.0)
    bytes_per_s: float = Field(default=100e6, gt=0.0)
    buffers: int = Field(default=64, ge=1, le=4096)


class LinkCamerasConfig(_Cameras):
    """`[devices.cameras]`: the camera link.

    `timeout_s` is the deadline of each reply, `busy_s` that of a frame which is not ready.
    """

    kind: Literal["link"] = "link"
    host: str = "127.0.0.1"
    port: Port
    busy_s: Seconds = 60.0


class BaslerConfig(_Cameras):
    """`[devices.cameras]`: Basler cameras, found by serial number.

    `serials` maps each camera of the rig file to its number. `gain`, counts per (W/(sr m²) · s),
    and `black`, counts, are calibrated. `features` are written to the camera in their order after
    its default settings: region of interest, analog gain, black level, packet size. `timeout_s` is
    the deadline of arming; a frame may come `frame_s` after its exposure.
    """

    kind: Literal["basler"]
    serials: dict[str, Annotated[str, Field(min_length=1)]]
    gain: float = Field(gt=0.0)
    black: float = Field(default=0.0, ge=0.0)
    pixel_format: str = Field(
        default="BayerRG12", pattern="^(Mono|Bayer(RG|GR|GB|BG))(8|10|12|16)$"
    )
    trigger_line: str = Field(default="Line1", pattern=r"^Line\d+$")
    features: dict[str, bool | int | float | str] = Field(default_factory=dict)
    frame_s: Seconds = 0.5
    buffers: int = Field(default=16, ge=1, le=4096)

    @field_validator("serials")
    @classmethod
    def _one_camera_each(cls, serials: dict[str, str]) -> dict[str, str]:
        if len(set(serials.values())) < len(serials):
            raise ValueError("two cameras have the same serial number")
        return serials


CamerasConfig = Annotated[LinkCamerasConfig | BaslerConfig, Field(discriminator="kind")]


class DevicesConfig(Strict):
    """`[devices]`: the stage's devices. Without `projectors` there are no sweeps.

    `hardware_stepping`: the trigger box's gates are wired to the light bank and the projectors, so
    that the box can clock a sequence.
    """

    hardware_stepping: bool = False
    heartbeat_s: Seconds = 0.5
    watchdog_s: float = Field(default=2.0, ge=0.1, le=60.0)
    lights: Annotated[LightBankConfig, _kind_by_default("modbus_tcp")]
    trigger: SerialConfig
    projectors: SerialConfig | None = None
    pjlink: dict[str, PjLinkConfig] = Field(default_factory=dict)
    cameras: Annotated[CamerasConfig, _kind_by_default("link")]

    @model_validator(mode="after")
    def _heartbeat_before_watchdog(self) -> DevicesConfig:
        if self.heartbeat_s > self.watchdog_s / 2:
            raise ValueError(
                f"heartbeat_s {self.heartbeat_s} must be at most half of watchdog_s "
                f"{self.watchdog_s}, or one late beat switches the lamps off"
            )
        return self


class Exposures(Strict):
    """Seconds of exposure per kind of step."""

    dark: Exposure = 0.02
    all_on: Exposure = 0.02
    olat: Exposure = 0.02
    scanline: Exposure = 0.02
    tracking: Exposure = 0.02


class Levels(Strict):
    """Lamp (`olat`, `all_on`) and projector (`scanline`, `tracking`) levels, 0 to 1.

    All lamps at once are some hundred times one lamp: `all_on` must be low, or it saturates.
    """

    all_on: Level = 0.02
    olat: Level = 1.0
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
    if devices is not None and isinstance(devices.cameras, BaslerConfig):
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


_KINDS = ("modbus_tcp", "modbus_rtu", "dmx_enttec", "link", "basler")


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
