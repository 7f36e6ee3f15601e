"""Least squares of a field by conjugate gradients."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from appearance.fields.basis import ViewBasis
from appearance.fields.form import Form
from appearance.fields.grams import Gram
from appearance.render.harmonics import degrees
from reconstruction.arrays import AnyFloats, Array, Bools, Floats

Iteration = Callable[[int, Floats, float], None]
"""Called with the number of iterations done, the coefficients and the gradient's relative size."""


def ignore(_done: int, _coefficients: Floats, _gradient: float) -> None:
    """An `Iteration` that does nothing."""


@dataclass(frozen=True, eq=False)
class ViewSystem:
    """A view in one or more fits: the basis of its pixels, and its images reduced to quadratics in
    parts, `grams`, each of the fits with numbers in `fits`."""

    basis: ViewBasis
    grams: Sequence[Gram]
    fits: Sequence[tuple[int, ...]] = ((0,),)

    @property
    def used(self) -> tuple[int, ...]:
        """The fits of any of its parts."""
        return tuple(sorted(set().union(*self.fits)))

    def summed(self, of: Callable[[Gram, list[int]], Floats]) -> Floats:
        """The sum `(P, n, 3 · used)` over parts of `of` a part and the indices of its fits among
        those used, `(P, n, 3, …)`."""
        used, n = self.used, self.basis.harmonics
        total = np.zeros((len(self.grams[0].right), n, 3, len(used)), np.float32)
        for gram, fits in zip(self.grams, self.fits, strict=True):
            at = [used.index(f) for f in fits]
            found = of(gram, at)
            for k, f in enumerate(at):
                total[..., f] += found[..., k % found.shape[-1]]
        return total.reshape(len(total), n, -1)


