"""The pipelines by name: which steps, in which order."""

from __future__ import annotations

PIPELINES: dict[str, tuple[str, ...]] = {
    "light_planes": ("reconstruct", "fit", "assess", "evaluate", "results", "compress"),
    "full": (
        "reconstruct",
        "fit",
        "inverse_rendering",
        "assess",
        "evaluate",
        "results",
        "compress",
    ),
    "reconstruct": ("reconstruct", "evaluate", "results"),
    "fit": ("fit", "assess", "results"),
    "appearance": ("fit", "inverse_rendering", "assess", "results"),
    "fields": ("fit", "inverse_rendering", "fields", "assess", "results"),
}
"""Each step is a checkpoint: after a crash the job goes on at the step that was under way. What
nobody waits for comes last: results and pictures are there before frames are compressed."""

RENDERING = frozenset({"fit", "inverse_rendering", "fields", "assess"})
"""Steps that a GPU makes several times faster, where Dr.Jit has one."""

STEPS_VERSION = "5"
"""Raise it when a pipeline's steps change: a job begun under other steps is not taken up again."""
