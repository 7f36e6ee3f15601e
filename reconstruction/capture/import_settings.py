"""What a user says of a folder of pictures (`import.toml`), and which file is which frame."""

from __future__ import annotations

import os
import re
import tomllib
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, get_args

from reconstruction.capture.folder import CaptureError, Step, StepKind
from reconstruction.capture.grey_ball import GreyBall
from reconstruction.capture.import_geometry import GeometryFiles
from reconstruction.files.pictures import (
    FORMATS,
    LOSSY,
    PictureError,
    Positive,
    Sensor,
    exposure_of,
)
from reconstruction.geometry.rig import Rig
from reconstruction.options import BadOptions, options, parse_options

SETTINGS = "import.toml"
FIELDS = ("camera", "light", "exposure", "projector", "row", "number")


class ImportProblem(CaptureError):
    """A folder that cannot be imported; the message names the file and the field."""


@options
class Patterns:
    """Where each kind of picture lies, relative to the folder.

    `{camera}`, `{light}` and `{projector}` are names, or the number that a name ends in;
    `{exposure}` is seconds (`0.02`, `1-50`) or a name of `exposures`; `{row}` a projector's row;
    `{number}` counts what else there is several of, in the order of shooting: tracking frames and
    rows in one count; of lights that are shot once cameras may count apart; `*` is any text.
    `clean_plate` shows the stage without the subject, `flat` an evenly lit field.
    """

    olat: str = "images/{camera}/{light}.*"
    dark: str | None = None
    all_on: str | None = None
    tracking: str | None = None
    scanline: str | None = None
    clean_plate: str | None = None
    flat: str | None = None
    hair: str = "masks/{camera}.png"
    subject: str = "subjects/{camera}.png"


@options
class ImportSettings:
    """`import.toml`, field by field.

    `exposure` in seconds is that of pictures whose pattern has no `{exposure}`, "file" what each
    says itself (EXIF); `exposures` names others. `first_light`: the number in a picture's name that
    stands for the first light of the list, those after it following; None: the number that the
    light's own name ends in. `units`: whether a full channel at 1 s is `scale` W/(sr m²), or
    unknown; a `grey_ball` in view says it instead of `scale`. `geometry`: the files of cameras and
    lights, relative to the folder.
    """

    pictures: Patterns = Patterns()
    sensor: Sensor = Sensor()
    exposure: Positive | Literal["file"] = 1.0
    exposures: dict[str, Positive] = field(default_factory=dict)
    first_light: int | None = None
    units: Literal["radiance", "relative"] | None = None
    scale: Positive = 1.0
    grey_ball: GreyBall | None = None
    geometry: GeometryFiles = GeometryFiles()


def read_settings(path: Path) -> ImportSettings:
    """Read `import.toml`. Raises `ImportProblem` naming the field that is wrong."""
    try:
        return parse_options(ImportSettings, tomllib.loads(path.read_text()), str(path))
    except FileNotFoundError:
        raise ImportProblem(f"{path}: no such file") from None
    except (BadOptions, UnicodeDecodeError) as error:
        raise ImportProblem(str(error)) from error
    except tomllib.TOMLDecodeError as error:
        raise ImportProblem(f"{path}: not TOML ({error})") from error


Bracket = dict[float, Path]
"""One picture at several exposures: files by seconds."""


