"""Errors as problem documents (RFC 9457), defined in one table."""

from __future__ import annotations

import json
import logging
import re
from collections.abc import Iterator
from dataclasses import dataclass
from http import HTTPStatus
from textwrap import fill
from typing import Any

from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import Response
from pydantic import BaseModel, ConfigDict
from starlette.exceptions import HTTPException
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from reconstruction import CaptureError, MissingFrame, ModelError
from reconstruction.capture.writer import JournalInUse
from reconstruction.containment import NotContained
from reconstruction.files.durable import DiskFull
from reconstruction.reading import printable
from stage_service.acquisition.states import WrongState
from stage_service.captures.capture_queue import QueueFull, UnknownEntry
from stage_service.captures.catalogue import UnknownCapture
from stage_service.captures.control import Forbidden
from stage_service.captures.hold import HoldChanged
from stage_service.captures.latch import CannotAcknowledge, Unsafe
from stage_service.captures.may_light import Busy, NotNow
from stage_service.decoding import DecoderBusy, Undecodable
from stage_service.devices.device_set import NoStage
from stage_service.devices.ownership import StageInUse
from stage_service.devices.permission import NotPermitted
from stage_service.frames import UnknownFrame
from stage_service.inputs import BadInput
from stage_service.jobs.queue import JobsUnavailable, NoSuchJob
from stage_service.links import LeadsOutside
from stage_service.plan.flash import FlashRefusal
from stage_service.plan.resolved import PlanError
from stage_service.records.attempts import TooManyLogins
from stage_service.records.audit import NotRecorded
from stage_service.records.lease import Leased, NoLease
from stage_service.records.tokens import UnknownToken
from stage_service.storage import BadUpload, InUse, NotRemoved, NotThere
from stage_service.submitting import KeyUsed, ModelInUse, NotFinished, UnknownArtifact
from stage_service.viewer import BadLight, NothingToView, TracerStopped
from stage_service.watching import NotReady

log = logging.getLogger("hairstage.api")
PAGE = "/docs/errors.md"
MOST_ERRORS = 20
"""Invalid fields that a response lists: 60,000 would take seconds to send."""


@dataclass(frozen=True)
class Kind:
    """A kind of problem: anchor in the errors page, status, title, and what to do."""

    slug: str
    status: int
    title: str
    help: str


