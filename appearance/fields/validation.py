"""Cross-validation of a field's ridge and gain by left-out images."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from appearance.fields.basis import ViewBasis
from appearance.fields.form import Form
from appearance.fields.grams import Gram
from appearance.fields.options import FieldOptions
from appearance.fields.pictures import Pictures
from appearance.fields.solver import Iteration, LeastSquares, ViewSystem, conjugate_gradients
from appearance.metrics.decision import Decision, decide
from appearance.metrics.scores import srgb
from appearance.render.pixel_field import PixelField
from reconstruction import Progress
from reconstruction.arrays import Array, Floats
from reconstruction.files.durable import writing

PARTS = 9
"""Parts of a view's hair, of which errors are known separately."""
_LEAST_LIGHTS = 4
"""Fewest lights to leave some out."""
BLOCK = 64_000_000
"""Bytes of the coefficients of folds that are solved together."""
_PATIENCE = 2
"""Successive ridges worse than the best after which the search ends."""


@dataclass(frozen=True)
class Folds:
    """Each part of the views with each part of the lights is left out in turn.

    `views (V,)` and `lights (L,)` are their parts. A single part is never left out.
    """

    views: tuple[int, ...]
    lights: tuple[int, ...]

    @classmethod
    def of(cls, views: int, lights: int, most: int) -> Folds:
        """At most `most` parts of either; one for fewer than two views or four lights."""
        of_lights = most if lights >= _LEAST_LIGHTS else 1
        return cls(
            tuple(k % min(most, views) for k in range(views)),
            tuple(k % of_lights for k in range(lights)),
        )

    @property
    def of_views(self) -> int:
        """Parts of the views."""
        return max(self.views) + 1

    @property
    def of_lights(self) -> int:
        """Parts of the lights."""
        return max(self.lights) + 1

    @property
    def count(self) -> int:
        """Number of folds; 0 if nothing can be left out."""
        return self.of_views * self.of_lights if self.of_views * self.of_lights > 1 else 0

    def parts(self, fold: int) -> tuple[int, int]:
        """The left-out parts of the views and of the lights; -1 is none."""
        view, light = divmod(fold, self.of_lights)
        return (view if self.of_views > 1 else -1), (light if self.of_lights > 1 else -1)

    def lights_of(self, part: int) -> list[int]:
        """The numbers of a part of the lights."""
        return [i for i, k in enumerate(self.lights) if k == part]

    def is_fitted(self, fold: int, view: int, part: int) -> bool:
        """Whether a fold fits a part of the lights in a `view`."""
        left_out = self.parts(fold)
        return self.views[view] != left_out[0] and part != left_out[1]

    def is_judged(self, fold: int, view: int, part: int) -> bool:
        """Whether neither the view nor the part of the lights is fitted, where both can be left
        out; each frame is judged in one fold."""
        return all(
            left_out in (-1, there)
            for left_out, there in zip(self.parts(fold), (self.views[view], part), strict=True)
        )


