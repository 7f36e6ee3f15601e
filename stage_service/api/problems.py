"""Errors as problem documents (RFC 9457), one table for all of them."""

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
"""Fields that an answer lists: a list of 60,000 wrong ones would take seconds to tell."""


@dataclass(frozen=True)
class Kind:
    """One kind of problem: its anchor in the errors page, its status, and what to do about it."""

    slug: str
    status: int
    title: str
    help: str


TABLE = """
unauthorized 401 Who asks is not known
    Every request but those for /docs and /openapi.json carries `Authorization: Bearer TOKEN`, or
    the cookie that `POST /login` sets. `hairstage token` makes tokens; docs/how-to/safety.md says
    who may do what.
forbidden 403 This token does not allow that
    `scope` is what it lacks. Abort and blackout are open to every token.
foreign-origin 403 A web page of another site asked
    A browser sent this for a page that is not this service's own.
too-many-logins 429 Wait before you log in again
    Too many wrong tokens came from this address. `Retry-After` has the seconds. No other address
    waits for that, no token that is sent with each request, and no blackout.
no-place 429 The caller has as many as they may have
    Connections, event streams, uploads, downloads, renders and requests at work are counted by
    token, and some are kept for tokens with the scope `steer`. `detail` says which limit it is,
    how many the token has, and what to do; the header `Retry-After` says when to try again. With
    the status 503 others have what there is, or a capture is being shot. Abort and blackout are
    answered all the same.
too-large 413 The request is too large
    `detail` says what is allowed.
invalid-request 422 The request does not fit the schema
    `errors` lists each field that is wrong and why. The schema is in /openapi.json.
invalid-plan 422 This rig cannot shoot this plan
    `problems` has one sentence for each reason. No lamp was touched. Correct the plan and try
    it with `POST /plans:validate`.
bad-input 422 A file or name in the request cannot be used
    `detail` names it and says what was expected, or which limit it goes beyond. Paths are those of
    the service's machine.
busy 409 Another capture is running
    The stage makes one capture at a time. Wait for `running`, or abort it.
not-now 409 Light may not be put on now
    `detail` says why: the service ends, the stage is put dark or was since the request came,
    nobody knows yet whether it is dark, or the request is too old. Ask again when that is over.
hold-changed 409 The queue is held for another reason
    `held` says why, and something has happened since you read it. Send `hold` once you have read
    it: `POST /queue:go-on`.
not-recorded 507 The disk did not take what has to last
    Who steers, and who answers for flashes, is on the disk before it counts. `detail` names the
    file and the disk's error; nothing has changed.
stage-in-use 409 Another service has this stage
    `detail` says which. Stop it; where its machine is dead, start this one with `--take-over`.
no-stage 409 The rig file names no devices
    Nothing can be shot or darkened from here. Start the service with a rig file that has
    `[devices]`, or with `--devices`.
flash-rate 422 A living subject would see flashes of 3 to 30 Hz
    `problems` has the ways out: a slower plan, or recorded consent that somebody at the stage
    arms. docs/how-to/safety.md says why. No lamp was touched.
unsafe 409 Nobody knows whether the lamps are off
    The last blackout could not be verified. Look at the stage, put `detail` right, then `POST
    /devices/blackout`; where the link cannot read back, `POST /devices/acknowledge`.
cannot-acknowledge 409 This is not for a person to say
    Nothing is latched, or the light bank can tell by itself: `POST /devices/blackout`.
unknown-entry 404 Nothing of that name waits
    `GET /queue` lists what waits, `GET /queue/history` what was started from it.
queue-full 409 The queue has no room
    Remove what waits, or name lights by a rule and not one by one.
in-use 409 A job still needs it
    `detail` names the job, or the file that one has just put away. Wait until it is done, or
    cancel it.
not-removed 409 Some of the trash could not be deleted
    All else was. `problems` names each entry that is left and the disk's error; put that right and
    empty the trash again.
leads-outside 409 A link leads out of the store
    `detail` names the link and where it leads: nothing is read through it. Put the folder or file
    itself there, or remove the link with DELETE, which leaves alone what it leads to.
not-there 404 No such thing in the store
    `GET /models`, `/uploads` and `/trash` list what there is.
disk-full 507 The disk has no room
    `detail` says how much is needed. `DELETE /trash` makes room.
not-stored 507 The disk did not take it
    It counts until the service ends. `detail` says what it means and what to do.
leased 409 Somebody else steers the stage
    `holder` has the lease until `expires`. Wait, or ask them. Abort and blackout are open to
    everybody.
no-lease 409 The token is no lease's
    The lease has expired or was released. `GET /lease` says who holds one now.
journal-in-use 409 The capture is being written or compressed
    Wait until that is done; `GET /jobs` shows a compression.
wrong-state 409 The capture's state does not allow this
    `detail` lists what is possible now; `state` is where the capture is. Steps that the
    trigger box clocks cannot pause.
not-finished 409 The capture is not finished
    Wait until its state is `done`; only a capture that completed can be processed, so resume
    one that did not.
model-in-use 409 Another job makes this model
    Wait until it is done, cancel it, or name another model.
key-used 409 This Idempotency-Key stands for another request
    `detail` names the job. A key is its caller's own, and of one request: send another key.
unknown-capture 404 No such capture
    `GET /captures` lists the captures.
unknown-frame 404 No such step or camera
    `detail` says which steps and cameras this capture has.
missing-frame 404 The frame is missing
    It was planned and did not come, or has not been shot yet; `detail` says which.
unknown-job 404 No such job
    `GET /jobs` lists the jobs.
unknown-artifact 404 No such file in the model folder
    `GET /jobs/{id}/artifacts` lists the files. Paths that lead out of the folder are not
    followed.
jobs-unavailable 503 The job database does not answer
    Captures, blackout and abort do not need it. `GET /health` says what is wrong; what
    completed captures were asked to be followed by is enqueued once it answers.
decoder-busy 503 Other files are being decoded
    Pictures, meshes and maps are decoded in a process of its own, a few at a time. Ask again in
    some seconds.
not-ready 503 No capture could begin
    `problems` has a sentence for each reason. A capture that runs is none.
damaged-capture 409 The capture folder cannot be read
    `detail` names the file. `hairstage verify CAPTURE` lists everything that is wrong.
http 400 The request cannot be served
    The status says why: no such route, method not allowed, a host name that is not this
    service's, or a request that took too long to come.
internal 500 A fault in the service
    The service's log has the traceback. Lamps go off by themselves if the service dies.
"""
"""Each kind's anchor, status and title, and below them what to do about it."""


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
"""Which error class becomes which kind; a subclass stands before its base."""

WHO_MAY = {"unauthorized", "forbidden", "too-many-logins"}
"""Kinds that are about who asks: the gate has them audited."""
EXTRA = ("problems", "running", "state", "holder", "expires", "scope", "held", "hold")
"""Attributes of an error that its problem document repeats."""


class Problem(BaseModel):
    """An error as RFC 9457 has it; `type` leads to its paragraph of the errors page."""

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
    # In ASCII, so that no text that an error quotes can keep it from being told.
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
    """Answers a fault of the service with a problem document, and keeps the connection.

    The framework's own handler answers and then raises again, upon which the server closes the
    connection under the client's next request.
    """

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass the request on; raises only where half an answer has gone out already."""
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
    """Make every error of `app` that is known a problem document; `Faults` does for the others."""

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