TABLE = """
unauthorized 401 The caller is not authenticated
    Every request but those for /docs and /openapi.json carries `Authorization: Bearer TOKEN`, or
    the cookie that `POST /login` sets. `hairstage token` makes tokens; docs/how-to/safety.md
    lists their scopes.
forbidden 403 This token does not allow that
    `scope` is the missing scope. Abort and blackout need none.
foreign-origin 403 The request comes from a web page of another site
    The header `Origin` is not this service's.
too-many-logins 429 Wait before you log in again
    Too many wrong tokens came from this address. `Retry-After` has the seconds. Other addresses,
    requests with a token, and blackouts are not affected.
no-place 429 The caller has reached a limit
    Connections, event streams, uploads, downloads, renders and concurrent requests are counted by
    token, and some are reserved for tokens with the scope `steer`. `detail` names the limit, the
    token's count, and what to do; the header `Retry-After` has the seconds. With the status 503
    other callers have all places, or a capture is running. Abort and blackout are not affected.
too-large 413 The request is too large
    `detail` has the limit.
invalid-request 422 The request does not fit the schema
    `errors` lists each invalid field with the reason. The schema is in /openapi.json.
invalid-plan 422 This rig cannot shoot this plan
    `problems` lists the reasons. No lamp was lit. Correct the plan and check it with
    `POST /plans:validate`.
bad-input 422 A file or name in the request cannot be used
    `detail` names it, with what was expected or the limit that it exceeds. Paths are those of the
    service's machine.
busy 409 Another capture is running
    The stage runs one capture at a time. Wait for `running`, or abort it.
not-now 409 Light is not permitted now
    `detail` has the reason: the service is stopping, a blackout is running or came after the
    request, it is not yet known whether the stage is dark, or the request is too old. Repeat the
    request later.
hold-changed 409 The queue is held for another reason
    `held` has the present reason, which is newer than the one you confirmed. Read it, then send
    `hold` with `POST /queue:go-on`.
not-recorded 507 The audit log could not be written
    The lease and the person responsible for flashes are recorded on disk before they take effect.
    `detail` names the file and the disk's error; nothing has changed.
stage-in-use 409 Another service has this stage
    `detail` names it. Stop it; if its machine is dead, start this one with `--take-over`.
no-stage 409 The rig file names no devices
    This service cannot make captures or blackouts. Start it with a rig file that has `[devices]`,
    or with `--devices`.
flash-rate 422 A living subject would see flashes of 3 to 30 Hz
    `problems` lists the alternatives: a slower plan, or recorded consent that a person at the stage
    arms. The reason is in docs/how-to/safety.md. No lamp was lit.
unsafe 409 It is unknown whether the lamps are off
    The last blackout could not be verified. Inspect the stage, remove the cause in `detail`, then
    `POST /devices/blackout`; if the link cannot read back, `POST /devices/acknowledge`.
cannot-acknowledge 409 A person cannot acknowledge this
    Nothing is latched, or the light bank can read back: `POST /devices/blackout`.
unknown-entry 404 No such queued capture
    `GET /queue` lists queued captures, `GET /queue/history` started and removed ones.
queue-full 409 The queue is full
    Remove queued captures, or select lights by a rule instead of by name.
in-use 409 A job uses it
    `detail` names the job, or the file that a job has just removed. Wait until it is done, or
    cancel it.
not-removed 409 Some of the trash could not be deleted
    `problems` names each remaining entry and the disk's error; remove the cause and empty the trash
    again.
leads-outside 409 A link leads out of the store
    `detail` names the link and its target, which is not read. Put the folder or file itself there,
    or remove the link with DELETE, which keeps the target.
not-there 404 No such entry in the store
    `GET /models`, `/uploads` and `/trash` list the entries.
disk-full 507 The disk is full
    `detail` has the bytes needed. `DELETE /trash` frees space.
not-stored 507 The disk could not store it
    It is in effect until the service ends. `detail` has the consequence and what to do.
leased 409 Another caller holds the lease
    `holder` has the lease until `expires`. Wait, or contact them. Abort and blackout need no lease.
no-lease 409 The lease's token is not valid
    The lease has expired or was released. `GET /lease` has the present holder.
journal-in-use 409 The capture is being written or compressed
    Wait for its end; `GET /jobs` lists compressions.
wrong-state 409 The capture's state does not allow this
    `detail` lists the possible actions, `state` is the capture's state. Steps that the trigger box
    clocks cannot be paused.
not-finished 409 The capture is not finished
    Wait until its state is `done`. Only completed captures can be processed: resume an incomplete
    one.
model-in-use 409 Another job makes this model
    Wait for its end, cancel it, or name another model.
key-used 409 This Idempotency-Key belongs to another request
    `detail` names the job. A key is valid for one caller and one request: send another key.
unknown-capture 404 No such capture
    `GET /captures` lists the captures.
unknown-frame 404 No such step or camera
    `detail` lists the steps and cameras of this capture.
missing-frame 404 The frame is missing
    It was planned and did not arrive, or has not been shot yet; `detail` has the reason.
unknown-job 404 No such job
    `GET /jobs` lists the jobs.
unknown-artifact 404 No such file in the model folder
    `GET /jobs/{id}/artifacts` lists the files. Paths out of the folder are refused.
jobs-unavailable 503 The job database does not respond
    Captures, blackout and abort do not need it. `GET /health` has the reason; jobs of completed
    captures are enqueued when it responds again.
decoder-busy 503 Other files are being decoded
    Images, meshes and maps are decoded in a separate process, a few at a time. Repeat the request
    after some seconds.
not-ready 503 No capture could start
    `problems` lists the reasons. A running capture is none of them.
damaged-capture 409 The capture folder cannot be read
    `detail` names the file. `hairstage verify CAPTURE` lists all damaged files.
http 400 The request cannot be served
    The status has the reason: no such route, method not allowed, a host name that is not this
    service's, or a request that took too long to arrive.
internal 500 An internal error of the service
    The service's log has the traceback. If the service dies, the watchdog switches the lamps off.
"""
"""Anchor, status and title of each kind, then what to do."""


def _kinds() -> Iterator[Kind]:
    for entry in re.split(r"\n(?=\S)", TABLE.strip()):
        first, _, help = entry.partition("\n")
        slug, status, title = first.split(" ", 2)
        yield Kind(slug, int(status), title, " ".join(help.split()))


KINDS = {kind.slug: kind for kind in _kinds()}

BY_ERROR: dict[type[Exception], str] = {
    PlanError: "invalid-plan",
    BadInput: "bad-input",
    BadUpload: "bad-input",
    BadLight: "bad-input",
    Undecodable: "bad-input",
    DecoderBusy: "decoder-busy",
    InUse: "in-use",
    NotRemoved: "not-removed",
    LeadsOutside: "leads-outside",
    NotThere: "not-there",
    NothingToView: "not-there",
    ModelError: "not-there",
    DiskFull: "disk-full",
    UnknownEntry: "unknown-entry",
    QueueFull: "queue-full",
    NotContained: "bad-input",
    Busy: "busy",
    NotNow: "not-now",
    NotPermitted: "not-now",
    HoldChanged: "hold-changed",
    NotRecorded: "not-recorded",
    JournalInUse: "journal-in-use",
    FlashRefusal: "flash-rate",
    Unsafe: "unsafe",
    StageInUse: "stage-in-use",
    NoStage: "no-stage",
    CannotAcknowledge: "cannot-acknowledge",
    Leased: "leased",
    NoLease: "no-lease",
    Forbidden: "forbidden",
    UnknownToken: "unauthorized",
    TooManyLogins: "too-many-logins",
    WrongState: "wrong-state",
    NotFinished: "not-finished",
    KeyUsed: "key-used",
    ModelInUse: "model-in-use",
    JobsUnavailable: "jobs-unavailable",
    TracerStopped: "no-place",
    UnknownCapture: "unknown-capture",
    UnknownFrame: "unknown-frame",
    MissingFrame: "missing-frame",
    NoSuchJob: "unknown-job",
    UnknownArtifact: "unknown-artifact",
    NotReady: "not-ready",
    CaptureError: "damaged-capture",
}
"""Kind by error class, subclasses before their bases."""

