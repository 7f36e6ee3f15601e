"""A field fitted to pictures: the ridge that held-out pictures prefer, then all pictures."""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from appearance.fields.anchors import Grid, Places, nested
from appearance.fields.basis import ViewBasis
from appearance.fields.field import Field
from appearance.fields.grams import Gram, Samples
from appearance.fields.hits import Hits
from appearance.fields.options import FieldOptions
from appearance.fields.solver import (
    Iteration,
    LeastSquares,
    Seen,
    conjugate_gradients,
    ignore,
)
from appearance.inverse_rendering import losses
from appearance.metrics.scores import srgb
from appearance.render.harmonics import harmonics
from reconstruction import Light, Progress, silent
from reconstruction.arrays import AnyFloats, Array, Bools, Floats

GROUPS = ("new lights", "new views", "both new")
MOST_CLAMPED = 0.01
"""Share of the samples that a modulation may make darker than black before they are left out."""
_CLAMP_ROUNDS = 2


@dataclass(frozen=True, eq=False)
class Pictures:
    """One view of a fit.

    `rendered` (inverse rendering's) and `captured (L, P, 3)` are radiance at the pixels of `hits`
    under each of `lights` alone; `valid (L, P)` is false where a frame is missing or saturated.
    """

    hits: Hits
    lights: tuple[Light, ...]
    rendered: Floats
    captured: Floats
    valid: Bools

    def samples(self, options: FieldOptions, scale: float, unit: float = 1.0) -> Samples:
        """What the fit of a kind of field is about, in exposure units: 1 is white.

        What is added is counted in `unit`s of radiance per irradiance.
        """
        rendered, captured = (x.astype(np.float64) * scale for x in (self.rendered, self.captured))
        level = losses.level(captured)
        if options.kind != "whole":
            level = 0.5 * (level + rendered)
        weight = np.where(self.valid[..., None], losses.weights(np.maximum(level, 0)), 0)
        points = self.hits.middle()
        regressor: AnyFloats = rendered
        if options.kind != "modulation":
            regressor = np.stack([_irradiance(x, points) for x in self.lights]) * scale * unit
        target = captured if options.kind == "whole" else captured - rendered
        arrays = (np.asarray(x, np.float32) for x in (regressor, target, weight))
        return Samples(self.lights, points, *arrays)


def _irradiance(light: Light, points: Floats) -> Floats:
    squared = np.sum((light.position - points) ** 2, axis=-1, keepdims=True)
    return np.asarray(light.intensity_towards(points) / squared, np.float32)


@dataclass(frozen=True)
class Monitor:
    """Who follows a fit, and the file in which it keeps where it stands; see `fit_pictures`."""

    progress: Progress = silent
    checkpoint: Path | None = None


