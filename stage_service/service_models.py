"""What goes into the service and comes out of it, as JSON."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from pydantic import BaseModel, Field

from reconstruction.containment import LONGEST_NAME
from stage_service.acquisition.capture_queue import Entry
from stage_service.acquisition.states import CaptureStatus
from stage_service.config import Strict
from stage_service.jobs.records import PipelineRequest, with_example
from stage_service.plan.capture_plan import CapturePlan

FILE_NAME = r"^[A-Za-z0-9][A-Za-z0-9_.-]{0,99}$"
FileName = Annotated[str, Field(pattern=FILE_NAME)]
PersonName = Annotated[str, Field(min_length=1, max_length=100)]
Place = Annotated[int, Field(ge=0, le=10**6)]
LeaseSeconds = Annotated[float, Field(ge=1.0, le=86400.0)]


class _Wanted(Strict):
    plan: CapturePlan = CapturePlan()
    head: Path | None = None
    masks: Path | None = None
    upload: FileName | None = None
    pipeline: PipelineRequest | None = None


class CaptureRequest(_Wanted):
    """A capture to make, and the job that follows it by itself when it completes.

    `head` is an OBJ file and `masks` a folder of `<camera>.png`, both on the service's machine;
    `upload` names a subject whose head and masks were uploaded instead. `armed_by` says who at the
    stage answers for flashes that the plan has consent for.
    """

    model_config = with_example(
        plan={"projectors": [], "exposure": {"olat": 0.01}},
        head="/data/subject/head.obj",
        pipeline={"name": "light_planes", "options": {"held_out_cameras": ["cam_03"]}},
    )

    armed_by: PersonName | None = None


class QueueRequest(_Wanted):
    """A capture that is to wait for the stage, at the end of the queue or at `place` from 0.

    A plan that flashes needs its consent here; who answers for it is said when it is started.
    """

    model_config = with_example(
        plan={"projectors": [], "exposure": {"olat": 0.01}}, head="/data/subject/head.obj", place=0
    )

    place: Place | None = None


class MoveRequest(Strict):
    """Where in the queue, from 0."""

    place: Place


class ResumeRequest(Strict):
    """`armed_by`: who answers at the stage for flashes that the plan has consent for."""

    armed_by: PersonName | None = None


class JobRequest(Strict):
    """A pipeline to run on a capture; `model` names the model folder (default: a new one)."""

    model_config = with_example(capture="20261121-093000", pipeline={"name": "light_planes"})

    capture: Annotated[str, Field(max_length=LONGEST_NAME)]
    pipeline: PipelineRequest
    model: FileName | None = None


class LeaseRequest(Strict):
    """Who wants to steer alone, and for how long."""

    holder: PersonName
    seconds: LeaseSeconds = 60.0


class RenewRequest(Strict):
    """How long the lease is to last from now."""

    seconds: LeaseSeconds = 60.0


class AcknowledgeRequest(Strict):
    """Who looked at the stage, and what they saw."""

    name: Annotated[str, Field(min_length=2, max_length=100)]
    note: Annotated[str, Field(min_length=4, max_length=2000)]


class CaptureView(CaptureStatus):
    """A capture's status and the job that its completion enqueued."""

    model_config = with_example(
        id="20261121-093000-1f2e",
        state="done",
        outcome="completed",
        error=None,
        path="/data/stage/captures/20261121-093000-1f2e",
        steps=545,
        step=545,
        frames_planned=4360,
        frames_written=4360,
        frames_missing=0,
        seconds_predicted=29.6,
        seconds=31.2,
        left_out=[],
        started="2026-11-21T09:30:00.123+00:00",
        request={"pipeline": {"name": "light_planes"}},
        job="job-20261121-093000-1f2e",
    )

    job: str | None


class QueueView(BaseModel):
    """What waits for the stage, the next one first.

    `held`: why nothing begins by itself until somebody says that it may go on; `waits_for`: what
    the first one waits for now.
    """

    held: str | None
    waits_for: str | None
    waiting: list[Entry]


class LeaseView(BaseModel):
    """Who holds the lease, and until when (UTC); None: nobody, so anybody may steer."""

    holder: str | None
    expires: str | None


class LeaseGrant(LeaseView):
    """A lease and the token that steers under it, to be sent as the header `Hairstage-Lease`."""

    token: str


class Artifact(BaseModel):
    """A file of a model folder; `path` is relative to it."""

    path: str
    bytes: int


class Health(BaseModel):
    """How the service is, as far as it knows without asking a device or the job database.

    `status`: "unsafe" while nobody knows whether the lamps are off, "degraded" where something else
    is wrong; `problems` has a sentence for each. `worker`: whether one runs; `unread`: captures on
    the disk that are not listed yet; `lamps`: "dark", "in use" or "unknown, unsafe".
    """

    status: Literal["ok", "degraded", "unsafe"]
    version: str
    rig: str
    root: str
    worker: bool
    capture: str | None
    unread: int
    lamps: str
    problems: list[str]
