"""`lights.json`: the lights as inverse rendering found them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from appearance.inverse_rendering.unknowns import LightDeviations
from reconstruction import Light, Model

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
    """The calibrated `lights` as they were found to be; those that were not fitted as they are."""
    rows = {row["name"]: row for row in model.json(LIGHTS_FILE)} if model.has(LIGHTS_FILE) else {}
    out = []
    for light in lights:
        row = rows.get(light.name)
        if row is not None:
            names = ("moved_m", "turned_rad", "gain", "profile_scale")
            (light,) = LightDeviations(*(np.array([row[n]], float) for n in names)).applied([light])
        out.append(light)
    return out
