"""Matching of files with frames by their names."""

from __future__ import annotations

import os
import re
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, get_args

from reconstruction.capture.import_settings import (
    FIELDS,
    PATTERN_IMAGES,
    PHOTOGRAPHS,
    ImportProblem,
    ImportSettings,
    Patterns,
)
from reconstruction.capture.light_patterns import LightPatterns
from reconstruction.capture.records import Step, StepKind
from reconstruction.files.encoded import FORMATS, RAW, PictureError
from reconstruction.files.lights import light_name
from reconstruction.files.pictures import LOSSY, exposure_of
from reconstruction.geometry.cameras import Camera
from reconstruction.geometry.rig import Rig

Bracket = dict[float, Path]
"""Files of one frame by exposure in seconds."""


@dataclass(frozen=True)
class Found:
    """Matched files: `frames` by step and camera; flats and masks by camera.

    `plates` are clean plates by light (None: all lights) and camera. `unmatched` are images without
    a pattern, relative to the folder.
    """

    steps: tuple[Step, ...]
    frames: Mapping[tuple[int, str], Bracket]
    plates: Mapping[tuple[str | None, str], Bracket]
    flats: Mapping[str, Path]
    hair: Mapping[str, Path]
    subjects: Mapping[str, Path]
    unmatched: tuple[str, ...]
    notes: tuple[str, ...]


@dataclass(frozen=True)
class _Match:
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


def find(
    folder: Path, settings: ImportSettings, rig: Rig, lit_by: LightPatterns | None = None
) -> Found:
    """Match all files in `folder` with the patterns and the names in `rig` and `lit_by`.

    Raises `ImportProblem` for an invalid pattern, no single-light image (for a rig without lights,
    no photograph; with `lit_by`, no image under a pattern), two files for one frame, or rows
    without an order among tracking frames.
    """
    names = {p.relative_to(folder).as_posix(): p for p in _files(folder)}
    reader, needed, patterns = _Names(rig, settings, lit_by), "olat", settings.pictures
    if lit_by is not None or not rig.lights:
        needed, places = ("all_on", PHOTOGRAPHS) if lit_by is None else ("pattern", PATTERN_IMAGES)
        patterns = _first_of(places, patterns, reader, names)
    matches: dict[str, list[_Match]] = {}
    used: set[Path] = set()
    for role in (f for f in vars(patterns) if getattr(patterns, f)):
        matches[role] = reader.matching(role, getattr(patterns, role), names)
        used |= {m.path for m in matches[role]}
    _check_order(patterns, matches)
    steps: list[Step] = []
    frames: dict[tuple[int, str], Bracket] = {}
    kinds: list[tuple[StepKind, tuple[Any, ...], list[_Match]]] = []
    shots = matches.get("olat", [])
    once = len({(m.light, m.camera, m.exposure) for m in shots}) == len(shots)
    for kind in get_args(StepKind):
        groups: dict[tuple[Any, ...], list[_Match]] = defaultdict(list)
        for match in matches.get(kind, []):
            if kind == "olat":  # lights captured once may be numbered per camera
                place = reader.lights.index(str(match.light))
                groups[(place,) if once else (place, *match.shot)].append(match)
            else:
                groups[match.shot].append(match)
        kinds += [(kind, key, group) for key, group in groups.items()]
    rank = {"dark": 0, "all_on": 1, "olat": 2, "pattern": 2, "tracking": 3, "scanline": 3}
    for kind, _, group in sorted(kinds, key=lambda k: (rank[k[0]], k[1], k[0])):
        first, longest = group[0], max(m.exposure for m in group)
        level = 0.0 if kind == "dark" else 1.0
        which = {"light": first.light, "projector": first.projector, "row": first.row}
        which |= {"pattern": first.pattern}
        step = Step(len(steps), kind, longest, level, **which)  # type: ignore[arg-type]
        steps.append(step)
        for camera, bracket in _brackets(group).items():
            frames[step.index, camera] = bracket
    if not any(s.kind == needed for s in steps):
        raise ImportProblem(reader.why_none(folder, getattr(patterns, needed), names))
    plates: dict[tuple[str | None, str], Bracket] = {}
    for light in {m.light for m in matches.get("clean_plate", [])}:
        of_light = [m for m in matches["clean_plate"] if m.light == light]
        plates |= {(light, camera): b for camera, b in _brackets(of_light).items()}
    single = {
        role: {c: next(iter(b.values())) for c, b in _brackets(matches.get(role, [])).items()}
        for role in ("flat", "hair", "subject")
    }
    left = [n for n, p in names.items() if p not in used and p.suffix.lower() in FORMATS]
    shot = {s.light for s in steps} | set(lit_by.lights if lit_by else ())
    without = sorted({c.name for c in rig.cameras} - {camera for _, camera in frames})
    bare = [f"{_few(without)}: no images, all frames are missing"] if without else []
    return Found(
        tuple(steps), frames, plates, single["flat"], single["hair"], single["subject"],
        tuple(left), (*bare, *_notes(rig, shot, used, settings, left), *reader.notes()),
    )  # fmt: skip


def light_names(folder: Path, settings: ImportSettings, cameras: Sequence[Camera]) -> list[str]:
    """What the images' names have for `{light}`, sorted, for a set without positions of lights."""
    reader = _Names(Rig(folder.name, tuple(cameras), ()), settings, None)
    names = {p.relative_to(folder).as_posix(): p for p in _files(folder)}
    others = {f: p for f, p in vars(settings.pictures).items() if p and f != "olat"}
    taken = {m.path for role, p in others.items() for m in reader.matching(role, p, names)}
    expression = re.compile(reader.expression(settings.pictures.olat))
    found = (expression.fullmatch(n) for n, p in names.items() if p not in taken)
    return sorted({str(light_name(m["light"])) for m in found if m})


