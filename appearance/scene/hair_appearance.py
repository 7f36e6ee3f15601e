"""What a hair fibre looks like, independent of any renderer."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from typing import Any, Self


@dataclass(frozen=True)
class HairAppearance:
    """Parameters of a hair fibre that has one colour along its length.

    `sigma_a` is the absorption per fibre radius and linear RGB channel (dimensionless);
    `beta_m`, `beta_n` are Chiang's longitudinal and azimuthal roughness in [0.001, 1]; `eta` is the
    fibre's index of refraction relative to the air; `tilt_deg` is the cuticle's tilt in degrees,
    for strands that run from root to tip, where a positive tilt moves the R highlight towards the
    root. Raises `ValueError` naming the field that is out of range.
    """

    sigma_a: tuple[float, float, float]
    beta_m: float
    beta_n: float
    eta: float = 1.55
    tilt_deg: float = 2.0

    def __post_init__(self) -> None:
        object.__setattr__(self, "sigma_a", _rgb("sigma_a", self.sigma_a, 0.0, float("inf")))
        for name, low, high in (
            ("beta_m", 0.001, 1.0),
            ("beta_n", 0.001, 1.0),
            ("eta", 1.0001, 5.0),
        ):
            value = float(getattr(self, name))
            if not low <= value <= high:
                raise ValueError(f"hair: {name} must be in [{low:g}, {high:g}], got {value}")
            object.__setattr__(self, name, value)
        if not abs(self.tilt_deg) <= 20:
            raise ValueError(f"hair: tilt_deg must be in [-20, 20], got {self.tilt_deg}")

    def to_dict(self) -> dict[str, Any]:
        """A JSON-ready description that `from_dict` reads back exactly."""
        return {**asdict(self), "sigma_a": list(self.sigma_a)}

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> Self:
        """Read what `to_dict` wrote; `ValueError` names a field that is unknown or absent."""
        known = {f.name for f in fields(cls)}
        if unknown := set(data) - known:
            raise ValueError(f"hair: unknown fields {sorted(unknown)}; known are {sorted(known)}")
        if absent := {"sigma_a", "beta_m", "beta_n"} - set(data):
            raise ValueError(f"hair: the fields {sorted(absent)} are missing")
        return cls(**data)


@dataclass(frozen=True)
class DiffuseHair:
    """Fibres as Lambertian cylinders of `albedo (3,)` in [0, 1]: the trivial baseline."""

    albedo: tuple[float, float, float]

    def __post_init__(self) -> None:
        object.__setattr__(self, "albedo", _rgb("albedo", self.albedo, 0.0, 1.0))


def _rgb(name: str, value: Any, low: float, high: float) -> tuple[float, float, float]:
    channels = tuple(float(v) for v in value)
    if len(channels) != 3 or not all(low <= v <= high and v < float("inf") for v in channels):
        raise ValueError(
            f"hair: {name} must be 3 finite numbers in [{low:g}, {high:g}], got {value}"
        )
    return channels[0], channels[1], channels[2]
