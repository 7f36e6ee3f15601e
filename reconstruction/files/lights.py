"""Files of light positions: `.json`, `.csv`, `.txt`, `.npy`, `.mat`, `.obj`, `.pc`.

`.json`: a list of positions, an object of positions by name, or a list under `lights`,
`light_positions` or `positions`; a light may be an object with `position` (or x, y and z) and
optionally `name` (or `id`), `intensity`, `colocated_camera`, `aim` (or `direction`, `axis`) and
`mu`: its intensity falls as cos^mu of the angle to its aim, 1 (Lambertian) by default, and does not
depend on direction without an aim. `.csv` and `.txt`: the same columns by the names in a header
line (`aim_x`), else an optional name, x, y, z, optional intensity; with semicolons as separators,
commas are decimal. A unit is stated as in `x_mm`, `x [cm]`, `"position_mm"` or
`"units": {"position": "mm"}`. `.npy`: (N, 3). `.mat`: `S (N, 3)`, optionally `Dir (N, 3)`,
`mu (N,)`, `Phi (N, 3)`, as of Quéau et al. (JMIV 60(3), 2018). `.obj`, `.pc`: lines `v x y z`.
"""

from __future__ import annotations

import csv
import re
from collections import Counter
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.io import loadmat, whosmat

from reconstruction.arrays import Array
from reconstruction.containment import is_file_name
from reconstruction.files.numpy_files import read_array
from reconstruction.geometry.cameras import facing
from reconstruction.geometry.light_profiles import cosine_lobe
from reconstruction.geometry.lights import Light
from reconstruction.reading import read_json, read_text

METRES = {"m": 1.0, "metre": 1.0, "meter": 1.0, "cm": 0.01, "mm": 0.001, "in": 0.0254, "ft": 0.3048}
METRES |= {"inch": 0.0254, "inche": 0.0254, "foot": 0.3048, "feet": 0.3048, "centimetre": 0.01}
METRES |= {"centimeter": 0.01, "millimetre": 0.001, "millimeter": 0.001}
"""By name without a plural's s."""
MOST_NUMBERS = 100_000
_UNIT = rf"(?:[ _.]*[ _.\[(/](?P<unit>(?:{'|'.join(METRES)})s?)[\])]?)?"
_PLACE = re.compile(rf"(?:p|(?:position|pos)?[ _.]*)(?P<axis>[xyz]|position){_UNIT}")
_NAME = re.compile("(?:light|lamp|led)?[ _]*(?:name|id|label|number|index|no)|light|lamp|led|#")
_AIM = re.compile(r"(?:aim|axis|dir|direction)[ _.]*([xyz])?|d([xyz])")
_COLOUR = re.compile(r"(?:intensity[ _.]*)?(r|g|b|red|green|blue)")


class LightFileError(ValueError):
    """An invalid file of lights; the message names the file, the light and what to do."""


@dataclass(frozen=True)
class LightFile:
    """Lights in the file's units and axes; `notes` are for the user.

    `directions` is whether all are at distance 1 from the origin; `metres` the length of the unit
    that the file states, None without one.
    """

    lights: list[Light]
    notes: list[str] = field(default_factory=list)
    directions: bool = False
    metres: float | None = None


def read_lights(path: str | Path) -> LightFile:
    """The lights of a file, with intensity 1 if it has none.

    Raises `LightFileError` naming the light and the field.
    """
    path = Path(path)
    readers = {".json": _json, ".csv": _table, ".txt": _table, ".npy": _npy}
    readers |= {".obj": _vertices, ".pc": _vertices, ".mat": _mat}
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
        lights.append(_light(entry, i, f"{path}: {entry.get('where', f'light {i + 1}')}"))
    if unused := Counter(key for entry in entries for key in entry.get("unused", ())):
        notes.append(f"{path}: not used of its lights: {', '.join(unused)}")
    units = {entry.get("metres") for entry in entries}
    if len(units) > 1:
        raise LightFileError(f"{path}: some positions have a unit and others another or none")
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
    (unit,) = units
    alike = len(lights) > 1 and bool(np.abs(away - 1).max() < 1e-4)
    return LightFile(lights, notes, alike and unit is None, unit)


def light_name(name: Any) -> Any:
    """`light_007` of 7, "07" and "7.0"; other names as they are."""
    if isinstance(name, str):
        name = name.strip()
        if re.fullmatch(r"[0-9]{1,9}(\.0*)?", name):
            name = float(name)
    if isinstance(name, float) and name.is_integer():
        name = int(name)
    if isinstance(name, int) and not isinstance(name, bool) and name >= 0:
        return f"light_{name:03d}"
    return name


