"""Takes of single lights with fully lit frames between them: which file is which light's.

All lights come on after 19 single ones, and from then on after every 20, so that the subject can be
tracked: frames 0, 20, 41, 62, … of the pattern (FaceOLAT, issues 4, 7 and 8). Files of some takes
begin a frame or more before it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from reconstruction.arrays import Bools
from reconstruction.capture.folder import CaptureError

FIRST_CYCLE, CYCLE = 20, 21
"""Frames until the stage is fully lit again: at first, and from then on."""


class PresetProblem(CaptureError):
    """A folder that is not of the preset's layout; the message says what was expected where."""


def fully_lit(count: int) -> list[int]:
    """Frames of a take of `count` single lights in which the whole stage is lit: 0, 20, 41, …"""
    out, singles, at = [0], 0, 0
    while singles < count:
        run = min((FIRST_CYCLE if at == 0 else CYCLE) - 1, count - singles)
        singles, at = singles + run, at + run + 1
        out.append(at)
    return out


@dataclass(frozen=True)
class Pattern:
    """Where in a take's files the pattern begins, `start`; which are `lit` fully, and which not.

    `lit (N,)` is by brightness; `wrong` are files that the pattern has otherwise.
    """

    start: int
    lit: Bools
    wrong: list[int]


def find_pattern(brightness: ArrayLike, order: Sequence[int]) -> Pattern:
    """Lay the pattern over a take by the `brightness (N,)` of its files in one camera.

    `order` is the light of each frame of the pattern, -1 for the fully lit ones. Raises
    `PresetProblem` where they cannot be told from single lights, or stand elsewhere.
    """
    value = np.log(np.maximum(np.asarray(brightness, float), 1e-12))
    whole = np.flatnonzero(np.asarray(order) < 0)
    latest = len(value) - len(order)
    if latest < 0:
        raise PresetProblem(f"{len(value)} frames, the pattern of lights has {len(order)}")

    def contrast(start: int) -> float:
        inside = value[start : start + len(order)]
        return float(inside[whole].mean() - np.delete(inside, whole).mean())

    start = max(range(latest + 1), key=contrast)
    inside = value[start : start + len(order)]
    single = np.delete(inside, whole)
    middle = (np.median(inside[whole]) + np.quantile(single, 0.75)) / 2
    if np.median(inside[whole]) - np.quantile(single, 0.75) < np.log(1.5):
        raise PresetProblem(
            "frames with all lights on cannot be told from single lights by brightness: are the "
            "frames of one take, in order, and none missing?"
        )
    lit = value > middle
    wrong = [
        start + int(i) for i in np.flatnonzero(lit[start:][: len(order)] != (np.asarray(order) < 0))
    ]
    if len(wrong) > max(2, 0.1 * len(order)):
        places = ", ".join(map(str, np.flatnonzero(lit)[:20]))
        raise PresetProblem(
            f"all lights are on in the frames {places}…: that is not the pattern 0, 20, 41, … from "
            "any frame on; the single lights cannot be named"
        )
    return Pattern(start, np.asarray(lit), wrong)


def with_fully_lit(singles: Sequence[int]) -> list[int]:
    """The light of each frame, -1 where all are lit."""
    out, rest = [], iter(singles)
    lit = set(fully_lit(len(singles)))
    for i in range(len(singles) + len(lit)):
        out.append(-1 if i in lit else next(rest))
    return out
