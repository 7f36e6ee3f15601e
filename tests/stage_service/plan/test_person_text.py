"""Names that hide who acts: characters by their place in the Unicode standard."""

from __future__ import annotations

from typing import Annotated

import pytest
from pydantic import TypeAdapter, ValidationError

from stage_service.plan.person_text import LINES, ONE_LINE

NAME, TEXT = TypeAdapter(Annotated[str, ONE_LINE]), TypeAdapter(Annotated[str, LINES])


@pytest.mark.parametrize(
    ("character", "said"),
    [
        ("\u200b", "ZERO WIDTH SPACE"),
        ("\u202e", "RIGHT-TO-LEFT OVERRIDE"),
        ("\u2066", "LEFT-TO-RIGHT ISOLATE"),
        ("\ufeff", "ZERO WIDTH NO-BREAK SPACE"),
        ("\u3164", "HANGUL FILLER"),
        ("\x1b", "ESCAPE"),
        ("\x00", "NULL"),
        ("\n", "LINE FEED"),
    ],
)
def test_a_name_with_a_character_that_does_not_show_is_refused_by_its_name(character, said):
    with pytest.raises(ValidationError, match=said):
        NAME.validate_python(f"A{character}da")


@pytest.mark.parametrize("name", ["Ada", "Zoë", "李", "O’Brien-Núñez", "عائشة", "Ada 2"])
def test_names_of_people_pass(name):
    assert NAME.validate_python(name) == name


def test_a_text_may_have_lines_and_a_blank_one_shows_nothing():
    assert TEXT.validate_python("agreed\non paper") == "agreed\non paper"
    with pytest.raises(ValidationError, match="RIGHT-TO-LEFT OVERRIDE"):
        TEXT.validate_python("agreed\u202e")
    with pytest.raises(ValidationError, match="no visible character"):
        NAME.validate_python(" \u00a0")
