"""`lights.json`: the lights as inverse rendering found them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from appearance.inverse_rendering.unknowns import LightDeviations
from reconstruction import Light, Model, ModelError

LIGHTS_FILE = "lights.json"


def save_lights(model: Model, found: LightDeviations, lights: Sequence[Light]) -> None:
    """Write the calibrated `lights` as `found`, and how each differs from its calibration."""
    rows = [
        {
            **light.to_dict(),
            "moved_m": found.position[i].tolist(),
            "turned_rad": found.turn[i].tolist(),
            "gain": float(found.gain[i]),
            "profile_scale": float(found.profile[i]),
        }
        for i, light in enumerate(found.applied(lights))
    ]
    model.write_json(LIGHTS_FILE, rows)


def lights_as_found(model: Model, lights: Sequence[Light]) -> list[Light]:
    """The calibrated `lights` as they were found to be; those that were not fitted as they are.

    Raises `ModelError` for a file that is damaged.
    """
    if not model.has(LIGHTS_FILE):
        return list(lights)
    try:
        rows = {row["name"]: row for row in model.json(LIGHTS_FILE)}
        return [_as_found(light, rows.get(light.name)) for light in lights]
    except ModelError:
        raise
    except (KeyError, TypeError, ValueError) as error:
        path = model.file(LIGHTS_FILE)
        raise ModelError(f"{path}: {error!r}: run 'hairstage fit' again") from error


def _as_found(light: Light, row: Mapping[str, Any] | None) -> Light:
    if row is None:
        return light
    names = ("moved_m", "turned_rad", "gain", "profile_scale")
    return LightDeviations(*(np.array([row[n]], float) for n in names)).applied([light])[0]
