"""The capture that is being made: what is known of it meanwhile, and what is counted of all."""

from __future__ import annotations

import threading
from collections import Counter, defaultdict
from typing import Any

from pydantic import ValidationError

from reconstruction import Capture, CaptureWriter
from reconstruction.options import sentence
from stage_service.acquisition.exposing import FlashWatch
from stage_service.acquisition.sequencer import Sequencer
from stage_service.acquisition.states import OUTCOMES, CaptureStatus, read_status
from stage_service.config import RigFile
from stage_service.devices.device_set import DeviceSet
from stage_service.devices.permission import Permission
from stage_service.plan.capture_plan import CapturePlan
from stage_service.plan.resolved import PlanError, ResolvedPlan, resolve
from stage_service.records.events import EventLog


class CaptureRun:
    """One run over what a capture lacks; whoever makes it grants its `permission` to light, and
    starts `sequencer` on `thread`.

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
        self.id, self.plan = capture_id, plan
        self.permission = Permission(f"capture {capture_id}")
        self.thread: threading.Thread | None = None
        self._events = events
        self._writer = writer
        self._first = read_status(writer.path)
        self._lacked = {id(r): r for r in writer.records.values() if r.file is None}
        living = plan.rig_file.safety.living_subject
        free = not living or (plan.plan.consent is not None and consented)
        self.sequencer = Sequencer(
            devices,
            writer,
            plan,
            permission=self.permission,
            watch=None if free else FlashWatch(),
            notify=self._notify,
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
                "error": sequencer.error or sequencer.trouble,
                "step": progress.step,
                "progress": None if sequencer.state == "done" else progress,
                "frames_written": written,
                "frames_missing": missing,
                "seconds": sequencer.seconds,
            }
        )

    def frames(self) -> Counter[str]:
        """What this run made of frames: "written", "missing" and shot "again"."""
        written, _ = self._writer.counts()
        records = list(self._writer.records.values())
        return Counter(
            written=written - self._first.frames_written,
            missing=sum(r.file is None and id(r) not in self._lacked for r in records),
            again=self.sequencer.progress.again,
        )

    def give_up(self) -> None:
        """Let go of the folder without having begun."""
        self._writer.close()

    def _notify(self, kind: str, data: dict[str, Any]) -> None:
        self._events.publish(kind, {"id": self.id, **data})


class Tally:
    """What became of captures, frames and devices since the start. Not locked: the owner is.

    `running`, where given, is the run that is not counted yet.
    """

    def __init__(self) -> None:
        self._captures = Counter[str](dict.fromkeys(OUTCOMES.values(), 0))
        self._frames = Counter(written=0, missing=0, again=0)
        self._faults = Counter[str]()
        self._by_device: defaultdict[str, Counter[str]] = defaultdict(Counter)

    def add(self, run: CaptureRun, outcome: str | None) -> None:
        """Count a run that is over; `outcome` None: one that is in no list, for its faults only."""
        if outcome is not None:
            self._captures[outcome] += 1
            self._frames.update(run.frames())
        self._faults.update(run.sequencer.faults)
        for device, counts in run.sequencer.by_device.items():
            self._by_device[device].update(counts)

    def counts(self, running: CaptureRun | None) -> dict[str, dict[str, int]]:
        """Captures by how they ended, frames by what became of them, faults by device."""
        frames = self._frames.copy()
        if running is not None:
            frames.update(running.frames())
        found = {"captures": self._captures, "frames": frames, "device_faults": self._faults}
        return {k: dict(v) for k, v in found.items()}

    def of_device(self, device: str, running: CaptureRun | None) -> dict[str, int]:
        """What one device, or camera, did to captures."""
        counts = Counter(timeouts=0, faults=0)
        counts.update(self._by_device[device])
        if running is not None:
            counts.update(dict(running.sequencer.by_device.get(device, {})))
        return dict(counts)


def plan_of(capture: Capture, rig_file: RigFile) -> ResolvedPlan:
    """The plan of a capture that is to go on. Raises `PlanError` where it no longer fits."""
    if "plan" not in capture.plan:
        raise PlanError([f"{capture.path}: this capture was not shot by a plan"])
    if capture.rig.to_dict() != rig_file.rig.to_dict():
        raise PlanError([f"{rig_file.path}: the rig has changed since this capture: begin anew"])
    try:
        asked = CapturePlan.model_validate(capture.plan["plan"])
    except ValidationError as error:
        told = f"{capture.path}: its plan is one of another version: {sentence(error)}"
        raise PlanError([told]) from error
    plan = resolve(asked, rig_file)
    if plan.steps != capture.steps:
        changed = "[capture] has changed since this capture, and with it the plan's steps"
        raise PlanError([f"{rig_file.path}: {changed}: begin anew"])
    return plan
