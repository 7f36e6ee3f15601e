"""DSLRs for tests: libgphoto2's own virtual Nikon, and a stand-in for the module `gphoto2`.

The first is a peer that shares no code with us: a PTP camera behind libgphoto2's `vusb` port
library, which python-gphoto2's wheels carry. The second follows python-gphoto2's API as its driver
uses it; it makes the faults that the first cannot.
"""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

from reconstruction import Camera as Geometry
from stage_service.device_config import Gphoto2Config
from stage_service.devices.cameras import gphoto2 as driver
from stage_service.devices.cameras.gphoto2 import Gphoto2Camera

VIRTUAL_SERIAL = "0.1"


def dslr(serial: str, size: tuple[int, int] = (16, 12), **fields: Any) -> Gphoto2Camera:
    """A driver that is not connected; frames are JPEG."""
    table = {"kind": "gphoto2", "serials": {"cam_a": serial}, "gain": 1000.0, "jpeg": True}
    k = np.array([[40.0, 0, size[0] / 2], [0, 40.0, size[1] / 2], [0, 0, 1]])
    geometry = Geometry("cam_a", *size, k, np.eye(3), np.zeros(3))
    return Gphoto2Camera(Gphoto2Config.model_validate(table | fields), geometry)


def jpeg(code: int = 128, size: tuple[int, int] = (16, 12)) -> bytes:
    """A grey image, coded 0 to 255."""
    return cv2.imencode(".jpg", np.full((size[1], size[0], 3), code, np.uint8))[1].tobytes()


def plug_in_virtual(patch: pytest.MonkeyPatch, folder: Path, picture: bytes) -> None:
    """Have libgphoto2 find its virtual Nikon D750 alone, whose captures are copies of `picture`."""
    if find_spec("gphoto2") is None:
        pytest.skip("python-gphoto2 is missing: pip install 'hairstage[gphoto2]'")
    import gphoto2

    vusb = Path(gphoto2.__file__).parent / "libgphoto2" / "vusb"
    if not vusb.is_dir():
        pytest.skip("this build of python-gphoto2 has no virtual camera (vusb)")
    (folder / "picture.jpg").write_bytes(picture)
    patch.setenv("IOLIBS", os.fspath(vusb))
    patch.setenv("VCAMERADIR", os.fspath(folder))
    patch.setattr(driver, "_SERIALS", {})


@dataclass
class Setting:
    """A widget: its value, choices and whether it is read-only."""

    value: Any
    choices: list[str] = field(default_factory=list)
    readonly: bool = False


class Error(Exception):
    """As `gphoto2.GPhoto2Error`."""

    def __init__(self, code: int, text: str) -> None:
        super().__init__(f"[{code}] {text}")
        self.code = code


@dataclass
class Body:
    """A camera on the bus. Its shutter opens `lag_s` after the release and closes after the
    exposure; `store_s` later it reports the file.

    `picture()`: the file's content, called as the shutter opens and as it closes; where the two
    differ, `torn` is stored. `blocks`: the release returns when the shutter has
    closed. `busy`: how many commands are refused as the camera is busy. `faults`: "unplugged",
    "no file", "claimed", "no capture", or "full".
    """

    serial: str = "123"
    port: str = "usb:001,004"
    model: str = "Stand-in EOS"
    lag_s: float = 0.0
    store_s: float = 0.0
    blocks: bool = False
    busy: int = 0
    faults: set[str] = field(default_factory=set)
    picture: Callable[[], bytes] = jpeg
    torn: bytes = jpeg(0)
    settings: dict[str, Setting] = field(
        default_factory=lambda: {
            "serialnumber": Setting("", readonly=True),
            "batterylevel": Setting("75%", readonly=True),
            "capturetarget": Setting("Memory card", ["Internal RAM", "Memory card"]),
            "imageformat": Setting("RAW", ["RAW", "RAW + L", "L"]),
            "iso": Setting("100", ["Auto", "100", "200"]),
            "shutterspeed": Setting("1/60", ["bulb", "30", "1/60", "1/250", "1/500", "1/1000"]),
            "bulb": Setting(2),
        }
    )
    files: dict[str, bytes] = field(default_factory=dict)
    shots: int = 0
    releases: int = 0
    opened: list[tuple[float, float]] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.settings["serialnumber"].value = self.serial
        self.events: list[tuple[float, int, Any]] = []
        self.open_since: float | None = None

    def expose(self, seconds: float) -> None:
        time.sleep(self.lag_s)
        first, opened = self.picture(), time.monotonic()
        time.sleep(seconds)
        self.opened.append((opened, time.monotonic()))
        self.store(first if self.picture() == first else self.torn)

    def store(self, content: bytes) -> None:
        self.shots += 1
        if "no file" in self.faults:
            return
        due = time.monotonic() + self.store_s
        if "full" in self.faults:
            self.events.append((due, FakeGphoto2.GP_EVENT_UNKNOWN, "PTP Event 400a, Param1 0"))
            return
        name = f"IMG_{self.shots:04d}.JPG"
        self.files[name] = content
        path = SimpleNamespace(folder="/store", name=name)
        self.events.append((due, FakeGphoto2.GP_EVENT_FILE_ADDED, path))


