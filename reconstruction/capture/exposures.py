"""Merging images at several exposures, and background pixels from clean plates."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from reconstruction.arrays import Bools, Floats
from reconstruction.files.pictures import Picture

FULL_WELL = 1e4
"""Assumed electrons of a full channel: shot noise relative to the step of one count."""
AGREES, SURE = 0.05, 4.0
"""Relative difference, and standard deviations of noise, within which a pixel is unchanged."""


@dataclass(frozen=True, eq=False)
class Merged:
    """`radiance (H, W, 3)`, and `saturated (H, W)` pixels of the shortest exposure.

    `full` is the radiance at which a channel saturates, `quantum` that of one count if constant,
    else 0; `noise (H, W)` is the standard deviation of the channels' mean.
    """

    radiance: Floats
    saturated: Bools
    full: float
    quantum: float
    noise: Floats

    def marked(self) -> tuple[Floats, float]:
        """Radiance `(H, W, 3)` with exactly the saturated pixels at `full` or above, and `full`."""
        if not np.isfinite(self.full):
            return self.radiance, self.full
        brightest = self.radiance.max(axis=-1)
        below = brightest[~self.saturated]
        full = max(self.full, 1.0001 * float(below.max(initial=0.0)))
        out = self.radiance.copy()
        y, x = np.nonzero(self.saturated & (brightest < full))
        out[y, x, out[y, x].argmax(axis=-1)] = full
        return out, full


def averaged(shots: Iterable[tuple[float, Floats, Bools]]) -> tuple[Floats, Bools]:
    """Mean radiance `(H, W, 3)` of shots (seconds, radiance, saturated), the shortest first.

    Weights are exposures; saturated pixels have none, and are returned as saturated where they are
    in the shortest, whose radiance they keep if no other has any.
    """
    total: Any = 0.0
    weight: Any = 0.0
    first: tuple[Floats, Bools] | None = None
    for seconds, image, saturated in shots:
        used = np.float32(seconds) * ~saturated
        total, weight = total + used[..., None] * image, weight + used
        first = first or (image, saturated)
    if first is None:
        raise ValueError("no exposure to average")
    mean = total / np.maximum(weight, np.finfo(np.float32).tiny)[..., None]
    return np.where(weight[..., None] > 0, mean, first[0]), first[1]


def merge(pictures: Mapping[float, Picture], scale: float = 1.0) -> Merged:
    """Merge images by exposure in seconds; `scale` is the radiance of a full channel at 1 s.

    Unsaturated values are averaged with inverse-variance weights: rounding of a count, and shot
    noise of a sensor with `FULL_WELL` electrons. Shot noise is estimated from the longest
    unsaturated exposure, since weights from each value's own noise would bias the mean.
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
    """`merged` divided by a `flat (H, W, 3)` field of mean 1."""
    even = np.maximum(flat, np.float32(0.05))
    radiance = (merged.radiance / even).astype(np.float32)
    return replace(merged, radiance=radiance, noise=merged.noise / even.mean(axis=-1))


class BackgroundPixels:
    """Background pixels of one camera, from frames with and without the subject.

    A pixel is background if it is unchanged under most of the lights that reach it: a shadow
    changes a wall under a few lights, the subject hides it under nearly all.
    """

    def __init__(self) -> None:
        self._same: Any = 0
        self._lit: Any = 0

    def add(self, picture: Merged, plate: Merged) -> None:
        """One light with and without the subject."""
        a, b = picture.radiance.mean(axis=-1), plate.radiance.mean(axis=-1)
        noise = SURE * np.hypot(picture.noise, plate.noise)
        larger = np.maximum(np.abs(a), np.abs(b))
        lit = (larger > noise) & ~(picture.saturated & plate.saturated)
        self._lit = self._lit + lit
        self._same = self._same + (lit & (np.abs(a - b) <= np.maximum(noise, AGREES * larger)))

    def subject(self) -> Bools:
        """The subject's pixels `(H, W)`, after one `add` or more."""
        return np.asarray((self._lit > 0) & (2 * self._same <= self._lit))
