"""HTML as values: text that is not `Html` is escaped."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from html import escape
from typing import Any
from urllib.parse import quote

VOID = {"img", "meta"}
SPREAD = ("p10", "p50", "p90")


class Html(str):
    """Text that is markup and is not escaped."""

    __slots__ = ()


def element(name: str, /, *content: str, **attributes: object) -> Html:
    """`<name attributes>content</name>`; in attribute names a trailing `_` is dropped, others
    become `-`; attributes of value None are skipped."""
    given = "".join(
        f' {key.rstrip("_").replace("_", "-")}="{escape(str(value))}"'
        for key, value in attributes.items()
        if value is not None
    )
    if name in VOID:
        return Html(f"<{name}{given}>")
    return Html(f"<{name}{given}>{joined(content)}</{name}>")


def joined(content: Iterable[str]) -> Html:
    """Concatenated pieces, escaped if plain text."""
    return Html("".join(c if isinstance(c, Html) else escape(c) for c in content))


def heading(text: str) -> Html:
    """A column's heading, or an empty cell."""
    return element("th", text, scope="col") if text else element("td")


def table(heads: Sequence[str], rows: Iterable[Sequence[str]], kind: str = "") -> Html:
    """A table that scrolls if it is too wide; empty without rows."""
    body = [element("tr", *(element("td", cell) for cell in row)) for row in rows]
    if not body:
        return Html("")
    top = element("tr", *map(heading, heads))
    parts = [element("thead", top)] if any(heads) else []
    inner = element("table", *parts, element("tbody", *body))
    return element("div", inner, class_=f"wide {kind}".strip())


def link(path: str, *content: str, class_: str | None = None) -> Html:
    """A link to a file of the page's folder."""
    return element("a", *(content or (path,)), href=quote(path), class_=class_)


def number(value: object) -> str:
    """A figure with four digits."""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, int):
        return f"{value:,}"
    if isinstance(value, float):
        if not math.isfinite(value):
            return "not finite"
        if value == 0 or 1e-3 <= abs(value) < 1e5:
            return f"{value:,.0f}" if abs(value) >= 1000 else f"{value:.4g}"
        digits, _, power = f"{value:.3e}".partition("e")
        times = "" if float(digits) == 1 else f"{float(digits):g} · "
        return f"{times}10{_raised(int(power))}"
    return "unknown" if value is None else str(value)


def words(name: str) -> str:
    """A field's name in words."""
    return name.replace("_", " ")


def seconds(value: float) -> str:
    """A duration as text."""
    if value >= 5400:
        return f"{int(value // 3600)} h {int(value % 3600 // 60)} min"
    if value >= 120:
        return f"{int(value // 60)} min {int(value % 60)} s"
    return f"{value:.0f} s" if value >= 10 else f"{value:.2g} s"


def size(count: int) -> str:
    """A number of bytes as text."""
    for unit, scale in (("GB", 1e9), ("MB", 1e6), ("kB", 1e3)):
        if count >= 0.9995 * scale:  # 999,999 B is 1 MB
            return f"{count / scale:.3g} {unit}"
    return f"{count} B"


def flat(figures: Mapping[str, Any], above: str = "") -> Iterator[tuple[str, str]]:
    """Nested figures as rows (name, value); spreads and short lists are one value."""
    for key, value in figures.items():
        name = f"{above} · {words(str(key))}" if above else words(str(key))
        if isinstance(value, Mapping) and set(SPREAD) <= set(value):
            low, middle, high = (number(value[k]) for k in SPREAD)
            yield name, f"{middle} ({low} to {high}: 10 to 90 %)"
        elif isinstance(value, Mapping) and value and all(map(_plain, value.values())):
            yield name, ", ".join(f"{words(str(k))} {number(v)}" for k, v in value.items())
        elif isinstance(value, Mapping):
            yield from flat(value, name)
        elif isinstance(value, list) and all(map(_plain, value)):
            more = f", … ({len(value)})" if len(value) > 8 else ""
            yield name, ", ".join(number(v) for v in value[:8]) + more
        elif isinstance(value, list):
            yield name, f"{len(value)} entries in report.json"
        else:
            yield name, number(value)


def _plain(value: object) -> bool:
    return not isinstance(value, Mapping | list)


def _raised(power: int) -> str:
    return str(power).translate(str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹"))
