"""The service's requests and responses, as JSON."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal, Self

from pydantic import BaseModel, Field

from reconstruction import Camera, Projector
from reconstruction.arrays import AnyFloats
from reconstruction.capture.records import StepKind
from reconstruction.containment import LONGEST_NAME
from stage_service.acquisition.states import CaptureStatus
from stage_service.captures.capture_queue import Entry
from stage_service.captures.hold import Held
from stage_service.captures.latch import Latched
from stage_service.config import CaptureDefaults, Exposure, Level, RigFile, Text
from stage_service.device_config import DevicesConfig, DmxLightsConfig, Strict
from stage_service.jobs.records import PipelineRequest, with_example
from stage_service.plan.capture_plan import CapturePlan
from stage_service.plan.person_text import LINES, ONE_LINE
from stage_service.records.lease import LONGEST_LEASE_S

FILE_NAME = r"^[A-Za-z0-9][A-Za-z0-9_.-]{0,99}$"
FileName = Annotated[str, Field(pattern=FILE_NAME)]
PersonName = Annotated[str, Text, Field(min_length=1, max_length=100), ONE_LINE]
Place = Annotated[int, Field(ge=0, le=10**6)]
LeaseSeconds = Annotated[float, Field(ge=1.0, le=LONGEST_LEASE_S)]


class _Wanted(Strict):
    plan: CapturePlan = CapturePlan()
    head: Path | None = None
    masks: Path | None = None
    upload: FileName | None = None
    pipeline: PipelineRequest | None = None


class CaptureRequest(_Wanted):
    """A capture to start, and the pipeline that follows its completion.

    `head` is an OBJ file and `masks` a folder of `<camera>.png`, both on the service's machine;
    `upload` names a subject whose head and masks were uploaded instead. `armed_by` names the person
    at the stage who arms the flashes that the plan has consent for.
    """

    model_config = with_example(
        plan={"projectors": [], "exposure": {"olat": 0.01}},
        head="/data/subject/head.obj",
        pipeline={"name": "light_planes", "options": {"held_out_cameras": ["cam_03"]}},
    )

    armed_by: PersonName | None = None


class QueueRequest(_Wanted):
    """A capture to queue, at the end or at `place` from 0.

    A plan that flashes needs its consent here, and arming when it is started.
    """

    model_config = with_example(
        plan={"projectors": [], "exposure": {"olat": 0.01}}, head="/data/subject/head.obj", place=0
    )

    place: Place | None = None


class SnapshotRequest(Strict):
    """A single exposure in one light, or in all; seconds and level default to the rig file's."""

    light: Annotated[str, Field(max_length=LONGEST_NAME)] | None = None
    exposure: Exposure | None = None
    level: Level | None = None


class BoardSize(Strict):
    """A ChArUco board: squares across and down, the edges of squares and markers, and OpenCV's name
    of the markers."""

    columns: Annotated[int, Field(ge=3, le=64)] = 9
    rows: Annotated[int, Field(ge=3, le=64)] = 7
    square_mm: Annotated[float, Field(gt=0, le=1000)] = 27.0
    marker_mm: Annotated[float, Field(gt=0, le=1000)] = 21.0
    dictionary: Annotated[str, Field(pattern=r"^DICT_[A-Z0-9_]{1,40}$")] = "DICT_4X4_50"


class BoardQuery(BoardSize):
    """The board, and whether to use the calibrated lenses instead of the capture's."""

    calibrated: bool = False


CaptureNames = Annotated[
    list[Annotated[str, Field(min_length=1, max_length=LONGEST_NAME)]], Field(max_length=200)
]
Albedo = Annotated[float, Field(gt=0, le=1)]
RadiusMm = Annotated[float, Field(gt=0, le=1000)]


class CalibrationRequest(Strict):
    """Captures to calibrate the rig from: one per pose of the board, one per position of a sphere;
    options as of `hairstage calibrate rig`."""

    model_config = with_example(boards=["20261121-093000-1f2e", "20261121-093110-a0c4"])

    boards: Annotated[CaptureNames, Field(min_length=1)]
    diffuse: CaptureNames = Field(default_factory=list)
    mirror: CaptureNames = Field(default_factory=list)
    board: BoardSize = BoardSize()
    paper_albedo: Albedo | None = None
    diffuse_albedo: Albedo = 0.8
    diffuse_radius_mm: RadiusMm = 50.0
    mirror_radius_mm: RadiusMm = 50.0
    keep_lens: bool = False


class GoOnRequest(Strict):
    """`hold`: the id of the queue's hold that the caller has read; each reason makes a new id."""

    model_config = with_example(hold="3f9ac2d1")

    hold: Annotated[str, Field(min_length=1, max_length=100)]


class MoveRequest(Strict):
    """A place in the queue, from 0."""

    place: Place


class ResumeRequest(Strict):
    """`armed_by`: the person at the stage who arms the flashes that the plan has consent for."""

    armed_by: PersonName | None = None


class JobRequest(Strict):
    """A pipeline to run on a capture; `model` names the model folder (default: a new one)."""

    model_config = with_example(capture="20261121-093000", pipeline={"name": "light_planes"})

    capture: Annotated[str, Field(max_length=LONGEST_NAME)]
    pipeline: PipelineRequest
    model: FileName | None = None


