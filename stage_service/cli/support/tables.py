"""Results as tables for people, and as the README's table."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

from rich.console import Group
from rich.table import Table

_THRESHOLDS = ("1mm_10deg", "2mm_20deg", "3mm_30deg")
_HEADS = [t.replace("mm_", " mm/").replace("deg", "°") for t in _THRESHOLDS]
_GROUPS = ("held_out_lights", "held_out_camera")
_APPEARANCE = {
    "beta_m": "longitudinal roughness β_M",
    "v": "longitudinal variance v (Sun's β_l)",
    "colour": "colour of dense hair",
    "skin": "colour of skin",
}


def figures_table(results: Mapping[str, Any], out: Path) -> Group:
    """The tables of the demo's `results.json` in `out`, and where everything is."""
    geometry = geometry_table({"ours": results["geometry"], **results["baselines"]})
    images = Table("pictures (PSNR / SSIM)", "held-out lights", "held-out camera")
    for name in results["images"][_GROUPS[0]]:
        images.add_row(name, *(_picture(results, group, name) for group in _GROUPS))
    fitted, true = results["appearance"]["fitted"], results["appearance"]["true"]
    hair = Table("appearance", "fitted", "true")
    for key, what in _APPEARANCE.items():
        hair.add_row(what, _numbers(fitted[key]), _numbers(true[key]))
    capture = results["capture"]
    return Group(
        geometry,
        images,
        hair,
        *(f"warning: {w}" for w in results["warnings"]),
        f"{results['seconds']:.0f} s in all: capture {capture['seconds']:.0f} s, "
        + ", ".join(f"{k} {v:.0f} s" for k, v in results["stages"].items()),
        f"everything is in {out.resolve()}: results.json, capture/, model/ (strands, appearance, "
        "pictures, report.json, plots/), truth/, logs/",
    )


def markdown_table(results: Mapping[str, Mapping[str, Any]]) -> str:
    """The README's table of figures: a column for each of several demos' results by name, and their
    warnings below it."""
    figures: dict[str, Callable[[Mapping[str, Any]], str]] = {}
    for over in ("visible", "all"):
        for name, title in _STRANDS.items():
            figures[f"F at 1 mm/10°, {over} points: {title}"] = partial(_f, over=over, name=name)
    for group, title in zip(_GROUPS, ("lights", "camera"), strict=True):
        for method in ("ours", "diffuse", "three_nearest"):
            label = "three nearest lights" if method == "three_nearest" else method
            figures[f"held-out {title}: {label}"] = partial(_picture, group=group, name=method)
    figures["β_M (true)"] = lambda r: " ".join(
        form.format(r["appearance"][which]["beta_m"])
        for which, form in (("fitted", "{:.2f}"), ("true", "({:.2f})"))
    )
    head, notes = [""], []
    for number, (name, result) in enumerate(results.items(), 1):
        warnings = result.get("warnings", [])
        head.append(f"{name} [{number}]" if warnings else name)
        notes += [f"[{number}] {w}" for w in warnings]
    rows = [head, ["---"] * len(head)]
    rows += [[title, *(figure(r) for r in results.values())] for title, figure in figures.items()]
    table = "\n".join(f"| {' | '.join(row)} |" for row in rows)
    return "\n\n".join([table, *notes])


_STRANDS = {
    "ours": "ours",
    "hull_smooth_field": "hull + smooth field",
    "hull_vertical": "hull + vertical",
}


def _f(results: Mapping[str, Any], over: str, name: str) -> str:
    scores = results["geometry"] if name == "ours" else results["baselines"][name]
    return f"{100 * scores[over][_THRESHOLDS[0]]['f']:.1f} %"


def _picture(results: Mapping[str, Any], group: str, name: str) -> str:
    scores = results["images"][group][name]
    return f"{scores['psnr']:.1f} dB / {scores['ssim']:.2f}"


def _numbers(value: Any) -> str:
    values = value if isinstance(value, list) else [value]
    return ", ".join(f"{x:.3g}" for x in values)


def geometry_table(rows: Mapping[str, Mapping[str, Any]]) -> Table:
    """A table of precision, recall and F in per cent, a row for each name in `rows`."""
    table = Table(
        "strands", "over", *_HEADS, title="Strands against the true ones: precision / recall / F, %"
    )
    for name, figures in rows.items():
        for over in ("visible", "all"):
            if over in figures:
                table.add_row(name, over, *_cells(figures[over]))
    return table


def _cells(scores: dict[str, dict[str, float]]) -> list[str]:
    return [
        " / ".join(f"{100 * scores[t][k]:.1f}" for k in ("precision", "recall", "f"))
        for t in _THRESHOLDS
    ]


def assessment_text(figures: dict[str, Any]) -> Group:
    """Tables of what `assess_strands` found."""
    regions = Table("part of the hair", *_HEADS, title="Precision / recall / F by part, %")
    for kind in figures["regions"].values():
        for name, scores in kind.items():
            regions.add_row(name, *_cells(scores))
    more = Table("", "predicted", "true", title="Strands")
    for name, value in _STRAND_ROWS:
        cells = [value(figures, which) for which in ("pred", "true")]
        if any(cells):
            more.add_row(name, *cells)
    table = geometry_table({"as lines": figures, "root to tip": figures["directed"]})
    return Group(table, regions, more)


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
    ("strands that lie along it", lambda f, w: _spread(f, "connectivity", w, "covering")),
    ("fewest that cover what any does", lambda f, w: _spread(f, "connectivity", w, "fragments")),
    ("reach the scalp, %", lambda f, w: _share(f, "roots", w, "rooted")),
    ("with their tip, %", lambda f, w: _share(f, "roots", w, "upside_down")),
]
