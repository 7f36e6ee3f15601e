"""A field fitted to images: the ridge by cross-validation, then a fit to all images."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from appearance.fields.anchors import Grid, Places, nested
from appearance.fields.basis import ViewBasis
from appearance.fields.field import Field
from appearance.fields.form import Form
from appearance.fields.grams import Gram
from appearance.fields.options import FieldOptions
from appearance.fields.pictures import Pictures, irradiance
from appearance.fields.solver import ignore
from appearance.fields.validation import Data, Folds, cross_validated
from appearance.metrics.decision import Decision
from appearance.render.harmonics import harmonics
from reconstruction import Progress, silent
from reconstruction.arrays import Bools, Floats
from reconstruction.report.progress import part_of

NOTHING = "no frame can be held out of one view and fewer than four lights"
MOST_CLAMPED = 0.01
"""Share of samples with a negative modulation above which they are excluded from the fit."""
_CLAMP_ROUNDS = 2
JUDGED = 1000
"""Most validation pixels of a view."""


@dataclass(frozen=True)
class Monitor:
    """Progress callback and checkpoint file of a fit."""

    progress: Progress = silent
    checkpoint: Path | None = None


@dataclass(frozen=True, eq=False)
class FieldFit:
    """A field, and whether it is kept by images that fields to other images were judged on.

    `tried` are the ridges with the error of left-out images. `clamped` is the share of samples with
    a negative modulation; `warnings` are for the user.
    """

    field: Field
    ridge: float
    decision: Decision
    tried: list[tuple[float, float]]
    clamped: float
    warnings: list[str] = dataclasses.field(default_factory=list)


def fit_pictures(
    views: Sequence[Pictures],
    places: Places,
    scale: float,
    options: FieldOptions | None = None,
    monitor: Monitor | None = None,
) -> FieldFit:
    """Fit a field to `views`, whose radiance times `scale` has white at 1.

    The ridge is chosen by `cross_validated`, the result fitted to all views and lights. With a
    checkpoint a killed fit resumes after the ridges done. Raises `ValueError` if neither a view nor
    lights can be left out.
    """
    if not views or not Folds.of(len(views), len(views[0].lights), 2).count:
        raise ValueError(NOTHING)
    return _Fit(views, places, scale, options or FieldOptions(), monitor or Monitor()).run()


class _Fit:
    def __init__(
        self,
        views: Sequence[Pictures],
        places: Places,
        scale: float,
        options: FieldOptions,
        monitor: Monitor,
    ) -> None:
        self.options, self.monitor, self.places = options, monitor, places
        self.form = Form(options.kind, options.degree)
        strands = len(places.fitted)
        grids = [Grid.of(level, strands) for level in options.levels]
        self.grid = grids[-1]
        self.folds = Folds.of(len(views), len(views[0].lights), options.folds)
        unit = _unit(views) if not options.multiplies else 1.0
        bases, grams, judges = [], [], []
        for i, view in enumerate(views):
            monitor.progress(f"{view.hits.camera.name}: reducing its images", 0.3 * i / len(views))
            bases.append(self._basis(view))
            few = view.some(JUDGED)
            judges.append((few, bases[-1] if few is view else self._basis(few)))
            samples = view.samples(options, scale, unit)
            grams.append(
                {
                    part: Gram.of(samples.under(self.folds.lights_of(part)), self.form.degree)
                    for part in range(self.folds.of_lights)
                }
            )
        self.data = Data(views, bases, grams, judges, nested(grids, places), options, scale, unit)
        self.warnings: list[str] = []

    def _basis(self, view: Pictures) -> ViewBasis:
        return self.form.basis(view.hits, self.grid, self.places)

    def run(self) -> FieldFit:
        progress, options = self.monitor.progress, self.options
        ridges = sorted(options.ridges, reverse=True)
        validating = part_of(progress, 0.3, 0.9)
        found = cross_validated(self.data, self.folds, self.monitor.checkpoint, validating)
        if found.best == len(ridges) - 1:
            self.warnings.append(
                f"The weakest ridge, {found.ridge:g}, was chosen: the field may overfit."
            )
        if found.best == 0:
            self.warnings.append(
                f"The strongest ridge, {found.ridge:g}, was chosen: the field changes little."
            )
        progress("fitting to all images", 0.9)
        fine, clamped = self._final(found.ridge, found.start)
        values = np.asarray(self.data.unit * fine, np.float32)
        made = Field.of(self.form, self.grid, self.places, values)
        return FieldFit(made, found.ridge, found.decision, found.tried, clamped, self.warnings)

    def _final(self, ridge: float, start: Floats | None) -> tuple[Floats, float]:
        """The field of all images `(M, Q · 3)`, and the share of clamped samples."""
        data, options = self.data, self.options
        for round_ in range(_CLAMP_ROUNDS + 1):
            start = data.solved(data.system(ridge), start, ignore)
            fine = np.asarray(data.nested @ start)
            if not options.multiplies:
                return fine, 0.0
            below = [_below(data, i, fine) for i in range(len(data.views))]
            weighed = sum(int(v.valid.sum()) for v in data.views) * 3
            clamped = sum(int(b.sum()) for b in below) / max(weighed, 1)
            if clamped <= MOST_CLAMPED or round_ == _CLAMP_ROUNDS:
                break
            grams = []
            for view, where in zip(data.views, below, strict=True):
                samples = view.samples(options, data.scale)
                weight = np.where(where, 0, samples.weight)
                grams.append({-1: Gram.of(replace(samples, weight=weight), self.form.degree)})
            data = replace(data, grams=grams)
        if clamped > MOST_CLAMPED:
            self.warnings.append(
                f"{clamped:.1%} of the samples have a negative modulation and are rendered black: "
                "the material does not match these frames."
            )
        return fine, clamped


def _unit(views: Sequence[Pictures]) -> float:
    """Mean radiance over irradiance of the hair: the unit of an additive field."""
    sent = sum(float(v.captured[v.valid].sum()) for v in views)
    given = 0.0
    for view in views:
        points = view.hits.middle()
        for i, light in enumerate(view.lights):
            given += float(irradiance(light, points)[view.valid[i]].sum())
    return sent / given if sent > 0 and given > 0 else 1.0


def _below(data: Data, number: int, fine: Floats) -> Bools:
    """Where the modulation is below 0 `(L, P, 3)`."""
    view = data.views[number]
    g, points = data.bases[number].at_pixels(fine), view.hits.middle()
    out = np.zeros(view.captured.shape, bool)
    for i, light in enumerate(view.lights):
        y = harmonics(light.position - points, data.form.degree)
        out[i] = (1 + np.einsum("pn,pnc->pc", y, g) < 0) & view.valid[i][:, None]
    return out
