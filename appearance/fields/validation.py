"""Cross-validation of a field: the ridge that left-out pictures prefer, and what it is worth."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from appearance.fields.basis import ViewBasis
from appearance.fields.grams import Gram
from appearance.fields.options import FieldOptions
from appearance.fields.pictures import Pictures
from appearance.fields.solver import Iteration, LeastSquares, Seen, conjugate_gradients
from appearance.metrics.scores import srgb
from appearance.render.pixel_field import PixelField
from reconstruction import Progress
from reconstruction.arrays import Array, Floats, Ints

GROUPS = ("new lights", "new views", "both new")
_LEAST_LIGHTS = 4
"""Fewer lights are not left out."""
_PATIENCE = 2
"""Ridges in a row that are worse than the best, after which no weaker one is tried."""


@dataclass(frozen=True)
class Folds:
    """Every part of the views, each with every part of the lights: left out together in turn.

    `views (V,)` and `lights (L,)` are the parts that each belongs to. Of one part none is left out.
    """

    views: tuple[int, ...]
    lights: tuple[int, ...]

    @classmethod
    def of(cls, views: int, lights: int, most: int) -> Folds:
        """At most `most` parts of either; one of fewer than two views or four lights."""
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
        """Folds; 0 where nothing can be left out."""
        return self.of_views * self.of_lights if self.of_views * self.of_lights > 1 else 0

    def parts(self, fold: int) -> tuple[int, int]:
        """The parts of the views and of the lights that a fold leaves out; -1 is none."""
        view, light = divmod(fold, self.of_lights)
        return (view if self.of_views > 1 else -1), (light if self.of_lights > 1 else -1)

    def lights_of(self, part: int) -> list[int]:
        """The numbers of a part of the lights."""
        return [i for i, k in enumerate(self.lights) if k == part]

    def group(self, fold: int, view: int, part: int) -> int | None:
        """Of `GROUPS`, what a part of the lights is in a `view`; None where it was fitted."""
        left_out = self.parts(fold)
        new_view, new_light = self.views[view] == left_out[0], part == left_out[1]
        return (0 if new_light else None) if not new_view else (2 if new_light else 1)


@dataclass(frozen=True, eq=False)
class Data:
    """What fits are made from: views, their bases, and of each the quadratics by part of lights."""

    views: Sequence[Pictures]
    bases: Sequence[ViewBasis]
    grams: Sequence[dict[int, Gram]]
    nested: Any
    options: FieldOptions
    scale: float
    unit: float

    def system(self, ridge: float, without: tuple[Folds, int] | None = None) -> LeastSquares:
        """The fit to everything, or to what a fold leaves."""
        seen = []
        for i, (basis, parts) in enumerate(zip(self.bases, self.grams, strict=True)):
            used = list(parts.values())
            if without is not None:
                folds, fold = without
                if folds.views[i] == folds.parts(fold)[0]:
                    continue
                used = [gram for part, gram in parts.items() if part != folds.parts(fold)[1]]
            total = used[0]
            for gram in used[1:]:
                total = total + gram
            seen.append(Seen(basis, total))
        return LeastSquares(seen, self.nested, self.options.degree, ridge)

    def solved(self, system: LeastSquares, start: Floats | None, told: Iteration) -> Floats:
        """Its minimum `(N, v · n · 3)`, by conjugate gradients."""
        options = self.options
        return conjugate_gradients(system, options.iterations, options.tolerance, start, told)

    def pixel_field(self, view: int, fine: Floats) -> PixelField:
        """The field of `fine (M, v · n · 3)` at the finest grid's anchors, at a view's pixels."""
        found = (self.unit * self.bases[view].at_pixels(fine)).astype(np.float32)
        additive, alone = self.options.kind != "modulation", self.options.kind == "whole"
        return PixelField(found, self.views[view].hits.middle(), additive, alone=alone)

    def fingerprint(self) -> str:
        """Of all that a fit depends on."""
        total = hashlib.sha256(repr((self.options, self.scale)).encode())
        for gram in (g for parts in self.grams for g in parts.values()):
            total.update(np.ascontiguousarray(gram.right).tobytes())
        return total.hexdigest()


@dataclass(frozen=True, eq=False)
class Verdict:
    """The `ridge` that is best of all, all that were tried, and what left-out pictures say.

    `tried` are ridges with the mean logarithm, over groups, of the squared error of displayed
    values relative to no field. `validation` and `gain`: see `FieldFit`. `start` are coefficients
    near the best; `best` is the ridge's number, from the strongest.
    """

    ridge: float
    best: int
    tried: list[tuple[float, float]]
    validation: dict[str, dict[str, float]]
    gain: tuple[float, float]
    start: Floats | None


def cross_validated(
    data: Data, folds: Folds, checkpoint: Path | None, progress: Progress
) -> Verdict:
    """Fit to what each fold leaves, at ridges from the strongest on; judge by what it leaves out.

    A fold's pictures are judged at the ridge that the other folds prefer, so that no picture has a
    part in the field that it judges. Killed, it goes on behind the ridges that `checkpoint` has.
    """
    ridges = sorted(data.options.ridges, reverse=True)
    without, counts = _squares(data, folds, None)
    state = _State.load(checkpoint, data.fingerprint(), np.ones((0, *without.shape)))
    for k, ridge in enumerate(ridges):
        if k < len(state.squares):
            continue
        values = [_objective(s, without) for s in state.squares]
        if values and k - 1 - int(np.argmin(values)) >= _PATIENCE:
            break
        share = 1 / len(ridges)
        systems = (data.system(ridge, (folds, f)) for f in range(folds.count))
        starts: Sequence[Floats | None] = state.latest or [None] * folds.count
        found = []
        for fold, (system, start) in enumerate(zip(systems, starts, strict=True)):
            at = (k + fold / folds.count) * share
            told = _iterations(f"ridge {ridge:g}, fold {fold + 1} of {folds.count}", at, progress)
            found.append(data.solved(system, start, told))
        squares, _ = _squares(data, folds, found)
        progress(
            f"ridge {ridge:g}: left-out error {np.exp(_objective(squares, without)):.3f}",
            (k + 1) * share,
        )
        state = _State(np.concatenate([state.squares, squares[None]]), found)
        state.save(checkpoint, data.fingerprint())
    values = [_objective(s, without) for s in state.squares]
    best = int(np.argmin(values))
    judged = np.stack([_elsewhere(state.squares, without, f) for f in range(folds.count)])
    near = np.asarray(np.mean(state.latest, axis=0), np.float32) if state.latest else None
    tried = list(zip(ridges, values, strict=False))
    return Verdict(ridges[best], best, tried, *_validation(judged, without, counts), near)


def _iterations(
    what: str, share: float, progress: Progress
) -> Callable[[int, Floats, float], None]:
    return lambda _, __, left: progress(f"{what}: gradient at {left:.2g}", share)


def _squares(data: Data, folds: Folds, found: Sequence[Floats] | None) -> tuple[Array, Array]:
    """Squared errors of displayed values, and how many: by fold, view and group `(F, V, G)`.

    With each fold's coefficients, or without a field.
    """
    squares, counts = np.zeros((2, folds.count, len(data.views), len(GROUPS)))
    for fold in range(folds.count):
        fine = None if found is None else np.asarray(data.nested @ found[fold])
        for i, view in enumerate(data.views):
            at = None if fine is None else data.pixel_field(i, fine)
            for part in range(folds.of_lights):
                group = folds.group(fold, i, part)
                if group is None:
                    continue
                lights = folds.lights_of(part)
                shown, used = view.rendered[lights], view.valid[lights]
                if at is not None:
                    shown = at.lit(shown, [view.lights[k] for k in lights])
                off = srgb(shown * data.scale) - srgb(view.captured[lights] * data.scale)
                squares[fold, i, group] += float((off[used] ** 2).sum(dtype=np.float64))
                counts[fold, i, group] += 3 * int(used.sum())
    return squares, counts


def _objective(squares: Array, without: Array) -> float:
    """The mean over groups of the logarithm of the error relative to that without a field."""
    pairs = zip(squares.sum((0, 1)), without.sum((0, 1)), strict=True)
    logs = [np.log(max(a, 1e-12) / b) for a, b in pairs if b > 0]
    return float(np.mean(logs)) if logs else 0.0


def _elsewhere(squares: Array, without: Array, fold: int) -> Array:
    """A fold's squares `(V, G)` at the ridge that the others prefer, which may be no field."""
    others = np.arange(len(without)) != fold
    if not others.any():
        others[:] = True
    candidates = [*squares, without]
    values = [_objective(s[others], without[others]) for s in candidates]
    return np.asarray(candidates[int(np.argmin(values))][fold])


