"""The response curve of an import's images, checked by its fully lit frames."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from reconstruction.arrays import Array, Floats
from reconstruction.capture.import_frames import ImportedFrames
from reconstruction.capture.records import Step
from reconstruction.capture.summed_lights import (
    CurveFit,
    SummedLights,
    advantage,
    fit_lights,
    misfit,
)
from reconstruction.files.colour import Curve
from reconstruction.files.pictures import Sensor, response_of

PLACES, MOST_LIT = 1500, 4
"""Places of a camera's images and fully lit frames that are compared."""
WRONG = 0.15
"""Relative difference in light, over the values of the images, that contradicts a curve."""
UNEXPLAINED = 0.05
"""Median relative difference of values from which on a frame is no sum of the single lights."""
STEADY = 0.1
"""Relative difference in brightness between fully lit frames that is reported."""
_CONTRAST, _TILES = 0.3, 6


@dataclass(frozen=True)
class ResponseCheck:
    """The `sensor` to decode with, and `notes` for the user."""

    sensor: Sensor
    notes: tuple[str, ...]


def check_response(frames: ImportedFrames, replaceable: bool) -> ResponseCheck:
    """Compare the fully lit frames of one camera with the sum of its single lights.

    A contradicted curve is replaced if it is `replaceable`, that is, the user has not stated it;
    else a note gives the one to state. Raises `ImportProblem` for an image that cannot be read.
    """
    sensor, found = frames.settings.sensor, frames.found
    singles = [s for s in found.steps if s.kind == "olat"]
    if not singles:  # the curve is irrelevant to the texture of photographs
        taken = "images are under patterns: the response curve is not checked by their sums"
        return ResponseCheck(sensor, (taken,) if frames.patterns else ())
    kinds = {"all_on"} if frames.rig.projectors else {"all_on", "tracking"}
    lit = [s for s in found.steps if s.kind in kinds]

    def count(camera: str, steps: list[Step]) -> int:
        return sum((s.index, camera) in found.frames for s in steps)

    camera = max(frames.shot, key=lambda c: (count(c, lit) > 0, count(c, singles)), default="")
    if not camera or not count(camera, lit):
        taken = "as stated" if sensor.response is not None else "that of the file type"
        note = f"no fully lit frame: the response curve is {taken} and cannot be checked"
        return ResponseCheck(sensor, (note,))
    values = _Values(frames, camera, singles, lit)
    sums = values.read()
    solved = None if sums is None else fit_lights(sums)
    if sums is None or solved is None:
        note = f"{camera}: the fully lit frames are too dark, even or saturated to check the curve"
        return ResponseCheck(sensor, (note,))
    fit, level, error = solved
    own = np.where(np.isnan(level), 1.0, np.maximum(level, 1e-3))
    sums = replace(sums, seconds=sums.seconds / own)
    if (off := misfit(sums, fit)) > UNEXPLAINED:
        note = (
            f"{camera}: the fully lit frames differ from the sum of the single lights by {off:.0%} "
            "under any curve, so the curve cannot be checked: are lights missing, or did the "
            "subject move?"
        )
        return ResponseCheck(sensor, (note,))
    stated, black = response_of(values.lit[0], sensor), (sensor.black or 0.0) / values.white
    notes, used = values.levels(sums, fit, level, error), sensor
    estimate = f"the fully lit frames of {camera} show {_text(fit, values.white)}"
    if not _contradicts(sums, fit, stated, black):
        return ResponseCheck(sensor, (f"{estimate}: {_name(stated)} is confirmed", *notes))
    level_of_black = fit.black * values.white
    level_of_black = round(level_of_black, 1) if level_of_black >= values.count else 0.0
    right = replace(sensor, response=_rounded(fit.curve), black=level_of_black)
    setting = f"sensor.response = {_toml(right.response)} and sensor.black = {right.black:g}"
    decided = f"they contradict {_name(stated)} with black {black * values.white:g}"
    if replaceable:
        used, decided = right, f"{decided}, and {setting} are used instead"
    else:
        decided = f"{decided}, which is used as stated: set {setting}"
    return ResponseCheck(used, (f"{estimate}; {decided}", *notes))


def _contradicts(sums: SummedLights, fit: CurveFit, stated: Curve, black: float) -> bool:
    """Whether the stated curve's light differs by `WRONG` over the values, and explains less."""
    as_stated = replace(fit, curve=stated, black=black)
    v = np.quantile(sums.singles[sums.singles > fit.black + 5 * sums.noise], np.linspace(0.1, 0.9))
    ratio = sums.light(v, stated, black) / sums.light(v, fit.curve, fit.black)
    spread = float(np.log(np.maximum(ratio, 1e-6)).max() - np.log(np.maximum(ratio, 1e-6)).min())
    return spread > WRONG and advantage(sums, fit, as_stated) > 3


