"""Roughness, index, mean colour and light intensities: few numbers, found from pictures alone.

Gauss-Newton, its derivatives on the left and on the right estimated apart: the square of a path
tracer's derivative is mostly noise. On the left stand instruments Z, the hardly noisy derivative
of the light of the first hit; with weights W and the difference r of rendered and captured, Zᵀ W r
is zero on average at the truth, whatever Z is. On the right stand quotients of whole pictures over
wide steps: their noise, independent of Z's and r's, changes only the length of a step.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from appearance.inverse_rendering import losses
from appearance.inverse_rendering.batches import Batch, Comparison
from appearance.inverse_rendering.options import Effort
from appearance.inverse_rendering.problem import FitProblem
from appearance.inverse_rendering.unknowns import Raw
from reconstruction import Progress, silent
from reconstruction.arrays import Array

Number = tuple[str, int]
"""A name in `Raw` and the index of a channel there; of "gain", that of a light."""

PRIOR = 0.03
"""Standard deviation of a light's calibrated intensity, relative."""
WIDE = {"sigma_a": 0.4, "beta_m": 0.4, "beta_n": 0.6, "eta": 0.6, "gain": PRIOR}
"""Half the width of a quotient, and how far one estimate may step, in `Raw`'s units."""
_FARTHEST = 1.5
_LINEARISATIONS, _ESTIMATES = 10, 4
"""Derivatives are taken anew when a number has moved by its width; residuals with the same ones."""
_FIRST_HITS = 1000
"""Number of the random numbers of instruments; derivatives' are less, those of estimates follow."""
_FEWEST = 8
"""Paths a pixel of a picture that derivatives are made of."""
_BEGINS = (-1.8, 0.4)
"""Roughness begins between 0.15 and 0.6: a much narrower lobe is met by too few paths."""
_ALIKE = 3 * 32
"""Values in a row that may be off together."""


@dataclass(frozen=True)
class Evidence:
    """The pictures that numbers are found from: `pairs`, pixels and paths, and a seed."""

    pairs: Sequence[Batch]
    effort: Effort
    seed: int = 0


