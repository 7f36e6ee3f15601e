"""DSLRs and mirrorless cameras on USB, through libgphoto2; see `docs/reference/wire.md`.

They have no input for the trigger box: `release` starts an exposure, and each frame is a file that
the camera reports when it has one.
"""

from __future__ import annotations

import math
import re
import threading
import time
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any

from reconstruction import Camera
from stage_service.device_config import Gphoto2Config
from stage_service.devices.cameras import photographs
from stage_service.devices.cameras.genicam import BLOCK_WRAP, SLICE_S
from stage_service.devices.cameras.gphoto2_settings import SPEEDS, Settings
from stage_service.devices.cameras.interface import Busy, CameraCapabilities, CameraInfo, Frame
from stage_service.devices.errors import Cancelled, DeviceError, DeviceTimeout, DeviceUnreachable

LOWEST_BATTERY = 10
"""Per cent."""
LOOK_S = 0.2
"""Longest look at the events that are there: some cameras always have one more."""
QUIET = {"capturetarget": "Internal RAM", "autofocus": "Off"}
"""Written first, where the camera has them."""
OURS = {*SPEEDS, "bulb"}
"""Settings that the driver writes itself; `settings` may not."""
STORE_FULL = re.compile(r"PTP Event 400a\b")
_LISTING = threading.Lock()
"""Cameras connect side by side, and each looks at those that no other has."""
_SERIALS: dict[str, str] = {}
"""The serial number of the camera at each USB port; a camera that is plugged in has a new port."""


