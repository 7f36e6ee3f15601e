"""Safe reading of untrusted JSON."""

from __future__ import annotations

import codecs
import json
import math
import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from reconstruction.containment import plain_file

DEEPEST = 40
"""Levels of nested arrays and objects."""
_UNFIT = re.compile(r"\\u(?:0000|[dD][89a-fA-F])")


def read_json(path: str | Path) -> Any:
    """The value of a JSON file, as `parse_json`. Raises `OSError`, and `ValueError` naming it."""
    data = plain_file(path).read_bytes()
    try:
        return parse_json(data)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error


def read_text(path: str | Path, otherwise: str | None = None) -> str:
    """The text of a file in UTF-8, or in UTF-16 by its byte order mark, else in `otherwise`.

    A byte order mark and a DOS end of file are left out. Raises `OSError`, and `ValueError` naming
    the file if it is not text.
    """
    data = plain_file(path).read_bytes().rstrip(b"\x1a")
    encoding = "utf-16" if data[:2] in (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE) else "utf-8-sig"
    try:
        return data.decode(encoding)
    except UnicodeDecodeError as error:
        if otherwise is not None:
            return data.decode(otherwise)
        raise ValueError(f"{path}: not text in UTF-8 ({error})") from error


def parse_json(data: bytes | str) -> Any:
    """A JSON text in UTF-8 as RFC 7493 (I-JSON) restricts it.

    Raises `ValueError` for NaN, Infinity and numbers beyond float64, lone surrogates and NUL,
    duplicate names, and more than `DEEPEST` levels.
    """
    text = data.decode("utf-8-sig") if isinstance(data, bytes) else data
    try:
        value = json.loads(
            text, parse_constant=_refuse, parse_float=_finite, object_pairs_hook=_distinct
        )
        if text.count("[") + text.count("{") > DEEPEST and _depth(value) > DEEPEST:
            raise ValueError(f"more than {DEEPEST} levels within each other")
    except RecursionError:
        raise ValueError(f"more than {DEEPEST} levels within each other") from None
    if _UNFIT.search(text) or not text.isascii():
        for string in _strings(value):
            if string != printable(string) or "\0" in string:
                raise ValueError(f"a text that is not Unicode, or has NUL: {string!r}")
    return value


def printable(text: str) -> str:
    """`text` with lone surrogates, as in file names that are not UTF-8, escaped."""
    return text.encode("utf-8", "backslashreplace").decode()


def _refuse(name: str) -> float:
    raise ValueError(f"{name} is not a number")


def _finite(text: str) -> float:
    if not math.isfinite(number := float(text)):
        raise ValueError(f"{text} is beyond float64")
    return number


def _distinct(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) < len(pairs):
        names = [name for name, _ in pairs]
        twice = sorted({name for name in names if names.count(name) > 1})
        raise ValueError(f"an object has {twice[:5]} twice")
    return found


def _inside(value: Any) -> Iterable[Any]:
    if isinstance(value, dict):
        return value.values()
    return value if isinstance(value, list) else ()


def _depth(value: Any) -> int:
    levels, depth = [value], 0
    while levels := [v for v in levels if isinstance(v, dict | list)]:
        levels, depth = [x for v in levels for x in _inside(v)], depth + 1
    return depth


def _strings(value: Any) -> Iterable[str]:
    todo = [value]
    while todo:
        here = todo.pop()
        if isinstance(here, str):
            yield here
        elif isinstance(here, dict):
            yield from here
        todo.extend(_inside(here))
