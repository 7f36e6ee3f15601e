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
from appearance.metrics.scores import srgb
from appearance.render.pixel_field import PixelField
from reconstruction import Progress
from reconstruction.arrays import Array, Floats
from reconstruction.files.durable import writing

GROUPS = ("new lights", "new views", "both new")
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

    def group(self, fold: int, view: int, part: int) -> int | None:
        """Number in `GROUPS` of a part of the lights in a `view`; None if it was fitted."""
        left_out = self.parts(fold)
        new_view, new_light = self.views[view] == left_out[0], part == left_out[1]
        return (0 if new_light else None) if not new_view else (2 if new_light else 1)


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
                    if folds is None or folds.group(fold, i, part) is None
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
    """The chosen `ridge`, and the scores of left-out images.

    `tried` are ridges with the mean gain in dB over groups and its standard error. `validation` and
    `gain`: see `FieldFit`. `start` are coefficients near the best; `best` is the ridge's number,
    from the strongest.
    """

    ridge: float
    best: int
    tried: list[tuple[float, float, float]]
    validation: dict[str, dict[str, float]]
    gain: tuple[float, float]
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
        found_gains = [_mean_gain(x, without)[0] for x in state.squares]
        if found_gains and k - 1 - int(np.argmax(found_gains)) >= _PATIENCE:
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
        progress(
            f"ridge {ridge:g}: left-out images gain {_mean_gain(squares, without)[0]:.2f} dB",
            (k + 1) * share,
        )
        state = _State(np.concatenate([state.squares, squares[None]]), found)
        state.save(checkpoint, data.fingerprint())
    best = _chosen(state.squares)
    judged = np.stack([_elsewhere(state.squares, without, folds, f) for f in range(folds.count)])
    near = [x.reshape(len(x), -1, len(b)).sum(2) for x, b in zip(state.latest, blocks, strict=True)]
    start = np.asarray(sum(near) / folds.count, np.float32)
    tried = [(r, *_mean_gain(x, without)) for r, x in zip(ridges, state.squares, strict=False)]
    return Verdict(ridges[best], best, tried, *_validation(judged, without, counts), start)


def _iterations(
    what: str, share: float, progress: Progress
) -> Callable[[int, Floats, float], None]:
    return lambda _, __, left: progress(f"{what}: gradient at {left:.2g}", share)


def _squares(data: Data, folds: Folds, found: Sequence[Floats] | None) -> tuple[Array, Array]:
    """Squared errors of displayed values (products of two halves' errors, without noise) and their
    counts by fold, view, light and group `(F, V, L, G)`, for each fold's coefficients in blocks, or
    without a field."""
    shape = folds.count, len(folds.views), len(folds.lights), len(GROUPS)
    squares, counts = np.zeros((2, *shape))
    fine = [] if found is None else [np.asarray(data.nested @ x) for x in found]
    for i, (view, _) in enumerate(data.judges):
        fields = [data.judging(i, block) for block in fine]
        for light, part in enumerate(folds.lights):
            used, halves = view.valid[light], view.halves[:, light]
            true = srgb(view.captured[light] * data.scale)
            lit = [field.lit(halves, [view.lights[light]] * 2) for field in fields]
            split = [x.reshape(*halves.shape, -1) for x in lit]
            shown = np.concatenate(split, axis=-1) if lit else halves[..., None]
            for fold in range(folds.count):
                group = folds.group(fold, i, part)
                if group is None:
                    continue
                one, other = srgb(shown[..., fold if lit else 0] * data.scale) - true
                squares[fold, i, light, group] = float((one * other)[used].sum())
                counts[fold, i, light, group] = 3 * int(used.sum())
    return squares, counts


def gains(squares: Array, without: Array) -> Array:
    """Gain in dB of sums of squares over those `without`, of any one shape."""
    ratio = np.maximum(without, 1e-30) / np.maximum(squares, 1e-30)
    return np.asarray(10 * np.log10(np.clip(ratio, 1e-10, 1e10)))


def _mean_gain(squares: Array, without: Array) -> tuple[float, float]:
    """The mean of the groups' gains in dB, and its standard error; both are `(F, V, L, G)`."""
    there = without.sum((0, 1, 2)) > 0
    if not there.any():
        return 0.0, np.inf
    a, b = squares[..., there], without[..., there]
    mean = float(gains(a.sum((0, 1, 2)), b.sum((0, 1, 2))).mean())
    return mean, float(spread_of(a, b, lambda x, y: gains(x, y).mean(axis=-1)))


def spread_of(squares: Array, without: Array, of: Callable[[Array, Array], Array]) -> Array:
    """The standard error of `of` the sums `(..., G)` of squares and of those without.

    Jackknife variances over views and over lights add up. Infinite for one view and one light.
    """
    total: Any = np.inf if max(without.shape[1:3]) < 2 else 0.0
    for others in ((0, 2), (0, 1)):
        a, b = squares.sum(others), without.sum(others)
        if len(a) > 1:
            each = of(a.sum(0) - a, b.sum(0) - b)
            total = total + (len(a) - 1) * np.var(each, axis=0)
    return np.asarray(np.sqrt(total))


def _chosen(candidates: Array) -> int:
    """Index into errors `(R, F, V, L, G)`, strongest ridge first: the strongest whose loss against
    the best is within its standard error."""
    best = int(np.argmax([_mean_gain(x, candidates[0])[0] for x in candidates]))
    for k in range(best):
        gain, spread = _mean_gain(candidates[best], candidates[k])
        if gain <= spread:
            return k
    return best


def _elsewhere(squares: Array, without: Array, folds: Folds, fold: int) -> Array:
    """A fold's errors `(V, L, G)` at the ridge (or no field) chosen by the other folds on views and
    lights that this fold does not leave out."""
    view, light = folds.parts(fold)
    others = np.arange(folds.count) != fold
    views, lights = np.array(folds.views) != view, np.array(folds.lights) != light
    candidates = np.concatenate([without[None], squares])
    elsewhere = candidates[:, others][:, :, views][:, :, :, lights]
    return np.asarray(candidates[_chosen(elsewhere)][fold])


def _validation(
    squares: Array, without: Array, counts: Array
) -> tuple[dict[str, dict[str, float]], tuple[float, float]]:
    """PSNR by group with the standard error of its gain; the mean gain with its standard error."""
    a, b, n = (x.sum((0, 1, 2)) for x in (squares, without, counts))
    each = spread_of(squares, without, gains)
    found = {}
    for k in np.flatnonzero(b > 0):
        with_it, without_it = (float(-10 * np.log10(max(x[k] / n[k], 1e-10))) for x in (a, b))
        spread = float(np.broadcast_to(each, a.shape)[k])
        found[GROUPS[k]] = {"without": without_it, "with": with_it, "spread": spread}
    return found, _mean_gain(squares, without)


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
