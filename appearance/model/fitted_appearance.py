"""What a fit leaves in a model folder: `appearance.json`."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from appearance.metrics.scores import Exposure
from appearance.scene.hair_appearance import HairAppearance


@dataclass(frozen=True)
class FittedAppearance:
    """A model's appearance.

    `hair` is what to render with, `colour (3,)` the multiple-scattering albedo behind its
    absorption, `skin (3,)` a diffuse albedo, `exposure` the capture's. `v` is the longitudinal
    variance behind `hair.beta_m`; `plain_v` and `printed_v` are what the captured lobe reads before
    the correction by rendering, with a floor and (as Sun's Eq. 10) without.
    """

    hair: HairAppearance
    colour: tuple[float, float, float]
    skin: tuple[float, float, float]
    exposure: Exposure
    v: float
    plain_v: float
    printed_v: float

    def save(self, model: Path) -> None:
        """Write `appearance.json` in the folder `model`, whole or not at all."""
        path = model / "appearance.json"
        data = {**asdict(self), "hair": self.hair.to_dict(), "exposure": self.exposure.scale}
        temporary = path.with_suffix(".part")
        temporary.write_text(json.dumps(data, indent=1, allow_nan=False) + "\n")
        temporary.replace(path)

    @classmethod
    def load(cls, model: Path) -> FittedAppearance:
        """Read `appearance.json` of `model`; errors name the file and what to do."""
        path = model / "appearance.json"
        if not path.is_file():
            raise FileNotFoundError(f"{path} is missing: run 'hairstage fit CAPTURE {model}' first")
        data: dict[str, Any] = json.loads(path.read_text())
        try:
            colour, skin = (tuple(float(x) for x in data[k]) for k in ("colour", "skin"))
            return cls(
                HairAppearance.from_dict(data["hair"]),
                (colour[0], colour[1], colour[2]),
                (skin[0], skin[1], skin[2]),
                Exposure(float(data["exposure"])),
                *(float(data[k]) for k in ("v", "plain_v", "printed_v")),
            )
        except (KeyError, IndexError, TypeError, ValueError) as error:
            raise ValueError(f"{path}: {error!r}: run 'hairstage fit' again") from error