@dataclass(frozen=True, eq=False)
class FieldFit:
    """A field and what is known of it.

    `validation` has, by group of `GROUPS`, the PSNR in dB of held-out pictures "without" the field
    and "with" one that was fitted to the others, at the same `ridge`; groups that nothing could be
    held out for are absent. `errors` are the ridges that were tried with the mean logarithm of the
    held-out weighted error relative to no field. `clamped` is the share of the samples that are
    black for being modulated below 0; `warnings` are for the user.
    """

    field: Field
    ridge: float
    validation: dict[str, dict[str, float]]
    errors: list[tuple[float, float]]
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

    The middle view and every fourth light are held out while the ridge is chosen; the result is
    fitted to everything at that ridge. With a checkpoint a fit that was killed goes on behind the
    ridges that it had done. Raises `ValueError` where there is no view.
    """
    if not views:
        raise ValueError("a field needs a view to be fitted to")
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
        self.views, self.places, self.scale = views, places, scale
        self.options, self.monitor = options, monitor
        strands = len(places.fitted)
        grids = [Grid.of(level, strands) for level in options.levels]
        self.grid, self.nested = grids[-1], nested(grids, places)
        lights = len(views[0].lights)
        self.held_lights = list(range(1, lights, 4)) if lights >= 4 else []
        self.kept_lights = [i for i in range(lights) if i not in self.held_lights]
        self.held_view = len(views) // 2 if len(views) > 1 else None
        self.unit = self._unit() if options.kind != "modulation" else 1.0
        self.warnings: list[str] = []

    def _unit(self) -> float:
        """What hair sends for the irradiance it gets, in the mean: the unit of what is added."""
        sent = sum(float(v.captured[v.valid].sum()) for v in self.views)
        given = 0.0
        for view in self.views:
            points = view.hits.middle()
            for i, light in enumerate(view.lights):
                given += float(_irradiance(light, points)[view.valid[i]].sum())
        return sent / given if sent > 0 and given > 0 else 1.0

    def run(self) -> FieldFit:
        progress, options = self.monitor.progress, self.options
        self.bases, self.kept, self.held = [], [], list[Gram]()
        for i, view in enumerate(self.views):
            progress(f"{view.hits.camera.name}: reducing its pictures", 0.4 * i / len(self.views))
            self.bases.append(
                ViewBasis.of(
                    view.hits,
                    self.grid,
                    self.places,
                    options.degree,
                    in_strands=options.kind == "modulation",
                )
            )
            samples = view.samples(options, self.scale, self.unit)
            self.kept.append(Gram.of(samples.under(self.kept_lights), options.degree))
            self.held.append(Gram.of(samples.under(self.held_lights), options.degree))
        ridge, errors, coefficients = self._choose()
        validation = self._judged(coefficients) if coefficients is not None else {}
        progress("fitting to all pictures", 0.8)
        found, clamped = self._final(ridge, coefficients)
        made = self._field(found)
        return FieldFit(made, ridge, validation, errors, clamped, self.warnings)

    def _choose(self) -> tuple[float, list[tuple[float, float]], Floats | None]:
        """The ridge that held-out pictures prefer, all errors, and its coefficients."""
        ridges = sorted(self.options.ridges, reverse=True)
        if not self.held_lights and self.held_view is None:
            self.warnings.append(
                "one view and fewer than 4 lights: nothing can be held out, so the strongest ridge "
                "is used and nothing says whether the field is better than none"
            )
            return ridges[0], [], None
        fit = [
            Seen(b, g)
            for i, (b, g) in enumerate(zip(self.bases, self.kept, strict=True))
            if i != self.held_view
        ]
        groups = self._held_out()
        zero = [sum(seen.gram.constant for seen in group) for group in groups]
        state = _State.load(self.monitor.checkpoint, self._fingerprint())
        for k, ridge in enumerate(ridges):
            if k < len(state.errors):
                continue
            if k - state.best >= 3:  # two in a row were worse than the best
                break
            system = LeastSquares(fit, self.nested, self.options.degree, ridge)
            each = 0.4 / len(ridges)
            part = (0.4 + each * k, each / self.options.iterations)

            def told(
                done: int,
                _: Floats,
                left: float,
                ridge: float = ridge,
                part: tuple[float, float] = part,
            ) -> None:
                share = part[0] + part[1] * done
                self.monitor.progress(f"ridge {ridge:g}: gradient at {left:.2g}", share)

            start = state.latest if len(state.latest) else None
            found = self._solved(system, start, told)
            errors = [system.error(found, group) for group in groups]
            value = float(np.mean(np.log(np.maximum(errors, 1e-12) / np.maximum(zero, 1e-12))))
            told_error = f"ridge {ridge:g}: held-out error {np.exp(value):.3f}"
            self.monitor.progress(told_error, part[0] + each)
            state = state.after(value, found)
            state.save(self.monitor.checkpoint, self._fingerprint())
        tried = [(r, e) for r, e in zip(ridges, state.errors, strict=False)]
        if state.best == len(ridges) - 1:
            self.warnings.append(f"the weakest ridge of those allowed, {ridges[-1]:g}, is best")
        if state.best == 0:
            self.warnings.append(
                f"the strongest ridge of those allowed, {ridges[0]:g}, is best: it says little"
            )
        return ridges[state.best], tried, state.coefficients

    def _solved(
        self, system: LeastSquares, start: Floats | None, told: Iteration = ignore
    ) -> Floats:
        options = self.options
        return conjugate_gradients(system, options.iterations, options.tolerance, start, told)

    def _field(self, fine: Floats) -> Field:
        options = self.options
        values = np.asarray(self.unit * fine, np.float32)
        return Field.of(options.kind, options.degree, self.grid, self.places, values)

    def _held_out(self) -> list[list[Seen]]:
        """The pictures of each group of `GROUPS` that is there."""
        rest = [i for i in range(len(self.views)) if i != self.held_view]
        out = [[Seen(self.bases[i], self.held[i]) for i in rest]] if self.held_lights else []
        if self.held_view is not None:
            i = self.held_view
            out.append([Seen(self.bases[i], self.kept[i])])
            if self.held_lights:
                out.append([Seen(self.bases[i], self.held[i])])
        return out

    def _judged(self, coefficients: Floats) -> dict[str, dict[str, float]]:
        """PSNR of held-out pictures by group, with the field and without."""
        made = self._field(np.asarray(self.nested @ coefficients))
        squares: dict[str, list[tuple[Array, Array]]] = {}
        for i, view in enumerate(self.views):
            parts = {GROUPS[0]: self.held_lights}
            if i == self.held_view:
                parts = {GROUPS[1]: self.kept_lights, GROUPS[2]: self.held_lights}
            at = made.at(view.hits)
            for group, lights in parts.items():
                if not view.valid[lights].any():
                    continue
                rendered = view.rendered[lights]
                lit = at.lit(rendered, [view.lights[k] for k in lights])
                wanted, used = srgb(view.captured[lights] * self.scale), view.valid[lights]
                off = [(srgb(x * self.scale) - wanted)[used] ** 2 for x in (rendered, lit)]
                squares.setdefault(group, []).append((off[0].ravel(), off[1].ravel()))
        out = {}
        for group, found in squares.items():
            means = [float(np.concatenate([f[k] for f in found]).mean()) for k in (0, 1)]
            without, with_it = (-10 * np.log10(max(m, 1e-10)) for m in means)
            out[group] = {"without": float(without), "with": float(with_it)}
        return out

    def _final(self, ridge: float, start: Floats | None) -> tuple[Floats, float]:
        """The field of all pictures `(M, v · n · 3)`, and the share of samples that it clamps."""
        grams = [a + b for a, b in zip(self.kept, self.held, strict=True)]
        for round_ in range(_CLAMP_ROUNDS + 1):
            seen = [Seen(b, g) for b, g in zip(self.bases, grams, strict=True)]
            system = LeastSquares(seen, self.nested, self.options.degree, ridge)
            start = self._solved(system, start)
            fine = np.asarray(self.nested @ start)
            if self.options.kind != "modulation":
                return fine, 0.0
            below = [self._below(i, fine) for i in range(len(self.views))]
            weighed = sum(int(v.valid.sum()) for v in self.views) * 3
            clamped = sum(int(b.sum()) for b in below) / max(weighed, 1)
            if clamped <= MOST_CLAMPED or round_ == _CLAMP_ROUNDS:
                break
            for i, view in enumerate(self.views):
                samples = view.samples(self.options, self.scale)
                weight = np.where(below[i], 0, samples.weight)
                grams[i] = Gram.of(replace(samples, weight=weight), self.options.degree)
        if clamped > MOST_CLAMPED:
            self.warnings.append(
                f"{clamped:.1%} of the samples are modulated below black, and shown black: inverse "
                "rendering is far from these frames"
            )
        return fine, clamped

    def _below(self, number: int, fine: Floats) -> Bools:
        """Where the modulation is below 0 `(L, P, 3)`."""
        view, basis = self.views[number], self.bases[number]
        g, points = basis.at_pixels(fine), view.hits.middle()
        out = np.zeros(view.rendered.shape, bool)
        for i, light in enumerate(view.lights):
            y = harmonics(light.position - points, self.options.degree)
            out[i] = (1 + np.einsum("pn,pnc->pc", y, g) < 0) & view.valid[i][:, None]
        return out

    def _fingerprint(self) -> str:
        total = hashlib.sha256(repr((self.options, self.scale)).encode())
        for gram in (*self.kept, *self.held):
            total.update(np.ascontiguousarray(gram.right).tobytes())
        return total.hexdigest()


@dataclass(frozen=True, eq=False)
class _State:
    """The held-out errors of the ridges done, the latest solution and the best one."""

    errors: tuple[float, ...]
    latest: Floats
    best_found: Floats

    @property
    def best(self) -> int:
        """The number of the best ridge; 0 where none is done."""
        return int(np.argmin(self.errors)) if self.errors else 0

    @property
    def coefficients(self) -> Floats:
        """Those of the best ridge."""
        return self.best_found

    def after(self, error: float, found: Floats) -> _State:
        """With one more ridge."""
        better = not self.errors or error < min(self.errors)
        return _State((*self.errors, error), found, found if better else self.best_found)

    def save(self, path: Path | None, fingerprint: str) -> None:
        """Write it, whole or not at all; nothing where `path` is None."""
        if path is None:
            return
        path.parent.mkdir(parents=True, exist_ok=True)
        part = path.with_suffix(".part.npz")
        names = {"fingerprint": np.array(fingerprint), "errors": np.array(self.errors)}
        np.savez(part, **names, latest=self.latest, best=self.best_found)  # type: ignore[arg-type]
        part.replace(path)

    @classmethod
    def load(cls, path: Path | None, fingerprint: str) -> _State:
        """Read it; nothing done where there is no file, or one of another fit."""
        none = np.zeros((0, 0), np.float32)
        if path is None or not path.is_file():
            return cls((), none, none)
        with np.load(path) as data:
            if str(data["fingerprint"]) != fingerprint:
                return cls((), none, none)
            return cls(tuple(data["errors"].tolist()), data["latest"], data["best"])
