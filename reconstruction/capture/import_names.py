"""File names of an import: the fields of a pattern, and the rig's names in them."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from reconstruction.capture.import_settings import FIELDS, ImportProblem, ImportSettings
from reconstruction.capture.light_patterns import LightPatterns
from reconstruction.files.encoded import FORMATS, PictureError
from reconstruction.files.pictures import exposure_of
from reconstruction.geometry.rig import Rig


@dataclass(frozen=True)
class Match:
    """A file and the fields of its name."""

    path: Path
    camera: str
    light: str | None
    pattern: str | None
    projector: str | None
    row: int | None
    number: int | None
    exposure: float

    @property
    def shot(self) -> tuple[Any, ...]:
        """Identifies a step over cameras and exposures; sorts by time."""
        order = -1 if self.number is None else self.number
        row = -1 if self.row is None else self.row
        return order, self.projector or "", row, self.pattern or ""


def few(names: Sequence[str]) -> str:
    """The first three of them, for a message."""
    return ", ".join(names[:3]) + (", …" if len(names) > 3 else "")


class Names:
    """The names of a rig in file names; `sensitivities` of the files whose exposure was read."""

    def __init__(self, rig: Rig, settings: ImportSettings, lit_by: LightPatterns | None) -> None:
        self.cameras = [c.name for c in rig.cameras]
        self.lights = [x.name for x in rig.lights]
        self.patterns = list(lit_by.names) if lit_by else []
        self.projectors = [p.name for p in rig.projectors]
        self._settings = settings
        self.sensitivities: set[str] = set()

    def matching(self, role: str, pattern: str, names: Mapping[str, Path]) -> list[Match]:
        """Files matching `pattern`. Raises `ImportProblem` if a required field is missing."""
        needed = {"olat": {"camera", "light"}, "scanline": {"camera", "projector", "row"}}
        needed["pattern"] = {"camera", "pattern"}
        given = {"camera": self.cameras, "projector": self.projectors}
        fields = set(re.findall(r"{(.*?)}", pattern))
        where = f"pictures.{role} = {pattern!r}"
        if unknown := fields - set(FIELDS):
            raise ImportProblem(
                f"{where}: unknown fields {sorted(unknown)}; expected some of {list(FIELDS)}"
            )
        alone = {f for f, names in given.items() if len(names) == 1}
        if missing := needed.get(role, {"camera"}) - fields - alone:
            raise ImportProblem(f"{where}: the fields {' and '.join(sorted(missing))} are required")
        expression = re.compile(self.expression(pattern))
        found = ((path, expression.fullmatch(name)) for name, path in names.items())
        timed = role not in ("flat", "hair", "subject")
        read = [self._read(path, match.groupdict(), timed) for path, match in found if match]
        return [m for m in read if m is not None]

    def expression(self, pattern: str) -> str:
        """The regular expression of `pattern`."""
        number = r"\d+"
        kinds = {
            "camera": _any_of([*self.cameras, _numbered("cam(?:era)?", self.cameras)], 1),
            "light": _any_of([*self.lights, _numbered("light", self.lights)], 1)
            if self.lights
            else "[^/]+?",
            "pattern": _any_of([*self.patterns, _numbered("pattern", self.patterns)], 1),
            "projector": _any_of([*self.projectors, _numbered("proj", self.projectors)], 1),
            "exposure": _any_of(
                [*self._settings.exposures, r"\d+[-_]\d+|\d+(?:\.\d+)?(?:e-?\d+)?"], 1
            ),
            "row": number,
            "number": number,
        }
        out, used = "", set()
        for part in re.split(r"({.*?}|\*)", pattern):
            if part == "*":
                out += "[^/]*"
            elif part.startswith("{"):
                name = part[1:-1]
                out += f"(?P={name})" if name in used else f"(?P<{name}>{kinds[name]})"
                used.add(name)
            else:
                out += re.escape(part)
        return out

    def _read(self, path: Path, fields: Mapping[str, str], timed: bool) -> Match | None:
        """None for a number that the rig does not have; `timed`: the exposure is needed."""
        camera = (
            self._name(fields.get("camera"), self.cameras)
            if "camera" in fields
            else self.cameras[0]
        )
        light = self._light(fields["light"]) if "light" in fields else None
        pattern = self._name(fields.get("pattern"), self.patterns)
        projector = self._name(fields.get("projector"), self.projectors)
        if "row" in fields and "projector" not in fields:
            projector = self.projectors[0]
        if camera is None or (light is None and "light" in fields):
            return None
        if any(
            x is None and f in fields for f, x in (("pattern", pattern), ("projector", projector))
        ):
            return None
        row, number = (int(fields[f]) if f in fields else None for f in ("row", "number"))
        exposure = self._settings.exposure
        if "exposure" in fields:
            exposure = self._seconds(fields["exposure"])
        elif exposure == "file":
            exposure = self._seconds_in(path) if timed else 1.0
        return Match(path, camera, light, pattern, projector, row, number, exposure)

    def _light(self, text: str) -> str | None:
        first, number = self._settings.first_light, re.search(r"\d+$", text)
        if first is None or number is None or (text in self.lights and not text.isdigit()):
            return self._name(text, self.lights)
        index = int(number[0]) - first
        return self.lights[index] if 0 <= index < len(self.lights) else None

    def _name(self, text: str | None, names: list[str]) -> str | None:
        if text is None or text in names:
            return text
        word, number = _split(text)
        numbered = [(n, *_split(n)) for n in names if n[-1:].isdigit()]
        own = {word} & {w for _, w, _ in numbered}
        same = [n for n, w, k in numbered if k == number and (not own or w == word)]
        return same[0] if len(same) == 1 else None

    def _seconds(self, text: str) -> float:
        if text in self._settings.exposures:
            return self._settings.exposures[text]
        above, _, below = text.replace("_", "-").partition("-")
        whole = "e" not in text and bool(below)
        value = (
            float(above) / float(below)
            if whole and float(below)
            else float(text if not whole else 0)
        )
        if not value > 0:
            raise ImportProblem(
                f"{{exposure}} = {text!r}: seconds above 0, or a name of `exposures`"
            )
        return value

    def _seconds_in(self, path: Path) -> float:
        try:
            seconds, sensitivity = exposure_of(path)
        except PictureError as error:
            raise ImportProblem(str(error)) from error
        self.sensitivities.add(sensitivity)
        return seconds

    def notes(self) -> list[str]:
        """Differences between exposures that are not corrected."""
        if len(self.sensitivities) < 2:
            return []
        several = few(sorted(self.sensitivities))
        return [f"images differ in ISO or aperture ({several}): only exposure times are corrected"]

    def why_none(self, folder: Path, pattern: str, names: Mapping[str, Path]) -> str:
        """Why no file is an image that is needed."""
        pictures = [n for n, p in names.items() if p.suffix.lower() in FORMATS]
        if not pictures:
            return f"{folder}: no images ({' '.join(sorted(FORMATS))})"
        lights = f" and a light of {few(self.lights)}" if self.lights else ""
        lights = f" and a pattern of {few(self.patterns)}" if self.patterns else lights
        way = "" if lights else ", or lights (lights.json, --lights) if each shows one"
        return (
            f"{folder}: no file matches {pattern!r} with a camera of {few(self.cameras)}{lights}; "
            f"found {few(pictures)}: give --pictures a pattern{way}"
        )


def _split(name: str) -> tuple[str, int]:
    """A name that ends in a number, without it, and the number."""
    word = name.rstrip("0123456789")
    return word, int(name[len(word) :])


def _numbered(kind: str, names: Sequence[str]) -> str:
    """A regular expression for a number, alone or after `kind` or the words of `names`: 7, 07 and
    light_7 for light_07."""
    words = sorted({re.escape(_split(n)[0]) for n in names if n[-1:].isdigit()})
    return rf"(?:{'|'.join([*words, rf'(?i:{kind})[ _-]?'])})?\d+"


def _any_of(choices: Sequence[str], plain: int) -> str:
    """A regular expression for one of `choices`; the last `plain` are expressions themselves."""
    names = sorted(choices[:-plain], key=len, reverse=True)
    return "|".join([*map(re.escape, names), *choices[-plain:]])
