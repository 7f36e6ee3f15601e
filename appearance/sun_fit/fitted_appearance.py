"""What Sun's fit leaves in a model: `appearance.json`."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from pydantic import TypeAdapter

from appearance.bsdf.longitudinal import (
    LEAST_VARIANCE,
    roughness_of_variance,
    roughness_without_scatter,
    variance_of_roughness,
)
from appearance.metrics.scores import Exposure
from appearance.observations import HeldOut
from appearance.scene.hair_appearance import HairAppearance
from reconstruction import Model, ModelError

UNCERTAIN = 0.2
"""Standard error of log sigma_a above which a user is warned."""


@dataclass(frozen=True)
class Uncertainty:
    """What a fit knows of its error.

    `beta_m` is the standard error of log β_M, `beta_m_low` and `beta_m_high` the ends of an
    interval of about 95 %; `sigma_a (3,)` the standard error of log sigma_a, None where the hair's
    colour does not answer to it. `tangents_deg` is how far the strands' inclinations are off, root
    mean square, `tangents_error_deg` its standard error; None where a fit of an earlier version
    did not say.
    """

    beta_m: float
    beta_m_low: float
    beta_m_high: float
    sigma_a: tuple[float | None, float | None, float | None]
    tangents_deg: float | None = None
    tangents_error_deg: float | None = None

    def warnings(self, sigma_a: tuple[float, float, float]) -> list[str]:
        """What a user has to know of an absorption `sigma_a` before believing it."""
        return [
            f"sigma_a of {name}, {value:.2g}, "
            + ("cannot be told from the colour" if e is None else f"is uncertain by {e:.0%}")
            for name, value, e in zip(("red", "green", "blue"), sigma_a, self.sigma_a, strict=True)
            if e is None or e > UNCERTAIN
        ]


@dataclass(frozen=True)
class FittedAppearance:
    """A model's appearance.

    `hair` is what to render with, `colour (3,)` the multiple-scattering albedo behind its
    absorption, `skin (3,)` a diffuse albedo, `exposure` the capture's. `v` is the longitudinal
    variance behind `hair.beta_m`; `plain_v` and `printed_v` are what the captured lobe reads before
    the correction by rendering, with a floor and (as Sun's Eq. 10) without. `held_out` is what
    the fit did not observe. `uncertainty` is None where `hair` is not what was fitted.
    """

    hair: HairAppearance
    colour: tuple[float, float, float]
    skin: tuple[float, float, float]
    exposure: Exposure
    v: float
    plain_v: float
    printed_v: float
    held_out: HeldOut
    uncertainty: Uncertainty | None = None

    def fibre_beta_m(self, beta_m: float) -> float | None:
        """The fibres' β_M, where pictures of these strands ask for `beta_m`: without their scatter.

        None where the scatter of directions is not known, or is most of what the pictures show.
        """
        if self.uncertainty is None or self.uncertainty.tangents_deg is None:
            return None
        return roughness_without_scatter(beta_m, math.radians(self.uncertainty.tangents_deg))

    def fibre_beta_m_range(self, beta_m: float) -> tuple[float, float] | None:
        """The ends of an interval of about 95 % about `fibre_beta_m`.

        Two standard errors of the fibres' variance to both sides, from those of the scatter and of
        `beta_m`, taken to be known as well as Sun's fit knows it. The low end is 0 where nothing of
        the lobe need be the fibres'. None where the errors, or the fibres' β_M, are not known.
        """
        known, fibre = self.uncertainty, self.fibre_beta_m(beta_m)
        if known is None or fibre is None or known.tangents_error_deg is None:
            return None
        rougher, smoother = (min(beta_m * math.exp(k * known.beta_m), 1.0) for k in (1, -1))
        whole = variance_of_roughness([fibre, rougher, smoother])
        scatter = math.radians(known.tangents_deg or 0.0)
        error = math.radians(known.tangents_error_deg)
        off = 2 * math.hypot(0.5 * (whole[1] - whole[2]), 8 * scatter * error)
        ends = np.maximum(whole[0] + np.array([-off, off]), LEAST_VARIANCE)
        low, high = roughness_of_variance(ends).tolist()
        return (low if ends[0] > LEAST_VARIANCE else 0.0), high

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
                TypeAdapter(Uncertainty | None).validate_python(data["uncertainty"]),
            )
        except (KeyError, IndexError, TypeError, ValueError) as error:
            path = model.file("appearance.json")
            raise ModelError(f"{path}: {error!r}: run 'hairstage fit' again") from error
