"""What people write about themselves: names and sentences that read as what they are.

A name is shown to others as who steers, who has looked, who answers for flashes. Characters that do
not show, or that change how what stands beside them reads, would let it pass for another's.
"""

from __future__ import annotations

import unicodedata

from pydantic import AfterValidator

UNSEEN = {0x034F, 0x115F, 0x1160, 0x17B4, 0x17B5, *range(0x180B, 0x1810), 0x2800, 0x3164, 0xFFA0}
UNSEEN |= {*range(0xFE00, 0xFE10), *range(0xE0000, 0xE1000)}
"""Letters and marks that show nothing: Unicode's Default_Ignorable_Code_Point that are in none of
the categories below, and the blank pattern of Braille."""
REFUSED = {
    "Cc": "a control character",
    "Cf": "an invisible character, or one that reverses text",
    "Cn": "a character that this service does not know",
    "Co": "a character of private use",
    "Cs": "half a character",
    "Zl": "a line separator",
    "Zp": "a paragraph separator",
}
"""Unicode categories that no name has."""
CONTROLS = {"\0": "NULL", "\b": "BACKSPACE", "\t": "TAB", "\n": "LINE FEED", "\r": "RETURN"}
CONTROLS |= {"\x1b": "ESCAPE", "\x7f": "DELETE"}
"""Control characters have no names in Unicode; these are those of keys and terminals."""


def _checked(text: str, allowed: str) -> str:
    for character in text:
        category = unicodedata.category(character)
        why = "an invisible character" if ord(character) in UNSEEN else REFUSED.get(category)
        if why is not None and character not in allowed:
            name = unicodedata.name(character, CONTROLS.get(character, ""))
            shown = f"U+{ord(character):04X}" + (f" ({name})" if name else "")
            raise ValueError(f"has {shown}, {why}: leave it out")
    if not any(unicodedata.category(c)[0] in "LNPS" for c in text):
        raise ValueError("shows nothing: write a name, or what is to be said")
    return text


ONE_LINE = AfterValidator(lambda text: _checked(text, ""))
"""Of a person's name. Stands behind the limits of its length."""
LINES = AfterValidator(lambda text: _checked(text.replace("\r\n", "\n"), "\n"))
"""Of what a person says, which may have several lines."""
