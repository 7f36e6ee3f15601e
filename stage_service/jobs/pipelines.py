"""The pipelines by name: which steps, in which order."""

from __future__ import annotations

PIPELINES: dict[str, tuple[str, ...]] = {
    "light_planes": ("reconstruct", "fit", "relight", "assess", "evaluate", "results", "compress"),
    "full": (
        "reconstruct",
        "fit",
        "inverse_rendering",
        "fields",
        "relight",
        "assess",
        "evaluate",
        "results",
        "compress",
    ),
    "reconstruct": ("reconstruct", "evaluate", "results"),
    "fit": ("fit", "inverse_rendering", "fields", "relight", "assess", "results"),
}
"""Each step is a checkpoint: after a crash the job resumes at the step that was under way.
The result comes first; comparisons and compression delay nobody."""

SECONDS = {
    "reconstruct": 166,
    "fit": 63,
    "inverse_rendering": 85,
    "fields": 100,
    "relight": 80,
    "assess": 60,
    "evaluate": 148,
    "results": 3,
    "compress": 20,
}
"""Duration of steps of the demo on two cores, for the share of a job that is done."""

RENDERING = frozenset({"fit", "inverse_rendering", "fields", "relight", "assess"})
"""Steps that run several times faster on a GPU."""

STEPS_VERSION = "7"
"""Raise it when a pipeline's steps change: jobs of another version are not resumed."""
