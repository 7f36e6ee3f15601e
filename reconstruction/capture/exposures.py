"""Pictures of one thing at several exposures, merged to one; and the light of empty stages."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from reconstruction.arrays import Bools, Floats
from reconstruction.files.pictures import Picture

FULL_WELL = 1e4
"""Electrons that a full channel is taken to have: how noisy light is beside the step of a count."""
AGREES, SURE = 0.05, 4.0
"""A pixel is as without the subject within this share, or so many steps of noise."""


@dataclass(frozen=True, eq=False)
class Merged:
    """`radiance (H, W, 3)`, and `saturated (H, W)` where even the shortest exposure is.

    `full` is the radiance from which on a channel saturates, `quantum` that of one count where it
    is the same everywhere, else 0; `noise (H, W)` the standard deviation of the channels' mean.
    """

    radiance: Floats
    saturated: Bools
    full: float
    quantum: float
    noise: Floats

    def marked(self) -> tuple[Floats, float]:
        """The radiance `(H, W, 3)` with what is saturated, and only that, at `full` or above."""
        if not np.isfinite(self.full):
            return self.radiance, self.full
        brightest = self.radiance.max(axis=-1)
        below = brightest[~self.saturated]
        full = max(self.full, 1.0001 * float(below.max(initial=0.0)))
        out = self.radiance.copy()
        y, x = np.nonzero(self.saturated & (brightest < full))
        out[y, x, out[y, x].argmax(axis=-1)] = full
        return out, full


def merge(pictures: Mapping[float, Picture], scale: float = 1.0) -> Merged:
    """Merge pictures by seconds of exposure; `scale` is the radiance of a full channel at 1 s.

    The mean of what is not saturated, weighted by the inverse variance of a count's rounding and of
    the photons of a sensor that holds `FULL_WELL` electrons. The photons are those that the longest
    exposure that is not saturated gives: a weight that follows its own noise would bias the mean.
    """
    seconds = sorted(pictures)
    first = pictures[seconds[0]]
    about = first.light / np.float32(seconds[0])
    for s in seconds[1:]:
        usable = ~pictures[s].saturated[..., None]
        about = np.where(usable, pictures[s].light / np.float32(s), about)
    total, weights = np.zeros_like(about), np.zeros_like(about)
    for s in seconds:
        picture = pictures[s]
        step = np.maximum(np.float32(picture.quantum), np.float32(1e-6))
        variance = step**2 / 12 + np.maximum(about, 0) * np.float32(s / FULL_WELL)
        weight = np.float32(s) ** 2 / variance * ~picture.saturated[..., None]
        total += weight * (picture.light / np.float32(s) - about)  # exact for one exposure
        weights += weight
    radiance = (about + total / np.maximum(weights, 1e-30)) * np.float32(scale)
    deviation = np.where(weights > 0, np.maximum(weights, 1e-30) ** -0.5, np.inf) * scale
    same = [np.ndim(p.quantum) == 0 for p in pictures.values()]
    quantum = float(pictures[seconds[-1]].quantum) / seconds[-1] * scale if all(same) else 0.0
    return Merged(
        radiance.astype(np.float32),
        first.saturated,
        first.full / seconds[0] * scale,
        quantum,
        np.asarray(np.sqrt((deviation**2).sum(axis=-1)) / 3, np.float32),
    )


def flattened(merged: Merged, flat: Floats) -> Merged:
    """`merged` through a lens whose `flat (H, W, 3)` field has a mean of 1."""
    even = np.maximum(flat, np.float32(0.05))
    radiance = (merged.radiance / even).astype(np.float32)
    return replace(merged, radiance=radiance, noise=merged.noise / even.mean(axis=-1))


class Unchanged:
    """What of a camera's pictures is as it is without the subject, told light by light.

    A pixel is the background where most of the lights that show anything there show the same with
    and without the subject. A shadow on a wall changes it under a few lights, the subject, which
    hides it, under nearly all.
    """

    def __init__(self) -> None:
        self._same: Any = 0
        self._told: Any = 0

    def add(self, picture: Merged, plate: Merged) -> None:
        """One light with and without the subject."""
        a, b = picture.radiance.mean(axis=-1), plate.radiance.mean(axis=-1)
        noise = SURE * np.hypot(picture.noise, plate.noise)
        larger = np.maximum(np.abs(a), np.abs(b))
        told = (larger > noise) & ~(picture.saturated & plate.saturated)
        self._told = self._told + told
        self._same = self._same + (told & (np.abs(a - b) <= np.maximum(noise, AGREES * larger)))

    def subject(self) -> Bools:
        """The subject's pixels `(H, W)`, after one `add` or more."""
        return np.asarray((self._told > 0) & (2 * self._same <= self._told))
