"""Routes about who steers, what is dark, and who did what."""

from __future__ import annotations

from typing import Annotated, Any

from fastapi import APIRouter, Depends, Header, Query, Request, status

from stage_service.acquisition.control import Caller
from stage_service.records.audit import Action
from stage_service.service import Service
from stage_service.service_models import (
    AcknowledgeRequest,
    LeaseGrant,
    LeaseRequest,
    LeaseView,
    RenewRequest,
)

router = APIRouter()


def on_service(request: Request) -> Service:
    """The service of this application."""
    service: Service = request.app.state.service
    return service


def caller(
    request: Request,
    token: Annotated[
        str | None, Header(alias="Hairstage-Lease", description="token of the lease")
    ] = None,
) -> Caller:
    """Who asks."""
    peer = request.client
    return Caller("unknown" if peer is None else f"{peer.host}:{peer.port}", token)


OnService = Annotated[Service, Depends(on_service)]
By = Annotated[Caller, Depends(caller)]


@router.post("/lease", status_code=status.HTTP_201_CREATED, tags=["steering"])
def take_lease(body: LeaseRequest, service: OnService, by: By) -> LeaseGrant:
    """Steer alone for some time. Others are answered 409, but may abort and black out."""
    return service.take_lease(body, by)


@router.get("/lease", tags=["steering"])
def get_lease(service: OnService) -> LeaseView:
    """Who steers, if anybody in particular."""
    return service.lease()


@router.patch("/lease", tags=["steering"])
def renew_lease(body: RenewRequest, service: OnService, by: By) -> LeaseGrant:
    """Let the lease of the token end so many seconds from now."""
    return service.renew_lease(body, by)


@router.delete("/lease", tags=["steering"])
def release_lease(service: OnService, by: By) -> LeaseView:
    """End the lease of the token."""
    return service.release_lease(by)


@router.get("/audit", tags=["steering"])
def get_audit(
    service: OnService, limit: Annotated[int, Query(ge=1, le=10_000)] = 100
) -> list[Action]:
    """The newest actions on the stage, refused ones too; the oldest of them first."""
    return service.audit(limit)


@router.get("/devices", tags=["devices"])
def get_devices(service: OnService) -> dict[str, Any]:
    """Each device and whether it answers; under `safety`, whether the lamps are known to be off."""
    return service.devices()


@router.post("/devices/blackout", tags=["devices"])
def blackout(service: OnService, by: By) -> dict[str, Any]:
    """All lamps and projectors off, verified. Aborts a running capture."""
    return service.blackout(by)


@router.post("/devices/acknowledge", tags=["devices"])
def acknowledge(body: AcknowledgeRequest, service: OnService, by: By) -> dict[str, Any]:
    """Somebody has looked: the lamps are off. Only where the link cannot tell by itself."""
    return service.acknowledge(body, by)
