"""The cost of a plan: frames, bytes, seconds, light."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from reconstruction import Rig, Step
from stage_service.device_config import Strict
from stage_service.plan.flash import FlashRate
from stage_service.plan.patterns import LAMP_KINDS, LampLevels

EXR_HEADER_BYTES = 700
"""Bytes of an EXR file beside 12 bytes per pixel and its table of lines."""


class LeftOutWork(Strict):
    """Steps that this plan omits on this rig."""

    what: str
    why: str
    saved: str


class PlanCost(Strict):
    """The cost of a plan, without retries.

    `frames` counts images (steps times cameras), `bytes` is the size of the capture folder while
    shooting, `seconds` includes exposure, settling, readout, link and storage; `limited_by` is the
    largest of these. `stepping` counts the steps that the service and the trigger box clock,
    `stepping_why` is the reason. `lamp_seconds` sums level times on-time over lamps; `dose` is the
    radiant exposure at the head's centre, J/m² per channel, of lamps and projectors. `flash` is the
    flash rate, and whether a living subject's consent is required.
    """

    steps: int
    frames: int
    frames_by_kind: dict[str, int]
    bytes: int
    seconds: float
    seconds_by_cause: dict[str, float]
    limited_by: str
    stepping: dict[str, int]
    stepping_why: str
    lamp_seconds: float
    dose: tuple[float, float, float]
    flash: FlashRate
    left_out: tuple[LeftOutWork, ...]


def folder_bytes(rig: Rig) -> int:
    """Bytes of one step's frames, uncompressed."""
    return sum(EXR_HEADER_BYTES + 16 * c.height + 12 * c.width * c.height for c in rig.cameras)


def dose_of(
    rig: Rig, steps: Sequence[Step], overhead_s: float, lamp_levels: LampLevels
) -> tuple[float, tuple[float, float, float]]:
    """Lamp seconds, and radiant exposure at the head's centre, J/m² per channel.

    By the inverse-square law; a light is on `overhead_s` longer than its exposure. A row counts as
    1/height of its projector.
    """
    lamps = np.reshape([x.irradiance(np.zeros(3)) for x in rig.lights], (-1, 3))
    beams = {p.name: (p.intensity / (p.center @ p.center), p.height) for p in rig.projectors}
    all_beams = sum((beam for beam, _ in beams.values()), np.zeros(3))
    dose, lamp_seconds = np.zeros(3), 0.0
    for step in steps:
        seconds = step.exposure + overhead_s
        time = step.level * seconds
        if step.kind in LAMP_KINDS:
            levels = lamp_levels(step)
            dose += seconds * (levels @ lamps)
            lamp_seconds += seconds * float(levels.sum())
        elif step.kind == "tracking":
            dose += time * all_beams
        elif step.projector is not None:
            beam, height = beams[step.projector]
            dose += time * beam / height
    r, g, b = (float(x) for x in dose)
    return lamp_seconds, (r, g, b)