def _first_of(
    defaults: Mapping[str, Sequence[str]],
    patterns: Patterns,
    reader: _Names,
    names: Mapping[str, Path],
) -> Patterns:
    """`patterns` of a set without single lights: `defaults` become the first that match."""
    chosen = {}
    for role, places in defaults.items():
        if getattr(patterns, role) == getattr(Patterns(), role):
            matching = (p for p in places if reader.matching(role, p, names))
            chosen[role] = next(matching, places[0])
    stated = reader.lights and patterns.olat != Patterns().olat
    return replace(patterns, **chosen) if stated else replace(patterns, olat="", **chosen)


def _files(folder: Path) -> list[Path]:
    """All files below `folder`, sorted; linked folders are visited once, after the others."""
    found: list[Path] = []
    visited: set[str] = set()
    roots = [folder]
    for root in roots:  # links are appended below
        for at, below, names in os.walk(root):
            real = os.path.realpath(at)
            if real in visited:
                below.clear()
                continue
            visited.add(real)
            roots += [link for n in sorted(below) if (link := Path(at, n)).is_symlink()]
            found += [Path(at, n) for n in names]
    return sorted(p for p in found if p.is_file())


def _check_order(patterns: Patterns, matches: Mapping[str, Sequence[_Match]]) -> None:
    """Raise `ImportProblem` for rows without an order among several tracking frames.

    They would all precede the first one, whose pose is the reference, and the solved motion would
    not be applied to them.
    """
    several = len({m.shot for m in matches.get("tracking", [])}) > 1
    rows = patterns.scanline if matches.get("scanline") else None
    if several and rows is not None and "{number}" not in rows:
        raise ImportProblem(
            f"pictures.scanline = {rows!r}: without {{number}} the order of rows and tracking "
            f"frames ({patterns.tracking!r}) is unknown, and motion cannot be compensated: number "
            "rows and tracking frames in one count, or remove `tracking` for a static subject"
        )


def _brackets(matches: Sequence[_Match]) -> dict[str, Bracket]:
    """Files by camera and exposure. Raises `ImportProblem` for two files of the same."""
    out: dict[str, Bracket] = {}
    for match in matches:
        bracket = out.setdefault(match.camera, {})
        if other := bracket.get(match.exposure):
            raise ImportProblem(
                f"{match.path} and {other} match the same frame of {match.camera}: remove one, or "
                f"use a pattern that separates them ({{exposure}}, {{number}}, .png for .*)"
            )
        bracket[match.exposure] = match.path
    return out


def _notes(
    rig: Rig, lights: set[str | None], used: set[Path], settings: ImportSettings, left: list[str]
) -> list[str]:
    """Notes for the user before a pixel is read."""
    out = []
    if absent := [x.name for x in rig.lights if x.name not in lights]:
        out.append(f"{len(absent)} lights have no image and are skipped: {_few(absent)}")
    suffixes = {p.suffix.lower() for p in used}
    if suffixes & LOSSY:
        out.append(
            "JPEG: compression hides fine hair, and the camera's tone curve is unknown: colour and "
            "roughness are unreliable; use RAW"
        )
    if suffixes & RAW and settings.sensor.matrix is None:
        out.append(
            "RAW: colours are the sensor's own, the file's ColorMatrix is not applied: give "
            "`sensor.matrix` if they must be Rec. 709"
        )
    if left:
        out.append(f"{len(left)} images match no pattern: {_few(left)}")
    if not rig.lights:
        out.append(
            "no lights: photographs under constant light; strands follow masks and texture, and "
            "'hairstage fit' needs images under one light at a time"
        )
    elif settings.units is None and settings.grey_ball is None and suffixes - {".exr"}:
        out.append(
            "relative units: hair albedo is relative until you provide `scale` or a grey ball "
            "(docs/how-to/import.md)"
        )
    return out


def _few(names: Sequence[str]) -> str:
    return ", ".join(names[:3]) + (", …" if len(names) > 3 else "")


class _Names:
    """The names of a rig in file names."""

    def __init__(self, rig: Rig, settings: ImportSettings, lit_by: LightPatterns | None) -> None:
        self.cameras = [c.name for c in rig.cameras]
        self.lights = [x.name for x in rig.lights]
        self.patterns = list(lit_by.names) if lit_by else []
        self.projectors = [p.name for p in rig.projectors]
        self._settings = settings
        self.sensitivities: set[str] = set()

    def matching(self, role: str, pattern: str, names: Mapping[str, Path]) -> list[_Match]:
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

    def _read(self, path: Path, fields: Mapping[str, str], timed: bool) -> _Match | None:
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
        return _Match(path, camera, light, pattern, projector, row, number, exposure)

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
        several = _few(sorted(self.sensitivities))
        return [f"images differ in ISO or aperture ({several}): only exposure times are corrected"]

    def why_none(self, folder: Path, pattern: str, names: Mapping[str, Path]) -> str:
        """Why no file is an image that is needed."""
        pictures = [n for n, p in names.items() if p.suffix.lower() in FORMATS]
        if not pictures:
            return f"{folder}: no images ({' '.join(sorted(FORMATS))})"
        lights = f" and a light of {_few(self.lights)}" if self.lights else ""
        lights = f" and a pattern of {_few(self.patterns)}" if self.patterns else lights
        way = "" if lights else ", or lights (lights.json, --lights) if each shows one"
        return (
            f"{folder}: no file matches {pattern!r} with a camera of {_few(self.cameras)}{lights}; "
            f"found {_few(pictures)}: give --pictures a pattern{way}"
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