class Gphoto2Camera:
    """Implements `CameraDevice`; see there for the contract. Block ids count the files that
    were read."""

    def __init__(self, config: Gphoto2Config, geometry: Camera) -> None:
        self.name = geometry.name
        self.serial = config.serials.get(geometry.name, "")
        self.device = f"camera {geometry.name} (gphoto2 {self.serial})"
        self.config = config
        self.geometry = geometry
        self.capabilities = CameraCapabilities(config.buffers, False, BLOCK_WRAP)
        self.busy: Busy | None = None
        self._info: CameraInfo | None = None
        self._gp: Any = None
        self._camera: Any = None
        self._settings: Any = None
        self._failures: Any = ()
        self._port = ""
        self._exposure: float | None = None
        self._by_bulb = False
        self._released: deque[float] = deque()  # exposures of the frames that were not read
        self._files: deque[tuple[str, str]] = deque()  # folder and name of those on the camera
        self._count = 0
        self._trouble: Exception | None = None
        self._lock = threading.RLock()

    @property
    def info(self) -> CameraInfo:
        """Size and `gain` from the rig file."""
        if self._info is None:
            raise RuntimeError(f"{self.device}: not connected")
        return self._info

    def connect(self) -> None:
        """Find the camera by its serial number or port, and write its settings.

        Raises `DeviceError` where it refuses one, cannot be released over USB, or has no charge.
        """
        self._load()
        with self._command("connecting"):
            self.close()
            try:
                self._find()
                self._set_up("setting up")
            except (DeviceError, self._failures):
                self.close()
                raise

    def close(self) -> None:
        """Close the link, unless a release that hangs keeps it for `timeout_s`."""
        with suppress(DeviceTimeout), self._command("closing"):
            if self._camera is not None:
                with suppress(self._failures):
                    self._camera.exit()
            self._camera = self._settings = self._exposure = self._trouble = None
            self._released.clear()
            self._files.clear()
            self._count = 0

    def arm(self, exposure: float) -> None:
        """Expose at the next releases for `exposure` seconds, by a shutter speed of the camera's
        list, or by bulb from `BULB_S` on. Unread frames are deleted."""
        doing = f"arming for {exposure:g} s"
        with self._command(doing):
            self._open(doing)
            self._end(doing)
            for name in ("imagequality", "imageformat"):
                if "+" in (value := str(self._settings.value(name) or "")):
                    todo = f"Set {name} to RAW alone in [devices.cameras.settings]."
                    raise self._error(doing, "one file a frame", f"{name} = {value}", todo)
            self._exposure, self._by_bulb = self._settings.expose(exposure)

    def release(self) -> None:
        """Release the shutter. A busy camera makes no frame of this pulse."""
        doing = "releasing the shutter"
        try:
            with self._command(doing):
                self._release(doing)
        except Exception as error:  # raised by `read`
            self._trouble = error

    def disarm(self) -> None:
        """Ignore releases from now on; unread frames are deleted."""
        with self._command("disarming"):
            self._open("disarming")
            self._end("disarming")

    def read(self, cancel: threading.Event) -> Frame | None:
        """The oldest unread frame. Raises `DeviceTimeout` where a release made no file within
        `frame_s`, and what `release` could not do."""
        doing = "reading a frame"
        with self._command(doing):
            if self._trouble is not None:
                error, self._trouble = self._trouble, None
                raise error
            self._open(doing)
            try:
                if self._exposure is None or not self._wait(doing, cancel):
                    return None
                self.busy = Busy("downloading a file")
                return self._frame(doing)
            finally:
                self.busy = None

    def _load(self) -> None:
        try:
            import gphoto2
        except ImportError as error:
            todo = "Install it: pip install 'hairstage[gphoto2]'."
            expected = "the library python-gphoto2"
            raise DeviceUnreachable(
                self.device, "connecting", expected, str(error), todo
            ) from error
        self._gp, self._failures = gphoto2, gphoto2.GPhoto2Error

    def _find(self) -> None:
        """Open the camera; those of other serial numbers are opened once to read theirs."""
        with _LISTING:
            models = self._models()
            for port in _SERIALS.keys() - models.keys():
                del _SERIALS[port]
            seen = []
            for port, model in models.items():
                if self.serial in (port, _SERIALS.get(port, self.serial)):
                    seen.append(self._try(port, model))
                    if self._camera is not None:
                        return
                else:
                    seen.append(f"{model} {_SERIALS[port]} at {port}")
        expected = f"a camera with serial number or port {self.serial}"
        todo = "Check power, cable and serials in [devices.cameras]; close programs that hold "
        todo += "cameras, such as gvfs-gphoto2-volume-monitor; install the rules of deploy/udev."
        received = ", ".join(seen) or "no camera at all"
        raise DeviceUnreachable(self.device, "connecting", expected, received, todo)

    def _try(self, port: str, model: str) -> str:
        """Open the camera at a port, and keep it if it is this one; returns what it is."""
        ports = self._gp.PortInfoList()
        ports.load()
        camera = self._gp.Camera()
        camera.set_port_info(ports[ports.lookup_path(port)])
        try:
            camera.init()
        except self._failures as error:
            return f"{model} at {port} that does not open: {error}"
        self._camera, self._port = camera, port
        self._settings = Settings(self.device, self._gp, camera, self.config.timeout_s)
        found = str(self._settings.value("serialnumber") or "without a serial number")
        _SERIALS[port] = found
        if self.serial not in (port, found):
            camera.exit()
            self._camera = None
        return f"{model} {found} at {port}"

    def _models(self) -> dict[str, str]:
        """The model at each USB port."""
        return {port: model for model, port in self._gp.Camera.autodetect().items()}

    def _set_up(self, doing: str) -> None:
        gp, config, settings = self._gp, self.config, self._settings
        if ours := sorted(OURS & config.settings.keys()):
            todo = "Remove them from [devices.cameras.settings]."
            expected = "settings that the driver does not write itself"
            raise self._error(doing, expected, ", ".join(ours), todo)
        needed = gp.GP_OPERATION_TRIGGER_CAPTURE | gp.GP_OPERATION_CONFIG
        abilities = self._camera.get_abilities()
        if abilities.operations & needed != needed:
            todo = "Use a camera with remote capture in gphoto.org's list, in its PTP mode."
            expected = "a camera that can be released and set over USB"
            raise self._error(doing, expected, abilities.model, todo)
        battery = str(settings.value("batterylevel"))
        charge = re.match(r"(\d+) ?%|low|empty", battery, re.IGNORECASE)
        if charge and int(charge[1] or 0) < LOWEST_BATTERY:
            expected = f"a battery of at least {LOWEST_BATTERY} %"
            todo = "Charge or change it; a mains adapter lasts a whole capture."
            raise self._error(doing, expected, battery, todo)
        for name, value in QUIET.items():
            if name not in config.settings and value in settings.choices(name):
                settings.write(name, value)
        for name, setting in config.settings.items():
            settings.write(name, setting)
        size = self.geometry.width, self.geometry.height
        self._info = CameraInfo(*size, photographs.FULL, photographs.BLACK, config.gain)

    def _release(self, doing: str) -> None:
        began = time.monotonic()
        if self._exposure is None or self._camera is None:
            return
        if self._released:  # some cameras forget the file at the next release
            self._wait(doing, threading.Event(), len(self._released))
        exposure = self._exposure
        try:
            if self._by_bulb:
                exposure = self._bulb(exposure)
            else:
                self._camera.trigger_capture()
        except self._failures as error:
            if error.code == self._gp.GP_ERROR_CAMERA_BUSY:
                return  # `arm` waits until it is not
            raise
        self._released.append(exposure)
        limit, took = self.config.release_s + exposure, time.monotonic() - began
        if took > limit:
            expected, received = "the exposure's end", f"it after {took:.3g} s"
            todo = "The lamps were off by then: raise release_s in [devices.cameras]."
            raise DeviceTimeout(self.device, doing, expected, received, todo, limit)

    def _bulb(self, exposure: float) -> float:
        """Open and close the shutter; returns the seconds between the two."""
        opened = time.monotonic()
        self._settings.write("bulb", True)
        try:
            time.sleep(max(0.0, opened + exposure - time.monotonic()))
        finally:
            closed = time.monotonic()
            self._settings.write("bulb", False)
        return closed - opened

    def _wait(self, doing: str, cancel: threading.Event, files: int = 1) -> bool:
        """Wait for the files of releases; without a release only look whether there is one."""
        began = time.monotonic()
        limit = self.config.frame_s + sum(self._released)
        if not self._released:
            self._look()
        while len(self._files) < files and self._released:
            self.busy = Busy("waiting for a file")
            left = began + limit - time.monotonic()
            if left <= 0 and self._removed():
                raise self._gone(doing)
            if left <= 0:
                todo = "Switch off autofocus, self-timer and mirror lock-up, check card and mode "
                todo += "dial (M), or raise frame_s in [devices.cameras]."
                expected, received = "the file of a release", f"none ({self._condition()})"
                raise DeviceTimeout(self.device, doing, expected, received, todo, limit)
            if cancel.is_set():
                raise Cancelled(f"{self.device}: {doing} was given up")
            self._event(min(left, SLICE_S))
        return len(self._files) >= files

    def _event(self, seconds: float) -> bool:
        """Take up the next event that comes within so long; returns whether one came."""
        gp = self._gp
        kind, data = self._camera.wait_for_event(math.ceil(seconds * 1e3))
        if kind == gp.GP_EVENT_FILE_ADDED:
            self._files.append((data.folder, data.name))
        elif kind == gp.GP_EVENT_UNKNOWN and STORE_FULL.match(str(data)):
            raise self._full("storing a frame")
        return bool(kind != gp.GP_EVENT_TIMEOUT)

    def _frame(self, doing: str) -> Frame:
        folder, name = self._files[0]
        file = self._camera.file_get(folder, name, self._gp.GP_FILE_TYPE_NORMAL)
        data = bytes(file.get_data_and_size())
        exposure = self._take()
        self._count += 1
        if data.startswith(photographs.JPEG) and not self.config.jpeg:
            todo = "Set its image quality to RAW in [devices.cameras.settings] (imageformat or "
            todo += "imagequality), or jpeg = true."
            raise self._error(doing, "a RAW file", f"the JPEG file {name}", todo)
        try:
            counts = photographs.counts(data)
        except ValueError as error:
            todo = "Set the camera to RAW of a kind that LibRaw reads, or set jpeg = true."
            received = f"{name}, {len(data)} bytes: {error}"
            raise self._error(doing, "a photograph", received, todo) from error
        size = counts.shape[1], counts.shape[0]
        if size != (self.info.width, self.info.height):
            expected = f"{self.info.width}x{self.info.height} pixels as in the rig file"
            todo = "Set the camera's image size, or calibrate the rig for this one."
            raise self._error(doing, expected, f"{size[0]}x{size[1]} in {name}", todo)
        self._delete(folder, name)
        self._look()
        return Frame(counts, self._count, 0.0, exposure, len(self._files))

    def _take(self) -> float:
        """Forget the oldest file; returns its exposure."""
        self._files.popleft()
        return self._released.popleft() if self._released else self._exposure or 0.0

    def _delete(self, folder: str, name: str) -> None:
        if not self.config.keep:
            with suppress(self._failures):  # a file in the camera's memory is gone by itself
                self._camera.file_delete(folder, name)

    def _look(self) -> None:
        """Take up the events that are there."""
        until = time.monotonic() + LOOK_S
        while self._event(0.0) and time.monotonic() < until:
            pass

    def _end(self, doing: str) -> None:
        """Stop exposing; unread frames are deleted once their files are there."""
        self._exposure = self._trouble = None
        self._wait(doing, threading.Event(), len(self._released))
        while self._files:
            self._delete(*self._files[0])
            self._take()

    def _condition(self) -> str:
        """Battery and card, as far as the camera reports them."""
        found = []
        with suppress(self._failures):
            found.append(f"battery {self._settings.value('batterylevel') or 'unknown'}")
            found += [f"room for {s.freeimages} images" for s in self._camera.get_storageinfo()]
        return ", ".join(found) or "no reply about battery and card"

    def _removed(self) -> bool:
        with _LISTING:
            return self._port not in self._models()

    def _open(self, doing: str) -> None:
        if self._camera is None:
            todo = "Connect again; what the camera held is lost."
            raise DeviceUnreachable(self.device, doing, "an open camera", "a closed one", todo)

    @contextmanager
    def _command(self, doing: str) -> Iterator[None]:
        """Turn the library's exceptions into `DeviceError`, and wait for another thread's release,
        which may outlast a capture."""
        limit = self.config.timeout_s
        if not self._lock.acquire(timeout=limit):
            expected, received = "the end of the last command", "a camera that hangs"
            todo = "Switch it off and on, and start again."
            raise DeviceTimeout(self.device, doing, expected, received, todo, limit)
        try:
            yield
        except self._failures as error:
            gp, code = self._gp, error.code
            if code == gp.GP_ERROR_CAMERA_BUSY:
                todo = "Leave its menu and live view, and wait until it has written its card."
                expected, received = "a camera that is ready", "busy all the time"
                raise DeviceTimeout(self.device, doing, expected, received, todo, limit) from error
            if self._camera is not None and self._removed():
                raise self._gone(doing) from error
            if code in (gp.GP_ERROR_NO_SPACE, gp.GP_ERROR_NO_MEMORY):
                raise self._full(doing) from error
            todo = "Check lens (manual focus), mode dial (M), mirror lock-up, card and cable."
            received = f"{error} ({self._condition() if self._camera else 'closed'})"
            raise self._error(doing, "success of libgphoto2", received, todo) from error
        finally:
            self._lock.release()

    def _full(self, doing: str) -> DeviceError:
        todo = "Empty the card; frames that were read are in the capture, which can be resumed."
        received = f"a full card ({self._condition()})"
        return self._error(doing, "room for a file", received, todo)

    def _gone(self, doing: str) -> DeviceUnreachable:
        self.close()
        received = "a camera that was unplugged, lost power or fell asleep"
        todo = "Check power, cable and its automatic switch-off, and resume the capture."
        return DeviceUnreachable(self.device, doing, "the camera", received, todo)

    def _error(self, doing: str, expected: str, received: str, todo: str) -> DeviceError:
        return DeviceError(self.device, doing, expected, received, todo)
