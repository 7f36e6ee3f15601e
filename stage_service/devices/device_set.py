"""All devices of one stage, as the rig file describes them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any, Self, TypeVar

from reconstruction.geometry.rig import RigError
from stage_service.config import RigFile
from stage_service.device_config import (
    AravisConfig,
    ArtNetConfig,
    BaslerConfig,
    DevicesConfig,
    DmxConfig,
    Gphoto2Config,
    LightBankConfig,
    SacnConfig,
)
from stage_service.devices.cameras.aravis import AravisCamera
from stage_service.devices.cameras.basler import BaslerCamera
from stage_service.devices.cameras.fan_out import FanOut
from stage_service.devices.cameras.gphoto2 import Gphoto2Camera
from stage_service.devices.cameras.interface import Busy, CameraDevice
from stage_service.devices.cameras.link import LinkCamera
from stage_service.devices.errors import DeviceError
from stage_service.devices.lights.dmx_enttec import DmxLightBank
from stage_service.devices.lights.dmx_network import ArtNetBank, SacnBank
from stage_service.devices.lights.interface import LightBank
from stage_service.devices.lights.limited import LimitedLightBank
from stage_service.devices.lights.modbus import ModbusLightBank
from stage_service.devices.projectors.interface import ProjectorController
from stage_service.devices.projectors.pjlink import PjLinkProjector, Power
from stage_service.devices.projectors.serial_controller import SerialProjectorController
from stage_service.devices.trigger.interface import TriggerBox
from stage_service.devices.trigger.serial_box import SerialTriggerBox

Device = LightBank | TriggerBox | ProjectorController | CameraDevice
D = TypeVar("D", bound=Device)


class NoStage(RigError):
    """The rig file has no `[devices]`."""


@dataclass(frozen=True, eq=False)
class DeviceSet:
    """The drivers of a stage; `projectors` is None where it has none.

    `powers` are the projectors whose power state can be read.
    """

    config: DevicesConfig
    lights: LimitedLightBank
    trigger: TriggerBox
    projectors: ProjectorController | None
    cameras: tuple[CameraDevice, ...]
    powers: tuple[PjLinkProjector, ...] = ()

    @classmethod
    def of(cls, rig_file: RigFile) -> Self:
        """Make the drivers; connects to nothing. Raises `NoStage`, `RigError`."""
        config, rig = rig_file.devices, rig_file.rig
        if config is None:
            raise NoStage(f"{rig_file.path}: the table [devices] is missing: no stage to talk to")
        if not rig.lights:
            raise RigError(f"{rig_file.path}: no lights, but [devices.lights] has to drive some")
        try:
            lights = driver_for(config.lights, len(rig.lights))
        except RigError as error:
            raise RigError(f"{rig_file.path}: {error}") from error
        if isinstance(config.cameras, BaslerConfig):
            cameras: list[CameraDevice] = [BaslerCamera(config.cameras, c) for c in rig.cameras]
        elif isinstance(config.cameras, AravisConfig):
            cameras = [AravisCamera(config.cameras, c) for c in rig.cameras]
        elif isinstance(config.cameras, Gphoto2Config):
            cameras = [Gphoto2Camera(config.cameras, c) for c in rig.cameras]
        else:
            cameras = [LinkCamera(config.cameras, c) for c in rig.cameras]
        projectors = None
        if config.projectors is not None and rig.projectors:
            names = tuple(p.name for p in rig.projectors)
            projectors = SerialProjectorController(config.projectors, names)
        return cls(
            config,
            LimitedLightBank(lights, rig_file.safety, lights=[light.name for light in rig.lights]),
            SerialTriggerBox(config.trigger),
            projectors,
            tuple(cameras),
            _powers(rig_file, config),
        )

    def connect(self) -> None:
        """Connect to every device, lights first, cameras side by side. Raises `DeviceError`, or
        an `ExceptionGroup` of those of several cameras."""
        for device in self._all():
            if device not in self.cameras:
                device.connect()
        cameras = FanOut(self.cameras)
        try:
            cameras(lambda camera: camera.connect())
        finally:
            cameras.close()

    @property
    def busy(self) -> dict[str, Busy]:
        """The reports of the cameras whose frames are not ready, by name."""
        return {c.name: busy for c in self.cameras if (busy := c.busy) is not None}

    def require_power(self) -> None:
        """Raise `DeviceError` for a projector that is not on: its rows would be dark."""
        for projector in self.powers:
            state = projector.power()
            if state is not Power.ON:
                received = state.name.lower().replace("_", " ")
                todo = "Switch it on, and wait until its lamp has warmed up."
                doing = "reading the power state before a sweep"
                raise DeviceError(projector.name, doing, "power on", received, todo)

    def close(self) -> None:
        """Close every link; lamps and projectors stay as they are."""
        for device in self._all():
            device.close()

    def status(
        self, *, connect: bool, given_up: Callable[[], bool] = lambda: False
    ) -> dict[str, Any] | None:
        """Query each device: {kind: {"state": "ok" | "unreachable", ...}}.

        With `connect` each device is connected first. Without it, as during a capture, cameras are
        not queried; a driver whose link is closed opens it. None once `given_up()`, which is
        checked before each device.
        """
        lights, trigger, beams = self.lights, self.trigger, self.projectors
        queries: dict[str, Callable[[], dict[str, Any]]] = {
            "lights": lambda: _query(lights, connect, _lamps),
            "trigger": lambda: _query(
                trigger, connect, lambda t: {"pulses": t.count(), **asdict(t.status())}
            ),
        }
        if beams is not None:
            queries["projectors"] = lambda: _query(
                beams, connect, lambda b: {"dark": b.is_dark(), "names": list(b.names)}
            )
        queries["cameras"] = self._query_cameras if connect else lambda: self._cameras("in use")
        queries["projector_power"] = lambda: {
            p.projector: _power(p) for p in self.powers if connect
        }
        out = {}
        for kind, query in queries.items():
            if given_up():
                return None
            out[kind] = query()
        return out

    @property
    def slowest_s(self) -> float:
        """The longest deadline of a request to lamps or projectors."""
        beams = self.config.projectors
        return max(self.config.lights.timeout_s, 0.0 if beams is None else beams.timeout_s)

    def unqueried(self) -> dict[str, Any]:
        """As `status`, before the first query: each device's state is "not queried yet"."""
        state = "not queried yet"
        single: dict[str, Device | None]
        single = {"lights": self.lights, "trigger": self.trigger, "projectors": self.projectors}
        known = {k: {"name": d.name, "state": state} for k, d in single.items() if d is not None}
        return {**known, "cameras": self._cameras(state), "projector_power": {}}

    def _cameras(self, state: str) -> dict[str, Any]:
        return {camera.name: {"state": state} for camera in self.cameras}

    def _query_cameras(self) -> dict[str, Any]:
        cameras = FanOut(self.cameras)
        try:
            return cameras(lambda camera: _query(camera, True, lambda c: asdict(c.info)))
        finally:
            cameras.close()

    def close_lit(self) -> None:
        """Close the links to lamps and projectors, which stay as they are."""
        for device in (self.lights, self.projectors):
            if device is not None:
                device.close()

    def _all(self) -> tuple[Device, ...]:
        beams = (self.projectors,) if self.projectors is not None else ()
        return (self.lights, *beams, self.trigger, *self.cameras)


