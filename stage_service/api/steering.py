"""Routes of the lease, the devices and the audit log; identity of callers."""

from __future__ import annotations

from typing import Annotated, Any

from fastapi import APIRouter, Depends, Header, Query, Request, Security, status
from fastapi.security import HTTPBearer, SecurityScopes

from stage_service.api.lanes import OnLanes
from stage_service.captures.control import Caller
from stage_service.records.audit import Action
from stage_service.records.tokens import SCOPES
from stage_service.service import Service
from stage_service.service_models import (
    AcknowledgeRequest,
    LeaseGrant,
    LeaseRequest,
    LeaseView,
    RenewRequest,
)


async def on_service(request: Request) -> Service:
    """The service of this application."""
    service: Service = request.app.state.service
    return service


async def caller(
    request: Request,
    needed: SecurityScopes,
    _: Annotated[object, Depends(HTTPBearer(auto_error=False, scheme_name="token"))],
    lease: Annotated[
        str | None, Header(alias="Hairstage-Lease", description="token of the lease")
    ] = None,
) -> Caller:
    """The caller; raises `Forbidden` if their token lacks a scope of the route."""
    identity = request.state.identity
    service: Service | None = getattr(request.app.state, "service", None)  # 'view' has none
    moment = None if service is None else service.moment()
    by = Caller(address_of(request), lease, identity.name, identity.scopes, moment)
    for scope in SCOPES:
        if scope in needed.scopes:
            by.require(scope)
    return by


RIGHT = "Hairstage-Blackout"
"""The header with a page's blackout right."""


def address_of(request: Request) -> str:
    """Host and port of a request's client, for the audit log."""
    peer = request.client
    return f"{peer.host}:{peer.port}" if peer else "this machine"


OnService = Annotated[Service, Depends(on_service)]
Anybody = Annotated[Caller, Security(caller)]
"""A caller with any token."""
Steers = Annotated[Caller, Security(caller, scopes=["steer"])]
Arms = Annotated[Caller, Security(caller, scopes=["arm"])]
Processes = Annotated[Caller, Security(caller, scopes=["jobs"])]
Administrates = Annotated[Caller, Security(caller, scopes=["admin"])]
READS = [Security(caller, scopes=["read"])]

router = APIRouter()
reading = APIRouter(dependencies=READS)


@router.post("/lease", status_code=status.HTTP_201_CREATED, tags=["steering"])
def take_lease(body: LeaseRequest, service: OnService, by: Steers) -> LeaseGrant:
    """Take the lease. Other callers get 409, but may abort and black out."""
    return service.leasing.take(body, by)


@reading.get("/lease", tags=["steering"])
def get_lease(service: OnService) -> LeaseView:
    """Holder of the lease, if any."""
    return service.leasing.view()


@router.patch("/lease", tags=["steering"])
def renew_lease(body: RenewRequest, service: OnService, by: Steers) -> LeaseGrant:
    """Extend the token's lease to so many seconds from now."""
    return service.leasing.renew(body, by)


@router.delete("/lease", tags=["steering"])
def release_lease(
    service: OnService,
    by: Anybody,
    force: Annotated[bool, Query(description="another's lease too; needs the scope admin")] = False,
) -> LeaseView:
    """Release the token's lease."""
    return service.leasing.end(by) if force else service.leasing.release(by)


@reading.get("/audit", tags=["steering"])
def get_audit(
    service: OnService, limit: Annotated[int, Query(ge=1, le=10_000)] = 100
) -> list[Action]:
    """The newest actions on the stage, with refused ones, the oldest of them first."""
    return service.audit(limit)


@reading.get("/devices", tags=["devices"])
async def get_devices(service: OnService, lanes: OnLanes) -> dict[str, Any]:
    """State of each device at its last query, `age_s` seconds ago; `safety` has the lamps'
    state."""
    return await lanes.devices(service.devices)


@router.post("/devices/blackout", tags=["devices"])
async def blackout(
    service: OnService,
    lanes: OnLanes,
    by: Anybody,
    right: Annotated[
        str | None, Header(alias=RIGHT, description="`blackout` of a login, in place of a token")
    ] = None,
) -> dict[str, Any]:
    """All lamps and projectors off, verified. Aborts a running capture."""
    return await lanes.dark(service.blackout, by)


@router.post("/devices/acknowledge", tags=["devices"])
def acknowledge(body: AcknowledgeRequest, service: OnService, by: Arms) -> dict[str, Any]:
    """Record a person's observation that the lamps are dark, if the link cannot read them back."""
    return service.acknowledge(body, by)
