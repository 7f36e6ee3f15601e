"""Sets of patterns of lights: each frame is lit by a weighted sum of lights.

A table is CSV, a row for each pattern: its name, then a weight for each light of the header; or
JSON, an object of patterns by name, each an object of weights by light or a list of lights at full
level. A light that is not named is off.
"""

from __future__ import annotations

import csv
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from reconstruction.arrays import Array
from reconstruction.containment import is_file_name
from reconstruction.files.lights import light_name
from reconstruction.geometry.lights import LightPattern
from reconstruction.geometry.rig import Rig, counted
from reconstruction.reading import read_json, read_text

Table = Mapping[str, Mapping[str, float]]
"""By pattern, weights by light."""
TABLES = ("patterns.csv", "patterns.json")
ILL_CONDITIONED = 1e3
"""Condition number from which on errors of weights of 0.1 % are as large as single lights."""


class PatternError(ValueError):
    """An invalid set of patterns; the message names the pattern or the light."""


@dataclass(frozen=True, eq=False)
class LightPatterns:
    """Patterns called `names (P)`: `weights (P, L)`, 0 to 1, of the `lights (L)`.

    Raises `PatternError` for a set that is empty or inconsistent.
    """

    names: tuple[str, ...]
    lights: tuple[str, ...]
    weights: Array

    def __post_init__(self) -> None:
        weights = np.asarray(self.weights, float)
        expected = (len(self.names), len(self.lights))
        if weights.shape != expected or 0 in expected:
            raise PatternError(
                f"expected weights of {expected[0]} patterns × {expected[1]} lights, at least one "
                f"of each, got the shape {weights.shape}"
            )
        for kind, names in (("pattern", self.names), ("light", self.lights)):
            if twice := {n for n in names if names.count(n) > 1}:
                raise PatternError(f"two columns or rows are of the {kind} {min(twice)!r}")
        if wrong := [n for n in self.names if not is_file_name(n) or n in self.lights]:
            raise PatternError(f"a pattern needs a file's name that no light has, got {wrong[0]!r}")
        for name, row in zip(self.names, weights, strict=True):
            bad = ~((row >= 0) & (row <= 1))  # or not a number
            if bad.any():
                k = int(np.flatnonzero(bad)[0])
                raise PatternError(
                    f"pattern {name}: the weight of {self.lights[k]} must be 0 to 1, got {row[k]}"
                )
            if not row.any():
                raise PatternError(f"pattern {name} lights nothing: remove it, or correct its row")
        object.__setattr__(self, "weights", weights)

    def rows(self, names: Sequence[str]) -> Array:
        """Weights of some of the patterns `(len(names), L)`."""
        return self.weights[[self.names.index(n) for n in names]]

    def pattern(self, name: str, rig: Rig) -> LightPattern:
        """The lights of one pattern."""
        row = self.weights[self.names.index(name)]
        lit = np.flatnonzero(row)
        return LightPattern(name, tuple(rig.light(self.lights[k]) for k in lit), row[lit])

    def to_dict(self) -> dict[str, Any]:
        """As `of_plan` reads it."""
        rows = zip(self.names, self.weights.tolist(), strict=True)
        return {"lights": list(self.lights), "weights": dict(rows)}

    @classmethod
    def of_table(cls, table: Table, lights: Sequence[str]) -> LightPatterns:
        """The patterns of a `Table` for a rig's `lights`; see `read_patterns`."""
        rows = {name: _matching(row, lights) for name, row in table.items()}
        if named := sorted(set(rows) & set(lights)):
            raise PatternError(f"a pattern needs a file's name that no light has, got {named[0]!r}")
        used = list(dict.fromkeys(x for row in rows.values() for x, w in row.items() if w != 0))
        weights = [[row.get(x, 0.0) for x in used] for row in rows.values()]
        return cls(tuple(rows), tuple(used), np.array(weights, float).reshape(len(rows), len(used)))

    @classmethod
    def of_plan(cls, plan: Mapping[str, Any], rig: Rig, used: Collection[str]) -> LightPatterns:
        """The `patterns` of a plan whose frames have the patterns `used`. Raises `PatternError`."""
        try:
            data = plan["patterns"]
            lights, weights = tuple(map(str, data["lights"])), data["weights"]
            table = np.array([list(map(float, row)) for row in weights.values()])
            out = cls(tuple(weights), lights, table)
        except PatternError:
            raise
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            raise PatternError(f"expected lights and weights by pattern ({error!r})") from error
        _known(lights, [x.name for x in rig.lights])
        if missing := sorted(set(used) - set(out.names)):
            raise PatternError(f"no pattern {missing[0]!r}; {counted(out.names)}")
        return out


