"""Results as tables for people, and as the README's table."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from statistics import mean, stdev
from typing import Any

from rich.console import Group
from rich.table import Table

from stage_service.model_page.names import (
    GROUPS,
    OF_TRUTH,
    PICTURES,
    STRAND_FIGURES,
    STRANDS,
    THRESHOLDS,
    strand_cells,
    strand_figure,
    threshold,
)

_HEADS = [threshold(t) for t in THRESHOLDS]
_SCORES = ("psnr", "ssim")
_APPEARANCE = {
    "beta_m": "β_M to render these strands with",
    "v": "longitudinal variance v (Sun's β_l)",
    "colour": "colour of dense hair",
    "skin": "colour of skin",
}


def figures_table(results: Mapping[str, Any], out: Path) -> Group:
    """The tables of the demo's `results.json` in `out`, and where everything is."""
    geometry = geometry_table({"ours": results["geometry"], **results["baselines"]})
    images = Table("pictures (PSNR / SSIM)", "held-out lights", "held-out camera")
    for name, title in PICTURES.items():
        found = [results["images"].get(group, {}).get(name) for group in GROUPS]
        cells = ["" if f is None else f"{f['psnr']:.1f} dB / {f['ssim']:.2f}" for f in found]
        if any(cells):
            images.add_row(title, *cells)
    fits = results["appearance"]
    hair = Table("appearance", *(PICTURES.get(name, name) for name in fits))
    for key, what in _APPEARANCE.items():
        hair.add_row(what, *(_numbers(figures[key]) for figures in fits.values()))
    if any("beta_m_interval" in figures for figures in fits.values()):
        hair.add_row("its 95 % interval", *(_interval(f) for f in fits.values()))
    if any("sigma_a_error" in figures for figures in fits.values()):
        errors = (_per_cent(figures.get("sigma_a_error")) for figures in fits.values())
        hair.add_row("standard error of σ_a", *errors)
    capture = results["capture"]
    return Group(
        geometry,
        images,
        hair,
        *(f"warning: {w}" for w in results["warnings"]),
        f"{results['seconds']:.0f} s in all: capture {capture['seconds']:.0f} s, "
        + ", ".join(f"{k} {v:.0f} s" for k, v in results["stages"].items()),
        f"everything is in {out.resolve()}: results.json, capture/, model/, truth/, logs/",
        f"begin with {out.resolve() / 'model' / 'index.html'}",
        f"the hair under light that turns: {out.resolve() / 'model' / 'relit.webp'}",
        f"turn the hair: hairstage view {out / 'model'} --capture {out / 'capture'} "
        f"--truth {out / 'truth' / 'strands.npz'}",
    )


def markdown_table(
    columns: Mapping[str, Sequence[Mapping[str, Any]]], *, short: bool = False
) -> str:
    """A table of figures: a column for each list of results, one a seed, by its name.

    A cell is the figure of one seed, or mean ± standard deviation (n - 1) over seeds. Warnings
    stand below, each with the seeds that had it; its numbers are those of the first. The README's
    is `short`: what is ours and what it is held against, and how many warnings there are.
    """
    table, notes = [["", *columns], ["---"] * (len(columns) + 1)], []
    for number, (name, results) in enumerate(columns.items(), 1):
        seeds_of: dict[str, list[str]] = {}
        first: dict[str, str] = {}
        for result in results:
            for text in result.get("warnings", []):
                alike = re.sub(r"[\d.]+", "#", text)
                first.setdefault(alike, text)
                seeds_of.setdefault(alike, []).append(str(result["seed"]))
        if first:
            table[0][number] = f"{name} [{number}]"
        if short and first:
            many = "s" if len(first) > 1 else ""
            notes.append(f"[{number}] {len(first)} warning{many} of these runs")
            continue
        for alike, text in first.items():
            of = f" (seed {', '.join(seeds_of[alike])})" if len(results) > 1 else ""
            notes.append(f"[{number}] {text}{of}")
    figures = [figures_of(results) for results in columns.values()]
    for title, parts in _rows(short).items():
        cells = [" / ".join(_cell(f[title], parts)) if title in f else "–" for f in figures]
        if set(cells) != {"–"}:
            table.append([title, *cells])
    return "\n\n".join(["\n".join(f"| {' | '.join(row)} |" for row in table), *notes])


def figures_of(results: Sequence[Mapping[str, Any]]) -> dict[str, list[dict[str, float]]]:
    """The rows of `markdown_table` as numbers, of one seed or several.

    `{row: [{"mean", "n", "std"}, …]}`: of pictures PSNR and SSIM, else one; "std" of several seeds.
    """
    out = {}
    for title, parts in _rows().items():
        values = [[read(result) for result in results] for read, _, _ in parts]
        if not any(v is None for of_part in values for v in of_part):
            out[title] = [
                _summary([float(v) for v in of_part if v is not None]) for of_part in values
            ]
    return out


def _summary(values: Sequence[float]) -> dict[str, float]:
    spread = {"std": stdev(values)} if len(values) > 1 else {}
    return {"mean": mean(values), "n": len(values), **spread}


_Part = tuple[Callable[[Mapping[str, Any]], float | None], str, str]
"""A figure of a result, None where it has none; the form of the number, and its unit."""


_SHORT = frozenset(
    ("ours", "hull_smooth_field", "guided_frames", "diffuse", "three_nearest", "nearest_cameras")
)
"""What the README's rows of F and of pictures are of; its other rows are ours."""


