"""A fit's whole state in one file."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np

from appearance.inverse_rendering.descent import Adam, Convergence
from appearance.inverse_rendering.unknowns import Raw
from reconstruction.arrays import Array
from reconstruction.files.durable import writing


@dataclass
class State:
    """Where a fit stands. `average` is the running mean of `raw` that is validated and returned.

    `first` is what the steps began with, behind so many `pieces` that need no gradient, which left
    numbers `left_open`. `tables` are the pairs' estimated `squared_error (V, L)` and the lights'
    `gain (L,)`.
    """

    raw: Raw
    average: Raw
    first: Raw
    descent: Adam = field(default_factory=Adam)
    convergence: Convergence = field(default_factory=Convergence)
    pieces: int = 0
    left_open: dict[str, float] = field(default_factory=dict)
    step: int = 0
    level_began: int = 0
    history: list[list[float]] = field(default_factory=list)
    tables: Raw = field(default_factory=dict)

    @property
    def gain(self) -> Array:
        """The factors on the lights' intensities `(L,)`."""
        return self.tables["gain"]

    def save(self, path: Path | None, fingerprint: str) -> None:
        """Write the state, whole or not at all; nothing where `path` is None."""
        if path is None:
            return
        arrays: Raw = {}
        for kind, table in self._tables().items():
            arrays |= {f"{kind}/{name}": value for name, value in table.items()}
        numbers = {
            "fingerprint": fingerprint,
            "count": self.descent.count,
            "convergence": asdict(self.convergence),
            "pieces": self.pieces,
            "left_open": self.left_open,
            "step": self.step,
            "level_began": self.level_began,
            "history": self.history,
        }
        with writing(path) as part:
            np.savez(part, numbers=np.array(json.dumps(numbers)), **arrays)  # type: ignore[arg-type]

    @classmethod
    def load(cls, path: Path | None, fingerprint: str) -> State | None:
        """Read a state; None where there is no file, or one of another fit."""
        if path is None or not path.is_file():
            return None
        with np.load(path) as data:
            numbers = json.loads(str(data["numbers"]))
            if numbers["fingerprint"] != fingerprint:
                return None
            state = cls({}, {}, {}, Adam(numbers["count"]), Convergence(**numbers["convergence"]))
            for key in data.files:
                kind, _, name = key.partition("/")
                if name:
                    state._tables()[kind][name] = data[key]
        for name in ("pieces", "left_open", "step", "level_began", "history"):
            setattr(state, name, numbers[name])
        return state

    def _tables(self) -> dict[str, Raw]:
        return {
            "raw": self.raw,
            "average": self.average,
            "first": self.first,
            "first moment": self.descent.first,
            "second moment": self.descent.second,
            "tables": self.tables,
        }
