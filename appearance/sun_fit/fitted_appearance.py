"""The result of Sun's fit in a model: `appearance.json`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

from pydantic import TypeAdapter

from appearance.metrics.scores import Exposure
from appearance.observations import HeldOut
from appearance.scene.hair_appearance import HairAppearance
from reconstruction import Model, ModelError

_Interval = tuple[float, float]
_Errors = tuple[float | None, float | None, float | None]

UNCERTAIN = 0.2
"""Standard error of log sigma_a above which a user is warned."""


def absorption_warnings(sigma_a: Sequence[float], errors: Sequence[float | None]) -> list[str]:
    """Which channels of an absorption (3,) with these relative errors are uncertain."""
    return [
        f"sigma_a of {name}, {value:.2g}, "
        + ("cannot be estimated from the colour" if e is None else f"is uncertain by {e:.0%}")
        for name, value, e in zip(("red", "green", "blue"), sigma_a, errors, strict=True)
        if e is None or e > UNCERTAIN
    ]


@dataclass(frozen=True)
class FittedAppearance:
    """A model's appearance.

    `hair` is the material to render the model's strands with. `colour (3,)` is the
    multiple-scattering albedo of its absorption, `skin (3,)` a diffuse albedo, `exposure` the
    capture's. `v` is the longitudinal variance of `hair.beta_m`; `plain_v` and `printed_v` are
    those of the captured lobe with a floor and, as Sun's Eq. 10, without. `held_out` are the frames
    not used. `beta_m_error` is the standard error of log β_M, `beta_m_interval` an interval of
    about 95 %, and `sigma_a_error (3,)` the standard error of log sigma_a, None in a channel whose
    colour does not depend on it. All three are None if `hair` was not fitted.
    """

    hair: HairAppearance
    colour: tuple[float, float, float]
    skin: tuple[float, float, float]
    exposure: Exposure
    v: float
    plain_v: float
    printed_v: float
    held_out: HeldOut
    beta_m_error: float | None = None
    beta_m_interval: _Interval | None = None
    sigma_a_error: _Errors | None = None

    def save(self, model: Model) -> None:
        """Write `appearance.json`."""
        data = {**asdict(self), "hair": self.hair.to_dict(), "exposure": self.exposure.scale}
        model.write_json("appearance.json", data)

    @classmethod
    def is_of(cls, model: Model, held_out: HeldOut) -> bool:
        """Whether a model has a readable appearance that was fitted without these frames."""
        try:
            made = cls.load(model).held_out
        except ModelError:
            return False
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
                TypeAdapter(float | None).validate_python(data.get("beta_m_error")),
                TypeAdapter(_Interval | None).validate_python(data.get("beta_m_interval")),
                TypeAdapter(_Errors | None).validate_python(data.get("sigma_a_error")),
            )
        except (KeyError, IndexError, TypeError, ValueError) as error:
            path = model.file("appearance.json")
            raise ModelError(f"{path}: {error!r}: run 'hairstage fit' again") from error
