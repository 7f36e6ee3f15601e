"""What is fitted, as unconstrained numbers, and the values of the renderer that they stand for.

Absorption is the logit of a colour C with sigma = (log C / 6)²: black and white hair are both far
away, and equal steps look about equally large. Roughness and index are logits of their ranges,
correctives a tanh of theirs; all of them smooth, with finite derivatives everywhere.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.spatial.transform import Rotation
from scipy.special import expit

from appearance.bsdf.maps import HairMaps
from reconstruction import Light
from reconstruction.arrays import Array, Ints

Raw = dict[str, Array]
"""Unconstrained numbers by name. Of lights: "position" offsets in metres, "turn" axis-angles in
radians, "profile" logarithms of a factor for each profile."""

BRACKET = 6.0
"""About Chiang's polynomial at beta_N = 0.3: here it only shapes the parametrisation."""
RANGES = {"beta_m": (0.01, 0.99), "beta_n": (0.01, 0.99), "eta": (1.2, 2.2)}
MOST_TURN = 0.6
"""Radians of a corrective's component."""
MOST_TILT = 10.0
_PLUGIN = {"beta_m": "longitudinal_roughness", "beta_n": "azimuthal_roughness", "eta": "eta"}
_FARTHEST = 16.0


@dataclass(frozen=True, eq=False)
class LightDeviations:
    """How the lights differ from their calibration, for all L lights of a fit.

    `position (L, 3)` metres, `turn (L, 3)` radians about the light's centre in the world's frame,
    `gain (L,)` and `profile (L,)` factors on the intensity; those of one profile share the latter.
    """

    position: Array
    turn: Array
    gain: Array
    profile: Array

    @classmethod
    def calibrated(cls, count: int) -> LightDeviations:
        """No difference."""
        return cls(np.zeros((count, 3)), np.zeros((count, 3)), np.ones(count), np.ones(count))

    def applied(self, lights: Sequence[Light]) -> list[Light]:
        """The `lights` as they are found to be."""
        out = []
        for i, light in enumerate(lights):
            turned = light.orientation
            if turned is not None:
                turned = turned @ Rotation.from_rotvec(self.turn[i]).as_matrix().T
            out.append(
                replace(
                    light,
                    position=light.position + self.position[i],
                    intensity=light.intensity * self.gain[i] * self.profile[i],
                    orientation=turned,
                )
            )
        return out


def encode(maps: HairMaps, lights: LightDeviations, profile_of: Ints) -> Raw:
    """The unconstrained numbers of `maps` and `lights`; `profile_of (L,)` numbers the profiles."""
    raw = {
        "sigma_a": encode_absorption(maps.sigma_a),
        "rotation": encode_rotation(maps.rotation),
        "tilt_deg": np.array(
            [MOST_TILT * np.arctanh(np.clip(maps.tilt_deg / MOST_TILT, -0.99, 0.99))]
        ),
        "position": lights.position.copy(),
        "turn": lights.turn.copy(),
        "profile": np.array(
            [np.log(lights.profile[profile_of == k][0]) for k in range(profile_of.max() + 1)]
        ),
    }
    for name, (low, high) in RANGES.items():
        share = np.clip((getattr(maps, name) - low) / (high - low), 1e-4, 1 - 1e-4)
        raw[name] = np.array([np.log(share / (1 - share))])
    return raw


def hair_values(raw: Mapping[str, Any]) -> dict[str, Any]:
    """The BSDF's parameters by their names in `DifferentiableOlat`, from Dr.Jit tensors."""
    values: dict[str, Any] = {
        "hair.sigma_a": (_log_sigmoid(raw["sigma_a"]) * (1 / BRACKET)) ** 2,
        "hair.rotation": MOST_TURN * dr.tanh(raw["rotation"] * (1 / MOST_TURN)),
        "hair.scale_tilt": mi.Float((-MOST_TILT * dr.tanh(raw["tilt_deg"] / MOST_TILT)).array),
    }
    for name, (low, high) in RANGES.items():
        share = 0.5 + 0.5 * dr.tanh(0.5 * raw[name])
        values[f"hair.{_PLUGIN[name]}"] = mi.Float((low + (high - low) * share).array)
    return values


def decode(raw: Raw) -> HairMaps:
    """The maps that the numbers stand for."""
    scalars = {
        name: float(low + (high - low) * (0.5 + 0.5 * np.tanh(0.5 * raw[name][0])))
        for name, (low, high) in RANGES.items()
    }
    return HairMaps(
        (np.logaddexp(0, -raw["sigma_a"]) / BRACKET) ** 2,
        MOST_TURN * np.tanh(raw["rotation"] / MOST_TURN),
        tilt_deg=float(MOST_TILT * np.tanh(raw["tilt_deg"][0] / MOST_TILT)),
        **scalars,
    )


def slopes(raw: Raw) -> Raw:
    """Derivatives of the maps' absorption, roughnesses and index by their numbers."""
    x = raw["sigma_a"]
    out = {"sigma_a": -2 / BRACKET**2 * np.logaddexp(0, -x) * expit(-x)}
    for name, (low, high) in RANGES.items():
        share = expit(raw[name])
        out[name] = (high - low) * share * (1 - share)
    return out


def encode_absorption(sigma_a: Array) -> Array:
    """The logit of the colour C of `sigma_a (…, 3)`: to 1e-7 from 1 and down to any blackness."""
    log_colour = -BRACKET * np.sqrt(np.maximum(sigma_a, 1e-12))
    short = np.maximum(-np.expm1(log_colour), 1e-7)
    return log_colour - np.log(short)


def encode_rotation(rotation: Array) -> Array:
    """The unconstrained numbers of correctives `(…, 2)`, those at their limit just within it."""
    return np.asarray(MOST_TURN * np.arctanh(np.clip(rotation / MOST_TURN, -0.999, 0.999)))


def _log_sigmoid(x: Any) -> Any:
    """log(1/(1 + exp(-x))), accurate for large x too."""
    # 1 + e loses e below 1e-7; its series does not
    e = dr.exp(-dr.abs(x))
    log1p = dr.select(e < 1e-3, e * (1 - 0.5 * e), dr.log(1 + e))
    return dr.minimum(x, 0) - log1p
