"""Faults injected into simulated devices."""

from __future__ import annotations

import json
import threading
from collections.abc import Callable
from dataclasses import asdict, dataclass, fields
from pathlib import Path

SERIAL = ("silent", "garbage", "nak", "late", "noise", "unplug")
"""Faults of a serial line, see `Fault`."""
_ON_REQUEST = (*SERIAL, "crc", "echo", "drop", "repeat")
_TRIGGER = ("interlock", "estop", "double", "dropped", "uncounted", "late_trigger")
_KINDS = {
    "camera": ("drop", "mute", "lost", "repeat", "stray", "late_frame"),
    "trigger": (*SERIAL, *_TRIGGER),
    "projectors": (*SERIAL, "blank"),
    "lights": (*SERIAL, "crc", "echo", "drop", "repeat", "hang", "lies", "stuck", "override"),
}


class FaultError(ValueError):
    """A fault file that cannot be used; the message names the file and the entry."""


@dataclass(frozen=True)
class Fault:
    """One fault. `pulse` is the trigger box's count at which, or from which on, it occurs.

    camera: drop misses the pulse; lost loses its frame on the way; repeat gives it the number of
    the previous frame; stray sends one more frame; late_frame holds it until the next pulse; mute
    sends no response from then on. trigger: interlock and estop are open or pressed from then on;
    double fires twice and counts once; dropped counts without firing; uncounted fires without
    counting; late_trigger fires `seconds` late. projectors: blank shows no pattern from then on.
    lights: hang sends no response from then on, while the watchdog runs; lies reports no lamp as
    lit from then on; stuck keeps the lamps lit that are lit at that pulse; override, on sACN and
    Art-Net: another source sends full levels from then on.

    Serial faults occur once, at the first request from that pulse on that begins with `request`;
    default: any request of projectors and lights, PULSE of the trigger box. Requests of the lights
    begin with function code and address on Modbus ("6 1000": the selector), with the label on DMX,
    with "dmx" and the universe or "poll" on networks.
    silent: executed without reply. garbage: executed, invalid reply. nak: not executed, error
    reply. late: executed, reply after `seconds`. noise: executed, a line of garbage precedes the
    reply. unplug: the port disappears before execution and returns after `seconds`. Only the
    lights: crc, the reply has a wrong checksum (RTU); echo, a write is acknowledged with another
    value; drop, the packet is lost; repeat, the packet before it arrives once more after it.
    """

    device: str
    kind: str
    pulse: int
    camera: str | None = None
    request: str | None = None
    seconds: float = 1.5

    def __post_init__(self) -> None:
        if self.device not in _KINDS or self.kind not in _KINDS[self.device]:
            known = "; ".join(f"{d}: {', '.join(k)}" for d, k in _KINDS.items())
            raise FaultError(f"unknown fault {self.device} {self.kind}; known are {known}")
        if not isinstance(self.pulse, int) or self.pulse < 0:
            raise FaultError(f"pulse must be a whole number >= 0, got {self.pulse!r}")
        if (self.device == "camera") != (self.camera is not None):
            raise FaultError(f"the field camera belongs to camera faults: {asdict(self)}")
        if self.request is not None and self.kind not in _ON_REQUEST:
            raise FaultError(f"the field request belongs to serial faults: {asdict(self)}")
        if not isinstance(self.seconds, int | float) or not 0 < self.seconds <= 60:
            raise FaultError(f"seconds must be over 0 and at most 60, got {self.seconds!r}")


class Faults:
    """The faults of a run. Safe to call from several threads."""

    def __init__(self, faults: tuple[Fault, ...] = ()) -> None:
        self._left = list(faults)
        self._lock = threading.Lock()

    @classmethod
    def load(cls, path: str | Path, cameras: list[str]) -> Faults:
        """Read a JSON list of faults; raises `FaultError` naming the file and the entry."""
        known = {f.name for f in fields(Fault)}
        try:
            entries = json.loads(Path(path).read_text())
        except (OSError, json.JSONDecodeError) as error:
            raise FaultError(f"{path}: {error}") from error
        if not isinstance(entries, list):
            raise FaultError(f"{path}: expected a list of faults, got {type(entries).__name__}")
        faults = []
        for number, entry in enumerate(entries, 1):
            where, needed = f"{path}, fault {number}", {"device", "kind", "pulse"}
            if not isinstance(entry, dict) or not needed <= set(entry) <= known:
                optional = ", ".join(sorted(known - needed))
                raise FaultError(
                    f"{where}: expected device, kind, pulse[, {optional}], got {entry}"
                )
            try:
                fault = Fault(**entry)
            except FaultError as error:
                raise FaultError(f"{where}: {error}") from error
            if fault.camera is not None and fault.camera not in cameras:
                raise FaultError(f"{where}: no camera {fault.camera!r}; the rig has {cameras}")
            faults.append(fault)
        return cls(tuple(faults))

    def add(self, fault: Fault) -> None:
        """Add a fault while the devices run."""
        with self._lock:
            self._left.append(fault)

    def at(self, device: str, kind: str, pulse: int, camera: str | None = None) -> Fault | None:
        """The fault at exactly `pulse`, which is then removed."""
        wanted = (device, kind, pulse, camera)
        return self._use(lambda f: (f.device, f.kind, f.pulse, f.camera) == wanted)

    def on_request(self, device: str, request: str, pulse: int) -> Fault | None:
        """The serial fault of this request, which is then removed."""
        any_request = {"trigger": "PULSE"}.get(device, "")

        def strikes(fault: Fault) -> bool:
            word = any_request if fault.request is None else fault.request
            due = fault.device == device and fault.pulse <= pulse
            return due and fault.kind in _ON_REQUEST and request.startswith(word)

        return self._use(strikes)

    def _use(self, strikes: Callable[[Fault], bool]) -> Fault | None:
        with self._lock:
            for fault in self._left:
                if strikes(fault):
                    self._left.remove(fault)
                    return fault
        return None

    def since(self, device: str, kind: str, pulse: int, camera: str | None = None) -> bool:
        """Whether this lasting fault has begun by `pulse`."""
        with self._lock:
            return any(
                (f.device, f.kind, f.camera) == (device, kind, camera) and f.pulse <= pulse
                for f in self._left
            )
