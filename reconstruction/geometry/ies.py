"""IES photometric files (ANSI/IES LM-63 of 1986, 1991, 1995, 2002 and 2019)."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Literal

import numpy as np

from reconstruction.arrays import Array
from reconstruction.geometry.light_profiles import LightProfile, Photometry, Unit
from reconstruction.reading import read_text

EDITIONS = {"1986": 1986, "86": 1986, "1991": 1991, "91": 1991, "1995": 1995, "95": 1995}
EDITIONS |= {"2002": 2002, "02": 2002, "2019": 2019, "19": 2019}
_FIRST = re.compile(r"(?:IES|IESNA|ANSI/?IES):?(?:LM-?63-?)?(\d+)")  # a file of 1986 has none
_TILT = re.compile(r"\s*TILT\s*=\s*(.*)", re.IGNORECASE)
_PHOTOMETRY: dict[int, Photometry] = {1: "C", 2: "B", 3: "A"}
_MILLIWATTS = re.compile(r"\bmw\s*/\s*sr\b|\bmilliwatts?\b", re.IGNORECASE)


class IesError(ValueError):
    """A file that is not LM-63; the message names the file, the line and what was expected."""


def read_ies(
    path: str | Path, *, unit: Literal["cd", "mW/sr"] | None = None, tilt_deg: float = 0.0
) -> LightProfile:
    """The distribution in an LM-63 file of any edition, photometry of type A, B or C.

    In candela or W/sr, multiplied by the file's multiplier, ballast and tilt factors. Makers of
    infrared, ultraviolet and single-colour lamps write mW/sr where LM-63 has candela: give `unit`,
    or a label line that names `mW/sr` or milliwatts. `tilt_deg` selects the factor of
    `TILT=INCLUDE`. Raises `IesError` naming file and line.
    """
    if unit not in (None, "cd", "mW/sr"):
        raise ValueError(f"unit must be 'cd' or 'mW/sr', got {unit!r}")
    path = Path(path)
    try:
        lines = read_text(path, "latin-1").splitlines()
    except OSError as error:
        raise IesError(f"{path}: cannot be read: {error.strerror}") from error
    start, version = _labels(path, lines)
    numbers = _Numbers(path, lines, start + 1)
    how = lines[start].partition("=")[2].strip().upper()
    tilt = _tilt(numbers) if how == "INCLUDE" else None
    if how not in ("NONE", "INCLUDE"):
        raise IesError(
            f"{path}, line {start + 1}: TILT={how}: tilt files are not looked up; "
            "put the table into the file (TILT=INCLUDE) or use TILT=NONE"
        )
    numbers.count("number of lamps")
    numbers.take("lumens per lamp")
    multiplier = numbers.take("multiplier", 0.0)
    sizes = [numbers.count(f"number of {k} angles") for k in ("vertical", "horizontal")]
    kind = numbers.one_of("photometric type (1 C, 2 B, 3 A)", (1, 2, 3))
    numbers.one_of("units (1 feet, 2 metres)", (1, 2))
    for side in ("width", "length", "height"):
        numbers.take(f"opening's {side}")
    multiplier *= numbers.take("ballast factor", 0.0)
    photometric_factor = numbers.take("ballast-lamp photometric factor", 0.0)
    if version <= 1995:  # later editions keep the place for something that is no factor
        multiplier *= photometric_factor
    if multiplier == 0:
        raise numbers.wrong(
            f"the factors of an edition of {version} multiply all candela values by 0; if the file "
            "is of 2002 or later, its first line must be IESNA:LM-63-2002"
        )
    numbers.take("input watts")
    if tilt is not None:
        multiplier *= float(np.interp(tilt_deg, tilt[:, 0], tilt[:, 1]))
    photometry = _PHOTOMETRY[kind]
    vertical, horizontal = _angles(numbers, photometry, sizes)
    values = numbers.many("candela values", sizes[0] * sizes[1], 0.0).reshape(sizes[1], sizes[0])
    numbers.end()
    radiometric = unit == "mW/sr" or (
        unit is None and any(_MILLIWATTS.search(line) for line in lines[:start])
    )
    value_unit: Unit = "W/sr" if radiometric else "cd"
    values = values * (multiplier * (1e-3 if radiometric else 1.0))
    if photometry == "C":
        table = _type_c(vertical, horizontal, values)
    else:
        table = _type_a_or_b(vertical, horizontal, values, photometry)
    return LightProfile(path.stem, *table, photometry, value_unit)


def _labels(path: Path, lines: list[str]) -> tuple[int, int]:
    """Index of the TILT= line, and the edition by the first line that is not blank."""
    tilt = next((i for i, line in enumerate(lines) if _TILT.match(line)), None)
    if tilt is None:
        raise IesError(f"{path}, line {len(lines)}: no line starts with TILT=: not an LM-63 file")
    number, first = next((n, x) for n, x in enumerate(lines, 1) if x.strip())
    found = _FIRST.match("".join(first.split()).upper())
    if found is None:
        return tilt, 1986
    if found[1] not in EDITIONS:
        raise IesError(
            f"{path}, line {number}: edition {first.strip()!r} is unknown; known are "
            f"{', '.join(EDITIONS)}"
        )
    return tilt, EDITIONS[found[1]]


class _Numbers:
    """The numbers after TILT=, in order, whatever the lines they stand on."""

    def __init__(self, path: Path, lines: list[str], start: int) -> None:
        self._path = path
        self._words = [
            (number, word)
            for number, line in enumerate(lines[start:], start + 1)
            for word in line.replace(",", " ").split()
        ]
        self._next = 0
        self._last_line = len(lines)

    def take(self, what: str, least: float = -np.inf) -> float:
        """The next number; errors call it `what`."""
        if self._next == len(self._words):
            raise IesError(f"{self._path}, line {self._last_line}: the file ends before {what}")
        line, word = self._words[self._next]
        self._next += 1
        try:
            value = float(word)
        except ValueError:
            value = np.nan
        if not np.isfinite(value) or value < least:
            bound = "" if least == -np.inf else f" >= {least:g}"
            raise self.wrong(f"{what}: expected a number{bound}, got {word!r}", line)
        return value

    def many(self, what: str, count: int, least: float = -np.inf) -> Array:
        """The next `count` numbers."""
        left = len(self._words) - self._next
        if left < count:
            raise IesError(
                f"{self._path}, line {self._last_line}: expected {count} {what}, "
                f"but the file ends after {left}"
            )
        return np.array([self.take(what, least) for _ in range(count)])

    def count(self, what: str) -> int:
        """A whole number from 1 on."""
        value = self.take(what)
        if value != int(value) or value < 1:
            raise self.wrong(f"{what}: expected a whole number from 1 on, got {value:g}")
        return int(value)

    def one_of(self, what: str, allowed: tuple[int, ...]) -> int:
        """One of a few whole numbers."""
        value = self.take(what)
        if value not in allowed:
            raise self.wrong(f"{what}: expected one of {allowed}, got {value:g}")
        return int(value)

    def end(self) -> None:
        """Refuse numbers after the last expected one."""
        if self._next < len(self._words):
            line, word = self._words[self._next]
            left = len(self._words) - self._next
            raise self.wrong(f"expected the end of the file, got {word!r}, {left} words left", line)

    def wrong(self, text: str, line: int | None = None) -> IesError:
        """An error about the word that was taken last, or about `line`."""
        if line is None:
            line = self._words[self._next - 1][0]
        return IesError(f"{self._path}, line {line}: {text}")


def _tilt(numbers: _Numbers) -> Array:
    """Angles and factors `(T, 2)` of TILT=INCLUDE."""
    numbers.one_of("lamp-to-luminaire geometry", (1, 2, 3))
    count = numbers.count("number of tilt angles")
    angles = numbers.many("tilt angles", count)
    if not (np.diff(angles) > 0).all():
        raise numbers.wrong("tilt angles must ascend")
    return np.stack([angles, numbers.many("tilt factors", count, 0.0)], axis=1)


def _angles(numbers: _Numbers, photometry: Photometry, sizes: list[int]) -> tuple[Array, Array]:
    """Vertical and horizontal angles, ascending and in the range of their type."""
    found = []
    for name, count in zip(("vertical", "horizontal"), sizes, strict=True):
        low, high = -90.0, 90.0
        if photometry == "C":
            low, high = 0.0, 180.0 if name == "vertical" else 360.0
        angles = numbers.many(f"{name} angles", count)
        if not (np.diff(angles) > 0).all():
            raise numbers.wrong(f"{name} angles must ascend, got {angles.tolist()}")
        if angles[0] < low or angles[-1] > high:
            raise numbers.wrong(
                f"{name} angles of type {photometry} must lie in [{low:g}, {high:g}], "
                f"got {angles[0]:g} to {angles[-1]:g}"
            )
        least = 2 if name == "vertical" or photometry != "C" else 1
        if count < least:
            raise numbers.wrong(f"type {photometry} needs {least} or more {name} angles")
        found.append(angles)
    vertical, horizontal = found
    if photometry == "C" and (horizontal[0], horizontal[-1]) != (90.0, 270.0):
        last = horizontal[-1]
        if horizontal[0] != 0 or not (last in (0, 90, 180) or last > 180):
            raise numbers.wrong(
                "horizontal angles of type C must go from 0 to 0, 90, 180 or beyond, or from "
                f"90 to 270, got {horizontal[0]:g} to {last:g}"
            )
    return vertical, horizontal


def _type_c(vertical: Array, horizontal: Array, values: Array) -> tuple[Array, Array, Array]:
    """All round, by the symmetry that the range of the horizontal angles stands for."""
    h, v = horizontal, values
    if h[-1] == 0:
        h, v = np.array([0.0, 360.0]), np.repeat(v, 2, axis=0)
    for end in (90, 180, 270):  # mirrored there; from 0 to 270 is no half
        if h[-1] == end and (h[0] == 90) == (end == 270):
            h, v = np.append(h, 2 * end - h[-2::-1]), np.append(v, v[-2::-1], axis=0)
    if h[-1] - h[0] < 360:
        h, v = np.append(h, 360), np.append(v, v[:1], axis=0)
    return h, vertical, v


def _type_a_or_b(
    vertical: Array, horizontal: Array, values: Array, photometry: Photometry
) -> tuple[Array, Array, Array]:
    """Both sides of the vertical plane where only one is given; dark beyond the table."""
    if horizontal[0] == 0:
        horizontal = np.append(-horizontal[:0:-1], horizontal)
        values = np.append(values[:0:-1], values, axis=0)
    if photometry == "A":
        return horizontal, vertical + 90, values
    return vertical, horizontal + 90, values.T
