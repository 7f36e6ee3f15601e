"""Old names of keys, fields and options that users may still have, read until 0.3.

`RENAMED` is the only table of them, `with_new_names` and `with_new_options` its only readers.
"""

from __future__ import annotations

import logging
from collections.abc import Iterable, Mapping, Sequence
from functools import cache
from typing import Any

REMOVED_IN = "0.3"
RENAMED: dict[str, dict[str, str]] = {
    # kind of document, as a message names it: {old name: new name}
    "refine": {"worth": "marginal_coverage"},
}

_log = logging.getLogger(__name__)


class BothNamesError(ValueError):
    """A document has a key under its old and its new name."""


def with_new_names(kind: str, document: Mapping[str, Any]) -> dict[str, Any]:
    """A copy of `document` with the old keys of its kind replaced by the new ones.

    One warning is logged for each old key and process. Nested mappings are documents of their own.

    Raises:
        BothNamesError: if a key is there under both names.
    """
    names = _new_names(kind, document)
    return {names.get(key, key): value for key, value in document.items()}


def with_new_options(command: str, arguments: Sequence[str]) -> list[str]:
    """Command-line `arguments` with old options (`--old`, `--old=3`) replaced by new ones.

    `command` is the kind in `RENAMED`. Raises `BothNamesError` as `with_new_names` does.
    """
    end = arguments.index("--") if "--" in arguments else len(arguments)
    split = [argument.partition("=") for argument in arguments[:end]]
    names = _new_names(command, [option for option, _, _ in split])
    replaced = [names.get(option, option) + sign + value for option, sign, value in split]
    return [*replaced, *arguments[end:]]


def _new_names(kind: str, keys: Iterable[str]) -> dict[str, str]:
    """Old name: new name, of the old names among `keys`."""
    table, found = RENAMED.get(kind, {}), set(keys)
    names = {old: new for old, new in table.items() if old in found}
    for old, new in names.items():
        if new in found:
            raise BothNamesError(
                f"{kind}: found both {old!r} and {new!r}; {old!r} is the old name of {new!r}:"
                f" remove {old!r}"
            )
        _warn(kind, old, new)
    return names


@cache
def _warn(kind: str, old: str, new: str) -> None:
    _log.warning(
        "%s: %r is now called %r; the old name is read until %s", kind, old, new, REMOVED_IN
    )
