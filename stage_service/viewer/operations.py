"""Operations on a viewed model by name.

Options and results are JSON-ready or bytes, so that another process can run them.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from reconstruction import Camera, Capture, CaptureError, Model
from stage_service.viewer.errors import BadLight, NothingToView
from stage_service.viewer.viewed import Viewed

Weights = dict[str, list[float]]
"""Factors of red, green and blue by light number, as JSON keys."""


@dataclass(frozen=True)
class Source:
    """A model's folder, and candidates for its capture, of which the first readable one is used."""

    model: Path
    captures: tuple[Path, ...] = ()

    def open(self) -> Viewed:
        """The model to view."""
        model = Model(self.model)
        for path in self.captures:
            with suppress(CaptureError):
                return Viewed(model, Capture(path))
        return Viewed(model)


def _strands(model: Viewed, which: str, first: int, count: int) -> bytes:
    return model.packed(which).chunk(first, count)


def _visibility(model: Viewed, light: int) -> bytes:
    if not 0 <= light < len(model.lighting.lights):
        raise NothingToView(f"light number {light}: expected 0 to {len(model.lighting.lights) - 1}")
    return model.lighting.visibility(light)


def _sum(model: Viewed, camera: str, weights: Weights, exposure: float) -> bytes:
    if camera not in {c["name"] for c in model.about()["cameras"]}:
        raise NothingToView(f"unknown camera {camera!r}")
    return model.lighting.sum(camera, _numbered(weights), exposure)


def _in_view(model: Viewed, view: dict[str, Any], weights: Weights) -> bytes:
    try:
        lens, turned, moved = (np.array(view[name]) for name in ("K", "R", "t"))
        camera = Camera("view", view["width"], view["height"], lens, turned, moved)
    except ValueError as error:
        raise BadLight(str(error)) from error
    return model.lighting.indirect_in_view(camera, _numbered(weights))


def _environment(model: Viewed, which: str, rotation_deg: float) -> list[list[float]]:
    found: list[list[float]] = model.lighting.environment(which, rotation_deg).tolist()
    return found


def _lights(model: Viewed) -> list[list[list[float]]]:
    """Position and intensity towards the origin of each light."""
    origin = np.zeros(3)
    return [
        [x.position.tolist(), x.intensity_towards(origin).tolist()] for x in model.lighting.lights
    ]


def _numbered(weights: Weights) -> dict[int, list[float]]:
    return {int(number): value for number, value in weights.items()}


OPERATIONS: dict[str, Callable[..., Any]] = {
    "about": Viewed.about,
    "strands": _strands,
    "head": Viewed.head_bytes,
    "confidence": Viewed.confidence,
    "lighting": lambda model: model.lighting.about(),
    "lights": _lights,
    "table": lambda model: model.lighting.table(),
    "visibility": _visibility,
    "few": lambda model, weights: model.lighting.few(_numbered(weights)),
    "indirect_in_view": _in_view,
    "sum": _sum,
    "environment": _environment,
}
