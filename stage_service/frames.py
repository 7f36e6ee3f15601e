"""A capture's steps and frames, as the console and its users view them."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, ConfigDict

from reconstruction import Capture, CaptureError
from reconstruction.calibration.boards import CalibrationError
from stage_service.calibrating import BoardView, Calibrating
from stage_service.decoding import Decoder
from stage_service.inputs import BadInput
from stage_service.service_models import BoardQuery, StepView

T = TypeVar("T")


class FrameFigures(BaseModel):
    """Exposure of a frame. `white`: the 99.5 % quantile of its values, W/(sr m²); `saturated`: the
    share of pixels with a channel at `full_scale` (None: it never saturates).

    `histogram` counts values in 64 equal bins from 0 to full scale, or to the largest value.
    `focus` is the variance of the green channel's Laplacian over its squared mean; it compares
    frames of one camera in one light and is largest for the sharpest.
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


class Frames:
    """Frames of the captures that `capture_path(id)` finds; images are decoded by `decoder`.

    Every method raises `UnknownCapture`.
    """

    def __init__(
        self, capture_path: Callable[[str], Path], decoder: Decoder, calibrating: Calibrating
    ) -> None:
        self._capture_path, self._decoder = capture_path, decoder
        self._calibrating = calibrating

    def read(self, capture_id: str, step: int, camera: str, read: Callable[[Path], T]) -> T:
        """`read(file)` of a frame's EXR file.

        Raises `UnknownFrame`, `MissingFrame`; `CaptureError` if the file is gone or unreadable.
        """
        capture = Capture(self._capture_path(capture_id))
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

    def preview(self, capture_id: str, step: int, camera: str, **look: Any) -> bytes:
        """A PNG of a frame, see `png_of_frame`. Raises as `read`, and `DecoderBusy`."""
        return self.read(capture_id, step, camera, partial(self._decoder.preview, **look))

    def figures(self, capture_id: str, step: int, camera: str) -> FrameFigures:
        """The exposure of a frame. Raises as `read`, and `DecoderBusy`."""
        found = self.read(capture_id, step, camera, self._decoder.figures)
        return FrameFigures.model_validate(found)

    def steps(self, capture_id: str) -> list[StepView]:
        """A capture's steps in order, with the cameras that lack a frame. Raises `CaptureError`."""
        capture = Capture(self._capture_path(capture_id))
        names = [camera.name for camera in capture.rig.cameras]
        there = {key for key, r in capture.records.items() if r.file is not None}
        return [
            StepView(**step.to_dict(), lacks=[n for n in names if (step.index, n) not in there])
            for step in capture.steps
        ]

    def board(self, capture_id: str, camera: str, board: BoardQuery) -> BoardView:
        """The calibration board in a camera's frame. Raises as `read`, and `BadInput`."""
        capture = Capture(self._capture_path(capture_id))
        if camera not in [c.name for c in capture.rig.cameras]:
            raise UnknownFrame(f"{capture_id} has no camera {camera!r}")
        try:
            return self._calibrating.detect(capture.path, camera, board, board.calibrated)
        except CalibrationError as error:
            raise BadInput(str(error)) from error
