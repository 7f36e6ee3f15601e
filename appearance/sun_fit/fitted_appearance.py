"""What Sun's fit leaves in a model: `appearance.json`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

from pydantic import TypeAdapter

from appearance.metrics.scores import Exposure
from appearance.observations import HeldOut
from appearance.scene.hair_appearance import HairAppearance
from reconstruction import Model, ModelError

_Errors = tuple[float | None, float | None, float | None]

UNCERTAIN = 0.2
"""Standard error of log sigma_a above which a user is warned."""


@dataclass(frozen=True)
class Fibres:
    """The roughness of the hair's fibres, whatever the strands that stand for them.

    `error` is the standard error of log β_M, `low` and `high` the ends of an interval of about
    95 %. `disorder_deg` is by how much single hairs turn beyond the model's strands, root mean
    square, and the next two the ends of its interval; None where that was not measured.
    """

    beta_m: float
    error: float
    low: float
    high: float
    disorder_deg: float | None = None
    disorder_low_deg: float | None = None
    disorder_high_deg: float | None = None


def absorption_warnings(sigma_a: Sequence[float], errors: Sequence[float | None]) -> list[str]:
    """What a user has to know of an absorption (3,) with these relative errors to believe it."""
    return [
        f"sigma_a of {name}, {value:.2g}, "
        + ("cannot be told from the colour" if e is None else f"is uncertain by {e:.0%}")
        for name, value, e in zip(("red", "green", "blue"), sigma_a, errors, strict=True)
        if e is None or e > UNCERTAIN
    ]


@dataclass(frozen=True)
class FittedAppearance:
    """A model's appearance.

    `hair` is what to render the model's strands with: strands that are smoother than hair are
    rendered rougher than its `fibres` are. `colour (3,)` is the multiple-scattering albedo behind
    its absorption, `skin (3,)` a diffuse albedo, `exposure` the capture's. `v` is the longitudinal
    variance behind `hair.beta_m`; `plain_v` and `printed_v` are what the captured lobe reads before
    the correction by rendering, with a floor and (as Sun's Eq. 10) without. `held_out` is what
    the fit did not observe. `sigma_a_error (3,)` is the standard error of log sigma_a, None where
    the hair's colour does not answer to it. `fibres` and `sigma_a_error` are None where `hair` is
    not what was fitted.
    """

    hair: HairAppearance
    colour: tuple[float, float, float]
    skin: tuple[float, float, float]
    exposure: Exposure
    v: float
    plain_v: float
    printed_v: float
    held_out: HeldOut
    fibres: Fibres | None = None
    sigma_a_error: _Errors | None = None

    def save(self, model: Model) -> None:
        """Write `appearance.json`."""
        data = {**asdict(self), "hair": self.hair.to_dict(), "exposure": self.exposure.scale}
        model.write_json("appearance.json", data)

    @classmethod
    def is_of(cls, model: Model, held_out: HeldOut) -> bool:
        """Whether the model has an appearance whose fit left out these cameras and lights.

        One that cannot be read, or is of an earlier version, is none: it has to be fitted again.
        """
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
                TypeAdapter(Fibres | None).validate_python(data["fibres"]),
                TypeAdapter(_Errors | None).validate_python(data["sigma_a_error"]),
            )
        except (KeyError, IndexError, TypeError, ValueError) as error:
            path = model.file("appearance.json")
            raise ModelError(f"{path}: {error!r}: run 'hairstage fit' again") from error