def solve_global_parameters(
    problem: FitProblem,
    raw: Raw,
    gain: Array,
    names: Sequence[str],
    evidence: Evidence,
    progress: Progress = silent,
) -> tuple[Raw, Array]:
    """`raw` and `gain (L,)` with the numbers called `names` solved for.

    "sigma_a" moves all cells' logits alike in each channel; "gain" is the lights' intensities,
    their mean kept at 1. What no pixel of the pairs depends on stays where it is: every estimate
    has a prior of the widths of `WIDE`, gains one of 3 % about the calibration. Found are beta_m of
    0.05 to 0.7 and beta_n of 0.2 to 0.7, wherever they begin; a narrower beta_n ends at up to 0.3.
    Takes the time of about ten pictures of `effort.spp` paths a pixel near the answer, five more
    for each time that a number moves by its width. Where a picture is not finite, it gives back
    what it got.
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
    estimates: list[tuple[Raw, Array]] = []
    for turn in range(_LINEARISATIONS):
        progress("derivatives of the global parameters", turn / _LINEARISATIONS)
        system = _System(problem, numbers, evidence, turn)
        system.differentiate(raw, gain)
        away, estimates = np.zeros(len(numbers)), []
        while len(estimates) < _ESTIMATES and np.abs(away[system.bends]).max() < 1:
            step = system.step(raw, gain, len(estimates))
            if not np.isfinite(step).all():
                return given
            away += step
            for number, d in zip(numbers, step * system.wide, strict=True):
                raw, gain = _moved(raw, gain, number, d)
            gain = gain / np.exp(np.log(gain).mean())
            estimates.append((raw, gain))
        if len(estimates) == _ESTIMATES:
            break
    # each is of independent noise, once the first has come near
    last = estimates[1:] or estimates
    return (
        raw | {n: np.mean([r[n] for r, _ in last], axis=0) for n in names if n in raw},
        np.exp(np.mean([np.log(g) for _, g in last], axis=0)),
    )


def _moved(raw: Raw, gain: Array, number: Number, d: float) -> tuple[Raw, Array]:
    name, i = number
    if name == "gain":
        gain = gain.copy()
        gain[i] *= np.exp(d)
        return raw, gain
    value = raw[name].copy()
    value[..., i] += d
    return raw | {name: value}, gain


@dataclass
class _System:
    """The normal equations of some pixels, about which everything is flat over patches `(N,)`."""

    problem: FitProblem
    numbers: Sequence[Number]
    evidence: Evidence
    turn: int

    def __post_init__(self) -> None:
        rng = np.random.default_rng((self.evidence.seed, self.turn))
        self.seed = int(rng.integers(1 << 30))
        self.effort = self.evidence.effort
        self.patches = [self.problem.patch(b, self.effort.pixels, rng) for b in self.evidence.pairs]
        self.wide = np.array([WIDE[name] for name, _ in self.numbers])
        self.bends = np.array([name != "gain" for name, _ in self.numbers])

    def differentiate(self, raw: Raw, gain: Array) -> None:
        """Instruments, derivatives, noise and weights about `raw` and `gain`."""
        drawn = [n for n in self.numbers if n[0] != "gain"]
        few = max(_FEWEST, self.effort.spp // 8)
        quotients: dict[Number, Array] = {}
        means, squares = [], []
        for k, number in enumerate(drawn):
            more, less = (
                [
                    self._picture(*_moved(raw, gain, number, side * WIDE[number[0]]), few, drawing)
                    for drawing in (8 * k + 1 - side, 8 * k + 2 - side)
                ]
                for side in (1, -1)
            )
            quotients[number] = (more[0] + more[1] - less[0] - less[1]) / 4
            means.append((more[0] + more[1] + less[0] + less[1]) / 4)
            squares.append((more[0] - more[1]) ** 2 + (less[0] - less[1]) ** 2)
        mean, noise = np.mean(means, axis=0), np.mean(squares, axis=0)
        seen = self._compared(mean)
        level = np.concatenate([s.level.ravel() for s in seen])
        light = np.concatenate([np.repeat(p.lights, 3 * len(p.few)) for p in self.patches])
        channel = np.arange(len(level)) % 3
        self.left, self.right = [], []
        for number in self.numbers:
            name, i = number
            if name == "gain":
                self.left.append(np.where(light == i, level, 0))
                self.right.append(np.where(light == i, mean, 0) * WIDE[name])
                continue
            self.right.append(quotients[number])
            if name == "sigma_a":
                self.left.append(np.where(channel == i, level, 0))
            else:
                self.left.append(self._first_hit(raw, gain, number))
        weights = [np.where(s.valid[..., None], losses.weights(s.level), 0) for s in seen]
        parts = zip(weights, self._split(noise), strict=True)
        self.weight = np.concatenate([losses.noise_weighted(w, n).ravel() for w, n in parts])

    def step(self, raw: Raw, gain: Array, estimate: int) -> Array:
        """How far to move each number, by its width: the first estimate is from half the paths."""
        spp = self.effort.spp * (2 if estimate else 1)
        picture = self._picture(raw, gain, spp, _FIRST_HITS + 1 + estimate)
        residual = picture - np.concatenate([s.captured.ravel() for s in self._compared(picture)])
        left = np.array(self.left) * self.weight
        moment, matrix = left @ residual, left @ np.array(self.right).T
        # the prior: of each estimate about where it begins, of gains about the calibration
        about = np.array([np.log(gain[i]) / PRIOR if n == "gain" else 0 for n, i in self.numbers])
        step = np.zeros(len(about))
        for _ in range(2):
            # what the moment is off by: noise, and what no step explains, alike over some pixels
            # (of the steps, only intensities': other derivatives would add their own noise)
            left_over = residual + (step * ~self.bends) @ np.array(self.right)
            parts = np.add.reduceat(left * left_over, np.arange(0, len(residual), _ALIKE), axis=1)
            spread = parts @ parts.T
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
        return step

    def _first_hit(self, raw: Raw, gain: Array, number: Number) -> Array:
        """Half the difference that a number's width makes to what a camera ray meets first."""
        once = replace(self.effort, max_depth=1)
        spp = max(_FEWEST, self.effort.spp // 2)
        more, less = (
            self._picture(*_moved(raw, gain, number, d), spp, _FIRST_HITS, once)
            for d in (WIDE[number[0]], -WIDE[number[0]])
        )
        return np.asarray((more - less) / 2)

    def _picture(
        self, raw: Raw, gain: Array, spp: int, number: int, effort: Effort | None = None
    ) -> Array:
        effort = replace(effort or self.effort, spp=spp)
        first = self.seed + number * len(self.patches)
        render, patches = self.problem.render, enumerate(self.patches)
        return np.concatenate([render(raw, gain, p, effort, first + k).ravel() for k, p in patches])

    def _compared(self, picture: Array) -> list[Comparison]:
        parts = zip(self.patches, self._split(picture), strict=True)
        return [self.problem.compare(patch, part) for patch, part in parts]

    def _split(self, values: Array) -> list[Array]:
        """Flat values as `(k, P, 3)` of each patch."""
        shapes = [(len(p.lights), len(p.few), 3) for p in self.patches]
        ends = np.cumsum([np.prod(s) for s in shapes])
        return [v.reshape(s) for v, s in zip(np.split(values, ends[:-1]), shapes, strict=True)]
