"""Routes about who steers, what is dark, and who did what."""

from __future__ import annotations

from typing import Annotated, Any

from fastapi import APIRouter, Depends, Header, Query, Request, status
from pydantic import BaseModel, ConfigDict, Field

from stage_service.acquisition.control import Caller
from stage_service.records.audit import Action
from stage_service.records.lease import Lease
from stage_service.service import Stage

router = APIRouter()


class _Request(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


LeaseSeconds = Annotated[float, Field(ge=1.0, le=86400.0)]


class LeaseRequest(_Request):
    """Who wants to steer alone, and for how long."""

    holder: Annotated[str, Field(min_length=1, max_length=100)]
    seconds: LeaseSeconds = 60.0


class RenewRequest(_Request):
    """How long the lease is to last from now."""

    seconds: LeaseSeconds = 60.0


class LeaseView(BaseModel):
    """Who holds the lease, and until when (UTC); None: nobody, so anybody may steer."""

    holder: str | None
    expires: str | None


class LeaseGrant(LeaseView):
    """A lease and the token that steers under it, to be sent as the header `Hairstage-Lease`."""

    token: str


class AcknowledgeRequest(_Request):
    """Who looked at the stage, and what they saw."""

    name: Annotated[str, Field(min_length=2, max_length=100)]
    note: Annotated[str, Field(min_length=4, max_length=2000)]


class ResumeRequest(_Request):
    """`armed_by`: who answers at the stage for flashes that the plan has consent for."""

    armed_by: Annotated[str, Field(min_length=1, max_length=100)] | None = None


def on_stage(request: Request) -> Stage:
    """The stage of this application."""
    stage: Stage = request.app.state.stage
    return stage


def caller(
    request: Request,
    token: Annotated[
        str | None, Header(alias="Hairstage-Lease", description="token of the lease")
    ] = None,
) -> Caller:
    """Who asks."""
    peer = request.client
    return Caller("unknown" if peer is None else f"{peer.host}:{peer.port}", token)


OnStage = Annotated[Stage, Depends(on_stage)]
By = Annotated[Caller, Depends(caller)]


@router.post("/lease", status_code=status.HTTP_201_CREATED, tags=["steering"])
def take_lease(body: LeaseRequest, stage: OnStage, by: By) -> LeaseGrant:
    """Steer alone for some time. Others are answered 409, but may abort and black out."""
    return _grant(stage.control.take_lease(by, body.holder, body.seconds))


@router.get("/lease", tags=["steering"])
def get_lease(stage: OnStage) -> LeaseView:
    """Who steers, if anybody in particular."""
    held = stage.control.leases.current
    if held is None:
        return LeaseView(holder=None, expires=None)
    return LeaseView(holder=held.holder, expires=held.expires)


@router.patch("/lease", tags=["steering"])
def renew_lease(body: RenewRequest, stage: OnStage, by: By) -> LeaseGrant:
    """Let the lease of the token end so many seconds from now."""
    return _grant(stage.control.renew_lease(by, body.seconds))


@router.delete("/lease", tags=["steering"])
def release_lease(stage: OnStage, by: By) -> LeaseView:
    """End the lease of the token."""
    stage.control.release_lease(by)
    return get_lease(stage)


@router.get("/audit", tags=["steering"])
def get_audit(stage: OnStage, limit: Annotated[int, Query(ge=1, le=10_000)] = 100) -> list[Action]:
    """The newest actions on the stage, refused ones too; the oldest of them first."""
    return stage.control.audit.latest(limit)


@router.get("/devices", tags=["devices"])
def get_devices(stage: OnStage) -> dict[str, Any]:
    """Each device and whether it answers; under `safety`, whether the lamps are known to be off."""
    return stage.captures.devices()


@router.post("/devices/blackout", tags=["devices"])
def blackout(stage: OnStage, by: By) -> dict[str, Any]:
    """All lamps and projectors off, verified. Aborts a running capture."""
    return stage.control.blackout(by)


@router.post("/devices/acknowledge", tags=["devices"])
def acknowledge(body: AcknowledgeRequest, stage: OnStage, by: By) -> dict[str, Any]:
    """Somebody has looked: the lamps are off. Only where the link cannot tell by itself."""
    return stage.control.acknowledge(by, body.name, body.note)


def _grant(lease: Lease) -> LeaseGrant:
    return LeaseGrant(token=lease.token, holder=lease.holder, expires=lease.expires)
