"""The fitted maps as unconstrained numbers, and back.

Absorption is the logit of a colour C with sigma = (log C / 6)²: black and white hair are both far
away, and equal steps look about equally large. Roughness and index are logits of their ranges,
correctives a tanh of theirs; all of them smooth, with finite derivatives everywhere.
"""

from __future__ import annotations

import numpy as np
from scipy.special import expit

from appearance.bsdf.maps import HairMaps
from reconstruction.arrays import Array

Raw = dict[str, Array]
"""Unconstrained numbers by name."""

BRACKET = 6.0
"""About Chiang's polynomial at beta_N = 0.3: here it only shapes the parametrisation."""
RANGES = {"beta_m": (0.01, 0.99), "beta_n": (0.01, 0.99), "eta": (1.2, 2.2)}
MOST_TURN = 0.6
"""Radians of a corrective's component."""
MOST_TILT = 10.0


def encode(maps: HairMaps) -> Raw:
    """The unconstrained numbers of `maps`."""
    raw = {
        "sigma_a": encode_absorption(maps.sigma_a),
        "rotation": encode_rotation(maps.rotation),
        "tilt_deg": np.array(
            [MOST_TILT * np.arctanh(np.clip(maps.tilt_deg / MOST_TILT, -0.99, 0.99))]
        ),
    }
    return raw | {name: np.array([encode_scalar(name, getattr(maps, name))]) for name in RANGES}


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


def derivatives(raw: Raw) -> Raw:
    """Derivatives of the maps' absorption, roughnesses and index by their numbers."""
    x = raw["sigma_a"]
    out = {"sigma_a": -2 / BRACKET**2 * np.logaddexp(0, -x) * expit(-x)}
    for name, (low, high) in RANGES.items():
        share = expit(raw[name])
        out[name] = (high - low) * share * (1 - share)
    return out


def encode_scalar(name: str, value: float) -> float:
    """The logit of a roughness or index in its range of `RANGES`."""
    low, high = RANGES[name]
    share = np.clip((value - low) / (high - low), 1e-4, 1 - 1e-4)
    return float(np.log(share / (1 - share)))


def encode_absorption(sigma_a: Array) -> Array:
    """The logit of the colour C of `sigma_a (…, 3)`: to 1e-7 from 1 and down to any blackness."""
    log_colour = -BRACKET * np.sqrt(np.maximum(sigma_a, 1e-12))
    short = np.maximum(-np.expm1(log_colour), 1e-7)
    return log_colour - np.log(short)


def encode_rotation(rotation: Array) -> Array:
    """The unconstrained numbers of correctives `(…, 2)`, those at their limit just within it."""
    return np.asarray(MOST_TURN * np.arctanh(np.clip(rotation / MOST_TURN, -0.999, 0.999)))