def from_directions(lights: list[Light], center: Array, distance: float) -> list[Light]:
    """Lights at `distance` metres from `center (3,)` in the directions of their positions."""
    return [replace(li, position=center + distance * li.position) for li in lights]


def _light(entry: dict[str, Any], i: int, where: str) -> Light:
    name = light_name(entry.get("name", entry.get("id", i)))
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
        return Light(name, position, intensity, beside, **lobe(entry, f"{where} ({name})"))
    except ValueError as error:
        raise LightFileError(f"{where}: {error}") from error


def lobe(entry: dict[str, Any], where: str) -> dict[str, Any]:
    """`orientation` and `profile` of a light with an `aim`. Raises `ValueError`."""
    if "aim" not in entry:
        if "mu" in entry:
            raise LightFileError(f"{where}: mu needs an aim, the direction that it points to")
        return {}
    aim = _three(entry["aim"], f"{where}: aim")
    if not aim.any():
        raise LightFileError(f"{where}: aim: expected a direction, got 0")
    power = _three(entry.get("mu", 1.0), f"{where}: mu", spread=True)[0]
    return {"orientation": facing(aim), "profile": cosine_lobe(float(power))}


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
    data, unit = read_json(path), None
    if isinstance(data, dict):
        unit = _unit(data, path)
        for key in ("lights", "light_positions", "positions", "directions"):
            if key in data:
                data = data[key]
                break
    if isinstance(data, dict):
        data = [
            {"name": k, **(v if isinstance(v, dict) else {"position": v})} for k, v in data.items()
        ]
    if not isinstance(data, list):
        raise LightFileError(f"{path}: expected a list of lights, got {type(data).__name__}")
    return [_entry(v, path, unit) for v in data]


def _unit(data: dict[str, Any], path: Path) -> float | None:
    """Metres of the unit that an object states for its positions."""
    unit = data.get("units", data.get("unit"))
    if isinstance(unit, dict):
        unit = unit.get("position")
    return None if unit is None else _metres(unit, path)


def _metres(unit: Any, path: Path) -> float:
    word = str(unit).strip().lower()
    if (length := METRES.get(word, METRES.get(word.removesuffix("s")))) is None:
        raise LightFileError(f"{path}: unknown unit {unit!r}: give one of {', '.join(METRES)}")
    return length


def _entry(value: Any, path: Path, unit: float | None) -> dict[str, Any]:
    """A light's fields; its position in the file's unit, `metres` of that if it is stated."""
    if not isinstance(value, dict):
        return {"position": value, "metres": unit}
    unit = _unit(value, path) or unit
    places = {k: m for k in value if (m := _PLACE.fullmatch(k.strip().lower()))}
    axes = {m["axis"]: k for k, m in places.items()}
    fields = ("name", "id", "intensity", "colocated_camera", "mu")
    out = {k: v for k, v in value.items() if k in fields}
    aims = {m[1] or m[2]: k for k in value if (m := _AIM.fullmatch(k.strip().lower()))}
    if set(aims) == set("xyz"):
        out["aim"] = [value[aims[a]] for a in "xyz"]
    elif set(aims) == {None}:
        out["aim"] = value[aims[None]]
    if len(axes) != len(places) or ("position" in axes and len(axes) > 1):
        raise LightFileError(f"{path}: {', '.join(places)} give a position twice")
    if set(axes) == set("xyz"):
        out["position"] = [value[axes[a]] for a in "xyz"]
    elif "position" in axes:
        out["position"] = value[axes["position"]]
    out["unused"] = [
        k for k in value if k not in (*out, *axes.values(), *aims.values(), "unit", "units")
    ]
    stated = {m["unit"] for m in places.values()}
    if len(stated) > 1:
        raise LightFileError(f"{path}: {', '.join(places)}: expected one unit for x, y and z")
    word = next(iter(stated), None)
    out["metres"] = unit if word is None else _metres(word, path)
    return out


def _npy(path: Path) -> list[dict[str, Any]]:
    try:
        positions = read_array(path)
    except ValueError as error:
        raise LightFileError(f"{path}: not a NumPy array ({error})") from error
    if positions.ndim != 2 or positions.shape[1] != 3 or positions.dtype.kind not in "fiu":
        raise LightFileError(f"{path}: expected (N, 3) numbers, got {positions.shape}")
    return [{"position": p} for p in positions]