class LeaseRequest(Strict):
    """The holder of a lease, and its duration."""

    holder: PersonName
    seconds: LeaseSeconds = 60.0


class RenewRequest(Strict):
    """The lease's duration from now."""

    seconds: LeaseSeconds = 60.0


class AcknowledgeRequest(Strict):
    """The person who inspected the stage, and what they saw."""

    name: Annotated[str, Text, Field(min_length=2, max_length=100), ONE_LINE]
    note: Annotated[str, Text, Field(min_length=4, max_length=2000), LINES]


class CaptureView(CaptureStatus):
    """A capture's status and its job."""

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
    """The queued captures, the next one first.

    `held`: why the queue starts nothing until a person who has read it releases it, by `POST
    /queue:go-on` with the id of `hold`, which has the reasons one by one, the newest first.
    `waits_for`: what the first entry waits for.
    """

    held: str | None
    hold: Held | None
    waits_for: str | None
    waiting: list[Entry]


class LeaseView(BaseModel):
    """The lease's holder and its end (UTC); None: no lease, every caller may steer."""

    holder: str | None
    expires: str | None


class LeaseGrant(LeaseView):
    """A lease and its token, to be sent as the header `Hairstage-Lease`."""

    token: str


class Artifact(BaseModel):
    """A file of a model folder; `path` is relative to it."""

    path: str
    bytes: int


class LatchView(BaseModel):
    """Light is refused since `since`, because of `detail`. A "blackout" ends it if the link reads
    back that the lamps are off, otherwise a person's "acknowledge"."""

    since: str
    detail: str
    ended_by: Literal["blackout", "acknowledge"]

    @classmethod
    def of(cls, latched: Latched | None) -> Self | None:
        """The view of a latch; None without one."""
        if latched is None:
            return None
        way_out: Literal["blackout", "acknowledge"]
        way_out = "blackout" if latched.reads_back else "acknowledge"
        return cls(since=latched.since, detail=latched.detail, ended_by=way_out)


class Health(BaseModel):
    """The service's health, without a query of devices or the job database.

    `status`: "unsafe" while `latch` is set: a blackout has failed, and light is refused; "degraded"
    for other problems; `problems` has a sentence for each. `lamps` is "dark", "said to be dark" (by
    a person who looked), "in use" or "unknown, unsafe", with `lamps_detail`. With "ok" they are
    unknown before the first blackout, during one, and after each of a bank without read-back that
    the rig file accepts (`lamps_accepted`). `worker`: one is alive; `unread`: captures on the disk
    that are not listed yet; `disk_free_bytes` is the root folder's, None while the disk hangs.
    """

    status: Literal["ok", "degraded", "unsafe"]
    version: str
    rig: str
    root: str
    worker: bool
    capture: str | None
    unread: int
    lamps: str
    lamps_detail: str
    lamps_accepted: bool
    latch: LatchView | None
    disk_free_bytes: int | None
    problems: list[str]


class StepView(BaseModel):
    """A commanded exposure; `light` for "olat", `pattern` for "pattern", `projector` and `row` for
    "scanline". `lacks`: the cameras without a frame of it."""

    index: int
    kind: StepKind
    exposure: float
    level: float
    light: str | None = None
    pattern: str | None = None
    projector: str | None = None
    row: int | None = None
    lacks: list[str] = []


Vector = tuple[float, float, float]


class Standing(BaseModel):
    """A device's position: metres, z up, the head's centre at the origin, its face to −y."""

    name: str
    position: Vector


class Looking(Standing):
    """A camera or a projector: the unit vector of its optical axis, and its size in pixels."""

    towards: Vector
    width: int
    height: int


class RigView(BaseModel):
    """The poses of lights, cameras and projectors, and the defaults of plans. `living_subject`:
    flashes of 3 to 30 Hz need consent. `watchdog_s`: seconds after the service's last heartbeat
    until the light bank puts its lamps off by itself; None: it has no watchdog."""

    name: str
    lights: list[Standing]
    cameras: list[Looking]
    projectors: list[Looking]
    defaults: CaptureDefaults
    hardware_stepping: bool
    living_subject: bool
    watchdog_s: float | None

    @classmethod
    def of(cls, rig_file: RigFile) -> Self:
        """The view of a rig file."""
        rig, devices = rig_file.rig, rig_file.devices
        return cls(
            name=rig.name,
            lights=[Standing(name=x.name, position=_vector(x.position)) for x in rig.lights],
            cameras=[_looking(c) for c in rig.cameras],
            projectors=[_looking(p) for p in rig.projectors],
            defaults=rig_file.capture,
            hardware_stepping=devices is not None and devices.hardware_stepping,
            living_subject=rig_file.safety.living_subject,
            watchdog_s=None if devices is None else _watchdog_s(devices),
        )


def _watchdog_s(devices: DevicesConfig) -> float | None:
    lights = devices.lights
    if isinstance(lights, DmxLightsConfig):
        return None
    registers = lights.registers
    return None if None in (registers.heartbeat, registers.watchdog) else devices.watchdog_s


def _vector(array: AnyFloats) -> Vector:
    x, y, z = (float(value) for value in array)
    return x, y, z


def _looking(device: Camera | Projector) -> Looking:
    return Looking(
        name=device.name,
        position=_vector(device.center),
        towards=_vector(device.R[2]),
        width=device.width,
        height=device.height,
    )
