"""`lights.json`: the lights with the intensities, axes and lobes of inverse rendering."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from appearance.inverse_rendering.lobes import as_calibrated, with_lobes
from reconstruction import Light, Model, ModelError
from reconstruction.arrays import Array
from reconstruction.geometry.light_profiles import cosine_lobe

LIGHTS_FILE = "lights.json"


def save_lights(
    model: Model, gain: Array, lights: Sequence[Light], lobes: Array | None = None
) -> None:
    """Write the calibrated `lights` with their intensities times `gain (L,)`, those factors, and
    `lobes (L, 6)` (see `lobes.as_calibrated`)."""
    if lobes is None:
        lobes = as_calibrated(len(lights))
    rows = []
    for light, g, lobe in zip(with_lobes(lights, lobes), gain, lobes, strict=True):
        assert isinstance(light, Light)
        row = {**light.scaled(float(g)).to_dict(), "gain": float(g)}
        if np.isfinite(lobe[3]):
            row |= {"power": lobe[3], "power_error": lobe[5]}
            row["axis_error_deg"] = float(np.degrees(lobe[4]))
        rows.append(row)
    model.write_json(LIGHTS_FILE, rows)


def fitted_lights(model: Model, lights: Sequence[Light]) -> list[Light]:
    """The calibrated `lights` with their fitted intensities and lobes, if they were fitted.

    Raises `ModelError` for a file that is damaged.
    """
    if not model.has(LIGHTS_FILE):
        return list(lights)
    try:
        rows = {row["name"]: row for row in model.json(LIGHTS_FILE)}
        return [_fitted(x, rows[x.name]) if x.name in rows else x for x in lights]
    except ModelError:
        raise
    except (KeyError, TypeError, ValueError) as error:
        path = model.file(LIGHTS_FILE)
        raise ModelError(f"{path}: {error!r}: run 'hairstage fit' again") from error


def _fitted(light: Light, row: Mapping[str, Any]) -> Light:
    if "power" in row:
        lobe = cosine_lobe(float(row["power"]))
        light = replace(light, orientation=row["orientation"], profile=lobe)
    return light.scaled(float(row["gain"]))