def _mat(path: Path) -> list[dict[str, Any]]:
    fields = {"S": "position", "Dir": "aim", "mu": "mu", "Phi": "intensity"}
    try:
        shapes = {name: shape for name, shape, _ in whosmat(str(path)) if name in fields}
        if any(np.prod(shape) > MOST_NUMBERS for shape in shapes.values()):
            raise LightFileError(f"{path}: too large for a file of lights: {shapes}")
        found = {f: np.atleast_2d(loadmat(str(path), variable_names=[f])[f]) for f in shapes}
    except OSError:
        raise
    except Exception as error:  # SciPy raises various types for damaged files
        raise LightFileError(f"{path}: not a MATLAB file of lights ({error})") from error
    count = len(found.get("S", ()))
    found = {k: v.reshape(-1, 1) if v.size == count else v for k, v in found.items()}
    wrong = [k for k, v in found.items() if len(v) != count or v.dtype.kind not in "fiu"]
    if not count or wrong:
        raise LightFileError(
            f"{path}: expected S (N, 3), optionally Dir (N, 3), mu (N,), Phi (N, 3), got {shapes}"
        )
    return [{fields[k]: v[i] for k, v in found.items()} for i in range(count)]


def _vertices(path: Path) -> list[dict[str, Any]]:
    """Lines `v x y z`; what else an OBJ has places nothing."""
    out = []
    for number, line in enumerate(read_text(path).splitlines(), 1):
        words = line.partition("#")[0].split()
        if words[:1] == ["v"]:
            out.append({"position": [_float(w, path, number) for w in words[1:4]]})
    return out


def _table(path: Path) -> list[dict[str, Any]]:
    lines = [(n, x) for n, x in enumerate(read_text(path).splitlines(), 1) if x.strip(" \t,;")]
    rows = [(n, x) for n, x in lines if not x.lstrip().startswith("#")]
    between = next((c for c in (";", "\t", ",") if any(c in x for _, x in rows)), None)

    def cells(line: str) -> list[str]:
        if between is None:
            return line.split()
        if between == ";":
            line = line.replace(",", ".")
        return [w.strip() for w in next(csv.reader([line], delimiter=between))]

    # NumPy writes the header as a comment
    for number, line in lines if rows else []:
        if number > rows[0][0]:
            break
        columns = [w.lower() for w in cells(line.lstrip(" \t#"))]
        if len(set("xyz") & {m["axis"] for w in columns if (m := _PLACE.fullmatch(w))}) == 3:
            values = [(n, x) for n, x in rows if n > number]
            return [_named_row(columns, cells(x), path, n) for n, x in values]
    return [_row(cells(x), path, n) for n, x in rows]


def _named_row(columns: list[str], words: list[str], path: Path, line: int) -> dict[str, Any]:
    while len(words) > len(columns) and not words[-1]:
        words.pop()
    if len(words) != len(columns) or len(set(columns)) != len(columns):
        raise LightFileError(
            f"{path}: line {line} has {len(words)} columns, the header has {', '.join(columns)}"
        )
    row: dict[str, Any] = {}
    for column, word in zip(columns, words, strict=True):
        colour = _COLOUR.fullmatch(column)
        if _NAME.fullmatch(column) and word and "name" not in row:
            row["name"] = word
        elif _PLACE.fullmatch(column) or (word and (_AIM.fullmatch(column) or column == "mu")):
            row[column] = _float(word, path, line)
        elif colour or (column == "intensity" and word):
            row[f"intensity {colour[1][0]}" if colour else column] = _float(word, path, line)
        elif word:
            row[column] = word
    if {f"intensity {c}" for c in "rgb"} <= set(row):
        row["intensity"] = [row.pop(f"intensity {c}") for c in "rgb"]
    return _entry(row, path, None) | {"where": f"line {line}"}


def _no_name(word: str) -> bool:
    """Whether a word is a fraction or negative, and so not a name."""
    try:
        return not float(word).is_integer() or word.startswith("-")
    except (ValueError, OverflowError):
        return False


def _row(words: list[str], path: Path, line: int) -> dict[str, Any]:
    out: dict[str, Any] = {"where": f"line {line}"}
    if len(words) in (4, 7):
        if len(words) == 4 and _no_name(words[0]):
            raise LightFileError(
                f"{path}: line {line}: {words[0]} is ambiguous, a name or x: add a header line (x, "
                "y, z, intensity)"
            )
        out["name"], words = words[0], words[1:]
    if len(words) not in (3, 6):
        raise LightFileError(
            f"{path}: line {line} has {len(words)} columns; expected x, y, z with an optional name "
            "before and red, green and blue intensity after, or a header line that names the "
            "columns, as id,x_mm,y_mm,z_mm"
        )
    numbers = [_float(w, path, line) for w in words]
    out["position"] = numbers[:3]
    if len(numbers) == 6:
        out["intensity"] = numbers[3:]
    return out


def _float(word: str, path: Path, line: int) -> float:
    try:
        return float(word)
    except ValueError:
        raise LightFileError(
            f"{path}: line {line}: expected a number, got {word!r}; a header names the columns x, "
            "y and z, with a unit as in x_mm"
        ) from None
