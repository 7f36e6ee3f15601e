"""The light of each file in a take of single lights with fully lit frames for tracking.

All lights are on after the first 19 single lights and then after every 20: frames 0, 20, 41, 62, …
of the pattern (FaceOLAT, issues 4, 7 and 8). Some takes have files before the pattern.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from reconstruction.arrays import Bools
from reconstruction.capture.records import CaptureError

FIRST_CYCLE, CYCLE = 20, 21
"""Frames between fully lit ones: at the start, and later."""


class PresetProblem(CaptureError):
    """A folder without the preset's layout; the message names the file and what was expected."""


def fully_lit(count: int) -> list[int]:
    """Fully lit frames in a take of `count` single lights: 0, 20, 41, …"""
    out, singles, at = [0], 0, 0
    while singles < count:
        run = min((FIRST_CYCLE if at == 0 else CYCLE) - 1, count - singles)
        singles, at = singles + run, at + run + 1
        out.append(at)
    return out


@dataclass(frozen=True)
class Pattern:
    """First file `start` of the pattern; fully `lit (N,)` files by brightness; and `wrong` files,
    whose brightness contradicts the pattern."""

    start: int
    lit: Bools
    wrong: list[int]


def find_pattern(brightness: ArrayLike, order: Sequence[int]) -> Pattern:
    """Align the pattern with the `brightness (N,)` of a take's files in one camera.

    `order` is the light of each frame of the pattern, -1 if fully lit. Raises `PresetProblem` if
    fully lit frames cannot be identified or contradict the pattern.
    """
    value = np.log(np.maximum(np.asarray(brightness, float), 1e-12))
    whole = np.flatnonzero(np.asarray(order) < 0)
    latest = len(value) - len(order)
    if latest < 0:
        raise PresetProblem(f"{len(value)} frames, expected {len(order)} or more")

    def contrast(start: int) -> float:
        inside = value[start : start + len(order)]
        return float(inside[whole].mean() - np.delete(inside, whole).mean())

    start = max(range(latest + 1), key=contrast)
    inside = value[start : start + len(order)]
    single = np.delete(inside, whole)
    middle = (np.median(inside[whole]) + np.quantile(single, 0.75)) / 2
    if np.median(inside[whole]) - np.quantile(single, 0.75) < np.log(1.5):
        raise PresetProblem(
            "fully lit frames are not brighter than single lights: check that the frames are of "
            "one take, in order and complete"
        )
    lit = value > middle
    wrong = [
        start + int(i) for i in np.flatnonzero(lit[start:][: len(order)] != (np.asarray(order) < 0))
    ]
    if len(wrong) > max(2, 0.1 * len(order)):
        places = ", ".join(map(str, np.flatnonzero(lit)[:20]))
        raise PresetProblem(
            f"the frames {places}… are fully lit, expected 0, 20, 41, … from some frame on: the "
            "single lights cannot be identified"
        )
    return Pattern(start, np.asarray(lit), wrong)


def with_fully_lit(singles: Sequence[int]) -> list[int]:
    """The light of each frame, -1 if fully lit."""
    out, rest = [], iter(singles)
    lit = set(fully_lit(len(singles)))
    for i in range(len(singles) + len(lit)):
        out.append(-1 if i in lit else next(rest))
    return out
