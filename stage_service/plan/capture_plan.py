"""The one model of a capture that REST, CLI, dry run, sequencer and writer share."""

from __future__ import annotations

from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from reconstruction.capture.folder import Step, StepKind
from reconstruction.geometry.projectors import Projector
from reconstruction.geometry.rig import Rig
from stage_service.config import (
    LONGEST_S,
    SHORTEST_S,
    CaptureDefaults,
    Exposure,
    Level,
    RigFile,
)
from stage_service.plan.flash import FlashRate, flash_rate
from stage_service.plan.limits import check_levels, check_limits
from stage_service.plan.stepping import LATENCY_S, Run, limited_by, runs, seconds_by_cause
from stage_service.plan.timeline import timeline

EXR_HEADER_BYTES = 700
"""What an EXR file holds beside 12 bytes a pixel, not counting its table of lines."""


Bracket = Annotated[float, Field(gt=0.0, le=1000.0)]


class _Model(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class KindExposures(_Model):
    """Seconds per kind of step; None takes the rig file's."""

    dark: Exposure | None = None
    all_on: Exposure | None = None
    olat: Exposure | None = None
    scanline: Exposure | None = None
    tracking: Exposure | None = None


class KindLevels(_Model):
    """Levels per kind of step, above 0 up to 1; None takes the rig file's."""

    all_on: Level | None = None
    olat: Level | None = None
    scanline: Level | None = None
    tracking: Level | None = None


class Rows(_Model):
    """Scanlines `first`, `first + step`, … up to and including `last` (None: the last row)."""

    first: int = Field(default=0, ge=0)
    last: int | None = Field(default=None, ge=0)
    step: int = Field(default=1, ge=1)


class LeftOutWork(_Model):
    """Work that this plan does not need on this rig."""

    what: str
    why: str
    saved: str


class PlanCost(_Model):
    """What a plan takes, retries apart.

    `frames` counts pictures (steps times cameras), `bytes` what the capture folder gets while
    shooting, `seconds` includes exposure, settling, readout, link and storage; `limited_by` names
    what takes most of it. `stepping` counts the steps that the service and the trigger box clock,
    and `stepping_why` says why. `lamp_seconds` sums level times on-time over lamps; `dose` is the
    radiant exposure at the head's centre, J/m² per channel, lamps and projectors together. `flash`
    says how fast it flashes, and whether a living subject must have consented to that.
    """

    steps: int
    frames: int
    frames_by_kind: dict[str, int]
    bytes: int
    seconds: float
    seconds_by_cause: dict[str, float]
    limited_by: str
    stepping: dict[str, int]
    stepping_why: str
    lamp_seconds: float
    dose: tuple[float, float, float]
    flash: FlashRate
    left_out: tuple[LeftOutWork, ...]


class PlanError(ValueError):
    """A plan that this rig cannot shoot; `problems` has one sentence for each reason."""

    def __init__(self, problems: list[str]) -> None:
        super().__init__("; ".join(problems))
        self.problems = problems


class CapturePlan(_Model):
    """What to shoot. The order is: dark, all on; each light alone; the sweep; dark, all on.

    `brackets` are factors on the exposure of a light alone: all lights at the first factor, then
    all at the next, so that cameras are armed once for each. `rate_hz` is the most steps a second.
    `stepping` says who clocks the steps; "auto" lets the trigger box do it where it can. `consent`
    says who agreed, when, and to what, where a living subject is to see flashes of 3 to 30 Hz.

    In the sweep a tracking frame stands before every full group of `tracking_every` scanlines of
    a projector, floor(rows / tracking_every) of them and at least one: 76 for 768 rows, 6 for 64.
    The rows that are left over follow the last full group. 0 means no tracking frames.
    """

    lights: Literal["all"] | tuple[str, ...] = "all"
    projectors: Literal["all"] | tuple[str, ...] = "all"
    rows: Rows = Rows()
    sentinels: bool = True
    brackets: Annotated[tuple[Bracket, ...], Field(min_length=1, max_length=8)] = (1.0,)
    stepping: Literal["auto", "software", "hardware"] = "auto"
    rate_hz: Annotated[float, Field(gt=0.0, le=1000.0)] | None = None
    consent: Annotated[str, Field(min_length=12, max_length=2000)] | None = None
    tracking_every: Annotated[int, Field(ge=0)] | None = None
    retries: Annotated[int, Field(ge=0, le=20)] | None = None
    exposure: KindExposures = KindExposures()
    level: KindLevels = KindLevels()

    def check(self, rig_file: RigFile) -> None:
        """Raise `PlanError` with everything that this rig cannot do; touches no device."""
        rig = rig_file.rig
        problems = _unknown("light", self.lights, [x.name for x in rig.lights])
        problems += _unknown("projector", self.projectors, [x.name for x in rig.projectors])
        for p in self._swept(rig_file):
            last = p.height - 1 if self.rows.last is None else self.rows.last
            if last >= p.height or self.rows.first > last:
                problems.append(
                    f"rows {self.rows.first} to {last}: projector {p.name} has rows 0 to "
                    f"{p.height - 1}"
                )
        if len(set(self.brackets)) < len(self.brackets):
            problems.append(f"brackets: {list(self.brackets)} has a factor twice")
        olat = self._exposure("olat", rig_file.capture)
        for factor in self.brackets:
            if not SHORTEST_S <= factor * olat <= LONGEST_S:
                problems.append(
                    f"brackets: {factor:g} times {olat:g} s is an exposure of {factor * olat:g} s; "
                    f"the trigger box makes {SHORTEST_S:g} to {LONGEST_S:g} s"
                )
        devices = rig_file.devices
        if self.stepping == "hardware" and (devices is None or not devices.hardware_stepping):
            problems.append(
                "stepping: the rig file does not say that the trigger box's gates are wired; set "
                "hardware_stepping in [devices], or let the service step"
            )
        if self.projectors != "all" and self.projectors and _no_controller(rig_file):
            problems.append("projectors: the rig file has no [devices.projectors]")
        if not problems and not self.steps(rig_file):
            problems.append("the plan has no steps: no lights, no projectors, no sentinels")
        if not problems:
            parts, _ = self.runs(rig_file, self.steps(rig_file))
            lights = timeline(parts, rig_file, rate_hz=self.rate_hz)
            problems += check_limits(lights, rig, rig_file.safety)
            problems += check_levels(parts, devices.lights) if devices is not None else []
        if problems:
            raise PlanError(problems)

    def retries_on(self, rig_file: RigFile) -> int:
        """How often a missing frame is shot again."""
        return rig_file.capture.retries if self.retries is None else self.retries

    def steps(self, rig_file: RigFile) -> tuple[Step, ...]:
        """The exposures in the order in which they are shot."""
        defaults = rig_file.capture
        todo: list[dict[str, Any]] = []
        ends = [{"kind": "dark"}, {"kind": "all_on"}] if self.sentinels else []
        todo += ends
        names = [x.name for x in rig_file.rig.lights] if self.lights == "all" else self.lights
        todo += [
            {"kind": "olat", "light": name, "bracket": factor}
            for factor in self.brackets
            for name in names
        ]
        every = defaults.tracking_every if self.tracking_every is None else self.tracking_every
        for projector in self._swept(rig_file):
            rows = self._rows(projector)
            groups = max(1, len(rows) // every) if every else 0
            for i, row in enumerate(rows):
                if every and i % every == 0 and i // every < groups:
                    todo.append({"kind": "tracking"})
                todo.append({"kind": "scanline", "projector": projector.name, "row": row})
        todo += ends
        return tuple(
            Step(
                index=i,
                exposure=self._exposure(t["kind"], defaults) * t.pop("bracket", 1.0),
                level=self._level(t["kind"], defaults),
                **t,
            )
            for i, t in enumerate(todo)
        )

    def runs(self, rig_file: RigFile, steps: tuple[Step, ...]) -> tuple[list[Run], str]:
        """The plan's steps, or those of them that are left, in runs; and why they are so."""
        return runs(steps, rig_file, self.stepping)

    def left_out(self, rig_file: RigFile) -> tuple[LeftOutWork, ...]:
        """What "all" does not contain on this rig, and why."""
        if self.projectors != "all":
            return ()
        if not rig_file.rig.projectors:
            why = "the rig has no projector"
            return (LeftOutWork(what="scanline sweep", why=why, saved="its frames and its time"),)
        if _no_controller(rig_file):
            rows = sum(len(self._rows(p)) for p in rig_file.rig.projectors)
            why = "the rig file has no [devices.projectors]"
            saved = f"{rows * len(rig_file.rig.cameras)} frames"
            return (LeftOutWork(what="scanline sweep", why=why, saved=saved),)
        return ()

    def cost(self, rig_file: RigFile) -> PlanCost:
        """Count the plan before any lamp is armed. Raises `PlanError`."""
        self.check(rig_file)
        rig, steps = rig_file.rig, self.steps(rig_file)
        cameras = len(rig.cameras)
        pixels = sum(c.width * c.height for c in rig.cameras)
        folder = 12 * pixels + sum(EXR_HEADER_BYTES + 16 * c.height for c in rig.cameras)
        kinds: dict[str, int] = {}
        for step in steps:
            kinds[step.kind] = kinds.get(step.kind, 0) + cameras
        parts, why = self.runs(rig_file, steps)
        causes = seconds_by_cause(
            parts,
            rig_file,
            wire_bytes=6 * pixels,
            folder_bytes=folder,
            rate_hz=self.rate_hz,
        )
        lag = causes["storage"] / len(steps)
        lights = timeline(parts, rig_file, rate_hz=self.rate_hz, lag_s=lag)
        lamp_seconds, dose = _dose(rig, steps, causes["settle"] / len(steps) + LATENCY_S)
        return PlanCost(
            steps=len(steps),
            frames=len(steps) * cameras,
            frames_by_kind=kinds,
            bytes=len(steps) * folder,
            seconds=sum(causes.values()),
            seconds_by_cause=causes,
            limited_by=limited_by(causes),
            stepping={
                kind: sum(len(p.steps) for p in parts if p.stepping == kind)
                for kind in ("software", "hardware")
            },
            stepping_why=why,
            lamp_seconds=lamp_seconds,
            dose=dose,
            flash=flash_rate(lights, rig_file.safety.living_subject),
            left_out=self.left_out(rig_file),
        )

    def _swept(self, rig_file: RigFile) -> list[Projector]:
        if _no_controller(rig_file) and self.projectors == "all":
            return []
        chosen = self.projectors
        return [p for p in rig_file.rig.projectors if chosen == "all" or p.name in chosen]

    def _rows(self, projector: Projector) -> range:
        last = projector.height - 1 if self.rows.last is None else self.rows.last
        return range(self.rows.first, min(last, projector.height - 1) + 1, self.rows.step)

    def _exposure(self, kind: StepKind, defaults: CaptureDefaults) -> float:
        own: float | None = getattr(self.exposure, kind)
        return getattr(defaults.exposure, kind) if own is None else own

    def _level(self, kind: StepKind, defaults: CaptureDefaults) -> float:
        if kind == "dark":
            return 0.0
        own: float | None = getattr(self.level, kind)
        return getattr(defaults.level, kind) if own is None else own


def _unknown(kind: str, chosen: Literal["all"] | tuple[str, ...], known: list[str]) -> list[str]:
    if chosen == "all":
        return []
    problems = [
        f"{kind}s: the rig has no {kind} {name!r}" + (f" (it has {', '.join(known[:5])}, …)")
        for name in chosen
        if name not in set(known)
    ]
    twice = sorted({name for name in chosen if chosen.count(name) > 1})
    return problems + [f"{kind}s: {name!r} is listed twice" for name in twice]


def _no_controller(rig_file: RigFile) -> bool:
    return rig_file.devices is not None and rig_file.devices.projectors is None


def _dose(
    rig: Rig, steps: tuple[Step, ...], overhead: float
) -> tuple[float, tuple[float, float, float]]:
    """Lamp seconds, and radiant exposure (3,) at the head's centre by the inverse-square law.

    A row lights a point for about one row's time: it counts as 1/height of its projector.
    """
    lamps = {
        x.name: x.intensity_towards(np.zeros(3)) / (x.position @ x.position) for x in rig.lights
    }
    beams = {p.name: (p.intensity / (p.center @ p.center), p.height) for p in rig.projectors}
    all_lamps = sum(lamps.values(), np.zeros(3))
    all_beams = sum((beam for beam, _ in beams.values()), np.zeros(3))
    dose, lamp_seconds = np.zeros(3), 0.0
    for step in steps:
        time = step.level * (step.exposure + overhead)
        if step.kind == "all_on":
            dose += time * all_lamps
            lamp_seconds += time * len(lamps)
        elif step.light is not None:
            dose += time * lamps[step.light]
            lamp_seconds += time
        elif step.kind == "tracking":
            dose += time * all_beams
        elif step.projector is not None:
            beam, height = beams[step.projector]
            dose += time * beam / height
    r, g, b = (float(x) for x in dose)
    return lamp_seconds, (r, g, b)
