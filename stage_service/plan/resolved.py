"""A plan applied to a rig: made once by `resolve`, used to cost and to shoot it."""

from __future__ import annotations

import shutil
from collections import Counter
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

from reconstruction import Step
from reconstruction.capture.light_patterns import LightPatterns, PatternError
from reconstruction.files.durable import RESERVE
from stage_service.config import LONGEST_S, SHORTEST_S, RigFile
from stage_service.plan.capture_plan import CapturePlan
from stage_service.plan.cost import LeftOutWork, PlanCost, dose_of, folder_bytes
from stage_service.plan.flash import SLOW_HZ, FlashRefusal, flash_rate
from stage_service.plan.limits import check_levels, check_limits
from stage_service.plan.patterns import LampLevels, patterns_of
from stage_service.plan.stepping import (
    LATENCY_S,
    NO_PATTERNS,
    Run,
    limited_by,
    runs,
    seconds_by_cause,
)
from stage_service.plan.steps import expand, exposures_of, levels_of, no_controller, rows_of, swept
from stage_service.plan.timeline import timeline

MOST_LISTED = 20
"""Wrong names that are listed one by one."""


class PlanError(ValueError):
    """The rig cannot shoot this plan; `problems` has one sentence for each reason."""

    def __init__(self, problems: list[str]) -> None:
        super().__init__("; ".join(problems))
        self.problems = problems


@dataclass(frozen=True, eq=False)
class ResolvedPlan:
    """A plan that `rig_file` can shoot: its steps in order, divided into runs.

    `stepping_why` is the reason for how they are clocked; `patterns` are those that are lit.
    """

    plan: CapturePlan
    rig_file: RigFile
    steps: tuple[Step, ...]
    runs: tuple[Run, ...]
    stepping_why: str
    patterns: LightPatterns | None = None

    @cached_property
    def lamp_levels(self) -> LampLevels:
        """The level of each lamp in a step."""
        return LampLevels(self.rig_file.rig, self.patterns)

    @property
    def recorded_patterns(self) -> dict[str, Any]:
        """The field `patterns` of the capture's `plan.json`; empty without any."""
        return {} if self.patterns is None else {"patterns": self.patterns.to_dict()}

    @property
    def retries(self) -> int:
        """How often a missing frame is shot again."""
        retries = self.plan.retries
        return self.rig_file.capture.retries if retries is None else retries

    def at_rate(self, hz: float) -> ResolvedPlan:
        """The same steps, at most `hz` per second."""
        return replace(self, plan=self.plan.model_copy(update={"rate_hz": hz}))

    def check_flashing(self, armed_by: str | None) -> None:
        """Raise `FlashRefusal` where flashes lack consent or arming."""
        cost, consent = self.cost, self.plan.consent
        if cost.flash.needs_consent and not (consent and armed_by):
            slow = self.at_rate(SLOW_HZ).cost
            raise FlashRefusal(cost.flash, consent, seconds=cost.seconds, slow_seconds=slow.seconds)

    def check_room(self, folder: Path) -> None:
        """Raise `PlanError` where the frames do not fit on the disk of `folder`, or it is gone."""
        try:
            needed, free = self.cost.bytes, shutil.disk_usage(folder).free
        except FileNotFoundError:
            raise PlanError([f"{folder} does not exist: check its disk"]) from None
        if needed + RESERVE > free:
            need, kept, have = (f"{n / 1e9:.2f} GB" for n in (needed, RESERVE, free))
            fits = f"the plan writes {need} and keeps a reserve of {kept}"
            raise PlanError([f"{fits}, but {folder} has {have} free: make room"])

    @cached_property
    def cost(self) -> PlanCost:
        """The predicted cost."""
        rig, steps, rate_hz = self.rig_file.rig, self.steps, self.plan.rate_hz
        cameras, folder = len(rig.cameras), folder_bytes(rig)
        causes = seconds_by_cause(
            self.runs,
            self.rig_file,
            wire_bytes=6 * sum(c.width * c.height for c in rig.cameras),
            folder_bytes=folder,
            rate_hz=rate_hz,
        )
        lag = causes["storage"] / len(steps)
        lights = timeline(self.runs, self.rig_file, rate_hz=rate_hz, lag_s=lag)
        devices = self.rig_file.devices
        overhead = causes["settle"] / len(steps) + LATENCY_S
        overhead += 0.0 if devices is None else devices.cameras.lag_s
        lamp_seconds, dose = dose_of(rig, steps, overhead, self.lamp_levels)
        clocked = Counter({"software": 0, "hardware": 0})
        for run in self.runs:
            clocked[run.stepping] += len(run.steps)
        return PlanCost(
            steps=len(steps),
            frames=len(steps) * cameras,
            frames_by_kind={k: n * cameras for k, n in Counter(s.kind for s in steps).items()},
            bytes=len(steps) * folder,
            seconds=sum(causes.values()),
            seconds_by_cause=causes,
            limited_by=limited_by(causes),
            stepping=dict(clocked),
            stepping_why=self.stepping_why,
            lamp_seconds=lamp_seconds,
            dose=dose,
            flash=flash_rate(lights, self.rig_file.safety.living_subject),
            left_out=self._left_out(),
        )

    def _left_out(self) -> tuple[LeftOutWork, ...]:
        """What "all" omits on this rig, and why."""
        rig = self.rig_file.rig
        if self.plan.projectors != "all":
            return ()
        if not rig.projectors:
            why, saved = "the rig has no projector", "its frames and its time"
        elif no_controller(self.rig_file):
            rows = sum(len(rows_of(self.plan.rows, p)) for p in rig.projectors)
            why = "the rig file has no [devices.projectors]"
            saved = f"{rows * len(rig.cameras)} frames"
        else:
            return ()
        return (LeftOutWork(what="scanline sweep", why=why, saved=saved),)


