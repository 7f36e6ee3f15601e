"""Old names of keys that users may still have, read until 0.3.

`RENAMED` is the only table of them, `with_new_names` and `new_name` its only readers.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping
from functools import cache
from typing import Any

REMOVED_IN = "0.3"
RENAMED: dict[str, dict[str, str]] = {
    # kind of document, as a message names it: {old name: new name}
    "refine": {"worth": "marginal_coverage"},
    "options": {"inverse_rendering.fit.variant": "stages"},
    "pipeline": {"appearance": "fit", "fields": "fit"},
    "hairstage fit": {"--method": "--stages", "--field": "--stages field"},
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
    names = {old: new_name(kind, old) for old in RENAMED.get(kind, {}) if old in document}
    for old, new in names.items():
        if new in document:
            raise BothNamesError(
                f"{kind}: found both {old!r} and {new!r}; {old!r} is the old name of {new!r}:"
                f" remove {old!r}"
            )
    return {names.get(key, key): value for key, value in document.items()}


def new_name(kind: str, name: str) -> str:
    """The new name of an old one, with a warning; `name` itself if it is not old."""
    new = RENAMED.get(kind, {}).get(name)
    if new is None:
        return name
    _warn(kind, name, new)
    return new


@cache
def _warn(kind: str, old: str, new: str) -> None:
    _log.warning(
        "%s: %r is now called %r; the old name is read until %s", kind, old, new, REMOVED_IN
    )