def _rows(short: bool = False) -> dict[str, list[_Part]]:
    """The table's rows by title."""
    rows: dict[str, list[_Part]] = {}
    strands = {n: title for n, title in STRANDS.items() if n in _SHORT or not short}
    pictures = {n: title for n, title in PICTURES.items() if n in _SHORT or not short}
    ours = {"ours": STRANDS["ours"]} if short else STRANDS
    for over in ("visible", "all"):
        for at, how, of in (("", "", strands), ("equal_length", ", at equal length", ours)):
            for name, title in of.items():
                read = partial(_f, at=at, over=over, name=name)
                rows[f"F at 1 mm/10°, {over} points{how}: {title}"] = [(read, ".1f", " %")]
    for title, form, unit, place in STRAND_FIGURES:
        for name, who in ours.items():
            figure = partial(_strand_figure, place=place, name=name)
            rows[f"{title}: {who}"] = [(figure, form, unit)]
        if title in OF_TRUTH:
            truth = partial(_strand_figure, place=OF_TRUTH[title], name="ours")
            rows[f"{title}: the truth"] = [(truth, form, unit)]
    for group in GROUPS:
        for name, title in pictures.items():
            decibels, ssim = (partial(_score, group=group, name=name, score=s) for s in _SCORES)
            where = group.replace("held_out_", "held-out ")
            rows[f"{where}: {title}"] = [(decibels, ".1f", " dB"), (ssim, ".2f", "")]
    rows["β_M to render these strands with"] = [(partial(_beta_m, fit="fitted"), ".2f", "")]
    rows["β_M of Sun's fit: standard error"] = [(_beta_m_error, ".2f", "")]
    rows["β_M of the fibres: the truth"] = [(partial(_beta_m, fit="true"), ".2f", "")]
    rows["σ_a, the channel that is furthest off"] = [(_absorption_error, ".0f", " %")]
    return rows


def _cell(figures: Sequence[Mapping[str, float]], parts: Sequence[_Part]) -> Iterator[str]:
    for one, (_, form, unit) in zip(figures, parts, strict=True):
        spread = f" ± {one['std']:{form}}" if "std" in one else ""
        yield f"{one['mean']:{form}}{spread}{unit}"


def _f(results: Mapping[str, Any], at: str, over: str, name: str) -> float | None:
    scores = _scores_of(results, name)
    if scores is None or (at and at not in scores):
        return None  # of an earlier version
    return 100 * float((scores[at] if at else scores)[over][THRESHOLDS[0]]["f"])


def _strand_figure(results: Mapping[str, Any], place: Sequence[str], name: str) -> float | None:
    scores = _scores_of(results, name)
    return None if scores is None else strand_figure(scores, place)


def _scores_of(results: Mapping[str, Any], name: str) -> Mapping[str, Any] | None:
    found: Mapping[str, Any] | None = {"ours": results["geometry"], **results["baselines"]}.get(
        name
    )
    return found


def _score(results: Mapping[str, Any], group: str, name: str, score: str) -> float | None:
    found = results["images"].get(group, {}).get(name)
    return None if found is None else float(found[score])


def _beta_m(results: Mapping[str, Any], fit: str) -> float | None:
    found = results["appearance"].get(fit)
    return None if found is None else float(found["beta_m"])


def _beta_m_error(results: Mapping[str, Any]) -> float | None:
    """Standard error of the roughness of Sun's fit; None in results without one."""
    fits = results["appearance"]
    sun = fits.get("sun_fit", fits["fitted"])
    return sun["beta_m"] * sun["beta_m_error"] if "beta_m_error" in sun else None


def _absorption_error(results: Mapping[str, Any]) -> float | None:
    """By how much, in per cent, the channel of σ_a is off that is furthest from the truth."""
    fits = results["appearance"]
    fitted, true = (fits.get(fit, {}).get("sigma_a") for fit in ("fitted", "true"))
    if not fitted or not true or not all(true):
        return None
    return 100 * max(abs(a / b - 1) for a, b in zip(fitted, true, strict=True))


def _per_cent(value: Any) -> str:
    values = value if isinstance(value, list) else [value] * (value is not None)
    return ", ".join("?" if x is None else f"{100 * x:.0f} %" for x in values)


def _numbers(value: Any) -> str:
    values = value if isinstance(value, list) else [value]
    return ", ".join(f"{x:.3g}" for x in values)


def _interval(figures: Mapping[str, Any]) -> str:
    ends = figures.get("beta_m_interval")
    return "" if ends is None else f"{ends[0]:.3g} to {ends[1]:.3g}"


def geometry_table(rows: Mapping[str, Mapping[str, Any]]) -> Group:
    """Precision, recall and F in per cent, as it is and at equal length, rows for each of `rows`;
    and how long and how whole the strands are."""
    table = Table(
        "strands", "over", *_HEADS, title="Strands against the true ones: precision / recall / F, %"
    )
    for over in ("visible", "all"):
        for at, how in (("", ""), ("equal_length", ", at equal length")):
            for name, figures in rows.items():
                scores = figures.get(at, {}) if at else figures
                if over in scores:
                    table.add_row(name, over + how, *_cells(scores[over]))
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
    regions = Table("part of the hair", *_HEADS, title="Precision / recall / F by part, %")
    for kind in figures["regions"].values():
        for name, scores in kind.items():
            regions.add_row(name, *_cells(scores))
    more = Table("", "predicted", "true", title="Strands")
    for name, value in _STRAND_ROWS:
        cells = [value(figures, which) for which in ("pred", "true")]
        if any(cells):
            more.add_row(name, *cells)
    rows = {"as lines": figures, "root to tip": figures["directed"]}
    if "true_directions" in figures:
        rows["true directions"] = figures["true_directions"]
    table = geometry_table(rows)
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
