"""The lease in callers' names, with an event for each change."""

from __future__ import annotations

from functools import partial

from stage_service.captures.control import Caller, Control
from stage_service.records.events import EventLog
from stage_service.records.lease import Lease
from stage_service.service_models import LeaseGrant, LeaseRequest, LeaseView, RenewRequest


class Leasing:
    """Takes, renews and ends the lease of `control`; each change is an event."""

    def __init__(self, control: Control, events: EventLog) -> None:
        self._control, self._events = control, events

    def view(self) -> LeaseView:
        """The present lease."""
        held = self._control.leases.current
        if held is None:
            return LeaseView(holder=None, expires=None)
        return LeaseView(holder=held.holder, expires=held.expires)

    def take(self, request: LeaseRequest, by: Caller) -> LeaseGrant:
        """Take the lease. Raises `Leased`, `NotRecorded`."""
        work = partial(self._control.leases.take, request.holder, request.seconds)
        detail = f"{request.holder}, {request.seconds:g} s"
        lease = self._control.do(by, "lease.take", work, detail=detail, steers=False)
        return self._granted(lease, lease.token)

    def renew(self, request: RenewRequest, by: Caller) -> LeaseGrant:
        """Extend the caller's lease. Raises `NoLease`, `NotRecorded`."""
        token = by.token or ""
        work = partial(self._control.leases.renew, token, request.seconds)
        detail = f"{request.seconds:g} s"
        lease = self._control.do(by, "lease.renew", work, detail=detail, steers=False)
        return self._granted(lease, token)

    def release(self, by: Caller) -> LeaseView:
        """End the caller's lease. Raises `Forbidden`, `NoLease`."""
        by.require("steer")
        work = partial(self._control.leases.release, by.token or "")
        self._control.do(by, "lease.release", work, steers=False)
        return self._publish()

    def end(self, by: Caller) -> LeaseView:
        """End any caller's lease. Raises `Forbidden`, `NoLease`."""
        by.require("admin")
        held = self._control.leases.current
        detail = "" if held is None else f"held by {held.holder}"
        work = self._control.leases.end
        self._control.do(by, "lease.end", work, detail=detail, steers=False)
        return self._publish()

    def _granted(self, lease: Lease, token: str) -> LeaseGrant:
        self._publish()
        return LeaseGrant(token=token, holder=lease.holder, expires=lease.expires)

    def _publish(self) -> LeaseView:
        view = self.view()
        self._events.publish("stage.lease", view.model_dump())
        return view
