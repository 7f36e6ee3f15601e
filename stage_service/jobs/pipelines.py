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
"""Each step is a checkpoint: after a crash the job resumes at the step that was under way.
Compression is last, so that it delays no results."""

RENDERING = frozenset({"fit", "inverse_rendering", "fields", "assess"})
"""Steps that run several times faster on a GPU."""

STEPS_VERSION = "5"
"""Raise it when a pipeline's steps change: jobs of another version are not resumed."""
