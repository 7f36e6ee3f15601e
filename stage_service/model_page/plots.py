"""The page's plots as inline SVG and bars; colours are the style sheet's."""

from __future__ import annotations

import math
from collections.abc import Sequence

from reconstruction.report.report import Series, Stage
from stage_service.model_page.html import Html, element, heading, number, seconds, words

WIDTH, HEIGHT = 520, 250
LEFT, RIGHT, TOP, BOTTOM = 64, 12, 12, 34
COLOURS = 6
"""Classes c0, c1, … of the style sheet."""


def time_bars(stages: Sequence[Stage]) -> Html:
    """A row for each stage: seconds as a bar, share, peak memory."""
    longest = max((s.seconds for s in stages), default=0.0) or 1.0
    total = sum(s.seconds for s in stages) or 1.0
    rows = []
    for stage in stages:
        share = stage.seconds / longest
        bar = element("span", class_="bar", style=f"width:{100 * share:.2f}%")
        memory = "" if stage.peak_gb is None else f"{stage.peak_gb:.2f} GB"
        rows.append(
            element(
                "tr",
                element("th", words(stage.name), scope="row"),
                element("td", bar, class_="bars"),
                element("td", seconds(stage.seconds), class_="n"),
                element("td", f"{stage.seconds / total:.0%}", class_="n"),
                element("td", memory, class_="n"),
            )
        )
    heads = ("stage", "", "time", "share", "peak memory")
    top = element("tr", *map(heading, heads))
    inner = element("table", element("thead", top), element("tbody", *rows))
    return element("div", inner, class_="wide time")


def error_plots(stage: Stage) -> list[Html]:
    """Error against run time on logarithmic axes, a figure for each kind of error."""
    out = []
    drawn = [s for s in stage.series if any(e > 0 for _, e in s.points)]
    for kind in dict.fromkeys(s.error for s in drawn):
        members = [s for s in drawn if s.error == kind]
        title = f"{words(stage.name)}: {words(kind)} against run time"
        out.append(
            element(
                "figure",
                _log_log(members, title),
                element("figcaption", element("b", title), *_legend(members)),
            )
        )
    return out


def _legend(members: Sequence[Series]) -> list[Html]:
    names = [
        element("span", words(s.name), class_=f"key c{k % COLOURS}") for k, s in enumerate(members)
    ]
    return [element("span", *names, class_="keys")]


def _log_log(members: Sequence[Series], title: str) -> Html:
    times = [t for s in members for t, e in s.points if e > 0 and t > 0]
    errors = [e for s in members for _, e in s.points if e > 0]
    # a logarithmic axis has no zero: what was there from the start is drawn at its left end
    start = 0.5 * min(times, default=2e-3)
    at_once = any(t <= 0 for s in members for t, e in s.points if e > 0)
    x0, x1 = _limits([start, *times] if at_once or not times else times)
    y0, y1 = _limits(errors)

    def x(t: float) -> float:
        share = (math.log10(t if t > 0 else start) - x0) / (x1 - x0)
        return LEFT + share * (WIDTH - LEFT - RIGHT)

    def y(e: float) -> float:
        return HEIGHT - BOTTOM - (math.log10(e) - y0) / (y1 - y0) * (HEIGHT - TOP - BOTTOM)

    parts: list[Html] = [element("title", title)]
    base = HEIGHT - BOTTOM
    for tick in _ticks(x0, x1):
        at = f"{x(tick):.1f}"
        parts.append(element("line", x1=at, x2=at, y1=TOP, y2=base, class_="grid"))
        style = {"x": at, "y": base + 15, "text_anchor": "middle"}
        parts.append(element("text", number(tick), **style))
    for tick in _ticks(y0, y1):
        at = f"{y(tick):.1f}"
        parts.append(element("line", x1=LEFT, x2=WIDTH - RIGHT, y1=at, y2=at, class_="grid"))
        style = {"x": LEFT - 7, "y": at, "dy": "0.32em", "text_anchor": "end"}
        parts.append(element("text", number(tick), **style))
    style = {"x": WIDTH - RIGHT, "y": HEIGHT - 3, "text_anchor": "end"}
    parts.append(element("text", "seconds", **style))
    for k, s in enumerate(members):
        points = [(x(t), y(e)) for t, e in s.points if e > 0]
        colour = f"c{k % COLOURS}"
        line = " ".join(f"{a:.1f},{b:.1f}" for a, b in points)
        parts.append(element("polyline", points=line, class_=colour))
        if len(points) <= 25:
            parts += [
                element("circle", cx=f"{a:.1f}", cy=f"{b:.1f}", r="2.6", class_=colour)
                for a, b in points
            ]
    return element("svg", *parts, viewBox=f"0 0 {WIDTH} {HEIGHT}", role="img", aria_label=title)


def _limits(values: Sequence[float]) -> tuple[float, float]:
    low, high = math.log10(min(values)), math.log10(max(values))
    pad = max(0.04 * (high - low), 0.03)
    return low - pad, high + pad


def _ticks(low: float, high: float) -> list[float]:
    """Decades; where there are too few of them, 2 and 5 between, or a few even steps."""
    decades = range(math.floor(low), math.ceil(high) + 1)
    for digits in ((1,), (1, 3), (1, 2, 5), tuple(range(1, 10))):
        found = [
            d * 10.0**k for k in decades for d in digits if low <= math.log10(d * 10.0**k) <= high
        ]
        if len(found) >= 3:
            return found[:: -(-len(found) // 7)]
    steps = (low + (high - low) * (i + 0.5) / 3 for i in range(3))
    return [float(f"{10**s:.3g}") for s in steps]
