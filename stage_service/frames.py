"""A capture's steps and frames, for those who look at them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

from pydantic import BaseModel, ConfigDict

from reconstruction import Capture, CaptureError
from stage_service.service_models import StepView

T = TypeVar("T")


class FrameFigures(BaseModel):
    """How a frame is exposed. `white`: the 99.5 % quantile of its values, W/(sr m²); `saturated`:
    the share of its pixels of which a channel is at `full_scale` (None: it never saturates).

    `histogram` counts values in 64 equal bins from 0 to full scale, or to the largest value.
    `focus` is the variance of the green channel's Laplacian by the square of its mean: it is at its
    largest where the picture is sharpest, and compares frames of one camera in one light.
    """

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False)

    width: int
    height: int
    largest: float
    white: float
    full_scale: float | None
    saturated: float
    histogram: list[int]
    focus: float


class UnknownFrame(LookupError):
    """The capture's plan has no such step or its rig no such camera."""


def read_frame(capture: Capture, step: int, camera: str, read: Callable[[Path], T]) -> T:
    """What `read` makes of a frame's EXR file. Raises `UnknownFrame`, `MissingFrame`;
    `CaptureError` where the file is gone or cannot be read."""
    by_index = {s.index: s for s in capture.steps}
    cameras = [c.name for c in capture.rig.cameras]
    if step not in by_index or camera not in cameras:
        raise UnknownFrame(
            f"{capture.path.name} has the steps {min(by_index, default=None)} to "
            f"{max(by_index, default=None)} and the cameras "
            f"{cameras}; got step {step}, camera {camera!r}"
        )
    try:
        return capture.read_file(by_index[step], camera, read)
    except CaptureError:
        raise
    except (OSError, ValueError) as error:
        raise CaptureError(str(error)) from error


def steps_of(capture: Capture) -> list[StepView]:
    """What a capture shoots, in order, and which frames it has."""
    names = [camera.name for camera in capture.rig.cameras]
    there = {key for key, r in capture.records.items() if r.file is not None}
    return [
        StepView(**step.to_dict(), lacks=[n for n in names if (step.index, n) not in there])
        for step in capture.steps
    ]
