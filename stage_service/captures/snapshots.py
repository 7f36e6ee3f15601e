"""Snapshots: a single exposure, kept until the next one and apart from the captures."""

from __future__ import annotations

from dataclasses import replace

from stage_service.config import RigFile
from stage_service.plan.capture_plan import CapturePlan, KindExposures, KindLevels
from stage_service.plan.flash import SLOW_HZ
from stage_service.plan.resolved import ResolvedPlan, resolve
from stage_service.plan.stepping import runs

SNAPSHOT = "snapshot"
"""The id of the newest snapshot."""
APART_S = 1 / SLOW_HZ
"""Shortest interval between snapshots, so that they do not flash at a living subject."""


def one_step(
    rig_file: RigFile,
    light: str | None = None,
    exposure: float | None = None,
    level: float | None = None,
) -> ResolvedPlan:
    """A plan of a single step: `light` alone, or all lights; shot once. Exposure in seconds and
    level are the rig file's where they are None. Raises `PlanError`."""
    kind = "all_on" if light is None else "olat"
    plan = CapturePlan(
        lights=() if light is None else (light,),
        projectors=(),
        sentinels=light is None,
        stepping="software",
        retries=0,
        exposure=KindExposures.model_validate({kind: exposure}),
        level=KindLevels.model_validate({kind: level}),
    )
    found = resolve(plan, rig_file)
    step = replace(next(s for s in found.steps if s.kind == kind), index=0)
    parts, why = runs((step,), rig_file, "software")
    return ResolvedPlan(plan, rig_file, (step,), parts, why)
