"""The state of a fit in one file."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np

from appearance.inverse_rendering.unknowns import Raw
from appearance.metrics.decision import Decision
from reconstruction.arrays import Array
from reconstruction.files.durable import writing


@dataclass
class State:
    """The state of a fit after the stages of `decisions`: `raw`, factors on the intensities
    `gain (L,)`, and `lobes (L, 6)`, if any; `left_open` is that of `Outcome`."""

    raw: Raw
    gain: Array
    decisions: list[Decision] = field(default_factory=list)
    left_open: dict[str, float] = field(default_factory=dict)
    lobes: Array | None = None

    def save(self, path: Path | None, fingerprint: str) -> None:
        """Write the state, whole or not at all; nothing where `path` is None."""
        if path is None:
            return
        numbers = {
            "fingerprint": fingerprint,
            "decisions": [asdict(x) for x in self.decisions],
            "left_open": self.left_open,
        }
        arrays = {f"raw/{name}": value for name, value in self.raw.items()} | {"gain": self.gain}
        if self.lobes is not None:
            arrays["lobes"] = self.lobes
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
            raw = {k.removeprefix("raw/"): data[k] for k in data.files if k.startswith("raw/")}
            decisions = [Decision(**x) for x in numbers["decisions"]]
            lobes = data["lobes"] if "lobes" in data.files else None
            return cls(raw, data["gain"], decisions, numbers["left_open"], lobes)