class FakeGphoto2:
    """Stands for the module `gphoto2` with the cameras `bodies` on the bus."""

    GPhoto2Error = Error
    GP_ERROR_IO, GP_ERROR_BAD_PARAMETERS, GP_ERROR_NO_MEMORY = -7, -2, -3
    GP_ERROR_IO_USB_CLAIM, GP_ERROR_CAMERA_BUSY, GP_ERROR_NO_SPACE = -53, -110, -115
    GP_EVENT_UNKNOWN, GP_EVENT_TIMEOUT, GP_EVENT_FILE_ADDED = 0, 1, 2
    GP_WIDGET_TEXT, GP_WIDGET_RANGE, GP_WIDGET_TOGGLE = 2, 3, 4
    GP_WIDGET_RADIO, GP_WIDGET_MENU, GP_WIDGET_DATE = 5, 6, 8
    GP_OPERATION_CONFIG, GP_OPERATION_TRIGGER_CAPTURE, GP_FILE_TYPE_NORMAL = 16, 32, 1

    def __init__(self, *bodies: Body) -> None:
        self.bodies = list(bodies)
        bus = self

        class Camera(_Camera):
            bodies = bus.bodies

            @staticmethod
            def autodetect() -> _Pairs:
                return _Pairs(b for b in bus.bodies if "unplugged" not in b.faults)

        class PortInfoList:
            def load(self) -> None: ...

            def lookup_path(self, path: str) -> int:
                return [b.port for b in bus.bodies].index(path)

            def __getitem__(self, index: int) -> str:
                return bus.bodies[index].port

        self.Camera, self.PortInfoList = Camera, PortInfoList


class _Pairs:
    """A `CameraList`, in which a model may be there twice."""

    def __init__(self, bodies: Any) -> None:
        self._pairs = [(b.model, b.port) for b in bodies]

    def items(self) -> list[tuple[str, str]]:
        return self._pairs


class _Widget:
    def __init__(self, setting: Setting) -> None:
        self.value, self.choices, self.readonly = setting.value, setting.choices, setting.readonly

    def get_value(self) -> Any:
        return self.value

    def set_value(self, value: Any) -> None:
        self.value = value

    def get_choices(self) -> list[str]:
        return self.choices

    def get_readonly(self) -> bool:
        return self.readonly

    def get_type(self) -> int:
        toggle = isinstance(self.value, int)
        kind = FakeGphoto2.GP_WIDGET_TOGGLE if toggle else FakeGphoto2.GP_WIDGET_TEXT
        return FakeGphoto2.GP_WIDGET_RADIO if self.choices else kind


class _Camera:
    bodies: list[Body]

    def set_port_info(self, port: str) -> None:
        self.body = next(b for b in self.bodies if b.port == port)

    def init(self) -> None:
        if "claimed" in self.body.faults:
            raise Error(FakeGphoto2.GP_ERROR_IO_USB_CLAIM, "Could not claim the USB device")

    def exit(self) -> None:
        self._there()

    def _there(self, busy: bool = False) -> Body:
        if "unplugged" in self.body.faults:
            raise Error(FakeGphoto2.GP_ERROR_IO, "I/O problem")
        if busy and self.body.busy > 0:
            self.body.busy -= 1
            raise Error(FakeGphoto2.GP_ERROR_CAMERA_BUSY, "I/O in progress")
        return self.body

    def get_abilities(self) -> Any:
        kind = 0 if "no capture" in self.body.faults else 48
        return SimpleNamespace(model=self.body.model, operations=kind)

    def get_storageinfo(self) -> list[Any]:
        return [SimpleNamespace(freeimages=0 if "full" in self._there().faults else 150)]

    def get_single_config(self, name: str) -> _Widget:
        setting = self._there().settings.get(name)
        if setting is None:
            raise Error(FakeGphoto2.GP_ERROR_BAD_PARAMETERS, "Bad parameters")
        return _Widget(setting)

    def set_single_config(self, name: str, widget: _Widget) -> None:
        body = self._there(busy=True)
        if name != "bulb":
            body.settings[name].value = widget.value
        elif widget.value:
            body.open_since = time.monotonic()
        elif body.open_since is not None:
            body.opened.append((body.open_since, time.monotonic()))
            body.store(body.picture())

    def trigger_capture(self) -> None:
        body = self._there(busy=True)
        body.releases += 1
        shutter = shutter_seconds(body.settings["shutterspeed"].value)
        thread = threading.Thread(target=body.expose, args=(shutter,), daemon=True)
        thread.start()
        if body.blocks:
            thread.join()

    def wait_for_event(self, milliseconds: int) -> tuple[int, Any]:
        body, until = self._there(), time.monotonic() + milliseconds / 1e3
        while not (due := [e for e in body.events if e[0] <= time.monotonic()]):
            if time.monotonic() >= until:
                return FakeGphoto2.GP_EVENT_TIMEOUT, None
            time.sleep(0.001)
        body.events.remove(due[0])
        return due[0][1:]

    def file_get(self, folder: str, name: str, kind: int) -> Any:
        content = self._there().files[name]
        return SimpleNamespace(get_data_and_size=lambda: memoryview(content))

    def file_delete(self, folder: str, name: str) -> None:
        del self._there().files[name]


def shutter_seconds(choice: str) -> float:
    """Seconds of a choice such as "1/125"."""
    above, _, below = choice.partition("/")
    return float(above) / float(below or 1)