@dataclass(frozen=True, eq=False)
class LeastSquares:
    """The squared errors of F fields on some views, with a ridge.

    Coefficients `(N, Q · 3 · F)` of all grids, the fits' side by side, so that sparse products are
    shared. `nested (M, N)` sums grids at the anchors of the last. `ridge` is that of degree 0;
    `known` caches terms independent of it across `dataclasses.replace`.
    """

    views: Sequence[ViewSystem]
    nested: Any
    form: Form
    ridge: float
    fits: int = 1
    known: dict[str, Floats] = field(default_factory=dict, repr=False)

    @property
    def shape(self) -> tuple[int, int]:
        """Shape of the coefficients."""
        return self.nested.shape[1], self.form.count * 3 * self.fits

    @property
    def penalty(self) -> Floats:
        """The ridge of each column `(Q · 3 · F,)`, growing with the degrees."""
        each = np.repeat(self.form.growth, 3 * self.fits)
        return (self.ridge * each).astype(np.float32)

    def right(self) -> Floats:
        """The right side `(N, Q · 3 · F)` of the normal equations."""
        if "right" not in self.known:
            pixels = [s.summed(lambda gram, _: gram.right[..., None]) for s in self.views]
            self.known["right"] = self.nested.T @ self._at_anchors(_anchors, pixels)
        return self.known["right"]

    def times(self, coefficients: Floats) -> Floats:
        """The left side of the normal equations times `coefficients (N, Q · 3 · F)`."""
        fine: Floats = self.nested @ coefficients
        pixels = (_times(view, g) for view, g in zip(self.views, self._pixels(fine), strict=True))
        gathered = self.nested.T @ self._at_anchors(_anchors, pixels)
        return np.asarray(gathered + self.penalty * coefficients)

    def diagonal(self) -> Floats:
        """Approximate diagonal `(N, Q · 3 · F)` of the left side."""
        if "diagonal" not in self.known:
            k = degrees(self.form.degree)
            pixels = [s.summed(lambda gram, _: gram.diagonal(k)[..., None]) for s in self.views]
            squared = self.nested.copy()
            squared.data = squared.data**2
            self.known["diagonal"] = squared.T @ self._at_anchors(_squared, pixels)
        return np.asarray(self.known["diagonal"] + self.penalty)

    def each(self, values: AnyFloats) -> Array:
        """The sums `(F,)` of `values (N, Q · 3 · F)` over each fit."""
        return np.asarray(values.sum(axis=0, dtype=np.float64).reshape(-1, self.fits).sum(axis=0))

    def spread(self, factors: AnyFloats | Bools) -> Floats:
        """Factors of the fits `(F,)` repeated for the columns `(Q · 3 · F,)`."""
        return np.tile(factors.astype(np.float32), self.shape[1] // self.fits)

    def _pixels(self, fine: Floats) -> Iterator[Floats]:
        """Of each view `(P, n, 3 · used)`."""
        parts: dict[tuple[int, ...], Floats] = {}
        for view in self.views:
            used = view.used
            if used not in parts:
                every = len(used) == self.fits
                some = fine if every else np.take(_split(fine, self.fits), used, axis=-1)
                parts[used] = some.reshape(len(fine), -1)
            yield view.basis.at_pixels(parts[used])

    def _at_anchors(
        self, gather: Callable[[ViewBasis, Floats], Floats], pixels: Iterable[Floats]
    ) -> Floats:
        """Values at the views' pixels, summed at the finest anchors `(M, Q · 3 · F)`."""
        parts: dict[tuple[int, ...], Floats] = {}
        for view, values in zip(self.views, pixels, strict=True):
            found = gather(view.basis, values)
            if view.used in parts:
                parts[view.used] += found
            else:
                parts[view.used] = found
        total = np.zeros((self.nested.shape[0], self.shape[1]), np.float32)
        for used, found in parts.items():
            if len(used) == self.fits:
                total += found
                continue
            for k, fit in enumerate(used):
                _split(total, self.fits)[..., fit] += _split(found, len(used))[..., k]
        return total


def _anchors(basis: ViewBasis, values: Floats) -> Floats:
    return basis.at_anchors(values)


def _squared(basis: ViewBasis, values: Floats) -> Floats:
    return basis.squares(values)


def _times(view: ViewSystem, g: Floats) -> Floats:
    """The matrices of a view's fits times `g (P, n, 3 · used)`."""
    each = g.reshape(*g.shape[:2], 3, -1)
    return view.summed(lambda gram, at: gram.times(np.take(each, at, axis=-1)))


def _split(values: Floats, fits: int) -> Floats:
    return values.reshape(len(values), -1, fits)


def conjugate_gradients(
    system: LeastSquares,
    iterations: int,
    tolerance: float,
    start: Floats | None = None,
    on_iteration: Iteration = ignore,
) -> Floats:
    """The coefficients `(N, Q · 3 · F)` that minimise `system`, from `start` (None: 0).

    Preconditioned by the diagonal. Each fit ends after `iterations`, or at a preconditioned
    gradient of `tolerance` times that at 0, as if solved alone. Coefficients without observations
    stay 0. `on_iteration` gets the largest gradient.
    """
    right = system.right()
    scale: Floats = np.float32(1) / system.diagonal()
    at_zero = system.each(right * right * scale)
    x = np.zeros(system.shape, np.float32)
    if start is not None:
        x += start * system.spread(at_zero > 0)
    r: Floats = right - system.times(x) if x.any() else right.copy()
    z: Floats = r * scale
    direction, size = z.copy(), system.each(r * z)
    for k in range(iterations):
        going = size > tolerance**2 * at_zero
        if not going.any():
            break
        image = system.times(direction)
        curvature = system.each(direction * image)
        step = system.spread(np.divide(size, curvature, out=np.zeros_like(size), where=going))
        x += step * direction
        r -= step * image
        z = r * scale
        before, size = size, np.where(going, system.each(r * z), size)
        along = np.divide(size, before, out=np.zeros_like(size), where=going)
        direction = z + system.spread(along) * direction
        left = np.divide(size, at_zero, out=np.zeros_like(size), where=at_zero > 0)
        on_iteration(k + 1, x, float(np.sqrt(left.max())))
    return x
