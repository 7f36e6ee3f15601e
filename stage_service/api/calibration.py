"""Routes of calibration: detected boards, and the calibrated rig."""

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
    """Corners of the board in a camera's lit frame, with their reprojection errors."""
    return service.frames.board(capture, camera, board)


@router.post("/calibration", status_code=status.HTTP_202_ACCEPTED)
def calibrate(body: CalibrationRequest, service: OnService, by: Processes) -> CalibrationView:
    """Calibrate the rig by captures of a board and of spheres; the event "calibration.state"
    reports its end. A running calibration is cancelled."""
    return service.calibrate(body, by)


@reading.get("/calibration")
def get_calibration(service: OnService) -> CalibrationView:
    """State and results of the latest calibration."""
    return service.calibrating.view()


@reading.get("/calibration/rig.json", response_class=FileResponse, responses=RANGES)
def get_rig_file(service: OnService) -> Response:
    """The calibrated rig file, for `hairstage serve --rig`."""
    return file_response(service.calibrated(), "application/json")
