"""Calibration from the console: the board in each image, then the solution.

The solution is `hairstage calibrate rig`, in a process of its own, because a capture may start
meanwhile.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import threading
from collections.abc import Callable
from concurrent.futures import Future
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel

from reconstruction import CaptureError, MissingFrame
from reconstruction.calibration.boards import Board, CalibrationError
from reconstruction.capture.writer import utc_now
from reconstruction.reading import read_json
from stage_service.config import RigFile
from stage_service.decoding import Decoder, Undecodable
from stage_service.records.events import EventLog
from stage_service.service_models import BoardSize, CalibrationRequest
from stage_service.signals import tied

LOWER = 10
"""Niceness of the process above the service's."""
Point = tuple[float, float]
ERRORS: dict[str, type[ValueError]] = {
    **dict.fromkeys(("MissingFrame", "NoSilhouette"), MissingFrame),
    **dict.fromkeys(("CalibrationError", "RigError"), CalibrationError),
}
"""The exception for an error in the decoder, by the name of its class."""


class BoardView(BaseModel):
    """The board in a camera's image: `corners` of `of`, at `pixels`. If they determine its pose,
    which is fitted to this image alone: `off`, the residual of each corner in pixels, their
    `rms_px`, and the board's tilt from the image plane."""

    corners: int
    of: int
    pixels: list[Point]
    off: list[Point] = []
    rms_px: float | None = None
    tilt_deg: float | None = None
    lens: Literal["nominal", "calibrated"]


class CalibrationView(BaseModel):
    """The newest calibration: the `stages` of its report, or its `error`. `rig`: there is a
    calibrated rig file, of this or an earlier calibration."""

    state: Literal["none", "running", "done", "failed"]
    started: str | None = None
    request: CalibrationRequest | None = None
    error: str | None = None
    stages: list[dict[str, Any]] = []
    rig: bool = False


class Calibrating:
    """One calibration at a time, stored in `root/calibration`; safe to call from any thread."""

    def __init__(self, folder: Path, rig_file: RigFile, events: EventLog, decoder: Decoder) -> None:
        self._folder, self._rig_file, self._events = folder, rig_file, events
        self._decoder = decoder
        self._lock = threading.Lock()
        self._process: subprocess.Popen[str] | None = None
        self._view = CalibrationView(state="none")

    @property
    def rig(self) -> Path:
        """The path of the calibrated rig file."""
        return self._folder / "rig.json"

    def view(self) -> CalibrationView:
        """The newest calibration; after a restart, the report of the last successful one."""
        with self._lock:
            view = self._view
        if not self.rig.is_file():
            return view
        stages, report = [], self._folder / "rig.report.json"
        if view.state in ("none", "done") and report.is_file():
            stages = read_json(report)["stages"]
        state = "done" if view.state == "none" else view.state
        return view.model_copy(update={"rig": True, "stages": stages, "state": state})

    def begin(self, request: CalibrationRequest, path: Callable[[str], Path]) -> CalibrationView:
        """Calibrate by these captures, whose folders `path(id)` returns; ends a running
        calibration. Raises as `path`, and `CalibrationError` for an invalid board."""
        board_of(request.board)
        names = {k: [path(n) for n in getattr(request, k)] for k in ("boards", "diffuse", "mirror")}
        made = self._folder / "next.json"
        words: list[Any] = [*names["boards"], "--rig", self._rig_file.path, "--out", made]
        for kind in ("diffuse", "mirror"):
            words += [f"--{kind}", *names[kind]] if names[kind] else []
        options = request.model_dump(exclude={"boards", "diffuse", "mirror", "board", "keep_lens"})
        options |= request.board.model_dump()
        for name, value in options.items():
            words += [] if value is None else [f"--{name.replace('_', '-')}", value]
        words += ["--keep-lens"] if request.keep_lens else []
        command = [sys.executable, "-m", "stage_service.cli", "calibrate", "rig", "--json"]
        self._folder.mkdir(parents=True, exist_ok=True)
        started: Future[subprocess.Popen[str]] = Future()
        work = partial(self._run, [*command, *map(str, words)], made, started)
        with self._lock:
            self._end()
            threading.Thread(target=work, name="calibration", daemon=True).start()
            self._process = started.result()
            self._view = CalibrationView(state="running", started=utc_now(), request=request)
        self._events.publish("calibration.state", {"state": "running"})
        return self.view()

    def close(self) -> None:
        """End a running calibration."""
        with self._lock:
            self._end()

    def _end(self) -> None:
        process, self._process = self._process, None
        if process is not None and process.poll() is None:
            process.kill()
            process.wait()

    def _run(self, command: list[str], made: Path, started: Future[subprocess.Popen[str]]) -> None:
        """Start the process, on the thread that it is tied to, and store its result."""
        try:
            with (self._folder / "log").open("w") as log:
                process = subprocess.Popen(
                    tied(command, "KILL"),
                    stdin=subprocess.DEVNULL,
                    stdout=subprocess.PIPE,
                    stderr=log,
                    text=True,
                    start_new_session=True,
                )
        except Exception as error:  # raised in `begin`
            started.set_exception(error)
            return
        with suppress(OSError):
            os.setpriority(os.PRIO_PROCESS, process.pid, LOWER)
        started.set_result(process)
        output, _ = process.communicate()
        with self._lock:
            if self._process is not process:  # ended by `_end`
                return
            update: dict[str, Any] = {"state": "done"}
            try:
                if process.returncode != 0:
                    update = {"state": "failed", "error": self._why(output)}
                else:
                    for suffix in (".report.json", ".json"):
                        made.with_suffix(suffix).replace(self.rig.with_suffix(suffix))
            except OSError as error:  # of the disk: the old rig stays
                update = {"state": "failed", "error": str(error)}
            self._view = self._view.model_copy(update=update)
        self._events.publish("calibration.state", {"state": update["state"]})

    def _why(self, output: str) -> str:
        with suppress(ValueError, LookupError, TypeError):
            return str(json.loads(output.splitlines()[-1])["error"]["detail"])
        lines = (self._folder / "log").read_text(errors="replace").strip().splitlines()
        return lines[-1] if lines else "the process ended without output"

    def detect(self, capture: Path, camera: str, size: BoardSize, calibrated: bool) -> BoardView:
        """Detect the board in a camera's lit frame in `capture`, with the capture's lens or the
        calibrated one, if there is one. Raises `MissingFrame`, `CalibrationError`, `CaptureError`,
        `DecoderBusy`."""
        board = board_of(size)
        rig = self.rig if calibrated and self.rig.is_file() else None
        what = board.columns, board.rows, board.square, board.marker, board.dictionary
        try:
            return BoardView.model_validate(self._decoder.board(capture, camera, what, rig))
        except Undecodable as error:
            raise ERRORS.get(error.kind, CaptureError)(str(error)) from error


def board_of(size: BoardSize) -> Board:
    """The board. Raises `CalibrationError` for an invalid size."""
    square, marker = 1e-3 * size.square_mm, 1e-3 * size.marker_mm
    return Board(size.columns, size.rows, square, marker, size.dictionary)
