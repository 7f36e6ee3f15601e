"""Extreme hair and lights, whose frames are compared with many paths."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from appearance import HairAppearance
from benchmarks.subjects import Subject
from reconstruction import Light, Strands
from reconstruction.arrays import Array

BLOND = (0.03, 0.06, 0.125)
NEAR = 0.3
"""Metres from the middle of the hair: inside the dome."""


@dataclass(frozen=True)
class Extreme:
    """A subject under some lights."""

    name: str
    subject: Subject
    lights: Sequence[Light]


def extremes(subject: Subject, lights: Sequence[Light]) -> list[Extreme]:
    """The subject in its mean colour, with one thing changed at a time."""
    subject = replace(subject, absorption=None)

    def hair(name: str, **changed: object) -> Extreme:
        appearance = HairAppearance.from_dict(subject.hair.to_dict() | changed)
        return Extreme(name, replace(subject, hair=appearance), lights)

    def alone(name: str, these: Strands) -> Extreme:
        return Extreme(name, replace(subject, strands=these, head=None), lights)

    middle = subject.strands.points.mean(axis=0, dtype=float)

    def near(light: Light) -> Light:
        away = light.position - middle
        distance = float(np.linalg.norm(away))
        closer = middle + away * (NEAR / distance)
        return replace(light, position=closer, intensity=light.intensity * (NEAR / distance) ** 2)

    off = replace(lights[0], intensity=np.zeros(3))
    longest = subject.strands.subset([int(subject.strands.lengths().argmax())])
    return [
        hair("white: no absorption", sigma_a=(0.0, 0.0, 0.0)),
        hair("blond", sigma_a=BLOND),
        hair("black: absorption 10", sigma_a=(10.0, 10.0, 10.0)),
        hair("β 0.05", beta_m=0.05, beta_n=0.05),
        hair("β 0.8", beta_m=0.8, beta_n=0.8),
        alone("one strand", longest),
        alone("a braid", braid(middle, 120, float(np.mean(subject.strands.radius)))),
        Extreme("lights at 30 cm", subject, [near(light) for light in lights]),
        Extreme("a lamp of 0 W", subject, [off]),
    ]


def braid(middle: Array, count: int, radius: float, height: float = 0.12) -> Strands:
    """Three bundles of `count` strands of `radius` metres in a flat braid about `middle (3,)`.

    The bundles' axes have the lemniscate's paths of a braid, a third of a turn apart.
    """
    rng = np.random.default_rng(0)
    z = np.linspace(-height / 2, height / 2, 60)
    lines = []
    for bundle in range(3):
        turn = 2 * np.pi * (z / 0.04 + bundle / 3)
        axis = np.column_stack([9e-3 * np.sin(turn), 4e-3 * np.sin(2 * turn), z])
        width = 5e-3 * np.sqrt(rng.random(count))
        angle = 2 * np.pi * rng.random(count)
        for w, a in zip(width, angle, strict=True):
            lines.append(middle + axis + (w * np.cos(a), w * np.sin(a), 0.0))
    return Strands.from_list(lines, radius)
