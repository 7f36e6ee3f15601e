"""Matching of files with frames by their names."""

from __future__ import annotations

import os
import re
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, get_args

from reconstruction.capture.import_names import Match, Names, few
from reconstruction.capture.import_settings import (
    PATTERN_IMAGES,
    PHOTOGRAPHS,
    ImportProblem,
    ImportSettings,
    Patterns,
)
from reconstruction.capture.light_patterns import LightPatterns
from reconstruction.capture.records import Step, StepKind
from reconstruction.files.encoded import FORMATS, RAW
from reconstruction.files.lights import light_name
from reconstruction.files.pictures import LOSSY
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


def find(
    folder: Path, settings: ImportSettings, rig: Rig, lit_by: LightPatterns | None = None
) -> Found:
    """Match all files in `folder` with the patterns and the names in `rig` and `lit_by`.

    Raises `ImportProblem` for an invalid pattern, no single-light image (for a rig without lights,
    no photograph; with `lit_by`, no image under a pattern), two files for one frame, or rows
    without an order among tracking frames.
    """
    names = {p.relative_to(folder).as_posix(): p for p in _files(folder)}
    reader, needed, patterns = Names(rig, settings, lit_by), "olat", settings.pictures
    if lit_by is not None or not rig.lights:
        needed, places = ("all_on", PHOTOGRAPHS) if lit_by is None else ("pattern", PATTERN_IMAGES)
        patterns = _first_of(places, patterns, reader, names)
    matches: dict[str, list[Match]] = {}
    used: set[Path] = set()
    for role in (f for f in vars(patterns) if getattr(patterns, f)):
        matches[role] = reader.matching(role, getattr(patterns, role), names)
        used |= {m.path for m in matches[role]}
    _check_order(patterns, matches)
    steps: list[Step] = []
    frames: dict[tuple[int, str], Bracket] = {}
    kinds: list[tuple[StepKind, tuple[Any, ...], list[Match]]] = []
    shots = matches.get("olat", [])
    once = len({(m.light, m.camera, m.exposure) for m in shots}) == len(shots)
    for kind in get_args(StepKind):
        groups: dict[tuple[Any, ...], list[Match]] = defaultdict(list)
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
    bare = [f"{few(without)}: no images, all frames are missing"] if without else []
    return Found(
        tuple(steps), frames, plates, single["flat"], single["hair"], single["subject"],
        tuple(left), (*bare, *_notes(rig, shot, used, settings, left), *reader.notes()),
    )  # fmt: skip


def light_names(folder: Path, settings: ImportSettings, cameras: Sequence[Camera]) -> list[str]:
    """What the images' names have for `{light}`, sorted, for a set without positions of lights."""
    reader = Names(Rig(folder.name, tuple(cameras), ()), settings, None)
    names = {p.relative_to(folder).as_posix(): p for p in _files(folder)}
    others = {f: p for f, p in vars(settings.pictures).items() if p and f != "olat"}
    taken = {m.path for role, p in others.items() for m in reader.matching(role, p, names)}
    expression = re.compile(reader.expression(settings.pictures.olat))
    found = (expression.fullmatch(n) for n, p in names.items() if p not in taken)
    return sorted({str(light_name(m["light"])) for m in found if m})


def _first_of(
    defaults: Mapping[str, Sequence[str]],
    patterns: Patterns,
    reader: Names,
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


def _check_order(patterns: Patterns, matches: Mapping[str, Sequence[Match]]) -> None:
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


def _brackets(matches: Sequence[Match]) -> dict[str, Bracket]:
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
        out.append(f"{len(absent)} lights have no image and are skipped: {few(absent)}")
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
        out.append(f"{len(left)} images match no pattern: {few(left)}")
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
