"""`lights.json`: the lights with the intensities of inverse rendering."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

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
    # 0.1 wrote a second factor, shared by the lights of one profile
    factor = float(row["gain"]) * float(row.get("profile_scale", 1.0))
    return replace(light, intensity=light.intensity * factor)
