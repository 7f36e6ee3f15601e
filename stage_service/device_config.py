"""The table `[devices]` of the rig file: every link, its limits and its defaults."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import (
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    field_validator,
    model_validator,
)

Port = Annotated[int, Field(ge=1, le=65535)]
Seconds = Annotated[float, Field(gt=0.0)]
Baud = Annotated[int, Field(ge=300, le=100_000_000)]
Address = Annotated[int, Field(ge=0, le=65535)]


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


class DmxLightsConfig(_LightBank):
    """Lamps on DMX channels: each has `channels` at one level (3: RGB as white), from
    `first_channel` on, all in one universe."""

    first_channel: int = Field(default=1, ge=1, le=512)
    channels: int = Field(default=1, ge=1, le=512)

    def level_steps(self, by_table: bool = False) -> int:
        return 255


class DmxConfig(DmxLightsConfig):
    """`[devices.lights]`: one DMX universe through an Enttec USB Pro.

    A command takes two frames: 50 ms at the widget's 40 frames per second.
    """

    kind: Literal["dmx_enttec"]
    port: str = Field(min_length=1)


class SacnConfig(DmxLightsConfig):
    """`[devices.lights]`: DMX universes from `universe` on, by sACN to `host`; without it to each
    universe's multicast group. Receivers obey the source of the highest `priority`.

    A command takes 70 ms.
    """

    kind: Literal["sacn"]
    host: str = ""
    port: Port = 5568
    universe: int = Field(default=1, ge=1, le=63999)
    priority: int = Field(default=200, ge=0, le=200)


class ArtNetConfig(DmxLightsConfig):
    """`[devices.lights]`: DMX universes from the Port-Address `universe` on, by Art-Net to the node
    `host`. A command takes 70 ms."""

    kind: Literal["artnet"]
    host: str = Field(min_length=1)
    port: Port = 6454
    universe: int = Field(default=0, ge=0, le=32767)
    timeout_s: Seconds = 3.0


def _kind_by_default(kind: str) -> BeforeValidator:
    return BeforeValidator(lambda t: {"kind": kind, **t} if isinstance(t, dict) else t)


LightBankConfig = Annotated[
    ModbusTcpConfig | ModbusRtuConfig | DmxConfig | SacnConfig | ArtNetConfig,
    Field(discriminator="kind"),
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

    @property
    def lag_s(self) -> float:
        """Seconds from the pulse to the open shutter at most, while the lamps are on; 0 for cameras
        that the trigger box fires."""
        return 0.0


class LinkCamerasConfig(_Cameras):
    """`[devices.cameras]`: the camera link.

    `timeout_s` is the deadline of each reply, `busy_s` that of a frame which is not ready.
    """

    kind: Literal["link"] = "link"
    host: str = "127.0.0.1"
    port: Port
    busy_s: Seconds = 60.0


class NumberedCamerasConfig(_Cameras):
    """Fields of cameras that are found by serial number.

    `serials` maps each camera of the rig file to its number. `gain`, counts per (W/(sr m²) · s), is
    calibrated. `timeout_s` is the deadline of arming; a frame may come `frame_s` after its
    exposure.
    """

    serials: dict[str, Annotated[str, Field(min_length=1)]]
    gain: float = Field(gt=0.0)
    frame_s: Seconds = 0.5

    @field_validator("serials")
    @classmethod
    def _one_camera_each(cls, serials: dict[str, str]) -> dict[str, str]:
        if len(set(serials.values())) < len(serials):
            raise ValueError("two cameras have the same serial number")
        return serials


class GenicamConfig(NumberedCamerasConfig):
    """Fields of every GenICam camera.

    `black`, counts, is calibrated. `features` are written to the camera in their order after its
    default settings: region of interest, analog gain, black level, packet size.
    """

    black: float = Field(default=0.0, ge=0.0)
    pixel_format: str = Field(
        default="BayerRG12", pattern="^(Mono|Bayer(RG|GR|GB|BG))(8|10|12|16)$"
    )
    trigger_line: str = Field(default="Line1", pattern=r"^Line\d+$")
    features: dict[str, bool | int | float | str] = Field(default_factory=dict)
    buffers: int = Field(default=16, ge=1, le=4096)


class BaslerConfig(GenicamConfig):
    """`[devices.cameras]`: Basler cameras through pylon."""

    kind: Literal["basler"]


class AravisConfig(GenicamConfig):
    """`[devices.cameras]`: cameras of any maker on GigE Vision or USB3 Vision, through Aravis."""

    kind: Literal["aravis"]


class Gphoto2Config(NumberedCamerasConfig):
    """`[devices.cameras]`: DSLRs and mirrorless cameras on USB, through libgphoto2.

    `serials` maps each camera of the rig file to its serial number or USB port, "usb:001,005".
    `gain`, counts per (W/(sr m²) · s), is calibrated. `settings` are written to the camera in their
    order. The lamps are on for `release_s`, within which the shutter opens, and the exposure; its
    file comes within `frame_s`. `jpeg`: frames are JPEG, by the sRGB curve, not RAW. `keep` leaves
    the files on the card.
    """

    kind: Literal["gphoto2"]
    settings: dict[str, bool | int | float | str] = Field(default_factory=dict)
    release_s: Seconds = 1.0
    jpeg: bool = False
    keep: bool = False
    timeout_s: Seconds = 10.0
    frame_s: Seconds = 10.0
    readout_s: float = Field(default=1.0, ge=0.0)
    buffers: Literal[1] = 1

    @property
    def lag_s(self) -> float:
        return self.release_s


CamerasConfig = Annotated[
    LinkCamerasConfig | BaslerConfig | AravisConfig | Gphoto2Config, Field(discriminator="kind")
]


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

    @model_validator(mode="after")
    def _fired_by_the_box(self) -> DevicesConfig:
        if self.hardware_stepping and self.cameras.lag_s:
            raise ValueError(
                f"hardware_stepping: the trigger box cannot fire cameras of {self.cameras.kind}, "
                "which the service releases over USB: set it to false"
            )
        return self
