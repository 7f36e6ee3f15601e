"""The steps of a plan on a rig, in shooting order."""

from __future__ import annotations

from typing import Any

from reconstruction import Projector, Step
from reconstruction.capture.light_patterns import LightPatterns
from stage_service.config import Exposures, Levels, RigFile
from stage_service.plan.capture_plan import CapturePlan, Rows
from stage_service.plan.patterns import level_of_bank


def expand(
    plan: CapturePlan, rig_file: RigFile, patterns: LightPatterns | None = None
) -> tuple[Step, ...]:
    """The steps of a plan that names only what the rig has; `patterns` are the plan's."""
    defaults = rig_file.capture
    exposures, levels = exposures_of(plan, rig_file), levels_of(plan, rig_file)
    levels = levels.model_copy(update={"pattern": level_of_bank(levels.pattern, rig_file)})
    ends = [{"kind": "dark"}, {"kind": "all_on"}] if plan.sentinels else []
    kind, field = "olat", "light"
    names = [x.name for x in rig_file.rig.lights] if plan.lights == "all" else plan.lights
    if patterns is not None:
        kind, field, names = "pattern", "pattern", patterns.names
    exposure = getattr(exposures, kind)
    todo: list[dict[str, Any]] = [*ends]
    for factor in plan.brackets:
        for i, name in enumerate(names):
            if plan.lit_every and i % plan.lit_every == 0:
                todo.append({"kind": "all_on"})
            todo.append({"kind": kind, field: name, "exposure": exposure * factor})
    if plan.lit_every and names:
        todo.append({"kind": "all_on"})
    every = defaults.tracking_every if plan.tracking_every is None else plan.tracking_every
    for projector in swept(plan, rig_file):
        rows = rows_of(plan.rows, projector)
        groups = max(1, len(rows) // every) if every else 0
        for i, row in enumerate(rows):
            if every and i % every == 0 and i // every < groups:
                todo.append({"kind": "tracking"})
            todo.append({"kind": "scanline", "projector": projector.name, "row": row})
    todo += ends
    return tuple(
        Step(
            index=i,
            level=0.0 if fields["kind"] == "dark" else getattr(levels, fields["kind"]),
            **{"exposure": getattr(exposures, fields["kind"]), **fields},
        )
        for i, fields in enumerate(todo)
    )


def exposures_of(plan: CapturePlan, rig_file: RigFile) -> Exposures:
    """Seconds per kind of step: the plan's, else the rig file's."""
    return rig_file.capture.exposure.model_copy(update=plan.exposure.model_dump(exclude_none=True))


def levels_of(plan: CapturePlan, rig_file: RigFile) -> Levels:
    """Levels per kind of step: the plan's, else the rig file's."""
    return rig_file.capture.level.model_copy(update=plan.level.model_dump(exclude_none=True))


def swept(plan: CapturePlan, rig_file: RigFile) -> list[Projector]:
    """The projectors that sweep; "all" is none without a controller."""
    if plan.projectors == "all":
        return [] if no_controller(rig_file) else list(rig_file.rig.projectors)
    return [p for p in rig_file.rig.projectors if p.name in plan.projectors]


def no_controller(rig_file: RigFile) -> bool:
    """Whether the rig file has devices, but no projector controller."""
    return rig_file.devices is not None and rig_file.devices.projectors is None


def rows_of(rows: Rows, projector: Projector) -> range:
    """The rows that this projector shows."""
    last = projector.height - 1 if rows.last is None else rows.last
    return range(rows.first, min(last, projector.height - 1) + 1)