@dataclass(frozen=True)
class Found:
    """What a folder's names say: `frames` by step and camera, and what goes with them by camera.

    `plates` are by light (None: under all of them) and camera. `unmatched` are pictures that no
    pattern names, relative to the folder.
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
    """A file, and what its name says."""

    path: Path
    camera: str
    light: str | None
    projector: str | None
    row: int | None
    number: int | None
    exposure: float

    @property
    def shot(self) -> tuple[Any, ...]:
        """What is the same in all cameras and exposures of one step; sorts by time."""
        order = -1 if self.number is None else self.number
        return order, self.projector or "", -1 if self.row is None else self.row


def find(folder: Path, settings: ImportSettings, rig: Rig) -> Found:
    """Match the names of all files in `folder` with the patterns, and these with `rig`.

    Raises `ImportProblem`: a pattern that cannot be used, no picture of a single light, two files
    for one frame, rows that cannot be placed between tracking frames.
    """
    names = {p.relative_to(folder).as_posix(): p for p in _files(folder)}
    patterns, reader = settings.pictures, _Names(rig, settings)
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
            if kind == "olat":  # of a light that is shot once cameras may have numbers of their own
                place = reader.lights.index(str(match.light))
                groups[(place,) if once else (place, *match.shot)].append(match)
            else:
                groups[match.shot].append(match)
        kinds += [(kind, key, group) for key, group in groups.items()]
    rank = {"dark": 0, "all_on": 1, "olat": 2, "tracking": 3, "scanline": 3}
    for kind, _, group in sorted(kinds, key=lambda k: (rank[k[0]], k[1], k[0])):
        first, longest = group[0], max(m.exposure for m in group)
        level = 0.0 if kind == "dark" else 1.0
        which = {"light": first.light, "projector": first.projector, "row": first.row}
        step = Step(len(steps), kind, longest, level, **which)  # type: ignore[arg-type]
        steps.append(step)
        for camera, bracket in _brackets(group).items():
            frames[step.index, camera] = bracket
    if not any(s.kind == "olat" for s in steps):
        raise ImportProblem(reader.why_none(folder, patterns.olat, names))
    plates: dict[tuple[str | None, str], Bracket] = {}
    for light in {m.light for m in matches.get("clean_plate", [])}:
        of_light = [m for m in matches["clean_plate"] if m.light == light]
        plates |= {(light, camera): b for camera, b in _brackets(of_light).items()}
    single = {
        role: {c: next(iter(b.values())) for c, b in _brackets(matches.get(role, [])).items()}
        for role in ("flat", "hair", "subject")
    }
    left = [n for n, p in names.items() if p not in used and p.suffix.lower() in FORMATS]
    shot = {s.light for s in steps}
    without = sorted({c.name for c in rig.cameras} - {camera for _, camera in frames})
    bare = [f"no picture of {_few(without)}: all its frames are missing"] if without else []
    return Found(
        tuple(steps), frames, plates, single["flat"], single["hair"], single["subject"],
        tuple(left), (*bare, *_notes(rig, shot, used, settings, left), *reader.notes()),
    )  # fmt: skip


def _files(folder: Path) -> list[Path]:
    """All files below `folder`, in order; folders that are links are looked into, each once, after
    those that are not."""
    found: list[Path] = []
    seen: set[str] = set()
    roots = [folder]
    for root in roots:  # which links are added to
        for at, below, names in os.walk(root):
            real = os.path.realpath(at)
            if real in seen:
                below.clear()
                continue
            seen.add(real)
            roots += [link for n in sorted(below) if (link := Path(at, n)).is_symlink()]
            found += [Path(at, n) for n in names]
    return sorted(p for p in found if p.is_file())


def _check_order(patterns: Patterns, matches: Mapping[str, Sequence[_Match]]) -> None:
    """Raises `ImportProblem` where rows have no place among several tracking frames.

    They would all come before the first one, whose pose is the reference: no motion would be taken
    off them, though one is solved and reported.
    """
    several = len({m.shot for m in matches.get("tracking", [])}) > 1
    rows = patterns.scanline if matches.get("scanline") else None
    if several and rows is not None and "{number}" not in rows:
        raise ImportProblem(
            f"pictures.scanline = {rows!r}: without {{number}} nothing says between which tracking "
            f"frames ({patterns.tracking!r}) a row was shot, and the subject's motion could not be "
            "taken off: give rows the {number} of the same count, or, where the subject kept "
            "still, leave `tracking` out"
        )


def _brackets(matches: Sequence[_Match]) -> dict[str, Bracket]:
    """Files by camera and exposure. Raises `ImportProblem` where two say the same."""
    out: dict[str, Bracket] = {}
    for match in matches:
        bracket = out.setdefault(match.camera, {})
        if other := bracket.get(match.exposure):
            raise ImportProblem(
                f"{match.path} and {other} are both one frame of {match.camera}: remove one, or "
                f"give a pattern that tells them apart ({{exposure}}, {{number}}, .png for .*)"
            )
        bracket[match.exposure] = match.path
    return out


def _notes(
    rig: Rig, lights: set[str | None], used: set[Path], settings: ImportSettings, left: list[str]
) -> list[str]:
    """What the user should know before a pixel is read."""
    out = []
    if absent := [x.name for x in rig.lights if x.name not in lights]:
        out.append(f"{len(absent)} lights have no picture and are left out: {_few(absent)}")
    suffixes = {p.suffix.lower() for p in used}
    if suffixes & LOSSY:
        out.append(
            "JPEG: its blocks hide fine hair, and what its camera did to contrast and colour "
            "cannot be told: do not trust figures of colour and roughness; give RAW instead"
        )
    if left:
        out.append(f"{len(left)} pictures match no pattern: {_few(left)}")
    if settings.units is None and settings.grey_ball is None and suffixes - {".exr"}:
        out.append(
            "relative units: no `scale` says what a full channel is in W/(sr m²): how dark the "
            "hair is, against its light, is not known until a grey ball in view says it"
        )
    return out


def _few(names: Sequence[str]) -> str:
    return ", ".join(names[:3]) + (", …" if len(names) > 3 else "")


class _Names:
    """How the names of a rig are written in the names of files."""

    def __init__(self, rig: Rig, settings: ImportSettings) -> None:
        self.cameras = [c.name for c in rig.cameras]
        self.lights = [x.name for x in rig.lights]
        self.projectors = [p.name for p in rig.projectors]
        self._settings = settings
        self.sensitivities: set[str] = set()

    def matching(self, role: str, pattern: str, names: Mapping[str, Path]) -> list[_Match]:
        """Files whose names follow `pattern`. Raises `ImportProblem` where it says too little."""
        needed = {"olat": {"camera", "light"}, "scanline": {"camera", "projector", "row"}}
        given = {"camera": self.cameras, "projector": self.projectors}
        fields = set(re.findall(r"{(.*?)}", pattern))
        where = f"pictures.{role} = {pattern!r}"
        if unknown := fields - set(FIELDS):
            raise ImportProblem(f"{where}: no fields {sorted(unknown)}; there are {list(FIELDS)}")
        alone = {f for f, names in given.items() if len(names) == 1}
        if missing := needed.get(role, {"camera"}) - fields - alone:
            raise ImportProblem(f"{where}: must say which {' and '.join(sorted(missing))}")
        expression = re.compile(self._expression(pattern))
        found = ((path, expression.fullmatch(name)) for name, path in names.items())
        timed = role not in ("flat", "hair", "subject")
        read = [self._read(path, match.groupdict(), timed) for path, match in found if match]
        return [m for m in read if m is not None]

    def _expression(self, pattern: str) -> str:
        number = r"\d+"
        kinds = {
            "camera": _any_of([*self.cameras, number], 1),
            "light": _any_of([*self.lights, number], 1),
            "projector": _any_of([*self.projectors, number], 1),
            "exposure": _any_of(
                [*self._settings.exposures, r"\d+[-_]\d+|\d+(?:\.\d+)?(?:e-?\d+)?"], 1
            ),
            "row": number,
            "number": number,
        }
        out, seen = "", set()
        for part in re.split(r"({.*?}|\*)", pattern):
            if part == "*":
                out += "[^/]*"
            elif part.startswith("{"):
                name = part[1:-1]
                out += f"(?P={name})" if name in seen else f"(?P<{name}>{kinds[name]})"
                seen.add(name)
            else:
                out += re.escape(part)
        return out

    def _read(self, path: Path, said: Mapping[str, str], timed: bool) -> _Match | None:
        """None where a number stands for nothing that the rig has; `timed`: seconds matter."""
        camera = (
            self._name(said.get("camera"), self.cameras) if "camera" in said else self.cameras[0]
        )
        light = self._light(said["light"]) if "light" in said else None
        projector = self._name(said.get("projector"), self.projectors)
        if "row" in said and "projector" not in said:
            projector = self.projectors[0]
        if camera is None or (light is None and "light" in said):
            return None
        if projector is None and "projector" in said:
            return None
        row, number = (int(said[f]) if f in said else None for f in ("row", "number"))
        exposure = self._settings.exposure
        if "exposure" in said:
            exposure = self._seconds(said["exposure"])
        elif exposure == "file":
            exposure = self._seconds_in(path) if timed else 1.0
        return _Match(path, camera, light, projector, row, number, exposure)

    def _light(self, text: str) -> str | None:
        first = self._settings.first_light
        if first is None or not text.isdigit():
            return self._name(text, self.lights)
        index = int(text) - first
        return self.lights[index] if 0 <= index < len(self.lights) else None

    def _name(self, text: str | None, names: list[str]) -> str | None:
        if text is None or text in names:
            return text
        ends = [re.search(r"(\d+)$", n) for n in names]
        same = [n for n, e in zip(names, ends, strict=True) if e and int(e[1]) == int(text)]
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
        """What differs between the shots, and is not accounted for."""
        if len(self.sensitivities) < 2:
            return []
        several = _few(sorted(self.sensitivities))
        return [f"pictures differ in more than seconds ({several}): only seconds are accounted for"]

    def why_none(self, folder: Path, pattern: str, names: Mapping[str, Path]) -> str:
        """Why no file is a picture of one light."""
        pictures = [n for n, p in names.items() if p.suffix.lower() in FORMATS]
        if not pictures:
            return f"{folder}: has no pictures ({' '.join(sorted(FORMATS))})"
        return (
            f"{folder}: no file is called {pattern!r} with a camera of {_few(self.cameras)} and a "
            f"light of {_few(self.lights)}; there is {_few(pictures)}: give --pictures a pattern"
        )


def _any_of(choices: Sequence[str], plain: int) -> str:
    """An expression for one of `choices`, of which the last `plain` are expressions themselves."""
    names = sorted(choices[:-plain], key=len, reverse=True)
    return "|".join([*map(re.escape, names), *choices[-plain:]])
