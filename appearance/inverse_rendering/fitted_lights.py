"""`lights.json`: the lights with the intensities of inverse rendering."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from reconstruction import Light, Model, ModelError
from reconstruction.arrays import Array

LIGHTS_FILE = "lights.json"


def save_lights(model: Model, gain: Array, lights: Sequence[Light]) -> None:
    """Write the calibrated `lights` with their intensities times `gain (L,)`, and those factors."""
    rows = [
        {**replace(light, intensity=light.intensity * g).to_dict(), "gain": float(g)}
        for light, g in zip(lights, gain, strict=True)
    ]
    model.write_json(LIGHTS_FILE, rows)


def fitted_lights(model: Model, lights: Sequence[Light]) -> list[Light]:
    """The calibrated `lights` with their fitted intensities, if they were fitted.

    Raises `ModelError` for a file that is damaged.
    """
    if not model.has(LIGHTS_FILE):
        return list(lights)
    try:
        gains = {row["name"]: float(row["gain"]) for row in model.json(LIGHTS_FILE)}
        return [replace(x, intensity=x.intensity * gains.get(x.name, 1.0)) for x in lights]
    except ModelError:
        raise
    except (KeyError, TypeError, ValueError) as error:
        path = model.file(LIGHTS_FILE)
        raise ModelError(f"{path}: {error!r}: run 'hairstage fit' again") from error