def driver_for(config: LightBankConfig, lamps: int) -> LightBank:
    """The driver of a light bank, not connected. Raises `RigError`."""
    if isinstance(config, DmxConfig):
        return DmxLightBank(config, lamps)
    if isinstance(config, SacnConfig):
        return SacnBank(config, lamps)
    if isinstance(config, ArtNetConfig):
        return ArtNetBank(config, lamps)
    return ModbusLightBank(config, lamps)


def _powers(rig_file: RigFile, config: DevicesConfig) -> tuple[PjLinkProjector, ...]:
    known, out = {p.name for p in rig_file.rig.projectors}, []
    for name, link in config.pjlink.items():
        where = f"{rig_file.path}: devices.pjlink.{name}"
        if name not in known:
            raise RigError(f"{where}: the rig has no projector {name!r}")
        file = link.password_file
        # Read on use: a missing file must not prevent a blackout.
        password = "" if file is None else rig_file.path.parent / file
        out.append(PjLinkProjector(name, link.host, link.port, password, link.timeout_s))
    return tuple(out)


def _power(projector: PjLinkProjector) -> dict[str, Any]:
    try:
        lamps = [asdict(lamp) for lamp in projector.lamps()]
        return {"state": "ok", "power": projector.power().name, "lamps": lamps}
    except Exception as error:
        return {"state": "unreachable", "error": str(error)}


def _lamps(lights: LightBank) -> dict[str, Any]:
    known = asdict(lights.status()) if lights.capabilities.reads_back else {}
    return {"count": lights.count, **known}


def _query(device: D, connect: bool, question: Callable[[D], dict[str, Any]]) -> dict[str, Any]:
    try:
        if connect:
            device.connect()
        return {"name": device.name, "state": "ok", **question(device)}
    except Exception as error:  # any error: the other devices are still queried
        return {"name": device.name, "state": "unreachable", "error": str(error)}
