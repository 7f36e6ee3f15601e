"""The running capture and its status, and counts of all captures since the start."""

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
    """One run over the frames that a capture lacks. Its owner grants `permission` to light and
    starts `sequencer` on `thread`.

    Before a living subject the flash rate is measured, unless the plan has consent and was armed
    (`consented`).
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
        """The present status."""
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
        """This run's frames: "written", "missing" and shot "again"."""
        written, _ = self._writer.counts()
        records = list(self._writer.records.values())
        return Counter(
            written=written - self._first.frames_written,
            missing=sum(r.file is None and id(r) not in self._lacked for r in records),
            again=self.sequencer.progress.again,
        )

    def give_up(self) -> None:
        """Close the folder of a run that was not started."""
        self._writer.close()

    def _notify(self, kind: str, data: dict[str, Any]) -> None:
        self._events.publish(kind, {"id": self.id, **data})


class Tally:
    """Counts of captures, frames and devices' faults since the start. The owner locks it.

    `running` is the run that is not added yet.
    """

    def __init__(self) -> None:
        self._captures = Counter[str](dict.fromkeys(OUTCOMES.values(), 0))
        self._frames = Counter(written=0, missing=0, again=0)
        self._faults = Counter[str]()
        self._by_device: defaultdict[str, Counter[str]] = defaultdict(Counter)

    def add(self, run: CaptureRun, outcome: str | None) -> None:
        """Count an ended run; `outcome` None (a snapshot): only its faults."""
        if outcome is not None:
            self._captures[outcome] += 1
            self._frames.update(run.frames())
        self._faults.update(run.sequencer.faults)
        for device, counts in run.sequencer.by_device.items():
            self._by_device[device].update(counts)

    def counts(self, running: CaptureRun | None) -> dict[str, dict[str, int]]:
        """Captures by outcome, frames by result, faults by device."""
        frames = self._frames.copy()
        if running is not None:
            frames.update(running.frames())
        found = {"captures": self._captures, "frames": frames, "device_faults": self._faults}
        return {k: dict(v) for k, v in found.items()}

    def of_device(self, device: str, running: CaptureRun | None) -> dict[str, int]:
        """The counts of one device or camera."""
        counts = Counter(timeouts=0, faults=0)
        counts.update(self._by_device[device])
        if running is not None:
            counts.update(dict(running.sequencer.by_device.get(device, {})))
        return dict(counts)


def plan_of(capture: Capture, rig_file: RigFile) -> ResolvedPlan:
    """The plan of a capture that is to be continued. Raises `PlanError` where it no longer fits."""
    if "plan" not in capture.plan:
        raise PlanError([f"{capture.path}: this capture has no plan: it was not shot here"])
    if capture.rig.to_dict() != rig_file.rig.to_dict():
        changed = "the rig has changed since this capture: start a new one"
        raise PlanError([f"{rig_file.path}: {changed}"])
    try:
        plan = CapturePlan.model_validate(capture.plan["plan"])
    except ValidationError as error:
        problem = f"{capture.path}: its plan is not of this version: {sentence(error)}"
        raise PlanError([problem]) from error
    resolved = resolve(plan, rig_file)
    recorded = {k: v for k, v in capture.plan.items() if k == "patterns"}
    if resolved.steps != capture.steps or resolved.recorded_patterns != recorded:
        changed = "[capture] or [devices] has changed since this capture, and with it the steps"
        raise PlanError([f"{rig_file.path}: {changed}: start a new one"])
    return resolved
