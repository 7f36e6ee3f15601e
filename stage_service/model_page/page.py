"""The page's parts from top to bottom."""

from __future__ import annotations

import shlex
from collections.abc import Iterator, Mapping, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

from reconstruction import Model
from reconstruction.model import FILES
from reconstruction.report.report import Report
from stage_service.model_page.html import (
    Html,
    element,
    flat,
    joined,
    link,
    number,
    size,
    table,
    words,
)
from stage_service.model_page.html import seconds as time_text
from stage_service.model_page.material import material, material_files
from stage_service.model_page.names import (
    GROUPS,
    HERO,
    OF_TRUTH,
    PICTURES,
    SHOWN,
    STRAND_FIGURES,
    STRANDS,
    consistency_cells,
    strand_cells,
    threshold,
)
from stage_service.model_page.plots import error_plots, time_bars

PAGE = "index.html"


def write_page(model: Model, label: str = "") -> Path:
    """Write the `index.html` of `model`, see `model_page`; returns its path."""
    with model.writing(PAGE) as part:
        part.write_text(model_page(model, label), encoding="utf-8")
    return model.file(PAGE)


def model_page(model: Model, label: str = "") -> Html:
    """The page of `model`; `label` stands under its name, by default that of its results."""
    report = model.report()
    results = model.json("results.json") if model.has("results.json") else {}
    label = label or results.get("label", "")
    name = model.path.resolve().name
    warnings = [(s.name, w) for s in report.stages for w in s.warnings]
    parts = {
        "Result": _result(model),
        f"Warnings ({len(warnings)})": _warnings(report, warnings),
        "Scores": _quality(model, results),
        "Pictures": _pictures(model),
        "Time": _time(report),
        "Skipped work": _left_out(report),
        "All figures": _figures(report),
        "Files": _files(model),
    }
    shown = {title: content for title, content in parts.items() if content}
    marks = {title: title.split(" (")[0].lower().replace(" ", "-") for title in shown}
    menu = [element("a", title, href=f"#{marks[title]}") for title in shown]
    sections = [
        element("section", element("h2", title), content, id=marks[title])
        for title, content in shown.items()
    ]
    head = element(
        "head",
        element("meta", charset="utf-8"),
        element("meta", name="viewport", content="width=device-width, initial-scale=1"),
        element("meta", name="referrer", content="no-referrer"),
        element("title", f"{name} · hairstage"),
        element("style", Html(Path(__file__).with_name("style.css").read_text(encoding="utf-8"))),
    )
    top = element(
        "header",
        element("p", "hairstage model", class_="kind"),
        element("h1", name),
        *([element("p", label)] if label else []),
        element("nav", *menu, aria_label="parts of this page"),
    )
    foot = element("footer", f"Written by hairstage {version('hairstage')}.")
    body = element("body", top, element("main", *sections), foot)
    return joined([Html("<!doctype html>\n"), element("html", head, body, lang="en"), Html("\n")])


def _result(model: Model) -> Html:
    """Strands and material, with their files."""
    if not model.has("strands.npz"):
        return element("p", "There are no strands yet: the reconstruction has not finished.")
    strands, name = model.strands(), shlex.quote(model.path.resolve().name)
    lengths = strands.lengths()
    facts = [
        ("strands", [element("b", f"{len(strands):,}"), f" of {len(strands.points):,} points"])
    ]
    if len(strands):
        facts.append(
            (
                "length",
                [
                    element("b", f"{lengths.sum():,.0f} m"),
                    f" in all; a strand {1e3 * _middle(lengths):.0f} mm, median",
                ],
            )
        )
        radius = 1e6 * _middle(strands.radius)
        facts.append(("radius", [element("b", f"{radius:.0f} µm"), _coverage_note(radius)]))
    facts += [*_fitted_head(model), *material(model)]
    rows = [joined([element("dt", what), element("dd", *text)]) for what, text in facts]
    text = joined(
        [
            element(
                "p",
                "The result is ",
                link("strands.usdc" if model.has("strands.usdc") else "strands.npz"),
                " with ",
                *material_files(model),
                ". The other sections have scores, warnings and timings.",
                class_="lead",
            ),
            element("dl", *rows),
            element(
                "p",
                "To view it in a browser: ",
                element("code", f"hairstage view {name}"),
                ". For other programs: ",
                element("code", f"hairstage export {name} --to blender --out FOLDER"),
                class_="quiet",
            ),
        ]
    )
    hero = next((p for p in HERO if model.has(p)), None)
    if hero is None:
        return text
    picture = element("img", src=hero, alt=FILES[hero])
    return element("div", link(hero, picture), element("div", text), class_="hero")


