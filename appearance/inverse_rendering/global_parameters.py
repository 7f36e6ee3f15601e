"""Roughness, index, mean colour and light intensities: the global parameters, from images.

Gauss-Newton on cached paths with instruments, as the square of a path tracer's derivative is mostly
noise. The instruments Z, on the left, are the derivatives of first-hit light, with little noise:
with weights W and the difference r of rendered and captured images, Zᵀ W r has mean zero at the
truth for any Z. On the right are the exact derivatives of full images. Z is of one half of the
paths, r and the right side of the other, and vice versa, so that their noise is independent and
only changes the step length.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from appearance.inverse_rendering import losses
from appearance.inverse_rendering.batches import Batch
from appearance.inverse_rendering.options import Effort
from appearance.inverse_rendering.problem import FitProblem
from appearance.inverse_rendering.unknowns import Raw, derivatives, encode_scalar
from reconstruction import Progress, silent
from reconstruction.arrays import Array

Number = tuple[str, int]
"""A name in `Raw` and the index of a channel there; of "gain", that of a light."""

PRIOR = 0.03
"""Standard deviation of a light's calibrated intensity, relative."""
WIDE = {"sigma_a": 0.4, "beta_m": 0.4, "beta_n": 0.6, "eta": 0.6, "gain": PRIOR}
"""The unit of steps, in those of `Raw`."""
_FARTHEST = 1.5
_TURNS, _ESTIMATES = 16, 4
"""Most draws of paths; the result is the mean of `_ESTIMATES` within a width of each other."""
_DARKENS, _CLEARLY = 32, 0.25
"""Most steps of absorption alone, and the width from which they count."""
FEWEST = 32
"""Paths a pixel of a draw."""
_BEGINS = (-1.8, 0.4)
"""Roughness starts between 0.15 and 0.6: too few paths sample a much narrower lobe."""
_ALIKE = 3 * 32
"""Successive values with correlated errors."""
FOUND = {"beta_m": (0.05, 0.8), "beta_n": (0.2, 0.7)}
"""Limits of roughness: what is recovered from any start in tests. On misplaced strands the error
falls towards a beta_n below them, whose glints no frame shows."""


@dataclass(frozen=True)
class Evidence:
    """The images of a solve: `pairs`, pixels and paths, and a seed."""

    pairs: Sequence[Batch]
    effort: Effort
    seed: int = 0


class Solved(NamedTuple):
    """The solution: `raw` and `gain (L,)`.

    `left_open`: by name, the standard error of an estimate over its prior width in `WIDE`, of the
    least certain channel; 1 if images do not depend on it.
    """

    raw: Raw
    gain: Array
    left_open: dict[str, float]


def solve_global_parameters(
    problem: FitProblem,
    raw: Raw,
    gain: Array,
    names: Sequence[str],
    evidence: Evidence,
    progress: Progress = silent,
) -> Solved:
    """`raw` and `gain (L,)` with the numbers called `names` solved for.

    "sigma_a" shifts all cells' logits of a channel; "gain" is the intensities of the pairs' lights,
    with mean 1. Estimates have priors of the widths in `WIDE`, gains of 3 % about the calibration.
    Roughness stays within `FOUND`; a narrower beta_n results in up to 0.3. Hair that starts
    too bright in all channels is darkened first, as a wide lobe would explain its image too. Takes
    the time of five to sixteen images of twice `effort.spp` paths a pixel. Returns the input if an
    image is not finite.
    """
    lights = np.unique(np.concatenate([b.lights for b in evidence.pairs]))
    numbers = [
        (name, i)
        for name in WIDE
        if name in names
        for i in (lights if name == "gain" else range(raw[name].shape[-1]))
    ]
    given = raw, gain
    for name in {"beta_m", "beta_n"} & set(names):
        raw = raw | {name: np.clip(raw[name], *_BEGINS)}
    if len(names) > 1 and "sigma_a" in names:
        raw = _darkened(problem, raw, gain, evidence)
    estimates: list[tuple[Raw, Array]] = []
    away = np.zeros(len(numbers))
    system = _System(problem, numbers, evidence)
    for turn in range(_TURNS):
        progress("global parameters", turn / _TURNS)
        step = system.step(raw, gain, turn)
        if not np.isfinite(step).all():
            return Solved(*given, system.left_open())
        for number, d in zip(numbers, step * system.wide, strict=True):
            raw, gain = _moved(raw, gain, number, d)
        for name in FOUND.keys() & set(names):
            least, most = (encode_scalar(name, x) for x in FOUND[name])
            raw = raw | {name: np.clip(raw[name], least, most)}
        if "gain" in names:
            gain[lights] /= np.exp(np.log(gain[lights]).mean())
        away += step
        if np.abs(away[system.bends]).max(initial=0) >= 1:
            away, estimates = np.zeros(len(numbers)), []
        estimates.append((raw, gain))
        if len(estimates) == _ESTIMATES:
            break
    # each is of independent noise, once the first has come near
    last = estimates[1:] or estimates
    return Solved(
        raw | {n: np.mean([r[n] for r, _ in last], axis=0) for n in names if n in raw},
        np.exp(np.mean([np.log(g) for _, g in last], axis=0)),
        system.left_open(),
    )


