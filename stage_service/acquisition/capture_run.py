"""The capture that is being made: its sequencer, and what is known of it meanwhile."""

from __future__ import annotations

import threading
from collections import Counter
from typing import Any

from reconstruction import Capture, CaptureWriter
from stage_service.acquisition.exposing import FlashWatch
from stage_service.acquisition.sequencer import Sequencer
from stage_service.acquisition.states import CaptureStatus, read_status
from stage_service.config import RigFile
from stage_service.devices.device_set import DeviceSet
from stage_service.plan.capture_plan import CapturePlan
from stage_service.plan.resolved import PlanError, ResolvedPlan, resolve
from stage_service.records.events import EventLog


class CaptureRun:
    """One run over what a capture lacks; whoever makes it starts `sequencer` on `thread`.

    Before a living subject the flash rate is watched, unless the plan has consent and somebody
    has armed it (`consented`).
    """

    def __init__(
        self,
        capture_id: str,
        plan: ResolvedPlan,
        devices: DeviceSet,
        writer: CaptureWriter,
        events: EventLog,
        *,
        consented: bool,
    ) -> None:
        self.id = capture_id
        self.thread: threading.Thread | None = None
        self._events = events
        self._writer = writer
        self._first = read_status(writer.path)
        living = plan.rig_file.safety.living_subject
        free = not living or (plan.plan.consent is not None and consented)
        self.sequencer = Sequencer(
            devices, writer, plan, watch=None if free else FlashWatch(), notify=self._notify
        )

    def status(self) -> CaptureStatus:
        """Where it is now."""
        sequencer = self.sequencer
        written, missing = self._writer.counts()
        progress = sequencer.progress.now()
        return self._first.model_copy(
            update={
                "state": sequencer.state,
                "outcome": sequencer.outcome if sequencer.state == "done" else None,
                "error": sequencer.error,
                "step": progress.step,
                "progress": None if sequencer.state == "done" else progress,
                "frames_written": written,
                "frames_missing": missing,
                "seconds": sequencer.seconds,
            }
        )

    def frames(self) -> Counter[str]:
        """What this run made of frames: "written", "missing" and shot "again"."""
        written, missing = self._writer.counts()
        before = self._first.frames_written
        return Counter(
            written=written - before, missing=missing, again=self.sequencer.progress.again
        )

    def give_up(self) -> None:
        """Let go of the folder without having begun."""
        self._writer.close()

    def _notify(self, kind: str, data: dict[str, Any]) -> None:
        self._events.publish(kind, {"id": self.id, **data})


def plan_of(capture: Capture, rig_file: RigFile) -> ResolvedPlan:
    """The plan of a capture that is to go on. Raises `PlanError` where it no longer fits."""
    if "plan" not in capture.plan:
        raise PlanError([f"{capture.path}: this capture was not shot by a plan"])
    if capture.rig.to_dict() != rig_file.rig.to_dict():
        raise PlanError([f"{rig_file.path}: the rig has changed since this capture: begin anew"])
    plan = resolve(CapturePlan.model_validate(capture.plan["plan"]), rig_file)
    if plan.steps != capture.steps:
        changed = "[capture] has changed since this capture, and with it the plan's steps"
        raise PlanError([f"{rig_file.path}: {changed}: begin anew"])
    return plan
