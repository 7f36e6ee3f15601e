"""Strand scores as tables on the terminal."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from rich.console import Group
from rich.table import Table

from stage_service.model_page.names import (
    OF_TRUTH,
    STRAND_FIGURES,
    THRESHOLDS,
    consistency_cells,
    strand_cells,
    strand_figure,
    threshold,
)

_HEADS = [threshold(t) for t in THRESHOLDS]


def geometry_table(rows: Mapping[str, Mapping[str, Any]]) -> Group:
    """Precision, recall and F in per cent, as it is and at equal length, and strand consistency,
    rows for each of `rows`; and how long and how whole the strands are."""
    table = Table(
        "strands", "over", *_HEADS, title="Strands against the true ones: precision / recall / F, %"
    )
    for over in ("visible", "all"):
        for at, how in (("", ""), ("equal_length", ", at equal length")):
            for name, figures in rows.items():
                scores = figures.get(at, {}) if at else figures
                if over in scores:
                    table.add_row(name, over + how, *_cells(scores[over]))
    for name, figures in rows.items():
        if cells := consistency_cells(figures):
            table.add_row(name, "strand consistency, %", *cells)
    more = Table("strands", *(title for title, *_ in STRAND_FIGURES))
    for name, figures in rows.items():
        if any(strand_figure(figures, read) is not None for *_, read in STRAND_FIGURES):
            more.add_row(name, *strand_cells(figures))
    if more.row_count:
        first = next(iter(rows.values()))
        more.add_row(
            "the truth",
            *strand_cells(first, [OF_TRUTH.get(title, ()) for title, *_ in STRAND_FIGURES]),
        )
    return Group(table, more) if more.row_count else Group(table)


def _cells(scores: dict[str, dict[str, float]]) -> list[str]:
    return [
        " / ".join(f"{100 * scores[t][k]:.1f}" for k in ("precision", "recall", "f"))
        for t in THRESHOLDS
    ]


def assessment_text(figures: dict[str, Any]) -> Group:
    """Tables of what `assess_strands` found."""
    more = Table("", "predicted", "true", title="Strands")
    for name, value in _STRAND_ROWS:
        cells = [value(figures, which) for which in ("pred", "true")]
        if any(cells):
            more.add_row(name, *cells)
    rows = {"as lines": figures, "root to tip": figures["directed"]}
    if "true_directions" in figures:
        rows["true directions"] = figures["true_directions"]
    table = geometry_table(rows)
    return Group(table, more)


def _spread(figures: dict[str, Any], *path: str) -> str:
    """Mean and 5 to 95 % of a spread, or nothing where it is missing."""
    for key in path:
        figures = figures.get(key, {})
    if "mean" not in figures:
        return ""
    return f"{figures['mean']:.3g} ({figures['p5']:.3g} to {figures['p95']:.3g})"


def _share(figures: dict[str, Any], *path: str) -> str:
    for key in path[:-1]:
        figures = figures.get(key, {})
    return f"{100 * figures[path[-1]]:.1f}" if path[-1] in figures else ""


_ONE = {"pred": "on_one", "true": "by_one"}
_STRAND_ROWS: list[tuple[str, Callable[[dict[str, Any], str], str]]] = [
    ("strands", lambda f, w: f"{f['lengths'][w]['strands']:,}"),
    ("length, mm: mean (5 to 95 %)", lambda f, w: _spread(f, "lengths", w)),
    ("to the nearest point, mm", lambda f, w: _spread(f, "errors", w, "distance_mm")),
    ("angle to it, degrees", lambda f, w: _spread(f, "errors", w, "angle_deg")),
    ("nearest point runs the other way, %", lambda f, w: _share(f, "errors", w, "reversed")),
    ("most of it on one strand, share", lambda f, w: _spread(f, "connectivity", w, _ONE[w])),
    ("reach the scalp, %", lambda f, w: _share(f, "roots", w, "rooted")),
    ("with their tip, %", lambda f, w: _share(f, "roots", w, "upside_down")),
]
