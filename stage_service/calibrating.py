"""Calibration as an operator does it: what each picture shows of the board, then the solution.

The solution is `hairstage calibrate rig`, in a process of its own: it takes long, and a capture
may begin meanwhile.
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
"""How much lower than the service's the priority of the process is."""
Point = tuple[float, float]
ERRORS: dict[str, type[ValueError]] = {
    **dict.fromkeys(("MissingFrame", "NoSilhouette"), MissingFrame),
    **dict.fromkeys(("CalibrationError", "RigError"), CalibrationError),
}
"""What an error in the decoder is here, by the name of its class."""


class BoardView(BaseModel):
    """What a camera sees of the board: `corners` of `of`, at `pixels`. Where they tell its pose:
    `off`, from each to where the lens has it, px; their `rms_px`, and how far the board is tilted
    from the picture's plane. The pose is fitted to this picture alone."""

    corners: int
    of: int
    pixels: list[Point]
    off: list[Point] = []
    rms_px: float | None = None
    tilt_deg: float | None = None
    lens: Literal["nominal", "calibrated"]


class CalibrationView(BaseModel):
    """The newest calibration: `stages` are those of its report, `error` is why it came to none.
    `rig` says whether there is a calibrated rig file, of this one or of one before."""

    state: Literal["none", "running", "done", "failed"]
    started: str | None = None
    request: CalibrationRequest | None = None
    error: str | None = None
    stages: list[dict[str, Any]] = []
    rig: bool = False


class Calibrating:
    """One calibration at a time, kept in `root/calibration`; any thread may ask."""

    def __init__(self, folder: Path, rig_file: RigFile, events: EventLog, decoder: Decoder) -> None:
        self._folder, self._rig_file, self._events = folder, rig_file, events
        self._decoder = decoder
        self._lock = threading.Lock()
        self._process: subprocess.Popen[str] | None = None
        self._view = CalibrationView(state="none")

    @property
    def rig(self) -> Path:
        """The calibrated rig file, where there is one."""
        return self._folder / "rig.json"

    def view(self) -> CalibrationView:
        """How it is with the newest one; after a restart, the report of the last that was done."""
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
        """Calibrate by the captures that are named, whose folders `path` knows; one that runs is
        ended. Raises what `path` raises, `CalibrationError` for a board that there cannot be."""
        board_of(request.board)
        names = {k: [path(n) for n in getattr(request, k)] for k in ("boards", "diffuse", "mirror")}
        made = self._folder / "next.json"
        words: list[Any] = [*names["boards"], "--rig", self._rig_file.path, "--out", made]
        for kind in ("diffuse", "mirror"):
            words += [f"--{kind}", *names[kind]] if names[kind] else []
        told = request.model_dump(exclude={"boards", "diffuse", "mirror", "board", "keep_lens"})
        told |= request.board.model_dump()
        for name, value in told.items():
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
        """End the one that runs."""
        with self._lock:
            self._end()

    def _end(self) -> None:
        process, self._process = self._process, None
        if process is not None and process.poll() is None:
            process.kill()
            process.wait()

    def _run(self, command: list[str], made: Path, started: Future[subprocess.Popen[str]]) -> None:
        """Start the process, on the thread that it is tied to, and learn what comes of it."""
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
        except Exception as error:  # whoever asked has to know
            started.set_exception(error)
            return
        with suppress(OSError):
            os.setpriority(os.PRIO_PROCESS, process.pid, LOWER)
        started.set_result(process)
        answer, _ = process.communicate()
        with self._lock:
            if self._process is not process:  # it was ended, by the next one or by the service
                return
            update: dict[str, Any] = {"state": "done"}
            try:
                if process.returncode != 0:
                    update = {"state": "failed", "error": self._why(answer)}
                else:
                    for suffix in (".report.json", ".json"):
                        made.with_suffix(suffix).replace(self.rig.with_suffix(suffix))
            except OSError as error:  # of the disk: the rig that was there is what there is
                update = {"state": "failed", "error": str(error)}
            self._view = self._view.model_copy(update=update)
        self._events.publish("calibration.state", {"state": update["state"]})

    def _why(self, answer: str) -> str:
        with suppress(ValueError, LookupError, TypeError):
            return str(json.loads(answer.splitlines()[-1])["error"]["detail"])
        lines = (self._folder / "log").read_text(errors="replace").strip().splitlines()
        return lines[-1] if lines else "it ended without a word"

    def look(self, capture: Path, camera: str, size: BoardSize, calibrated: bool) -> BoardView:
        """What a camera's lit frame in `capture` shows of the board, by the capture's lens or the
        calibrated one, where there is one of this camera. Raises `MissingFrame`,
        `CalibrationError`, `CaptureError`, `DecoderBusy`."""
        board = board_of(size)
        rig = self.rig if calibrated and self.rig.is_file() else None
        what = board.columns, board.rows, board.square, board.marker, board.dictionary
        try:
            return BoardView.model_validate(self._decoder.board(capture, camera, what, rig))
        except Undecodable as error:
            raise ERRORS.get(error.kind, CaptureError)(str(error)) from error


def board_of(size: BoardSize) -> Board:
    """The board. Raises `CalibrationError` where there can be none."""
    square, marker = 1e-3 * size.square_mm, 1e-3 * size.marker_mm
    return Board(size.columns, size.rows, square, marker, size.dictionary)
