"""The pipelines by name: which steps, in which order."""

from __future__ import annotations

PIPELINES: dict[str, tuple[str, ...]] = {
    "light_planes": ("compress", "reconstruct", "fit", "assess", "evaluate", "results"),
    "reconstruct": ("reconstruct", "evaluate", "results"),
    "fit": ("fit", "assess", "results"),
    "appearance": ("fit", "inverse_rendering", "assess", "results"),
}
"""Each step is a checkpoint: after a crash the job goes on at the step that was under way."""

STEPS_VERSION = "2"
"""Raise it when a pipeline's steps change: a job begun under other steps is not taken up again."""