@dataclass(frozen=True, eq=False)
class Demultiplexing:
    """Least squares from patterns `weights (P, L)` to single lights; `variances (P,)` of a frame's
    noise, equal by default. The lights are determined if the rank is L."""

    weights: Array
    variances: Array | None = None

    @cached_property
    def spans(self) -> bool:
        """Whether the patterns determine every light."""
        return int(np.linalg.matrix_rank(self.weights)) == self.weights.shape[1]

    @cached_property
    def matrix(self) -> Array:
        """What turns frames into single lights `(L, P)`: (Wᵀ V⁻¹ W)⁻¹ Wᵀ V⁻¹."""
        scale = 1.0 if self.variances is None else self.variances**-0.5
        return np.asarray(np.linalg.pinv((self.weights.T * scale).T) * scale)

    @property
    def condition(self) -> float:
        """Largest over smallest singular value; infinite where lights are undetermined."""
        return float(np.linalg.cond(self.weights)) if self.spans else np.inf

    @cached_property
    def read_gain(self) -> Array:
        """Noise of each light `(L,)` over that of its single frame, of noise that does not depend
        on the light (of reading): the root of the diagonal of (WᵀW)⁻¹ for equal variances
        (Schechner, Nayar, Belhumeur, IEEE TPAMI 29(8), 2007)."""
        return np.asarray(np.sqrt(np.square(self.matrix).sum(axis=1)))

    @cached_property
    def photon_gain(self) -> Array:
        """The same of photon noise, for lights that are equally bright in a pixel."""
        return np.asarray(np.sqrt(np.square(self.matrix) @ self.weights.sum(axis=1)))

    def warnings(self) -> list[str]:
        """Why demultiplexed lights are worse than single frames; empty if they are not."""
        out = []
        if self.condition > ILL_CONDITIONED:
            out.append(
                f"the patterns hardly determine the lights (condition number {self.condition:.2g}):"
                " errors of weights and noise are amplified; add patterns, or fit the patterns"
            )
        for kind, gain in (("read noise", self.read_gain), ("photon noise", self.photon_gain)):
            if gain.max() > 1:
                out.append(
                    f"{kind} of {int((gain > 1).sum())} of {len(gain)} lights is amplified, up to "
                    f"{gain.max():.2g} times, against single frames of the same exposure and level"
                )
        return out


def read_patterns(path: Path, lights: Sequence[str]) -> LightPatterns:
    """The patterns of a table for a rig's `lights`; those of no pattern are left out.

    A light is named as in the rig or by its number at the end. Raises `PatternError`.
    """
    table = read_table(path)
    try:
        return LightPatterns.of_table(table, lights)
    except ValueError as error:
        raise PatternError(f"{path}: {error}") from error


def read_table(path: Path) -> Table:
    """The weights by light of each pattern, by the names in the file. Raises `PatternError`."""
    readers = {".csv": _csv, ".json": _json}
    if path.suffix.lower() not in readers:
        raise PatternError(f"{path}: expected a table of patterns ({', '.join(readers)})")
    try:
        return readers[path.suffix.lower()](path)
    except (OSError, ValueError, TypeError) as error:
        text = error.strerror if isinstance(error, OSError) else str(error)
        raise PatternError(f"{path}: {str(text).removeprefix(f'{path}: ')}") from error


def _csv(path: Path) -> Table:
    lines = [row for row in csv.reader(read_text(path).splitlines()) if any(row)]
    if len(lines) < 2 or len(lines[0]) < 2:
        raise PatternError("expected a header with the lights and a row for each pattern")
    header, out = [h.strip() for h in lines[0]], dict[str, dict[str, float]]()
    for name, *values in lines[1:]:
        if len(values) != len(header) - 1 or name.strip() in out:
            raise PatternError(
                f"pattern {name}: expected one row of {len(header) - 1} weights, got {len(values)}"
            )
        try:
            pairs = zip(header[1:], map(float, values), strict=True)
            out[name.strip()] = dict(pairs)
        except ValueError as error:
            raise PatternError(f"pattern {name}: {error}") from error
    return out


def _json(path: Path) -> Table:
    data = read_json(path)
    data = data.get("patterns", data) if isinstance(data, dict) else data
    if not isinstance(data, dict):
        raise PatternError("expected an object of patterns by name")
    out = dict[str, dict[str, float]]()
    for name, row in data.items():
        weights = dict.fromkeys(map(str, row), 1.0) if isinstance(row, list) else row
        if not isinstance(weights, Mapping):
            raise PatternError(f"pattern {name}: expected weights by light, or a list of lights")
        out[name] = {light: float(w) for light, w in weights.items()}
    return out


def _matching(row: Mapping[str, float], lights: Sequence[str]) -> dict[str, float]:
    """A row of a table by the rig's names."""
    numbers = {light_name(x.rsplit("_", 1)[-1]): x for x in lights if x[-1:].isdigit()}
    found = [n if n in lights else numbers.get(light_name(n.rsplit("_", 1)[-1]), n) for n in row]
    _known(found, lights)
    if len(set(found)) < len(found):
        raise PatternError("two columns are of the same light")
    return dict(zip(found, row.values(), strict=True))


def _known(names: Sequence[str], lights: Sequence[str]) -> None:
    if unknown := [n for n in names if n not in lights]:
        raise PatternError(f"there is no light {unknown[0]!r}; {counted(lights)}")
