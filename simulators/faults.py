"""Faults that a simulated device shows on request, to test what the service does about them."""

from __future__ import annotations

import json
import threading
from dataclasses import asdict, dataclass, fields
from pathlib import Path

_KINDS = {
    "camera": ("drop", "mute"),
    "trigger": ("silent", "garbage", "interlock", "estop"),
    "projectors": ("silent", "garbage"),
    "lights": ("hang",),
}


class FaultError(ValueError):
    """A fault file that cannot be used; the message names the file and the entry."""


@dataclass(frozen=True)
class Fault:
    """One fault. `pulse` is the trigger box's count from which, or at which, it shows.

    camera drop: no frame of `camera` for that pulse, once. camera mute: `camera` answers nothing
    from that pulse on. trigger silent or garbage: that pulse fires, its reply is lost or broken,
    once. trigger interlock or estop: open or pressed after that pulse, for good. projectors silent
    or garbage: the first reply after that pulse is lost or broken, once. lights hang: the bank
    answers nothing after that pulse, and its watchdog goes on.
    """

    device: str
    kind: str
    pulse: int
    camera: str | None = None

    def __post_init__(self) -> None:
        if self.device not in _KINDS or self.kind not in _KINDS[self.device]:
            known = "; ".join(f"{d}: {', '.join(k)}" for d, k in _KINDS.items())
            raise FaultError(f"unknown fault {self.device} {self.kind}; known are {known}")
        if not isinstance(self.pulse, int) or self.pulse < 0:
            raise FaultError(f"pulse must be a whole number >= 0, got {self.pulse!r}")
        if (self.device == "camera") != (self.camera is not None):
            raise FaultError(f"the field camera belongs to camera faults: {asdict(self)}")


class Faults:
    """The faults of a run; every device asks here. Safe to call from several threads."""

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
            where = f"{path}, fault {number}"
            if (
                not isinstance(entry, dict)
                or not {"device", "kind", "pulse"} <= set(entry) <= known
            ):
                raise FaultError(f"{where}: expected device, kind, pulse[, camera], got {entry}")
            try:
                fault = Fault(**entry)
            except FaultError as error:
                raise FaultError(f"{where}: {error}") from error
            if fault.camera is not None and fault.camera not in cameras:
                raise FaultError(f"{where}: no camera {fault.camera!r}; the rig has {cameras}")
            faults.append(fault)
        return cls(tuple(faults))

    def once(self, device: str, kind: str, pulse: int, camera: str | None = None) -> bool:
        """Whether this fault shows at exactly `pulse`; it is then used up."""
        with self._lock:
            for fault in self._left:
                if (fault.device, fault.kind, fault.camera) == (device, kind, camera) and (
                    fault.pulse == pulse
                ):
                    self._left.remove(fault)
                    return True
        return False

    def since(self, device: str, kind: str, pulse: int, camera: str | None = None) -> bool:
        """Whether this fault has begun by `pulse`; it stays."""
        with self._lock:
            return any(
                (f.device, f.kind, f.camera) == (device, kind, camera) and f.pulse <= pulse
                for f in self._left
            )