def resolve(plan: CapturePlan, rig_file: RigFile) -> ResolvedPlan:
    """Apply a plan to a rig; uses no device. Raises `PlanError` with every problem."""
    problems = _misfits(plan, rig_file)
    patterns = None
    try:
        if not problems:
            patterns = patterns_of(plan, rig_file, levels_of(plan, rig_file).pattern)
    except PatternError as error:
        problems.append(f"patterns: {error}")
    steps = () if problems else expand(plan, rig_file, patterns)
    if not problems and not steps:
        problems.append("the plan has no steps: no lights, no projectors, no sentinels")
    if problems:
        raise PlanError(problems)
    parts, why = runs(steps, rig_file, plan.stepping)
    lights = timeline(parts, rig_file, rate_hz=plan.rate_hz)
    lamp_levels = LampLevels(rig_file.rig, patterns)
    problems += check_limits(lights, rig_file.rig, rig_file.safety, lamp_levels)
    if rig_file.devices is not None:
        problems += check_levels(parts, rig_file.devices.lights)
    if problems:
        raise PlanError(problems)
    return ResolvedPlan(plan, rig_file, steps, parts, why, patterns)


def _misfits(plan: CapturePlan, rig_file: RigFile) -> list[str]:
    """What the plan requires and the rig does not have."""
    rig, devices = rig_file.rig, rig_file.devices
    problems = _unknown("light", plan.lights, [x.name for x in rig.lights])
    problems += _unknown("projector", plan.projectors, [x.name for x in rig.projectors])
    for p in swept(plan, rig_file):
        last = p.height - 1 if plan.rows.last is None else plan.rows.last
        if last >= p.height or plan.rows.first > last:
            problems.append(
                f"rows {plan.rows.first} to {last}: projector {p.name} has rows 0 to {p.height - 1}"
            )
    if len(set(plan.brackets)) < len(plan.brackets):
        problems.append(f"brackets: {list(plan.brackets)} has a factor twice")
    exposures = exposures_of(plan, rig_file)
    base = exposures.olat if plan.patterns is None else exposures.pattern
    for factor in plan.brackets:
        if not SHORTEST_S <= factor * base <= LONGEST_S:
            problems.append(
                f"brackets: {factor:g} times {base:g} s is an exposure of {factor * base:g} s; "
                f"the trigger box makes {SHORTEST_S:g} to {LONGEST_S:g} s"
            )
    if plan.stepping == "hardware" and (devices is None or not devices.hardware_stepping):
        problems.append(
            "stepping: the rig file does not say that the trigger box's gates are wired; set "
            "hardware_stepping in [devices], or let the service step"
        )
    if plan.stepping == "hardware" and plan.patterns is not None:
        problems.append(f"stepping: {NO_PATTERNS}, no pattern: let the service step")
    if plan.projectors != "all" and plan.projectors and no_controller(rig_file):
        problems.append("projectors: the rig file has no [devices.projectors]")
    return problems


def _unknown(kind: str, chosen: Literal["all"] | tuple[str, ...], known: list[str]) -> list[str]:
    if chosen == "all":
        return []
    there = set(known)
    problems = [
        f"{kind}s: the rig has no {kind} {name!r} (it has {', '.join(known[:5])}, …)"
        for name in chosen
        if name not in there
    ]
    twice = sorted(name for name, count in Counter(chosen).items() if count > 1)
    problems += [f"{kind}s: {name!r} is listed twice" for name in twice]
    more = len(problems) - MOST_LISTED
    return problems[:MOST_LISTED] + ([f"{kind}s: {more} more such names"] if more > 0 else [])