WHO_MAY = {"unauthorized", "forbidden", "too-many-logins"}
"""Kinds about the caller, which the gate records in the audit log."""
EXTRA = ("problems", "running", "state", "holder", "expires", "scope", "held", "hold")
"""Attributes of errors that are copied to the problem document."""


class Problem(BaseModel):
    """An error (RFC 9457); `type` is the path of its paragraph in the errors page."""

    model_config = ConfigDict(
        extra="allow",
        json_schema_extra={
            "examples": [
                {
                    "type": f"{PAGE}#busy",
                    "title": KINDS["busy"].title,
                    "status": 409,
                    "detail": "capture 20261121-093000 is running; wait for it, or abort it first",
                    "instance": "/captures",
                    "running": "20261121-093000",
                }
            ]
        },
    )

    type: str
    title: str
    status: int
    detail: str
    instance: str


def problem_response(
    path: str, slug: str, detail: str, *, status: int | None = None, **extra: Any
) -> Response:
    """The problem document of the kind `slug` as a response."""
    kind = KINDS[slug]
    content = {
        "type": f"{PAGE}#{kind.slug}",
        "title": kind.title,
        "status": status or kind.status,
        "detail": printable(detail),
        "instance": path,
        **extra,
    }
    # ASCII, so that any text an error quotes can be sent
    text = json.dumps(content)
    return Response(text, content["status"], media_type="application/problem+json")


def errors_page() -> str:
    """The page of all kinds, at `PAGE` and in the documentation."""
    parts = ["# Errors of the HTTP API", ""]
    parts += [
        "Every error is a problem document (RFC 9457, `application/problem+json`) with `type`,",
        "`title`, `status`, `detail` and `instance`; `type` is the path of this page with one of",
        "the anchors below.",
    ]
    for kind in KINDS.values():
        status = f"{kind.status} {HTTPStatus(kind.status).phrase}"
        text = f"{kind.title} ({status}). {kind.help}"
        parts += ["", f"## {kind.slug}", "", fill(text, 120, break_on_hyphens=False)]
    return "\n".join(parts) + "\n"


class Faults:
    """Responds to internal errors with a problem document and keeps the connection.

    The framework's handler raises again after its response, and the server then closes the
    connection under the client's next request.
    """

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass the request on; raises only if a part of the response has been sent."""
        begun = False

        async def sending(message: Message) -> None:
            nonlocal begun
            begun = True
            await send(message)

        try:
            await self._app(scope, receive, sending)
        except Exception as error:
            if begun or scope["type"] != "http":
                raise
            log.error("%s %s failed", scope["method"], scope["path"], exc_info=error)
            text = f"{type(error).__name__}: {error}"
            await problem_response(scope["path"], "internal", text)(scope, receive, send)


def install_problems(app: FastAPI) -> None:
    """Respond to the errors of `BY_ERROR` with problem documents; `Faults` handles others."""

    async def known(request: Request, error: Exception) -> Response:
        slug = next(s for e, s in BY_ERROR.items() if isinstance(error, e))
        extra = {k: getattr(error, k) for k in EXTRA if hasattr(error, k)}
        status = error.status if isinstance(error, TracerStopped) else None
        response = problem_response(request.url.path, slug, str(error), status=status, **extra)
        if slug in WHO_MAY:
            request.state.refusal = slug, str(error)
        if isinstance(error, TooManyLogins | TracerStopped):
            response.headers["retry-after"] = str(error.retry_after)
        return response

    async def invalid(request: Request, error: Exception) -> Response:
        assert isinstance(error, RequestValidationError)
        found = error.errors()
        errors = [
            {"loc": ".".join(str(p) for p in e["loc"] if p != "body"), "msg": e["msg"]}
            for e in found[:MOST_ERRORS]
        ]
        detail = "; ".join(f"{e['loc']}: {e['msg']}" for e in errors)
        if len(found) > MOST_ERRORS:
            detail += f"; and {len(found) - MOST_ERRORS} more"
        return problem_response(request.url.path, "invalid-request", detail, errors=errors)

    async def http(request: Request, error: Exception) -> Response:
        assert isinstance(error, HTTPException)
        response = problem_response(
            request.url.path, "http", str(error.detail), status=error.status_code
        )
        response.headers.update(error.headers or {})
        return response

    for kind in BY_ERROR:
        app.add_exception_handler(kind, known)
    app.add_exception_handler(RequestValidationError, invalid)
    app.add_exception_handler(HTTPException, http)
