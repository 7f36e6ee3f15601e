"""What a hair fibre looks like, independent of any renderer."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from typing import Annotated, Any, Self

from pydantic import Field

from reconstruction.options import options, parse_options

Absorption = Annotated[float, Field(ge=0)]
Albedo = Annotated[float, Field(ge=0, le=1)]
Roughness = Annotated[float, Field(ge=0.001, le=1)]


@options
class HairAppearance:
    """Parameters of a hair fibre that has one colour along its length.

    `sigma_a` is the absorption per fibre radius and linear RGB channel (dimensionless);
    `beta_m`, `beta_n` are Chiang's longitudinal and azimuthal roughness in [0.001, 1]; `eta` is the
    fibre's index of refraction relative to the air; `tilt_deg` is the cuticle's tilt in degrees,
    for strands that run from root to tip, where a positive tilt moves the R highlight towards the
    root. Raises `ValueError` naming the field that is out of range.
    """

    sigma_a: tuple[Absorption, Absorption, Absorption]
    beta_m: Roughness
    beta_n: Roughness
    eta: Annotated[float, Field(ge=1.0001, le=5)] = 1.55
    tilt_deg: Annotated[float, Field(ge=-20, le=20)] = 2.0

    def to_dict(self) -> dict[str, Any]:
        """A JSON-ready description that `from_dict` reads back exactly."""
        return {**asdict(self), "sigma_a": list(self.sigma_a)}

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> Self:
        """Read what `to_dict` wrote; `BadOptions` names a field that is unknown or absent."""
        return parse_options(cls, data, "hair")


@options
class DiffuseHair:
    """Fibres as Lambertian cylinders of `albedo (3,)` in [0, 1]: the trivial baseline."""

    albedo: tuple[Albedo, Albedo, Albedo]