@dataclass(frozen=True, eq=False)
class Data:
    """Input of fits: views, their bases, their quadratics by part of the lights, and `judges`, each
    view's validation pixels with their bases."""

    views: Sequence[Pictures]
    bases: Sequence[ViewBasis]
    grams: Sequence[dict[int, Gram]]
    judges: Sequence[tuple[Pictures, ViewBasis]]
    nested: Any
    options: FieldOptions
    scale: float
    unit: float

    def system(self, ridge: float, without: tuple[Folds, range] | None = None) -> LeastSquares:
        """The fit to everything, or together the fits without each of some folds."""
        folds, which = without or (None, range(1))
        views = []
        for i, (basis, parts) in enumerate(zip(self.bases, self.grams, strict=True)):
            fits = [
                tuple(
                    k
                    for k, fold in enumerate(which)
                    if folds is None or folds.is_fitted(fold, i, part)
                )
                for part in parts
            ]
            if any(fits):
                views.append(ViewSystem(basis, list(parts.values()), fits))
        return LeastSquares(views, self.nested, self.form, ridge, len(which))

    @property
    def form(self) -> Form:
        """Kind and degree of the coefficients."""
        return Form(self.options.kind, self.options.degree)

    def blocks(self, folds: Folds) -> list[range]:
        """The folds in blocks of at most `BLOCK` bytes, which are solved together."""
        one = 4 * self.nested.shape[1] * self.form.count * 3
        each = max(1, BLOCK // one)
        return [range(k, min(k + each, folds.count)) for k in range(0, folds.count, each)]

    def solved(self, system: LeastSquares, start: Floats | None, on_iteration: Iteration) -> Floats:
        """Its minimum `(N, Q · 3)`, by conjugate gradients."""
        options = self.options
        return conjugate_gradients(
            system, options.iterations, options.tolerance, start, on_iteration
        )

    def judging(self, view: int, fine: Floats) -> PixelField:
        """The fields of `fine (M, Q · 3 · F)` at a view's validation pixels."""
        pictures, basis = self.judges[view]
        found = (self.unit * basis.at_pixels(fine)).astype(np.float32)
        additive, alone = not self.options.multiplies, self.options.kind == "whole"
        return PixelField(found, pictures.hits.middle(), additive, alone=alone)

    def fingerprint(self) -> str:
        """A hash of the fit's input."""
        total = hashlib.sha256(repr((self.options, self.scale)).encode())
        for gram in (g for parts in self.grams for g in parts.values()):
            total.update(np.ascontiguousarray(gram.right).tobytes())
        return total.hexdigest()


@dataclass(frozen=True, eq=False)
class Verdict:
    """The chosen `ridge`.

    `decision` is that of the field. `tried` are the ridges with the error of left-out images.
    `start` are coefficients near the best; `best` is the ridge's number, from the strongest.
    """

    ridge: float
    best: int
    tried: list[tuple[float, float]]
    decision: Decision
    start: Floats | None


def cross_validated(
    data: Data, folds: Folds, checkpoint: Path | None, progress: Progress
) -> Verdict:
    """Fit without each fold, at ridges from the strongest on, and score the left-out images.

    Nested: a fold is scored at the ridge chosen by other images of the other folds. A killed run
    resumes after the ridges in `checkpoint`.
    """
    ridges = sorted(data.options.ridges, reverse=True)
    blocks = data.blocks(folds)
    systems = [data.system(ridges[0], (folds, block)) for block in blocks]
    without, counts = _squares(data, folds, None)
    state = _State.load(checkpoint, data.fingerprint(), np.ones((0, *without.shape)))
    for k, ridge in enumerate(ridges):
        if k < len(state.squares):
            continue
        errors = [float(x.sum()) for x in state.squares]
        if errors and k - 1 - int(np.argmin(errors)) >= _PATIENCE:
            break
        share = 1 / len(ridges)
        systems = [replace(system, ridge=ridge) for system in systems]
        starts: Sequence[Floats | None] = state.latest or [None] * len(systems)
        found = []
        for block, system, start in zip(blocks, systems, starts, strict=True):
            at = (k + block.start / folds.count) * share
            some = f"folds {block.start + 1} to {block.stop} of {folds.count}"
            found.append(
                data.solved(system, start, _iterations(f"ridge {ridge:g}, {some}", at, progress))
            )
        squares, _ = _squares(data, folds, found)
        error = _decision(squares, without, counts).before
        progress(f"ridge {ridge:g}: error on left-out images {error:.4f}", (k + 1) * share)
        state = _State(np.concatenate([state.squares, squares[None]]), found)
        state.save(checkpoint, data.fingerprint())
    best = _chosen(state.squares, counts)
    candidates = np.concatenate([without[None], state.squares])
    judged = [_elsewhere(candidates, counts, folds, f) for f in range(folds.count)]
    decision = _decision(without, np.stack(judged), counts)
    near = [x.reshape(len(x), -1, len(b)).sum(2) for x, b in zip(state.latest, blocks, strict=True)]
    start = np.asarray(sum(near) / folds.count, np.float32)
    errors = [_decision(x, x, counts).after or 0.0 for x in state.squares]
    return Verdict(ridges[best], best, list(zip(ridges, errors, strict=False)), decision, start)


def _iterations(
    what: str, share: float, progress: Progress
) -> Callable[[int, Floats, float], None]:
    return lambda _, __, left: progress(f"{what}: gradient at {left:.2g}", share)


def _squares(data: Data, folds: Folds, found: Sequence[Floats] | None) -> tuple[Array, Array]:
    """Squared errors of displayed values (products of two halves' errors, without noise) and their
    counts by fold, view, light and part of the hair `(F, V, L, B)`, for each fold's coefficients in
    blocks, or without a field."""
    shape = folds.count, len(folds.views), len(folds.lights), PARTS
    squares, counts = np.zeros((2, *shape))
    fine = [] if found is None else [np.asarray(data.nested @ x) for x in found]
    for i, (view, _) in enumerate(data.judges):
        fields = [data.judging(i, block) for block in fine]
        for light, part in enumerate(folds.lights):
            used, halves = view.valid[light][:, None], view.halves[:, light]
            true = srgb(view.captured[light] * data.scale)
            lit = [field.lit(halves, [view.lights[light]] * 2) for field in fields]
            split = [x.reshape(*halves.shape, -1) for x in lit]
            shown = np.concatenate(split, axis=-1) if lit else halves[..., None]
            for fold in range(folds.count):
                if not folds.is_judged(fold, i, part):
                    continue
                one, other = srgb(shown[..., fold if lit else 0] * data.scale) - true
                for values, of in ((one * other * used, squares), (3 * used, counts)):
                    parts = np.array_split(values, PARTS)
                    of[fold, i, light] = [float(x.sum()) for x in parts]
    return squares, counts


def _decision(before: Array, after: Array, counts: Array) -> Decision:
    """`decide` by errors and counts of `_squares`."""
    return decide("field", *(x.sum(axis=(0, 2)) for x in (before, after, counts)))


def _chosen(candidates: Array, counts: Array) -> int:
    """Index into errors `(R, F, V, L, B)`, strongest ridge first: the strongest than which the best
    is not better by more than its standard error."""
    best = int(np.argmin(candidates.sum(axis=(1, 2, 3, 4))))
    for k in range(best):
        if not _decision(candidates[k], candidates[best], counts).kept:
            return k
    return best


def _elsewhere(candidates: Array, counts: Array, folds: Folds, fold: int) -> Array:
    """A fold's errors `(V, L, B)` at the ridge (or no field, the first candidate) chosen by the
    other folds on views and lights that this fold does not leave out."""
    view, light = folds.parts(fold)
    views, lights = np.array(folds.views) != view, np.array(folds.lights) != light
    elsewhere = (slice(None), *np.ix_(np.arange(folds.count) != fold, views, lights))
    return np.asarray(candidates[_chosen(candidates[elsewhere], counts[elsewhere[1:]])][fold])


@dataclass(frozen=True, eq=False)
class _State:
    """The squares of the ridges done `(R, F, V, L, G)`, and each block's latest solution."""

    squares: Array
    latest: list[Floats]

    def save(self, path: Path | None, fingerprint: str) -> None:
        """Write it durably; nothing if `path` is None."""
        if path is None:
            return
        path.parent.mkdir(parents=True, exist_ok=True)
        latest: dict[str, Any] = {f"block_{k}": x for k, x in enumerate(self.latest)}
        with writing(path) as part:
            np.savez(part, fingerprint=np.array(fingerprint), squares=self.squares, **latest)

    @classmethod
    def load(cls, path: Path | None, fingerprint: str, none: Array) -> _State:
        """Read it; an empty state without a file of the same fit."""
        if path is None or not path.is_file():
            return cls(none, [])
        with np.load(path) as data:
            if str(data["fingerprint"]) != fingerprint:
                return cls(none, [])
            blocks = sum(name.startswith("block_") for name in data.files)
            return cls(data["squares"], [data[f"block_{k}"] for k in range(blocks)])