def _validation(
    squares: Array, without: Array, counts: Array
) -> tuple[dict[str, dict[str, float]], tuple[float, float]]:
    """PSNR by group with the standard error of its gain; the mean gain with its standard error.

    The errors are those of leaving out one view in turn, or one part of the lights of one view.
    """
    axis = 0 if counts.shape[1] > 1 else 1
    a, b, n = (x.sum(axis) for x in (squares, without, counts))  # (V or F, G)
    there = n.sum(0) > 0
    units = np.flatnonzero(n.sum(1))
    rest = [np.delete(units, k) for k in range(len(units))] if len(units) > 1 else []

    def gains(used: Ints) -> Array:
        ratio = b[used][:, there].sum(0) / np.maximum(a[used][:, there].sum(0), 1e-30)
        return 10 * np.log10(np.clip(ratio, 1e-10, 1e10))

    def spread(values: list[Array]) -> Array:
        return np.sqrt((len(values) - 1) * np.var(values, axis=0)) if values else np.inf + there

    each = spread([gains(used) for used in rest])
    found = {}
    for k, group in enumerate(np.flatnonzero(there)):
        with_it, without_it = (
            float(-10 * np.log10(max(x[:, group].sum() / n[:, group].sum(), 1e-10))) for x in (a, b)
        )
        row = {"without": without_it, "with": with_it, "spread": float(each[k])}
        found[GROUPS[group]] = row
    if not found:
        return {}, (0.0, np.inf)
    total = spread([gains(used).mean(keepdims=True) for used in rest])
    return found, (float(gains(units).mean()), float(total[0]))


@dataclass(frozen=True, eq=False)
class _State:
    """The left-out squares of the ridges done `(R, F, V, G)`, and each fold's latest solution."""

    squares: Array
    latest: list[Floats]

    def save(self, path: Path | None, fingerprint: str) -> None:
        """Write it, whole or not at all; nothing where `path` is None."""
        if path is None:
            return
        path.parent.mkdir(parents=True, exist_ok=True)
        part = path.with_suffix(".part.npz")
        arrays: dict[str, Any] = {"squares": self.squares, "latest": np.stack(self.latest)}
        np.savez(part, fingerprint=np.array(fingerprint), **arrays)
        part.replace(path)

    @classmethod
    def load(cls, path: Path | None, fingerprint: str, none: Array) -> _State:
        """Read it; nothing done where there is no file, or one of another fit."""
        if path is None or not path.is_file():
            return cls(none, [])
        with np.load(path) as data:
            if str(data["fingerprint"]) != fingerprint:
                return cls(none, [])
            return cls(data["squares"], list(data["latest"]))
