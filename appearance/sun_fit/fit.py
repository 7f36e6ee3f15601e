"""Fit the appearance of a reconstructed model to the OLAT frames of its capture."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from appearance.bsdf.longitudinal import (
    absorption_of_colour,
    roughness_of_variance,
    variance_of_roughness,
)
from appearance.metrics.scores import Exposure
from appearance.observations import HeldOut, Observed
from appearance.render.olat import render_olat
from appearance.render.tracing import Sampling
from appearance.scene.hair_appearance import HairAppearance
from appearance.scene.hair_scene import HairScene, build_scene
from appearance.sun_fit.fit_pixels import (
    COVERED,
    FitPixels,
    check_strands,
    covered,
    in_front,
    observed_pixels,
    reached,
)
from appearance.sun_fit.fitted_appearance import FittedAppearance, absorption_warnings
from appearance.sun_fit.highlights import WINDOW, Highlight, Highlights
from appearance.sun_fit.light_correlation import Roughness, match_roughness
from appearance.sun_fit.mirror_samples import (
    MirrorSamples,
    binned,
    mirror_lights,
    mirror_samples,
    usable,
)
from appearance.sun_fit.options import FitOptions
from appearance.sun_fit.roughness_and_colour import (
    LEAST_ALBEDO,
    LEAST_SKIN,
    MOST_ALBEDO,
    MOST_SKIN,
    Colours,
    Lobe,
    absorption_error,
    fit_colour,
    fit_lobe,
    fit_lobe_as_printed,
)
from appearance.sun_fit.visible_fibres import VisibleFibres, visible_fibres
from reconstruction import Capture, Model, Progress, Report, Stage, silent
from reconstruction.arrays import Array, Bools, Floats, Ints
from reconstruction.report.report import Series

MAX_DEPTH = 16
ASSUMED = 0.3
"""β_M where there are no single lights, the middle of human hair's."""
BETA_N = 0.2
"""Azimuthal roughness, fixed as in Sun §5.1."""
ROUGHNESSES = (0.04, 0.12, 0.22, 0.35, 0.55, 0.95)
"""β_M of the renderings, the range of the result."""
ROUGHNESS_PIXELS = 350
"""Most pixels a camera for matching highlights."""


