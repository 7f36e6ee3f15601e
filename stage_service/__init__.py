"""Runs the stage: HTTP API, CLI, jobs, sequencing, device drivers.

from stage_service import CapturePlan, load_rig_file, resolve

resolve(CapturePlan(), load_rig_file("demo.toml")).cost
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from stage_service.config import RigFile as RigFile
    from stage_service.config import load_rig_file as load_rig_file
    from stage_service.plan.capture_plan import CapturePlan as CapturePlan
    from stage_service.plan.resolved import PlanError as PlanError
    from stage_service.plan.resolved import ResolvedPlan as ResolvedPlan
    from stage_service.plan.resolved import resolve as resolve
    from stage_service.service import Service as Service

_MODULES = {
    "RigFile": "config",
    "load_rig_file": "config",
    "CapturePlan": "plan.capture_plan",
    "PlanError": "plan.resolved",
    "ResolvedPlan": "plan.resolved",
    "resolve": "plan.resolved",
    "Service": "service",
}
"""Each public name's module, which is imported when the name is first asked for."""

__all__ = list(_MODULES)


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_MODULES[name]}"), name)