def _darkened(problem: FitProblem, raw: Raw, gain: Array, evidence: Evidence) -> Raw:
    """`raw` with more absorption, while each channel is clearly too bright."""
    numbers = [("sigma_a", i) for i in range(3)]
    system = _System(problem, numbers, replace(evidence, seed=evidence.seed + 1))
    for turn in range(_DARKENS):
        step = system.step(raw, gain, turn)
        if not step.max() < -_CLEARLY:  # or not a number
            break
        for number, d in zip(numbers, step * system.wide, strict=True):
            raw, gain = _moved(raw, gain, number, d)
    return raw


def _moved(raw: Raw, gain: Array, number: Number, d: float) -> tuple[Raw, Array]:
    name, i = number
    if name == "gain":
        gain = gain.copy()
        gain[i] *= np.exp(d)
        return raw, gain
    value = raw[name].copy()
    value[..., i] += d
    return raw | {name: value}, gain


class _System:
    """The normal equations of some pixels, about which everything is flat `(N,)` over patches."""

    def __init__(self, problem: FitProblem, numbers: Sequence[Number], evidence: Evidence) -> None:
        self.problem, self.numbers, self.effort = problem, numbers, evidence.effort
        rng = np.random.default_rng(evidence.seed)
        self.seed = int(rng.integers(1 << 30))
        self.patches = [problem.patch(b, self.effort.pixels, rng) for b in evidence.pairs]
        self.wide = np.array([WIDE[name] for name, _ in numbers])
        self.bends = np.array([name != "gain" for name, _ in numbers])
        self.noise: list[tuple[Array, Array] | None] = [None] * len(self.patches)
        self.error = np.ones(len(numbers))

    def left_open(self) -> dict[str, float]:
        """Of the latest step; see `Solved`."""
        out: dict[str, float] = {}
        for (name, _), error in zip(self.numbers, self.error, strict=True):
            out[name] = max(out.get(name, 0.0), float(error))
        return out

    def step(self, raw: Raw, gain: Array, turn: int) -> Array:
        """How far to move each number, by its width."""
        parts = [self._patch(raw, gain, k, turn) for k in range(len(self.patches))]
        left, right, residual = (np.concatenate(x, axis=-1) for x in zip(*parts, strict=True))
        moment, matrix = left @ residual, left @ right.T
        # the prior: of each estimate about where it begins, of gains about the calibration
        about = np.array([np.log(gain[i]) / PRIOR if n == "gain" else 0 for n, i in self.numbers])
        step = np.zeros(len(about))
        for _ in range(2):
            # what the moment is off by: noise, and what no step explains, alike over some pixels
            # (of the steps, only intensities': other derivatives would add their own noise)
            left_over = residual + (step * ~self.bends) @ right
            parts_of = np.add.reduceat(
                left * left_over, np.arange(0, len(residual), _ALIKE), axis=1
            )
            spread = parts_of @ parts_of.T
            size = np.sqrt(np.diag(spread))
            if size.max() == 0:
                return step
            size = np.maximum(size, 1e-9 * size.max())
            spread = spread / np.outer(size, size) + 1e-6 * np.eye(len(size))
            half = np.linalg.solve(spread, np.column_stack([matrix, moment]) / size[:, None])
            back = (matrix / size[:, None]).T
            normal = back @ half[:, :-1] + np.eye(len(size))
            step = -np.linalg.solve(normal, back @ half[:, -1] + about)
            step = np.clip(step, -_FARTHEST, _FARTHEST)
        self.error = np.sqrt(np.diag(np.linalg.inv(normal)))
        return step

    def _patch(self, raw: Raw, gain: Array, k: int, turn: int) -> tuple[Array, Array, Array]:
        """Weighted instruments and derivatives `(numbers, N)` of a patch, and residuals `(N,)`."""
        patch = self.patches[k]
        seed = self.seed + turn * len(self.patches) + k
        # the first step need not be exact
        spp = max(FEWEST, self.effort.spp * (2 if turn else 1))
        effort = replace(self.effort, spp=spp)
        pictures = self.problem.linearised(raw, gain, patch, effort, seed)
        halves = pictures.picture()
        seen = self.problem.compare(patch, halves.mean(axis=0))
        weight = np.where(seen.valid[..., None], losses.weights(seen.level), 0)
        if (known := self.noise[k]) is not None:
            # of other paths: weights from this image's noise would select among it
            weight = losses.noise_weighted(weight, *known)
        light = 0.5 * (seen.captured + halves.mean(axis=0))
        self.noise[k] = (halves[0] - halves[1]) ** 2, light
        left, right = [], []
        for name, i in self.numbers:
            if name == "gain":
                of_light = (patch.lights == i)[:, None, None]
                left.append(np.broadcast_to(of_light * seen.level, halves.shape))
                right.append(of_light * halves * WIDE[name])
                continue
            moved = _changes(raw, (name, i))
            right.append(pictures.change(moved))
            if name == "sigma_a":
                channel = np.arange(3) == i
                left.append(np.broadcast_to(channel * seen.level, halves.shape))
            else:
                left.append(pictures.change(moved, first_hit=True))
        crossed = np.array(right)[:, ::-1].reshape(len(right), -1)
        residual = (halves - seen.captured)[::-1].ravel()
        return (np.array(left) * weight).reshape(len(left), -1), crossed, residual


def _changes(raw: Raw, number: Number) -> dict[str, Any]:
    """First-order change of the renderer's value by a number's width."""
    name, i = number
    slope = derivatives(raw)[name]
    if name != "sigma_a":
        return {name: float(slope[i]) * WIDE[name]}
    return {name: slope * (np.arange(3) == i) * WIDE[name]}
