"""The interface of a camera."""

from __future__ import annotations

import threading
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from reconstruction.arrays import Floats


@dataclass(frozen=True)
class CameraInfo:
    """A camera's description: `gain` in counts per (W/(sr m²) · s), `black` in counts."""

    width: int
    height: int
    full_scale: int
    black: float
    gain: float


@dataclass(frozen=True, eq=False)
class Frame:
    """One exposure as the camera sent it: `counts (H, W, 3) uint16`, RGB.

    `timestamp` is in seconds on the camera's clock, 0 where it has none; `left` is how many more
    frames the camera holds.
    """

    counts: NDArray[np.uint16]
    block_id: int
    timestamp: float
    exposure: float
    left: int = 0

    def radiance(self, info: CameraInfo) -> Floats:
        """Scene-linear radiance `(H, W, 3)`, W/(sr m²); noise may push it below zero."""
        scale = np.float32(self.count_scale(info))
        radiance = self.counts.astype(np.float32)
        radiance -= np.float32(info.black)
        radiance *= scale
        return radiance

    def count_scale(self, info: CameraInfo) -> float:
        """Radiance of one count."""
        return 1.0 / (info.gain * self.exposure)

    def full_scale(self, info: CameraInfo) -> float:
        """Radiance at which a channel saturates, with the rounding of `radiance`."""
        scale = np.float32(self.count_scale(info))
        return float((np.float32(info.full_scale) - np.float32(info.black)) * scale)


@dataclass(frozen=True)
class CameraCapabilities:
    """Abilities of camera and link.

    `buffers`: unread frames that it can hold. `timestamps`: it stamps frames with its clock.
    `block_wrap`: the last block id; the next is 1.
    """

    buffers: int
    timestamps: bool
    block_wrap: int


@dataclass(frozen=True)
class Busy:
    """What a camera reports of a frame that is not ready: what it does, and in how many seconds
    the frame is ready.

    `frame_s`: seconds until a later frame of a kind of step is ready, for the kinds that take
    longer than the others.
    """

    doing: str = ""
    left_s: float | None = None
    frame_s: Mapping[str, float] = field(default_factory=dict)


class CameraDevice(Protocol):
    """One camera that waits for hardware triggers, or for `release`. Every call raises
    `DeviceError`.

    `busy` is the camera's latest report while `read` waits, else None.
    """

    name: str
    capabilities: CameraCapabilities
    busy: Busy | None

    @property
    def info(self) -> CameraInfo:
        """The camera's description; known after `connect`."""

    def connect(self) -> None:
        """Open the link and check that the camera is the rig file's."""

    def close(self) -> None:
        """Close the link."""

    def arm(self, exposure: float) -> None:
        """Expose at the next pulses for `exposure` seconds; unread frames are dropped."""

    def release(self) -> None:
        """Expose now, on a camera without a trigger input, if it is armed; else do nothing. Returns
        once the exposure is under way or over. `read` raises the errors."""

    def disarm(self) -> None:
        """Ignore pulses from now on."""

    def read(self, cancel: threading.Event) -> Frame | None:
        """The oldest unread frame, or None when no pulse reached the camera.

        Waits while the camera is busy. Raises `Cancelled` once `cancel` is set.
        """