def fit(
    capture: Capture,
    model: Model,
    *,
    held_out: HeldOut | None = None,
    options: FitOptions | None = None,
    progress: Progress = silent,
    seed: int = 0,
) -> Report:
    """Fit roughness, hair colour and skin colour (Sun 2021, §5) and write `appearance.json`.

    Uses the model's strands and masks and the OLAT frames of `capture` that are not `held_out`; of
    patterns of lights the roughness is assumed, and the colour of sums is matched. The returned
    report, also the model's, has the stages "samples", "roughness" and "colour". Raises
    `CaptureError` or `ValueError` naming what is missing.
    """
    held_out, options = held_out or HeldOut(), options or FitOptions()
    training = held_out.training(capture)
    strands = model.strands()
    if len(strands) == 0:
        raise ValueError(f"{model.file('strands.npz')} has no strands: there is no hair to fit")
    report = model.report()
    with report.stage("samples") as stage:
        progress("reading hair pixels", 0.0)
        pixels = observed_pixels(training, model, options, stage, progress, seed)
        exposure = Exposure.of([o.radiance[o.valid] for o in pixels.hair])
        pixels = reached(training, pixels, exposure, stage)
        head = model.head(capture)
        scene = build_scene(strands, head, hair=HairAppearance((0.1, 0.1, 0.1), 0.3, BETA_N))
        check_strands(training, model, scene, stage, seed)
    fitting = SunFit(scene, pixels, options, seed, progress)
    with report.stage("roughness") as stage:
        found = fitting.roughness(stage) if training.olat_lights() else None
        if found is None:
            stage.warn(
                f"Patterns show no highlight of a single light: beta_m {ASSUMED} is assumed, and "
                "only inverse rendering estimates it."
            )
            beta_m, first = ASSUMED, fitting.first_colour(ASSUMED)
        else:
            stage.warn(found.matched.limit())
            beta_m, first = found.matched.beta_m, found.first
    with report.stage("colour") as stage:
        start = np.array(first.colour), np.array(first.skin)
        colours = fitting.colour(beta_m, *start, stage)
        if head is None:
            stage.leave_out("skin colour", "there is no head mesh", "its renderings")
        elif not pixels.skin:
            stage.warn("Skin is visible in no camera: its colour is a guess.")
        red, green, blue = fitting.absorption_error(colours)
        stage.figures["sigma_a_error"] = [red, green, blue]
        for warning in absorption_warnings(colours.hair.sigma_a, (red, green, blue)):
            stage.warn(warning)
        if capture.plan.get("import", {}).get("relative"):
            stage.warn(
                "Radiometric scale unknown: hair albedo is relative until you import with `scale` "
                "or a grey ball (docs/how-to/import.md)."
            )
    made = (colours.hair, colours.colour, colours.skin, exposure)
    v = float(variance_of_roughness(beta_m))
    variances, spread = (v, v, v), dict[str, Any]()
    if found is not None:
        variances, roughness = (v, found.plain.v, found.printed), found.matched
        spread["beta_m_error"] = roughness.error
        spread["beta_m_interval"] = roughness.low, roughness.high
    model.forget_appearance()
    errors = {**spread, "sigma_a_error": (red, green, blue)}
    FittedAppearance(*made, *variances, held_out, **errors).save(model)
    for stale in ("inverse_rendering", "field", "images"):
        report.drop(stale)
    model.write_report(report)
    progress("appearance fitted", 1.0)
    return report


def _spread(observed: Observed) -> Ints:
    """Indices of `ROUGHNESS_PIXELS` of the pixels, evenly spaced."""
    count = len(observed.pixels)
    return np.linspace(0, count - 1, min(count, ROUGHNESS_PIXELS)).astype(int)


@dataclass(frozen=True)
class Roughnesses:
    """The roughness by three methods.

    `matched` by renderings that match the capture, `plain` by the lobe of the capture's samples,
    `printed` the variance by Eq. 10 as printed. `first` is the colour of the renderings.
    """

    matched: Roughness
    plain: Lobe
    printed: float
    first: Colours


