"""Files of light positions: `.json`, `.csv`, `.txt`, `.npy`, `.obj`, `.pc`.

`.json`: a list of positions, an object of positions by name, or a list under `lights`,
`light_positions` or `positions`; a light may be an object with `position` and optionally `name` (or
`id`), `intensity`, `colocated_camera`. `.csv` and `.txt`: optional name, x, y, z, optional
intensity; optional header line; with semicolons as separators, commas are decimal. `.npy`: (N, 3).
`.obj`, `.pc`: lines `v x y z`.
"""

from __future__ import annotations

import csv
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from reconstruction.arrays import Array
from reconstruction.containment import is_file_name, plain_file
from reconstruction.files.numpy_files import read_array
from reconstruction.geometry.lights import Light
from reconstruction.reading import read_json


class LightFileError(ValueError):
    """An invalid file of lights; the message names the file, the light and what to do."""


@dataclass(frozen=True)
class LightFile:
    """Lights in the file's units and axes; `notes` are for the user.

    `directions` is whether all are at distance 1 from the origin.
    """

    lights: list[Light]
    notes: list[str] = field(default_factory=list)
    directions: bool = False


def read_lights(path: str | Path) -> LightFile:
    """The lights of a file, with intensity 1 if it has none.

    Raises `LightFileError` naming the light and the field.
    """
    path = Path(path)
    readers = {".json": _json, ".csv": _table, ".txt": _table, ".npy": _npy}
    readers |= {".obj": _vertices, ".pc": _vertices}
    if path.suffix.lower() not in readers:
        raise LightFileError(f"{path}: expected a file of lights ({', '.join(readers)})")
    try:
        entries = readers[path.suffix.lower()](path)
    except OSError as error:
        raise LightFileError(f"{path}: {error.strerror or error}") from error
    except LightFileError:
        raise
    except ValueError as error:
        raise LightFileError(f"{path}: {str(error).removeprefix(f'{path}: ')}") from error
    if not entries:
        raise LightFileError(f"{path}: no lights")
    lights, notes = [], []
    for i, entry in enumerate(entries):
        lights.append(_light(entry, i, f"{path}: light {i + 1}"))
    names = [light.name for light in lights]
    if twice := {n for n in names if names.count(n) > 1}:
        raise LightFileError(f"{path}: two lights have the name {sorted(twice)[0]!r}")
    with_intensity = ["intensity" in entry for entry in entries]
    if any(with_intensity) and not all(with_intensity):
        i = with_intensity.index(False)
        raise LightFileError(
            f"{path}: light {i + 1} ({lights[i].name}) has no intensity, others have one: give all "
            "or none"
        )
    if not any(with_intensity):
        notes.append("the file of lights has no intensities: all are 1, units are relative")
    away = np.linalg.norm([light.position for light in lights], axis=1)
    return LightFile(lights, notes, len(lights) > 1 and bool(np.abs(away - 1).max() < 1e-4))


def from_directions(lights: list[Light], center: Array, distance: float) -> list[Light]:
    """Lights at `distance` metres from `center (3,)` in the directions of their positions."""
    return [replace(li, position=center + distance * li.position) for li in lights]


def _light(entry: dict[str, Any], i: int, where: str) -> Light:
    name = entry.get("name", entry.get("id", i))
    if isinstance(name, int) and not isinstance(name, bool) and name >= 0:
        name = f"light_{name:03d}"
    if not isinstance(name, str) or not is_file_name(name):
        raise LightFileError(f"{where}: {name!r} is not a valid name")
    position = _three(entry.get("position"), f"{where} ({name}): position")
    intensity = _three(entry.get("intensity", 1.0), f"{where} ({name}): intensity", spread=True)
    beside = entry.get("colocated_camera")
    if not isinstance(beside, str | None):
        raise LightFileError(
            f"{where} ({name}): colocated_camera: expected a camera's name, got {beside!r}"
        )
    try:
        return Light(name, position, intensity, beside)
    except ValueError as error:
        raise LightFileError(f"{where}: {error}") from error


