"""Routes of calibration: what cameras see of the board, and the rig that comes of it."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Query, status
from fastapi.responses import FileResponse, Response

from stage_service.api.downloads import RANGES, file_response
from stage_service.api.steering import READS, OnService, Processes
from stage_service.calibrating import BoardView, CalibrationView
from stage_service.service_models import BoardQuery, CalibrationRequest

router = APIRouter(tags=["calibration"])
reading = APIRouter(dependencies=READS, tags=["calibration"])


@reading.get("/captures/{capture}/board/{camera}")
def get_board(
    capture: str, camera: str, service: OnService, board: Annotated[BoardQuery, Query()]
) -> BoardView:
    """What a camera's lit frame shows of the board, and how far each corner is from where the lens
    has it."""
    return service.frames.board(capture, camera, board)


@router.post("/calibration", status_code=status.HTTP_202_ACCEPTED)
def calibrate(body: CalibrationRequest, service: OnService, by: Processes) -> CalibrationView:
    """Calibrate the rig by captures of a board and of spheres; the event "calibration.state" says
    when it is done. One that runs is ended."""
    return service.calibrate(body, by)


@reading.get("/calibration")
def get_calibration(service: OnService) -> CalibrationView:
    """How the newest calibration goes, and what it found."""
    return service.calibrating.view()


@reading.get("/calibration/rig.json", response_class=FileResponse, responses=RANGES)
def get_rig_file(service: OnService) -> Response:
    """The calibrated rig file, to serve with."""
    return file_response(service.calibrated(), "application/json")