def _fitted_head(model: Model) -> Iterator[tuple[str, list[str]]]:
    """The source of a fitted head, and the residual of its fit."""
    fit = next((s.figures for s in model.report().stages if s.name == "head"), {})
    if model.has("head.obj") and {"template", "source", "rms_mm"} <= set(fit):
        rms = f"{fit['rms_mm']:.1f} mm rms"
        yield (
            "head",
            [link("head.obj"), f": the {fit['template']} fitted to {fit['source']}, {rms}"],
        )


def _coverage_note(radius: float) -> str:
    if radius > 60:
        return ", above that of hair (20 to 60 µm), because fewer strands cover the same head"
    return ""


def _middle(values: Any) -> float:
    ordered = sorted(values.tolist()) if getattr(values, "ndim", 0) else [float(values)]
    return float(ordered[len(ordered) // 2])


def _warnings(report: Report, warnings: Sequence[tuple[str, str]]) -> Html:
    if not report.stages:
        return Html("")
    if not warnings:
        return element("p", "No stage reported a warning.")
    rows = [element("li", element("b", words(stage)), " ", text) for stage, text in warnings]
    return element("ul", *rows, class_="warnings")


def _quality(model: Model, results: Mapping[str, Any]) -> Html:
    """Scores against truth, baselines and held-out frames, if there are any."""
    parts = []
    if "geometry" in results:
        found = {"ours": results["geometry"], **results.get("baselines", {})}
        parts += [
            element("h3", "Strands against the true ones: precision / recall / F, %"),
            _strand_table(found),
        ]
    if any(group in results.get("images", {}) for group in GROUPS):
        parts += [
            element("h3", "Images: PSNR, SSIM and relative error on the hair"),
            _picture_table(results["images"]),
            element("p", "Means over the images of each group.", class_="quiet"),
        ]
    if "appearance" in results:
        parts += [element("h3", "Appearance"), _appearance_table(results["appearance"])]
    if not parts:
        return Html("")
    note = (
        "One run: the spread over seeds is not known. "
        "To compare several runs: hairstage bench demo --results RESULTS…"
    )
    return joined([*parts, element("p", note, class_="quiet")])


def _strand_table(found: Mapping[str, Any]) -> Html:
    first = next(iter(found.values()))
    heads = [threshold(t) for t in next(iter(first[p] for p in ("visible", "all") if p in first))]
    rows = []
    for over in ("visible", "all"):
        for at, how in (("", ""), ("equal_length", ", at equal length")):
            for name, figures in found.items():
                scores = figures.get(at, {}) if at else figures
                if over in scores:
                    cells = [
                        " / ".join(f"{100 * s[k]:.1f}" for k in ("precision", "recall", "f"))
                        for s in scores[over].values()
                    ]
                    rows.append([f"{over} points{how}", _ours(name, STRANDS), *cells])
    for name, figures in found.items():
        if cells := consistency_cells(figures):
            rows.append(["strand consistency", _ours(name, STRANDS), *cells])
    scored = table(["", "", *heads], rows, "figures")
    if "lengths" not in first:
        return scored  # of an earlier version
    rows = [
        [_ours(name, STRANDS), *strand_cells(figures)]
        for name, figures in found.items()
        if "lengths" in figures
    ]
    truth = strand_cells(first, [OF_TRUTH.get(title, ()) for title, *_ in STRAND_FIGURES])
    heads = [title for title, *_ in STRAND_FIGURES]
    whole = table(["", *heads], [*rows, ["the truth", *truth]], "figures")
    note = (
        "More strands raise recall: at equal length a random subset of the predicted strands has "
        "the true total length."
    )
    return joined([scored, whole, element("p", note, class_="quiet")])


def _picture_table(images: Mapping[str, Any]) -> Html:
    heads, rows = [words(g) for g in GROUPS if g in images], []
    for name in PICTURES:
        cells = []
        for found in (images[g].get(name) for g in GROUPS if g in images):
            text = "–"
            if found is not None:
                text = f"{found['psnr']:.1f} dB / {found['ssim']:.2f}"
                if "relative_error" in found:
                    text += f" / {found['relative_error']:.2f}"
            cells.append(text)
        if set(cells) != {"–"}:
            rows.append([_ours(name, PICTURES), *cells])
    return table(["", *heads], rows, "figures")


def _appearance_table(fits: Mapping[str, Mapping[str, Any]]) -> Html:
    names = {key: None for figures in fits.values() for key in figures}
    rows = []
    for key in names:
        show = _shares if key.endswith("_error") else _numbers
        cells = (show(figures[key]) if key in figures else "–" for figures in fits.values())
        rows.append([words(key), *cells])
    return table(["", *(PICTURES.get(n, words(n)) for n in fits)], rows, "figures")


def _ours(name: str, titles: Mapping[str, str]) -> str:
    title = titles.get(name, words(name))
    return element("b", title) if name == "ours" else title


def _shares(value: Any) -> str:
    """Standard errors of logarithms, in per cent."""
    values = value if isinstance(value, list) else [value]
    return ", ".join("unknown" if x is None else f"± {x:.1%}" for x in values)


def _numbers(value: Any) -> str:
    values = value if isinstance(value, list) else [value]
    return ", ".join(f"{x:.3g}" if isinstance(x, float) else number(x) for x in values)


def _pictures(model: Model) -> Html:
    figures = [
        element(
            "figure",
            link(path, element("img", src=path, alt=text)),
            element("figcaption", element("b", path), " ", text),
        )
        for path, text in SHOWN.items()
        if model.has(path)
    ]
    return element("div", *figures, class_="pictures") if figures else Html("")


def _time(report: Report) -> Html:
    if not report.stages:
        return Html("")
    total = sum(s.seconds for s in report.stages)
    plots = [plot for stage in report.stages for plot in error_plots(stage)]
    return joined(
        [
            element("p", f"{time_text(total)} wall time in the stages of this model."),
            time_bars(report.stages),
            element("div", *plots, class_="plots") if plots else "",
        ]
    )


def _left_out(report: Report) -> Html:
    rows = [
        [words(stage.name), item.what, item.why, item.saved]
        for stage in report.stages
        for item in stage.left_out
    ]
    intro = "Work that this subject did not need, and its saving."
    ledger = table(["stage", "skipped", "reason", "saved"], rows)
    return joined([element("p", intro), ledger]) if rows else Html("")


def _figures(report: Report) -> Html:
    parts = [
        element(
            "details",
            element("summary", words(stage.name)),
            table(["", ""], flat(stage.figures), "figures"),
        )
        for stage in report.stages
        if stage.figures
    ]
    return joined(parts)


def _files(model: Model) -> Html:
    """All files with the description of `FILES`, folders expanded."""
    found = model.sizes()
    found.pop(PAGE, None)
    rows: list[list[str]] = []
    for name, what in FILES.items():
        inside = {p: n for p, n in found.items() if p == name or p.startswith(f"{name}/")}
        if not inside:
            continue
        total = size(sum(inside.values()))
        if name in inside:
            rows.append([link(name), what, total])
            continue
        each = [element("li", link(p, p.removeprefix(f"{name}/"))) for p in inside]
        summary = element("summary", f"{name}/: {len(inside)} files")
        rows.append([element("details", summary, element("ul", *each)), what, total])
    known = tuple(FILES)
    others = [p for p in found if p.split("/")[0] not in known]
    rows += [[link(p), "", size(found[p])] for p in others]
    return table(["file", "what it is", "size"], rows, "files")
