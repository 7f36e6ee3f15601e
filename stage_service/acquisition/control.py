"""Steering the stage in somebody's name: who may, and the record of who did."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeVar

from stage_service.acquisition.capture_status import CaptureStatus
from stage_service.acquisition.captures import CaptureManager
from stage_service.plan.capture_plan import CapturePlan
from stage_service.records.lease import Lease, Leases

T = TypeVar("T")
STAGE = "stage"


@dataclass(frozen=True)
class Caller:
    """Who asks: an address, and the token of a lease where they have one."""

    address: str
    token: str | None = None


class Control:
    """What `CaptureManager` does, for callers that take turns by leases; each call is recorded.

    Every method raises what the manager's raises, and those that steer raise `Leased` while
    somebody else holds the lease. Abort and blackout are open to everybody.
    """

    def __init__(self, captures: CaptureManager) -> None:
        self.leases = Leases()
        self.audit = captures.audit
        self._captures = captures

    def start(
        self, caller: Caller, plan: CapturePlan, *, armed_by: str | None = None, **more: Any
    ) -> str:
        """`CaptureManager.start`."""

        def work() -> str:
            return self._captures.start(plan, armed_by=armed_by, **more)

        capture = self._do(caller, "capture.start", None, work)
        if armed_by is not None:
            self._record_arming(caller, capture, armed_by, plan.consent)
        return capture

    def pause(self, caller: Caller, capture: str) -> CaptureStatus:
        """`CaptureManager.pause`."""
        return self._do(caller, "capture.pause", capture, lambda: self._captures.pause(capture))

    def resume(self, caller: Caller, capture: str, *, armed_by: str | None = None) -> CaptureStatus:
        """`CaptureManager.resume`."""

        def work() -> CaptureStatus:
            return self._captures.resume(capture, armed_by=armed_by)

        status = self._do(caller, "capture.resume", capture, work)
        if armed_by is not None:
            self._record_arming(caller, capture, armed_by, None)
        return status

    def abort(self, caller: Caller, capture: str) -> CaptureStatus:
        """`CaptureManager.abort`; anybody may."""

        def work() -> CaptureStatus:
            return self._captures.abort(capture)

        return self._do(caller, "capture.abort", capture, work, steers=False)

    def blackout(self, caller: Caller) -> dict[str, Any]:
        """`CaptureManager.blackout`; anybody may."""
        who = self._who(caller)
        try:
            answer = self._captures.blackout()
        except Exception as error:
            self.audit.record(who, "blackout", STAGE, "failed", f"{type(error).__name__}: {error}")
            raise
        self.audit.record(who, "blackout", STAGE, answer["state"], answer["detail"])
        return answer

    def acknowledge(self, caller: Caller, name: str, note: str) -> dict[str, Any]:
        """Take a person's word that everything is dark; see `Latch.acknowledge`."""
        self._do(caller, "acknowledge", STAGE, self._captures.latch.acknowledge, f"{name}: {note}")
        return self._captures.darkness()

    def take_lease(self, caller: Caller, holder: str, seconds: float) -> Lease:
        """`Leases.take`."""

        def work() -> Lease:
            return self.leases.take(holder, seconds)

        detail = f"{holder}, {seconds:g} s"
        return self._do(caller, "lease.take", STAGE, work, detail, steers=False)

    def renew_lease(self, caller: Caller, seconds: float) -> Lease:
        """`Leases.renew`."""

        def work() -> Lease:
            return self.leases.renew(caller.token or "", seconds)

        return self._do(caller, "lease.renew", STAGE, work, f"{seconds:g} s", steers=False)

    def release_lease(self, caller: Caller) -> None:
        """`Leases.release`."""

        def work() -> Lease:
            return self.leases.release(caller.token or "")

        self._do(caller, "lease.release", STAGE, work, steers=False)

    def _do(
        self,
        caller: Caller,
        action: str,
        subject: str | None,
        work: Callable[[], T],
        detail: str = "",
        *,
        steers: bool = True,
    ) -> T:
        """`work()`, recorded whatever it comes to; without a subject, its result is that."""
        who = self._who(caller)
        try:
            if steers:
                self.leases.check(caller.token)
            result = work()
        except Exception as error:
            why = f"{type(error).__name__}: {error}"
            self.audit.record(who, action, subject or STAGE, "refused", why)
            raise
        self.audit.record(who, action, subject or str(result), detail=detail)
        return result

    def _record_arming(
        self, caller: Caller, capture: str, armed_by: str, consent: str | None
    ) -> None:
        detail = f"armed by {armed_by}; consent: {consent or 'as in the plan'}"
        self.audit.record(self._who(caller), "flash.armed", capture, detail=detail)

    def _who(self, caller: Caller) -> str:
        holder = self.leases.holder(caller.token)
        return f"{holder} ({caller.address})" if holder else caller.address
