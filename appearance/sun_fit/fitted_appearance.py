"""What Sun's fit leaves in a model: `appearance.json`."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

from appearance.metrics.scores import Exposure
from appearance.observations import HeldOut
from appearance.scene.hair_appearance import HairAppearance
from reconstruction import Model, ModelError


@dataclass(frozen=True)
class FittedAppearance:
    """A model's appearance.

    `hair` is what to render with, `colour (3,)` the multiple-scattering albedo behind its
    absorption, `skin (3,)` a diffuse albedo, `exposure` the capture's. `v` is the longitudinal
    variance behind `hair.beta_m`; `plain_v` and `printed_v` are what the captured lobe reads before
    the correction by rendering, with a floor and (as Sun's Eq. 10) without. `held_out` is what
    the fit did not observe.
    """

    hair: HairAppearance
    colour: tuple[float, float, float]
    skin: tuple[float, float, float]
    exposure: Exposure
    v: float
    plain_v: float
    printed_v: float
    held_out: HeldOut

    def save(self, model: Model) -> None:
        """Write `appearance.json`."""
        data = {**asdict(self), "hair": self.hair.to_dict(), "exposure": self.exposure.scale}
        model.write_json("appearance.json", data)

    @classmethod
    def is_of(cls, model: Model, held_out: HeldOut) -> bool:
        """Whether the model has an appearance whose fit left out these cameras and lights."""
        if not model.has("appearance.json"):
            return False
        made = cls.load(model).held_out
        return all(
            set(a) == set(b)
            for a, b in ((made.cameras, held_out.cameras), (made.lights, held_out.lights))
        )

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
                float(data["v"]),
                float(data["plain_v"]),
                float(data["printed_v"]),
                HeldOut(*(tuple(data["held_out"][k]) for k in ("cameras", "lights"))),
            )
        except (KeyError, IndexError, TypeError, ValueError) as error:
            path = model.file("appearance.json")
            raise ModelError(f"{path}: {error!r}: run 'hairstage fit' again") from error
