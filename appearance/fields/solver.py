"""Least squares of a field: conjugate gradients, and Adam on single pictures as the reference."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from appearance.fields.basis import ViewBasis
from appearance.fields.grams import Gram, Samples
from appearance.render.harmonics import count_of, degrees
from reconstruction.arrays import Floats

Iteration = Callable[[int, Floats, float], None]
"""Called with the number of iterations done, the coefficients and the gradient's relative size."""


def ignore(_done: int, _coefficients: Floats, _gradient: float) -> None:
    """An `Iteration` that does nothing."""


@dataclass(frozen=True, eq=False)
class Seen:
    """A view in a fit: what its pixels show of a field, and its pictures reduced."""

    basis: ViewBasis
    gram: Gram


@dataclass(frozen=True, eq=False)
class LeastSquares:
    """The error of a field on some views, and a ridge: a quadratic of its coefficients.

    Coefficients `(N, v · n · 3)` are those of all grids; `nested (M, N)` adds grids up at the
    anchors of the last. `ridge` is that of the degree 0.
    """

    views: Sequence[Seen]
    nested: Any
    degree: int
    ridge: float

    @property
    def shape(self) -> tuple[int, int]:
        """Of the coefficients."""
        return self.nested.shape[1], count_of(self.degree) ** 2 * 3

    @property
    def penalty(self) -> Floats:
        """The ridge of each column `(v · n · 3,)`, growing with the degrees."""
        k = degrees(self.degree)
        grows = 1 + k * (k + 1.0)
        each = np.repeat(np.outer(grows, grows).ravel(), 3)
        return (self.ridge * each).astype(np.float32)

    def right(self) -> Floats:
        """The right side `(N, v · n · 3)` of the normal equations."""
        return self._gathered([seen.gram.right for seen in self.views])

    def times(self, coefficients: Floats) -> Floats:
        """The left side of the normal equations times `coefficients (N, v · n · 3)`."""
        fine: Floats = self.nested @ coefficients
        pixels = [seen.gram.times(seen.basis.at_pixels(fine)) for seen in self.views]
        return np.asarray(self._gathered(pixels) + self.penalty * coefficients)

    def diagonal(self) -> Floats:
        """About the diagonal `(N, v · n · 3)` of the left side."""
        k = degrees(self.degree)
        total = np.zeros((self.nested.shape[0], self.shape[1]), np.float32)
        for seen in self.views:
            total += seen.basis.squares(seen.gram.diagonal(k))
        squared = self.nested.copy()
        squared.data = squared.data**2
        return np.asarray(squared.T @ total + self.penalty)

    def error(self, coefficients: Floats, views: Sequence[Seen] | None = None) -> float:
        """Squared error of `coefficients (N, v · n · 3)` on `views`, or on those of the fit."""
        fine = self.nested @ coefficients
        used = self.views if views is None else views
        return sum(seen.gram.error(seen.basis.at_pixels(fine)) for seen in used)

    def objective(self, coefficients: Floats) -> float:
        """What is minimised over `coefficients (N, v · n · 3)`: the error and the ridge's part."""
        ridge = np.sum(self.penalty * coefficients**2, dtype=np.float64)
        return self.error(coefficients) + float(ridge)

    def _gathered(self, pixels: Sequence[Floats]) -> Floats:
        total = np.zeros((self.nested.shape[0], self.shape[1]), np.float32)
        for seen, values in zip(self.views, pixels, strict=True):
            total += seen.basis.at_anchors(values)
        return np.asarray(self.nested.T @ total)


def conjugate_gradients(
    system: LeastSquares,
    iterations: int,
    tolerance: float,
    start: Floats | None = None,
    on_iteration: Iteration = ignore,
) -> Floats:
    """The coefficients `(N, v · n · 3)` that minimise `system`, from `start` (0 where None).

    Preconditioned by the diagonal. Ends after `iterations`, or once the preconditioned gradient has
    fallen to `tolerance` of the start's from 0. A coefficient that no observation meets stays 0.
    """
    right = system.right()
    scale = 1 / system.diagonal()
    at_zero = float(np.sum(right * right * scale, dtype=np.float64))
    x = np.zeros(system.shape, np.float32) if start is None else start.copy()
    if at_zero == 0:
        return np.zeros_like(x)
    r = right if start is None else right - system.times(x)
    z = r * scale
    direction, size = z.copy(), float(np.sum(r * z, dtype=np.float64))
    for k in range(iterations):
        if size <= tolerance**2 * at_zero:
            break
        image = system.times(np.asarray(direction, np.float32))
        step = size / float(np.sum(direction * image, dtype=np.float64))
        x += np.float32(step) * direction
        r -= np.float32(step) * image
        z = r * scale
        before, size = size, float(np.sum(r * z, dtype=np.float64))
        direction = z + np.float32(size / before) * direction
        on_iteration(k + 1, x, float(np.sqrt(size / at_zero)))
    return x


@dataclass(frozen=True)
class AdamOptions:
    """`steps` of one picture each, at a learning `rate`; `seed` draws the pictures."""

    rate: float
    steps: int
    seed: int = 0


def adam(
    system: LeastSquares,
    samples: Sequence[Samples],
    options: AdamOptions,
    on_iteration: Iteration = ignore,
) -> Floats:
    """The reference: Adam (Kingma & Ba 2015), a random view under a random light a step.

    `samples` are those of the views of `system`, whose minimum `(N, v · n · 3)` is looked for.
    """
    rng = np.random.default_rng(options.seed)
    x, first, second = (np.zeros(system.shape, np.float32) for _ in range(3))
    pictures = [(v, k) for v, s in enumerate(samples) for k in range(len(s.lights))]
    for k in range(1, options.steps + 1):
        view, light = pictures[rng.integers(len(pictures))]
        seen, picture = system.views[view], samples[view]
        y = picture.directions(system.degree, light)
        g = seen.basis.at_pixels(system.nested @ x)
        rendered = np.einsum("pn,pnc->pc", y, g) * picture.regressor[light]
        off = picture.weight[light] * picture.regressor[light] * (rendered - picture.target[light])
        pulled = seen.basis.at_anchors(y[:, :, None] * off[:, None])
        slope = len(pictures) * (system.nested.T @ pulled) + system.penalty * x
        first += np.float32(0.1) * (slope - first)
        second += np.float32(0.001) * (slope * slope - second)
        ahead, size = first / (1 - 0.9**k), second / (1 - 0.999**k)
        x -= np.float32(options.rate) * ahead / (np.sqrt(size) + np.float32(1e-8))
        on_iteration(k, x, float("nan"))
    return x
