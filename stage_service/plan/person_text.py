"""Checks of names and sentences that people type in.

A name is shown as who steers, has looked, or armed flashes. Invisible characters, and those that
reorder text, would let it look like another person's.
"""

from __future__ import annotations

import unicodedata

from pydantic import AfterValidator

UNSEEN = {0x034F, 0x115F, 0x1160, 0x17B4, 0x17B5, *range(0x180B, 0x1810), 0x2800, 0x3164, 0xFFA0}
UNSEEN |= {*range(0xFE00, 0xFE10), *range(0xE0000, 0xE1000)}
"""Invisible letters and marks: Unicode's Default_Ignorable_Code_Point outside the categories below,
and the blank pattern of Braille."""
REFUSED = {
    "Cc": "a control character",
    "Cf": "an invisible character, or one that reverses text",
    "Cn": "an unassigned character",
    "Co": "a character of private use",
    "Cs": "half a character",
    "Zl": "a line separator",
    "Zp": "a paragraph separator",
}
"""Refused Unicode categories."""
CONTROLS = {"\0": "NULL", "\b": "BACKSPACE", "\t": "TAB", "\n": "LINE FEED", "\r": "RETURN"}
CONTROLS |= {"\x1b": "ESCAPE", "\x7f": "DELETE"}
"""Names of control characters, which have none in Unicode."""


def _checked(text: str, allowed: str) -> str:
    for character in text:
        category = unicodedata.category(character)
        why = "an invisible character" if ord(character) in UNSEEN else REFUSED.get(category)
        if why is not None and character not in allowed:
            name = unicodedata.name(character, CONTROLS.get(character, ""))
            shown = f"U+{ord(character):04X}" + (f" ({name})" if name else "")
            raise ValueError(f"has {shown}, {why}: leave it out")
    if not any(unicodedata.category(c)[0] in "LNPS" for c in text):
        raise ValueError("has no visible character: write a name or a sentence")
    return text


ONE_LINE = AfterValidator(lambda text: _checked(text, ""))
"""For a person's name; after the limits of its length."""
LINES = AfterValidator(lambda text: _checked(text.replace("\r\n", "\n"), "\n"))
"""For a person's statement, which may have several lines."""
