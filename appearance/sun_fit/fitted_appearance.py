"""What Sun's fit leaves in a model: `appearance.json`."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

from appearance.metrics.scores import Exposure
from appearance.scene.hair_appearance import HairAppearance
from reconstruction import Model, ModelError


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

    def save(self, model: Model) -> None:
        """Write `appearance.json`."""
        data = {**asdict(self), "hair": self.hair.to_dict(), "exposure": self.exposure.scale}
        model.write_json("appearance.json", data)

    @classmethod
    def load(cls, model: Model) -> FittedAppearance:
        """Read `appearance.json`; `ModelError` names the file and what to do."""
        data: dict[str, Any] = model.json("appearance.json")
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
            path = model.file("appearance.json")
            raise ModelError(f"{path}: {error!r}: run 'hairstage fit' again") from error
