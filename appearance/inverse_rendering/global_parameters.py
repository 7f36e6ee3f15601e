"""Roughness, index, mean colour and lamp intensities: few numbers, found from pictures alone.

Gauss-Newton, its derivatives on the left and on the right estimated apart. A path tracer's
derivative is mostly noise, and its square in the normal equations is nothing else. On the left
stand instruments, which need to be like the derivative but not equal to it: the derivative of the
light of the first hit, a difference quotient along the same paths, is hardly noisy. With
instruments Z, weights W and the difference r of rendered and captured, Zᵀ W r is zero on average at
the truth, whatever Z is. On the right stand quotients of whole pictures over wide steps, whose
noise has nothing to do with Z's or r's and changes only the length of a step. Pixels count by what
is known of them: W falls with their noise, of which one in a hundred has nearly half.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from appearance.inverse_rendering import losses
from appearance.inverse_rendering.batches import Batch, Seen
from appearance.inverse_rendering.problem import Effort, Problem
from appearance.inverse_rendering.unknowns import Raw
from reconstruction.arrays import Array
from reconstruction.report.report import Progress, silent

Number = tuple[str, int]
"""A name in `Raw` and the index of a channel there; of "gain", that of a lamp."""

PRIOR = 0.03
"""Standard deviation of a lamp's calibrated intensity, relative."""
WIDE = {"sigma_a": 0.4, "beta_m": 0.4, "beta_n": 0.6, "eta": 0.6, "tilt_deg": 3.0, "gain": PRIOR}
"""Half the width of a quotient, and how far one look may change its mind, in `Raw`'s units."""
_FARTHEST = 1.5
_TURNS, _LOOKS = 10, 4
"""Derivatives are taken anew when a number has moved by its width; residuals looked at with one."""
_FIRST_HITS = 1000
"""Number of the random numbers of instruments; derivatives' are less, those of looks follow."""
_FEWEST = 8
"""Paths a pixel of a picture that derivatives are made of."""
_BEGINS = (-1.8, 0.4)
"""Roughness begins between 0.15 and 0.6: a much narrower lobe is met by too few paths."""
_ALIKE = 3 * 32
"""Values in a row that may be off together."""


def solved(
    problem: Problem,
    raw: Raw,
    gain: Array,
    names: Sequence[str],
    pairs: Sequence[Batch],
    effort: Effort,
    *,
    progress: Progress = silent,
    seed: int = 0,
) -> tuple[Raw, Array]:
    """`raw` and `gain (L,)` with the numbers called `names` solved for.

    "sigma_a" moves all cells' logits alike in each channel; "gain" is the lamps' intensities, their
    mean kept at 1. What the pixels of `pairs` do not tell stays where it is: every look has a prior
    of the widths of `WIDE`, gains one of 3 % about the calibration. Found are beta_m of 0.05 to 0.7
    and beta_n of 0.2 to 0.7, wherever they begin; a narrower beta_n ends at up to 0.3. Takes the
    time of about ten pictures of `effort.spp` paths a pixel near the answer, five more for each
    time that a number moves by its width. Where a picture is not finite, it gives back what it got.
    """
    lamps = np.unique(np.concatenate([b.lights for b in pairs]))
    numbers = [
        (name, i)
        for name in WIDE
        if name in names
        for i in (lamps if name == "gain" else range(raw[name].shape[-1]))
    ]
    given = raw, gain
    for name in {"beta_m", "beta_n"} & set(names):
        raw = raw | {name: np.clip(raw[name], *_BEGINS)}
    looks: list[tuple[Raw, Array]] = []
    for turn in range(_TURNS):
        progress("derivatives of the shared numbers", turn / _TURNS)
        system = _System(problem, numbers, pairs, effort, (seed, turn))
        system.differentiate(raw, gain)
        away, looks = np.zeros(len(numbers)), []
        while len(looks) < _LOOKS and np.abs(away[system.bends]).max() < 1:
            step = system.step(raw, gain, len(looks))
            if not np.isfinite(step).all():
                return given
            away += step
            for number, d in zip(numbers, step * system.wide, strict=True):
                raw, gain = _moved(raw, gain, number, d)
            gain = gain / np.exp(np.log(gain).mean())
            looks.append((raw, gain))
        if len(looks) == _LOOKS:
            break
    # each look is a new estimate, of independent noise, once the first has come near
    last = looks[1:] or looks
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
    """The normal equations of some pixels; everything about them is flat over `pairs` `(N,)`."""

    problem: Problem
    numbers: Sequence[Number]
    pairs: Sequence[Batch]
    effort: Effort
    seeds: tuple[int, int]

    def __post_init__(self) -> None:
        rng = np.random.default_rng(self.seeds)
        self.seed = int(rng.integers(1 << 30))
        views = self.problem.views
        self.few = [
            np.sort(rng.permutation(len(views[b.view].pixels))[: self.effort.pixels])
            for b in self.pairs
        ]
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
        seen = self._seen(mean)
        level = np.concatenate([s.level.ravel() for s in seen])
        light = np.concatenate(
            [np.repeat(b.lights, 3 * len(f)) for b, f in zip(self.pairs, self.few, strict=True)]
        )
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
        self.weight = np.concatenate(
            [
                losses.quieted(
                    np.where(s.valid[..., None], losses.weights(s.level), 0), squares
                ).ravel()
                for s, squares in zip(seen, self._split(noise), strict=True)
            ]
        )

    def step(self, raw: Raw, gain: Array, look: int) -> Array:
        """How far to move each number, by its width: the first look is from half the paths."""
        spp = self.effort.spp * (2 if look else 1)
        picture = self._picture(raw, gain, spp, _FIRST_HITS + 1 + look)
        residual = picture - np.concatenate([s.captured.ravel() for s in self._seen(picture)])
        left = np.array(self.left) * self.weight
        told, matrix = left @ residual, left @ np.array(self.right).T
        # the prior: of each look about where it begins, of gains about the calibration
        about = np.array([np.log(gain[i]) / PRIOR if n == "gain" else 0 for n, i in self.numbers])
        step = np.zeros(len(about))
        for _ in range(2):
            # what told may be off by: noise, and what no step explains, alike over some pixels
            # (of the steps, only intensities': other derivatives would add their own noise)
            left_over = residual + (step * ~self.bends) @ np.array(self.right)
            parts = np.add.reduceat(left * left_over, np.arange(0, len(residual), _ALIKE), axis=1)
            spread = parts @ parts.T
            size = np.sqrt(np.diag(spread))
            if size.max() == 0:
                return step
            size = np.maximum(size, 1e-9 * size.max())
            spread = spread / np.outer(size, size) + 1e-6 * np.eye(len(size))
            half = np.linalg.solve(spread, np.column_stack([matrix, told]) / size[:, None])
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
        return np.concatenate(
            [
                self.problem.render(
                    raw, gain, b, f, effort, self.seed + number * len(self.pairs) + k
                ).ravel()
                for k, (b, f) in enumerate(zip(self.pairs, self.few, strict=True))
            ]
        )

    def _seen(self, picture: Array) -> list[Seen]:
        return [
            self.problem.seen(b, f, part)
            for b, f, part in zip(self.pairs, self.few, self._split(picture), strict=True)
        ]

    def _split(self, values: Array) -> list[Array]:
        """Flat values as `(k, P, 3)` of each of `pairs`."""
        shapes = [(len(b.lights), len(f), 3) for b, f in zip(self.pairs, self.few, strict=True)]
        ends = np.cumsum([np.prod(s) for s in shapes])
        return [v.reshape(s) for v, s in zip(np.split(values, ends[:-1]), shapes, strict=True)]
