"""Titles of results and captions, on the terminal, in the benchmark's table and on the page."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

THRESHOLDS = ("1mm_10deg", "2mm_20deg", "3mm_30deg")
GROUPS = ("held_out_lights", "held_out_camera")
STRANDS = {
    "ours": "ours",
    "true_directions": "ours, true directions over a pixel",
    "hull_smooth_field": "hull + smooth field",
    "hull_vertical": "hull + vertical",
}
STRAND_FIGURES: tuple[tuple[str, str, str, tuple[str, ...]], ...] = (
    ("strands", ",.0f", "", ("lengths", "pred", "strands")),
    ("metres", ",.0f", " m", ("lengths", "pred", "total_m")),
    ("share of a strand on one true strand", ".2f", "", ("connectivity", "pred", "on_one", "mean")),
    ("share of a true strand on one strand", ".2f", "", ("connectivity", "true", "by_one", "mean")),
)
"""Length and continuity of strands: title, format, unit, path in the scores."""

OF_TRUTH = {"strands": ("lengths", "true", "strands"), "metres": ("lengths", "true", "total_m")}
PICTURES = {
    "ours": "ours",
    "inverse_rendering": "inverse rendering",
    "sun_fit": "Sun's fit",
    "without_field": "without the field",
    "from_frames": "captured frames, relit",
    "diffuse": "diffuse",
    "mean_colour": "mean colour",
    "three_nearest": "three nearest lights",
    "nearest_cameras": "three nearest cameras",
    "three_nearest_own_frames": "three nearest lights in that camera's own frames",
}
HERO = ("relit.png", "render.png", "comparison.png")
"""The image at the top of the page: the first that exists."""
SHOWN = {
    "relit.png": "The result under a new environment map.",
    "relit.webp": "The same under the turning environment.",
    "comparison.png": "Held-out frames: captured, rendered, and baselines.",
    "render.png": "The latest image of hairstage render.",
    "plots/geometry.png": "Strands, baselines and true directions against the true strands.",
}


def threshold(name: str) -> str:
    """`1mm_10deg` as text."""
    return name.replace("mm_", " mm/").replace("deg", "°")


def strand_figure(scores: Mapping[str, Any], place: Sequence[str]) -> float | None:
    """The figure at `place` in the result of `compare_strands`; None if missing."""
    found: Any = scores
    for key in place:
        found = found.get(key, {})
    return float(found) if place and not isinstance(found, Mapping) else None


def consistency_cells(scores: Mapping[str, Any]) -> list[str]:
    """Strand consistency at each of `THRESHOLDS` in per cent; none if missing."""
    found = scores.get("connectivity", {}).get("true", {}).get("strand_consistency", {})
    return [f"{100 * found[t]:.1f}" for t in THRESHOLDS if t in found]


def strand_cells(
    scores: Mapping[str, Any], places: Sequence[Sequence[str]] | None = None
) -> list[str]:
    """The `STRAND_FIGURES`, or those at `places`, as text; a dash if missing."""
    values = [
        strand_figure(scores, place) for place in places or [place for *_, place in STRAND_FIGURES]
    ]
    forms = [(form, unit) for _, form, unit, _ in STRAND_FIGURES]
    return [
        "–" if value is None else f"{value:{form}}{unit}"
        for value, (form, unit) in zip(values, forms, strict=True)
    ]
