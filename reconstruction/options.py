"""Options: frozen dataclasses validated by pydantic."""

from __future__ import annotations

from collections.abc import Mapping
from functools import wraps
from inspect import signature
from typing import Annotated, Any, TypeVar, dataclass_transform

from pydantic import ConfigDict, Field, TypeAdapter, ValidationError
from pydantic.dataclasses import dataclass

T = TypeVar("T")
Count = Annotated[int, Field(gt=0)]


class BadOptions(ValueError):
    """Invalid options; one sentence for each invalid field, with its path."""


@dataclass_transform(frozen_default=True)
def options(cls: type[T]) -> type[T]:
    """Make `cls` a frozen dataclass of options.

    Unknown fields, NaN, infinity and values outside a field's annotated range (as
    `Annotated[float, Field(gt=0)]`) raise pydantic's `ValidationError` with the field's path, also
    for positional arguments.
    """
    config = ConfigDict(extra="forbid", allow_inf_nan=False)
    made: type[T] = dataclass(frozen=True, config=config)(cls)  # type: ignore[assignment]
    names, checked = list(signature(made).parameters), made.__init__

    @wraps(checked)
    def named(self: T, *values: Any, **fields: Any) -> None:
        known = dict(zip(names, values, strict=False))
        checked(self, *values[len(known) :], **known, **fields)

    made.__init__ = named  # type: ignore[method-assign, assignment]
    return made


def parse_options(kind: type[T], values: Mapping[str, Any], place: str = "options") -> T:
    """`kind` from JSON-like `values`; raises `BadOptions` with paths below `place`."""
    try:
        return TypeAdapter(kind).validate_python(dict(values))
    except ValidationError as error:
        raise BadOptions(sentence(error, place)) from error


def sentence(error: ValidationError, place: str = "") -> str:
    """Path below `place`, reason and value of each invalid field."""
    above = (place,) if place else ()
    return "; ".join(
        f"{'.'.join(map(str, (*above, *e['loc'])))}: {e['msg']}"
        + (f", got {e['input']!r}" if isinstance(e["input"], bool | int | float | str) else "")
        for e in error.errors()
    )