@dataclass(frozen=True)
class SunFit:
    """The observations and the geometry that the fits of roughness and colour share."""

    scene: HairScene
    pixels: FitPixels
    options: FitOptions
    seed: int
    progress: Progress

    def roughness(self, stage: Stage) -> Roughnesses:
        """The roughness by matched renderings.

        Raises `ValueError` for patterns, or if no light lies near a mirror direction.
        """
        if any(len(o.single_lights) < len(o.lights) for o in self.pixels.hair):
            raise ValueError("patterns show no highlight of a single light")
        self.progress("measuring the highlight", 0.3)
        hair = self.pixels.hair
        step = max(1, len(hair) // self.options.roughness_cameras)
        views = self._views(hair[::step][: self.options.roughness_cameras])
        if len(views) < len(hair):
            stage.leave_out(
                f"{len(hair) - len(views)} of {len(hair)} cameras",
                "the highlight is the same in all of them",
                f"{1 - len(views) / len(hair):.0%} of the renderings",
            )
        views = [(o, f) for o, f in views if len(o.lights)]
        if not views:
            raise ValueError(
                "no light lies near a mirror direction of any hair pixel: the roughness needs more "
                "lights"
            )
        mean: Array = np.sum([o.radiance.mean((0, 1)) for o, _ in views], axis=0)
        # a black channel has no highlight
        channel = int(np.argmin(np.where(mean > 0, mean, np.inf)))
        plain, printed, count = self._read(views, channel)
        self.progress("a first colour", 0.4)
        first = self.first_colour(plain.beta_m)
        captured, highlights = self._highlights(views, channel)

        def rendered(number: int, beta: float) -> Highlight:
            self.progress("matching the highlight", 0.5 + number / 40)
            lit = self.scene.with_hair(replace(first.hair, beta_m=beta)).with_skin(first.skin)
            return highlights.of([self._halves(lit, o, number) for o, _ in highlights.views])

        family = [(beta, rendered(k, beta)) for k, beta in enumerate(ROUGHNESSES, 1)]
        found = match_roughness(captured, family)
        stage.figures |= {
            "samples": count,
            "pairs_of_lights": int(captured.pairs.sum()),
            "channel": "RGB"[channel],
            "sun_v": plain.v,
            "sun_beta_m": plain.beta_m,
            "sun_v_as_printed": printed,
            "sun_beta_m_as_printed": float(roughness_of_variance(printed)),
            "lobe_residual": plain.residual,
            **asdict(found),
            "range": list(found.range),
            "views": list(found.views),
            "correlation_deg": float(np.degrees(captured.angle())),
            "rendered_correlation_deg": [
                [beta, float(np.degrees(highlight.angle()))] for beta, highlight in family
            ],
        }
        for warning in found.warnings():
            stage.warn(warning)
        return Roughnesses(found, plain, printed, first)

    def first_colour(self, beta_m: float) -> Colours:
        """The colour of all light: near a highlight, indirect light comes from all directions."""
        skin, unreported = np.array(self.scene.skin), Stage("first colour")
        return self.colour(beta_m, None, skin, unreported, pixels=self.covered)

    @cached_property
    def covered(self) -> FitPixels:
        """The pixels for comparing colours."""
        return covered(self.pixels, self.scene)

    @cached_property
    def in_front(self) -> FitPixels:
        """Those, with hair under lights on its camera's side only."""
        return in_front(self.covered, self.scene)

    def colour(
        self,
        beta_m: float,
        start: Array | None,
        skin: Array,
        stage: Stage,
        pixels: FitPixels | None = None,
    ) -> Colours:
        """Hair and skin colour at a roughness, from albedos `start (3,)` and `skin (3,)`.

        Matched in `pixels`, by default `in_front`. `stage` gets errors against run time.
        """
        began = time.perf_counter()
        series = Series("hair colour", "relative error of the mean colour under uniform light")
        stage.series.append(series)

        def on_iteration(error: float) -> None:
            series.points.append((time.perf_counter() - began, error))
            self.progress("matching the colour", min(0.7 + 0.05 * len(series.points), 0.95))

        base = HairAppearance((0.1, 0.1, 0.1), beta_m, BETA_N)
        result = fit_colour(
            self.scene.with_hair(base).with_skin(skin),
            pixels or self.in_front,
            start=start,
            iterations=self.options.iterations,
            sampling=Sampling(self.options.colour_spp, MAX_DEPTH, self.seed),
            on_iteration=on_iteration,
        )
        count, kept = (sum(len(o.pixels) for o in p.hair) for p in (self.pixels, self.covered))
        if self.covered.hair is self.pixels.hair:
            stage.warn(
                "The strands cover under a tenth of the pixels that show hair, so its colour is "
                "too light: check that masks and geometry are of one capture."
            )
        elif self.in_front.hair is self.covered.hair:
            stage.warn(
                "No light stands on its camera's side of the hair: the colour is estimated from "
                "transmitted light, which depends on the density of the strands."
            )
        if self.pixels.skin and self.covered.skin is self.pixels.skin:
            stage.warn(
                "The head covers under a tenth of the pixels that show skin, so its colour is too "
                "light: check that masks and head are of one capture."
            )
        if kept < count:
            why = f"the strands cover less than {COVERED:.0%} of each"
            stage.leave_out(f"{count - kept} of {count} hair pixels", why, "their renderings")
        if self.in_front.hair is not self.covered.hair:
            why = "errors of strands change transmitted light most"
            stage.leave_out("lights behind the hair", why, "their renderings")
        stage.figures |= {
            "colour": list(result.colour),
            "sigma_a": list(result.hair.sigma_a),
            "sigma_a_of_first_guess": absorption_of_colour(result.pairs[0][0], BETA_N).tolist(),
            "skin": list(result.skin),
            "relative_error": min(result.errors),
        }
        for what, values, least, most in (
            ("colour of dense hair", result.colour, LEAST_ALBEDO, MOST_ALBEDO),
            ("skin's albedo", result.skin, LEAST_SKIN, MOST_SKIN),
        ):
            if min(values) <= least or max(values) >= most:
                stage.warn(
                    f"The {what} is at the end of its range, {least:g} to {most:g}; beta_m was "
                    "matched with it and may be off too."
                )
        if min(result.errors) > 0.05:
            stage.warn(
                f"The mean colour of the renderings is off by {min(result.errors):.0%}: check that "
                "the geometry is complete."
            )
        return result

    def absorption_error(self, colours: Colours) -> list[float | None]:
        """Standard error of log sigma_a by channel; None if the colour does not determine it."""
        self.progress("error of the absorption", 0.97)
        sampling = Sampling(self.options.colour_spp, MAX_DEPTH, self.seed)
        errors = absorption_error(
            self.scene, self.covered.hair, colours, sampling, self.options.error_paths
        )
        return [float(x) if np.isfinite(x) else None for x in errors]

    def _views(self, hair: Sequence[Observed]) -> list[tuple[Observed, VisibleFibres]]:
        """Pixels of hair of one direction with fibres, under lights near their mirror direction."""
        out = []
        for o in hair:
            fibres = visible_fibres(self.scene, o.camera, o.pixels, seed=self.seed)
            out.append(self._under(o, fibres, usable(fibres)))
        return out

    def _under(
        self, o: Observed, fibres: VisibleFibres, pixels: Bools | Ints
    ) -> tuple[Observed, VisibleFibres]:
        """Some of the pixels with fibres, under lights near their mirror direction."""
        o, fibres = o.where(pixels), fibres.where(pixels)
        near = mirror_lights(o, fibres, tilt_deg=self._tilt, window=WINDOW)
        return o.under(near), fibres

    def _highlights(
        self, views: Sequence[tuple[Observed, VisibleFibres]], channel: int
    ) -> tuple[Highlight, Highlights]:
        """The capture's highlight in some pixels of these views, and the `Highlights`."""
        few = [self._under(o, fibres, _spread(o)) for o, fibres in views]
        few = [(o, fibres) for o, fibres in few if len(o.lights)]
        highlights = Highlights(few, self._tilt, channel)
        return highlights.of([np.stack([o.radiance, o.radiance]) for o, _ in few]), highlights

    def _read(
        self, views: Sequence[tuple[Observed, VisibleFibres]], channel: int
    ) -> tuple[Lobe, float, int]:
        parts = [mirror_samples(o, f, tilt_deg=self._tilt, channel=channel) for o, f in views]
        bins = binned(MirrorSamples.joined(parts))
        return fit_lobe(bins), fit_lobe_as_printed(bins), int(bins.count.sum())

    def _halves(self, scene: HairScene, o: Observed, number: int) -> Floats:
        """Two independent renderings `(2, L, P, 3)` of a view with half of the samples each."""
        spp = max(self.options.roughness_spp // 2, 1)
        sampling = asdict(Sampling(spp, MAX_DEPTH, self.seed + (number << 11)))
        twice = np.tile(o.pixels, 2)
        images = render_olat(scene, o.camera, o.lights, pixels=twice, **sampling)
        return np.stack(np.split(images, 2, axis=1))

    @property
    def _tilt(self) -> float:
        return getattr(self.scene.hair, "tilt_deg", 0.0)