def _three(value: Any, where: str, spread: bool = False) -> Array:
    try:
        numbers = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError):
        numbers = np.full(0, np.nan)
    if spread and numbers.shape in ((), (1,)):
        numbers = np.full(3, numbers)
    if numbers.shape != (3,) or not np.isfinite(numbers).all():
        raise LightFileError(f"{where}: expected 3 finite numbers, got {value!r}")
    return numbers


def _json(path: Path) -> list[dict[str, Any]]:
    data = read_json(path)
    if isinstance(data, dict):
        for key in ("lights", "light_positions", "positions", "directions"):
            if key in data:
                data = data[key]
                break
    if isinstance(data, dict):
        return [{"name": k, **_entry(v)} for k, v in data.items()]
    if not isinstance(data, list):
        raise LightFileError(f"{path}: expected a list of lights, got {type(data).__name__}")
    return [_entry(v) for v in data]


def _entry(value: Any) -> dict[str, Any]:
    return value if isinstance(value, dict) else {"position": value}


def _npy(path: Path) -> list[dict[str, Any]]:
    try:
        positions = read_array(path)
    except ValueError as error:
        raise LightFileError(f"{path}: not a NumPy array ({error})") from error
    if positions.ndim != 2 or positions.shape[1] != 3 or positions.dtype.kind not in "fiu":
        raise LightFileError(f"{path}: expected (N, 3) numbers, got {positions.shape}")
    return [{"position": p} for p in positions]


def _vertices(path: Path) -> list[dict[str, Any]]:
    lines = (line.split() for line in plain_file(path).read_text().splitlines())
    return [{"position": [float(w) for w in words[1:4]]} for words in lines if words[:1] == ["v"]]


def _table(path: Path) -> list[dict[str, Any]]:
    text = plain_file(path).read_text(encoding="utf-8-sig")  # byte order mark of spreadsheets
    lines = [line for line in text.splitlines() if line.strip() and not line.startswith("#")]
    if any(";" in line for line in lines):  # decimal commas
        rows = list(csv.reader([x.replace(",", ".") for x in lines], delimiter=";"))
    elif any("," in line for line in lines):
        rows = list(csv.reader(lines, skipinitialspace=True))
    else:
        rows = [line.split() for line in lines]
    if rows and {"x", "y", "z"} <= {w.strip().lower() for w in rows[0]}:
        columns = [w.strip().lower() for w in rows.pop(0)]
        return [_named_row(dict(zip(columns, row, strict=False)), path) for row in rows]
    return [_row(row, path, i + 1) for i, row in enumerate(rows)]


def _named_row(row: dict[str, str], path: Path) -> dict[str, Any]:
    out: dict[str, Any] = {"position": [_float(row.get(k, ""), path) for k in "xyz"]}
    name = row.get("name") or row.get("id") or row.get("light")
    if name:
        out["name"] = int(name) if name.strip().isdecimal() else name.strip()
    if {"r", "g", "b"} <= set(row):
        out["intensity"] = [_float(row[k], path) for k in "rgb"]
    elif row.get("intensity"):
        out["intensity"] = _float(row["intensity"], path)
    return out


def _no_name(word: str) -> bool:
    """Whether a word is a fraction or negative, and so not a name."""
    try:
        return not float(word).is_integer() or word.startswith("-")
    except (ValueError, OverflowError):
        return False


def _row(words: list[str], path: Path, line: int) -> dict[str, Any]:
    out: dict[str, Any] = {}
    if len(words) in (4, 7):
        name = words[0].strip()
        if len(words) == 4 and _no_name(name):
            raise LightFileError(
                f"{path}: row {line}: {name} is ambiguous, a name or x: add a header line (x, y, "
                "z, intensity)"
            )
        out["name"], words = int(name) if name.isdecimal() else name, words[1:]
    if len(words) not in (3, 6):
        raise LightFileError(
            f"{path}: row {line} has {len(words)} columns; expected x, y, z with an optional name "
            "before and red, green and blue intensity after"
        )
    numbers = [_float(w, path) for w in words]
    out["position"] = numbers[:3]
    if len(numbers) == 6:
        out["intensity"] = numbers[3:]
    return out


def _float(word: str, path: Path) -> float:
    try:
        return float(word)
    except ValueError:
        raise LightFileError(f"{path}: expected a number, got {word!r}") from None