@dataclass(eq=False)
class _Values:
    """Reads one camera's frames as means over small places of the image."""

    frames: ImportedFrames
    camera: str
    single_steps: list[Step]
    lit_steps: list[Step]

    def __post_init__(self) -> None:
        self.white, self.count = 1.0, 0.005  # of floats; one count of integers
        files = self.frames.found.frames
        steps = [s for s in self.lit_steps if (s.index, self.camera) in files]
        kept = np.unique(np.linspace(0, len(steps) - 1, MOST_LIT).round().astype(int))
        self.lit = [self._longest(steps[i])[1] for i in kept]
        self.names: list[str] = []

    def _longest(self, step: Step) -> tuple[float, Path]:
        bracket = self.frames.found.frames[step.index, self.camera]
        return max(bracket.items()) if step.kind != "all_on" else min(bracket.items())

    def read(self) -> SummedLights | None:
        """None if no place of the first fully lit frame can be used."""
        first, spread, full = self._means(self.lit[0])
        grey = first.mean(axis=-1)
        step = self._step
        usable = (full == 0) & (grey > 4 * step) & (spread < _CONTRAST * grey)
        y, x = np.nonzero(usable)
        if not len(y):
            return None
        # as many places of each brightness as there are, up to the same number
        bins = (np.log(grey[y, x]) // 0.3).astype(int)
        order = np.random.default_rng(0).permutation(len(y))
        rank = np.empty(len(y), int)
        for b in np.unique(bins):
            inside = order[bins[order] == b]
            rank[inside] = np.arange(len(inside))
        chosen = np.sort(np.argsort(rank, kind="stable")[:PLACES])
        y, x = y[chosen], x[chosen]
        lit, singles, seconds, noise = [first[y, x]], [], [], []
        used = np.ones((len(y), 3), bool)
        for path in self.lit[1:]:
            mean, _, full = self._means(path)
            lit.append(mean[y, x])
            used &= (full[y, x] == 0)[:, None]
        for s in self.single_steps:
            if (s.index, self.camera) not in self.frames.found.frames:
                continue
            exposure, path = self._longest(s)
            mean, spread, full = self._means(path)
            singles.append(mean[y, x])
            used &= (full[y, x] == 0)[:, None]
            noise.append(np.quantile(spread[y, x], 0.1))
            seconds.append(exposure)
            self.names.append(str(s.light))
        if len(singles) < 2:
            return None
        height, width = grey.shape
        group = y * _TILES // height * _TILES + x * _TILES // width
        deviation = float(np.hypot(step, np.median(noise) / self._side))
        return SummedLights(
            np.array(singles), np.array(lit), np.array(seconds), deviation, group, used,
            self._dark(y, x),
        )  # fmt: skip

    def _dark(self, y: Any, x: Any) -> Floats | None:
        files = self.frames.found.frames
        for s in self.frames.found.steps:
            if s.kind == "dark" and (s.index, self.camera) in files:
                return self._means(self._longest(s)[1])[0][y, x]
        return None

    def _means(self, path: Path) -> tuple[Floats, Floats, Floats]:
        """Means `(h, w, 3)`, standard deviations and shares of saturated pixels `(h, w)`."""
        picture = self.frames.values(path, self.camera)
        height, width = picture.light.shape[:2]
        self._side = max(2, int(np.sqrt(height * width / (20 * PLACES))))
        if np.ndim(picture.quantum) == 0 and picture.quantum > 0:
            self.white, self.count = 1 / float(picture.quantum), 1.0
        self._step = max(float(np.mean(picture.quantum)) / np.sqrt(12), 1e-5)
        size = width // self._side, height // self._side

        def mean(image: Any) -> Floats:
            whole = image[: size[1] * self._side, : size[0] * self._side]
            return np.asarray(cv2.resize(whole, size, interpolation=cv2.INTER_AREA), np.float32)

        grey = np.ascontiguousarray(picture.light.mean(axis=-1), np.float32)
        spread = np.sqrt(np.maximum(mean(grey**2) - mean(grey) ** 2, 0))
        return mean(picture.light), spread, mean(picture.saturated.astype(np.float32))

    def levels(self, sums: SummedLights, fit: CurveFit, level: Array, error: Array) -> list[str]:
        """Notes on lamps that failed and exposures that differ."""
        notes = []
        if dark := [n for n, w in zip(self.names, level, strict=True) if np.isnan(w)]:
            notes.append(f"{self.camera}: no light under {', '.join(dark)}: did the lamps fail?")
        for name, w, e in zip(self.names, level, error, strict=True):
            if w != 1 and not np.isnan(w):
                notes.append(
                    f"{name}: the fully lit frame has {max(w, 0):.2f} ± {e:.2f} times its own "
                    "frame's light: correct its exposure, or remove its frame if the lamp failed"
                )
        total, ambient = sums.totals(fit.curve, fit.black)
        gain = sums.gains(fit.curve, fit.black, total, ambient).mean(axis=(1, 2))
        if gain.max() > (1 + STEADY) * gain.min() > 0:
            notes.append(
                f"{self.camera}: the fully lit frames differ in brightness by "
                f"{gain.max() / gain.min() - 1:.0%}: exposure or lights are not constant"
            )
        return notes


def _rounded(curve: Curve) -> Any:
    return round(curve, 2) if isinstance(curve, float) else curve


def _toml(response: Any) -> str:
    return f'"{response}"' if isinstance(response, str) else f"{response:g}"


def _name(curve: Curve) -> str:
    if callable(curve):
        return "the files' own curve"
    return {"srgb": "sRGB", "linear": "linear"}.get(str(curve), f"gamma {curve}")


def _text(fit: CurveFit, white: float) -> str:
    error = f" ± {max(fit.error, 0.005):.2f}" if isinstance(fit.curve, float) else ""
    name = _name(_rounded(fit.curve))
    black, of_black = fit.black * white, fit.black_error * white
    return f"{name}{error}, black {black:.3g} ± {max(of_black, 1e-3):.1g} of {white:.6g}"
